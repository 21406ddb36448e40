"""Where rays meet a field's surface: steps that bracket changes of sign, then roots in the brackets."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rts.engines import engine_of
from rts.operations.gradient import gradient
from rts.records import RayHits
from rts.trees import Array, map_leaves

STEPS = 256
"""Steps across the ball where no Lipschitz constant is known."""

SHORTEST = 1 / 1024
"""The shortest step where one is known, as a share of the ball's diameter. Thinner parts may be missed."""

MOST = 512
"""Such steps that a ray takes at most; one that keeps along a surface for longer ends there."""

SECANT, NEWTON = 5, 2
"""How often the methods of Illinois and of Newton are applied in a bracket."""

CROWDED = 0.75
"""The share of rays that still go on at which the others are taken out."""


def cast(
    level: Callable[[Array], Array],
    describe: Callable[[Array], Array],
    origins: Array,
    directions: Array,
    layers: int,
    *,
    center: np.ndarray,
    radius: float,
    lipschitz: float | None = None,
    steps: int | None = None,
) -> RayHits:
    """The nearest points of each ray at which a function changes its sign, within a ball; without derivative.

    With a Lipschitz constant L steps are |level| / L long, but not shorter than a share of the ball, so that they lead
    over the surface. Without one all steps are of one length. Either way what is thinner than a step may be missed.

    Args:
        level: points (M, 3) → (M,), negative inside, zero counts as outside.
        describe: points (M, 3) of the surface → (M, P), the parameters of a hit.
        origins: (R, 3).
        directions: (R, 3), of any length but zero.
        layers: K.
        center: (3,), the ball's.
        radius: the ball's.
        lipschitz: L, which the slope of `level` nowhere exceeds; or None.
        steps: the number of the shortest steps across the ball; None for `STEPS`, or 1 / `SHORTEST` with L.

    Returns:
        Hits in the arrays' engine and dtype. Where there is none, distance and parameters are 0.
    """
    engine = engine_of(origins)
    xp = engine.namespace
    length = xp.sqrt(xp.sum(directions * directions, axis=-1))
    enter, leave = _within(origins - engine.constant(center, origins), directions, length, radius)
    if steps is None:
        steps = STEPS if lipschitz is None else round(1 / SHORTEST)
    rays = _Rays(
        origins + enter[:, None] * directions,
        directions,
        leave - enter,
        2 * radius / steps / length,
        xp.zeros_like(length) if lipschitz is None else 1 / (lipschitz * length),
    )
    most = steps + 1 if lipschitz is None else MOST
    free = partial(_without_derivative, level)
    if engine.padded(origins):
        return _cast_all(level, free, describe, rays, enter, layers, most)
    return _cast_some(level, free, describe, rays, enter, layers, most)


class _Rays(NamedTuple):
    """Rays from where they enter the ball.

    Attributes:
        starts: (R, 3).
        directions: (R, 3).
        last: (R,), where they leave the ball, in units of their directions; 0 for those that do not meet it.
        shortest: (R,), the shortest step.
        rate: (R,), the step for each unit of the level.
    """

    starts: Array
    directions: Array
    last: Array
    shortest: Array
    rate: Array

    def at(self, t: Array) -> Array:
        return self.starts + t[:, None] * self.directions

    def further(self, t: Array, level: Array) -> Array:
        """The end of the next step from `t`, where the function has the value `level`."""
        xp = engine_of(t).namespace
        return xp.minimum(t + xp.maximum(xp.abs(level) * self.rate, self.shortest), self.last)


class _Bracket(NamedTuple):
    """Arguments between which functions change their sign, and the values there; arrays of one shape."""

    low: Array
    high: Array
    below: Array
    above: Array


def _cast_some(
    level: Callable, free: Callable, describe: Callable, rays: _Rays, enter: Array, layers: int, most: int
) -> RayHits:
    """Hits of eager arrays: only rays that are not done go on, and roots are sought only where there are any."""
    xp, count = engine_of(enter).namespace, enter.shape[0]
    index = xp.arange(count, dtype=xp.int64, device=enter.device)
    going, found, t, value = rays, xp.zeros_like(index), xp.zeros_like(enter), free(rays.starts)
    cells, brackets = [index[:0]], [_Bracket(*[t[:0]] * 4)]
    for _ in range(most):
        on = (t < going.last) & (found < layers)
        left = int(xp.sum(xp.astype(on, xp.int64)))
        if not left:
            break
        if left < CROWDED * on.shape[0]:
            going, index, found, t, value, on = _rows((going, index, found, t, value, on), xp.nonzero(on)[0])
        further = going.further(t, value)
        after = free(going.at(further))
        crossed = on & _change_sign(value, after)
        cell, bracket = _rows((found * count + index, _Bracket(t, further, value, after)), xp.nonzero(crossed)[0])
        cells.append(cell)
        brackets.append(bracket)
        found = found + xp.astype(crossed, xp.int64)
        t, value = further, after
    cell, bracket = xp.concat(cells), _Bracket(*(xp.concat(x) for x in zip(*brackets, strict=True)))
    met = _rows(rays, cell % max(1, count))
    t = _roots(level, free, met, bracket)

    def spread(values: Array) -> Array:
        table = xp.zeros((layers * count, *values.shape[1:]), dtype=values.dtype, device=values.device)
        table[cell] = values
        return xp.reshape(table, (layers, count, *values.shape[1:]))

    distance = t + xp.take(enter, cell % max(1, count), axis=0)
    return RayHits(spread(xp.ones_like(cell, dtype=xp.bool)), spread(distance), spread(describe(met.at(t))))


