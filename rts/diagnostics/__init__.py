"""Looking at derivatives: beside finite differences, as pictures, and against the time that they take."""

from rts.diagnostics.comparison.compare import Comparison, compare
from rts.diagnostics.gradients import check_gradient, gradient_image
from rts.diagnostics.tune import tune

__all__ = ["Comparison", "check_gradient", "compare", "gradient_image", "tune"]
