"""A verdict on a reconstruction: whether it is a blob, what is wrong, and what to try."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

import rts
from rts_reconstruct import points, posing
from rts_reconstruct.measures import Measured, mean_of, measured_view
from rts_reconstruct.model import Model
from rts_reconstruct.pictures import Pictures
from rts_reconstruct.stages import Settings

PSNR, OVERLAP, AWAY = 13.0, 0.75, 5.0
"""A blob has a smaller PSNR, dB, or overlap of outlines, or points farther away: 90th percentile, % of the diagonal."""
LOOSE = 0.9
"""The overlap of outlines from which on masks and mesh agree."""
LACKING = 0.05
"""The length of a part that the mesh lacks in half of the views, relative to the root of the object's area."""
FALLEN = 0.7
"""The share of the first losses that the last ones may be."""
BELOW, DARKER = 0.1, 5.0
"""How far a view's overlap, or its PSNR in dB, is below the median of all if it disagrees."""
GAIN = 1.0
"""dB that a view gains by a camera that is fitted, if its camera was at fault."""
FINE = 35.0
"""The median PSNR, dB, from which on cameras are good enough."""
TRIED = 3
"""The most views whose cameras are tried."""
FRONT, AROUND = 100.0, 150.0
"""The largest angle between two cameras, degrees: at less they see a front; at more than the second, all around."""
UNSEEN = 0.2
"""The share of the surface that may go unseen."""


class Verdict(NamedTuple):
    """The outcome in words.

    Attributes:
        blob: True if the mesh does not look like the pictures.
        figures: what was measured.
        findings: what is wrong, and what to try, in the order of weight.
    """

    blob: bool
    figures: str
    findings: tuple[str, ...]

    def __str__(self) -> str:
        head = "not a reconstruction" if self.blob else "no fault was found" if not self.findings else "with faults"
        return f"verdict: {head} ({self.figures})" + "".join(f"; {finding}" for finding in self.findings)


def verdict(
    model: Model,
    pictures: Pictures,
    rows: Sequence[Measured],
    losses: Sequence[Sequence[float]],
    unseen: float,
    settings: Settings,
    cut: float = 0.0,
) -> Verdict:
    """The verdict on a model.

    Args:
        model: the model.
        pictures: the pictures that it was fitted to.
        rows: their measures, of views to fit and then of those held out.
        losses: of each stage.
        unseen: the share of the surface that no view sees.
        settings: of the fit.
        cut: the share of the surface that was cut away, since no view sees it.
    """
    psnr = mean_of(list(rows), "psnr", bool(pictures.held_out)) or 0.0
    overlap = mean_of(list(rows), "iou", False)
    away = None
    if pictures.points is not None and pictures.region is not None:
        away = points.distances(pictures.points, pictures.region, pictures.world.outside(model.vertices), model.faces)
    figures = f"PSNR {psnr:.1f} dB"
    if overlap is not None and not pictures.by_points:  # Masks of the points' own solid overlap in any case.
        figures += f", overlap of outlines {overlap:.3f}"
    if away is not None:
        figures += f", points off by {away[0]:.2f} % of the diagonal, 90th percentile {away[1]:.2f} %"
    figures += f", {100 * unseen:.0f} % of the surface unseen"
    if cut:
        figures += f", {100 * cut:.0f} % cut away"
    if pictures.exposures is not None:
        figures += f", exposures that differ by {100 * pictures.exposures.std():.0f} % evened out"
    blob = psnr < PSNR or (overlap is not None and overlap < OVERLAP) or (away is not None and away[1] > AWAY)
    findings = []
    if overlap is not None and overlap < LOOSE:
        findings.append(
            "masks contradict each other, or cameras do not fit them: look at the masks, and leave them out if COLMAP "
            "has points"
            if settings.robust
            else "the mesh does not fill its outlines: give more --steps, or another --start"
        )
    lacks = [row.lacks for row in rows if row.lacks is not None]
    if lacks and np.median(lacks) > LACKING and not pictures.by_points:
        worst = max(rows, key=lambda row: row.lacks or 0.0)
        findings.append(
            f"the mesh lacks parts that outlines show, such as in {worst.name or worst.number}: leave out --quick, "
            "give more --steps, or take --start hull"
        )
    if away is not None and away[1] > AWAY:
        findings.append("the mesh is far from COLMAP's points: its outlines are of something else, or --region is")
    first, last = _ends(losses)
    # A robust loss, which later stages have, does not compare with the first stage's.
    if last > FALLEN * first and psnr < 20 and not settings.robust:
        findings.append(f"the loss has not fallen ({first:.2g} → {last:.2g}): give more --steps, or another --start")
    findings += _disagreeing(model, pictures, rows, settings)
    angle = points.span(pictures.views, np.zeros(3))
    fate = "cut away" if cut else "made up"
    if angle < FRONT:
        findings.append(
            f"the cameras are within {angle:.0f}° and do not surround a thing: this is a front, and what is behind it "
            f"is {fate}; take pictures from all around"
        )
    elif unseen > UNSEEN:
        where = "" if angle >= AROUND else f", and cameras are within {angle:.0f}° of one another"
        findings.append(f"much of the surface is in no picture{where}: what faces away from them is {fate}")
    return Verdict(blob, figures, tuple(findings))


