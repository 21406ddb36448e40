"""Splatters that plugins may extend, the check of rows before compiled loops read by them, and cells at outlines."""

from rts.sampling.exits import outline_cells
from rts.splatting.cells import check_rows
from rts.splatting.paper import Multi, Single

__all__ = ["Multi", "Single", "check_rows", "outline_cells"]
