"""What `rts compare` prints."""

from __future__ import annotations

from rich.table import Table

from rts.diagnostics.comparison import builtin
from rts.diagnostics.comparison.compare import Comparison
from rts.diagnostics.comparison.front import LEVELS
from rts.diagnostics.comparison.style import label


def scene_list() -> Table:
    """The built-in scenes."""
    table = Table("scene", "what is hard about it", "data")
    for name, scene in builtin.BUILTIN.items():
        table.add_row(name, scene.note, ", ".join(scene.data) or "formulas")
    return table


def summary(comparison: Comparison) -> Table:
    """For each mode the fastest setting within some errors."""
    title = f"{comparison.scene['name']}: fastest settings by the error of derivatives"
    table = Table("mode", *(f"{error:.0%}" for error in LEVELS), title=title)
    for mode in comparison.modes:
        cells = []
        for error in LEVELS:
            row = comparison.best(mode, error)
            cells.append("none" if row is None else f"{label(row)}\n{row['ms']['median']:.3g} ms")
        table.add_row(mode, *cells)
    return table
