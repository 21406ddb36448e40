"""The figures of `run`: derivative images, and failures. `benchmarks.pages` draws error against time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.accuracy import scenes
from benchmarks.accuracy.methods import CASES, name_of
from rts_diagnostics.smoothing import low_pass

COLUMNS = {
    "single, K = 1": "single, K = 1",
    "multi, K = 2": "multi, K = 2",
    "edges, K = 1": "edges",
    "DEODR": "DEODR",
    "Mitsuba, 64 spp": "Mitsuba,\n64 spp",
}
"""Methods of the derivative images, and their titles."""
SHOWN, CONTRAST = slice(36, 228), 2.0
"""Rows and columns of A, B and C that are shown, and the factor on their derivatives."""
ENLARGED = {"A": (40, 96, 60, 116), "B": (96, 152, 168, 224), "C": (84, 140, 166, 222)}
"""First and last row, first and last column of what is enlarged of them."""
TITLES = {"A": "A: bunny\nover black", "B": "B: square\nbehind bunny", "C": "C: bunny\nbefore square"}
CONTRAST_LOW = 10.0
"""The factor on low-passed differences."""
FAILURES = (
    ("wires 0.5 px", (88, 168, 72, 152)),
    ("turned box", (64, 184, 72, 192)),
    ("8 cards, alternating", (32, 220, 32, 220)),
    ("spheres", (60, 190, 70, 200)),
)
"""Scene, and what is shown: first and last row, first and last column."""


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
    """Derivative images of A, B and C, like the paper's figure 4, and how they differ from the truth, enlarged.

    A scene has two lines: the picture with a frame around the part that is enlarged, and the derivatives there; beneath
    each derivative its difference from the truth, after the blur of the scores.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    cases = [c for c in CASES if c in against]
    columns = {m: title for m, title in COLUMNS.items() if any((c, m) in images for c in cases)}
    if not cases:
        return
    count = 2 + len(columns)
    figure = Figure(figsize=(1.75 * count, 3.6 * len(cases) + 0.6), layout="constrained")
    lines = figure.subplots(2 * len(cases), count, squeeze=False)
    for n, scene in enumerate(cases):
        truth = against[scene].pixel.derivative
        top, bottom, left, right = ENLARGED[scene]
        rows, line, below = (slice(top, bottom), slice(left, right)), lines[2 * n], lines[2 * n + 1]
        show(line[0], scenes.scene(scene).image()[SHOWN, SHOWN].clip(0, 1), "" if n else "picture", TITLES[scene])
        corner = left - SHOWN.start - 0.5, top - SHOWN.start - 0.5
        line[0].add_patch(Rectangle(corner, right - left, bottom - top, fill=False, edgecolor="white", linewidth=1.5))
        show(line[1], signed(truth[rows], CONTRAST), "" if n else "truth")
        for axes in below[:2]:
            axes.set_axis_off()
        below[1].text(0.98, 0.5, f"difference from\nthe truth, blurred,\n× {CONTRAST_LOW:g}", ha="right", va="center",
                      transform=below[1].transAxes, fontsize=11)  # fmt: skip
        for axes, under, (method, title) in zip(line[2:], below[2:], columns.items(), strict=True):
            found = images[scene, method]
            show(axes, signed(found[rows], CONTRAST), "" if n else title)
            show(under, signed(low_pass(found - truth)[rows], CONTRAST_LOW))
    figure.suptitle(
        f"Derivative of the picture a pixel of motion, × {CONTRAST:g}; grey is zero. Below, how far each is off.",
        fontsize=13,
    )
    figure.savefig(path, dpi=100)


def failures(images: dict, against: dict, path: Path) -> None:
    """Pictures of the places where `edges` is wrong, and of its errors there."""
    from matplotlib.figure import Figure

    chosen = [f for f in FAILURES if f[0] in against]
    if not chosen:
        return
    titles = ["image", "derivative, truth", "derivative, edges", f"low-passed difference × {CONTRAST_LOW:g}"]
    figure = Figure(figsize=(2.9 * 4, 2.9 * len(chosen) + 0.4), layout="constrained")
    for n, (line, (scene, (top, bottom, left, right))) in enumerate(
        zip(figure.subplots(len(chosen), 4, squeeze=False), chosen, strict=True)
    ):
        found, reference = images[scene, name_of("edges", 1)], against[scene].exact
        pictures = [
            scenes.scene(scene).image().clip(0, 1),
            signed(reference.derivative),
            signed(found),
            signed(low_pass(found - reference.derivative), CONTRAST_LOW),
        ]
        for axes, picture, title in zip(line, pictures, titles, strict=True):
            show(axes, picture[top:bottom, left:right], "" if n else title)
        line[0].set_ylabel(scene, fontsize=13)
    figure.savefig(path, dpi=100)
