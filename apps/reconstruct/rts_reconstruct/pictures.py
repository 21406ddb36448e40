"""Pictures for a reconstruction: views read, made smaller, told apart from their background, and held out."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

import rts
from rts_reconstruct import masks as masks_of
from rts_reconstruct import outlining
from rts_reconstruct import points as seen_points
from rts_reconstruct.points import Points
from rts_reconstruct.refining import refined
from rts_reconstruct.solid import solid_of
from rts_reconstruct.world import World, around

SMALLEST = 8
"""Pixels of the shorter sides of pictures, at least."""


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
        points: COLMAP's points in the data set's world, or None.
        region: the ball that the points tell, as a world whose unit is its radius, or None.
        solid: what the points fill there, as a mesh, where a start or outlines need it; the world of the pictures is
            that of `region` then.
        by_points: True if the outlines are those of `solid`.
        by_masks: True if they are those of masks, in pictures that show what is around the object, too.
        exposures: (B,) of `exposures.exposures`, that were taken out of the pictures; None for none.
    """

    views: list[rts.View]
    held_out: list[rts.View]
    numbers: list[int]
    given: list[rts.View]
    outlined: bool
    background: np.ndarray
    world: World
    points: Points | None = None
    region: World | None = None
    solid: trimesh.Trimesh | None = None
    by_points: bool = False
    by_masks: bool = False
    exposures: np.ndarray | None = None


def read(
    path: Any,
    size: int,
    held_out: int,
    background: Any = None,
    masks: str | Path = "object",
    region: Any = None,
    start: Any = None,
    refine: bool = False,
) -> Pictures:
    """The pictures of a data set.

    Where neither alpha nor masks tell the object, COLMAP's points do if there are any.

    Args:
        path: file or folder, as `rts.load_views` takes it; or a list of views, with encoded images.
        size: pixels; longer sides are made at most so long, by means of n × n pixels.
        held_out: every so many views, one is held out; 0 for none.
        background: (3,) colour from 0 to 1, of pictures without alpha and masks; None for that of their borders.
        masks: "object" for masks that are white where the object is; "ignore" for masks that are black where pixels do
            not count, as COLMAP has them; or a folder of masks as `outlining.write_masks` writes them.
        region: center and radius (4,) of a ball that the object is in, world of the data set; None for that of the
            points.
        start: the kind of start, of which "points" needs the solid.
        refine: True to refine masks, white where the object is, by the pictures' colours first. It needs OpenCV.

    Raises:
        InputError: no views, one view, pictures that do not tell the object, or half of them without it, or an argument
            of the wrong kind.
    """
    views = list(path) if isinstance(path, (list, tuple)) else _loaded(path)
    folder = None if masks in ("object", "ignore") else Path(masks)
    if folder is not None:
        views = outlining.mended(views, folder)
    kept = [i for i in range(len(views)) if not held_out or i % held_out != held_out - 1]
    if len(kept) < 2:
        one = f"{len(kept)} of them is" if len(kept) == 1 else f"{len(kept)} of them are"
        raise rts.InputError(
            f"{len(views)} view{'s'[: len(views) != 1]} in {_named(path)}, and {one} left to fit; expected at least "
            "two, and thirty around a thing for all of its surface"
        )
    if refine:
        views = [refined(view) for view in views]
    given, named = views, _named(path)
    points = seen_points.read(path)
    ball = None if points is None else _region(points, given, region)
    views = [_smaller(view, size) for view in views]
    alphas = masks_of.told(views, named, ignored=masks == "ignore")
    by_masks = alphas is not None and alphas is not views
    if points is None and alphas is None and background is None:
        seen_points.check_readable(path)
    if points is None and region is not None:
        warnings.warn(f"region is not used: {named} has no points of COLMAP", rts.errors.RtsWarning, 3)
    by_points = ball is not None and alphas is None and background is None
    solid = None
    if points is not None and ball is not None and (by_points or folder is not None or start == "points"):
        solid = solid_of(points.inside(ball))
        if solid is None and region is not None:
            raise rts.InputError(
                f"region is {list(region)}, where COLMAP's points fill nothing; expected x, y, z and radius of a ball "
                "about the object: leave it out for that of the densest points"
            )
    world = around([view.camera.for_size(view.size) for view in given]) if solid is None or ball is None else ball
    behind = np.ones(3, np.float32) if background is None else masks_of.checked_background(background)
    if alphas is not None:
        views = alphas
    elif solid is not None and by_points:
        views = [outlining.cut_out(view, solid, world) for view in views]
    else:
        views, behind = masks_of.plain(views, named, None if background is None else behind)
        by_points = False
    for view in views:
        view.camera = world.camera(view.camera)
    others = [i for i in range(len(views)) if i not in set(kept)]
    numbers = kept + others
    fitted, held = [views[i] for i in kept], [views[i] for i in others]
    outlined = alphas is not None or by_points
    whole = [given[i] for i in numbers]
    return Pictures(fitted, held, numbers, whole, outlined, behind, world, points, ball, solid, by_points, by_masks)


def without(pictures: Pictures, places: Sequence[int]) -> Pictures:
    """The pictures without some of the views to fit, by their places."""
    if not places:
        return pictures
    gone = set(places)
    views = [view for i, view in enumerate(pictures.views) if i not in gone]
    numbers, given = ([x for i, x in enumerate(some) if i not in gone] for some in (pictures.numbers, pictures.given))
    return replace(pictures, views=views, numbers=numbers, given=given)


def _region(points: Points, views: Sequence[rts.View], region: Any) -> World | None:
    """The ball that the object is in, as it was given or as the points tell."""
    if region is None:
        return seen_points.region(points, views)
    return World(np.asarray(region[:3], np.float64), float(region[3]))


def _named(path: Any) -> str:
    return "the list of views" if isinstance(path, (list, tuple)) else str(path)


def _loaded(path: Any) -> list[rts.View]:
    """All views of a data set; of one that tells apart training and test, those for training."""
    apart = False
    if isinstance(path, (str, Path)):
        apart = (Path(path) / "transforms_train.json").is_file() and not (Path(path) / "transforms.json").is_file()
    # COLMAP's "train" would leave an eighth out.
    return rts.load_views(path, split="train" if apart else "all", linear=False)


def _smaller(view: rts.View, size: int) -> rts.View:
    """A view whose longer side has at most `size` pixels, read once. Rows and columns that are left over are cut."""
    if min(view.size) < SMALLEST:
        raise rts.InputError(
            f"{view.name or 'a view'} has {view.size[1]} × {view.size[0]} pixels; expected {SMALLEST} a side or more"
        )
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
        camera,
        functools.cache(lambda: means(view.image)),
        (height, width),
        name=view.name,
        mask=None if view.mask is None else functools.cache(lambda: means(np.asarray(view.mask))),
        path=view.path,
        lens=None if view.lens is None else view.lens.scaled(1 / n, 1 / n),
    )


def on(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Colours (H, W, 3) of an image, on a background if it is premultiplied (H, W, 4)."""
    return image if image.shape[2] == 3 else image[..., :3] + (1 - image[..., 3:]) * background
