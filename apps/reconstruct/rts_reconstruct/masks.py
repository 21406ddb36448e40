"""Alpha and masks of pictures: which of them tell the object, and which lie."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import rts

Part = Callable[[rts.View], np.ndarray]
"""A view's image or mask, made from another view."""
LOOKED_AT = 12
"""The most views whose pixels say what kind of pictures these are."""
OUTSIDE = 0.01
"""The least share of transparent pixels, or of pixels that masks leave out, that tells the object."""
INVERTED, HOLE = 0.95, 0.02
"""Masks that are white on this share of their border, and black on this share of the picture, look inverted."""
PLAIN = 0.04
"""The largest median difference of borders' colours from their median, for a background that is plain."""


def told(views: list[rts.View], named: str, ignored: bool) -> list[rts.View] | None:
    """The views with alpha that tells the object, by their own or by masks; None if neither does.

    Args:
        views: views with images (H, W, 3 or 4).
        named: the data set, for messages.
        ignored: True if masks are black where pixels do not count, and tell no object.

    Raises:
        InputError: half of the pictures show no object, or have masks that are black where the object is.
    """
    looked_at = _some(views)
    masks = [mask_of(view) for view in looked_at]
    images = [view.image for view in looked_at]
    found = None
    if all(image.shape[2] == 4 for image in images):
        clear = np.mean([((i[..., 3] < 0.5) & (m > 0.5)).mean() for i, m in zip(images, masks, strict=True)])
        found = views if clear > OUTSIDE else None
    lit = [shown(view) for view in looked_at]
    outside = np.mean([((mask < 0.5) & (s > 0.5)).mean() for mask, s in zip(masks, lit, strict=True)])
    if found is None and not ignored and outside > OUTSIDE:
        found = [_with(view, _cut_out, None if view.lens is None else shown) for view in views]
    if found is not None:
        _check_shown(found, named)
        _check_polarity(found, named)
    return found


def plain(views: list[rts.View], named: str, background: np.ndarray | None) -> tuple[list[rts.View], np.ndarray]:
    """Views without alpha, whose colours alone tell the object, and the background's colour (3,).

    Raises:
        InputError: no colour is given, and borders have no plain one.
    """
    looked_at = _some(views)
    white = all(view.mask is not None and view.lens is None and view.mask.min() > 0.5 for view in looked_at)
    behind = _border([view.image for view in looked_at], named, white) if background is None else background
    if white:
        said = f"the masks of {named} are white all over, so that they tell no object; colours alone are compared"
        warnings.warn(said, rts.errors.RtsWarning, 3)
    return [_with(view, _opaque, None if view.mask is None else mask_of) for view in views], behind


def _some(views: list[rts.View]) -> list[rts.View]:
    return [views[i] for i in np.unique(np.linspace(0, len(views) - 1, LOOKED_AT).astype(int))]


def _with(view: rts.View, image: Part, mask: Part | None) -> rts.View:
    """A view with another image and mask, which are made from it once."""
    made = functools.cache(lambda: image(view))
    counted = None if mask is None else functools.cache(lambda: mask(view))
    return rts.View(view.camera, made, view.size, name=view.name, mask=counted, path=view.path)


def _opaque(view: rts.View) -> np.ndarray:
    return view.image[..., :3]


def mask_of(view: rts.View) -> np.ndarray:
    """The view's mask (H, W), ones if it has none."""
    return np.ones(view.size, np.float32) if view.mask is None else view.mask


def shown(view: rts.View) -> np.ndarray:
    """1 at pixels (H, W) that the view's lens leaves a picture, but for its border; 0 elsewhere.

    Masks of data sets are 0 elsewhere, whether they tell the object or not.
    """
    height, width = view.size
    if view.lens is None:
        return np.ones((height, width), np.float32)
    x, y = view.lens.distorted(*np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5))
    return ((x > 1) & (x < width - 1) & (y > 1) & (y < height - 1)).astype(np.float32)


def _cut_out(view: rts.View) -> np.ndarray:
    """The picture (H, W, 4) where the view's mask is."""
    mask = mask_of(view)
    return np.concatenate([view.image[..., :3] * mask[..., None], mask[..., None]], axis=2)


