"""The tables of `run`, as Markdown."""

from __future__ import annotations

import numpy as np

from benchmarks.accuracy.methods import CASES, name_of
from benchmarks.report import table

FAILURES = (
    ("wires 0.3 px", "thinner than the samples are apart: most of a wire is between samples"),
    ("wires 0.5 px", "as above"),
    ("wires 1 px", "ends, and places where both edges are in one pixel"),
    ("turned box", "colours step from face to face"),
    ("spot turns", "thin legs and ears"),
    ("6 cards, alternating", "outlines that cross in a pixel"),
    ("8 cards, alternating", "as above"),
)
"""Scene, and what is hard."""
LEGEND = (
    "*Raw*: relative L2 / cosine, and *low-pass*: relative L2 / gain, against differences over a pixel. *Exact*: "
    "low-passed relative L2 against the closed form, or differences over a quarter of a pixel. Differences over a "
    "pixel are a blurred derivative, against which the finest methods score worse; what the blur costs is in the table."
)
CASE_METHODS = (
    "none, K = 1",
    "single, K = 1",
    "multi, K = 1",
    "multi, K = 2",
    "multi, K = 2, 2 × 2",
    "edges, K = 1",
    "edges, K = 1, 2 × 2",
    "edges, K = 1, 4 × 4",
)


class Rows:
    """The results by scene and method."""

    def __init__(self, results: dict):
        self.results = results
        self.rows = {(row["scene"], row["method"]): row for row in results["rows"]}

    def cell(self, scene: str, method: str, against: str, *keys: str) -> str:
        """Some scores with slashes between them; a dash where nothing was measured."""
        row = self.rows.get((scene, method))
        return " / ".join(f"{row[against][key]:.3f}" for key in keys) if row else "–"

    def low(self, scene: str, method: str) -> str:
        """Low-passed relative L2 against the derivative itself."""
        return self.cell(scene, method, "exact", "low_relative_l2")

    def has(self, scene: str) -> bool:
        return scene in self.results["scenes"]


def cases(rows: Rows) -> str:
    """Methods down, A, B and C across."""
    names = [c for c in CASES if rows.has(c)]
    about = [rows.results["scenes"][c] for c in names]
    columns = {
        "raw": ("pixel", "relative_l2", "cosine"),
        "low-pass": ("pixel", "low_relative_l2", "low_gain"),
        "exact": ("exact", "low_relative_l2"),
    }
    step, noise = ["*difference over a pixel*"], ["*noise of the truth*"]
    for scene in about:
        step += ["", "", f"{scene['step']:.3f}"]
        noise += [f"{scene['noise'][against][key]:.3f}" for against, key, *_ in columns.values()]
    header = ["method", *(f"{c} {column}" for c in names for column in columns)]
    scored = _by_method(rows, names, list(columns.values()))
    rest = _by_method(rows, names, [("pixel", "spurious", "loss_error")])
    return (
        table(header, [*scored, step, noise])
        + "\nSpurious energy / error of random losses' slopes:\n\n"
        + table(["method", *names], rest)
    )


def _by_method(rows: Rows, names: list[str], cells: list[tuple[str, ...]]) -> list[list[str]]:
    """A line for each method of the cases."""
    mitsuba = dict.fromkeys(m for _, m in rows.rows if m.startswith("Mitsuba"))
    return [
        [m, *(rows.cell(scene, m, *cell) for scene in names for cell in cells)]
        for m in (*CASE_METHODS, "DEODR", *mitsuba)
        if any((scene, m) in rows.rows for scene in names)
    ]


def others(rows: Rows) -> str:
    """Every scene but A, B and C."""
    lines = []
    for scene, about in rows.results["scenes"].items():
        methods = [m for s, m in rows.rows if s == scene and not m.startswith("single, K = 1,")]
        if scene in CASES:
            continue
        for method in methods:
            lines.append(
                [
                    scene,
                    method,
                    rows.cell(scene, method, "pixel", "relative_l2", "cosine"),
                    rows.cell(scene, method, "pixel", "low_relative_l2", "low_gain"),
                    rows.cell(scene, method, "pixel", "spurious"),
                    rows.cell(scene, method, "pixel", "loss_error"),
                    rows.low(scene, method) + (" (closed form)" if about["closed_form"] else ""),
                    f"{about['noise']['pixel']['low_relative_l2']:.3f}",
                ]
            )
    header = ["scene", "method", "raw", "low-pass", "spurious", "losses", "exact", "noise"]
    return table(header, lines)


def failures(rows: Rows) -> str:
    """Scenes that are hard for `edges`."""
    lines = []
    method, fine = name_of("edges", 1), name_of("edges", 1, 2)
    for scene, reason in FAILURES:
        if rows.has(scene):
            low = rows.cell(scene, method, "pixel", "low_relative_l2", "low_gain")
            lines.append([scene, low, rows.low(scene, method), rows.low(scene, fine), reason])
    return table(["scene", "low-pass", "exact", "2 × 2, exact", "why"], lines)


def factor(points: list[tuple[float, float]], seconds: float, error: float) -> tuple[str, float]:
    """The ratio of the seconds that the points (error, seconds) of two renderers take to an error, by logarithms.

    Beyond its ends the factor is that of the end, a bound: the first of the two says which.
    """
    errors, times = np.log(np.array(points)).T
    order = np.argsort(errors)
    at = float(np.exp(np.interp(np.log(error), errors[order], times[order])))
    bound = "> " if np.log(error) < errors.min() else "< " if np.log(error) > errors.max() else ""
    return bound, at / seconds


def times(rows: Rows) -> str:
    """Seconds beside errors, and the factor at equal error."""
    lines = []
    for row in rows.results["times"]:
        scene, method = row["scene"], row["method"]
        error = rows.rows[scene, method]["exact"]["low_relative_l2"]
        faster = "–"
        points = [
            (rows.rows[scene, r["method"]]["exact"]["low_relative_l2"], r["seconds"])
            for r in rows.results["times"]
            if r["scene"] == scene and r["method"].startswith("Mitsuba")
        ]
        if points and method.startswith("edges"):
            bound, times_longer = factor(points, row["seconds"], error)
            faster = f"{bound}×{times_longer:.{0 if times_longer >= 10 else 1}f}"
        lines.append([scene, method, f"{row['seconds']:.3f}", f"{error:.3f}", faster])
    header = ["scene", "method", "seconds", "exact", "at equal error, faster than Mitsuba"]
    return "One render and the gradient of a loss in the scalar motion.\n\n" + table(header, lines)


def summary(results: dict) -> str:
    """The text printed at the end."""
    rows = Rows(results)
    return "\n".join(part(rows) for part in (cases, failures, times))


def document(results: dict) -> str:
    rows = Rows(results)
    versions = ", ".join(f"{name} {v}" for name, v in results["versions"].items() if v)
    sections = {
        "The three cases": cases,
        "Where edges still fails": failures,
        "Time": times,
        "All other scenes": others,
    }
    text = f"# Accuracy of derivatives\n\n{results['date']}; {results['machine']}; {versions}.\n\n{LEGEND}\n"
    for title, part in sections.items():
        text += f"\n## {title}\n\n{part(rows)}"
    return text
