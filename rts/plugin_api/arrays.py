"""Arrays of any engine, and trees of them."""

from rts.arrays.array_functions import from_numbers, shape_of, unit
from rts.arrays.engines import constants, exemplar
from rts.arrays.trees import Array, Tree, leaves, map_leaves

__all__ = [
    "Array",
    "Tree",
    "constants",
    "exemplar",
    "from_numbers",
    "leaves",
    "map_leaves",
    "shape_of",
    "unit",
]
