"""Bilinear lookups in tables of texels, and their derivatives, as compiled loops for arrays on the host.

Operands are those of `rts.operations.texels.TEXELS`. Loops begin alike, since a helper that took the arrays would take
as long as a lookup. Gradients of texels are added up in the order of the lookups.
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
NARROW, WIDE = 0.5, 3.0
"""A side of a footprint of up to NARROW texels takes one lookup, of up to WIDE two, of up to twice as many four, and of
more eight, where the other side takes at most two; else four."""
MOST, ON_SIDES = 16, 20
"""Lookups inside a footprint, and on its sides, at most."""
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


def _taps() -> tuple[np.ndarray, np.ndarray]:
    """Where footprints are looked up, by the numbers of lookups along both sides: 2ᵃ and 2ᵇ are of 4 a + b.

    Returns:
        How many lookups there are on the two sides along b, inside, and on the two along a (16, 3). And for each
        lookup, in this order, its place along a and along b, from −½ to ½, and its weight (16, 36, 3).
    """
    numbers, taps = np.zeros((16, 3), np.int64), np.zeros((16, MOST + ON_SIDES, 3), np.float32)
    for q in range(16):
        count_a, count_b = 2 ** (q // 4), 2 ** (q % 4)
        if count_a * count_b > MOST:
            continue
        along_a, along_b = ((np.arange(n) + 0.5) / n - 0.5 for n in (count_a, count_b))
        ends = (-0.5, 0.5)
        of_a = [(end, t, 2 * end / count_b) for end in ends for t in along_b if count_a > 1]
        inside = [(s, t, 1 / (count_a * count_b)) for s in along_a for t in along_b]
        of_b = [(s, end, 2 * end / count_a) for end in ends for s in along_a if count_b > 1]
        numbers[q] = len(of_a), len(inside), len(of_b)
        taps[q, : sum(numbers[q])] = of_a + inside + of_b
    return numbers, taps


NUMBERS, TAPS = _taps()


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
def _sides(du_dx, dv_dx, du_dy, dv_dy, height, width):
    """The sides of a footprint in texels, right and down, and which of `TAPS` it is looked up at."""
    ax, ay, bx, by = du_dx * width, -dv_dx * height, du_dy * width, -dv_dy * height
    a, b = np.sqrt(ax * ax + ay * ay), np.sqrt(bx * bx + by * by)
    known = a + b < FAR  # Neither infinite nor NaN.
    of_a, of_b, none = _exponent(a), _exponent(b), 0 * width
    of_a, of_b = (of_a if of_b < 2 else min(of_a, 2)), (of_b if of_a < 2 else min(of_b, 2))
    return (ax, ay, bx, by, 4 * of_a + of_b) if known else (none, none, none, none, 0)


@compiled
def _exponent(length):
    """The logarithm (base 2) of the number of lookups along a side of so many texels."""
    return 0 if length <= NARROW else 1 if length <= WIDE else 2 if length <= 2 * WIDE else 3


@compiled
def _found(x, y, height, width, first, wrap_u, wrap_v, nearest):
    """The four texels around a point of an image, and the shares of the right and the lower ones.

    x and y are columns from the centre of the leftmost texel, and rows from the uppermost's.
    """
    if nearest:
        x, y = np.floor(x + np.float32(0.5)), np.floor(y + np.float32(0.5))
    x0, y0 = np.floor(x), np.floor(y)
    # NaN names some texel, and its shares are none.
    left = int(min(max(x0, -FAR), FAR)) if x0 == x0 else 0
    upper = int(min(max(y0, -FAR), FAR)) if y0 == y0 else 0
    right, lower = left + 1, upper + 1
    if not (left >= 0 and right < width and upper >= 0 and lower < height):  # Most are inside.
        left, right = _wrapped(left, width, wrap_u), _wrapped(right, width, wrap_u)
        upper, lower = _wrapped(upper, height, wrap_v), _wrapped(lower, height, wrap_v)
    top, bottom = first + upper * width, first + lower * width
    a, b, c, d = np.uint32(top + left), np.uint32(top + right), np.uint32(bottom + left), np.uint32(bottom + right)
    return a, b, c, d, x - x0, y - y0


@compiled
def _kind(ax, ay, bx, by, q):
    """1 if a footprint's sides along b tell how the mean changes along a, plus 2 if those along a tell it along b."""
    a, b = q >= 4, q % 4 > 0
    determinant, aa, bb = ax * by - ay * bx, ax * ax + ay * ay, bx * bx + by * by
    if a and b and determinant * determinant <= np.float32(SHEARED) * aa * bb:
        a, b = aa >= bb, aa < bb
    return (1 if a else 0) + (2 if b else 0)


