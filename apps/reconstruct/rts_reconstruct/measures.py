"""Measures of renders beside pictures: PSNR, SSIM, and the overlap of outlines."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.ndimage

import rts
from rts_reconstruct.masks import where
from rts_reconstruct.model import Model, moved_camera
from rts_reconstruct.pictures import Pictures, on

SIGMA, RADIUS = 1.5, 5
"""Width and reach of SSIM's window, pixels: 11 × 11, as its authors have it."""
SMALL = 1e-10
"""The least mean square difference, for pictures that are equal."""


class Measured(NamedTuple):
    """Measures of one view.

    Attributes:
        number: the view's number in the data set.
        name: its name.
        held_out: True if it was not fitted.
        psnr: dB, of encoded colours.
        ssim: structural similarity (Wang et al. 2004), the mean over pixels of grey values.
        iou: the overlap of outlines, intersection over union; None where pictures do not tell the object.
        camera: "given", or "fitted" if its pose was fitted to the picture.
        lacks: the length of the longest part of the picture's object that the render lacks, such as a horn, relative to
            the root of the object's area; None where pictures do not tell the object.
    """

    number: int
    name: str
    held_out: bool
    psnr: float
    ssim: float
    iou: float | None
    camera: str = "given"
    lacks: float | None = None


def shown(model: Model, pictures: Pictures, place: int) -> np.ndarray:
    """A render (H, W, 4) of a model as a view has it; `place` counts the views to fit, then those held out."""
    view = (pictures.views + pictures.held_out)[place]
    moved = moved_camera(model.cameras, view.camera, place)
    camera = moved.map(lambda matrix: np.asarray(matrix))
    background = None if pictures.outlined else pictures.background
    return np.clip(np.asarray(rts.render(model.part, camera, view.size, supersample=2, background=background)), 0, 1)


def measured(model: Model, pictures: Pictures) -> list[Measured]:
    """Measures of all views, on the pictures' background; pixels that masks leave out do not count in the PSNR."""
    return [measured_view(model, pictures, place) for place in range(len(pictures.numbers))]


def measured_view(model: Model, pictures: Pictures, place: int) -> Measured:
    """Measures of one view; `place` counts the views to fit, then those held out."""
    view = (pictures.views + pictures.held_out)[place]
    render, image = shown(model, pictures, place), view.image
    pair = [
        on(image, pictures.background),
        on(render if pictures.outlined else render[..., :3], pictures.background),
    ]
    weights = np.ones(view.size) if view.mask is None else view.mask
    error = float((weights[..., None] * (pair[0] - pair[1]) ** 2).sum() / (3 * max(weights.sum(), 1)))
    iou = lacks = None
    if pictures.outlined:
        a, b = (weights > 0.5) & (image[..., 3] > 0.5), (weights > 0.5) & (render[..., 3] > 0.5)
        iou = float((a & b).sum() / max((a | b).sum(), 1))
        lacks = longest_missing(a, b)
    psnr = -10 * float(np.log10(max(error, SMALL)))
    held_out = place >= len(pictures.views)
    camera = "fitted" if model.poses[place].any() else "given"
    return Measured(pictures.numbers[place], str(where(view)), held_out, psnr, ssim(*pair), iou, camera, lacks)


def longest_missing(truth: np.ndarray, found: np.ndarray) -> float:
    """How far parts of an outline (H, W) bool reach out of another, relative to the root of its area.

    Parts of a single pixel do not count.
    """
    missing = scipy.ndimage.binary_opening(truth & ~found, np.ones((2, 2)))
    away: Any = scipy.ndimage.distance_transform_edt(~found)
    return float(away[missing].max(initial=0.0) / max(truth.sum(), 1) ** 0.5)


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """The structural similarity of two pictures (H, W, 3), values from 0 to 1: of their grey values, mean over pixels.

    Source: Wang, Bovik, Sheikh and Simoncelli 2004, *Image Quality Assessment: From Error Visibility to Structural
    Similarity*, equation 13, with a Gaussian window.
    """
    a, b = (np.asarray(x, np.float64) @ [0.299, 0.587, 0.114] for x in (a, b))

    def mean(x: np.ndarray) -> np.ndarray:
        return scipy.ndimage.gaussian_filter(x, SIGMA, radius=RADIUS)

    mean_a, mean_b = mean(a), mean(b)
    spread_a, spread_b, both = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2, mean(a * b) - mean_a * mean_b
    c, d = 0.01**2, 0.03**2
    likeness = (2 * mean_a * mean_b + c) * (2 * both + d) / ((mean_a**2 + mean_b**2 + c) * (spread_a + spread_b + d))
    return float(likeness.mean())


def mean_of(rows: list[Measured], name: str, held_out: bool) -> float | None:
    """The mean of a measure over views that are held out, or over the others; None without any."""
    values = [getattr(row, name) for row in rows if row.held_out == held_out and getattr(row, name) is not None]
    return float(np.mean(values)) if values else None
