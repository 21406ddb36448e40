"""Ray casting of a field's surface: steps bracket changes of sign, then roots are found in the brackets."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rts import engine_of, namespace
from rts.plugin_api.arrays import Array, map_leaves
from rts.plugin_api.operations import gradient
from rts.plugin_api.records import RayHits
from rts_surfaces.implicit.regions import Region

Level = Callable[[Array], Array]
Describe = Callable[[Array, Array], Array]

STEPS, WITH_BOUND = 256, 1024
"""The number of shortest steps across the region, without and with a Lipschitz constant."""

SECANT, NEWTON = 5, 2
"""Steps of the methods of Illinois and of Newton in a bracket."""

CROWDED = 0.75
"""Finished rays are removed when the share of the rays that go on is below this."""

FLATTEST = 1e-6
"""Least squared slope by which a level is divided to move points, as a share of the usual one; this bounds motion."""


def moving(level: Callable[[Array], Array], points: Array, hit: Array) -> Array:
    """Parameters (M, 7): points (M, 3) of a surface, their motion for each unit by which the level falls, and zeros.

    The motion is w = ∇f / |∇f|²: the point x₀ − f(x₀) w is on the surface, to first order. `hit` (M,) bool is true for
    rows that are points of the surface; others pad.
    """
    engine = engine_of(points)
    xp, slope = engine.namespace, per_level(gradient(level, points), hit)
    return engine.stop_gradient(xp.concat([points, slope, xp.zeros_like(points[:, :1])], axis=-1))


def per_level(slope: Array, hit: Array) -> Array:
    """Slopes (M, 3) divided by their squared lengths; `hit` (M,) bool is true for slopes at points of the surface.

    Slopes that are flat compared with the usual one are divided by more, see `FLATTEST`. The usual slope is a geometric
    mean, so that a few steep places, such as those of a square root, do not make the others flat.
    """
    xp = namespace(slope)
    # Squares of small slopes are no numbers of single precision.
    largest = xp.max(xp.abs(slope), axis=-1, keepdims=True)
    scaled = slope / xp.where(largest > 0, largest, xp.ones_like(largest))
    size = largest * xp.sqrt(xp.sum(scaled * scaled, axis=-1, keepdims=True))
    counts = hit[:, None] & (size > 0) & xp.isfinite(size)
    logarithms = xp.log(xp.where(counts, size, xp.ones_like(size)))
    usual = xp.exp(xp.sum(logarithms) / xp.clip(xp.sum(xp.astype(counts, size.dtype)), 1.0, None))
    size = xp.where(size > 0, size, xp.ones_like(size))
    return slope / size / xp.maximum(size, FLATTEST * usual * (usual / size))


def cast(
    level: Level,
    describe: Describe,
    origins: Array,
    directions: Array,
    layers: int,
    *,
    within: Region,
    lipschitz: float | None = None,
    steps: int | None = None,
) -> RayHits:
    """The nearest points of each ray at which a function changes its sign, within a region; without derivative.

    With a Lipschitz constant L steps are |level| / L long, but not shorter than a share of the region, so that they
    lead over the surface. Without L all steps are of one length. In both cases parts thinner than a step may be missed.
    On the CPU NumPy takes the steps, whose operations on few rays cost it less. The engine computes levels, of few
    shapes if it compiles for each, and parameters.

    Args:
        level: points (M, 3) → (M,), negative inside, zero counts as outside.
        describe: a function of points (M, 3) and marks (M,) bool of those on the surface; gives parameters (M, P).
        origins: (R, 3).
        directions: (R, 3), of any length but zero.
        layers: K.
        within: the region.
        lipschitz: L, which the slope of `level` nowhere exceeds; or None.
        steps: the number of the shortest steps across the region; None for `STEPS`, or with L `WITH_BOUND`.

    Returns:
        Hits in the arrays' engine and dtype. Where there is none, distance and parameters are 0.
    """
    engine = engine_of(origins)
    xp = engine.namespace
    if not isinstance(origins, np.ndarray) and engine.on_host(origins) and origins.shape[0]:
        options = {"within": within, "lipschitz": lipschitz, "steps": steps}
        with suppress(_Unknown):
            return _cast_on_host(level, describe, origins, directions, layers, options)
    length = xp.sqrt(xp.sum(directions * directions, axis=-1))
    enter, leave = within.span(origins, directions)
    if steps is None:
        steps = STEPS if lipschitz is None else WITH_BOUND
    rays = _Rays(
        origins + enter[:, None] * directions,
        directions,
        leave - enter,
        within.across / steps / length,
        xp.zeros_like(length) if lipschitz is None else 1 / (lipschitz * length),
    )
    most = steps + 1  # The shortest steps need no more to cross the region.
    free = partial(without_derivative, level)
    if engine.padded(origins):
        return _cast_all(level, free, describe, rays, enter, layers, most)
    return _cast_some(level, free, describe, rays, enter, layers, most)


class _Unknown(Exception):
    """Rays or levels are traced, these perhaps alone, as under an eager `vmap` over θ."""


def _cast_on_host(
    level: Level, describe: Describe, origins: Array, directions: Array, layers: int, options: dict
) -> RayHits:
    """See `cast`: NumPy takes the steps.

    Raises:
        _Unknown: rays or levels are traced.
    """
    engine = engine_of(origins)
    starts, ways = engine.known(origins), engine.known(directions)
    if starts is None or ways is None or starts.shape != origins.shape or ways.shape != directions.shape:
        raise _Unknown

    def known(points: np.ndarray) -> np.ndarray:
        count = len(points)
        padded = np.concatenate([points, np.repeat(points[:1], engine.room(count, origins) - count, axis=0)])
        values = engine.known(engine.stop_gradient(level(engine.constant(padded, origins))))
        if values is None or values.shape != padded.shape[:1]:
            raise _Unknown
        return np.asarray(values[:count], points.dtype)

    # Parameters of no columns stand for those that the engine computes, of hits alone.
    hits = cast(known, lambda points, hit: points[:, :0], starts, ways, layers, **options)
    _, ray = np.nonzero(hits.hit)
    count = len(ray)
    ray = np.concatenate([ray, np.zeros(engine.room(max(1, count), origins) - count, ray.dtype)])
    far = np.concatenate([hits.distance[hits.hit], np.zeros(len(ray) - count, hits.distance.dtype)])
    points = engine.constant(starts[ray] + far[:, None] * ways[ray], origins)
    found = describe(points, engine.constant(np.arange(len(ray)) < count, origins))
    row = np.zeros(hits.hit.shape, np.int32)
    row[hits.hit] = np.arange(count)
    hit, distance, entering, row = (
        engine.constant(x, origins) for x in (hits.hit, hits.distance, hits.entering, row.reshape(-1))
    )
    xp = engine.namespace
    params = xp.reshape(xp.take(found, row, axis=0), (*hit.shape, found.shape[-1]))
    return RayHits(hit, distance, xp.where(hit[..., None], params, 0.0), entering=entering)


class _Rays(NamedTuple):
    """Rays from where they enter the region.

    Attributes:
        starts: (R, 3).
        directions: (R, 3).
        last: (R,), where they leave the region, in units of their directions; 0 for those that do not meet it.
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
    """Ray parameters `low` and `high` between which the level changes its sign, and the levels there; of one shape."""

    low: Array
    high: Array
    below: Array
    above: Array


