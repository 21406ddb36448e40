"""Looking at derivatives: beside finite differences, as pictures, and where they come from."""

from rts.diagnostics.gradients import check_gradient, gradient_image

__all__ = ["check_gradient", "gradient_image"]
