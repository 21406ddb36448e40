"""Tables and lines that `rts compare` prints."""

from __future__ import annotations

from importlib.util import find_spec

from rich.table import Table

from rts.diagnostics.comparison import builtin
from rts.diagnostics.comparison.compare import Comparison
from rts.diagnostics.comparison.front import LEVELS
from rts.diagnostics.comparison.style import label, time_label


def scene_list() -> Table:
    """The built-in scenes."""
    table = Table("scene", "what is hard about it", "data")
    for name, scene in builtin.BUILTIN.items():
        table.add_row(name, scene.note, ", ".join(scene.data) or "formulas")
    return table


def missing_charts() -> str | None:
    """A line that names the charts for which a package is missing; None if no package is."""
    kinds = {"matplotlib": "PNG", "plotly": "HTML"}
    missing = [package for package in kinds if find_spec(package) is None]
    if not missing:
        return None
    return (
        f"no {' or '.join(kinds[package] for package in missing)}, which needs {' and '.join(missing)}: pip install "
        f"'rasterize-then-splat[plots]'. What is measured is kept: the same command draws it later"
    )


def summary(comparison: Comparison) -> Table:
    """A table of the fastest setting of each mode, for several bounds of the error."""
    title = f"{comparison.scene['name']}: fastest settings by the error of derivatives"
    table = Table("mode", *(f"{error:.0%}" for error in LEVELS), title=title)
    for mode in comparison.modes:
        cells = []
        for error in LEVELS:
            row = comparison.best(mode, error)
            cells.append("none" if row is None else f"{label(row)}\n{time_label(row['ms']['median'])}")
        table.add_row(mode, *cells)
    return table
