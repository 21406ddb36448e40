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
NARROW, WIDE = 0.5, 5.0
"""A side of a footprint of up to so many texels takes one lookup, or two; longer ones take four."""
SHEARED = 1e-3
"""The square of the least sine between the sides of a footprint of which both tell slopes."""


class Lookups(NamedTuple):
    """Places in images, and how these go on outside.

    Attributes:
        uv: (N, 2) float.
        image: (N,) int32, which image each lookup is of; (0,) where all are of the first.
        footprint: (N, 4) float, what each lookup is the mean over; (0, 4) where all are points.
        places: (L, 3) int32, see `places_of`.
        wraps: the continuations along u and v, see `WRAPS`.
        nearest: whether texels are not interpolated.
    """

    uv: np.ndarray
    image: np.ndarray
    footprint: np.ndarray
    places: np.ndarray
    wraps: tuple[int, int]
    nearest: bool


def places_of(sizes: Sequence[tuple[int, ...]]) -> np.ndarray:
    """Height, width and first row in the table (L, 3) int32 of images."""
    counts = np.array([height * width for height, width in sizes])
    return np.stack([*np.array(sizes).T, np.cumsum(counts) - counts], axis=1).astype(np.int32)


def forward(
    table: np.ndarray, uv: np.ndarray, image: np.ndarray, footprint: np.ndarray, out: np.ndarray, **options: Any
) -> None:
    """Fill `out` (N, C) with the lookups. `options` are the parameters of `TEXELS`."""
    _parallel(_look_up, _lookups(uv, image, footprint, **options), table, out)


def push(
    table: np.ndarray, uv: np.ndarray, image: np.ndarray, footprint: np.ndarray, *rest: Any, **options: Any
) -> None:
    """Fill the last of `rest`, out (N, C), with the derivative.

    Before it are tangents of the table (M, C) and of uv (N, 2), each None if zero.
    """
    t_table, t_uv, out = rest
    if t_table is None:
        out[...] = 0
    else:
        forward(t_table, uv, image, footprint, out, **options)
    if t_uv is not None and options["filter"] != "nearest":
        _parallel(_add_moved, _lookups(uv, image, footprint, **options), table, t_uv, out)


def pull(
    table: np.ndarray,
    uv: np.ndarray,
    image: np.ndarray,
    footprint: np.ndarray,
    g: np.ndarray,
    *results: Any,
    **options: Any,
) -> None:
    """Pull back the gradient `g` (N, C) of the result: fill `results`, of table and uv, given as zeros, unless None."""
    (g_table, g_uv), lookups = results, _lookups(uv, image, footprint, **options)
    if g_table is not None:
        _scatter(lookups, g, g_table)
    if g_uv is not None and not lookups.nearest:
        _parallel(_pull_uv, lookups, table, g, g_uv)


def _lookups(uv, image, footprint, sizes, wrap, filter):
    wraps = WRAPS.get(wrap[0], 0), WRAPS.get(wrap[1], 0)
    return Lookups(uv, image, footprint, read_only(places_of(sizes)), wraps, filter == "nearest")


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
def _sides(lookups, n, height, width):
    """The sides of a footprint in texels, right and down, and how many lookups there are along each."""
    footprint, real = lookups.footprint, lookups.uv.dtype.type
    ax = ay = bx = by = real(0)
    if len(footprint) > 0:
        ax, ay, bx, by = footprint[n, 0] * width, -footprint[n, 1] * height, footprint[n, 2] * width, footprint[n, 3]
        by *= -height
    a, b = np.sqrt(ax * ax + ay * ay), np.sqrt(bx * bx + by * by)
    if not a + b < FAR:  # Neither infinite nor NaN.
        ax = ay = bx = by = a = b = real(0)
    count_a = 1 if a <= NARROW else 2 if a <= WIDE else 4
    count_b = 1 if b <= NARROW else 2 if b <= WIDE else 4
    return real(ax), real(ay), real(bx), real(by), count_a, count_b


@compiled(inline="always")
def _along(i, count, real):
    """The place of lookup i of `count` along a side, from −½ to ½: all are as far apart."""
    return (real(i) + real(0.5)) / real(count) - real(0.5)


@compiled
def _centre(lookups, n, height, width):
    """Where a lookup is in an image: columns from the centre of the leftmost texel, and rows from the uppermost's."""
    uv, real, half = lookups.uv, lookups.uv.dtype.type, lookups.uv.dtype.type(0.5)
    return uv[n, 0] * real(width) - half, (real(1) - uv[n, 1]) * real(height) - half


@compiled
def _found(lookups, x, y, height, width, first):
    """The four texels around a point of an image, and the shares of the right and the lower ones."""
    wrap_u, wrap_v = lookups.wraps
    if lookups.nearest:
        half = lookups.uv.dtype.type(0.5)
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
    real = lookups.uv.dtype.type
    for n in range(start, stop):
        height, width, first = _place(lookups, n)
        x, y = _centre(lookups, n, height, width)
        ax, ay, bx, by, count_a, count_b = _sides(lookups, n, height, width)
        out[n] = 0
        share = real(1) / real(count_a * count_b)
        for i in range(count_a):
            for j in range(count_b):
                s, t = _along(i, count_a, real), _along(j, count_b, real)
                a, b, c, d, fx, fy = _found(lookups, x + s * ax + t * bx, y + s * ay + t * by, height, width, first)
                for k in range(table.shape[1]):
                    upper = table[a, k] + fx * (table[b, k] - table[a, k])
                    lower = table[c, k] + fx * (table[d, k] - table[c, k])
                    out[n, k] += share * (upper + fy * (lower - upper))


