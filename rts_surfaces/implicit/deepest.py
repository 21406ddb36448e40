"""Where a field is least along rays, beside its surface: what tells how outlines move."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from rts import engine_of
from rts.plugin_api.arrays import Array
from rts.plugin_api.operations import gradient
from rts_surfaces.implicit.casting import without_derivative

MARCH, FIRST, GROWTH = 10, 1 / 12, 2.0
"""Steps along a ray that seek its deepest point; the first, as a share of the reach; and their growth."""
HALVINGS = 14
"""Halvings of the bracket of a deepest point."""
REACH = 3.0
"""The reach in pixels at triangles' samples: farther outlines are of no interest; see `rts.RaySurface.deepest`."""
APART = 1 / 1500
"""Distance of the two samples from their deepest point, as a share of the reach: beyond rounding, lest both lie on one
side of a kink."""


def deepest(
    level: Callable[[Array], Array],
    free: Callable[[Array], Array],
    points: Array,
    directions: Array,
    reach: Array,
) -> tuple[Array, Array]:
    """Pairs of samples beside the deepest points of rays; see `rts.RaySurface.deepest`.

    Let s₋ ≤ 0 and s₊ ≥ 0 be the slopes of the level f along the ray just before and just behind the deepest point, and
    λ = s₊ / (s₊ − s₋). Then G = λ ∇f₋ + (1 − λ) ∇f₊ is perpendicular to the ray, and the outline moves by
    −(λ ∂f₋/∂θ + (1 − λ) ∂f₊/∂θ) G / |G|² (envelope theorem). The mean of a pair's motions is to be this: they
    are 2 λ G / |G|² and 2 (1 − λ) G / |G|² for each unit by which the level falls.
    Near an outline its distance from the ray is −f / |G|.

    Args:
        level: points (M, 3) → (M,), negative inside.
        free: points (M, 3) → marks (M,) bool of points whose level follows θ; others have no motion.
        points: (R, 3), points of the surface at which rays enter.
        directions: (R, 3).
        reach: (R,), the farthest distance of outlines.

    Returns:
        Parameters (R, 2, 7): points, motions for each unit of level, and levels; and marks (R,) bool of rays with a
        pair.
    """
    engine = engine_of(points)
    xp = engine.namespace
    along = directions / xp.sqrt(xp.sum(directions * directions, axis=-1, keepdims=True))
    value_at = partial(without_derivative, level)

    def at(t: Array) -> Array:
        return points + t[:, None] * along

    def slope_at(t: Array) -> Array:
        return engine.stop_gradient(gradient(level, at(t)))

    def march(state: dict[str, Array]) -> dict[str, Array]:
        t, low, high = state["t"], state["low"], state["high"]
        further = t + state["step"]
        value = value_at(at(further))
        passed = (value > state["value"]) & (high == 0)
        return {
            "low": xp.where(passed, state["before"], low),
            "high": xp.where(passed, further, high),
            "before": t,
            "t": further,
            "step": GROWTH * state["step"],
            "value": value,
        }

    def halve(state: dict[str, Array]) -> dict[str, Array]:
        middle = (state["low"] + state["high"]) / 2
        falls = xp.sum(slope_at(middle) * along, axis=-1) < 0
        return {"low": xp.where(falls, middle, state["low"]), "high": xp.where(falls, state["high"], middle)}

    zero, first = xp.zeros_like(reach), FIRST * reach
    # The root of a bracket with a kink may lie behind the deepest point, where the field rises: then before it, too.
    begin = xp.where(xp.sum(slope_at(zero) * along, axis=-1) > 0, -first, zero)
    state = {"low": zero, "high": zero, "before": begin, "t": zero, "step": first, "value": value_at(points)}
    state = engine.repeat(march, lambda state: xp.any(state["high"] == 0), state, MARCH)
    passed = state["high"] > 0
    state = {"low": state["low"], "high": state["high"]}
    state = engine.repeat(halve, lambda state: xp.any(state["high"] > state["low"]), state, HALVINGS)
    margin = APART * reach + 4 * xp.finfo(points.dtype).eps * xp.max(xp.abs(points), axis=-1)
    sides = xp.maximum(state["low"] - margin, begin), state["high"] + margin
    slopes, levels = [slope_at(t) for t in sides], [value_at(at(t)) for t in sides]
    # Squares of small slopes are no numbers of single precision.
    largest = xp.max(xp.abs(xp.concat(slopes, axis=-1)), axis=-1)
    largest = xp.where((largest > 0) & xp.isfinite(largest), largest, 1.0)
    slopes = [s / largest[:, None] for s in slopes]
    falls, rises = (xp.sum(s * along, axis=-1) for s in slopes)
    falls, rises = xp.clip(-falls, 0.0, None), xp.clip(rises, 0.0, None)
    bend = falls + rises
    share = xp.where(bend > 0, rises / xp.where(bend > 0, bend, 1.0), 0.5)
    across = share[:, None] * slopes[0] + (1 - share)[:, None] * slopes[1]
    across = across - xp.sum(across * along, axis=-1, keepdims=True) * along
    square = xp.sum(across * across, axis=-1)
    far = -(levels[0] + levels[1]) / 2 / largest
    near = passed & (square > 0) & (far * far < reach * reach * square)
    move = across / (xp.where(near, square, 1.0) * largest)[:, None]
    pair = []
    for t, part, value in zip(sides, (2 * share, 2 - 2 * share), levels, strict=True):
        place = at(t)
        part = xp.where(near & free(place), part, 0.0)
        pair.append(xp.concat([place, part[:, None] * move, value[:, None]], axis=-1))
    params = xp.stack(pair, axis=1)
    near = near & xp.all(xp.isfinite(params), axis=(1, 2))
    return engine.stop_gradient(xp.where(near[:, None, None], params, 0.0)), near
