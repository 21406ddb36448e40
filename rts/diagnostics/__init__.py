"""Looking at derivatives: beside finite differences, as pictures, against their time, and where they break."""

from rts.diagnostics.comparison.compare import Comparison, compare
from rts.diagnostics.failures.stability import Stability, stability
from rts.diagnostics.gradients import check_gradient, gradient_image
from rts.diagnostics.tune import tune

__all__ = ["Comparison", "Stability", "check_gradient", "compare", "gradient_image", "stability", "tune"]