def _ends(losses: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Means of the first and last tenth of the losses of all stages but the last, which fits a texture alone."""
    values = [value for stage in losses[: max(len(losses) - 1, 1)] for value in stage]
    if not values:
        return 1.0, 0.0
    count = max(len(values) // 10, 1)
    return float(np.mean(values[:count])), float(np.mean(values[-count:]))


def _disagreeing(model: Model, pictures: Pictures, rows: Sequence[Measured], settings: Settings) -> list[str]:
    """Views that fit worse than most; of each, whether another pose of its camera helps."""
    psnr = np.array([row.psnr for row in rows])
    overlap = np.array([1.0 if row.iou is None else row.iou for row in rows])
    worse = (psnr < np.median(psnr) - DARKER) | (overlap < np.median(overlap) - BELOW)
    suspects = [int(i) for i in np.argsort(psnr) if worse[i]]
    findings = []
    names = {"camera": [], "picture": []}
    for place in suspects[:TRIED]:
        names["camera" if _gain(model, pictures, place, settings) > GAIN else "picture"].append(rows[place].name)
    more = f" and {len(suspects) - TRIED} more" if len(suspects) > TRIED else ""
    if names["camera"]:
        findings.append(f"cameras that do not fit the others: {', '.join(names['camera'])}: try --fit-cameras")
    if names["picture"]:
        what = "masks or light" if pictures.outlined and not pictures.by_points else "light, or what moved"
        findings.append(f"pictures that disagree with the others{more}: {', '.join(names['picture'])}: look at {what}")
    if not settings.cameras and np.median(psnr) < FINE:
        fine = [i for i in range(len(pictures.views)) if not worse[i]]
        tried = [fine[i] for i in np.unique(np.linspace(0, len(fine) - 1, TRIED).astype(int))] if fine else []
        if tried and np.median([_gain(model, pictures, i, settings) for i in tried]) > GAIN:
            findings.append("most pictures fit better with other cameras: try --fit-cameras")
    return findings


def _gain(model: Model, pictures: Pictures, place: int, settings: Settings) -> float:
    """The PSNR, dB, that a view gains if its camera is fitted to the mesh."""
    plain = model._replace(atlas=None)  # Which is faster, and tells as much.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rts.errors.InputWarning)  # The fit of all views has warned, by their numbers.
        moved = posing.posed(plain, pictures, settings._replace(progress=False), [place], steps=posing.FEW)
    return measured_view(moved, pictures, place).psnr - measured_view(plain, pictures, place).psnr
