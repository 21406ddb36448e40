"""Targets of translucent layers whose nine sources pair layer by layer: most targets, without plans.

Layer by layer, all sources are at the level of the target. So nothing lies in front of a level or in a gap, and the
image is I = S + (W − A) · I' at each level (sums S of colours, W of weights, A of alpha; I' is the next level's image),
see `rts.splatting.stacks`. Each layer is splatted by a stencil of its own, in rows of tiles as in `stencil.py`.
"""

from __future__ import annotations

import numpy as np

from rts_backends.fused.rows import ONE, PITCH, RX, RY, SOURCE, SUM, TILE, add_row, compiled, loop, slot, tile
from rts_backends.fused.stencil import TANGENT, add_tangent_row, gather, load_around, load_image, load_tangents

IMAGE = 4 * PITCH
"""Length of the planes of an image's row."""


@loop
def find(start, stop, positions, row, ends, crossed, marks, straight, counts):
    """Move the marks of straight targets of rows [start, stop) from `marks` to `straight`.

    A target is straight if its sources have c or c − 1 layers, and if no layer of a source is nearer to the target's
    layers before or behind the one of its number. No outline or line of crossing may be beside it, and it is not in the
    outermost rows and columns.

    Args:
        start: first row.
        stop: end of the rows.
        positions: (N, 3) of samples.
        row: (K, H, W), the sample of each cell, in order of depth.
        ends: (H, W) of `uniform_cells.survey`, 0 where no outline ends; or no rows.
        crossed: (H, W) uint8, 1 beside lines of crossing; or no rows.
        marks: (H, W) uint8, targets; straight ones are cleared.
        straight: (H, W) uint8, to be filled with the number of layers of straight targets, 0 at others.
        counts: (H,), to be filled with the number of marks left.
    """
    layers, height, width = row.shape
    depths, levels = np.empty((3, layers + 1, width), positions.dtype), np.zeros((3, width), np.int32)
    for y in range(start - 1, stop + 1):
        if 0 <= y < height:
            _load(depths[(y + 3) % 3], levels[(y + 3) % 3], positions, row, y)
        if y <= start:
            continue
        own, at = straight[y - 1], (y + 2) % 3
        own[:] = 0
        if 0 < y - 1 < height - 1:
            own[1 : width - 1] = marks[y - 1, 1 : width - 1]
            if len(ends) > 0:
                _keep_zeros(own, ends[y - 1])
            if len(crossed) > 0:
                _keep_zeros(own, crossed[y - 1])
            _keep_even(own, levels[0], levels[1], levels[2])
            most = levels[at].max()
            for v in range(3):
                for k in range(most - 1):
                    here, there = depths[at], depths[v]
                    _keep_regular(own, here[k], here[k + 1], there[k], there[k + 1])
        counts[y - 1] = 0
        for x in range(width):
            marks[y - 1, x] ^= own[x]
            counts[y - 1] += marks[y - 1, x]
        if 0 < y - 1 < height - 1:
            _count(own, levels[0], levels[1], levels[2])


@compiled
def _load(depths, levels, positions, row, y):
    """Fill the first K lines of `depths` (K + 1, W), of row y: infinity where there is no layer.

    Also fills `levels` (W,), the number of layers.
    """
    levels[:] = 0
    for k in range(len(row)):
        for x in range(len(levels)):
            i = row[k, y, x]
            levels[x] += i >= 0
            depths[k, x] = positions[i, 2] if i >= 0 else depths.dtype.type(np.inf)


@compiled
def _keep_zeros(own, marks):
    for x in range(len(own)):
        own[x] &= np.uint8(marks[x] == 0)


@compiled
def _keep_even(own, above, level, below):
    """Clear in `own` the targets whose nine sources differ by more than one layer."""
    for x in range(1, len(own) - 1):
        least = most = level[x]
        for u in range(-1, 2):
            a, b, c = above[x + u], level[x + u], below[x + u]
            least, most = min(least, a, b, c), max(most, a, b, c)
        own[x] &= np.uint8(most - least <= 1)


@compiled
def _count(own, above, level, below):
    """Multiply the marks `own` by the number of layers, the largest of nine sources."""
    for x in range(1, len(own) - 1):
        most = 0
        for u in range(-1, 2):
            most = max(most, above[x + u], level[x + u], below[x + u])
        own[x] *= np.uint8(most)


