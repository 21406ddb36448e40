"""Functions of arrays with compiled values and derivatives, and the record for defining more."""

from rts.operations.combine import combine, differences, interpolate
from rts.operations.gradient import gradient
from rts.operations.operation import Operation
from rts.operations.room import filled_up, with_room
from rts.operations.take import take
from rts.shading.tangents import tangent_along

__all__ = [
    "Operation",
    "combine",
    "differences",
    "filled_up",
    "gradient",
    "interpolate",
    "take",
    "tangent_along",
    "with_room",
]
