"""The second pass of the rasterizer: listed triangles drawn into the layers of pixels, a band of rows at a time.

Most innermost loops run over arrays of one short block (a row for each number, a column for each triangle) and have no
branches, so that they compile to vector instructions and no jump is mispredicted. Rare cases are handled last. Where
one layer is kept, wide triangles are drawn row by row.
"""

from __future__ import annotations

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts_backends.triangles import owns

BAND_ROWS = 16
"""Rows of pixels that a thread draws at a time."""

BLOCK = 256
"""Triangles of a block. For each block references to arrays are counted: larger ones hardly take less time."""

WIDE = 12
"""Columns of a triangle from which on its rows are drawn whole, where one layer is kept: below, collected hits cost
less."""

AT_ONCE = 8
"""Columns in a vector instruction: numbers for a few beyond the last cost less than one by one."""

LISTED = 8
"""Numbers listed for a triangle: its index, its three vertices, first and last column, first and last row of pixels."""

TILE = 16
"""Columns of a band whose farthest depth is kept, so that triangles behind are left out at once."""

NUMBERS = 18
"""Numbers computed for a triangle: coefficients (x, y, 1) of its three edge functions, positive inside; depths of its
corners; the corners' w + z of clip space; and their w − z."""


@loop
def draw(first, last, triangles, vertices, matrix, view_depth, size, fragments):
    """Fill the fragment arrays, ids and depths (K, H · W) and barycentrics (K, H · W, 2), in bands `turns[first:last]`.

    `triangles` holds the fields of a `TriangleList` of `selection`; `size` is (H, W).
    """
    triangle_ids, barycentrics, depths = fragments
    layers, (height, width) = len(triangle_ids), size
    nearest, farthest = np.empty((layers, BAND_ROWS * width)), np.empty(-(-width // TILE))
    keep, turns, offsets, items, rows = triangles
    geometry = rows, vertices, matrix, view_depth, keep
    for band in turns[first:last]:
        top, end = band * BAND_ROWS, min(height, (band + 1) * BAND_ROWS)
        start, stop = top * width, end * width
        nearest[:], triangle_ids[:, start:stop], barycentrics[:, start:stop] = np.inf, -1, 0
        layered = start, nearest, triangle_ids, barycentrics
        begin, middle, last_item = offsets[2 * band], offsets[2 * band + 1], offsets[2 * band + 2]
        farthest[:] = np.inf
        _draw(items[begin:middle], geometry, top, end, width, farthest, layered)
        # Of closed surfaces nothing more is seen.
        if middle < last_item:
            _farthest(nearest[-1, : (end - top) * width], width, farthest)
            _draw(items[middle:last_item], geometry, top, end, width, farthest, layered)
        for k in range(layers):
            _depths(depths[k, start:stop], nearest[k])


@compiled
def _depths(depths, nearest):
    """Copy `nearest` to `depths`, with 0 where `nearest` is infinite: in empty cells."""
    for i in range(len(depths)):
        depths[i] = nearest[i] if nearest[i] < np.inf else 0.0


@compiled
def _farthest(last, width, farthest):
    """Fill `farthest` with the largest depth of the last layer, `last` (rows · width,), in each `TILE` columns."""
    farthest[:] = 0.0
    for start in range(0, len(last), width):
        for i in range(width):
            farthest[i // TILE] = max(farthest[i // TILE], last[start + i])


@compiled
def _draw(items, geometry, top, end, width, farthest, layered):
    """Insert the triangles of a band, rows [top, end), `width` wide, into layers of cells.

    Args:
        items: indices of the triangles in `rows`.
        geometry: `TriangleList.rows`, vertices (V, 3), the matrix (4, 4) to homogeneous pixels, coefficients (4,) of
            depth, and `TriangleList.keep`.
        top: first row.
        end: end of the rows.
        width: columns of the image.
        farthest: (ceil(width / TILE),), depths in these columns behind which the layers have no room; else infinite.
        layered: the index of the band's first cell among M; `nearest`, depths (K, ·); ids (K, M); and barycentrics (K,
            M, 2). They hold the layers found so far, or empty ones.
    """
    rows, vertices, matrix, view_depth, keep = geometry
    entries, points = np.empty((LISTED, BLOCK), np.int32), np.empty((3, 3, BLOCK), vertices.dtype)
    numbers, clips, covers = np.empty((NUMBERS, BLOCK)), np.empty(BLOCK, np.bool_), np.empty(BLOCK, np.int32)
    first, nearest, triangle_ids, barycentrics = layered
    in_row, in_row_within = np.empty(width + AT_ONCE), np.empty((2, width + AT_ONCE), np.float32)
    most = 4 * BLOCK
    # Room for hits left from a row, four for each small triangle, and one more row.
    room = 2 * most + width
    hits = np.empty((room, 2), np.int32)
    met = np.empty(room, np.bool_), np.empty(room), np.empty((2, room), np.float32)
    drawn = top, np.uint32(width), entries, numbers, clips
    for start in range(0, len(items), BLOCK):
        block = items[start : start + BLOCK]
        _gather(block, rows, vertices, entries, points)
        _set_up(len(block), points, matrix, view_depth, keep, (top, end - 1), entries, numbers, clips)
        _leave_out(len(block), farthest, numbers, entries)
        _cover(len(block), entries, numbers, covers)
        count = 0
        for b in range(len(block)):
            i0, i1, j0, j1 = entries[4, b], entries[5, b], entries[6, b], entries[7, b]
            place = b * BAND_ROWS + j0 - top
            if (i1 - i0 < 2) & (j1 - j0 < 2):
                for n in range(4):
                    hits[count, 0], hits[count, 1] = place + (n >> 1), i0 + (n & 1)
                    count += (covers[b] >> n) & 1
                continue
            whole, n = len(nearest) == 1 and i1 - i0 >= WIDE - 1 and not clips[b], i1 - i0 + 1
            for j in range(j0, j1 + 1):
                y = j + 0.5
                ra, rb = numbers[1, b] * y + numbers[2, b], numbers[4, b] * y + numbers[5, b]
                rc = numbers[7, b] * y + numbers[8, b]
                if whole:
                    _row(b, numbers, i0, n, ra, rb, rc, in_row, in_row_within)
                    cell = (j - top) * width + i0
                    _put_row(entries[0, b], n, in_row, in_row_within, cell, first, nearest, triangle_ids, barycentrics)
                    continue
                for i in range(i0, i1 + 1):
                    x = i + 0.5
                    ea, eb, ec = numbers[0, b] * x + ra, numbers[3, b] * x + rb, numbers[6, b] * x + rc
                    hits[count, 0], hits[count, 1] = place, i
                    count += (ea >= 0) & (eb >= 0) & (ec >= 0)
                place += 1
                if count > most - 4:
                    _insert(hits[:count], met, drawn, layered)
                    count = 0
        _insert(hits[:count], met, drawn, layered)


@compiled
def _row(b, numbers, i0, count, ra, rb, rc, depths, within):
    """Fill in depths (count,) and first two barycentrics (2, count) of a triangle in a row; inf outside of it.

    Args:
        b: the triangle in its block; it needs no clipping.
        numbers: those of the block, see `_set_up`.
        i0: the first column.
        count: how many columns there are.
        ra: its first edge function at x = 0 in the row.
        rb: the second.
        rc: the third.
        depths: to fill; with `within`, `AT_ONCE` longer than the row.
        within: to fill.
    """
    xa, xb, xc = numbers[0, b], numbers[3, b], numbers[6, b]
    za, zb, zc = numbers[9, b], numbers[10, b], numbers[11, b]
    # As in `_covers`.
    oa, ob, oc = owns(xa, numbers[1, b]), owns(xb, numbers[4, b]), owns(xc, numbers[7, b])
    for n in range((count + AT_ONCE - 1) // AT_ONCE * AT_ONCE):
        x = np.float64(i0 + n) + 0.5
        ea, eb, ec = xa * x + ra, xb * x + rb, xc * x + rc
        total = ea + eb + ec
        covers = ((ea > 0) | ((ea == 0) & oa)) & ((eb > 0) | ((eb == 0) & ob)) & ((ec > 0) | ((ec == 0) & oc))
        scale, z = 1 / total, (ea * za + eb * zb + ec * zc) / total
        depths[n] = z if covers & (total > 0) else np.inf
        within[0, n], within[1, n] = ea * scale, eb * scale


@compiled
def _put_row(t, count, depths, within, place, first, nearest, triangle_ids, barycentrics):
    """Put what `_row` gave, of triangle t, into the one layer of cells from `place` on; see `_put`."""
    for n in range(count):
        z, cell = depths[n], place + n
        old = nearest[0, cell]
        # The same holds along most of a row, so that jumps are predicted.
        if z < old or (z == old and z < np.inf and t < triangle_ids[0, first + cell]):
            nearest[0, cell], triangle_ids[0, first + cell] = z, t
            barycentrics[0, first + cell, 0], barycentrics[0, first + cell, 1] = within[0, n], within[1, n]


# numba itself must inline these helpers: only with known lengths of rows do their loops become vector code.


@compiled(inline="always")
def _gather(block, rows, vertices, entries, points):
    """Fill the list entries (LISTED, BLOCK) and the corners `points` (3, 3, BLOCK), by corner and axis, of a block.

    The loops are so short that the processor overlaps their waits for memory.
    """
    for b in range(len(block)):
        for r in range(LISTED):
            entries[r, b] = rows[block[b], r]
    for b in range(len(block)):
        for c in range(3):
            v = np.uint32(entries[1 + c, b])
            for r in range(3):
                points[c, r, b] = vertices[v, r]


@compiled(inline="always")
def _set_up(count, points, m, view_depth, keep, band, entries, numbers, clips):
    """Compute the numbers (NUMBERS, BLOCK) of triangles, and mark in `clips` those that may need clipping.

    In `entries`, each triangle's rows of pixels are cut to the first and last of the `band`. A triangle of no area, or
    that is culled, keeps no rows.
    """
    (top, bottom), corners, signs = band, np.empty((3, 4, BLOCK)), np.empty(BLOCK)
    for c in range(3):
        for b in range(count):
            px, py, pz = points[c, 0, b], points[c, 1, b], points[c, 2, b]
            numbers[9 + c, b] = view_depth[0] * px + view_depth[1] * py + view_depth[2] * pz + view_depth[3]
            x, y, z = np.float64(px), np.float64(py), np.float64(pz)
            for r in range(4):
                corners[c, r, b] = m[r, 0] * x + m[r, 1] * y + m[r, 2] * z + m[r, 3]
            numbers[12 + c, b] = corners[c, 3, b] + corners[c, 2, b]
            numbers[15 + c, b] = corners[c, 3, b] - corners[c, 2, b]
    for b in range(count):
        ax, ay, aw = corners[0, 0, b], corners[0, 1, b], corners[0, 3, b]
        bx, by, bw = corners[1, 0, b], corners[1, 1, b], corners[1, 3, b]
        cx, cy, cw = corners[2, 0, b], corners[2, 1, b], corners[2, 3, b]
        area = ax * (by * cw - bw * cy) - ay * (bx * cw - bw * cx) + aw * (bx * cy - by * cx)
        signs[b] = 1.0 if area > 0 else -1.0
        drawn = (area * keep > 0) | ((keep == 0) & (area != 0))
        entries[6, b], entries[7, b] = max(entries[6, b], top), min(entries[7, b], bottom) if drawn else -1
        near = min(numbers[12, b], numbers[13, b], numbers[14, b])
        far = min(numbers[15, b], numbers[16, b], numbers[17, b])
        clips[b] = (near < 0) | (far < 0)
    for c in range(3):
        i, j = (c + 1) % 3, (c + 2) % 3
        for b in range(count):
            ax, ay, aw = corners[i, 0, b], corners[i, 1, b], corners[i, 3, b]
            bx, by, bw = corners[j, 0, b], corners[j, 1, b], corners[j, 3, b]
            numbers[3 * c, b] = signs[b] * (ay * bw - aw * by)
            numbers[3 * c + 1, b] = signs[b] * (aw * bx - ax * bw)
            numbers[3 * c + 2, b] = signs[b] * (ax * by - ay * bx)


@compiled
def _leave_out(count, farthest, numbers, entries):
    """Leave triangles of a block without rows that lie behind the depths `farthest` of all their columns."""
    for b in range(count):
        z = min(numbers[9, b], numbers[10, b], numbers[11, b])
        z -= 1e-12 * abs(z)  # Depths between corners are rounded.
        seen = False
        for n in range(entries[4, b] // TILE, entries[5, b] // TILE + 1):
            seen |= z <= farthest[n]
        if not seen:
            entries[7, b] = -1


@compiled(inline="always")
def _cover(count, entries, numbers, covers):
    """Fill `covers`: for each triangle four bits, set where it may cover a pixel of the first 2 × 2 of its box."""
    for b in range(count):
        bits = 0
        for n in range(4):
            i, j = entries[4, b] + (n & 1), entries[6, b] + (n >> 1)
            x, y = i + 0.5, j + 0.5
            ea = numbers[0, b] * x + (numbers[1, b] * y + numbers[2, b])
            eb = numbers[3, b] * x + (numbers[4, b] * y + numbers[5, b])
            ec = numbers[6, b] * x + (numbers[7, b] * y + numbers[8, b])
            bits |= ((i <= entries[5, b]) & (j <= entries[7, b]) & (ea >= 0) & (eb >= 0) & (ec >= 0)) << n
        covers[b] = bits


@compiled
def _insert(hits, met, drawn, layered):
    """Insert the hits that stand the exact test into the layers of cells.

    Args:
        hits: (n, 2): triangle in the block · BAND_ROWS + row in band, column.
        met: working memory for `_meet`.
        drawn: the band's first row; the image's width; and the block's `entries`, `numbers` and `clips`, see `_set_up`.
        layered: see `_draw`; changed in place.
    """
    top, width, entries, numbers, clips = drawn
    sure, depths, within = met
    first, nearest, triangle_ids, barycentrics = layered
    _meet(hits, np.uint32(top), numbers, clips, sure, depths, within)
    for h in range(len(hits)):
        place, i = np.uint32(hits[h, 0]), np.uint32(hits[h, 1])
        b, row = place // np.uint32(BAND_ROWS), place % np.uint32(BAND_ROWS)
        if sure[h] or _covers(b, i + 0.5, row + np.uint32(top) + 0.5, numbers, clips):
            place = row * width + i
            p, q, cell = within[0, h], within[1, h], place + np.uint32(first)
            _put(depths[h], entries[0, b], p, q, place, cell, nearest, triangle_ids, barycentrics)


@compiled
def _meet(hits, top, numbers, clips, sure, depths, within):
    """Fill each hit's depth (n,) and first two barycentrics `within` (2, n), and `sure`: True if it needs no test.

    The test is `_covers`, for hits on an edge or of triangles that may need clipping.
    """
    for h in range(len(hits)):
        place, x = np.uint32(hits[h, 0]), np.uint32(hits[h, 1]) + 0.5
        b, y = place // np.uint32(BAND_ROWS), place % np.uint32(BAND_ROWS) + top + 0.5
        ea = numbers[0, b] * x + (numbers[1, b] * y + numbers[2, b])
        eb = numbers[3, b] * x + (numbers[4, b] * y + numbers[5, b])
        ec = numbers[6, b] * x + (numbers[7, b] * y + numbers[8, b])
        total = ea + eb + ec
        scale = 1 / total
        depths[h] = (ea * numbers[9, b] + eb * numbers[10, b] + ec * numbers[11, b]) / total
        within[0, h], within[1, h] = ea * scale, eb * scale
        sure[h] = (ea > 0) & (eb > 0) & (ec > 0) & ~clips[b]


@compiled
def _covers(b, x, y, numbers, clips):
    """True if triangle b of a block covers a point (x, y), pixels, edges and clipping taken into account."""
    xa, ya, xb, yb, xc, yc = numbers[0, b], numbers[1, b], numbers[3, b], numbers[4, b], numbers[6, b], numbers[7, b]
    ea, eb, ec = (
        xa * x + (ya * y + numbers[2, b]),
        xb * x + (yb * y + numbers[5, b]),
        xc * x + (yc * y + numbers[8, b]),
    )
    # Top and left edges own the pixels exactly on them (y points down).
    lost = (ea == 0 and not owns(xa, ya)) or (eb == 0 and not owns(xb, yb)) or (ec == 0 and not owns(xc, yc))
    return not lost and ea + eb + ec > 0 and not (clips[b] and _outside(numbers, b, ea, eb, ec))


@compiled(inline="always")
def _put(z, t, p, q, place, cell, nearest, triangle_ids, barycentrics):
    """Put a hit into the layers of a cell, sorted by depth, then by the triangle's index; the farthest drops out.

    The hit has depth z, triangle t and barycentrics p, q. `place` is the cell's index in `nearest`, `cell` in the
    others.
    """
    moved, triangle = z, t
    for k in range(len(nearest)):
        old, old_t = nearest[k, place], triangle_ids[k, cell]
        old_p, old_q = barycentrics[k, cell, 0], barycentrics[k, cell, 1]
        before = z < old  # A branch would be mispredicted every other time.
        if z == old:  # Those seen from behind come last, not in the order of their indices.
            before = triangle < old_t
        nearest[k, place], triangle_ids[k, cell] = moved if before else old, t if before else old_t
        barycentrics[k, cell, 0], barycentrics[k, cell, 1] = p if before else old_p, q if before else old_q
        moved, t = old if before else moved, old_t if before else t
        p, q = old_p if before else p, old_q if before else q


@compiled
def _outside(numbers, b, ea, eb, ec):
    """True if the point with barycentrics in the ratio ea : eb : ec is nearer than the near or beyond the far plane."""
    near = ea * numbers[12, b] + eb * numbers[13, b] + ec * numbers[14, b]
    far = ea * numbers[15, b] + eb * numbers[16, b] + ec * numbers[17, b]
    return near < 0 or far < 0
