"""The figures of `run`: derivative images, error against time, failures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.accuracy import scenes
from benchmarks.accuracy.methods import CASES, name_of
from rts.diagnostics.smoothing import low_pass

COLUMNS = {
    "single, K = 1": "single, K = 1",
    "multi, K = 2": "multi, K = 2",
    "visible, K = 2": "visible, K = 2",
    "visible, K = 2, 2 × 2": "visible, K = 2, 2 × 2",
    "DEODR": "DEODR",
    "Mitsuba, 64 spp": "Mitsuba, 64 spp",
}
"""Methods of the derivative images, and their titles."""
SHOWN, CONTRAST = slice(36, 228), 2.0
"""Rows and columns of A, B and C that are shown, and the factor on their derivatives."""
CONTRAST_LOW = 10.0
"""The factor on low-passed differences."""
OUTLINES = {"4 × 4 at outlines": "D", "4 × 4 around outlines": "P", "8 × 8 at outlines": "*"}
"""Samples where outlines are, and their marks in the figure of times."""
FAILURES = (
    ("wires 0.5 px", 2, (88, 168, 72, 152)),
    ("half-plane", 2, (116, 140, 116, 140)),
    ("box over card", 4, (64, 184, 72, 192)),
    ("8 cards, alternating", 8, (32, 220, 32, 220)),
    ("spheres", 4, (60, 190, 70, 200)),
    ("C unculled", 2, (36, 228, 36, 228)),
)
"""Scene, K, and what is shown: first and last row, first and last column."""


def signed(x: np.ndarray, gain: float = 1.0) -> np.ndarray:
    """Colours of a derivative, grey where it is zero."""
    return (0.5 + gain * x / 2).clip(0, 1)


def show(axes, picture: np.ndarray, title: str = "", left: str = "") -> None:
    axes.imshow(picture, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.set_frame_on(False)
    axes.set_title(title, fontsize=13)
    axes.set_ylabel(left, fontsize=13)


def derivatives(images: dict, against: dict, path: Path) -> None:
    """Derivative images of A, B and C, like the paper's figure 4."""
    from matplotlib.figure import Figure

    cases = [c for c in CASES if c in against]
    columns = {m: title for m, title in COLUMNS.items() if any((c, m) in images for c in scenes)}
    if not cases:
        return
    count = 2 + len(columns)
    figure = Figure(figsize=(2.6 * count, 2.6 * len(cases) + 0.8), layout="constrained")
    for n, (line, scene) in enumerate(zip(figure.subplots(len(cases), count, squeeze=False), cases, strict=True)):
        truth = against[scene].pixel
        show(line[0], scenes.scene(scene).image()[SHOWN, SHOWN].clip(0, 1), "" if n else "image", scene)
        pictures = {"truth": truth.derivative, **{title: images[scene, m] for m, title in columns.items()}}
        for axes, (title, picture) in zip(line[1:], pictures.items(), strict=True):
            show(axes, signed(picture[SHOWN, SHOWN], CONTRAST), "" if n else title)
    figure.suptitle(f"Derivative of the image a pixel of motion × {CONTRAST:g}, grey where it is zero", fontsize=14)
    figure.savefig(path, dpi=100)


def error_vs_time(results: dict, path: Path) -> None:
    """Error of the derivative against the time of a gradient; one panel a scene."""
    from matplotlib.figure import Figure

    errors = {(r["scene"], r["method"]): r["exact"]["low_relative_l2"] for r in results["rows"]}
    cases = [c for c in CASES if any(r["scene"] == c for r in results["times"])]
    if not cases:
        return
    figure = Figure(figsize=(4.6 * len(cases), 5.2), layout="constrained")
    for axes, scene in zip(figure.subplots(1, len(cases), sharey=True, squeeze=False)[0], cases, strict=True):
        for start, end, label, style in (
            ("visible", ("2", "4"), "visible, K = 2, s × s samples a pixel", {"color": "#c2410c", "marker": "o"}),
            *(
                ("visible", (where,), f"the same, {where}", {"color": "#c026d3", "marker": marker, "linestyle": "none"})
                for where, marker in OUTLINES.items()
            ),
            ("Mitsuba", ("",), "Mitsuba 3, direct_projective", {"color": "#1d4ed8", "marker": "s"}),
            ("DEODR", ("",), "DEODR", {"color": "#15803d", "marker": "^"}),
        ):
            rows = [
                r
                for r in results["times"]
                if r["scene"] == scene and r["method"].startswith(start) and r["method"].endswith(end)
            ]
            points = [(r["seconds"], errors[scene, r["method"]]) for r in rows]
            axes.loglog(*np.array(points).reshape(-1, 2).T, label=label, **style)
            place = {"xytext": (-6, -11), "ha": "right"} if start == "visible" else {"xytext": (6, 4)}
            for point, row in zip(points, rows, strict=True):
                text = _sampled(row["method"])
                axes.annotate(text, point, textcoords="offset points", fontsize=9, color=style["color"], **place)
        noise = results["scenes"][scene]["noise"]["exact"]["low_relative_l2"]
        axes.axhline(noise, color="grey", linestyle="--", linewidth=1, label="noise of the truth")
        axes.set_title(scene)
        axes.set_xlabel("seconds of render and gradient")
        axes.grid(alpha=0.3, which="both")
        axes.margins(x=0.22)
    figure.axes[0].set_ylabel("low-passed relative L2 of the derivative image")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=10)
    figure.suptitle(
        "Error of the derivative image against the time of one render and gradient in a scalar motion, both axes "
        "logarithmic.\nThe truth is a difference over ¼ pixel: one over a pixel blurs the derivative by as much as the "
        "methods are off.",
        fontsize=11,
    )
    figure.savefig(path, dpi=120)


def _sampled(method: str) -> str:
    """The label of a point beside its line; points at outlines are labelled in the legend."""
    if method.startswith("Mitsuba"):
        return method.split(", ")[1]
    if method.endswith("outlines"):
        return ""
    return (method.split(", ")[2:] or ["1 × 1"])[0] if method.startswith("visible") else ""


def failures(images: dict, against: dict, path: Path) -> None:
    """Pictures of the places where `visible` is wrong, and of its errors there."""
    from matplotlib.figure import Figure

    chosen = [f for f in FAILURES if f[0] in against]
    if not chosen:
        return
    titles = ["image", "derivative, truth", "derivative, visible", f"low-passed difference × {CONTRAST_LOW:g}"]
    figure = Figure(figsize=(2.9 * 4, 2.9 * len(chosen) + 0.4), layout="constrained")
    for n, (line, (scene, k, (top, bottom, left, right))) in enumerate(
        zip(figure.subplots(len(chosen), 4, squeeze=False), chosen, strict=True)
    ):
        found, reference = images[scene, name_of("visible", k)], against[scene].exact
        pictures = [
            scenes.scene(scene).image().clip(0, 1),
            signed(reference.derivative),
            signed(found),
            signed(low_pass(found - reference.derivative), CONTRAST_LOW),
        ]
        for axes, picture, title in zip(line, pictures, titles, strict=True):
            show(axes, picture[top:bottom, left:right], "" if n else title)
        line[0].set_ylabel(f"{scene}\nK = {k}", fontsize=13)
    figure.savefig(path, dpi=100)
