"""Masks that are inexact, refined by the colours of their pictures: GrabCut (Rother et al. 2004), by OpenCV."""

from __future__ import annotations

import functools

import numpy as np
import scipy.ndimage

import rts
from rts_reconstruct import masks

LARGEST = 512
"""Longer sides of pictures whose masks are refined, at most."""
BAND = 0.055
"""How far from its outline a mask is not relied on, in longer sides of the picture."""
ROUNDS = 3
"""Rounds of GrabCut: in each one the colours of both sides are learnt, and the cheapest cut found."""


def is_installed() -> bool:
    """True if OpenCV is there, and runs."""
    try:
        import cv2  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except ImportError:
        return False
    return True


def refined(view: rts.View) -> rts.View:
    """A view of a data set with alpha by its mask, whose outline has moved to an edge of the picture nearby.

    The mask is white where the object is. The image is encoded, (H, W, 3), or (H, W, 4) with an alpha that tells
    nothing.
    """

    @functools.cache
    def inside() -> np.ndarray:
        return _inside(view.image[..., :3], masks.mask_of(view))

    def image() -> np.ndarray:
        alpha = _resized(inside(), view.size)[..., None] > 0.5
        return np.concatenate([view.image[..., :3] * alpha, alpha.astype(np.float32)], axis=2)

    counts = None if view.lens is None else lambda: masks.shown(view)
    return rts.View(view.camera, image, view.size, name=view.name, mask=counts, path=view.path, lens=view.lens)


def _inside(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """True at pixels of the object, in at most `LARGEST` a side, by a picture (H, W, 3) and an inexact mask (H, W)."""
    import cv2

    shrink = max(1.0, max(mask.shape) / LARGEST)
    height, width = (max(1, round(extent / shrink)) for extent in mask.shape)
    colors, inside = _resized(image, (height, width)), _resized(mask, (height, width)) > 0.5
    away = [np.asarray(scipy.ndimage.distance_transform_edt(side)) for side in (inside, ~inside)]
    sure = away[0] + away[1] > BAND * max(height, width)
    if not (inside & sure).any() or not (~inside & sure).any():
        return inside  # Nothing tells the colours of one side.
    kinds = np.where(inside, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    kinds[sure] = np.where(inside[sure], cv2.GC_FGD, cv2.GC_BGD)
    cv2.setRNGSeed(0)  # Which makes the outcome the same each time.
    levels = np.clip(255 * colors, 0, 255).astype(np.uint8)
    cv2.grabCut(levels, kinds, (0, 0, 1, 1), np.zeros((1, 65)), np.zeros((1, 65)), ROUNDS, cv2.GC_INIT_WITH_MASK)
    return (kinds == cv2.GC_FGD) | (kinds == cv2.GC_PR_FGD)


def _resized(x: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """An array (H, W, ...) as float32 with another height and width: means of pixels, or linear between them."""
    import cv2

    way = cv2.INTER_AREA if x.shape[0] > size[0] else cv2.INTER_LINEAR
    return cv2.resize(np.asarray(x, np.float32), size[::-1], interpolation=way)
