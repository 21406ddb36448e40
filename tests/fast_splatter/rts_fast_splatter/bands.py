"""Bands of rows: the loops that Python calls. They fill the image, its tangents, and the gradients of samples."""

from functools import partial

import numpy as np

from rts.plugin_api import loops

from .rows import (
    ONE,
    PITCH,
    RX,
    RY,
    SOURCE,
    SUM,
    TANGENT,
    TILE,
    compiled,
    covered,
    gather,
    load,
    load_tangent,
    normalised,
    slot,
    tangent,
)

loop = partial(loops.loop, fastmath={"contract"})


@compiled
def tile(width, t):
    """First column and number of columns of tile t."""
    count = (width + TILE - 1) // TILE
    return width * t // count, width * (t + 1) // count - width * t // count


@loop
def splat(start, stop, positions, rgba, row, scale, peak, gamma, border, t_positions, t_rgba, out):
    """Fill rows of out (T, H, W, 4), the cells without `border`: tangents, or with none (0, ·) the image (1, H, W, 4).

    Tangents of zeros may be absent: (T, 0, ·).
    """
    many, width, kind = len(t_positions), out.shape[2], out.dtype.type
    sources, total, filled = np.empty(3 * SOURCE, out.dtype), np.empty(SUM, out.dtype), np.empty(3, np.bool_)
    tangents, change, slope = (
        np.empty((many, 3 * TANGENT), out.dtype),
        np.empty(SUM, out.dtype),
        kind(2) * scale * gamma,
    )
    for t in range((width + TILE - 1) // TILE):
        left, count = tile(width, t)
        for y in range(start + border - 1, stop + border + 1):
            at = row, y, left + border - 1, count + 2
            filled[(y + 3) % 3] = covered(*at)
            if filled[(y + 3) % 3]:
                s = slot(sources, y, SOURCE)
                load(s, positions, rgba, *at, scale, peak, gamma)
                for n in range(many):
                    load_tangent(slot(tangents[n], y, TANGENT), s, t_positions[n], t_rgba[n], *at, slope)
            if y <= start + border:
                continue
            some = filled[0] | filled[1] | filled[2]
            if some:
                normalised(total, sources, filled, y - 1, count)
            for n in range(len(out)):
                if some and many > 0:
                    tangent(change, total, sources, tangents[n], filled, y - 1, count)
                planes = change if many > 0 else total
                for j in range(count):
                    for c in range(4):
                        out[n, y - 1 - border, left + j, c] = planes[c * PITCH + j] if some else kind(0)


@loop
def pull(start, stop, positions, rgba, row, scale, peak, gamma, border, g, g_positions, g_rgba):
    """Add to the gradients of the samples of rows of cells; each collects from its nine targets."""
    width, zero = row.shape[1], g.dtype.type(0)
    sources, total, filled = np.empty(3 * SOURCE, g.dtype), np.empty(SUM, g.dtype), np.empty(3, np.bool_)
    adjoints, given, gathered = np.empty(3 * SUM, g.dtype), np.empty(SUM, g.dtype), np.empty(8 * PITCH, g.dtype)
    active, slope = np.zeros(3, np.bool_), g.dtype.type(2) * scale * gamma
    for t in range((width + TILE - 1) // TILE):
        left, count = tile(width, t)
        for y in range(start - 1, stop + 1):
            for v in range(y + 1 if y >= start else y - 1, y + 2):
                at = row, v, left - 2, count + 4
                filled[(v + 3) % 3] = covered(*at)
                if filled[(v + 3) % 3]:
                    load(slot(sources, v, SOURCE), positions, rgba, *at, scale, peak, gamma)
            active[(y + 3) % 3] = False
            if not (filled[0] | filled[1] | filled[2]):
                continue
            adjoint = slot(adjoints, y, SUM)
            if load_gradient(given, g, border, y, left - 1, count + 2):
                active[(y + 3) % 3] = True
                normalised(total, sources, filled, y, count + 2)
                to_sums(adjoint, total, given, count + 2)
            else:
                adjoint[:] = zero
            if y > start and filled[(y + 2) % 3] and (active[0] | active[1] | active[2]):
                s = slot(sources, y - 1, SOURCE)[2:]
                gather(gathered, s, slot(adjoints, y - 2, SUM), slot(adjoints, y - 1, SUM), adjoint, count)
                scatter(g_positions, g_rgba, row[y - 1, left:], gathered, s, slope, count)


@compiled
def load_gradient(to, g, border, y, first, count):
    """Fill planes with the gradient of a row, zero beyond the image; returns whether any is not."""
    some, zero, left = False, to.dtype.type(0), max(first - border, 0)
    to[:ONE] = zero
    if not 0 <= y - border < g.shape[0]:
        return False
    inner = g[y - border, left : max(first - border + count, left)]
    planes = to[left + border - first :]
    for j in range(len(inner)):
        for c in range(4):
            planes[c * PITCH + j] = inner[j, c]
    for p in range(ONE):
        some |= to[p] != zero
    return some


@compiled
def to_sums(to, total, g, count):
    """Adjoints of the sums from those of the image; zero for the weight where it is below one."""
    zero, one = to.dtype.type(0), to.dtype.type(1)
    for j in range(count):
        weight, dot = total[ONE + j], zero
        over = one / max(weight, one)
        for c in range(4):
            dot += g[c * PITCH + j] * total[c * PITCH + j]
            to[c * PITCH + j] = g[c * PITCH + j] * over
        to[ONE + j] = zero if weight < one else -dot * over


@compiled
def scatter(g_positions, g_rgba, row, gathered, s, slope, count):
    """Hand what a row of cells has gathered to their samples."""
    for j in range(count):
        i = row[j]
        if i >= 0 and len(g_rgba) > 0:
            for c in range(4):
                g_rgba[i, c] += gathered[c * PITCH + j]
        if i >= 0 and len(g_positions) > 0:
            h = gathered[5 * PITCH + j]
            g_positions[i, 0] += slope * (gathered[6 * PITCH + j] - s[RX + j] * h)
            g_positions[i, 1] += slope * (gathered[7 * PITCH + j] - s[RY + j] * h)


@loop
def repeats(row, seen):
    """True if several cells refer to one sample; `seen` (N,) are zeros."""
    for y in range(row.shape[0]):
        for x in range(row.shape[1]):
            i = row[y, x]
            if i >= 0:
                if seen[i]:
                    return True
                seen[i] = True
    return False