@compiled
def _keep_regular(own, depth, behind, source, source_behind):
    """Keep in `own` the targets whose layer k pairs with layer k, not k + 1, of each of three sources in a row.

    Layers k of target and source have depths `depth` and `source`; `behind` and `source_behind` are those of layers k +
    1. An infinite depth makes a distance infinite or NaN, which no other exceeds.
    """
    for x in range(1, len(own) - 1):
        irregular = False
        for u in range(3):
            distance = abs(source[x + u - 1] - depth[x])
            irregular |= distance > abs(source_behind[x + u - 1] - depth[x])
            irregular |= distance > abs(behind[x] - source[x + u - 1])
        own[x] &= np.uint8(not irregular)


# ---------------------------------------------------------------------------------------------- value, derivatives


@compiled
def _depth(straight, y, first, count):
    """The largest number of layers of `count` targets of row y, from `first` on; 0 if none is straight."""
    height, width = straight.shape
    most = np.uint8(0)
    if 0 <= y < height:
        for number in straight[y, max(first, 0) : min(first + count, width)]:
            most = max(most, number)
    return np.int64(most)


@compiled
def _sums(total, images, sources, layers, y, count):
    """Fill `total`, the sums of each of `layers` layers in row y: colours over the weight, and the weight.

    Also fills `images`, those from each layer on, and zeros behind the last. `sources` hold rows y − 1 to y + 1.
    """
    one = total.dtype.type(1)
    images[layers * IMAGE : (layers + 1) * IMAGE] = total.dtype.type(0)
    for k in range(layers - 1, -1, -1):
        s, image, behind = total[k * SUM : (k + 1) * SUM], images[k * IMAGE :], images[(k + 1) * IMAGE :]
        s[:] = total.dtype.type(0)
        for v in range(-1, 2):
            add_row(s, slot(sources, k, y - v, SOURCE), v, count)
        for j in range(count):
            over = one / max(s[ONE + j], one)
            for c in range(4):
                s[c * PITCH + j] *= over
            through = min(s[ONE + j], one) - s[3 * PITCH + j]
            for c in range(4):
                image[c * PITCH + j] = s[c * PITCH + j] + through * behind[c * PITCH + j]


@compiled
def _store(image, marks, left, planes, count):
    """Write planes of colour to the marked targets among `count` of a row, from column `left` on."""
    for j in range(count):
        if marks[j]:
            for c in range(4):
                image[left + j, c] = planes[c * PITCH + j]


