"""Normals of bicubic patches, and their derivatives: compiled loops. This module imports numba."""

from __future__ import annotations

import numpy as np

from rts.plugin_api.threads import parallel
from rts_surfaces.patches.bicubic_loops import SHARES, bernstein, compiled, control_nets, loop, scatter, share_range


def normals(
    collapsed: float, rows: np.ndarray, params: np.ndarray, patch: np.ndarray, table: np.ndarray, out: np.ndarray
) -> None:
    """Fill `out` (N, 3) with unit normals; a tangent below the share `collapsed` of the other counts as zero.

    A normal that does not exist is zero.
    """
    arguments = control_nets(rows, table), patch, params, rows.dtype.type(collapsed)
    parallel(_fill_normals, len(out), *arguments, out, work=60 * len(out))


def push_normals(
    collapsed: float, rows: np.ndarray, params: np.ndarray, patch: np.ndarray, table: np.ndarray, *moved: np.ndarray
) -> None:
    """Fill the second of `moved`, (N, 3), with the derivatives of normals along the first, (V, 3), tangents of rows."""
    tangents, out = moved
    arguments = control_nets(rows, table), control_nets(tangents, table), patch, params, rows.dtype.type(collapsed)
    parallel(_move_normals, len(out), *arguments, out, work=120 * len(out))


def pull_normals(
    collapsed: float,
    rows: np.ndarray,
    params: np.ndarray,
    patch: np.ndarray,
    table: np.ndarray,
    g: np.ndarray,
    result: np.ndarray,
) -> None:
    """Add to `result` (V, 3), the gradient of the rows, from g (N, 3), the gradient of the normals."""
    nets = control_nets(rows, table)
    found = np.zeros((SHARES, *nets.shape), nets.dtype)
    arguments = nets, patch, params, rows.dtype.type(collapsed), g, found
    parallel(_pull_normal_shares, SHARES, *arguments, work=80 * len(g))
    scatter(table, found, result)


@compiled
def _tangents(net, u, v, collapsed, work):
    """Fill `work` (7, 4): weights along u, their derivatives; the same along v; tangents along u and v; mixed slope.

    `net` (16, 3) are the control points. The last three rows of `work` are vectors in its first three columns.

    Where one side of a patch is a single point, one tangent is zero, and beside it mostly rounding. The mixed slope,
    the second derivative in u and v, has the direction in which that tangent grows. It replaces a tangent shorter than
    the share `collapsed` of the other, times a sign.

    Returns:
        The signs for the tangents along u and along v; 0 for a tangent that stays.
    """
    a, da, b, db = work[0], work[1], work[2], work[3]
    bernstein(u, a, da)
    bernstein(v, b, db)
    zero, one, half = net.dtype.type(0), net.dtype.type(1), net.dtype.type(0.5)
    uu, vv = zero, zero
    for c in range(3):
        along_u, along_v, mixed = zero, zero, zero
        for i in range(4):
            value, slope = zero, zero
            for j in range(4):
                x = net[4 * i + j, c]
                value += b[j] * x
                slope += db[j] * x
            along_u += da[i] * value
            along_v += a[i] * slope
            mixed += da[i] * slope
        work[4, c], work[5, c], work[6, c] = along_u, along_v, mixed
        uu += along_u * along_u
        vv += along_v * along_v
    # Along a side v = 0 that is a point, the derivative in u is zero; along u = 0, that in v.
    sign_u, sign_v = zero, zero
    if uu < collapsed * collapsed * vv:
        sign_u = one if v < half else -one
        work[4] = sign_u * work[6]
    if vv < collapsed * collapsed * uu:
        sign_v = one if u < half else -one
        work[5] = sign_v * work[6]
    return sign_u, sign_v


