"""Bicubic Bézier patches on the host, compiled: points and derivatives, triangles by error, Newton along rays.

Nets (n, 4, 4, 3) float64 are the control points of patches, first along u, then along v. It imports numba.
"""

from __future__ import annotations

import math

import numba
import numpy as np

compiled = numba.njit(nogil=True)
kernel = numba.njit(nogil=True, cache=True)


@compiled
def _basis(t, value, slope):
    """The cubic Bernstein polynomials (4,) and their derivatives, also beyond [0, 1]."""
    s = 1 - t
    value[0], value[1], value[2], value[3] = s * s * s, 3 * s * s * t, 3 * s * t * t, t * t * t
    slope[0], slope[1], slope[2], slope[3] = -3 * s * s, 3 * s * (s - 2 * t), 3 * t * (2 * s - t), 3 * t * t


@compiled
def _point(net, u, v, a, da, b, db, out):
    """The point, and its derivatives along u and v: the rows of `out` (3, 3)."""
    _basis(u, a, da)
    _basis(v, b, db)
    out[:] = 0
    for i in range(4):
        for j in range(4):
            w, wu, wv = a[i] * b[j], da[i] * b[j], a[i] * db[j]
            for c in range(3):
                x = net[i, j, c]
                out[0, c] += w * x
                out[1, c] += wu * x
                out[2, c] += wv * x


@kernel
def points(start, stop, nets, patch, params, out):
    """Fill `out` (N, 3, 3): points, and derivatives along u and v, of patches (N,) at params (N, 2)."""
    a, da, b, db = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for n in range(start, stop):
        _point(nets[patch[n]], params[n, 0], params[n, 1], a, da, b, db, out[n])


# -------------------------------------------------------------------------------------------------- Newton


@kernel
def newton(start, stop, nets, patch, params, origins, directions, spread, limits, depth, met):
    """Move params (N, 2) so that points lie on their rays; fill depth (N,) and whether they do, met (N,).

    Args:
        start: first sample.
        stop: one after the last.
        nets: (n, 4, 4, 3).
        patch: (N,) int.
        params: (N, 2) float64, where to start; changed in place.
        origins: (N, 3) float64.
        directions: (N, 3) float64; the point at depth z is `origin + z direction`.
        spread: (2,), a pixel at depth z is `spread[0] + spread[1] z` wide.
        limits: (4,): residual in pixels, largest number of steps, largest step in params, how far beyond the edge.
        depth: (N,) float64.
        met: (N,) bool.
    """
    residual, steps, largest, beyond = limits[0], int(limits[1]), limits[2], limits[3]
    a, da, b, db, at = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty((3, 3))
    for n in range(start, stop):
        net, o, d = nets[patch[n]], origins[n], directions[n]
        u, v = params[n, 0], params[n, 1]
        square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        # Two directions across the ray.
        k = 0
        if abs(d[1]) < abs(d[k]):
            k = 1
        if abs(d[2]) < abs(d[k]):
            k = 2
        i, j = (k + 1) % 3, (k + 2) % 3
        length = math.sqrt(d[i] * d[i] + d[j] * d[j])
        p, q = np.zeros(3), np.empty(3)
        p[i], p[j] = -d[j] / length, d[i] / length
        root = math.sqrt(square)
        for c in range(3):
            q[c] = (d[(c + 1) % 3] * p[(c + 2) % 3] - d[(c + 2) % 3] * p[(c + 1) % 3]) / root
        met[n] = False
        for step in range(steps + 1):
            _point(net, u, v, a, da, b, db, at)
            f, g, z = 0.0, 0.0, 0.0
            fu, fv, gu, gv = 0.0, 0.0, 0.0, 0.0
            for c in range(3):
                off = at[0, c] - o[c]
                f, g, z = f + p[c] * off, g + q[c] * off, z + d[c] * off
                fu, fv = fu + p[c] * at[1, c], fv + p[c] * at[2, c]
                gu, gv = gu + q[c] * at[1, c], gv + q[c] * at[2, c]
            z /= square
            width = abs(spread[0] + spread[1] * z)
            if f * f + g * g <= (residual * width) ** 2:
                inside = -beyond <= u <= 1 + beyond and -beyond <= v <= 1 + beyond
                met[n], depth[n], params[n, 0], params[n, 1] = inside, z, u, v
                break
            determinant = fu * gv - fv * gu
            scale = (fu * fu + gu * gu) * (fv * fv + gv * gv)
            if step == steps or not determinant * determinant > 1e-24 * scale:
                break
            du, dv = (fv * g - gv * f) / determinant, (gu * f - fu * g) / determinant
            size = max(abs(du), abs(dv))
            if size > largest:
                du, dv = du * largest / size, dv * largest / size
            u, v = u + du, v + dv
            u, v = min(max(u, -0.25), 1.25), min(max(v, -0.25), 1.25)


