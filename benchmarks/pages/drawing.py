"""Looks of the charts of results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

INK, PALE, OURS = "#1f2937", "#6b7280", "#D55E00"


def panels(columns: int, width: float, height: float, rows: int = 1) -> tuple[Any, Any]:
    """A figure of `width` × `height` inches, and its axes, row by row."""
    import matplotlib
    from matplotlib.figure import Figure

    matplotlib.rcParams.update({"svg.hashsalt": "rts", "font.family": "DejaVu Sans", "font.size": 9})
    figure = Figure(figsize=(width, height), layout="constrained")
    found = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in found:
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(colors=INK)
        axes.set_axisbelow(True)
    return figure, found


def logarithmic(axis: Any, text: Callable[[float], str], subs: Sequence[int] = (1, 2, 5)) -> None:
    """Set ticks at `subs` times powers of ten, written out by `text`."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda value, _: text(value)))
    axis.set_minor_formatter(NullFormatter())