@compiled
def _unit_product(work, normal):
    """Fill `normal` (3,) with the normalised cross product of rows 4 and 5 of `work`, the tangents; or with zero.

    Returns the length of the product, or 1 if that is zero.
    """
    for c in range(3):
        p, q = (c + 1) % 3, (c + 2) % 3
        normal[c] = work[4, p] * work[5, q] - work[4, q] * work[5, p]
    x, y, z = np.float64(normal[0]), np.float64(normal[1]), np.float64(normal[2])  # Squares beyond float32's range.
    square = x * x + y * y + z * z
    length = normal.dtype.type(np.sqrt(square) if square > 0 else square + 1)
    for c in range(3):
        normal[c] /= length
    return length


@loop
def _fill_normals(start, stop, nets, patch, params, collapsed, out):
    """Fill `out` (N, 3) with unit normals, or zero; `nets` (n, 16, 3), `collapsed` as in `normals`."""
    work = np.zeros((7, 4), nets.dtype)
    for n in range(start, stop):
        _tangents(nets[patch[n]], params[n, 0], params[n, 1], collapsed, work)
        _unit_product(work, out[n])


@loop
def _move_normals(start, stop, nets, tangents, patch, params, collapsed, out):
    """Fill `out` (N, 3) with the derivatives of unit normals along tangents (n, 16, 3) of control points."""
    work, moved, normal = np.zeros((7, 4), nets.dtype), np.zeros((7, 4), nets.dtype), np.empty(3, nets.dtype)
    for n in range(start, stop):
        u, v = params[n, 0], params[n, 1]
        sign_u, sign_v = _tangents(nets[patch[n]], u, v, collapsed, work)
        # The same choice of tangents as at the points themselves.
        _tangents(tangents[patch[n]], u, v, nets.dtype.type(0), moved)
        if sign_u != 0:
            moved[4] = sign_u * moved[6]
        if sign_v != 0:
            moved[5] = sign_v * moved[6]
        length = _unit_product(work, normal)
        along = nets.dtype.type(0)
        for c in range(3):
            p, q = (c + 1) % 3, (c + 2) % 3
            x = moved[4, p] * work[5, q] - moved[4, q] * work[5, p]
            x += work[4, p] * moved[5, q] - work[4, q] * moved[5, p]
            out[n, c] = x / length
            along += normal[c] * out[n, c]
        for c in range(3):
            out[n, c] -= along * normal[c]


@loop
def _pull_normal_shares(start, stop, nets, patch, params, collapsed, g, found):
    """Add to `found` (S, n, 16, 3) the gradients of control points from g (N, 3), that of normals.

    `start` and `stop` count shares, as in `_pull_shares`; `nets` (n, 16, 3), `collapsed` as in `normals`.
    """
    for share in range(start, stop):
        _pull_normals(*share_range(share, len(found), len(patch)), nets, patch, params, collapsed, g, found[share])


@compiled
def _pull_normals(start, stop, nets, patch, params, collapsed, g, found):
    work, normal, across = np.zeros((7, 4), nets.dtype), np.empty(3, nets.dtype), np.empty(3, nets.dtype)
    to_first, to_second = np.empty(3, nets.dtype), np.empty(3, nets.dtype)
    for n in range(start, stop):
        if g[n, 0] == 0 and g[n, 1] == 0 and g[n, 2] == 0:
            continue
        sign_u, sign_v = _tangents(nets[patch[n]], params[n, 0], params[n, 1], collapsed, work)
        length = _unit_product(work, normal)
        along = g[n, 0] * normal[0] + g[n, 1] * normal[1] + g[n, 2] * normal[2]
        for c in range(3):
            across[c] = (g[n, c] - along * normal[c]) / length
        for c in range(3):
            p, q = (c + 1) % 3, (c + 2) % 3
            to_first[c] = work[5, p] * across[q] - work[5, q] * across[p]
            to_second[c] = across[p] * work[4, q] - across[q] * work[4, p]
        a, da, b, db, to = work[0], work[1], work[2], work[3], found[patch[n]]
        for i in range(4):
            for j in range(4):
                mixed = da[i] * db[j]
                w = da[i] * b[j] if sign_u == 0 else sign_u * mixed
                x = a[i] * db[j] if sign_v == 0 else sign_v * mixed
                for c in range(3):
                    to[4 * i + j, c] += w * to_first[c] + x * to_second[c]
