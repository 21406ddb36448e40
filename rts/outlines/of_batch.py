"""Outlines of the items of a batch, such as poses under `vmap`, found in one pass over a picture of all items."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.arrays.trees import Tree
from rts.contracts.records import Samples
from rts.outlines.found import Found
from rts.outlines.gaps import Fronts
from rts.outlines.points import Points, found_in_views
from rts.sampling.picture import Picture, at_once
from rts.sampling.scene import Grid, Scene
from rts.sampling.side_by_side import View, joined

OF_SEGMENTS = frozenset({"square", "ties", "square_sides", "beyond", "corner", "pull"})
"""The fields of `Found` that have a row for each segment."""


def found_in_batch(
    scenes: Sequence[Scene],
    grids: Sequence[Grid],
    centres: Sequence[Fronts],
    inputs: Sequence[Sequence[Tree]],
    most: int | None,
    uniform: bool,
) -> list[tuple[Found, list[Samples]] | None]:
    """Outlines and the samples beside breaks, as of `found_in_views`, of each item of a batch.

    Args:
        scenes: the scene of each item, with arrays of the host.
        grids: its cells, as many for all.
        centres: what is seen at their centres.
        inputs: of the proxies of the parts of each, on the host.
        most: the number of breaks that there is room for in each item, if it is limited.
        uniform: as of `Points.of`.

    Returns:
        None for items that cannot be drawn along with others, or have more breaks than there is room for.
    """
    views = [View.of(*one) for one in zip(scenes, grids, inputs, strict=True)]
    found: list[tuple[Found, list[Samples]] | None] = [None] * len(views)
    kinds: dict[tuple, list[int]] = {}
    for index, view in enumerate(views):
        if view is not None:
            kinds.setdefault(view.kind, []).append(index)
    count = at_once(grids[0].size)
    for alike in kinds.values():
        for first in range(0, len(alike), count):
            chunk = alike[first : first + count]
            together = [view for view in (views[index] for index in chunk) if view is not None]
            for index, one in zip(chunk, _found_in_picture(together, [centres[i] for i in chunk], uniform), strict=True):
                found[index] = one if most is None or len(one[0].place) <= most else None
    return found


def _found_in_picture(
    views: Sequence[View], centres: Sequence[Fronts], uniform: bool
) -> list[tuple[Found, list[Samples]]]:
    """Outlines of views that are drawn at once, and the samples of each view's parts."""
    picture = Picture.of(len(views), views[0].grid.size)
    scene, grid = joined(views, picture)
    firsts = np.cumsum([0, *(len(view.proxies) for view in views)])[:-1]
    starts, layers = scene.joints[0].starts, len(centres[0].part)
    part, triangle = np.full((2, layers, *picture.size), -1, np.int32)
    depth = np.zeros(part.shape)
    for one, first, place in zip(centres, firsts, picture.places(), strict=True):
        here = np.where(one.part >= 0, one.part + np.int32(first), np.int32(-1))
        part[:, *place], depth[:, *place] = here, one.depth
        triangle[:, *place] = np.where(one.triangle >= 0, one.triangle + starts[here], np.int32(-1))
    points = Points.of(scene, grid, [None] * len(scene.parts), uniform)
    (found,), samples = found_in_views([points], [Fronts(part, triangle, depth)])
    of_views = zip(_split(found, picture, firsts), views, firsts, strict=True)
    return [(one, samples[first : first + len(view.proxies)]) for one, view, first in of_views]


def _split(found: Found, picture: Picture, firsts: np.ndarray) -> list[Found]:
    """The outlines of each view of a picture, given the index (B,) of its first part; none lies in two views."""
    (height, width), corners = picture.view, picture.corners()[:, ::-1]
    of_break, of_segment = (x[:, 0] // height * picture.across + x[:, 1] // width for x in (found.gap, found.square))
    breaks, segments = (np.argsort(x, kind="stable") for x in (of_break, of_segment))
    per_view = [np.bincount(x, minlength=picture.views) for x in (of_break, of_segment)]
    counts, ends = map(np.cumsum, per_view)
    number = np.empty(len(breaks), np.int32)
    number[breaks] = np.arange(len(breaks)) - (counts - per_view[0])[of_break[breaks]]
    gap, square = np.array(found.gap), found.square - corners[of_segment]
    gap[:, :2] -= corners[of_break]
    moved = {
        "gap": gap,
        "square": square,
        "parts": np.where(found.parts >= 0, found.parts - firsts[of_break, None], -1),
        "ties": np.append(number, np.int32(-1))[found.ties],
        "beyond": np.append(number, np.int32(-1))[found.beyond],
    }
    whole, joined, split = found._replace(**moved)._asdict(), found.joined, {}
    for name in whole.keys() - {"joined", "left"}:
        order, bounds = (segments, ends) if name in OF_SEGMENTS else (breaks, counts)
        split[name] = np.split(whole[name][order], bounds[:-1])
    nothing = np.int32(0)
    return [
        Found(**{name: x[b] for name, x in split.items()}, joined=joined[:, *place], left=nothing)
        for b, place in enumerate(picture.places())
    ]
