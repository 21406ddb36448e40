"""Rows of cells as planes of numbers in one flat array, at constant places: what the compiler makes vector code of.

A task owns a band of rows, and works through it in tiles of columns. Rows roll through three slots.
"""

import math
from functools import partial

import numpy as np
from numba import types
from numba.extending import overload

from rts.plugin_api import loops

TILE = 32
PITCH = TILE + 8
ONE, WX, WY, RX, RY, SOURCE = (PITCH * p for p in (4, 5, 8, 11, 12, 13))
"""Places in the slot of a source, after its colour: 1 if covered, weights by u and by v, offset from the centre."""
X, Y, TANGENT = (PITCH * p for p in (5, 6, 7))
"""Places in the slot of a tangent, after five planes D: w (D + (u X + v Y) colour) is that of a weighted colour."""
SUM = 5 * PITCH

compiled = partial(loops.compiled, fastmath={"contract"})

_F = [np.float32(1 / math.factorial(i)) for i in range(8)]
_ONE, _F2, _F3, _F4, _F5, _F6, _F7 = _F[1:]
_LOWEST, _LOG2E, _ROUND = np.float32(-87), np.float32(1 / math.log(2)), np.float32(1.5 * 2**23)
_LN2_HIGH, _LN2_LOW = np.float32(0.693359375), np.float32(math.log(2) - 0.693359375)
_MANTISSA, _BIAS = np.int32(23), np.int32(127 << 23)


def exp(x):
    """The exponential of a number of at most 0; in float32 by arithmetic alone, so that loops become vector code."""
    return math.exp(x)


@overload(exp)
def _exp(x):
    if x != types.float32:
        return lambda x: math.exp(x)

    def single(x):
        x = _LOWEST if x < _LOWEST else x
        shifted = np.float32(x * _LOG2E + _ROUND)  # Rounds to an integer, which is then in the lowest bits.
        n = shifted - _ROUND
        r = (x - n * _LN2_HIGH) - n * _LN2_LOW
        power = np.int32((shifted.view(np.int32) << _MANTISSA) + _BIAS)
        series = _F3 + r * (_F4 + r * (_F5 + r * (_F6 + r * _F7)))
        return (_ONE + r * (_ONE + r * (_F2 + r * series))) * power.view(np.float32)

    return single


@compiled
def slot(s, y, size):
    """The slot of row y ≥ −2; a view, so that the compiler knows that no index is negative."""
    start = (y + 3) % 3 * size
    return s[start : start + size]


@compiled
def covered(row, y, first, count):
    """True if any of the cells first, …, first + count − 1 of a row has a sample."""
    some, height, width = False, *row.shape
    if 0 <= y < height:
        for x in range(max(first, 0), min(first + count, width)):
            some |= row[y, x] >= 0
    return some


@compiled
def load(s, positions, rgba, row, y, first, count, scale, peak, gamma):
    """Fill a slot with cells first, … of a row."""
    width = row.shape[1]
    zero, half = s.dtype.type(0), s.dtype.type(0.5)
    for j in range(count):
        x = first + j
        i = row[y, x] if 0 <= x < width else -1
        if i >= 0:
            s[RX + j] = gamma * (positions[i, 0] - (s.dtype.type(x) + half))
            s[RY + j] = gamma * (positions[i, 1] - (s.dtype.type(y) + half))
            for c in range(4):
                s[c * PITCH + j] = rgba[i, c]
            s[ONE + j] = s.dtype.type(1)
        else:
            s[RX + j] = s[RY + j] = zero
            for c in range(5):
                s[c * PITCH + j] = zero
    for axis in range(2):
        for u in range(3):
            for j in range(count):
                d = s.dtype.type(u - 1) - s[RX + axis * PITCH + j]
                s[WX + (3 * axis + u) * PITCH + j] = peak * exp(-(d * d) * scale)


@compiled
def add_row(to, s, v, count):
    """Add what a row gives to the sums of the row at v from it; target j lies over source j + 1."""
    wy = s[WY + (v + 1) * PITCH :]
    for j in range(count):
        w0, w1, w2 = s[WX + 2 * PITCH + j] * wy[j], s[WX + PITCH + j + 1] * wy[j + 1], s[WX + j + 2] * wy[j + 2]
        for c in range(5):
            p = c * PITCH + j
            to[p] += w0 * s[p] + w1 * s[p + 1] + w2 * s[p + 2]