def _cast_all(
    level: Callable, free: Callable, describe: Callable, rays: _Rays, enter: Array, layers: int, most: int
) -> RayHits:
    """Hits of arrays whose shapes stay: all rays go on until all are done, and roots are sought in all layers."""
    engine = engine_of(enter)
    xp = engine.namespace
    zero = xp.zeros_like(enter)
    none = xp.stack([zero] * layers)

    def on(state: dict[str, Array]) -> Array:
        return (state["t"] < rays.last) & (state["found"] < layers)

    def body(state: dict[str, Array]) -> dict[str, Array]:
        going, t, value, found = on(state), state["t"], state["value"], state["found"]
        further = xp.where(going, rays.further(t, value), t)
        after = free(rays.at(further))
        crossed = going & _change_sign(value, after)
        layer = xp.stack([crossed & (found == k) for k in range(layers)])
        new = _Bracket(t, further, value, after)
        brackets = {n: xp.where(layer, getattr(new, n)[None], state[n]) for n in _Bracket._fields}
        return {"t": further, "value": after, "found": found + xp.astype(crossed, found.dtype), **brackets}

    state = {"t": zero, "value": free(rays.starts), "found": xp.zeros_like(zero, dtype=xp.int32)}
    state |= dict.fromkeys(_Bracket._fields, none)
    state = engine.repeat(body, lambda state: xp.any(on(state)), state, most)

    hit = xp.stack([state["found"] > k for k in range(layers)])
    flat = [xp.reshape(state[n], (-1,)) for n in _Bracket._fields]
    met = map_leaves(lambda x: xp.concat([x] * layers), rays)
    t = _roots(level, free, met, _Bracket(*flat))
    params = describe(met.at(t))
    params = xp.reshape(params, (*hit.shape, params.shape[-1]))
    distance = xp.reshape(t, hit.shape) + enter
    return RayHits(hit, xp.where(hit, distance, 0.0), xp.where(hit[..., None], params, 0.0))


def _roots(level: Callable, free: Callable, rays: _Rays, bracket: _Bracket) -> Array:
    """Where a function has its zero along rays (M,), each within its own bracket, which it never leaves."""
    engine = engine_of(bracket.low)
    xp, (low, high, below, above) = engine.namespace, bracket
    t = low
    for _ in range(SECANT):
        rise = above - below
        t = low - below * (high - low) / xp.where(rise == 0, 1.0, rise)
        t = xp.minimum(xp.maximum(t, low), high)
        value = free(rays.at(t))
        first = (value < 0) == (below < 0)
        # The end that stays counts half, lest it stay for ever.
        low, high = xp.where(first, t, low), xp.where(first, high, t)
        below, above = xp.where(first, value, 0.5 * below), xp.where(first, 0.5 * above, value)
    for _ in range(NEWTON):
        value = free(rays.at(t))
        slope = engine.stop_gradient(gradient(lambda s: level(rays.at(s[:, 0])), t[:, None])[:, 0])
        better = t - value / xp.where(slope == 0, 1.0, slope)
        t = xp.where((better >= low) & (better <= high), better, t)
    return t


def _rows(tree: Any, index: Array) -> Any:
    """Some rows of all arrays of a tree."""
    xp = engine_of(index).namespace
    return map_leaves(lambda x: xp.take(x, index, axis=0), tree)


def _change_sign(before: Array, after: Array) -> Array:
    """Whether one is inside and the other outside; what is not a number is neither."""
    return ((before < 0) & (after >= 0)) | ((before >= 0) & (after < 0))


def _without_derivative(level: Callable[[Array], Array], points: Array) -> Array:
    return engine_of(points).stop_gradient(level(points))


def _within(origins: Array, directions: Array, length: Array, radius: float) -> tuple[Array, Array]:
    """Where rays enter a ball about the origin, or begin in it, and leave it; both are 0 for those that miss it."""
    xp = engine_of(origins).namespace
    nearest = -xp.sum(origins * directions, axis=-1) / (length * length)
    off = origins + nearest[:, None] * directions
    square = radius * radius - xp.sum(off * off, axis=-1)
    half = xp.sqrt(xp.where(square > 0, square, 0.0)) / length
    met = (square > 0) & (nearest + half > 0)
    enter = xp.clip(nearest - half, 0, None)
    return xp.where(met, enter, 0.0), xp.where(met, nearest + half, 0.0)
