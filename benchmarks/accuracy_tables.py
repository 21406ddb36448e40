"""The tables of `accuracy`, as Markdown."""

from __future__ import annotations

import numpy as np
from methods import CASES, CLOSED, name_of
from truth import scores

UNCULLED = (
    ("sphere", 2),
    ("box over card", 4),
    ("turned box", 4),
    ("A unculled", 4),
    ("C unculled", 4),
    ("6 cards", 6),
)
"""Scenes without culling, and K."""
CULLED = {"A unculled": "A", "C unculled": "C", **{name: f"{name} culled" for name in CLOSED}}
FAILURES = (
    ("wires 0.3 px", 2, "thinner than the samples are apart: most of a wire is between samples"),
    ("wires 0.5 px", 2, "as above"),
    ("wires 1 px", 2, "both edges of a wire splat into the same pixels, whose sides are one or two samples apart"),
    ("wires 2 px", 2, "wide enough"),
    ("C unculled", 2, "K ends at the bunny's back: what its outline reveals is not there (K = 4: next line)"),
    ("C unculled", 4, "deep enough"),
    ("spheres", 4, "where surfaces cross, the line moves with neither: samples carry no edge there"),
    ("6 cards, alternating", 6, "at corners three surfaces with three motions meet in one 3 × 3 window"),
    ("8 cards, alternating", 8, "as above"),
    ("half-plane", 2, "an upright edge: one sample a pixel cannot tell in which of two pixels it is"),
    ("box over card", 4, "as above, at both sides"),
    ("card behind box", 4, "as above"),
)
"""Scene, K, and what is hard."""
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


def table(header: list[str], lines: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, ["---"] * len(header), *lines)) + "\n"


def upright_floor() -> float:
    """Least low-passed error of an upright edge's derivative that one sample a pixel allows.

    All of it lies in one pixel; samples tell only between which two centres the edge is, so half in each of the two
    pixels is the best guess.
    """
    line = np.zeros((64, 64, 3))
    line[:, 32] = 1
    return scores((line + np.roll(line, 1, axis=1)) / 2, line)["low_relative_l2"]


def cases(rows: Rows) -> str:
    """Methods down, A, B and C across."""
    names = [c for c in CASES if rows.has(c)]
    mitsuba = [m for scene, m in rows.rows if scene == names[0] and m.startswith("Mitsuba")]
    methods = [*CASE_METHODS, "DEODR", *mitsuba]
    columns = {
        "raw": ("pixel", "relative_l2", "cosine"),
        "low-pass": ("pixel", "low_relative_l2", "low_gain"),
        "¼ px": ("exact", "low_relative_l2"),
    }
    header = ["method", *(f"{c} {column}" for c in names for column in columns)]
    lines = [
        [m, *(rows.cell(c, m, *columns[column]) for c in names for column in columns)]
        for m in methods
        if any((c, m) in rows.rows for c in names)
    ]
    noise = ["*noise of the truth*"]
    for c in names:
        found = rows.results["scenes"][c]["noise"]
        noise += [f"{found['pixel'][key]:.3f}" for key in ("relative_l2", "low_relative_l2")]
        noise.append(f"{found['exact']['low_relative_l2']:.3f}")
    rest = [
        [m, *(rows.cell(c, m, "pixel", "spurious", "loss_error") for c in names)]
        for m in methods
        if any((c, m) in rows.rows for c in names)
    ]
    return (
        "*Raw*: relative L2 / cosine, *low-pass*: relative L2 / gain, both against differences over a pixel. *¼ px*: "
        "low-passed relative L2 against differences over a quarter of a pixel.\n\n"
        + table(header, [*lines, noise])
        + "\nSpurious energy / error of random losses' slopes:\n\n"
        + table(["method", *names], rest)
    )


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
    header = ["scene", "method", "raw", "low-pass", "spurious", "losses", "low-pass, exact", "noise"]
    return table(header, lines)


def unculled(rows: Rows) -> str:
    """Multi beside visible where back faces are drawn."""
    lines = []
    for scene, k in UNCULLED:
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
            ]
        )
    header = ["scene", "K", "multi", "multi, calibrated", "visible", "visible, exact", "visible 2 × 2, exact"]
    return table([*header, "visible culled, exact"], lines)


def failures(rows: Rows) -> str:
    lines = []
    for scene, k, reason in FAILURES:
        method, fine = name_of("visible", k), name_of("visible", k, 2)
        if rows.has(scene):
            low = rows.cell(scene, method, "pixel", "low_relative_l2", "low_gain")
            lines.append([scene, str(k), low, rows.low(scene, method), rows.low(scene, fine), reason])
    floor = f"An upright edge with one sample a pixel cannot be nearer than {upright_floor():.3f}.\n"
    return table(["scene", "K", "low-pass", "exact", "2 × 2, exact", "why"], lines) + "\n" + floor


def factor(points: list[tuple[float, float]], seconds: float, error: float) -> tuple[str, float]:
    """How many times longer the points (error, seconds) of a renderer take to an error, by logarithms.

    Beyond its ends the factor is that of the end, a bound: the first of the two says which.
    """
    errors, times = np.log(np.array(points)).T
    order = np.argsort(errors)
    at = float(np.exp(np.interp(np.log(error), errors[order], times[order])))
    bound = ">" if np.log(error) < errors.min() else "<" if np.log(error) > errors.max() else ""
    return bound, at / seconds


def times(rows: Rows) -> str:
    """Seconds beside errors, and the factor at equal error."""
    lines = []
    for row in rows.results["times"]:
        scene, method = row["scene"], row["method"]
        error = rows.rows[scene, method]["exact"]["low_relative_l2"]
        faster = ""
        points = [
            (rows.rows[scene, r["method"]]["exact"]["low_relative_l2"], r["seconds"])
            for r in rows.results["times"]
            if r["scene"] == scene and r["method"].startswith("Mitsuba")
        ]
        if points and method.startswith("visible"):
            bound, times_longer = factor(points, row["seconds"], error)
            faster = f"at equal error {bound}×{times_longer:.3g} faster than Mitsuba"
        lines.append([scene, method, f"{row['seconds']:.3f}", f"{error:.3f}", faster])
    return table(["scene", "method", "seconds", "low-pass, exact", ""], lines)


def summary(results: dict) -> str:
    """What is printed at the end."""
    rows = Rows(results)
    return "\n".join(part(rows) for part in (cases, failures, times) if part is not cases or rows.has(CASES[0]))


def document(results: dict) -> str:
    rows = Rows(results)
    versions = ", ".join(f"{name} {v}" for name, v in results["versions"].items() if v)
    sections = {
        "The three cases": cases,
        "Unculled": unculled,
        "Where visible still fails": failures,
        "Time": times,
        "All other scenes": others,
    }
    text = f"# Accuracy of derivatives\n\n{results['date']}; {results['machine']}; {versions}.\n"
    for title, part in sections.items():
        text += f"\n## {title}\n\n{part(rows)}"
    return text
