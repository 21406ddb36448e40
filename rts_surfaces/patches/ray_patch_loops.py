"""Hits of rays with bicubic patches, compiled: Newton's method, which may cross the edges of patches.

Patches are in the form of powers, see `rts_surfaces.patches.bicubic_loops`. It imports numba.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rts_surfaces.patches.bicubic_loops import compiled, first, loop


class Joined(NamedTuple):
    """Patches, and which of them meet.

    Attributes:
        powers: (n, 3, 4, 4), the patches.
        bends: (n, 3), the result of `bounds`. Where they prove that a step ends near enough to the ray, the surface is
            not evaluated again.
        across: (n, 4) int32, the result of `sides_across` of `rts_surfaces.patches.bicubic_patches`.
        flips: (n, 4) bool, as in `rts_surfaces.patches.tiles.Tiles`.
    """

    powers: np.ndarray
    bends: np.ndarray
    across: np.ndarray
    flips: np.ndarray


@loop
def bounds(nets, out):
    """Fill `out` (n, 3) with upper bounds of the lengths of second derivatives in a patch: in u, in u and v, in v.

    `nets` (n, 4, 4, 3) are the patches' control points.
    """
    for n in range(len(nets)):
        out[n] = 0
        for i in range(4):
            for j in range(4):
                uu, uv, vv = _differences(nets[n], i, j)
                out[n, 0] = max(out[n, 0], 6 * math.sqrt(uu))
                out[n, 1] = max(out[n, 1], 9 * math.sqrt(uv))
                out[n, 2] = max(out[n, 2], 6 * math.sqrt(vv))


@compiled
def _differences(net, i, j):
    """Squared lengths of second differences that begin at control point (i, j): in u, in u and v, in v.

    0 for a difference that would leave the net.
    """
    uu, uv, vv = 0.0, 0.0, 0.0
    for c in range(3):
        if i < 2:
            uu += (net[i, j, c] - 2 * net[i + 1, j, c] + net[i + 2, j, c]) ** 2
        if j < 2:
            vv += (net[i, j, c] - 2 * net[i, j + 1, c] + net[i, j + 2, c]) ** 2
        if i < 3 and j < 3:
            uv += (net[i, j, c] - net[i + 1, j, c] - net[i, j + 1, c] + net[i + 1, j + 1, c]) ** 2
    return uu, uv, vv


@compiled
def _crossed(across, flips, patch, u, v, inside):
    """The patch across the side beyond which (u, v) lies farthest, and (u, v) in it, `inside` away from the side.

    The patch is −1, and (u, v) unchanged, if (u, v) lies within its patch or nothing lies beyond the side. `across` and
    `flips` (n, 4) are those of `Joined`.
    """
    side, most = 0, -v
    if u - 1 > most:
        side, most = 1, u - 1
    if v - 1 > most:
        side, most = 2, v - 1
    if -u > most:
        side, most = 3, -u
    other = across[patch, side]
    if most <= 0 or other < 0:
        return -1, u, v
    u, v = min(max(u, 0.0), 1.0), min(max(v, 0.0), 1.0)
    # Sides run around a patch.
    t = u if side == 0 else v if side == 1 else 1 - u if side == 2 else 1 - v
    to, to_side = other // 4, other % 4
    if flips[patch, side] != flips[to, to_side]:
        t = 1 - t
    if to_side == 0:
        return to, t, inside
    if to_side == 1:
        return to, 1 - inside, t
    if to_side == 2:
        return to, 1 - t, 1 - inside
    return to, inside, 1 - t


@loop
def meet(start, stop, patches, ids, params, row, depth, rays, limits):
    """Newton's method: move params so that points lie on their rays; see `LIMITS` in `rts_surfaces.patches.parametric`.

    If the method ends beyond the edge of a patch, it goes on in the patch across this edge: triangles may be off the
    surface by more than thin patches are wide.

    Args:
        start: first of the L lines of cells, those of all layers.
        stop: one after the last.
        patches: `Joined`.
        ids: (N, 1) int32, the patch of each sample; changed where the hit is on another patch.
        params: (N, 2) float32, the samples' start; changed, to 0 without a hit.
        row: (L, W) int32, the sample in each cell, −1 for none; becomes −1 where the sample's ray does not meet the
            surface.
        depth: (L, W) float32, to be filled with the depth of each hit, 0 where a ray does not meet the surface. Cells
            that have no sample at the start keep their number, which should be 0.
        rays: (N,) `Rays`, float64.
        limits: (5,): residual in pixels, largest number of steps on a patch, largest step in params, largest distance
            beyond the edge in params, how many edges may be crossed.
    """
    for y in range(start, stop):
        for x in range(row.shape[1]):
            n = row[y, x]
            if n < 0:
                continue
            met, z = _meet(n, patches, ids, params, rays, limits)
            row[y, x], depth[y, x] = n if met else -1, z
            if not met:
                params[n, 0], params[n, 1] = 0, 0


@compiled
def _meet(n, patches, ids, params, rays, limits):
    """Move the patch `ids` and the params of sample n until its point lies on its ray; arguments as for `meet`.

    Returns True and the depth; or False and 0 without a hit, with `ids` and params unchanged.
    """
    (powers, bends, across, flips), (origins, directions, spread) = patches, rays
    residual, steps, largest, beyond, crossings = limits[0], int(limits[1]), limits[2], limits[3], int(limits[4])
    patch, u, v = ids[n, 0], float(params[n, 0]), float(params[n, 1])
    dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
    square, step, crossed = dx * dx + dy * dy + dz * dz, 0, 0
    out_u, out_v = u, v
    while True:
        p, bound = powers[patch], bends[patch]
        sx, ax, bx = first(p[0], u, v)
        sy, ay, by = first(p[1], u, v)
        sz, az, bz = first(p[2], u, v)
        # From the point to the ray's origin.
        rx, ry, rz = origins[n, 0] - sx, origins[n, 1] - sy, origins[n, 2] - sz
        z = -(rx * dx + ry * dy + rz * dz) / square
        near = residual * abs(spread[0] + spread[1] * z)
        cx, cy, cz = ry * dz - rz * dy, rz * dx - rx * dz, rx * dy - ry * dx
        met = cx * cx + cy * cy + cz * cz <= near * near * square
        # Where the ray meets the tangent plane, by Cramer's rule.
        hx, hy, hz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
        determinant = ax * hx + ay * hy + az * hz
        scale = (ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz) * square
        ended = met or step == steps or not determinant * determinant > 1e-24 * scale
        if not ended:
            qx, qy, qz = ry * az - rz * ay, rz * ax - rx * az, rx * ay - ry * ax
            du = (rx * hx + ry * hy + rz * hz) / determinant
            dv = (dx * qx + dy * qy + dz * qz) / determinant
            size = max(abs(du), abs(dv))
            if size > largest:
                du, dv = du * largest / size, dv * largest / size
            else:
                off = bound[0] * du * du + 2 * bound[1] * abs(du * dv) + bound[2] * dv * dv
                if off <= 2 * near:
                    met, z = True, (bx * qx + by * qy + bz * qz) / determinant
            u, v, step = u + du, v + dv, step + 1
        if met and -beyond <= u <= 1 + beyond and -beyond <= v <= 1 + beyond:
            ids[n, 0], params[n, 0], params[n, 1] = patch, u, v
            return True, z
        if u < 0 or u > 1 or v < 0 or v > 1:
            out_u, out_v = u, v
        if met or ended:
            if crossed == crossings:
                return False, 0.0
            # Beside a fold the far side of the edge attracts: each time the start moves farther into the patch.
            patch, u, v = _crossed(across, flips, patch, out_u, out_v, min(beyond * 2.0**crossed, 0.5))
            if patch < 0:
                return False, 0.0
            step, crossed, out_u, out_v = 0, crossed + 1, u, v
        else:
            u, v = min(max(u, -0.25), 1.25), min(max(v, -0.25), 1.25)
