"""Exposures of pictures, evened out where they differ: one mesh has one colour at each place."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

import rts
from rts_reconstruct.model import Model
from rts_reconstruct.pictures import Pictures
from rts_reconstruct.sight import camera_of

SPREAD = 0.03
"""The least standard deviation of the logarithms of exposures that is evened out."""
DARK, BRIGHT = 0.1, 0.97
"""Encoded grey values beyond which a pixel tells no exposure."""
INSIDE = 0.95
"""The least alpha of pixels that tell it."""
FEWEST = 50
"""Pictures with fewer such pixels are taken for ones of the mean exposure."""


def exposures(model: Model, pictures: Pictures) -> np.ndarray | None:
    """Exposures (B,) of the views to fit and of those held out, or None where they hardly differ.

    They are logarithms of factors on encoded colours, 0 in the mean of the views to fit. Each is the median over
    pixels of the difference between picture and render, of log grey values: shadows and wrong masks count little.
    None, too, for pictures on a plain background, which has one colour in all of them.

    Args:
        model: a model that was fitted to the pictures.
        pictures: the pictures as they are.
    """
    if not pictures.outlined:
        return None
    found = np.zeros(len(pictures.numbers))
    for place, view in enumerate(pictures.views + pictures.held_out):
        camera = camera_of(model, pictures, place, view.camera)
        render, image = np.asarray(rts.render(model.part, camera, view.size)), view.image
        counts = render[..., 3] > INSIDE
        if view.mask is not None:
            counts &= view.mask > INSIDE
        if image.shape[2] == 4:
            counts &= image[..., 3] > INSIDE
        pair = [x[..., :3].mean(axis=2)[counts] for x in (image, render)]
        usable = np.all([(x > DARK) & (x < BRIGHT) for x in pair], axis=0)
        differences = np.log(pair[0][usable] / pair[1][usable])
        found[place] = np.median(differences) if len(differences) >= FEWEST else np.nan
    fitted = found[: len(pictures.views)]
    if np.isfinite(fitted).sum() < 2:
        return None
    found = np.nan_to_num(found - np.nanmean(fitted))
    return found if found[: len(pictures.views)].std() > SPREAD else None


def evened(pictures: Pictures, found: np.ndarray | None) -> Pictures:
    """The pictures as if all had the mean exposure, given those of `exposures`; None leaves them as they are."""
    if found is None:
        return pictures
    every = zip(pictures.views + pictures.held_out, found, strict=True)
    views = [_scaled(view, np.exp(-log), keep=True) for view, log in every]
    whole = [_scaled(view, np.exp(-log), keep=False) for view, log in zip(pictures.given, found, strict=True)]
    count = len(pictures.views)
    return replace(pictures, views=views[:count], held_out=views[count:], given=whole, exposures=found)


def _scaled(view: rts.View, factor: float, keep: bool) -> rts.View:
    """A view whose colours, but not its alpha, are multiplied by a factor."""

    def image() -> np.ndarray:
        scaled = np.array(view.image)
        scaled[..., :3] *= factor
        return scaled

    def mask() -> np.ndarray:
        assert view.mask is not None
        return view.mask

    reading = functools.cache(image) if keep else image
    same = None if view.mask is None else mask
    return rts.View(view.camera, reading, view.size, name=view.name, mask=same, path=view.path, lens=view.lens)
