"""Regions in which rays are followed: balls and boxes."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rts import engine_of
from rts.plugin_api.arrays import Array


class Region(NamedTuple):
    """The region in which rays are followed: a `ball` or a `box`.

    Attributes:
        span: origins and directions (R, 3) → distances (R,) at which rays enter, 0 if they begin within, and (R,) at
            which they leave, in units of their directions; both are 0 for rays that miss the region.
        across: the length of the longest ray within the region.
    """

    span: Callable[[Array, Array], tuple[Array, Array]]
    across: float


def ball(center: np.ndarray, radius: float) -> Region:
    """A ball; `center` is (3,)."""

    def span(origins: Array, directions: Array) -> tuple[Array, Array]:
        engine = engine_of(origins)
        xp, off = engine.namespace, origins - engine.constant(center, origins)
        square = xp.sum(directions * directions, axis=-1)
        nearest = -xp.sum(off * directions, axis=-1) / square
        off = off + nearest[:, None] * directions
        left = radius * radius - xp.sum(off * off, axis=-1)
        half = xp.sqrt(xp.where(left > 0, left, 0.0) / square)
        return _ahead(nearest - half, nearest + half)

    return Region(span, 2 * radius)


def box(low: np.ndarray, high: np.ndarray) -> Region:
    """A box along the axes, from its lower corner (3,) to the opposite one."""

    def span(origins: Array, directions: Array) -> tuple[Array, Array]:
        engine = engine_of(origins)
        xp, along = engine.namespace, directions == 0
        ends = [
            (engine.constant(corner, origins) - origins) / xp.where(along, 1.0, directions) for corner in (low, high)
        ]
        # Rays along a plane are between it and the opposite one for ever, or never.
        inside = (ends[0] <= 0) & (ends[1] >= 0)
        far = xp.full_like(directions, xp.inf)
        never = xp.where(inside, -far, far)
        first = xp.where(along, never, xp.minimum(*ends))
        last = xp.where(along, -never, xp.maximum(*ends))
        return _ahead(xp.max(first, axis=-1), xp.min(last, axis=-1))

    return Region(span, float(np.linalg.norm(high - low)))


def _ahead(enter: Array, leave: Array) -> tuple[Array, Array]:
    """The part of a span ahead of the origin of a ray; 0 and 0 if it is empty."""
    xp = engine_of(enter).namespace
    enter = xp.clip(enter, 0, None)
    met = leave > enter
    return xp.where(met, enter, 0.0), xp.where(met, leave, 0.0)
