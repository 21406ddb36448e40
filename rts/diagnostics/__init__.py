"""Diagnostics of derivatives: finite differences to compare with, pictures, and reasons for disagreement."""

from rts.diagnostics.gradients import check_gradient, gradient_image

__all__ = ["check_gradient", "gradient_image"]
