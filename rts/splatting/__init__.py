"""The splatters: from shaded samples to an image that has derivatives at occlusion boundaries."""

from rts.splatting.edges import Edges
from rts.splatting.paper import Multi, Plain, Single, exact_calibration

__all__ = ["Edges", "Multi", "Plain", "Single", "exact_calibration"]
