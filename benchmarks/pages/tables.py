"""The tables and lists of the pages of results that have JSON files."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable

from benchmarks import basin, nvdiffrast
from benchmarks.pages.kept import kept
from benchmarks.paper import hand
from benchmarks.report import table

MARKS = {"ok": "", "degraded": "~ ", "failed": "✗ "}


def stability() -> str:
    """Ways to fail against methods."""
    found = kept("stability")
    lines = []
    for row in found["rows"]:
        cells = [MARKS[c["verdict"]] + c["text"] if c["verdict"] in MARKS else "–" for c in row["cells"]]
        lines.append([row["name"], *cells])
    return table(["", *found["methods"]], lines)


def hand_rates() -> str:
    """The hand's median errors by method and learning rate."""
    return hand.summary(kept("hand"))


def hand_seeds() -> str:
    """A list: where each seed of the hand ends at the two rates beyond which nothing holds."""
    fits = kept("hand")["fits"]
    lines = []
    for factor in list(next(iter(fits.values())))[-3:-1]:
        ends = {m: " ".join(f"{run['error']:.3f}" for run in runs[factor]) for m, runs in fits.items()}
        told = "; ".join(f"`{method}` {text}" for method, text in ends.items())
        lines.append(f"At ×{factor} the seeds end at: {told}.")
    return _items(*lines)


def why() -> str:
    """Why cells of the table of stability fail, row by row."""
    rows = kept("stability")["rows"]
    return table(["way to fail", "scene and figure", "why"], [[r["name"], r["note"], r["why"] or "–"] for r in rows])


def defects() -> str:
    """Planted mistakes, and the test that catches each."""
    lines = []
    for found in kept("defects"):
        place, _, test = (found["test"] or "").partition("::")
        name = re.sub(r"\[.*", "", test.replace("::", "."))
        caught = f"`{place.removeprefix('tests/').removesuffix('.py')}: {name}`" if test else "none"
        lines.append([found["name"], "yes" if found["loop"] else "", caught])
    return table(["defect", "in a loop", "caught by"], lines)


def _items(*texts: str) -> str:
    """A list in Markdown, in lines of 120 characters."""
    return "\n".join(textwrap.fill(t, 120, initial_indent="- ", subsequent_indent="  ") for t in texts) + "\n"


TABLES: dict[str, Callable[[], str]] = {
    "stability": stability,
    "why": why,
    "hand": hand_rates,
    "hand-seeds": hand_seeds,
    "defects": defects,
    "nvdiffrast-cube": lambda: nvdiffrast.cube_table(kept("nvdiffrast")),
    "nvdiffrast-gradients": lambda: nvdiffrast.gradient_table(kept("nvdiffrast")),
    "nvdiffrast-pose": lambda: nvdiffrast.pose_table(kept("nvdiffrast")),
    "nvdiffrast-outlines": lambda: nvdiffrast.outline_table(kept("nvdiffrast")),
    "nvdiffrast-time": lambda: nvdiffrast.time_table(kept("nvdiffrast")),
    "basin": lambda: basin.summary(kept("basin")["rows"]),
}
"""Name of a mark → a function that makes its table."""