@compiled
def normalised(total, sources, filled, y, count):
    """Row y: colours over the weight, taken as at least one, and the weight."""
    one = total.dtype.type(1)
    total[:] = total.dtype.type(0)
    for v in range(-1, 2):
        if filled[(y - v + 3) % 3]:
            add_row(total, slot(sources, y - v, SOURCE), v, count)
    for j in range(count):
        over = one / max(total[ONE + j], one)
        for c in range(4):
            total[c * PITCH + j] *= over


@compiled
def load_tangent(to, s, t_positions, t_rgba, row, y, first, count, slope):
    """Fill the slot of a tangent beside that of its source, which is filled."""
    zero, width = to.dtype.type(0), row.shape[1]
    for j in range(count):
        x = first + j
        i = row[y, x] if 0 <= x < width else -1
        move, tint = i >= 0 and len(t_positions) > 0, i >= 0 and len(t_rgba) > 0
        to[X + j] = slope * t_positions[i, 0] if move else zero
        to[Y + j] = slope * t_positions[i, 1] if move else zero
        for c in range(4):
            to[c * PITCH + j] = t_rgba[i, c] if tint else zero
        to[4 * PITCH + j] = zero
    for j in range(count):
        along = s[RX + j] * to[X + j] + s[RY + j] * to[Y + j]
        for c in range(5):
            to[c * PITCH + j] -= along * s[c * PITCH + j]


@compiled
def add_tangent_row(to, s, d, v, count):
    """The tangent of `add_row`."""
    wy, dv = s[WY + (v + 1) * PITCH :], s.dtype.type(v)
    for j in range(count):
        w0, w1, w2 = s[WX + 2 * PITCH + j] * wy[j], s[WX + PITCH + j + 1] * wy[j + 1], s[WX + j + 2] * wy[j + 2]
        d0, d1 = w0 * (dv * d[Y + j] + d[X + j]), w1 * (dv * d[Y + j + 1])
        d2 = w2 * (dv * d[Y + j + 2] - d[X + j + 2])
        for c in range(5):
            p = c * PITCH + j
            to[p] += w0 * d[p] + w1 * d[p + 1] + w2 * d[p + 2] + d0 * s[p] + d1 * s[p + 1] + d2 * s[p + 2]


@compiled
def tangent(change, total, sources, tangents, filled, y, count):
    """The tangent of `normalised`, of which `total` is the result."""
    zero, one = change.dtype.type(0), change.dtype.type(1)
    change[:] = zero
    for v in range(-1, 2):
        if filled[(y - v + 3) % 3]:
            add_tangent_row(change, slot(sources, y - v, SOURCE), slot(tangents, y - v, TANGENT), v, count)
    for j in range(count):
        over, grows = one / max(total[ONE + j], one), zero if total[ONE + j] < one else change[ONE + j]
        for c in range(4):
            p = c * PITCH + j
            change[p] = (change[p] - grows * total[p]) * over


@compiled
def gather(to, s, above, level, below, count):
    """Sums of w, w u and w v over nine targets' adjoints; source j lies under target j + 1."""
    zero = to.dtype.type(0)
    for j in range(count):
        up, mid, down = s[WY + j], s[WY + PITCH + j], s[WY + 2 * PITCH + j]
        left, center, right = s[WX + j], s[WX + PITCH + j], s[WX + 2 * PITCH + j]
        h, hx, hy = zero, zero, zero
        for c in range(5):
            p = c * PITCH + j
            a0, a1, a2 = up * above[p], up * above[p + 1], up * above[p + 2]
            b0, b1, b2 = down * below[p], down * below[p + 1], down * below[p + 2]
            m0, m1 = left * (a0 + mid * level[p] + b0), center * (a1 + mid * level[p + 1] + b1)
            m2 = right * (a2 + mid * level[p + 2] + b2)
            to[p] = m0 + m1 + m2
            h += s[p] * (m0 + m1 + m2)
            hx += s[p] * (m2 - m0)
            hy += s[p] * (left * (b0 - a0) + center * (b1 - a1) + right * (b2 - a2))
        to[5 * PITCH + j], to[6 * PITCH + j], to[7 * PITCH + j] = h, hx, hy