@compiled
def _split(x, y, ax, ay, bx, by, kind):
    """A direction as so much of a footprint's a, so much of b, and the rest."""
    none = 0 * x
    of_a = of_b = none
    if kind == 3:
        determinant = ax * by - ay * bx
        of_a, of_b = (x * by - y * bx) / determinant, (y * ax - x * ay) / determinant
        x, y = none, none
    elif kind == 1:
        of_a = (x * ax + y * ay) / (ax * ax + ay * ay)
    elif kind == 2:
        of_b = (x * bx + y * by) / (bx * bx + by * by)
    return of_a, of_b, x - of_a * ax - of_b * bx if kind < 3 else none, y - of_a * ay - of_b * by if kind < 3 else none


@compiled
def _rates(i, numbers, share, direction, fx, fy):
    """Weights of the four texels of lookup i, from the upper left one on, in the derivative along a split direction."""
    (of_a, of_b, x, y), (sides, inside) = direction, numbers
    one = 1 - 0 * fx
    x, y = share * x, share * y
    by = share * (of_a if i < sides else of_b)
    if sides <= i < sides + inside:
        return -(one - fy) * x - (one - fx) * y, (one - fy) * x - fx * y, -fy * x + (one - fx) * y, fy * x + fx * y
    upper, lower = by * (one - fy), by * fy
    return upper * (one - fx), upper * fx, lower * (one - fx), lower * fx


@compiled
def _any(g, n):
    """True if row n of a gradient (N, C) is not zero; engines may have rows that are not in use."""
    found = False
    for k in range(g.shape[1]):
        found |= g[n, k] != 0
    return found


@compiled
def _sum(table, k, a, b, c, d, of_a, of_b, of_c, of_d):
    """The sum of a channel of four texels, each so many times."""
    return of_a * table[a, k] + of_b * table[b, k] + of_c * table[c, k] + of_d * table[d, k]


@loop
def _look_up(start, stop, lookups, table, out):
    """Fill rows [start, stop) of `out` (N, C)."""
    uv, image, footprint, places, (wrap_u, wrap_v), nearest = lookups
    real, channels = uv.dtype.type, table.shape[1]
    one, half = real(1), real(0.5)
    for n in range(start, stop):
        place = image[n] if len(image) > 0 else 0
        rows, columns, first = places[place, 0], places[place, 1], places[place, 2]
        height, width = real(rows), real(columns)
        x, y = uv[n, 0] * width - half, (one - uv[n, 1]) * height - half
        ax, ay, bx, by, q = real(0), real(0), real(0), real(0), 0
        if len(footprint) > 0:
            du, dv, du_down, dv_down = footprint[n, 0], footprint[n, 1], footprint[n, 2], footprint[n, 3]
            ax, ay, bx, by, q = _sides(du, dv, du_down, dv_down, height, width)
        red = green = blue = real(0)  # In variables, most textures take half the time.
        for k in range(channels):
            out[n, k] = 0
        for i in range(NUMBERS[q, 0], NUMBERS[q, 0] + NUMBERS[q, 1]):
            s, t, share = real(TAPS[q, i, 0]), real(TAPS[q, i, 1]), real(TAPS[q, i, 2])
            px, py = x + s * ax + t * bx, y + s * ay + t * by
            a, b, c, d, fx, fy = _found(px, py, rows, columns, first, wrap_u, wrap_v, nearest)
            upper, lower = share * (one - fy), share * fy
            p0, p1, p2, p3 = upper * (one - fx), upper * fx, lower * (one - fx), lower * fx
            if channels == 3:
                red += _sum(table, 0, a, b, c, d, p0, p1, p2, p3)
                green += _sum(table, 1, a, b, c, d, p0, p1, p2, p3)
                blue += _sum(table, 2, a, b, c, d, p0, p1, p2, p3)
            for k in range(0 if channels == 3 else channels):
                out[n, k] += _sum(table, k, a, b, c, d, p0, p1, p2, p3)
        if channels == 3:
            out[n, 0], out[n, 1], out[n, 2] = red, green, blue


@loop
def _add_moved(start, stop, lookups, table, t_uv, out):
    """Add to rows [start, stop) of `out` (N, C) the derivative along `t_uv` (N, 2)."""
    uv, image, footprint, places, (wrap_u, wrap_v), nearest = lookups
    real = uv.dtype.type
    one, half = real(1), real(0.5)
    for n in range(start, stop):
        place = image[n] if len(image) > 0 else 0
        rows, columns, first = places[place, 0], places[place, 1], places[place, 2]
        height, width = real(rows), real(columns)
        x, y = uv[n, 0] * width - half, (one - uv[n, 1]) * height - half
        ax, ay, bx, by, q = real(0), real(0), real(0), real(0), 0
        if len(footprint) > 0:
            du, dv, du_down, dv_down = footprint[n, 0], footprint[n, 1], footprint[n, 2], footprint[n, 3]
            ax, ay, bx, by, q = _sides(du, dv, du_down, dv_down, height, width)
        kind, (sides, inside, others) = _kind(ax, ay, bx, by, q), (NUMBERS[q, 0], NUMBERS[q, 1], NUMBERS[q, 2])
        direction = _split(t_uv[n, 0] * width, -t_uv[n, 1] * height, ax, ay, bx, by, kind)
        for i in range(0 if kind % 2 == 1 else sides, sides + inside + (others if kind >= 2 else 0)):
            if kind == 3 and sides <= i < sides + inside:
                continue
            s, t, share = real(TAPS[q, i, 0]), real(TAPS[q, i, 1]), real(TAPS[q, i, 2])
            px, py = x + s * ax + t * bx, y + s * ay + t * by
            a, b, c, d, fx, fy = _found(px, py, rows, columns, first, wrap_u, wrap_v, nearest)
            p0, p1, p2, p3 = _rates(i, (sides, inside), share, direction, fx, fy)
            for k in range(table.shape[1]):
                out[n, k] += _sum(table, k, a, b, c, d, p0, p1, p2, p3)


