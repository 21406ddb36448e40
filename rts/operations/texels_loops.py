"""Bilinear lookups in tables of texels, and their derivatives, as compiled loops for arrays on the host.

Operands are those of `rts.operations.texels.TEXELS`. Gradients of texels are added up in the order of the lookups.
"""

from __future__ import annotations

import math

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel

WRAPS = {"clamp": 0, "repeat": 1, "mirror": 2}
"""Numbers of continuations."""


def forward(
    table: np.ndarray,
    uv: np.ndarray,
    image: np.ndarray,
    places: np.ndarray,
    out: np.ndarray,
    *,
    wrap: tuple[str, str],
    filter: str,
) -> None:
    """Fill `out` (N, C) with the lookups."""
    _parallel(_look_up, table, uv, image, places, wrap, filter, out)


def push(
    table: np.ndarray,
    uv: np.ndarray,
    image: np.ndarray,
    places: np.ndarray,
    t_table: np.ndarray | None,
    t_uv: np.ndarray | None,
    out: np.ndarray,
    *,
    wrap: tuple[str, str],
    filter: str,
) -> None:
    """Fill `out` (N, C) with the derivative along `t_table` (M, C) and `t_uv` (N, 2), each None if zero."""
    if t_table is None:
        out[...] = 0
    else:
        forward(t_table, uv, image, places, out, wrap=wrap, filter=filter)
    if t_uv is not None and filter != "nearest":
        _parallel(_add_moved, table, uv, image, places, wrap, filter, t_uv, out)


def pull(
    table: np.ndarray,
    uv: np.ndarray,
    image: np.ndarray,
    places: np.ndarray,
    g: np.ndarray,
    g_table: np.ndarray | None,
    g_uv: np.ndarray | None,
    *,
    wrap: tuple[str, str],
    filter: str,
) -> None:
    """Pull back the gradient `g` (N, C) of the result: fill `g_table` and `g_uv`, given as zeros, unless None."""
    if g_table is not None:
        _scatter(uv, image, places, *_numbers(wrap, filter), g, g_table)
    if g_uv is not None and filter != "nearest":
        _parallel(_pull_uv, table, uv, image, places, wrap, filter, g, g_uv)


def _parallel(function, table, uv, image, places, wrap, filter, *others):
    work = (30 + 6 * table.shape[1]) * len(uv)
    parallel(function, len(uv), table, uv, image, places, *_numbers(wrap, filter), *others, work=work)


def _numbers(wrap, filter):
    return WRAPS[wrap[0]], WRAPS[wrap[1]], filter == "nearest"


@compiled
def _wrapped(index, count, wrap):
    """A whole-numbered float as an integer in [0, count); 0 for NaN and infinity, which have no texel."""
    place = float(index) if math.isfinite(index) else 0.0
    if wrap == 1:
        place -= math.floor(place / count) * count
    elif wrap == 2:
        place -= math.floor(place / (2 * count)) * (2 * count)
        place = 2 * count - 1 - place if place >= count else place
    return int(min(max(place, 0.0), count - 1.0))


@compiled
def _found(uv, image, places, wrap_u, wrap_v, nearest, n):
    """The four texels of lookup n, and the shares of the right and the lower ones."""
    place = image[n if len(image) > 1 else 0]
    height, width, first = places[place, 0], places[place, 1], places[place, 2]
    real, half = uv.dtype.type, uv.dtype.type(0.5)
    x, y = uv[n, 0] * real(width) - half, (real(1) - uv[n, 1]) * real(height) - half
    if nearest:
        x, y = np.floor(x + half), np.floor(y + half)
    x0, y0 = np.floor(x), np.floor(y)
    left, right = _wrapped(x0, width, wrap_u), _wrapped(x0 + 1, width, wrap_u)
    top, bottom = first + _wrapped(y0, height, wrap_v) * width, first + _wrapped(y0 + 1, height, wrap_v) * width
    return top + left, top + right, bottom + left, bottom + right, x - x0, y - y0


@loop
def _look_up(start, stop, table, uv, image, places, wrap_u, wrap_v, nearest, out):
    """Fill rows [start, stop) of `out` (N, C)."""
    for n in range(start, stop):
        a, b, c, d, fx, fy = _found(uv, image, places, wrap_u, wrap_v, nearest, n)
        for k in range(table.shape[1]):
            upper = table[a, k] + fx * (table[b, k] - table[a, k])
            lower = table[c, k] + fx * (table[d, k] - table[c, k])
            out[n, k] = upper + fy * (lower - upper)


@loop
def _add_moved(start, stop, table, uv, image, places, wrap_u, wrap_v, nearest, t_uv, out):
    """Add to rows [start, stop) of `out` (N, C) the derivative along `t_uv` (N, 2)."""
    for n in range(start, stop):
        a, b, c, d, fx, fy = _found(uv, image, places, wrap_u, wrap_v, nearest, n)
        place = image[n if len(image) > 1 else 0]
        right, down = t_uv[n, 0] * places[place, 1], -t_uv[n, 1] * places[place, 0]
        for k in range(table.shape[1]):
            upper, lower = table[b, k] - table[a, k], table[d, k] - table[c, k]
            falls = table[c, k] + fx * lower - table[a, k] - fx * upper
            out[n, k] += right * (upper + fy * (lower - upper)) + down * falls


@loop
def _pull_uv(start, stop, table, uv, image, places, wrap_u, wrap_v, nearest, g, g_uv):
    """Fill rows [start, stop) of `g_uv` (N, 2) from `g` (N, C)."""
    for n in range(start, stop):
        a, b, c, d, fx, fy = _found(uv, image, places, wrap_u, wrap_v, nearest, n)
        right = down = g.dtype.type(0)
        for k in range(table.shape[1]):
            upper, lower = table[b, k] - table[a, k], table[d, k] - table[c, k]
            right += g[n, k] * (upper + fy * (lower - upper))
            down += g[n, k] * (table[c, k] + fx * lower - table[a, k] - fx * upper)
        place = image[n if len(image) > 1 else 0]
        g_uv[n, 0], g_uv[n, 1] = right * places[place, 1], -down * places[place, 0]


@loop
def _scatter(uv, image, places, wrap_u, wrap_v, nearest, g, g_table):
    """Add to `g_table` (M, C) the gradient of the texels, from `g` (N, C)."""
    one = g.dtype.type(1)
    for n in range(len(uv)):
        a, b, c, d, fx, fy = _found(uv, image, places, wrap_u, wrap_v, nearest, n)
        for k in range(g.shape[1]):
            x = g[n, k]
            if x != 0:
                g_table[a, k] += (one - fx) * (one - fy) * x
                g_table[b, k] += fx * (one - fy) * x
                g_table[c, k] += (one - fx) * fy * x
                g_table[d, k] += fx * fy * x
