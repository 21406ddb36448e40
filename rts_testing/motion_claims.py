"""Claims about surfaces whose θ changes a little: points of kept samples and triangles move along."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from rts import Part, TriangleSurface
from rts.plugin_api.arrays import Tree, leaves, map_leaves
from rts.plugin_api.records import Samples
from rts.results import Sampled
from rts_testing import derivatives, scenes
from rts_testing.claims import claim
from rts_testing.derivatives import directions, names, split
from rts_testing.normal_claims import normals_at

STEP = 1e-5
MOVED = 0.02
"""The motion of the fastest point, in world units: about a tenth of a pixel."""

BEHIND = 0.35
"""The largest distance of points from the moved surface, as a share of the surface's motion."""

ENOUGH = 20
"""The least number of samples to judge from."""


class Move(NamedTuple):
    """A small change of one array of θ.

    Attributes:
        name: the array's, such as "theta['vertices']".
        part: the part with θ changed.
        points: (N, 3) float64, the changed part's points at samples of the unchanged one.
    """

    name: str
    part: Part
    points: np.ndarray


def moves(part: Part, samples: Samples) -> Iterator[Move]:
    """A `Move` for each array of θ that moves the surface: along a random direction, the fastest point by `MOVED`."""
    values, join = split(part.theta)
    values = [v.astype(np.float64) for v in values]
    for i, along in enumerate(directions(values)):

        def by(step: float, i: int = i, along: np.ndarray = along) -> Tree:
            return join([v + step * along if i == j else v for j, v in enumerate(values)])

        ends = [_points(part.replace(theta=by(step)), samples) for step in (-STEP, STEP)]
        speed = np.abs(ends[1] - ends[0]).max(initial=0) / (2 * STEP)
        if speed > 1e-6:
            moved = part.replace(theta=map_leaves(derivatives.single, by(MOVED / speed)))
            yield Move(names(part.theta)[i], moved, _points(moved, samples))


def claim_followed(part: Part, sampler: Any) -> None:
    """Fail if, as θ moves, points of kept samples end off the surface by more than `BEHIND` of its motion.

    Distances are along normals. Surfaces without normals, and motions that few samples show, are not judged.
    """
    part = part.replace(theta=map_leaves(derivatives.single, part.theta))
    before = scenes.find(part, sampler=sampler)
    start = _points(part, before.samples[0])
    for name, moved, points in moves(part, before.samples[0]):
        after = scenes.find(moved, sampler=sampler)
        normals = normals_at(moved, after.samples[0])
        if normals is None:
            return
        old, new = _fronts_of_both(before, after)
        reached = _points(moved, after.samples[0])[new]
        # Cells that show another sheet now are left out.
        same = np.linalg.norm(start[old] - reached, axis=1) < 10 * MOVED
        across = normals[new] * same[:, None]
        off, way = (np.abs(np.sum((x[old] - reached) * across, axis=1)) for x in (points, start))
        kept_way = np.abs(np.sum((points - start)[old] * across, axis=1))
        if same.sum() < ENOUGH or max(way.sum(), kept_way.sum()) < 0.05 * MOVED * same.sum():
            continue
        share = off.sum() / max(way.sum(), kept_way.sum())
        claim(
            share <= BEHIND,
            f"when {name} changes a little, the points that evaluate gives of kept samples end {share:.0%} of the way "
            f"off the new surface; does evaluate move them the wrong way, or not as far as the surface goes?",
        )


def claim_inputs_change(part: Part, surface: TriangleSurface, sampler: Any) -> None:
    """Fail unless `proxy_inputs` changes with each array of θ that moves the surface."""
    samples = scenes.find(part, sampler=sampler).samples[0]
    first = _inputs(surface, part.theta)
    for name, moved, _ in moves(part, samples):
        same = all(np.array_equal(a, b) for a, b in zip(first, _inputs(surface, moved.theta), strict=True))
        claim(
            not same,
            f"{name} moves the surface, but proxy_inputs stays the same, so old triangles are kept; return what "
            f"depends on it, too",
        )


def _inputs(surface: TriangleSurface, theta: Tree) -> list[np.ndarray]:
    return [np.asarray(x).copy() for x in leaves(surface.proxy_inputs(map_leaves(derivatives.single, theta)))]


def _points(part: Part, samples: Samples) -> np.ndarray:
    return np.asarray(part.surface.evaluate(part.theta, samples)["position"], np.float64)


def _fronts_of_both(before: Sampled, after: Sampled) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the front samples of cells that have one both before and after."""
    old, new = np.asarray(before.row)[0], np.asarray(after.row)[0]
    both = (old >= 0) & (new >= 0)
    return old[both], new[both]
