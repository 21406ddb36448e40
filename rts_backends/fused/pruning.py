"""Hidden samples that can reach the image: `rts.splatting.Kernel.needed`, compiled."""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts.plugin_api.splats import Visible
from rts.plugin_api.threads import parallel
from rts_backends.fused import crossing_pairs
from rts_backends.fused.cells import Settings

HALO = 3
"""Rows on either side that a row's samples depend on: a row's marks depend on neighbours, and these on theirs."""

UNSIGNED = np.int32(0x7FFFFFFF)
"""All bits of a float32 but the sign's."""

MIXED, RING = 1, 2
"""Marks of targets whose colour may depend on hidden layers, and of cells beside empty ones."""


def needed(covered: np.ndarray, depth: np.ndarray, settings: Settings) -> np.ndarray:
    """Marks (K, H, W) of the samples that `Visible` or `Multi` needs, from covered (K, H, W) bool and depth (K, H, W).

    They are `covered` itself for a single layer, and for `Multi` with too small an epsilon.
    """
    layers, height, _ = covered.shape
    visible, rims = settings.kind == "visible", settings.rims
    if layers == 1 or not (visible or settings.epsilon >= Visible.LEAST_EPSILON):
        return covered
    covered, depth = np.ascontiguousarray(covered), np.ascontiguousarray(depth)
    kept, kind = np.empty_like(covered), depth.dtype.type
    least, largest = _extremes(covered, depth)
    numbers = kind(2 * (largest - least)), kind(Visible.TIE * max(largest, -least)), kind(Visible.CONTINUED)
    parallel(_keep, height, covered, depth, visible, rims, *numbers, kept, work=2 * covered.size)
    if settings.crossings:
        least, largest = _extremes(covered[:1], depth[:1])
        crossing_pairs.sheets(covered, depth, largest - least, kept)
    return kept


