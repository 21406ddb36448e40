"""The side of their surface that fragments show, compiled."""

from __future__ import annotations

import numpy as np

from rts.compiling.loops import compiled, loop
from rts.sampling.windows_loops import add, spread


@loop
def fill(start, stop, kept, triangle_ids, vertices, faces, pieces, eyes, rows, columns, listed, more, found):
    """Fill lines [start, stop) of `found` with pieces and sides; see `rts.sampling.facing`.

    Args:
        start: first line.
        stop: end of the lines.
        kept: (K, H, W) bool, the fragments that are samples; others get 0.
        triangle_ids: (K, H, W) int32.
        vertices: (V, 3) float32.
        faces: (T, 3) int32.
        pieces: (T,) int16; or (1,), one for all triangles.
        eyes: (B, 4), the point that the rays of each view come from; see `facing.eye`.
        rows: lines of a view. Views lie side by side, line after line.
        columns: columns of a view.
        listed: True to ask for all cells, not only those beside hidden samples.
        more: `Cells.MORE_BEHIND`.
        found: (K, H, W) int16.
    """
    layers, height, width = kept.shape
    across = width // columns
    hidden, near = np.zeros((3, width + 2), np.uint8), np.empty(width, np.uint8)
    asked = np.empty(width, np.int32)
    for y in range(start - 1, stop + 1):
        level = hidden[(y + 3) % 3]
        level[:] = 0
        if 0 <= y < height:
            for k in range(1, layers):
                add(level[1:-1], kept[k, y])
        if y <= start:
            continue
        for k in range(layers):
            found[k, y - 1, :] = 0
        spread(near, hidden[(y + 1) % 3], hidden[(y + 2) % 3], level)
        for view in range(across):
            eye = eyes[(y - 1) // rows * across + view]
            count = 0
            for x in range(view * columns, (view + 1) * columns):  # Most cells are not asked for: a branch less each.
                asked[count] = x
                count += listed or near[x] > 0
            for x in asked[:count]:
                for k in range(layers):
                    t, beyond = np.uint32(triangle_ids[k, y - 1, x]), more if k == layers - 1 else 0
                    known = kept[k, y - 1, x] > 0
                    found[k, y - 1, x] = _side(t, vertices, faces, pieces, eye, beyond) if known else 0


@compiled
def _side(t, vertices, faces, pieces, eye, more):
    """The number of piece of triangle `t`, plus `more`; negative where its back is seen; 0 without a piece.

    For other arguments see `fill`.
    """
    piece = pieces[t] if len(pieces) > 1 else pieces[0]
    if piece > 0:
        piece += more
    return piece if _front(vertices, faces, t, eye) else -piece


@compiled
def _front(vertices, faces, t, eye):
    """True if triangle `t` is seen from its front, where its corners go round counter-clockwise. See `facing.eye`."""
    a, b, c = np.uint32(faces[t, 0]), np.uint32(faces[t, 1]), np.uint32(faces[t, 2])
    x, y, z = np.float64(vertices[a, 0]), np.float64(vertices[a, 1]), np.float64(vertices[a, 2])
    bx, by, bz = vertices[b, 0] - x, vertices[b, 1] - y, vertices[b, 2] - z
    cx, cy, cz = vertices[c, 0] - x, vertices[c, 1] - y, vertices[c, 2] - z
    ex, ey, ez = eye[0] - eye[3] * x, eye[1] - eye[3] * y, eye[2] - eye[3] * z
    return (by * cz - bz * cy) * ex + (bz * cx - bx * cz) * ey + (bx * cy - by * cx) * ez > 0
