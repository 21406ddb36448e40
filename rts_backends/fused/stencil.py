"""Splatting onto plain targets, with all sources paired front to front: a 3 × 3 stencil, row by row of a tile.

`rows.py` tells what a tile, a plane and a slot are.
"""

from __future__ import annotations

import numpy as np

from rts_backends.fused.rows import (
    ONE,
    PITCH,
    RX,
    RY,
    SOURCE,
    SUM,
    SUMS,
    TILE,
    WX,
    WY,
    busy,
    compiled,
    composite,
    load,
    loop,
    normalised_sums,
    slot,
    store,
    tile,
)
from rts_backends.fused.uniform_cells import BUSY, FLAT, SETTLED

COLORS, ALPHA = (0,) * 5, (0,) * 2
"""Planes of a tangent to compute: all five (colours, weight), or alpha and the weight alone.

They are tuples, whose length the compiler knows."""

X, Y, TANGENT = (PITCH * p for p in (5, 6, 7))
"""Where planes X and Y begin in a tangent's slot, after five planes D, and the slot's length.

w (D + (u X + v Y) colour) is the tangent of a weighted colour."""


@compiled
def load_around(sources, loaded, grid, y, first, count):
    """Load the source rows y − 1, y and y + 1 that have no slot yet; return the first row loaded, or y + 2 for none.

    `sources` holds the slots (see `slot`): `count` cells from column `first` on, in all layers. `loaded` (3,), updated,
    names the row in each slot; for other columns, fill it with −9 before.
    """
    start = y + 2
    for v in range(y + 1, y - 2, -1):
        if loaded[(v + 3) % 3] != v:
            loaded[(v + 3) % 3], start = v, v
            for k in range(len(grid.row)):
                load(slot(sources, k, v, SOURCE), grid, k, v, first, count)
    return start


