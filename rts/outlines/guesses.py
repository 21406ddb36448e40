"""Where fields tell that their outlines lie: guesses, which samples then prove."""

from __future__ import annotations

import numpy as np

from rts.arrays.engines import constants, engine_of, exemplar
from rts.arrays.trees import map_leaves
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.records import Deepest
from rts.contracts.sampler import Sampler
from rts.contracts.surface import RaySurface
from rts.plugin_base import overrides
from rts.sampling.entries import host_value
from rts.sampling.triangle_sampler import TriangleSampler
from rts.scene.camera import Camera

REACH = 3.0
"""The farthest outlines, in pixels."""
TIMES = 2
"""Steps of Newton's method: of a smooth outline, each squares its distance, in pixels, over its radius."""


def tells_outlines(part: CheckedPart, sampler: Sampler) -> bool:
    """True if a part's surface may tell where its outlines lie."""
    return not isinstance(sampler, TriangleSampler) and overrides(part.surface, "deepest", RaySurface)


def outlines_beyond(
    part: CheckedPart, camera: Camera, size: tuple[int, int], points: np.ndarray, depth: np.ndarray, steps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How far outlines lie from points (M, 2) of the image along unit steps (M, 2), and their depths; NaN if unknown.

    Args:
        part: the part that is seen at the points.
        camera: in its local space.
        size: (height, width) of the image.
        points: (M, 2) in pixels.
        depth: (M,) of the part there.
        steps: (M, 2) in pixels.
    """
    engine, like, count = engine_of(part.theta, camera), exemplar(part.theta, camera), len(points)
    theta, camera = map_leaves(engine.stop_gradient, constants((part.theta, camera), engine, like))
    # Engines that compile eager operations for each shape get few: further rows repeat the first.
    rows = np.concatenate([np.arange(count), np.zeros(engine.room(count, like) - count, int)])
    points, steps = points[rows], steps[rows]
    away, back = np.zeros(len(rows)), np.zeros(len(rows))
    deep = start = depth[rows]
    for _ in range(TIMES):
        at = points + away[:, None] * steps
        rays = camera.rays(size, np.where(np.isfinite(at), at, points))
        z = engine.constant(np.where(np.isfinite(start), start, depth[rows]), like)
        reach = REACH * (rays.spread[0] + rays.spread[1] * z)
        found = part.surface.deepest(theta, rays.origins + z[:, None] * rays.directions, rays.directions, reach)
        found = Deepest(*found) if found is not None else None
        if found is None or found.outline is None:
            return np.full(count, np.nan), np.full(count, np.nan)
        outline = host_value(camera.project(found.outline, size))
        # The outline is at right angles to the way to it.
        way = outline[:, :2] - at
        along = (way * steps).sum(-1)
        away = away + (way * way).sum(-1) / np.where(along == 0, np.nan, along)
        back, deep = np.abs(outline[:, 2] - start), outline[:, 2]
        # Well before the next deepest point.
        start = deep - back / 2
    return away[:count], deep[:count]
