"""Rows of cells and of buffers as planes of numbers, for the splatting of plain targets, which are not mixed.

A task owns a band of rows and works through it in tiles of columns. A row of a tile is kept as planes of `PITCH`
numbers in one flat array. The planes' places are constants: so the compiler sees that they do not overlap, and uses
vector instructions. Source rows roll through three slots; a target row is finished when the source row below it has
been read.

There are one or two buffers: the surface, which takes the front layers, and, if `row` has more layers, the one behind
it, which takes all the others.

Helpers are not cached on disk, only the loops that call them (see `rts_backends.triangles`): after a change here,
touch the files of the loops.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import types
from numba.extending import overload

from rts.plugin_api import loops
from rts_backends.fused.uniform_cells import FLAT

TILE = 32
PITCH = TILE + 8
"""A plane holds a row of a tile, and up to two cells more at each end."""

COLOR, ONE, WX, WY, RX, RY, SOURCE = (PITCH * p for p in (0, 4, 5, 8, 11, 12, 13))
"""Where planes begin in a source's slot: colour, 1 if covered, weights by u and by v, offset from the cell's centre.
SOURCE is the slot's length."""

SUM, SUMS = 5 * PITCH, 10 * PITCH
"""Length of one buffer's sums, and of two buffers': colours and the weight."""

compiled = partial(loops.compiled, fastmath={"contract"})
loop = partial(loops.loop, fastmath={"contract"})

_F = [np.float32(1 / math.factorial(i)) for i in range(8)]
_ONE, _F2, _F3, _F4, _F5, _F6, _F7 = _F[1:]
_LOWEST, _LOG2E, _ROUND = np.float32(-87), np.float32(1 / math.log(2)), np.float32(1.5 * 2**23)
_LN2_HIGH, _LN2_LOW = np.float32(0.693359375), np.float32(math.log(2) - 0.693359375)
_MANTISSA, _BIAS = np.int32(23), np.int32(127 << 23)


def exp(x):
    """The exponential of a number of at most 0.

    Compiled, in float32, it is arithmetic alone, so that loops become vector code; numbers below −87 count as −87.
    """
    return math.exp(x)


@overload(exp)
def _exp(x):
    if x != types.float32:
        return lambda x: math.exp(x)

    def single(x):
        x = _LOWEST if x < _LOWEST else x
        # Adding 1.5 · 2²³ rounds to an integer, which is then found in the lowest bits.
        shifted = np.float32(x * _LOG2E + _ROUND)
        n = shifted - _ROUND
        r = (x - n * _LN2_HIGH) - n * _LN2_LOW
        power = np.int32((shifted.view(np.int32) << _MANTISSA) + _BIAS)
        series = _F3 + r * (_F4 + r * (_F5 + r * (_F6 + r * _F7)))
        return (_ONE + r * (_ONE + r * (_F2 + r * series))) * power.view(np.float32)

    return single


class Grid(NamedTuple):
    """Samples in their cells and a splatter's numbers, in the form that loops take; all floats have one dtype.

    Attributes:
        positions: (N, 3).
        rgba: (N, 4).
        row: (K, H, W) int32, the sample of each cell, or −1.
        scale: the factor of squared distances in the exponent.
        peak: the largest weight along one axis.
        gamma: the calibration, a factor of offsets from cells' centres.
    """

    positions: np.ndarray
    rgba: np.ndarray
    row: np.ndarray
    scale: float
    peak: float
    gamma: float


# Helpers get views, so that the compiler knows that no index is negative: that would count from the end.


@compiled
def slot(s, k, y, size):
    """A view of the `size` numbers of `s` that hold row y ≥ −2 of layer k; rows y and y + 3 share a slot."""
    start = (3 * k + (y + 3) % 3) * size
    return s[start : start + size]


@compiled
def tile(width, t):
    """First column and number of columns of tile t of a row of `width` cells."""
    count = (width + TILE - 1) // TILE
    return width * t // count, width * (t + 1) // count - width * t // count