@compiled
def _add_at(lookups, table, x, y, place, share, k, total):
    """Add the `share` of a lookup to row k of `total` (·, C)."""
    height, width, first = place
    a, b, c, d, fx, fy = _found(lookups, x, y, height, width, first)
    for c_ in range(table.shape[1]):
        upper = table[a, c_] + fx * (table[b, c_] - table[a, c_])
        lower = table[c, c_] + fx * (table[d, c_] - table[c, c_])
        total[k, c_] += share * (upper + fy * (lower - upper))


@compiled
def _slopes(lookups, table, n, slope, rises):
    """Fill `slope` (2, C) with the slopes of lookup n, to the right and down, a texel each; `rises` (2, C) is room."""
    real = lookups.uv.dtype.type
    height, width, first = _place(lookups, n)
    place = height, width, first
    x, y = _centre(lookups, n, height, width)
    ax, ay, bx, by, count_a, count_b = _sides(lookups, n, height, width)
    slope[...] = 0
    share = real(1) / real(count_a * count_b)
    for i in range(count_a):
        for j in range(count_b):
            s, t = _along(i, count_a, real), _along(j, count_b, real)
            a, b, c, d, fx, fy = _found(lookups, x + s * ax + t * bx, y + s * ay + t * by, height, width, first)
            for k in range(table.shape[1]):
                upper, lower = table[b, k] - table[a, k], table[d, k] - table[c, k]
                slope[0, k] += share * (upper + fy * (lower - upper))
                slope[1, k] += share * (table[c, k] + fx * lower - table[a, k] - fx * upper)
    if count_a == 1 and count_b == 1:
        return
    # What the mean changes by from side to side of the footprint, less what slopes say.
    rises[...] = 0
    for i in range(2):
        end = real(i) - real(0.5)
        for j in range(count_b if count_a > 1 else 0):
            t, weight = _along(j, count_b, real), real(2 * i - 1) / real(count_b)
            _add_at(lookups, table, x + end * ax + t * bx, y + end * ay + t * by, place, weight, 0, rises)
        for j in range(count_a if count_b > 1 else 0):
            s, weight = _along(j, count_a, real), real(2 * i - 1) / real(count_a)
            _add_at(lookups, table, x + s * ax + end * bx, y + s * ay + end * by, place, weight, 1, rises)
    aa, ab, bb = ax * ax + ay * ay, ax * bx + ay * by, bx * bx + by * by
    determinant = ax * by - ay * bx
    both = count_a > 1 and count_b > 1 and determinant * determinant > real(SHEARED) * aa * bb
    for k in range(table.shape[1]):
        more_a = rises[0, k] - slope[0, k] * ax - slope[1, k] * ay
        more_b = rises[1, k] - slope[0, k] * bx - slope[1, k] * by
        if both:
            slope[0, k] += (more_a * by - more_b * ay) / determinant
            slope[1, k] += (more_b * ax - more_a * bx) / determinant
        elif aa >= bb:
            slope[0, k] += more_a * ax / aa
            slope[1, k] += more_a * ay / aa
        else:
            slope[0, k] += more_b * bx / bb
            slope[1, k] += more_b * by / bb


@loop
def _add_moved(start, stop, lookups, table, t_uv, out):
    """Add to rows [start, stop) of `out` (N, C) the derivative along `t_uv` (N, 2)."""
    slope, rises = np.empty((2, table.shape[1]), table.dtype), np.empty((2, table.shape[1]), table.dtype)
    for n in range(start, stop):
        _slopes(lookups, table, n, slope, rises)
        height, width, _ = _place(lookups, n)
        right, down = t_uv[n, 0] * width, -t_uv[n, 1] * height
        for k in range(table.shape[1]):
            out[n, k] += right * slope[0, k] + down * slope[1, k]


@loop
def _pull_uv(start, stop, lookups, table, g, g_uv):
    """Fill rows [start, stop) of `g_uv` (N, 2) from `g` (N, C)."""
    slope, rises = np.empty((2, table.shape[1]), table.dtype), np.empty((2, table.shape[1]), table.dtype)
    for n in range(start, stop):
        if not _any(g, n):
            continue
        _slopes(lookups, table, n, slope, rises)
        right = down = g.dtype.type(0)
        for k in range(table.shape[1]):
            right += g[n, k] * slope[0, k]
            down += g[n, k] * slope[1, k]
        height, width, _ = _place(lookups, n)
        g_uv[n, 0], g_uv[n, 1] = right * width, -down * height


@loop
def _scatter(lookups, g, g_table):
    """Add to `g_table` (M, C) the gradient of the texels, from `g` (N, C)."""
    real, one = lookups.uv.dtype.type, g.dtype.type(1)
    for n in range(len(lookups.uv)):
        if not _any(g, n):
            continue
        height, width, first = _place(lookups, n)
        x, y = _centre(lookups, n, height, width)
        ax, ay, bx, by, count_a, count_b = _sides(lookups, n, height, width)
        share = one / g.dtype.type(count_a * count_b)
        for i in range(count_a):
            for j in range(count_b):
                s, t = _along(i, count_a, real), _along(j, count_b, real)
                a, b, c, d, fx, fy = _found(lookups, x + s * ax + t * bx, y + s * ay + t * by, height, width, first)
                for k in range(g.shape[1]):
                    part = share * g[n, k]
                    g_table[a, k] += (one - fx) * (one - fy) * part
                    g_table[b, k] += fx * (one - fy) * part
                    g_table[c, k] += (one - fx) * fy * part
                    g_table[d, k] += fx * fy * part
