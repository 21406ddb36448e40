"""Bilinear lookups in tables of texels, and their derivatives, as compiled loops for arrays on the host.

Operands are those of `rts.operations.texels.TEXELS`. Gradients of texels are added up in the order of the lookups.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.compiling.threads import parallel, read_only

WRAPS = {"repeat": 1, "mirror": 2}
"""Numbers of continuations; 0 is that of "clamp"."""
FAR = 2.0**53
"""Texels farther out count as this one, which is as an integer is."""


class Lookups(NamedTuple):
    """Places in images, and how these go on outside.

    Attributes:
        uv: (N, 2) float.
        image: (N,) int32, which image each lookup is of; (0,) where all are of the first.
        places: (L, 3) int32, see `places_of`.
        wraps: the continuations along u and v, see `WRAPS`.
        nearest: whether texels are not interpolated.
    """

    uv: np.ndarray
    image: np.ndarray
    places: np.ndarray
    wraps: tuple[int, int]
    nearest: bool


def places_of(sizes: Sequence[tuple[int, ...]]) -> np.ndarray:
    """Height, width and first row in the table (L, 3) int32 of images."""
    counts = np.array([height * width for height, width in sizes])
    return np.stack([*np.array(sizes).T, np.cumsum(counts) - counts], axis=1).astype(np.int32)


def forward(table: np.ndarray, uv: np.ndarray, image: np.ndarray, out: np.ndarray, **options: Any) -> None:
    """Fill `out` (N, C) with the lookups. `options` are the parameters of `TEXELS`."""
    _parallel(_look_up, _lookups(uv, image, **options), table, out)


def push(table: np.ndarray, uv: np.ndarray, image: np.ndarray, *rest: Any, **options: Any) -> None:
    """Fill the last of `rest`, out (N, C), with the derivative.

    Before it are tangents of the table (M, C) and of uv (N, 2), each None if zero.
    """
    t_table, t_uv, out = rest
    if t_table is None:
        out[...] = 0
    else:
        forward(t_table, uv, image, out, **options)
    if t_uv is not None and options["filter"] != "nearest":
        _parallel(_add_moved, _lookups(uv, image, **options), table, t_uv, out)


def pull(table: np.ndarray, uv: np.ndarray, image: np.ndarray, g: np.ndarray, *results: Any, **options: Any) -> None:
    """Pull back the gradient `g` (N, C) of the result: fill `results`, of table and uv, given as zeros, unless None."""
    (g_table, g_uv), lookups = results, _lookups(uv, image, **options)
    if g_table is not None:
        _scatter(lookups, g, g_table)
    if g_uv is not None and not lookups.nearest:
        _parallel(_pull_uv, lookups, table, g, g_uv)


def _lookups(uv, image, sizes, wrap, filter):
    wraps = WRAPS.get(wrap[0], 0), WRAPS.get(wrap[1], 0)
    return Lookups(uv, image, read_only(places_of(sizes)), wraps, filter == "nearest")


def _parallel(function, lookups, table, *others):
    count = len(lookups.uv)
    parallel(function, count, lookups, table, *others, work=(30 + 6 * table.shape[1]) * count)


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
def _place(lookups, n):
    """Height, width and first row of the image of lookup n."""
    image, places = lookups.image, lookups.places
    place = image[n] if len(image) > 0 else 0
    return places[place, 0], places[place, 1], places[place, 2]


@compiled
def _found(lookups, n):
    """The four texels of lookup n, and the shares of the right and the lower ones."""
    uv, (height, width, first), (wrap_u, wrap_v) = lookups.uv, _place(lookups, n), lookups.wraps
    real, half = uv.dtype.type, uv.dtype.type(0.5)
    x, y = uv[n, 0] * real(width) - half, (real(1) - uv[n, 1]) * real(height) - half
    if lookups.nearest:
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
def _look_up(start, stop, lookups, table, out):
    """Fill rows [start, stop) of `out` (N, C)."""
    for n in range(start, stop):
        a, b, c, d, fx, fy = _found(lookups, n)
        for k in range(table.shape[1]):
            upper = table[a, k] + fx * (table[b, k] - table[a, k])
            lower = table[c, k] + fx * (table[d, k] - table[c, k])
            out[n, k] = upper + fy * (lower - upper)


@loop
def _add_moved(start, stop, lookups, table, t_uv, out):
    """Add to rows [start, stop) of `out` (N, C) the derivative along `t_uv` (N, 2)."""
    for n in range(start, stop):
        a, b, c, d, fx, fy = _found(lookups, n)
        height, width, _ = _place(lookups, n)
        right, down = t_uv[n, 0] * width, -t_uv[n, 1] * height
        for k in range(table.shape[1]):
            upper, lower = table[b, k] - table[a, k], table[d, k] - table[c, k]
            falls = table[c, k] + fx * lower - table[a, k] - fx * upper
            out[n, k] += right * (upper + fy * (lower - upper)) + down * falls


@loop
def _pull_uv(start, stop, lookups, table, g, g_uv):
    """Fill rows [start, stop) of `g_uv` (N, 2) from `g` (N, C)."""
    for n in range(start, stop):
        if not _any(g, n):
            continue
        a, b, c, d, fx, fy = _found(lookups, n)
        right = down = g.dtype.type(0)
        for k in range(table.shape[1]):
            upper, lower = table[b, k] - table[a, k], table[d, k] - table[c, k]
            right += g[n, k] * (upper + fy * (lower - upper))
            down += g[n, k] * (table[c, k] + fx * lower - table[a, k] - fx * upper)
        height, width, _ = _place(lookups, n)
        g_uv[n, 0], g_uv[n, 1] = right * width, -down * height


@loop
def _scatter(lookups, g, g_table):
    """Add to `g_table` (M, C) the gradient of the texels, from `g` (N, C)."""
    one = g.dtype.type(1)
    for n in range(len(lookups.uv)):
        if not _any(g, n):
            continue
        a, b, c, d, fx, fy = _found(lookups, n)
        for k in range(g.shape[1]):
            x = g[n, k]
            g_table[a, k] += (one - fx) * (one - fy) * x
            g_table[b, k] += fx * (one - fy) * x
            g_table[c, k] += (one - fx) * fy * x
            g_table[d, k] += fx * fy * x
