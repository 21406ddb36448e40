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
    parallel(_sum_values, len(out), control_nets(rows, table), patch, params, out, work=30 * len(out))


def push_values(_: np.ndarray, params: np.ndarray, patch: np.ndarray, table: np.ndarray, *moved: np.ndarray) -> None:
    """Fill the second of `moved`, (N, C), with derivatives of the values along the first, (V, C), tangents of rows."""
    values(moved[0], params, patch, table, moved[1])


def pull_values(
    _: np.ndarray, params: np.ndarray, patch: np.ndarray, table: np.ndarray, g: np.ndarray, result: np.ndarray
) -> None:
    """Add to `result` (V, C), the gradient of the rows, from g (N, C), the gradient of the values."""
    found = np.zeros((SHARES, len(table), 16, g.shape[1]), g.dtype)
    parallel(_pull_shares, SHARES, patch, params, g, found, work=30 * len(g))
    scatter(table, found, result)


def control_nets(rows: np.ndarray, table: np.ndarray) -> np.ndarray:
    """The control points (n, 16, C) of all patches."""
    nets = np.empty((len(table), 16, rows.shape[1]), rows.dtype)
    parallel(_gather, len(table), rows, table, nets, work=50 * len(table))
    return nets


@compiled
def bernstein(t, value, slope):
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
def scatter(table, found, out):
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
        bernstein(params[n, 0], a, none)
        bernstein(params[n, 1], b, none)
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
        _pull_values(*share_range(share, len(found), len(patch)), patch, params, g, found[share])


@compiled
def share_range(share, shares, count):
    """First and end of the samples of a share, of `count` samples in equal parts."""
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
        bernstein(params[n, 0], a, none)
        bernstein(params[n, 1], b, none)
        to = found[patch[n]]
        for i in range(4):
            for j in range(4):
                w = a[i] * b[j]
                for c in range(g.shape[1]):
                    to[4 * i + j, c] += w * g[n, c]
