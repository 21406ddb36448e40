"""The choices of the splatters where layers of different surfaces meet.

A target is mixed where some source of it is not paired front to front. Few are, and each has a list of its own: for
every source and each of the buffers in front, at the surface and behind, a range of the source's layers.

Depths are compared in the dtype of the positions and in the order of `rts.splatting`, so that ties fall alike.
"""

from __future__ import annotations

import numba
import numpy as np

from rts_backends.fused_survey import EMPTY

compiled = numba.njit(nogil=True)
kernel = numba.njit(nogil=True, cache=True)


@kernel
def depths(start, stop, positions, row, z, farthest):
    """Linear depth into z (K, H + 2, W + 2), NaN where not covered; the largest size of each row's into `farthest`."""
    layers, _, width = row.shape
    z[:, start + 1 : stop + 1, 0] = z[:, start + 1 : stop + 1, width + 1] = np.nan
    for y in range(start, stop):
        most = z.dtype.type(0)
        for k in range(layers):
            for x in range(width):
                i = row[k, y, x]
                z[k, y + 1, x + 1] = positions[i, 2] if i >= 0 else np.nan
                if i >= 0:
                    most = max(most, abs(positions[i, 2]))
        farthest[y] = most


@kernel
def fill(start, stop, beyond, z):
    """Make the depth of uncovered layers `beyond`; where a cell has no layer it stays NaN, and pairs with nothing."""
    layers, _, width = z.shape
    covered = np.empty(width, np.bool_)
    for y in range(start + 1, stop + 1):
        covered[:] = False
        for k in range(layers):
            _cover(covered, z[k, y], z.dtype.type(beyond))
        for k in range(layers):
            _cover(covered, z[k, y], z.dtype.type(beyond))


@compiled
def _cover(covered, z, beyond):
    for x in range(len(z)):
        covered[x] |= z[x] == z[x]
        z[x] = beyond if covered[x] and z[x] != z[x] else z[x]


@kernel
def find(start, stop, row, visible, beyond, z, mixed, counts):
    """Mark mixed targets (H, W), and count those of each row."""
    layers, _, width = row.shape
    target = np.empty((layers, width), z.dtype)
    for y in range(start, stop):
        marks = mixed[y]
        marks[:] = 0
        for k in range(layers):
            for x in range(width):
                d = z[k, y + 1, x + 1]
                target[k, x] = d if d == d else beyond
        for k in range(1, layers):
            for n in range(9):
                _mark(marks, z[0, y + n // 3, n % 3 :], z[k, y + n // 3, n % 3 :], target[0], target[k])
        if visible:
            for x in range(width):
                if row[0, y, x] < 0:
                    marks[x] = 0
        counts[y] = marks.sum()


@compiled
def _mark(marks, front, hidden, target_front, target_hidden):
    """Mark targets where a hidden layer pairs nearer than the two fronts; comparisons with NaN are false."""
    for x in range(len(marks)):
        d = abs(front[x] - target_front[x])
        nearer = (abs(hidden[x] - target_front[x]) < d) | (abs(target_hidden[x] - front[x]) < d)
        marks[x] |= np.uint8(nearer)


@kernel
def choose(start, stop, row, visible, continued, beyond, z, mixed, offsets, columns, choices, states):
    """List each row's mixed targets: their columns (M,), and ranges of layers (M, 9, 3, 2) by source and buffer."""
    layers, _, width = row.shape
    target, shift = np.empty(layers, z.dtype), np.empty(9, np.int64)
    for y in range(start, stop):
        d = offsets[y]
        for x in range(width):
            if not mixed[y, x]:
                continue
            columns[d], states[y, x] = x, EMPTY
            choices[d] = 0
            for k in range(layers):
                depth = z[k, y + 1, x + 1]
                target[k] = depth if depth == depth else beyond
            for n in range(9):
                v, u = n // 3 - 1, n % 3 - 1
                shift[n], off = _pairing(z, y + 1 - v, x + 1 - u, target)
                if visible and shift[n] != 0 and _continues(z, row, y, x, u, v, continued * off):
                    shift[n] = 0
            if visible:
                _choose_visible(choices[d], shift, z, row, y, x, target)
            else:
                for n in range(9):
                    s = shift[n]
                    choices[d, n, 0, 1] = max(s, 0)
                    choices[d, n, 1, 0], choices[d, n, 1, 1] = max(s, 0), max(s + 1, 0)
                    choices[d, n, 2, 0], choices[d, n, 2, 1] = max(s + 1, 0), layers
            d += 1


@compiled
def _pairing(z, y, x, target):
    """The number s of `rts.splatting.Multi`, and what the depths that it pairs are off."""
    a, b = 0, 0
    best_a, best_b = abs(z[0, y, x] - target[0]), abs(target[0] - z[0, y, x])
    for k in range(1, len(target)):
        distance = abs(z[k, y, x] - target[0])
        if distance < best_a:
            best_a, a = distance, k
        distance = abs(target[k] - z[0, y, x])
        if distance < best_b:
            best_b, b = distance, k
    return (-b, best_b) if best_b < best_a else (a, best_a)


@compiled
def _continues(z, row, y, x, u, v, limit):
    """Whether the front of the source or of the target is nearer than a limit to where the other's line leads."""
    _, height, width = row.shape
    source, target = z[0, y + 1 - v, x + 1 - u], z[0, y + 1, x + 1]
    for steps, end, start in ((-1, source, target), (2, target, source)):
        by, bx = y - steps * v, x - steps * u
        if 0 <= by < height and 0 <= bx < width and row[0, by, bx] >= 0:
            if abs(end - (start + start - z[0, by + 1, bx + 1])) < limit:
                return True
    return False


@compiled
def _choose_visible(choice, shift, z, row, y, x, target):
    """Ranges of `rts.splatting.Visible` for a covered target."""
    layers, height, width = row.shape
    m = layers
    for n in range(9):
        py, px = y + 1 - n // 3, x + 1 - n % 3
        if shift[n] < 0 and 0 <= py < height and 0 <= px < width and row[0, py, px] >= 0:
            m = min(m, -shift[n])
    for n in range(9):
        s = shift[n]
        if s > 0:
            choice[n, 0, 1] = 1
        if s >= 0:
            choice[n, 1, 0], choice[n, 1, 1] = s, s + 1
        if m == layers:
            continue
        hidden, best = layers if s >= 0 else 0, z.dtype.type(np.inf)
        for k in range(s + 1 if s >= 0 else layers, layers):
            distance = abs(z[k, y + 2 - n // 3, x + 2 - n % 3] - target[m])
            if distance < best:
                best, hidden = distance, k
        if hidden < layers:
            choice[n, 2, 0], choice[n, 2, 1] = hidden, hidden + 1
