"""Places on gaps between centres, and the normals of outlines there, in array code."""

from __future__ import annotations

from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array


def on_gaps(gap: Array, places: Array) -> Array:
    """Points (B, ..., 2) at places (B, ...) along gaps (B, 3)."""
    xp = namespace(places)
    first, along = xp.astype(xp.stack([gap[:, 1], gap[:, 0]], axis=-1), places.dtype) + 0.5, steps(gap, places)
    if places.ndim == 2:
        first, along = first[:, None, :], along[:, None, :]
    return first + places[..., None] * along


def steps(gap: Array, like: Array) -> Array:
    """Unit steps (B, 2) along gaps (B, 3)."""
    xp = namespace(gap)
    return xp.astype(xp.stack([gap[:, 2], 1 - gap[:, 2]], axis=-1), like.dtype)


def normals(gap: Array, place: Array, ties: Array) -> Array:
    """Unit normals (B, 2) of outlines at breaks: the mean of their segments'; along the gap for a lone break."""
    xp, engine, count = namespace(place), engine_of(place), place.shape[0]
    points, step = on_gaps(gap, place), steps(gap, place)
    ends = [xp.take(points, xp.where(ties[:, i] >= 0, ties[:, i], 0), axis=0) for i in (0, 1)]
    way, total = ends[1] - ends[0], step * 1e-6
    normal = xp.stack([way[:, 1], -way[:, 0]], axis=-1)
    counts = (ties[:, 1] >= 0) & (ties[:, 0] != ties[:, 1])
    for i in (0, 1):
        at = xp.where(counts, ties[:, i], 0)
        # Two segments at a line of crossing may run in opposite directions.
        forward = xp.sum(normal * xp.take(step, at, axis=0), axis=-1) >= 0
        turned = xp.where(counts[:, None], xp.where(forward[:, None], normal, -normal), 0.0)
        total = total + engine.segment_sum(turned, at, count)
    return total / xp.sqrt(xp.sum(total * total, axis=-1, keepdims=True))
