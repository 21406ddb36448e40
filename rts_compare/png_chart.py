"""The comparison of settings as a picture: error against time, one panel a mode."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rts.errors import PluginError
from rts.tool_api.files import writing
from rts_compare.chart_style import (
    PEER_SYMBOL,
    Looks,
    drawn,
    environment_line,
    label,
    samples_label,
    side_length,
)
from rts_compare.pareto_front import Row, milliseconds

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKERS = {
    "circle": "o",
    "square": "s",
    "diamond": "D",
    "triangle-up": "^",
    "triangle-down": "v",
    "triangle-left": "<",
    "triangle-right": ">",
    "hexagon": "h",
    "pentagon": "p",
    "star": "*",
    "cross": "P",
    "x": "X",
}
"""Name of a symbol in `chart_style` → matplotlib's marker."""
INK, PALE = "#1f2937", "#6b7280"
COLUMNS = 2
PANEL_WIDTH, PANEL_HEIGHT, LEGEND_WIDTH, LINE_HEIGHT = 5.4, 4.3, 2.2, 0.142
"""Inches; `LINE_HEIGHT` is the height of a text line in the list under a panel."""
CHARACTER_WIDTH, TITLE_CHARACTER_WIDTH = 0.075, 0.1
"""Width of a character in the text below all panels, and of one above them, inches."""
LONGEST = 84
"""The most characters of a text line in the list under a panel."""


def draw(comparison: Mapping[str, Any], path: Path) -> None:
    """Draw the error of derivatives against the time of a render and gradient.

    The rows on the Pareto front are numbered, and listed under their panel. Rows without time are not drawn.

    Args:
        comparison: `Comparison.data`, also as read from its JSON file.
        path: of the PNG.

    Raises:
        PluginError: matplotlib is missing.
        InputError: the file cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise PluginError("charts need matplotlib: pip install 'rasterize-then-splat[plots]'") from error
    rows = [row for row in comparison["rows"] if drawn(row)]
    looks = Looks.of(rows)
    modes = {mode: [row for row in rows if row["mode"] == mode] for mode in comparison["modes"]}
    front_height = LINE_HEIGHT * max(2, 1 + max((len(_front(found)) for found in modes.values()), default=0))
    columns, lines = max(1, min(COLUMNS, len(modes))), max(1, -(-len(modes) // COLUMNS))
    size = PANEL_WIDTH * columns + LEGEND_WIDTH, (PANEL_HEIGHT + front_height) * lines + 0.8
    figure = Figure(figsize=size, dpi=110, layout="constrained")
    panels = figure.subplots(2 * lines, columns, squeeze=False, height_ratios=[PANEL_HEIGHT, front_height] * lines)
    charts, lists = panels[::2].ravel(), panels[1::2].ravel()
    for axes in (*charts[len(modes) :], *lists):
        axes.set_axis_off()
    for axes, below, (mode, found) in zip(charts, lists, modes.items(), strict=False):
        _panel(axes, found, comparison["modes"][mode]["truth_error"], looks)
        axes.set_title(mode, fontsize=12, color=INK, parse_math=False)
        _list(below, _front(found))
    for axes in panels[::2, 0]:
        axes.set_ylabel("error of the derivative")
    _texts(figure, comparison)
    _legend(figure, rows, looks)
    figure.draw_without_rendering()  # Where there is room for numbers depends on the layout, which stays from here on.
    figure.set_layout_engine("none")
    for axes, found in zip(charts, modes.values(), strict=False):
        _number(figure, axes, _front(found))
    with writing(path):
        figure.savefig(path, facecolor="white")


def _texts(figure: Figure, comparison: Mapping[str, Any]) -> None:
    """Write the scene's name, size and note above the panels, left of the legend, and the environment below them."""
    scene, width = comparison["scene"], figure.get_figwidth() - LEGEND_WIDTH
    lines = [f"{scene['name']}, {' × '.join(map(str, scene['size']))}"]
    lines += textwrap.wrap(scene.get("note", ""), int(width / TITLE_CHARACTER_WIDTH))
    middle = width / figure.get_figwidth() / 2
    figure.suptitle("\n".join(lines), x=middle, fontsize=13, color=INK, parse_math=False)
    where = textwrap.fill(environment_line(comparison["environment"]), int(figure.get_figwidth() / CHARACTER_WIDTH))
    figure.supxlabel(where, fontsize=8, color=PALE, parse_math=False)


