"""Which hidden samples can reach the image: `rts.splatting.Kernel.needed`, compiled."""

from __future__ import annotations

import numba
import numpy as np

from rts.splatting import CONTINUED, LEAST_EPSILON, TIE
from rts.threads import parallel

compiled = numba.njit(nogil=True)
kernel = numba.njit(nogil=True, cache=True)


def needed(covered: np.ndarray, depth: np.ndarray, visible: bool, epsilon: float) -> np.ndarray:
    """(K, H, W) bool of covered (K, H, W) bool and depth (K, H, W); for `Visible`, or for `Multi`."""
    layers, height, width = covered.shape
    if layers == 1 or not (visible or epsilon >= LEAST_EPSILON):
        return covered
    depth = np.ascontiguousarray(depth)
    z = np.empty((layers, height + 2, width + 2), depth.dtype)
    z[:, [0, -1]] = np.nan
    farthest = np.empty(height, z.dtype)
    parallel(_depths, height, covered, depth, z, farthest)
    margin, mixed, kept = TIE * farthest.max(), np.zeros((height + 2, width + 2), np.uint8), np.empty_like(covered)
    parallel(_mark, height, z, visible, 2 * farthest.max(), z.dtype.type(margin), z.dtype.type(CONTINUED), mixed)
    parallel(_spread, height, covered, mixed, kept)
    return kept


@kernel
def _depths(start, stop, covered, depth, z, farthest):
    """Depths into z (K, H + 2, W + 2), which is NaN where there is nothing; the largest size in each row."""
    layers, _, width = covered.shape
    for y in range(start, stop):
        most = z.dtype.type(0)
        for k in range(layers):
            z[k, y + 1, 0] = z[k, y + 1, width + 1] = np.nan
            for x in range(width):
                z[k, y + 1, x + 1] = depth[k, y, x] if covered[k, y, x] else np.nan
                if covered[k, y, x]:
                    most = max(most, abs(depth[k, y, x]))
        farthest[y] = most


@kernel
def _mark(start, stop, z, visible, beyond, margin, continued, mixed):
    """Mark targets, in `mixed` (H + 2, W + 2), at which more than front layers may count."""
    layers, _, width = z.shape
    width -= 2
    for y in range(start, stop):
        marks = mixed[y + 1, 1:-1]
        for k in range(1, layers):
            for n in range(9):
                at = n % 3
                _near(marks, z[0, y + n // 3, at:], z[k, y + n // 3, at:], z[0, y + 1, 1:], z[k, y + 1, 1:], margin)
        for x in range(width):
            covered = z[0, y + 1, x + 1] == z[0, y + 1, x + 1]
            if not visible and covered:
                for n in range(9):
                    marks[x] |= np.uint8(z[0, y + n // 3, x + n % 3] != z[0, y + n // 3, x + n % 3])
            elif visible and marks[x] and _continued(z, y, x, beyond, margin, continued):
                marks[x] = 0
            elif not visible:
                marks[x] = 1


@compiled
def _near(marks, source, source_hidden, target, target_hidden, margin):
    """Mark where a hidden layer is about as near as the fronts are; where there is nothing, NaN compares as false."""
    for x in range(len(marks)):
        d = abs(source[x] - target[x]) + margin
        nearer = (abs(source_hidden[x] - target[x]) <= d) | (abs(target_hidden[x] - source[x]) <= d)
        marks[x] |= np.uint8(nearer)


@compiled
def _continued(z, y, x, beyond, margin, continued):
    """Whether every source that is not nearest front to front continues the target's front along a line."""
    layers, height, width = z.shape
    target = z[0, y + 1, x + 1]
    for n in range(9):
        v, u = n // 3 - 1, n % 3 - 1
        source = z[0, y + 1 - v, x + 1 - u]
        if source != source:
            continue
        front, hidden = abs(source - target), z.dtype.type(np.inf)
        for k in range(1, layers):
            p, q = z[k, y + 1 - v, x + 1 - u], z[k, y + 1, x + 1]
            hidden = min(hidden, abs((p if p == p else beyond) - target), abs((q if q == q else beyond) - source))
        if front + margin < hidden:
            continue
        limit, joined = continued * min(front, hidden) - margin, False
        for steps, end, start in ((-1, source, target), (2, target, source)):
            by, bx = y + 1 - steps * v, x + 1 - steps * u
            if 0 <= by < height and 0 <= bx < width:
                joined |= abs(end - (start + start - z[0, by, bx])) < limit
        if not joined:
            return False
    return True


@kernel
def _spread(start, stop, covered, mixed, kept):
    """Keep fronts, and hidden layers in the neighbourhood of marks."""
    layers, _, width = covered.shape
    for y in range(start, stop):
        for x in range(width):
            kept[0, y, x] = covered[0, y, x]
            if layers > 1 and covered[1, y, x]:
                around = 0
                for n in range(9):
                    around |= mixed[y + n // 3, x + n % 3]
                for k in range(1, layers):
                    kept[k, y, x] = covered[k, y, x] and around != 0
            else:
                for k in range(1, layers):
                    kept[k, y, x] = covered[k, y, x]
