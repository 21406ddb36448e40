"""Bicubic patches on the host, compiled: points, values and gradients.

Patches come in two forms. *Powers* (n, 3, 4, 4) float64 are the coefficients of uⁱvʲ of each coordinate, for geometry
without derivatives. A *table* (n, 16) names rows of Bézier control points, first along u, then along v, for values that
are differentiated. It imports numba.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from rts.plugin_api import loops
from rts.plugin_api.threads import parallel

compiled = partial(loops.compiled, fastmath={"contract"})
loop = partial(loops.loop, fastmath={"contract"})

SHARES = 4
"""Number of parts into which samples are divided; the gradients of each part are added up separately. The number is
fixed, so that sums do not depend on how many threads there are."""
BEZIER = np.array([[1.0, 0, 0, 0], [-3, 3, 0, 0], [3, -6, 3, 0], [-1, 3, -3, 1]])
"""Coefficients of 1, t, t², t³ (rows) from Bézier control points (columns)."""


def powers(nets: np.ndarray) -> np.ndarray:
    """The powers (n, 3, 4, 4) of patches of Bézier control points (n, 4, 4, 3), first along u, then along v."""
    return np.ascontiguousarray(BEZIER @ nets.transpose(0, 3, 1, 2) @ BEZIER.T)


@compiled
def _cubic(a, t):
    return a[0] + t * (a[1] + t * (a[2] + t * a[3]))


@compiled
def _slope(a, t):
    return a[1] + t * (2 * a[2] + 3 * t * a[3])


@compiled
def first(p, u, v):
    """A coordinate of a patch with powers `p` (4, 4), and its derivatives in u and in v, at (u, v)."""
    a, b, c, d = _cubic(p[0], v), _cubic(p[1], v), _cubic(p[2], v), _cubic(p[3], v)
    along_v = _slope(p[0], v) + u * (_slope(p[1], v) + u * (_slope(p[2], v) + u * _slope(p[3], v)))
    return a + u * (b + u * (c + u * d)), b + u * (2 * c + 3 * u * d), along_v


@compiled
def _second(p, u, v):
    """The second derivatives at (u, v) of a coordinate with powers `p` (4, 4): in u, in u and v, in v."""
    uu = 2 * _cubic(p[2], v) + 6 * u * _cubic(p[3], v)
    uv = _slope(p[1], v) + u * (2 * _slope(p[2], v) + 3 * u * _slope(p[3], v))
    a, b, c, d = 2 * p[0, 2], 2 * p[1, 2], 2 * p[2, 2], 2 * p[3, 2]
    a, b, c, d = a + 6 * v * p[0, 3], b + 6 * v * p[1, 3], c + 6 * v * p[2, 3], d + 6 * v * p[3, 3]
    return uu, uv, a + u * (b + u * (c + u * d))


@loop
def points(start, stop, powers, patch, params, out):
    """Fill rows `start` to before `stop` of `out` (N, 1, 3): points of patches (N,) at params (N, 2)."""
    for n in range(start, stop):
        for c in range(3):
            out[n, 0, c] = first(powers[patch[n], c], params[n, 0], params[n, 1])[0]


@loop
def expansions(start, stop, powers, patch, params, out):
    """As `points`, but `out` is (N, 6, 3): the point, and its derivatives in u, v, uu, uv, vv."""
    for n in range(start, stop):
        p, u, v, to = powers[patch[n]], params[n, 0], params[n, 1], out[n]
        for c in range(3):
            to[0, c], to[1, c], to[2, c] = first(p[c], u, v)
            to[3, c], to[4, c], to[5, c] = _second(p[c], u, v)


# ------------------------------------------------------------------------------------- values and gradients


def values(rows: np.ndarray, params: np.ndarray, patch: np.ndarray, table: np.ndarray, out: np.ndarray) -> None:
    """Fill `out` (N, C) with values of patches (N,) at params (N, 2).

    The control points of each patch are the 16 rows of `rows` (V, C) that its row of `table` (n, 16) names.
    """
    parallel(_sum_values, len(out), _nets(rows, table), patch, params, out, work=30 * len(out))


def push_values(_: np.ndarray, params: np.ndarray, patch: np.ndarray, table: np.ndarray, *moved: np.ndarray) -> None:
    """Fill the second of `moved`, (N, C), with derivatives of the values along the first, (V, C), tangents of rows."""
    values(moved[0], params, patch, table, moved[1])


def pull_values(
    _: np.ndarray, params: np.ndarray, patch: np.ndarray, table: np.ndarray, g: np.ndarray, result: np.ndarray
) -> None:
    """Add to `result` (V, C), the gradient of the rows, from g (N, C), the gradient of the values."""
    found = np.zeros((SHARES, len(table), 16, g.shape[1]), g.dtype)
    parallel(_pull_shares, SHARES, patch, params, g, found, work=30 * len(g))
    _scatter(table, found, result)


def normals(
    collapsed: float, rows: np.ndarray, params: np.ndarray, patch: np.ndarray, table: np.ndarray, out: np.ndarray
) -> None:
    """Fill `out` (N, 3) with unit normals; a tangent below the share `collapsed` of the other counts as zero.

    A normal that does not exist is zero.
    """
    arguments = _nets(rows, table), patch, params, rows.dtype.type(collapsed)
    parallel(_fill_normals, len(out), *arguments, out, work=60 * len(out))


def push_normals(
    collapsed: float, rows: np.ndarray, params: np.ndarray, patch: np.ndarray, table: np.ndarray, *moved: np.ndarray
) -> None:
    """Fill the second of `moved`, (N, 3), with the derivatives of normals along the first, (V, 3), tangents of rows."""
    tangents, out = moved
    arguments = _nets(rows, table), _nets(tangents, table), patch, params, rows.dtype.type(collapsed)
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
    nets = _nets(rows, table)
    found = np.zeros((SHARES, *nets.shape), nets.dtype)
    arguments = nets, patch, params, rows.dtype.type(collapsed), g, found
    parallel(_pull_normal_shares, SHARES, *arguments, work=80 * len(g))
    _scatter(table, found, result)


def _nets(rows: np.ndarray, table: np.ndarray) -> np.ndarray:
    """The control points (n, 16, C) of all patches."""
    nets = np.empty((len(table), 16, rows.shape[1]), rows.dtype)
    parallel(_gather, len(table), rows, table, nets, work=50 * len(table))
    return nets


@compiled
def _bernstein(t, value, slope):
    """Fill `value` (4,) with the cubic Bernstein polynomials at t, also beyond [0, 1], and `slope` with derivatives."""
    one = value.dtype.type(1)
    three, two = one + one + one, one + one
    s = one - t
    value[0], value[1], value[2], value[3] = s * s * s, three * s * s * t, three * s * t * t, t * t * t
    slope[0], slope[1] = -three * s * s, three * s * (s - two * t)
    slope[2], slope[3] = three * t * (two * s - t), three * t * t


@loop
def _gather(start, stop, rows, table, out):
    """Fill `out` (n, 16, C) with the rows (V, C) of each patch."""
    for n in range(start, stop):
        for k in range(16):
            for c in range(rows.shape[1]):
                out[n, k, c] = rows[table[n, k], c]


@loop
def _scatter(table, found, out):
    """Add to `out` (V, C) the gradients `found` (S, n, 16, C) of control points in S shares; `table` (n, 16)."""
    for n in range(len(table)):
        for k in range(16):
            for c in range(out.shape[1]):
                for share in range(len(found)):
                    out[table[n, k], c] += found[share, n, k, c]


@loop
def _sum_values(start, stop, nets, patch, params, out):
    """Fill `out` (N, C) with sums of control points (n, 16, C) of patches (N,) at params (N, 2)."""
    a, b, none = np.empty(4, nets.dtype), np.empty(4, nets.dtype), np.empty(4, nets.dtype)
    for n in range(start, stop):
        _bernstein(params[n, 0], a, none)
        _bernstein(params[n, 1], b, none)
        net = nets[patch[n]]
        for c in range(nets.shape[2]):
            total = nets.dtype.type(0)
            for i in range(4):
                k = 4 * i
                total += a[i] * (b[0] * net[k, c] + b[1] * net[k + 1, c] + b[2] * net[k + 2, c] + b[3] * net[k + 3, c])
            out[n, c] = total


@loop
def _pull_shares(start, stop, patch, params, g, found):
    """Add to `found` (S, n, 16, C) the gradients of control points from g (N, C), each share's in its own part.

    `start` and `stop` count shares: share i is the i-th of S equal parts of the N samples.
    """
    for share in range(start, stop):
        _pull_values(*_share(share, len(found), len(patch)), patch, params, g, found[share])


@compiled
def _share(share, shares, count):
    return share * count // shares, (share + 1) * count // shares


@compiled
def _pull_values(start, stop, patch, params, g, found):
    a, b, none = np.empty(4, g.dtype), np.empty(4, g.dtype), np.empty(4, g.dtype)
    for n in range(start, stop):
        some = False
        for c in range(g.shape[1]):
            some |= g[n, c] != 0
        if not some:
            continue
        _bernstein(params[n, 0], a, none)
        _bernstein(params[n, 1], b, none)
        to = found[patch[n]]
        for i in range(4):
            for j in range(4):
                w = a[i] * b[j]
                for c in range(g.shape[1]):
                    to[4 * i + j, c] += w * g[n, c]


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
    _bernstein(u, a, da)
    _bernstein(v, b, db)
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
        _pull_normals(*_share(share, len(found), len(patch)), nets, patch, params, collapsed, g, found[share])


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