def _cast_some(
    level: Callable, free: Callable, describe: Callable, rays: _Rays, enter: Array, layers: int, most: int
) -> RayHits:
    """Hits of eager arrays: finished rays are removed, and roots are sought in the brackets found alone."""
    xp, count = engine_of(enter).namespace, enter.shape[0]
    index = xp.arange(count, dtype=xp.int64, device=enter.device)
    going, hits, t, value = rays, xp.zeros_like(index), xp.zeros_like(enter), free(rays.starts)
    # The first is of no hit, so that no function is called without points.
    cells, brackets = [index[:1]], [_Bracket(*[t[:1]] * 4)]
    for _ in range(most):
        on = (t < going.last) & (hits < layers)
        left = int(xp.sum(xp.astype(on, xp.int64)))
        if not left:
            break
        if left < CROWDED * on.shape[0]:
            going, index, hits, t, value, on = _rows((going, index, hits, t, value, on), xp.nonzero(on)[0])
        further = going.further(t, value)
        after = free(going.at(further))
        crossed = on & _change_sign(value, after)
        at = xp.nonzero(crossed)[0]
        if at.shape[0]:
            cell, bracket = _rows((hits * count + index, _Bracket(t, further, value, after)), at)
            cells.append(cell)
            brackets.append(bracket)
            hits = hits + xp.astype(crossed, xp.int64)
        t, value = further, after
    cell, bracket = xp.concat(cells), _Bracket(*(xp.concat(x) for x in zip(*brackets, strict=True)))
    met = _rows(rays, cell % count)
    t = _roots(level, free, met, bracket)

    def spread(values: Array) -> Array:
        table = xp.zeros((layers * count, *values.shape[1:]), dtype=values.dtype, device=values.device)
        table[cell[1:]] = values[1:]
        return xp.reshape(table, (layers, count, *values.shape[1:]))

    distance, hit = t + xp.take(enter, cell % count, axis=0), xp.ones_like(cell, dtype=xp.bool)
    hit[0] = False
    return RayHits(spread(hit), spread(distance), spread(describe(met.at(t), hit)), entering=spread(bracket.below >= 0))