# ---------------------------------------------------------------------------------------- triangles by error


GRID = 5
"""Points along each side of a patch at which its shape is looked at."""


@compiled
def _curvature(t, value):
    """The second derivatives of the cubic Bernstein polynomials (4,)."""
    value[0], value[1], value[2], value[3] = 6 * (1 - t), 6 * (3 * t - 2), 6 * (1 - 3 * t), 6 * t


@compiled
def _cross(a, b, out):
    for c in range(3):
        out[c] = a[(c + 1) % 3] * b[(c + 2) % 3] - a[(c + 2) % 3] * b[(c + 1) % 3]


@kernel
def shapes(start, stop, nets, normals, places, bends, curves):
    """Fill what is asked of the shape of patches.

    Args:
        start: first patch.
        stop: one after the last.
        nets: (n, 4, 4, 3).
        normals: (n, GRID, GRID, 3), of unit length, or zero.
        places: (n, GRID, GRID, 3), where these are.
        bends: (n, 3), the largest second derivatives along the normal: in u, in u and v, in v. Chords are off by those
            alone: what lies along the surface only moves points within it.
        curves: (n, 4), the largest second derivatives of the sides across themselves.
    """
    a, da, dda, b, db, ddb = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    at, second, normal = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for n in range(start, stop):
        net = nets[n]
        bends[n] = 0
        curves[n] = 0
        for i in range(GRID):
            u = i / (GRID - 1)
            _curvature(u, dda)
            for j in range(GRID):
                v = j / (GRID - 1)
                _curvature(v, ddb)
                _point(net, u, v, a, da, b, db, at)
                second[:] = 0
                for k in range(4):
                    for m in range(4):
                        for c in range(3):
                            x = net[k, m, c]
                            second[0, c] += dda[k] * b[m] * x
                            second[1, c] += da[k] * db[m] * x
                            second[2, c] += a[k] * ddb[m] * x
                _cross(at[1], at[2], normal)
                length = math.sqrt(np.sum(normal * normal))
                places[n, i, j] = at[0]
                scale = math.sqrt(np.sum(at[1] * at[1]) * np.sum(at[2] * at[2]))
                if length > 1e-6 * scale and length > 0:
                    normals[n, i, j] = normal / length
                    for k in range(3):
                        bends[n, k] = max(bends[n, k], abs(np.sum(second[k] * normal)) / length)
                else:
                    normals[n, i, j] = 0
                    for k in range(3):
                        bends[n, k] = max(bends[n, k], math.sqrt(np.sum(second[k] * second[k])))
                if j == 0:
                    curves[n, 0] = max(curves[n, 0], _across(second[0], at[1]))
                if i == GRID - 1:
                    curves[n, 1] = max(curves[n, 1], _across(second[2], at[2]))
                if j == GRID - 1:
                    curves[n, 2] = max(curves[n, 2], _across(second[0], at[1]))
                if i == 0:
                    curves[n, 3] = max(curves[n, 3], _across(second[2], at[2]))


@compiled
def _across(second, first):
    """The size of a second derivative of a curve across its first."""
    square, along, own = np.sum(first * first), np.sum(first * second), np.sum(second * second)
    if square > 0:
        own -= along * along / square
    return math.sqrt(max(own, 0.0))


@kernel
def outlines(start, stop, nets, normals, places, eye, parallel, move, spread, cone, fine, coarse, tolerance):
    """Fill tolerance (n,): the chord error in the units of the nets that a patch may have; infinity where out of view.

    Args:
        start: first patch.
        stop: one after the last.
        nets: (n, 4, 4, 3).
        normals: (n, GRID, GRID, 3).
        places: (n, GRID, GRID, 3).
        eye: (3,), or the direction towards the viewer if `parallel`.
        parallel: whether rays are.
        move: how far the eye may be off.
        spread: (2,), width of a pixel at depth z.
        cone: (5,): the axis of the view, sine and cosine of its half angle with what the view may be off.
        fine: pixels, where a patch has an outline.
        coarse: pixels elsewhere.
        tolerance: (n,).
    """
    faces, toward = np.empty((GRID, GRID)), np.empty(3)
    for n in range(start, stop):
        net = nets[n]
        middle = np.zeros(3)
        for i in range(4):
            for j in range(4):
                middle += net[i, j]
        middle /= 16
        radius = 0.0
        for i in range(4):
            for j in range(4):
                radius = max(radius, np.sum((net[i, j] - middle) ** 2))
        radius = math.sqrt(radius)
        nearest = np.inf
        if not parallel:
            off = middle - eye
            distance = math.sqrt(np.sum(off * off))
            if distance > radius + move:
                along = off[0] * cone[0] + off[1] * cone[1] + off[2] * cone[2]
                across = math.sqrt(max(distance * distance - along * along, 0.0))
                # Out of the cone by more than its own size, and that of the cell of views.
                if across * cone[4] - along * cone[3] > radius + move:
                    tolerance[n] = np.inf
                    continue
        least, most, jump = np.inf, -np.inf, 0.0
        for i in range(GRID):
            for j in range(GRID):
                normal = normals[n, i, j]
                far = 1.0
                if parallel:
                    toward[:] = eye
                else:
                    toward[:] = eye - places[n, i, j]
                    far = math.sqrt(np.sum(toward * toward))
                    nearest = min(nearest, far - move)
                facing = 0.0
                if far > 0:
                    facing = np.sum(normal * toward) / far
                faces[i, j] = facing
                slack = 1.0 if far == 0 else min(1.0, move / far)
                least, most = min(least, facing - slack), max(most, facing + slack)
        for i in range(GRID):
            for j in range(GRID - 1):
                jump = max(jump, abs(faces[i, j] - faces[i, j + 1]), abs(faces[j, i] - faces[j + 1, i]))
        straddles = least - 0.25 * jump <= 0 <= most + 0.25 * jump
        width = spread[0] if parallel else abs(spread[1] * max(nearest, 0.0))
        # The eye may be at the patch: then as fine as the size of the patch asks for.
        tolerance[n] = max(width * (fine if straddles else coarse), 1e-4 * radius)


