"""Bilinear lookups in tables of texels, and their derivatives, as compiled loops for arrays on the host.

Operands are those of `rts.operations.texels.TEXELS`. Gradients of texels are added up in the order of the lookups.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel, read_only

WRAPS = {"repeat": 1, "mirror": 2}
"""Numbers of continuations; 0 is that of "clamp"."""
FAR = 2.0**53
"""Texels farther out count as this one, which is as an integer is."""


def places_of(sizes: Sequence[tuple[int, ...]]) -> np.ndarray:
    """Height, width and first row in the table (L, 3) int32 of images."""
    counts = np.array([height * width for height, width in sizes])
    return np.stack([*np.array(sizes).T, np.cumsum(counts) - counts], axis=1).astype(np.int32)


def forward(
    table: np.ndarray,
    uv: np.ndarray,
    image: np.ndarray,
    out: np.ndarray,
    *,
    sizes: tuple[tuple[int, ...], ...],
    wrap: tuple[str, str],
    filter: str,
) -> None:
    """Fill `out` (N, C) with the lookups."""
    _parallel(_look_up, table, uv, image, sizes, wrap, filter, out)


def push(
    table: np.ndarray,
    uv: np.ndarray,
    image: np.ndarray,
    t_table: np.ndarray | None,
    t_uv: np.ndarray | None,
    out: np.ndarray,
    *,
    sizes: tuple[tuple[int, ...], ...],
    wrap: tuple[str, str],
    filter: str,
) -> None:
    """Fill `out` (N, C) with the derivative along `t_table` (M, C) and `t_uv` (N, 2), each None if zero."""
    if t_table is None:
        out[...] = 0
    else:
        forward(t_table, uv, image, out, sizes=sizes, wrap=wrap, filter=filter)
    if t_uv is not None and filter != "nearest":
        _parallel(_add_moved, table, uv, image, sizes, wrap, filter, t_uv, out)


def pull(
    table: np.ndarray,
    uv: np.ndarray,
    image: np.ndarray,
    g: np.ndarray,
    g_table: np.ndarray | None,
    g_uv: np.ndarray | None,
    *,
    sizes: tuple[tuple[int, ...], ...],
    wrap: tuple[str, str],
    filter: str,
) -> None:
    """Pull back the gradient `g` (N, C) of the result: fill `g_table` and `g_uv`, given as zeros, unless None."""
    if g_table is not None:
        _scatter(uv, image, *_numbers(sizes, wrap, filter), g, g_table)
    if g_uv is not None and filter != "nearest":
        _parallel(_pull_uv, table, uv, image, sizes, wrap, filter, g, g_uv)


def _parallel(function, table, uv, image, sizes, wrap, filter, *others):
    work = (30 + 6 * table.shape[1]) * len(uv)
    parallel(function, len(uv), table, uv, image, *_numbers(sizes, wrap, filter), *others, work=work)


def _numbers(sizes, wrap, filter):
    return read_only(places_of(sizes)), WRAPS.get(wrap[0], 0), WRAPS.get(wrap[1], 0), filter == "nearest"


@compiled
def _wrapped(index, count, wrap):
    """An integer in [0, count) for any."""
    if not 0 <= index < count:  # Most are inside, and divisions are slow.
        if wrap == 1:
            index %= count
        elif wrap == 2:
            index %= 2 * count
            index = 2 * count - 1 - index if index >= count else index
        else:
            index = min(max(index, 0), count - 1)
    return index


@compiled
def _found(uv, places, place, wrap_u, wrap_v, nearest, n):
    """The four texels of lookup n in the image `place`, and the shares of the right and the lower ones."""
    height, width, first = places[place, 0], places[place, 1], places[place, 2]
    real, half = uv.dtype.type, uv.dtype.type(0.5)
    x, y = uv[n, 0] * real(width) - half, (real(1) - uv[n, 1]) * real(height) - half
    if nearest:
        x, y = np.floor(x + half), np.floor(y + half)
    x0, y0 = np.floor(x), np.floor(y)
    # NaN names some texel, and its shares are none.
    column = int(min(max(x0, -FAR), FAR)) if x0 == x0 else 0
    row = int(min(max(y0, -FAR), FAR)) if y0 == y0 else 0
    left, right = _wrapped(column, width, wrap_u), _wrapped(column + 1, width, wrap_u)
    top, bottom = first + _wrapped(row, height, wrap_v) * width, first + _wrapped(row + 1, height, wrap_v) * width
    return top + left, top + right, bottom + left, bottom + right, x - x0, y - y0


@compiled
def _any(g, n):
    """True if row n of a gradient (N, C) is not zero; engines may have rows that are not in use."""
    found = False
    for k in range(g.shape[1]):
        found |= g[n, k] != 0
    return found


@loop
def _look_up(start, stop, table, uv, image, places, wrap_u, wrap_v, nearest, out):
    """Fill rows [start, stop) of `out` (N, C)."""
    several = len(image) > 0
    for n in range(start, stop):
        place = image[n] if several else 0
        a, b, c, d, fx, fy = _found(uv, places, place, wrap_u, wrap_v, nearest, n)
        for k in range(table.shape[1]):
            upper = table[a, k] + fx * (table[b, k] - table[a, k])
            lower = table[c, k] + fx * (table[d, k] - table[c, k])
            out[n, k] = upper + fy * (lower - upper)


@loop
def _add_moved(start, stop, table, uv, image, places, wrap_u, wrap_v, nearest, t_uv, out):
    """Add to rows [start, stop) of `out` (N, C) the derivative along `t_uv` (N, 2)."""
    several = len(image) > 0
    for n in range(start, stop):
        place = image[n] if several else 0
        a, b, c, d, fx, fy = _found(uv, places, place, wrap_u, wrap_v, nearest, n)
        right, down = t_uv[n, 0] * places[place, 1], -t_uv[n, 1] * places[place, 0]
        for k in range(table.shape[1]):
            upper, lower = table[b, k] - table[a, k], table[d, k] - table[c, k]
            falls = table[c, k] + fx * lower - table[a, k] - fx * upper
            out[n, k] += right * (upper + fy * (lower - upper)) + down * falls


@loop
def _pull_uv(start, stop, table, uv, image, places, wrap_u, wrap_v, nearest, g, g_uv):
    """Fill rows [start, stop) of `g_uv` (N, 2) from `g` (N, C)."""
    several = len(image) > 0
    for n in range(start, stop):
        if not _any(g, n):
            continue
        place = image[n] if several else 0
        a, b, c, d, fx, fy = _found(uv, places, place, wrap_u, wrap_v, nearest, n)
        right = down = g.dtype.type(0)
        for k in range(table.shape[1]):
            upper, lower = table[b, k] - table[a, k], table[d, k] - table[c, k]
            right += g[n, k] * (upper + fy * (lower - upper))
            down += g[n, k] * (table[c, k] + fx * lower - table[a, k] - fx * upper)
        g_uv[n, 0], g_uv[n, 1] = right * places[place, 1], -down * places[place, 0]


@loop
def _scatter(uv, image, places, wrap_u, wrap_v, nearest, g, g_table):
    """Add to `g_table` (M, C) the gradient of the texels, from `g` (N, C)."""
    one, several = g.dtype.type(1), len(image) > 0
    for n in range(len(uv)):
        if not _any(g, n):
            continue
        place = image[n] if several else 0
        a, b, c, d, fx, fy = _found(uv, places, place, wrap_u, wrap_v, nearest, n)
        for k in range(g.shape[1]):
            x = g[n, k]
            g_table[a, k] += (one - fx) * (one - fy) * x
            g_table[b, k] += fx * (one - fy) * x
            g_table[c, k] += (one - fx) * fy * x
            g_table[d, k] += fx * fy * x
