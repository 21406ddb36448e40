"""The splatters in array code, which compiled ones extend, and cells at outlines."""

from rts.sampling.exits import outline_cells
from rts.splatting.single_and_multi import Multi, Single
from rts.splatting.visible import Visible

__all__ = ["Multi", "Single", "Visible", "outline_cells"]