@compiled
def busy(states, y, first, count, least):
    """True if any of `count` targets of row y, from `first` on, has at least the state `least`."""
    height, width = states.shape
    if not 0 <= y < height:
        return False
    most = np.uint8(0)
    for state in states[y, max(first, 0) : min(first + count, width)]:
        most = max(most, state)
    return most >= least


@compiled
def load(s, grid, k, y, first, count):
    """Fill a source's slot `s` with cells first, …, first + count − 1 of row y of layer k.

    Cells outside of the grid are empty. Empty cells get zeros for colour and ONE, but weights like any other, unless
    the whole row is empty.
    """
    positions, rgba, row, scale, peak, gamma = grid
    zero, half = s.dtype.type(0), s.dtype.type(0.5)
    _, height, width = row.shape
    filled = False
    for j in range(count):
        x = first + j
        i = row[k, y, x] if 0 <= y < height and 0 <= x < width else -1
        if i >= 0:
            filled = True
            s[RX + j] = gamma * (positions[i, 0] - (s.dtype.type(x) + half))
            s[RY + j] = gamma * (positions[i, 1] - (s.dtype.type(y) + half))
            for c in range(4):
                s[c * PITCH + j] = rgba[i, c]
            s[ONE + j] = s.dtype.type(1)
        else:
            s[RX + j] = s[RY + j] = zero
            for c in range(5):
                s[c * PITCH + j] = zero
    if not filled:
        s[WX:RX] = zero
        return
    for axis in range(2):
        for u in range(3):
            for j in range(count):
                d = s.dtype.type(u - 1) - s[RX + axis * PITCH + j]
                s[WX + (3 * axis + u) * PITCH + j] = peak * exp(-(d * d) * scale)


@compiled
def add_row(to, s, v, count):
    """Add a source row's splats to a buffer's row, v rows farther on; target j lies over source j + 1."""
    wy = s[WY + (v + 1) * PITCH :]
    for j in range(count):
        w0, w1, w2 = s[WX + 2 * PITCH + j] * wy[j], s[WX + PITCH + j + 1] * wy[j + 1], s[WX + j + 2] * wy[j + 2]
        for c in range(5):
            p = c * PITCH + j
            to[p] += w0 * s[p] + w1 * s[p + 1] + w2 * s[p + 2]


@compiled
def normalised_sums(total, sources, layers, y, count):
    """Fill `total` with the sums of target row y: colours over the weight, taken as at least one; and the weight.

    There is one buffer for one layer, else two. `sources` hold rows y − 1 to y + 1 of all layers.
    """
    one = total.dtype.type(1)
    total[: min(layers, 2) * SUM] = total.dtype.type(0)
    for k in range(layers):
        for v in range(-1, 2):
            add_row(total[SUM:] if k > 0 else total, slot(sources, k, y - v, SOURCE), v, count)
    for b in range(min(layers, 2)):
        s = total[b * SUM :]
        for j in range(count):
            over = one / max(s[ONE + j], one)
            for c in range(4):
                s[c * PITCH + j] *= over


@compiled
def composite(total, layers, count):
    """Composite the surface over the buffer behind, in `total`, in place of the surface's colours.

    With a single layer `total` stays as it is.
    """
    one = total.dtype.type(1)
    if layers > 1:
        for j in range(count):
            through = one - total[3 * PITCH + j]
            for c in range(4):
                total[c * PITCH + j] += through * total[SUM + c * PITCH + j]


@compiled
def fill(s, rgba, cells, states, left, count):
    """Fill four planes `s` of a row without BUSY targets: the colours of FLAT targets, and zeros at others.

    `cells` and `states` are rows of the grid: the front's sample, and the state, of `count` targets from `left` on.
    """
    for j in range(count):
        for c in range(4):
            s[c * PITCH + j] = rgba[cells[left + j], c] if states[left + j] == FLAT else s.dtype.type(0)


@compiled
def store(image, y, left, s, count):
    """Write the four planes of colour of s to `count` cells of row y of an image, from column `left` on."""
    for j in range(count):
        for c in range(4):
            image[y, left + j, c] = s[c * PITCH + j]