def _cast_all(
    level: Callable, free: Callable, describe: Callable, rays: _Rays, enter: Array, layers: int, most: int
) -> RayHits:
    """Hits of arrays whose shapes must stay: rays go on until all are finished, and roots are sought in all layers."""
    engine = engine_of(enter)
    xp = engine.namespace
    zero = xp.zeros_like(enter)
    none = xp.stack([zero] * layers)

    def on(state: dict[str, Array]) -> Array:
        return (state["t"] < rays.last) & (state["hits"] < layers)

    def body(state: dict[str, Array]) -> dict[str, Array]:
        going, t, value, hits = on(state), state["t"], state["value"], state["hits"]
        further = xp.where(going, rays.further(t, value), t)
        after = free(rays.at(further))
        crossed = going & _change_sign(value, after)
        layer = xp.stack([crossed & (hits == k) for k in range(layers)])
        new = _Bracket(t, further, value, after)
        brackets = {n: xp.where(layer, getattr(new, n)[None], state[n]) for n in _Bracket._fields}
        return {"t": further, "value": after, "hits": hits + xp.astype(crossed, hits.dtype), **brackets}

    state = {"t": zero, "value": free(rays.starts), "hits": xp.zeros_like(zero, dtype=xp.int32)}
    state |= dict.fromkeys(_Bracket._fields, none)
    state = engine.repeat(body, lambda state: xp.any(on(state)), state, most)

    hit = xp.stack([state["hits"] > k for k in range(layers)])
    flat = [xp.reshape(state[n], (-1,)) for n in _Bracket._fields]
    met = map_leaves(lambda x: xp.concat([x] * layers), rays)
    t = _roots(level, free, met, _Bracket(*flat))
    params = describe(met.at(t), xp.reshape(hit, (-1,)))
    params = xp.reshape(params, (*hit.shape, params.shape[-1]))
    distance = xp.reshape(t, hit.shape) + enter
    entering = state["below"] >= 0
    return RayHits(hit, xp.where(hit, distance, 0.0), xp.where(hit[..., None], params, 0.0), entering=entering)


def _roots(level: Callable, free: Callable, rays: _Rays, bracket: _Bracket) -> Array:
    """Zeros (M,) of a function along rays, each within its own bracket, which no step leaves."""
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
    """True where one value is inside and the other outside; NaN is neither."""
    return ((before < 0) & (after >= 0)) | ((before >= 0) & (after < 0))


def without_derivative(level: Callable[[Array], Array], points: Array) -> Array:
    """The level at points, as a constant."""
    return engine_of(points).stop_gradient(level(points))
