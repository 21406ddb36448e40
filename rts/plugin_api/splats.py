"""Splatters that plugins may extend, and the check of rows before compiled loops read by them."""

from rts.contracts.splatter import SummingSplatter
from rts.splatting.cells import check_rows
from rts.splatting.paper import Multi, Single

__all__ = ["Multi", "Single", "SummingSplatter", "check_rows"]