def _front(rows: Sequence[Row]) -> list[Row]:
    """The rows on the Pareto front, the fastest first."""
    return sorted((row for row in rows if row.get("front")), key=lambda row: (milliseconds(row), -row["error"]))


def _panel(axes: Axes, rows: Sequence[Row], truth_error: float, looks: Looks) -> None:
    """Draw the points and lines of a mode."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.axhline(truth_error, color=PALE, linestyle="--", linewidth=1, zorder=1)
    axes.plot(*_places(_front(rows)), drawstyle="steps-post", color=INK, linewidth=1.1, zorder=5)
    for (color, symbol, samples, on), same in _alike([row for row in rows if "peer" not in row], looks).items():
        behind = 0.01 * side_length(samples)  # Small symbols are drawn over large ones.
        for mark in _marks(symbol, color, samples):
            axes.plot(*_places(same), **mark, alpha=1.0 if on else 0.45, zorder=6 if on else 4 - behind)
    for peer, color in looks.peers.items():
        places = _places(sorted((row for row in rows if row.get("peer") == peer), key=milliseconds))
        axes.plot(*places, color=color, linewidth=1.2, zorder=4)
        axes.plot(*places, **_marks(PEER_SYMBOL, color)[0], zorder=4)
    _ticks(axes)
    axes.set_xlabel("time of a render and gradient, ms")
    axes.tick_params(labelsize=9)
    axes.grid(which="major", color="#e5e7eb", linewidth=0.8)
    axes.set_axisbelow(True)


def _ticks(axes: Axes) -> None:
    """Set limits with room for numbers on the left and below, and ticks at 1, 2, 5, 10."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    axes.set(xlim=(left * (left / right) ** 0.06, right), ylim=(low * (low / high) ** 0.06, high))
    for axis, least, most, text in (
        (axes.xaxis, left, right, lambda value, _: f"{value:,.10g}"),
        (axes.yaxis, low, high, lambda value, _: f"{100 * value:.10g} %"),
    ):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if most < 2000 * least else (1,)))
        axis.set_major_formatter(FuncFormatter(text))
        axis.set_minor_formatter(NullFormatter())


def _alike(rows: Sequence[Row], looks: Looks) -> dict[tuple[str, str, int, bool], list[Row]]:
    """(Colour, symbol, samples along a pixel's side, True on the Pareto front) → the rows that look so."""
    found: dict[tuple[str, str, int, bool], list[Row]] = {}
    for row in rows:
        settings = row["settings"]
        symbol = looks.samplers[settings["sampler"]] + looks.engines[settings["engine"]]
        look = looks.splatters[settings["splatter"]], symbol, settings["supersample"], bool(row.get("front"))
        found.setdefault(look, []).append(row)
    return found


def _places(rows: Sequence[Row]) -> tuple[list[float], list[float]]:
    return [milliseconds(row) for row in rows], [row["error"] for row in rows]


def _marks(symbol: str, color: str, supersample: int = 1) -> list[dict[str, Any]]:
    """Keyword arguments of matplotlib's lines that draw a symbol: its shape, and its dot."""
    shape, hollow, dot = symbol.removesuffix("-dot").removesuffix("-open"), "-open" in symbol, symbol.endswith("-dot")
    size = 0.72 * side_length(supersample)  # Points of 1/72 inch.
    mark = {"marker": MARKERS[shape], "markersize": size, "linestyle": "none", "markeredgewidth": 0.9}
    marks = [{**mark, "markeredgecolor": color, "markerfacecolor": "none" if hollow else color}]
    if dot:
        inner = color if hollow else "white"
        marks.append({**mark, "marker": ".", "markersize": 0.6 * size, "color": inner, "markeredgewidth": 0})
    return marks