@loop
def _pull_uv(start, stop, lookups, table, g, g_uv):
    """Fill rows [start, stop) of `g_uv` (N, 2) from `g` (N, C)."""
    uv, image, footprint, places, (wrap_u, wrap_v), nearest = lookups
    real = uv.dtype.type
    zero, one, half = real(0), real(1), real(0.5)
    for n in range(start, stop):
        if not _any(g, n):
            continue
        place = image[n] if len(image) > 0 else 0
        rows, columns, first = places[place, 0], places[place, 1], places[place, 2]
        height, width = real(rows), real(columns)
        x, y = uv[n, 0] * width - half, (one - uv[n, 1]) * height - half
        ax, ay, bx, by, q = real(0), real(0), real(0), real(0), 0
        if len(footprint) > 0:
            du, dv, du_down, dv_down = footprint[n, 0], footprint[n, 1], footprint[n, 2], footprint[n, 3]
            ax, ay, bx, by, q = _sides(du, dv, du_down, dv_down, height, width)
        kind, (sides, inside, others) = _kind(ax, ay, bx, by, q), (NUMBERS[q, 0], NUMBERS[q, 1], NUMBERS[q, 2])
        to_right, to_below = _split(one, zero, ax, ay, bx, by, kind), _split(zero, one, ax, ay, bx, by, kind)
        right = down = zero
        for i in range(0 if kind % 2 == 1 else sides, sides + inside + (others if kind >= 2 else 0)):
            if kind == 3 and sides <= i < sides + inside:
                continue
            s, t, share = real(TAPS[q, i, 0]), real(TAPS[q, i, 1]), real(TAPS[q, i, 2])
            px, py = x + s * ax + t * bx, y + s * ay + t * by
            a, b, c, d, fx, fy = _found(px, py, rows, columns, first, wrap_u, wrap_v, nearest)
            of_a = of_b = of_c = of_d = zero
            for k in range(table.shape[1]):
                of_a += g[n, k] * table[a, k]
                of_b += g[n, k] * table[b, k]
                of_c += g[n, k] * table[c, k]
                of_d += g[n, k] * table[d, k]
            p0, p1, p2, p3 = _rates(i, (sides, inside), share, to_right, fx, fy)
            right += p0 * of_a + p1 * of_b + p2 * of_c + p3 * of_d
            p0, p1, p2, p3 = _rates(i, (sides, inside), share, to_below, fx, fy)
            down += p0 * of_a + p1 * of_b + p2 * of_c + p3 * of_d
        g_uv[n, 0], g_uv[n, 1] = right * width, -down * height


@loop
def _scatter(lookups, g, g_table):
    """Add to `g_table` (M, C) the gradient of the texels, from `g` (N, C)."""
    uv, image, footprint, places, (wrap_u, wrap_v), nearest = lookups
    real = uv.dtype.type
    one, half = real(1), real(0.5)
    for n in range(len(uv)):
        if not _any(g, n):
            continue
        place = image[n] if len(image) > 0 else 0
        rows, columns, first = places[place, 0], places[place, 1], places[place, 2]
        height, width = real(rows), real(columns)
        x, y = uv[n, 0] * width - half, (one - uv[n, 1]) * height - half
        ax, ay, bx, by, q = real(0), real(0), real(0), real(0), 0
        if len(footprint) > 0:
            du, dv, du_down, dv_down = footprint[n, 0], footprint[n, 1], footprint[n, 2], footprint[n, 3]
            ax, ay, bx, by, q = _sides(du, dv, du_down, dv_down, height, width)
        for i in range(NUMBERS[q, 0], NUMBERS[q, 0] + NUMBERS[q, 1]):
            s, t, share = real(TAPS[q, i, 0]), real(TAPS[q, i, 1]), real(TAPS[q, i, 2])
            px, py = x + s * ax + t * bx, y + s * ay + t * by
            a, b, c, d, fx, fy = _found(px, py, rows, columns, first, wrap_u, wrap_v, nearest)
            upper, lower = share * (one - fy), share * fy
            for k in range(g.shape[1]):
                g_table[a, k] += upper * (one - fx) * g[n, k]
                g_table[b, k] += upper * fx * g[n, k]
                g_table[c, k] += lower * (one - fx) * g[n, k]
                g_table[d, k] += lower * fx * g[n, k]
