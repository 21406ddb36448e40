"""Arrays of any engine, and trees of them."""

from rts.arrays.array_functions import from_numbers, shape_of
from rts.arrays.engines import constants, engine_of, exemplar, namespace
from rts.arrays.trees import Array, Tree, leaves, map_leaves
from rts.operations.unit import unit

__all__ = [
    "Array",
    "Tree",
    "constants",
    "engine_of",
    "exemplar",
    "from_numbers",
    "leaves",
    "map_leaves",
    "namespace",
    "shape_of",
    "unit",
]
