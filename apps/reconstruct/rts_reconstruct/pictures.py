"""Pictures for a reconstruction: views read, made smaller, told apart from their background, and held out."""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import rts
from rts_reconstruct.world import World, around

Part = Callable[[rts.View], np.ndarray]
"""A view's image or mask, made from another view."""
LOOKED_AT = 12
"""The most views whose pixels say what kind of pictures these are."""
OUTSIDE = 0.01
"""The least share of transparent pixels, or of pixels that masks leave out, that tells the object."""
PLAIN = 0.04
"""The largest median difference of borders' colours from their median, for a background that is plain."""


@dataclass(frozen=True)
class Pictures:
    """Views to fit and views that are only measured, in a world where the object is about as large as 1.

    Attributes:
        views: views to fit, with images (H, W, 4) premultiplied, or (H, W, 3), sRGB-encoded as in the files.
        held_out: views that are only measured.
        numbers: for each of `views` and then of `held_out`, its number in the data set.
        given: these views as the data set has them, in the same order.
        outlined: True if the pictures' alpha tells where the object is.
        background: (3,) colour, encoded: of the pictures where they have no alpha, else the one to measure on.
        world: the place and size of this world in that of the data set.
    """

    views: list[rts.View]
    held_out: list[rts.View]
    numbers: list[int]
    given: list[rts.View]
    outlined: bool
    background: np.ndarray
    world: World


def read(path: Any, size: int, held_out: int, background: Any = None) -> Pictures:
    """The pictures of a data set.

    Args:
        path: file or folder, as `rts.load_views` takes it; or a list of views, with encoded images.
        size: pixels; longer sides are made at most so long, by means of n × n pixels.
        held_out: every so many views, one is held out; 0 for none.
        background: (3,) colour from 0 to 1, of pictures without alpha and masks; None for that of their borders.

    Raises:
        InputError: no views, one view, pictures that do not tell the object, or half of them without it, or an argument
            of the wrong kind.
    """
    views = list(path) if isinstance(path, (list, tuple)) else _loaded(path)
    kept = [i for i in range(len(views)) if not held_out or i % held_out != held_out - 1]
    if len(kept) < 2:
        one = f"{len(kept)} of them is" if len(kept) == 1 else f"{len(kept)} of them are"
        raise rts.InputError(
            f"{len(views)} view{'s'[: len(views) != 1]} in {_named(path)}, and {one} left to fit; expected at least two"
        )
    given, world = views, around([view.camera.for_size(view.size) for view in views])
    views, outlined, behind = _outlined([_smaller(view, size, world) for view in views], _named(path), background)
    if outlined:
        _check_shown(views, _named(path))
    others = [i for i in range(len(views)) if i not in set(kept)]
    numbers = kept + others
    fitted, held = [views[i] for i in kept], [views[i] for i in others]
    return Pictures(fitted, held, numbers, [given[i] for i in numbers], outlined, behind, world)


def _named(path: Any) -> str:
    return "the list of views" if isinstance(path, (list, tuple)) else str(path)


def _loaded(path: Any) -> list[rts.View]:
    """All views of a data set; of one that tells apart training and test, those for training."""
    with contextlib.suppress(rts.InputError):
        return rts.load_views(path, split="all", linear=False)  # COLMAP's: "train" would leave an eighth out.
    return rts.load_views(path, linear=False)


