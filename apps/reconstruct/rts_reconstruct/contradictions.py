"""Masks that contradict those of the other views."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

import rts
from rts_reconstruct.masks import where
from rts_reconstruct.pictures import Pictures
from rts_reconstruct.points import visible
from rts_reconstruct.starts import REACH, hull, lattice_points

COUNT = 48
"""Points of the lattice along each axis."""
SPARED = 0.1
"""The share of the views that see a point, and one at least, that may show it outside of their mask."""
APART = 0.2
"""How far a view's overlap is below the median of all if its mask is named."""
CONSISTENT = 0.7
"""The least overlap of masks of one object with their common hull."""
INEXACT = 0.85
"""The consistency of masks below which they are inexact: most of their outlines are not the object's."""
FEWEST, ENOUGH = 4, 12
"""Of fewer views nothing is said, or none is named: each one carves too much that no other does."""
MOST = 5
"""The most names in a line."""


class Contradiction(NamedTuple):
    """What masks say of one another.

    Attributes:
        lines: a line for the user, with names; none where they do not contradict one another.
        liars: numbers of views to fit whose masks do not overlap with what all others show, and these agree.
    """

    lines: tuple[str, ...] = ()
    liars: tuple[int, ...] = ()


def contradictions(pictures: Pictures) -> Contradiction:
    """Whether masks contradict those of the other views; nothing is said if outlines are of points.

    Masks of one object are the pictures of the space that they have in common. Where they are not, views are named that
    fit worse than others to what all but a few have in common.
    """
    views = pictures.views
    if not pictures.outlined or pictures.by_points or len(views) < FEWEST or _overlaps(views, 0).min() > CONSISTENT:
        return Contradiction()
    found = _overlaps(views, SPARED)
    worst = np.flatnonzero(found < np.median(found) - APART)
    others = [view for i, view in enumerate(views) if i not in set(worst)]
    names = ", ".join(
        f"{where(views[i]) or i} ({found[i]:.2f})" for i in np.argsort(found)[: max(1, min(len(worst), MOST))]
    )
    names += f" and {len(worst) - MOST} more" if len(worst) > MOST else ""
    if len(views) >= ENOUGH and len(worst) and np.median(_overlaps(others, 0)) > CONSISTENT:
        line = (
            f"masks that do not overlap with what the other views show: {names}; these pictures are left out: look "
            "whether masks are inverted (the object is white), turned, or of something else, or cameras wrong"
        )
        return Contradiction((line,), tuple(map(int, worst)))
    of_all = f", most of all {names}" if len(views) >= ENOUGH else ""
    return Contradiction(
        (
            f"the masks contradict each other{of_all}: what they have in common is not what they show; mend them, "
            "leave them out if COLMAP has points (--masks ignore), or look whether the cameras are right",
        )
    )


def consistency(pictures: Pictures) -> float:
    """The median overlap of masks with pictures of their visual hull; 1 where masks are made, 0 where it is empty.

    Right masks differ from it by a cell of its lattice and by what few views do not carve away.
    """
    if not pictures.outlined or pictures.by_points or len(pictures.views) < FEWEST:
        return 1.0
    try:
        mesh = hull(pictures)
    except rts.InputError:
        return 0.0
    theta = {"vertices": np.asarray(mesh.vertices, np.float32), "colors": np.ones((len(mesh.vertices), 3), np.float32)}
    part = rts.Part(rts.Mesh(np.asarray(mesh.faces, np.int32)), theta, "unlit")
    found = []
    for view in pictures.views:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rts.errors.EmptyImageWarning)  # A hull of few cells may be seen nowhere.
            shown = np.asarray(rts.render(part, view.camera, view.size, splatter="none"))[..., 3] > 0.5
        mask, counts = view.image[..., 3] > 0.5, np.ones(view.size) if view.mask is None else view.mask
        found.append((counts * (shown & mask)).sum() / max((counts * (shown | mask)).sum(), 1))
    return float(np.median(found))


def _overlaps(views: Sequence[rts.View], spared: float) -> np.ndarray:
    """For each view (B,), intersection over union of its mask and its picture of a hull of all masks.

    The hull is the space that all views show inside of their masks, or all but a share that is spared, at least one.
    """
    points = lattice_points(COUNT)
    seen, outside = np.zeros(len(points)), np.zeros(len(points))
    places = []
    for view in views:
        inside = np.flatnonzero(visible(view, points))
        x, y = np.moveaxis(np.asarray(view.camera.project(points[inside], view.size)), -1, 0)[:2].astype(int)
        x, y = np.minimum(x, view.size[1] - 1), np.minimum(y, view.size[0] - 1)
        places.append((inside, y, x))
        seen[inside] += 1
        outside[inside] += view.image[y, x, 3] < 0.5
    most = np.maximum(1, spared * seen) if spared else 0
    hull = (seen >= 2) & (outside <= most)
    return np.array([_overlap(view, hull, *place) for view, place in zip(views, places, strict=True)])


def _overlap(view: rts.View, hull: np.ndarray, inside: np.ndarray, y: np.ndarray, x: np.ndarray) -> float:
    """The overlap of a view's mask and the points (M,) of a hull that it sees at pixels y, x; by tiles of a cell."""
    depth = max(float(np.asarray(view.camera.depth(np.zeros((1, 3))))[0]), 0.1)
    cell = 2 * REACH / (COUNT - 1) * view.camera.projection[1, 1] * view.size[0] / (2 * depth)
    tile = max(1, int(np.ceil(1.5 * cell)))
    height, width = (-(-extent // tile) for extent in view.size)
    shown = np.zeros((height, width), bool)
    kept = hull[inside]
    shown[y[kept] // tile, x[kept] // tile] = True
    padded = np.pad(view.image[..., 3], [(0, height * tile - view.size[0]), (0, width * tile - view.size[1])])
    mask = padded.reshape(height, tile, width, tile).mean(axis=(1, 3)) > 0.5
    return float((shown & mask).sum() / max((shown | mask).sum(), 1))