@loop
def forward(start, stop, grid, straight, border, image):
    """Fill the straight targets of rows [start, stop) of the image (H, W, 4), which lacks the border of `straight`."""
    layers, width = len(grid.row), image.shape[1]
    sources, loaded = np.empty(3 * layers * SOURCE, image.dtype), np.empty(3, np.int64)
    total, images = np.empty(layers * SUM, image.dtype), np.empty((layers + 1) * IMAGE, image.dtype)
    for t in range((width + TILE - 1) // TILE):
        left, count = tile(width, t)
        at = left + border
        loaded[:] = -9
        for y in range(start + border, stop + border):
            most = _depth(straight, y, at, count)
            if most > 0:
                load_around(sources, loaded, grid, y, at - 1, count + 2)
                _sums(total, images, sources, most, y, count)
                _store(image[y - border], straight[y, at : at + count], left, images, count)


@compiled
def _adjoints(to, total, images, own, layers, y, count):
    """Fill the slots of row y in `to` with the gradients of the sums before normalisation, for `layers` layers.

    `own` are planes of the image's gradient, which are overwritten; `total` and `images` are those of `_sums`.
    """
    zero, one = own.dtype.type(0), own.dtype.type(1)
    for k in range(layers):
        a, s, behind = slot(to, k, y, SUM), total[k * SUM : (k + 1) * SUM], images[(k + 1) * IMAGE :]
        for j in range(count):
            weight, alpha, through, dot = s[ONE + j], s[3 * PITCH + j], zero, zero
            over = one / max(weight, one)
            for c in range(4):
                p = c * PITCH + j
                through += own[p] * behind[p]
                dot += own[p] * s[p]
                a[p] = over * own[p]
                own[p] *= min(weight, one) - alpha
            a[3 * PITCH + j] -= over * through
            a[ONE + j] = -(dot - through * alpha) * over if weight >= one else through


@loop
def pull(start, stop, grid, straight, border, g, g_positions, g_rgba):
    """Add to the gradients of the samples of source rows [start, stop), from `g` (H, W, 4), the image's gradient.

    Straight targets alone count. `g_positions` (N, 3) gets x and y, `g_rgba` (N, 4) colours; one of no rows is not
    wanted.
    """
    layers, _, width = grid.row.shape
    sources, loaded = np.empty(3 * layers * SOURCE, g.dtype), np.empty(3, np.int64)
    total, images = np.empty(layers * SUM, g.dtype), np.empty((layers + 1) * IMAGE, g.dtype)
    adjoints, own, gathered = (
        np.empty(3 * layers * SUM, g.dtype),
        np.empty(IMAGE, g.dtype),
        np.empty(8 * PITCH, g.dtype),
    )
    depths, slope = np.zeros(3, np.int64), g.dtype.type(2) * grid.scale * grid.gamma
    for t in range((width + TILE - 1) // TILE):
        left, count = tile(width, t)
        loaded[:] = -9
        for y in range(start - 1, stop + 1):
            most = _depth(straight, y, left - 1, count + 2)
            depths[(y + 3) % 3] = most
            if most > 0:
                load_image(own, g, straight, 1, border, y, left - 1, count + 2)
                load_around(sources, loaded, grid, y, left - 2, count + 4)
                _sums(total, images, sources, most, y, count + 2)
                _adjoints(adjoints, total, images, own, most, y, count + 2)
            for k in range(most, layers):
                slot(adjoints, k, y, SUM)[:] = g.dtype.type(0)
            for k in range(depths.max() if y > start else 0):
                s = slot(sources, k, y - 1, SOURCE)[2:]
                above, level = slot(adjoints, k, y - 2, SUM), slot(adjoints, k, y - 1, SUM)
                gather(gathered, s, above, level, slot(adjoints, k, y, SUM), count)
                _scatter(g_positions, g_rgba, grid.row[k, y - 1], left, gathered, s, slope, count)


@compiled
def _scatter(g_positions, g_rgba, row, left, gathered, s, slope, count):
    """Add the sums `gathered` by a row of cells (see `gather`) to the gradients of their samples.

    `row` (W,) names the samples, or −1; `s` is the slot of the cells from column `left` on.
    """
    for j in range(count):
        i = row[left + j]
        if i >= 0:
            if len(g_rgba) > 0:
                for c in range(4):
                    g_rgba[i, c] += gathered[c * PITCH + j]
            if len(g_positions) > 0:
                h = gathered[5 * PITCH + j]
                g_positions[i, 0] += slope * (gathered[6 * PITCH + j] - s[RX + j] * h)
                g_positions[i, 1] += slope * (gathered[7 * PITCH + j] - s[RY + j] * h)


@compiled
def _change(grown, change, tangent, sources, total, images, layers, y, count):
    """Fill `grown`, planes of the tangent of row y of the image, from the slots of sources and of their tangents.

    `total` and `images` are those of `_sums`; `change` is working memory.
    """
    zero, one = grown.dtype.type(0), grown.dtype.type(1)
    grown[:] = zero
    for k in range(layers - 1, -1, -1):
        s, behind = total[k * SUM : (k + 1) * SUM], images[(k + 1) * IMAGE :]
        change[:] = zero
        for v in range(-1, 2):
            add_tangent_row(change, slot(sources, k, y - v, SOURCE), slot(tangent, k, y - v, TANGENT), v, count)
        for j in range(count):
            weight, alpha, more = s[ONE + j], s[3 * PITCH + j], change[ONE + j]
            covered, scaled = (zero, more) if weight >= one else (more, zero)
            over = one / max(weight, one)
            hidden = (change[3 * PITCH + j] - scaled * alpha) * over
            for c in range(4):
                p = c * PITCH + j
                through = (covered - hidden) * behind[p] + (min(weight, one) - alpha) * grown[p]
                grown[p] = (change[p] - scaled * s[p]) * over + through


@loop
def push(start, stop, grid, t_positions, t_rgba, straight, border, out):
    """Fill the straight targets of rows [start, stop) of the tangents `out` (T, H, W, 4), which lack the border.

    Tangents of positions (T, N, 3) and rgba (T, N, 4) may have no samples: then they are zeros.
    """
    layers, (many, _, width, _) = len(grid.row), out.shape
    sources, loaded = np.empty(3 * layers * SOURCE, out.dtype), np.empty(3, np.int64)
    total, images = np.empty(layers * SUM, out.dtype), np.empty((layers + 1) * IMAGE, out.dtype)
    tangents, change = np.empty((many, 3 * layers * TANGENT), out.dtype), np.empty(SUM, out.dtype)
    grown = np.empty(IMAGE, out.dtype)
    for t in range((width + TILE - 1) // TILE):
        left, count = tile(width, t)
        at = left + border
        loaded[:] = -9
        for y in range(start + border, stop + border):
            most = _depth(straight, y, at, count)
            if most > 0:
                load_tangents(tangents, sources, loaded, grid, t_positions, t_rgba, y, at - 1, count + 2)
                _sums(total, images, sources, most, y, count)
                for n in range(many):
                    _change(grown, change, tangents[n], sources, total, images, most, y, count)
                    _store(out[n, y - border], straight[y, at : at + count], left, grown, count)