def _check_shown(views: Sequence[rts.View], named: str) -> None:
    """Refuse pictures half of which show no object, by their alpha or masks; warn of fewer, and of those all white."""
    blank = [i for i, view in enumerate(views) if not (view.image[..., 3] >= 0.5).any()]
    if blank:
        told = f"alpha or masks are black all over in {_counted(views, blank)} of {named}"
        if 2 * len(blank) >= len(views):
            lightest = max(float(views[i].image[..., 3].max()) for i in blank)
            few = f" (the lightest pixel is {lightest:.3f} of white)" if lightest > 0 else ""
            raise rts.InputError(f"{told}{few}; expected masks, or alpha, that are white where the object is")
        _warn(f"{told}; what these see is taken for empty: leave them out if it is not")
    full = [i for i, view in enumerate(views) if not ((view.image[..., 3] < 0.5) & (mask_of(view) > 0.5)).any()]
    if full:
        _warn(
            f"alpha or masks are missing, or white all over, in {_counted(views, full)} of {named}; all that these see "
            "is taken for the object: add masks, or leave them out, if it is not"
        )


def _check_polarity(views: Sequence[rts.View], named: str) -> None:
    """Refuse pictures most of which have an alpha of 1 along the border, and of 0 within; warn of fewer."""
    inverted = [i for i, view in enumerate(views) if _is_inverted(view.image[..., 3])]
    if not inverted:
        return
    told = f"alpha or masks are white along the border and black within in {_counted(views, inverted)} of {named}"
    if 2 * len(inverted) > len(views):
        raise rts.InputError(
            f"{told}; expected white where the object is, so invert them (or --masks ignore, if black means that "
            "pixels do not count)"
        )
    _warn(f"{told}; expected white where the object is: look whether these are inverted")


def _counted(views: Sequence[rts.View], places: Sequence[int]) -> str:
    """How many views these are, and the names of some."""
    names = ", ".join(str(where(views[i]) or i) for i in places[:3]) + (", …" if len(places) > 3 else "")
    return f"{len(places)} of {len(views)} views ({names})"


def _warn(text: str) -> None:
    warnings.warn(text, rts.errors.RtsWarning, 5)


def _is_inverted(alpha: np.ndarray) -> bool:
    rim = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    return float((rim > 0.5).mean()) > INVERTED and float((alpha < 0.5).mean()) > HOLE


def _border(images: Sequence[np.ndarray], named: str, white: bool) -> np.ndarray:
    """The colour (3,) of a plain background, by the outermost pixels. `white`: there are masks, white all over."""
    sides = [side[..., :3].reshape(-1, 3) for i in images for side in (i[0], i[-1], i[:, 0], i[:, -1])]
    pixels = np.concatenate(sides)
    behind = np.median(pixels, axis=0)
    if all(np.abs(image[..., :3] - behind).max() <= PLAIN for image in images):
        colour = ", ".join(f"{x:.2f}" for x in behind)
        raise rts.InputError(f"the pictures of {named} have no other colour than {colour}; expected ones of an object")
    scatter = float(np.median(np.abs(pixels - behind).max(axis=1)))
    if scatter > PLAIN:
        fault = f"the pictures of {named} have neither alpha nor masks"
        if white:
            fault = f"the masks of {named} are white all over, so that they tell no object"
        raise rts.InputError(
            f"{fault}, and the pictures' borders have no plain colour (they differ by {scatter:.2f}, at most {PLAIN} "
            "is plain); expected masks that are black outside of the object (--masks FOLDER), points of COLMAP (rts "
            "cameras), or the background's colour (--background)"
        )
    return behind.astype(np.float32)


def checked_background(colour: Any) -> np.ndarray:
    """A background's colour (3,) float32; anything else is refused."""
    found = np.asarray(colour)
    if found.shape != (3,) or found.dtype.kind not in "fiu" or not ((found >= 0) & (found <= 1)).all():
        raise rts.InputError(f"background is {colour!r:.60}; expected three numbers from 0 to 1")
    return found.astype(np.float32)


def where(view: rts.View) -> Path | str:
    """The name of a view, for messages and tables."""
    return view.name or (view.path.name if view.path else "")
