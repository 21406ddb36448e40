"""The charts of the pages of results; here those of the first page: growth, and stability."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.pages import table_charts
from benchmarks.pages.drawing import INK, OURS, logarithmic, panels
from benchmarks.pages.kept import kept, number, written
from rts_compare.chart_style import PEER_COLORS

IMAGES = Path(__file__).parents[2] / "docs/images/results"
VERDICTS = {"ok": "well", "degraded": "degraded", "failed": "failed", "cannot": "does not apply"}
VERDICT_COLORS = {"ok": "#2F9E6E", "degraded": "#F2C14E", "failed": "#D1495B", "cannot": "#DDE1E6"}


def growth() -> dict[str, Any]:
    """Milliseconds of a step of a pose's fit by faces, of two sizes of image."""
    lines = {"rts, pose": "RtS-pose, torch, auto", "rts, pose and vertices": "full RtS, torch, auto", "DEODR": "DEODR"}
    found = {}
    for size in ("256²", "512²"):
        columns, rows = written("speed", f"{size}, ms")
        found[size] = {"faces": [number(c) for c in columns]}
        found[size] |= {name: [number(c) for c in rows[line]] for name, line in lines.items()}
    return found


def verdicts() -> dict[str, Any]:
    """How many rows of the table of stability have each verdict, by method."""
    table = kept("stability")
    told = {m: [row["cells"][n]["verdict"] for row in table["rows"]] for n, m in enumerate(table["methods"])}
    return {method: {v: cells.count(v) for v in VERDICTS} for method, cells in told.items()}


def draw_growth(found: dict[str, Any]) -> Any:
    """Time against faces, a panel a size."""
    figure, two = panels(2, 11, 3.9)
    looks = {"rts, pose": ("o-", OURS), "rts, pose and vertices": ("o--", "#8A4B12"),
             "DEODR": ("X-", PEER_COLORS["DEODR"])}  # fmt: skip
    for axes, (size, lines) in zip(two, found.items(), strict=True):
        axes.set(xscale="log", yscale="log", title=f"images of {size}", xlabel="triangles", ylim=(1, 1000))
        axes.grid(color="#e5e7eb")
        for name, (style, color) in looks.items():
            axes.plot(lines["faces"], lines[name], style, color=color, label=name)
        axes.set_xticks(lines["faces"], [f"{n / 1e3:.3g}K" if n < 1e6 else f"{n / 1e6:.2g}M" for n in lines["faces"]])
        axes.minorticks_off()
        logarithmic(axes.yaxis, lambda value: f"{value:g}")
    two[0].set_ylabel("a step of a pose's fit, ms")
    two[0].legend(frameon=False)
    return figure


def draw_verdicts(found: dict[str, Any]) -> Any:
    """Bars: outcomes by method."""
    figure, (axes,) = panels(1, 11, 3.6)
    methods = list(found)[::-1]
    left = [0] * len(methods)
    for verdict, text in VERDICTS.items():
        counts = [found[method][verdict] for method in methods]
        axes.barh(methods, counts, left=left, color=VERDICT_COLORS[verdict], label=text, edgecolor="white")
        for place, (start, count) in enumerate(zip(left, counts, strict=True)):
            if count:
                color = INK if verdict in ("degraded", "cannot") else "white"
                axes.text(start + count / 2, place, str(count), ha="center", va="center", color=color, fontsize=8)
        left = [a + b for a, b in zip(left, counts, strict=True)]
    axes.set(xlabel=f"of {max(left)} ways to fail", xlim=(0, max(left)))
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.legend(frameon=False, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


@dataclass(frozen=True)
class Chart:
    """A chart: a function that gathers its numbers, and one that draws them."""

    numbers: Callable[[], dict[str, Any]]
    figure: Callable[[dict[str, Any]], Any]

    def digest(self) -> str:
        """A checksum of the numbers, which the file of the chart carries."""
        return hashlib.sha256(json.dumps(self.numbers(), sort_keys=True).encode()).hexdigest()[:16]

    def draw(self, path: Path) -> None:
        """Write the chart as SVG."""
        metadata = {"Date": None, "Description": f"numbers {self.digest()}"}
        self.figure(self.numbers()).savefig(path, metadata=metadata, facecolor="white")


CHARTS = {
    "growth": Chart(growth, draw_growth),
    "outcomes": Chart(verdicts, draw_verdicts),
    "samplers": Chart(table_charts.samplers, table_charts.draw_samplers),
    "smooth": Chart(table_charts.smooth, table_charts.draw_smooth),
}
"""Name of a file → its chart."""


def out_of_date(name: str) -> bool:
    """True if a chart's file is missing, or was drawn of other numbers."""
    path = IMAGES / f"{name}.svg"
    return not path.exists() or f"numbers {CHARTS[name].digest()}" not in re.sub(r"\s+", " ", path.read_text())