DIRECTIONS = ((-0.7, -0.7), (-1.0, -0.2), (-0.2, -1.0))
NUMBER_SIZE = (12, 9)
"""Width and height that a number takes, in points."""


def _number(figure: Figure, axes: Axes, rows: Sequence[Row]) -> None:
    """Number these rows, below and left of their points, as near as possible without overlap of numbers."""
    from matplotlib.patheffects import withStroke

    taken = np.empty((0, 2))
    for number, row in enumerate(rows, 1):
        place = (milliseconds(row), row["error"])
        point = axes.transData.transform(place) * 72 / figure.dpi
        near = 0.36 * side_length(row["settings"].get("supersample", 1)) + 6
        tries = [np.array(direction) * (near + 11 * more) for more in range(6) for direction in DIRECTIONS]
        free = (t for t in tries if (np.abs(point + t - taken) >= NUMBER_SIZE).any(axis=1).all())
        offset = next(free, tries[0])
        taken = np.vstack([taken, point + offset])
        axes.annotate(
            str(number),
            place,
            (offset[0], offset[1]),
            textcoords="offset points",
            **{"ha": "center", "va": "center", "fontsize": 8, "color": INK, "zorder": 6},
            in_layout=False,
            path_effects=[withStroke(linewidth=2, foreground="white")],
            arrowprops={"arrowstyle": "-", "linewidth": 0.5, "color": PALE, "shrinkA": 4, "shrinkB": 2},
        )


def _list(axes: Axes, rows: Sequence[Row]) -> None:
    """List time, error and settings of each numbered row of a panel."""
    lines = [f"    {'ms':>8}  {'error':>7}"] if rows else ["    no row was timed"]
    for number, row in enumerate(rows, 1):
        text = f"{number:>3} {milliseconds(row):>8.4g}  {100 * row['error']:>5.3g} %  {label(row)}"
        lines.append(text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…")
    axes.text(
        *(0.0, 1.0, "\n".join(lines)),
        transform=axes.transAxes,
        va="top",
        family="monospace",
        fontsize=7.5,
        color=INK,
        parse_math=False,
        in_layout=False,
    )


def _legend(figure: Figure, rows: Sequence[Row], looks: Looks) -> None:
    """Draw the legend of colours, symbols, sizes and lines beside the panels."""
    from matplotlib.legend_handler import HandlerTuple
    from matplotlib.lines import Line2D

    sides = sorted({row["settings"]["supersample"] for row in rows if "peer" not in row})
    sections = {
        "splatter": {name: _marks("circle", color) for name, color in looks.splatters.items()},
        "sampler": {name: _marks(symbol, PALE) for name, symbol in looks.samplers.items()},
        "engine": {name: _marks(f"circle{fill}", PALE, 2) for name, fill in looks.engines.items()},
        "samples a pixel": {samples_label(s).replace("×", " × "): _marks("circle", PALE, s) for s in sides},
        "other renderers": {
            name: [{"color": color, "linewidth": 1.2}, *_marks(PEER_SYMBOL, color)]
            for name, color in looks.peers.items()
        },
        "lines": {
            "Pareto front": [{"color": INK, "linewidth": 1.1}],
            "error of the truth": [{"color": PALE, "linewidth": 1, "linestyle": "--"}],
        },
    }
    handles, labels, titles = [], [], []
    for title, entries in sections.items():
        if entries:
            titles.append(len(labels))
            handles += [(Line2D([], [], linestyle="none"),)] + [
                tuple(Line2D([], [], **mark) for mark in marks) for marks in entries.values()
            ]
            labels += [title, *entries]
    legend = figure.legend(
        handles,
        labels,
        loc="outside right upper",
        handler_map={tuple: HandlerTuple()},
        **{"frameon": False, "fontsize": 9, "labelspacing": 0.75, "labelcolor": INK},
    )
    for index, text in enumerate(legend.get_texts()):
        text.set(parse_math=False, fontweight="bold" if index in titles else "normal")