@kernel
def rates(bends, curves, tolerance, sides, edge_count, most, inner, edges):
    """Fill how often patches and their sides are cut: inner (n, 2) along u and v, edges (E,).

    Args:
        bends: (n, 3).
        curves: (n, 4).
        tolerance: (n,), chord error; infinity where out of view.
        sides: (n, 4) int32, the edge of each side: v = 0, u = 1, v = 1, u = 0.
        edge_count: E.
        most: the largest rate.
        inner: (n, 2) int32.
        edges: (E,) int32.
    """
    fine, second = np.full(edge_count, np.inf), np.zeros(edge_count)
    for n in range(len(bends)):
        for s in range(4):
            e = sides[n, s]
            fine[e], second[e] = min(fine[e], tolerance[n]), max(second[e], curves[n, s])
    for e in range(edge_count):
        edges[e] = 1
        if fine[e] < np.inf and second[e] > 0:
            edges[e] = int(min(most, max(1.0, math.ceil(math.sqrt(second[e] / (8 * fine[e]))))))
    for n in range(len(bends)):
        allowed = tolerance[n]
        ru, rv = 1.0, 1.0
        if allowed < np.inf:
            uu, uv, vv = bends[n, 0], bends[n, 1], bends[n, 2]
            ru, rv = max(1.0, math.sqrt(uu / (4 * allowed))), max(1.0, math.sqrt(vv / (4 * allowed)))
            # The error of a triangle's chord (Filip, Magedson, Markot 1986).
            error = (uu / (ru * ru) + 2 * uv / (ru * rv) + vv / (rv * rv)) / 8
            if error > allowed:
                grow = math.sqrt(error / allowed)
                ru, rv = ru * grow, rv * grow
        inner[n, 0], inner[n, 1] = int(min(most, math.ceil(ru))), int(min(most, math.ceil(rv)))
        for s in range(4):
            # Cut alike, a side and what lies within make no long triangles.
            if tolerance[n] <= fine[sides[n, s]] and allowed < np.inf:
                edges[sides[n, s]] = max(edges[sides[n, s]], inner[n, s % 2])
    for n in range(len(bends)):
        cut = edges[sides[n, 0]] > 1 or edges[sides[n, 1]] > 1 or edges[sides[n, 2]] > 1 or edges[sides[n, 3]] > 1
        if cut or inner[n, 0] > 1 or inner[n, 1] > 1:
            inner[n, 0], inner[n, 1] = max(inner[n, 0], 2), max(inner[n, 1], 2)


@compiled
def _count(inner, sides, edges, n):
    """How many triangles a patch has."""
    ru, rv = inner[n, 0], inner[n, 1]
    if ru == 1 and rv == 1:
        return 2
    around = 0
    for s in range(4):
        around += edges[sides[n, s]] + (ru if s % 2 == 0 else rv) - 2
    return around + 2 * (ru - 2) * (rv - 2)


@kernel
def counts(inner, sides, edges, first):
    """Fill first (n + 1,): the number of the first triangle of each patch."""
    first[0] = 0
    for n in range(len(inner)):
        first[n + 1] = first[n] + _count(inner, sides, edges, n)