def _extremes(covered: np.ndarray, depth: np.ndarray) -> tuple[np.floating, np.floating]:
    """The least and the largest of the covered depths and zero; no covered depth may be NaN."""
    if depth.dtype != np.float32:
        return depth.min(initial=0, where=covered), depth.max(initial=0, where=covered)
    lines = depth.shape[0] * depth.shape[1]
    bits, extremes = depth.reshape(lines, -1).view(np.int32), np.zeros((lines, 2), np.int32)
    parallel(_find_extremes, lines, bits, covered.reshape(lines, -1), extremes, work=depth.size // 12)
    low, high = extremes.max(axis=0, initial=0).view(np.float32)
    return -low, high


@loop
def _find_extremes(start, stop, bits, covered, extremes):
    """Fill `extremes` (lines, 2) with the largest amounts of each line's floats below and above zero, as bits.

    The bits of a negative float are a negative integer. Maxima of integers become vector code, those of floats do not.
    """
    zero = np.int32(0)
    for i in range(start, stop):
        low, high = zero, zero
        line, taken = bits[i], covered[i]
        for x in range(len(line)):
            number = line[x] if taken[x] else zero
            high = np.int32(max(high, number))
            low = np.int32(max(low, np.int32(number & UNSIGNED) if number < zero else zero))
        extremes[i, 0], extremes[i, 1] = low, high


@loop
def _keep(start, stop, covered, depth, visible, rims, beyond, margin, continued, kept):
    """Fill `kept` in rows [start, stop): True for fronts, and for hidden layers around marks.

    Around marks MIXED all hidden layers are kept, around RING alone the second layer.

    Args:
        start: first row.
        stop: end of the rows.
        covered: (K, H, W) bool.
        depth: (K, H, W), read where covered.
        visible: True for the splatter `Visible`, False for `Multi`.
        rims: True to set marks RING, too.
        beyond: a depth that stands for layers that are not covered.
        margin: difference of depths that rounding may cause.
        continued: `Visible.CONTINUED`.
        kept: (K, H, W) bool, to be filled.
    """
    layers, height, width = covered.shape
    # From row start − HALO on: depths with a border, NaN where there is nothing; least and largest front, least hidden.
    rows = stop - start + 2 * HALO
    z = np.full((layers, rows, width + 2), np.nan, depth.dtype)
    bounds = np.empty((rows, 3, width), depth.dtype)
    marks, empty = np.zeros((rows, width + 2), np.uint8), np.zeros((rows, width + 2), np.uint8)
    for r in range(rows):
        y = start - HALO + r
        if 0 <= y < height:
            for k in range(layers):
                _load(z[k, r], covered[k, y], depth[k, y])
            for x in range(width):
                empty[r, x + 1] = np.uint8(not covered[0, y, x])
        _bound(bounds[r, 0], bounds[r, 1], bounds[r, 2], z[0, r], z[1, r])
    for r in range(HALO - 1, rows - HALO + 1):
        _mark(marks[r, 1:], z, r, bounds, visible, beyond, margin, continued)
        if rims:
            _mark_ring(marks[r, 1:-1], empty[r - 1], empty[r], empty[r + 1])
    for y in range(start, stop):
        r = y - start + HALO
        for x in range(width):
            kept[0, y, x] = covered[0, y, x]
        for k in range(1, layers):
            which = np.uint8(MIXED | RING if k == 1 else MIXED)
            _spread(kept[k, y], covered[k, y], which, marks[r - 1], marks[r], marks[r + 1])


@compiled
def _load(z, covered, depth):
    nothing = z.dtype.type(np.nan)
    for x in range(len(covered)):
        z[x + 1] = depth[x] if covered[x] else nothing


@compiled
def _bound(least, largest, hidden, front, second):
    """Fill `least` and `largest` (W,) with the least and largest front of each cell and its two neighbours in the row.

    Fill `hidden` (W,) with the least depth of their second layers. Depths `front` and `second` (W + 2,) have a border
    cell at each end, and NaN for none. Where all are NaN, `least` and `hidden` are infinite, `largest` −infinite.
    """
    infinity = least.dtype.type(np.inf)
    for x in range(len(least)):
        a, b, c = front[x], front[x + 1], front[x + 2]
        # Comparisons with NaN are false.
        low = a if a < infinity else infinity
        high = a if a > -infinity else -infinity
        low, high = b if b < low else low, b if b > high else high
        least[x], largest[x] = c if c < low else low, c if c > high else high
        a, b, c = second[x], second[x + 1], second[x + 2]
        low = a if a < infinity else infinity
        low = b if b < low else low
        hidden[x] = c if c < low else low


@compiled
def _mark(marks, z, r, bounds, visible, beyond, margin, continued):
    """Fill `marks`: 1, that is MIXED, at targets of row r whose colour may depend on hidden layers; 0 at others.

    `z` (K, ·, W + 2) are depths and `bounds` (·, 3, W) the arrays of `_bound`, in a window of rows.
    """
    width = z.shape[2] - 2
    above, level, below = bounds[r - 1], bounds[r], bounds[r + 1]
    least, largest = (above[0], level[0], below[0]), (above[1], level[1], below[1])
    _suspect(marks, z[0, r, 1:], *least, *largest, above[2], level[2], below[2], margin)
    for x in range(width):
        if visible and not marks[x]:
            continue
        target, near = z[0, r, x + 1], marks[x] and _near(z, r, x, margin)
        if visible:
            marks[x] = near and not _continued(z, r, x, beyond, margin, continued)
        else:
            empty = target != target
            for n in range(9):
                source = z[0, r - 1 + n // 3, x + n % 3]
                empty |= source != source
            marks[x] = near or empty


# Rows are passed one by one: so the compiler sees that they do not overlap.


@compiled
def _suspect(marks, front, least0, least1, least2, largest0, largest1, largest2, hidden0, hidden1, hidden2, margin):
    """Fill `marks`: 0 at empty targets, and where hidden layers lie farther behind fronts than these lie apart; else 1.

    Few targets are marked. The depths of `_bound` are those of the rows above (0), at (1) and below (2) the targets'.
    """
    for x in range(len(least0)):
        a, b, c = least0[x], least1[x], least2[x]
        least = b if b < a else a
        least = c if c < least else least
        a, b, c = largest0[x], largest1[x], largest2[x]
        largest = b if b > a else a
        largest = c if c > largest else largest
        a, b, c = hidden0[x], hidden1[x], hidden2[x]
        hidden = b if b < a else a
        hidden = c if c < hidden else hidden
        far = hidden - largest > largest - least + margin + margin
        marks[x] = np.uint8((front[x] == front[x]) & (not far))


@compiled
def _near(z, r, x, margin):
    """True if a hidden layer pairs with some source about as near as the fronts do; comparisons with NaN are false."""
    target = z[0, r, x + 1]
    for n in range(9):
        source = z[0, r - 1 + n // 3, x + n % 3]
        d = abs(source - target) + margin
        for k in range(1, len(z)):
            if abs(z[k, r - 1 + n // 3, x + n % 3] - target) <= d or abs(z[k, r, x + 1] - source) <= d:
                return True
    return False


@compiled
def _continued(z, r, x, beyond, margin, continued):
    """True if every source's front that does not pair with the target's by depth alone lies on a line with it.

    Sources without a sample do not count. Depths `z` are a window of rows; `r` is the target's row in it.
    """
    layers, rows, width = z.shape
    target = z[0, r, x + 1]
    for n in range(9):
        v, u = n // 3 - 1, n % 3 - 1
        source = z[0, r - v, x + 1 - u]
        if source != source:
            continue
        front, hidden = abs(source - target), z.dtype.type(np.inf)
        for k in range(1, layers):
            p, q = z[k, r - v, x + 1 - u], z[k, r, x + 1]
            hidden = min(hidden, abs((p if p == p else beyond) - target), abs((q if q == q else beyond) - source))
        if front + margin < hidden:
            continue
        limit, joined = continued * min(front, hidden) - margin, False
        for steps, end, start in ((-1, source, target), (2, target, source)):
            by, bx = r - steps * v, x + 1 - steps * u
            if 0 <= by < rows and 0 <= bx < width:
                joined |= abs(end - (start + start - z[0, by, bx])) < limit
        if not joined:
            return False
    return True


@compiled
def _mark_ring(marks, above, level, below):
    """Add RING to the marks of the covered cells of a row that lie beside empty ones."""
    for x in range(len(marks)):
        around = above[x] | above[x + 1] | above[x + 2] | level[x] | level[x + 2]
        if (around | below[x] | below[x + 1] | below[x + 2]) > level[x + 1]:
            marks[x] |= RING


@compiled
def _spread(kept, covered, which, above, level, below):
    """Fill `kept` (W,): covered cells with a mark out of `which` on them or beside them."""
    for x in range(len(kept)):
        around = above[x] | above[x + 1] | above[x + 2] | level[x] | level[x + 1] | level[x + 2]
        kept[x] = covered[x] & (((around | below[x] | below[x + 1] | below[x + 2]) & which) != 0)
