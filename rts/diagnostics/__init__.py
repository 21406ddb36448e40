"""Diagnostics of derivatives: finite differences to compare with, pictures, and reasons for disagreement."""

from rts.diagnostics.gradient_images import gradient_image
from rts.diagnostics.gradients import check_gradient

__all__ = ["check_gradient", "gradient_image"]