@kernel
def triangles(start, stop, nets, corners, sides, flips, edges, edge_first, inner, inner_first, first, out):
    """Fill the triangles of patches, and the vertices within them.

    Args:
        start: first patch.
        stop: one after the last.
        nets: (n, 4, 4, 3).
        corners: (n, 4) int32, the vertices of the corners (0, 0), (1, 0), (1, 1), (0, 1).
        sides: (n, 4) int32, the edge of each side.
        flips: (n, 4) bool, whether a side, which runs around the patch, runs against its edge.
        edges: (E,) int32, how often each edge is cut.
        edge_first: (E,) int32, the first of the vertices within each edge.
        inner: (n, 2) int32.
        inner_first: (n,) int32, the first of the vertices within each patch.
        first: (n + 1,) int32, the first triangle of each patch.
        out: vertices (V, 3) float32, faces (T, 3) int32, ids (T, 1) int32, params (T, 3, 2) float32.
    """
    vertices, faces, ids, params = out
    a, da, b, db, at = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty((3, 3))
    for n in range(start, stop):
        ru, rv = inner[n, 0], inner[n, 1]
        t = first[n]
        ids[t : first[n + 1], 0] = n
        if ru == 1 and rv == 1:
            for k in range(3):
                _corner(faces, params, t, k, corners[n, k], k)
                _corner(faces, params, t + 1, k, corners[n, (k + 2) % 4], (k + 2) % 4)
            continue
        base = inner_first[n]
        for i in range(1, ru):
            for j in range(1, rv):
                _point(nets[n], i / ru, j / rv, a, da, b, db, at)
                vertices[base + (i - 1) * (rv - 1) + j - 1] = at[0]
        for i in range(1, ru - 1):
            for j in range(1, rv - 1):
                for half in range(2):
                    for k in range(3):
                        # (0, 0), (1, 0), (1, 1) and (1, 1), (0, 1), (0, 0) of the cell.
                        c = (k + 2 * half) % 4
                        x, y = i + (1 if c == 1 or c == 2 else 0), j + (1 if c >= 2 else 0)
                        faces[t, k] = base + (x - 1) * (rv - 1) + y - 1
                        params[t, k, 0], params[t, k, 1] = x / ru, y / rv
                    t += 1
        for s in range(4):
            e, count = sides[n, s], ru if s % 2 == 0 else rv
            cuts = edges[e]
            # Points of the side, 0 to `cuts`, and those of the ring within, 1 to `count` − 1; the nearer goes on.
            k, m = 0, 1
            while k < cuts or m < count - 1:
                outward = m == count - 1 or (k < cuts and (k + 1) * count * 2 <= (2 * m + 1) * cuts)
                _outer(faces, params, t, 0, n, s, k, cuts, corners, flips, edge_first[e])
                if outward:
                    _outer(faces, params, t, 1, n, s, k + 1, cuts, corners, flips, edge_first[e])
                    k += 1
                else:
                    _inner(faces, params, t, 1, s, m + 1, ru, rv, base)
                _inner(faces, params, t, 2, s, m, ru, rv, base)
                if not outward:
                    m += 1
                t += 1


@compiled
def _corner(faces, params, t, k, vertex, corner):
    faces[t, k] = vertex
    params[t, k, 0] = 1.0 if corner == 1 or corner == 2 else 0.0
    params[t, k, 1] = 1.0 if corner >= 2 else 0.0


@compiled
def _outer(faces, params, t, place, n, s, k, cuts, corners, flips, base):
    """The point number k of side s."""
    if k == 0 or k == cuts:
        c = s if k == 0 else (s + 1) % 4
        _corner(faces, params, t, place, corners[n, c], c)
        return
    faces[t, place] = base + (cuts - k if flips[n, s] else k) - 1
    x = k / cuts
    params[t, place, 0] = x if s == 0 else 1.0 if s == 1 else 1 - x if s == 2 else 0.0
    params[t, place, 1] = 0.0 if s == 0 else x if s == 1 else 1.0 if s == 2 else 1 - x


@compiled
def _inner(faces, params, t, place, s, m, ru, rv, base):
    """The point number m of the ring within a patch, along side s."""
    i = m if s == 0 else ru - 1 if s == 1 else ru - m if s == 2 else 1
    j = 1 if s == 0 else m if s == 1 else rv - 1 if s == 2 else rv - m
    faces[t, place] = base + (i - 1) * (rv - 1) + j - 1
    params[t, place, 0], params[t, place, 1] = i / ru, j / rv


@kernel
def edge_points(curves, edges, edge_first, vertices):
    """Fill the vertices within edges, of curves (E, 4, 3)."""
    a, da = np.empty(4), np.empty(4)
    for e in range(len(curves)):
        for k in range(1, edges[e]):
            _basis(k / edges[e], a, da)
            for c in range(3):
                x = 0.0
                for i in range(4):
                    x += a[i] * curves[e, i, c]
                vertices[edge_first[e] + k - 1, c] = x
