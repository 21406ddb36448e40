"""Parameters as fits see them: their names, refusals of those without derivative, and values in words."""

from rts.arrays.array_functions import kind_of
from rts.contracts.checks import is_real
from rts.fitting.dependence import differentiable, directions_in_words
from rts.fitting.parameter_names import named_leaves, names_in_words
from rts.fitting.run import untraceable

__all__ = [
    "differentiable",
    "directions_in_words",
    "is_real",
    "kind_of",
    "named_leaves",
    "names_in_words",
    "untraceable",
]
