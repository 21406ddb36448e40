"""The tables of `run`, as Markdown."""

from __future__ import annotations

import numpy as np

from benchmarks.accuracy.methods import ADAPTIVE, CASES, CLOSED, name_of
from benchmarks.report import table
from rts_compare.derivative_scores import all_scores

UNCULLED = (
    (
        "sphere",
        2,
        "the same culled: samples inside the rim are nearer than it, so they move faster; staircases as below",
    ),
    ("box over card", 4, "the same culled, and the least that one sample a pixel allows: edges are upright"),
    ("turned box", 4, "the same culled, half with 2 × 2: the edge in the middle is nearly upright"),
    ("A unculled", 4, "nearly that of culled; half with 2 × 2"),
    ("C unculled", 4, "as A"),
    ("6 cards", 6, "half with 2 × 2"),
)
"""Scenes without culling, K, and what their error is."""
CULLED = {"A unculled": "A", "C unculled": "C", **{name: f"{name} culled" for name in CLOSED}}
FAILURES = (
    ("wires 0.3 px", 2, "thinner than the samples are apart: most of a wire is between samples"),
    ("wires 0.5 px", 2, "as above"),
    ("wires 1 px", 2, "both edges of a wire splat into the same pixels, whose sides are one or two samples apart"),
    ("wires 2 px", 2, "the staircases of the steep wires are left: see half-plane"),
    ("C unculled", 2, "K ends at the bunny's back: what its outline reveals is not there (K = 4: next line)"),
    ("C unculled", 4, "deep enough"),
    (
        "spheres",
        4,
        "where surfaces cross, the line moves otherwise than either, and layers of equal depth pair by chance",
    ),
    ("spot turns", 2, "thin legs and ears; outlines themselves are extrapolated"),
    ("6 cards, alternating", 6, "at corners three surfaces with three motions meet in one 3 × 3 window"),
    ("8 cards, alternating", 8, "as above"),
    ("half-plane", 2, "an upright edge: one sample a pixel cannot tell in which of two pixels it is"),
    ("box over card", 4, "as above, at both sides"),
    ("card behind box", 4, "as above; 2 × 2 samples tell the pixel of one of its edges"),
)
"""Scene, K, and what is hard."""
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
    "multi, calibrated, K = 2",
    "multi, K = 2, 2 × 2",
    "visible, K = 1",
    "visible, K = 2",
    "visible, K = 2, 2 × 2",
    "visible, K = 2, 4 × 4",
    *(name_of("visible", 2, adaptive) for adaptive in ADAPTIVE),
    "edges, K = 1",
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


def upright_floor() -> float:
    """Least low-passed error of an upright edge's derivative that one sample a pixel allows.

    All of it lies in one pixel; samples tell only between which two centres the edge is, so half in each of the two
    pixels is the best guess.
    """
    line = np.zeros((64, 64, 3))
    line[:, 32] = 1
    return all_scores((line + np.roll(line, 1, axis=1)) / 2, line)["low_relative_l2"]


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


def unculled(rows: Rows) -> str:
    """Multi beside visible where back faces are drawn."""
    lines = []
    for scene, k, reason in UNCULLED:
        if not rows.has(scene):
            continue
        methods = [name_of(m, k) for m in ("multi", "multi, calibrated", "visible")]
        lines.append(
            [
                scene,
                str(k),
                *(rows.cell(scene, m, "pixel", "low_relative_l2", "low_gain") for m in methods),
                *(rows.low(scene, m) for m in (methods[-1], name_of("visible", k, 2))),
                rows.low(CULLED[scene], name_of("visible", 2)) if scene in CULLED else "open",
                reason,
            ]
        )
    header = ["scene", "K", "multi", "multi, calibrated", "visible", "visible, exact", "visible 2 × 2, exact"]
    return table([*header, "visible culled, exact", "what is left"], lines)


def failures(rows: Rows) -> str:
    lines = []
    for scene, k, reason in FAILURES:
        method, fine = name_of("visible", k), name_of("visible", k, 2)
        if rows.has(scene):
            low = rows.cell(scene, method, "pixel", "low_relative_l2", "low_gain")
            lines.append([scene, str(k), low, rows.low(scene, method), rows.low(scene, fine), reason])
    floor = (
        f"An upright edge with one sample a pixel cannot be nearer than {upright_floor():.3f}: all of its derivative "
        "lies in one pixel, and samples tell only between which two centres it is.\n"
    )
    return table(["scene", "K", "low-pass", "exact", "2 × 2, exact", "why"], lines) + "\n" + floor


def outlines(rows: Rows) -> str:
    """`visible` beside itself where outlines move as the samples inside of them: exact scores at the largest K."""
    scores_ = "low_relative_l2", "low_gain", "loss_error"
    lines = []
    for scene in rows.results["scenes"]:
        found = [m for s, m in rows.rows if s == scene and m.startswith("visible, by samples")]
        pairs = [(m, m.replace(", by samples", "")) for m in found]
        lines.append([scene, *(rows.cell(scene, m, "exact", *scores_) for pair in pairs for m in pair)])
    return table(["scene", "by samples", "visible", "by samples, 2 × 2", "visible, 2 × 2"], lines)


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
        if points and method.startswith("visible"):
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
        "Outlines (low-passed relative L2 / gain / error of random losses, exact)": outlines,
        "Unculled": unculled,
        "Where visible still fails": failures,
        "Time": times,
        "All other scenes": others,
    }
    text = f"# Accuracy of derivatives\n\n{results['date']}; {results['machine']}; {versions}.\n\n{LEGEND}\n"
    for title, part in sections.items():
        text += f"\n## {title}\n\n{part(rows)}"
    return text
