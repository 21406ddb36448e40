"""The splatters: from shaded samples to an image that has derivatives at occlusion boundaries."""

from rts.splatting.edges import Edges
from rts.splatting.paper import Multi, Plain, Single, exact_calibration
from rts.splatting.visible import Visible

__all__ = ["Edges", "Multi", "Plain", "Single", "Visible", "exact_calibration"]