@loop
def forward(start, stop, grid, states, border, image):
    """Fill rows [start, stop) of the image (H, W, 4), the cells less a border `border` wide.

    Mixed targets get anything: other loops fill them afterwards.
    """
    rgba, row = grid.rgba, grid.row
    layers, (_, width, _) = len(row), image.shape
    sources, total = np.empty(3 * layers * SOURCE, image.dtype), np.empty(SUMS, image.dtype)
    loaded = np.empty(3, np.int64)
    for t in range((width + TILE - 1) // TILE):
        left, count = tile(width, t)
        loaded[:] = -9
        for y in range(start, stop):
            if busy(states, y + border, left + border, count, BUSY):
                at = left + border - 1
                load_around(sources, loaded, grid, y + border, at, count + 2)
                normalised_sums(total, sources, layers, y + border, count)
                composite(total, layers, count)
                store(image, y, left, total, count)
                most = SETTLED
            else:
                image[y, left : left + count] = image.dtype.type(0)
                most = FLAT
            if busy(states, y + border, left + border, count, SETTLED):
                at = left + border
                own = image[y, left : left + count]
                _copy(own, rgba, row[0, y + border, at : at + count], states[y + border, at : at + count], most)


@compiled
def _copy(image, rgba, cells, states, most):
    """Copy the colour of their cell's front to targets of states SETTLED to `most`: they lie amid one colour."""
    for x in range(len(image)):
        if SETTLED <= states[x] <= most:
            i = max(cells[x], 0)  # Without a sample any colour will do.
            image[x, 0], image[x, 1], image[x, 2], image[x, 3] = rgba[i, 0], rgba[i, 1], rgba[i, 2], rgba[i, 3]


@compiled
def add_adjoint(to, total, g, count):
    """Fill `to` with the gradient of a buffer's sums, from `g`, that of its normalised colours.

    The weight's is zero where the weight is below one.
    """
    zero, one = to.dtype.type(0), to.dtype.type(1)
    for j in range(count):
        weight = total[ONE + j]
        over = one / max(weight, one)
        dot = zero
        for c in range(4):
            dot += g[c * PITCH + j] * total[c * PITCH + j]
            to[c * PITCH + j] = g[c * PITCH + j] * over
        to[ONE + j] = zero if weight < one else -dot * over


@compiled
def adjoint_row(to, total, g, layers, count):
    """Fill `to` with the gradients of the buffers' sums in a row, from the image's in `g`, which is overwritten.

    There is one buffer for one layer, else two; `g` has room for as many.
    """
    one = to.dtype.type(1)
    if layers > 1:
        for j in range(count):
            through = one - total[3 * PITCH + j]
            dot = to.dtype.type(0)
            for c in range(4):
                dot += g[c * PITCH + j] * total[SUM + c * PITCH + j]
                g[SUM + c * PITCH + j] = g[c * PITCH + j] * through
            g[3 * PITCH + j] -= dot
        add_adjoint(to[SUM:], total[SUM:], g[SUM:], count)
    add_adjoint(to, total, g, count)


@compiled
def load_image(s, image, states, least, border, y, first, count):
    """Load `count` cells of an image as planes `s`; zero beyond it and at targets whose state is below `least`."""
    height, width, _ = image.shape
    within = 0 <= y - border < height
    for j in range(count):
        x = first + j
        if within and 0 <= x - border < width and states[y, x] >= least:
            for c in range(4):
                s[c * PITCH + j] = image[y - border, x - border, c]
        else:
            for c in range(4):
                s[c * PITCH + j] = s.dtype.type(0)


@compiled
def _any(planes, count):
    """True if any number of four planes is not zero."""
    some = False
    for c in range(4):
        for j in range(count):
            some |= planes[c * PITCH + j] != 0
    return some


@compiled
def gather(to, s, above, level, below, count):
    """Fill eight planes `to` with sums over the adjoints a (five planes) of nine targets around each source.

    Five planes get w a; then three get w, w u and w v times a · (colour, 1). Source j lies under target j + 1; `s` is
    its slot from the cell of j = 0.
    """
    zero = to.dtype.type(0)
    for j in range(count):
        up, mid, down = s[WY + j], s[WY + PITCH + j], s[WY + 2 * PITCH + j]
        left, center, right = s[WX + j], s[WX + PITCH + j], s[WX + 2 * PITCH + j]
        h, hx, hy = zero, zero, zero
        for c in range(5):
            p = c * PITCH + j
            a0, a1, a2 = up * above[p], up * above[p + 1], up * above[p + 2]
            b0, b1, b2 = down * below[p], down * below[p + 1], down * below[p + 2]
            m0 = left * (a0 + mid * level[p] + b0)
            m1 = center * (a1 + mid * level[p + 1] + b1)
            m2 = right * (a2 + mid * level[p + 2] + b2)
            to[p] = m0 + m1 + m2
            h += s[p] * (m0 + m1 + m2)
            hx += s[p] * (m2 - m0)
            hy += s[p] * (left * (b0 - a0) + center * (b1 - a1) + right * (b2 - a2))
        to[5 * PITCH + j], to[6 * PITCH + j], to[7 * PITCH + j] = h, hx, hy


@loop
def pull(start, stop, grid, states, border, g, g_positions, g_rgba):
    """Write the gradients of the samples of source rows [start, stop) by plain targets, from the image's `g` (H, W, 4).

    Each cell collects its own. Gradients hold zeros before: cells far from all that counts are skipped. `g_positions`
    (N, 3) gets x and y, `g_rgba` (N, 4) colours; one of no rows is not wanted.
    """
    row = grid.row
    layers, _, width = row.shape
    sources, total = np.empty(3 * layers * SOURCE, g.dtype), np.empty(SUMS, g.dtype)
    adjoints, given, gathered = np.empty(3 * SUMS, g.dtype), np.empty(SUMS, g.dtype), np.empty(8 * PITCH, g.dtype)
    loaded, active = np.empty(3, np.int64), np.empty(3, np.bool_)
    slope, least = g.dtype.type(2) * grid.scale * grid.gamma, FLAT if len(g_rgba) > 0 else BUSY
    for t in range((width + TILE - 1) // TILE):
        left, count = tile(width, t)
        loaded[:] = -9
        for y in range(start - 1, stop + 1):
            adjoint = slot(adjoints, 0, y, SUMS)
            some = busy(states, y, left - 1, count + 2, least)
            if some:
                load_image(given, g, states, least, border, y, left - 1, count + 2)
                some = _any(given, count + 2)
            active[(y + 3) % 3] = some
            if some:
                load_around(sources, loaded, grid, y, left - 2, count + 4)
                normalised_sums(total, sources, layers, y, count + 2)
                adjoint_row(adjoint, total, given, layers, count + 2)
            else:
                adjoint[:] = g.dtype.type(0)
            if y <= start or not active.any():
                continue
            for k in range(layers):
                b = SUM if k > 0 else 0
                above, level = slot(adjoints, 0, y - 2, SUMS)[b:], slot(adjoints, 0, y - 1, SUMS)[b:]
                s = slot(sources, k, y - 1, SOURCE)[2:]
                gather(gathered, s, above, level, adjoint[b:], count)
                scatter(g_positions, g_rgba, row[k, y - 1], left, gathered, s, slope, count)


@compiled
def scatter(g_positions, g_rgba, row, left, gathered, s, slope, count):
    """Write the sums `gathered` by a row of cells (see `gather`) to the gradients of their samples, in their place.

    `row` (W,) names the samples, or −1; `s` is the slot of the cells from column `left` on.
    """
    for j in range(count):
        i = row[left + j]
        if i >= 0:
            if len(g_rgba) > 0:
                for c in range(4):
                    g_rgba[i, c] = gathered[c * PITCH + j]
            if len(g_positions) > 0:
                h = gathered[5 * PITCH + j]
                g_positions[i, 0] = slope * (gathered[6 * PITCH + j] - s[RX + j] * h)
                g_positions[i, 1] = slope * (gathered[7 * PITCH + j] - s[RY + j] * h)


@compiled
def load_tangent(to, s, t_positions, t_rgba, row, k, y, first, count, slope, planes=COLORS):
    """Fill a tangent's slot `to`, from its source's slot `s` and the tangents of positions and colours; see `X`."""
    zero, lowest = to.dtype.type(0), 5 - len(planes)
    _, height, width = row.shape
    for j in range(count):
        x = first + j
        i = row[k, y, x] if 0 <= y < height and 0 <= x < width else -1
        move, tint = i >= 0 and len(t_positions) > 0, i >= 0 and len(t_rgba) > 0
        to[X + j] = slope * t_positions[i, 0] if move else zero
        to[Y + j] = slope * t_positions[i, 1] if move else zero
        for c in range(lowest, 4):
            to[c * PITCH + j] = t_rgba[i, c] if tint else zero
        to[4 * PITCH + j] = zero
    for j in range(count):
        along = s[RX + j] * to[X + j] + s[RY + j] * to[Y + j]
        for c in range(lowest, 5):
            to[c * PITCH + j] -= along * s[c * PITCH + j]


@compiled
def load_tangents(tangents, sources, loaded, grid, t_positions, t_rgba, y, first, count, planes=COLORS):
    """Fill the slots of source rows y − 1, y and y + 1 that are not loaded yet, as `load_around` does.

    Also fills their slots in `tangents` (T, ·), from tangents of positions (T, N, 3) and rgba (T, N, 4), either of
    which may have no samples, for zeros.
    """
    slope = sources.dtype.type(2) * grid.scale * grid.gamma
    for v in range(load_around(sources, loaded, grid, y, first, count), y + 2):
        for k in range(len(grid.row)):
            s = slot(sources, k, v, SOURCE)
            for n in range(len(tangents)):
                to = slot(tangents[n], k, v, TANGENT)
                load_tangent(to, s, t_positions[n], t_rgba[n], grid.row, k, v, first, count, slope, planes)


@compiled
def change_row(to, tangents, sources, total, layers, y, count, planes=COLORS):
    """Fill the first planes of `to` with the tangent of target row y, from slots of sources and of their tangents."""
    to[: min(layers, 2) * SUM] = to.dtype.type(0)
    for k in range(layers):
        for v in range(-1, 2):
            s, tangent = slot(sources, k, y - v, SOURCE), slot(tangents, k, y - v, TANGENT)
            add_tangent_row(to[SUM:] if k > 0 else to, s, tangent, v, count, planes)
    tangent_row(to, total, layers, count, planes)


@compiled
def add_tangent_row(to, s, tangent, v, count, planes=COLORS):
    """Add a source row's tangents to `to`, the tangents of a buffer's row: the derivative of `add_row`."""
    wy, dv = s[WY + (v + 1) * PITCH :], s.dtype.type(v)
    for j in range(count):
        w0, w1, w2 = s[WX + 2 * PITCH + j] * wy[j], s[WX + PITCH + j + 1] * wy[j + 1], s[WX + j + 2] * wy[j + 2]
        d0 = w0 * (dv * tangent[Y + j] + tangent[X + j])
        d1 = w1 * (dv * tangent[Y + j + 1])
        d2 = w2 * (dv * tangent[Y + j + 2] - tangent[X + j + 2])
        for c in range(5 - len(planes), 5):
            p = c * PITCH + j
            to[p] += (
                w0 * tangent[p] + w1 * tangent[p + 1] + w2 * tangent[p + 2] + d0 * s[p] + d1 * s[p + 1] + d2 * s[p + 2]
            )


@compiled
def tangent_row(to, total, layers, count, planes=COLORS):
    """Turn `to`, the tangents of both buffers' sums in a row, into that of the image, in the first planes."""
    zero, one, lowest = to.dtype.type(0), to.dtype.type(1), 5 - len(planes)
    for b in range(min(layers, 2)):
        d, s = to[b * SUM :], total[b * SUM :]
        for j in range(count):
            over = one / max(s[ONE + j], one)
            change = zero if s[ONE + j] < one else d[ONE + j]
            for c in range(lowest, 4):
                p = c * PITCH + j
                d[p] = (d[p] - change * s[p]) * over
    if layers > 1:
        for j in range(count):
            through, change = one - total[3 * PITCH + j], to[3 * PITCH + j]
            for c in range(lowest, 4):
                p = c * PITCH + j
                to[p] += through * to[SUM + p] - change * total[SUM + p]


@loop
def push(start, stop, grid, t_positions, t_rgba, states, border, out):
    """Fill rows [start, stop) of `out`, the tangents (T, H, W, 4). Tangents that are zeros may be absent: (T, 0, ·)."""
    layers, (many, _, width, _) = len(grid.row), out.shape
    sources, total, change = (
        np.empty(3 * layers * SOURCE, out.dtype),
        np.empty(SUMS, out.dtype),
        np.empty(SUMS, out.dtype),
    )
    tangents, loaded = np.empty((many, 3 * layers * TANGENT), out.dtype), np.empty(3, np.int64)
    least = FLAT if t_rgba.shape[1] > 0 else BUSY
    for t in range((width + TILE - 1) // TILE):
        left, count = tile(width, t)
        loaded[:] = -9
        for y in range(start, stop):
            if not busy(states, y + border, left + border, count, least):
                out[:, y, left : left + count] = out.dtype.type(0)
                continue
            at = y + border, left + border - 1, count + 2
            load_tangents(tangents, sources, loaded, grid, t_positions, t_rgba, *at)
            normalised_sums(total, sources, layers, y + border, count)
            for n in range(many):
                change_row(change, tangents[n], sources, total, layers, y + border, count)
                store(out[n], y, left, change, count)