def _smaller(view: rts.View, size: int, world: World) -> rts.View:
    """A view whose longer side has at most `size` pixels, read once. Rows and columns that are left over are cut."""
    n = -(-max(view.size) // size)
    height, width = (extent // n for extent in view.size)
    if min(height, width) < 1:
        raise rts.InputError(
            f"size is {size}, and {view.name or 'a view'} has {view.size} pixels; choose a larger size"
        )
    camera = view.camera.window(view.size, (0, 0), (height * n, width * n))

    def means(picture: np.ndarray) -> np.ndarray:
        cut = np.asarray(picture)[: height * n, : width * n]
        blocks = cut.reshape(height, n, width, n, *cut.shape[2:])
        return blocks.mean(axis=(1, 3), dtype=np.float32)

    return rts.View(
        world.camera(camera),
        functools.cache(lambda: means(view.image)),
        (height, width),
        name=view.name,
        mask=None if view.mask is None else functools.cache(lambda: means(np.asarray(view.mask))),
        path=view.path,
        lens=None if view.lens is None else view.lens.scaled(1 / n, 1 / n),
    )


def _outlined(views: list[rts.View], named: str, background: Any) -> tuple[list[rts.View], bool, np.ndarray]:
    """The views with images that tell the object, True if their alpha does, and the background."""
    looked_at = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, LOOKED_AT).astype(int))]
    masks = [_mask(view) for view in looked_at]
    images = [view.image for view in looked_at]
    given = None if background is None else _checked(background)
    behind = np.ones(3, np.float32) if given is None else given
    if all(image.shape[2] == 4 for image in images):
        clear = np.mean([((i[..., 3] < 0.5) & (m > 0.5)).mean() for i, m in zip(images, masks, strict=True)])
        if clear > OUTSIDE:
            return views, True, behind
    shown = [_shown(view) for view in looked_at]
    if np.mean([((mask < 0.5) & (s > 0.5)).mean() for mask, s in zip(masks, shown, strict=True)]) > OUTSIDE:
        return [_with(view, _cut_out, None if view.lens is None else _shown) for view in views], True, behind
    white = all(view.mask is not None and view.lens is None for view in looked_at)
    if given is None:
        behind = _border(images, named, white)
    if white:
        told = f"the masks of {named} are white all over, so that they tell no object; colours alone are compared"
        warnings.warn(told, rts.errors.RtsWarning, 3)
    return [_with(view, _opaque, None if view.mask is None else _mask) for view in views], False, behind


def _with(view: rts.View, image: Part, mask: Part | None) -> rts.View:
    """A view with another image and mask, which are made from it once."""
    made = functools.cache(lambda: image(view))
    counted = None if mask is None else functools.cache(lambda: mask(view))
    return rts.View(view.camera, made, view.size, name=view.name, mask=counted, path=view.path)


def _opaque(view: rts.View) -> np.ndarray:
    return view.image[..., :3]


def _mask(view: rts.View) -> np.ndarray:
    """The view's mask, ones if it has none."""
    return np.ones(view.size, np.float32) if view.mask is None else view.mask


def _shown(view: rts.View) -> np.ndarray:
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
    mask = _mask(view)
    return np.concatenate([view.image[..., :3] * mask[..., None], mask[..., None]], axis=2)


def _check_shown(views: Sequence[rts.View], named: str) -> None:
    """Refuse pictures half of which show no object, by their alpha or masks; warn of fewer."""
    blank = [i for i, view in enumerate(views) if not (view.image[..., 3] >= 0.5).any()]
    if not blank:
        return
    names = ", ".join(str(where(views[i]) or i) for i in blank[:3]) + (", …" if len(blank) > 3 else "")
    told = f"alpha or masks are black all over in {len(blank)} of {len(views)} views of {named}: {names}"
    if 2 * len(blank) >= len(views):
        raise rts.InputError(f"{told}; expected masks, or alpha, that are white where the object is")
    warnings.warn(f"{told}; what these see is taken for empty: leave them out if it is not", rts.errors.RtsWarning, 3)


def _border(images: Sequence[np.ndarray], named: str, white: bool) -> np.ndarray:
    """The colour (3,) of a plain background, by the outermost pixels. `white`: there are masks, white all over."""
    sides = [side[..., :3].reshape(-1, 3) for i in images for side in (i[0], i[-1], i[:, 0], i[:, -1])]
    pixels = np.concatenate(sides)
    behind = np.median(pixels, axis=0)
    scatter = float(np.median(np.abs(pixels - behind).max(axis=1)))
    if scatter > PLAIN:
        fault = f"the pictures of {named} have neither alpha nor masks"
        if white:
            fault = f"the masks of {named} are white all over, so that they tell no object"
        raise rts.InputError(
            f"{fault}, and the pictures' borders have no plain colour (they differ by {scatter:.2f}, at most {PLAIN} "
            "is plain); expected masks that are black outside of the object, or give the background's colour"
        )
    return behind.astype(np.float32)


def _checked(colour: Any) -> np.ndarray:
    found = np.asarray(colour)
    if found.shape != (3,) or found.dtype.kind not in "fiu" or not ((found >= 0) & (found <= 1)).all():
        raise rts.InputError(f"background is {colour!r:.60}; expected three numbers from 0 to 1")
    return found.astype(np.float32)


def on(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Colours (H, W, 3) of an image, on a background if it is premultiplied (H, W, 4)."""
    return image if image.shape[2] == 3 else image[..., :3] + (1 - image[..., 3:]) * background


def where(view: rts.View) -> Path | str:
    """The name of a view, for messages and tables."""
    return view.name or (view.path.name if view.path else "")
