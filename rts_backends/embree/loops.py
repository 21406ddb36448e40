"""Rays through pixel centres, K nearest hits each, by compiled code that calls Embree.

Embree finds candidates in float32, among covers of the triangles (`enlarged_triangles.py`), and hands each to our
intersection filter. A hit well inside its triangle, and at a depth unlike that of other hits, is believed. Any other is
decided in float64 by the edge functions of `rts_backends.triangles`, exactly as the rasterizer decides: so hits are
those of the rasterizer, an edge between triangles is hit once, and coplanar layers keep their order.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from rts.plugin_api.loops import compiled, loop
from rts_backends.embree.enlarged_triangles import NEVER
from rts_backends.exact_hits import look
from rts_backends.triangles import depth_of, edge_values, to_corner

# isort: split
import numba  # After `loops`, which imports it where no signal interrupts.
from llvmlite import ir
from numba import carray, types  # pyright: ignore[reportPrivateImportUsage]  # Documented, but not in __all__.
from numba.extending import intrinsic

TILE = 8
ACCEPT, REJECT = -1, 0
COHERENT, INVOKE_FILTER = 1 << 16, 1 << 1
SLACK, REACH_SLACK_SHARE = 1e-5, 1e-4
"""Shares of the object's radius. Hits whose depths differ by less than the first are compared in float64. A ray that
has found all its layers is cut off beyond its last hit, by the second."""

GRAZING = 0.05
"""Cosine between ray and normal below which Embree's depth, and side, are not believed."""

REACH = 1.01
"""Square of the radius of the sphere that rays start on, in units of the object's sphere."""

# Per ray: hits so far, pixel x, y, sign of determinants to keep, slack of depths and of the ray's end, depth where the
# ray starts, and the depths between which no plane clips.
COUNT, PIXEL_X, PIXEL_Y, KEEP, DEPTH_SLACK, REACH_SLACK, START, NEAREST, FARTHEST = range(9)
HEADER = 9


def _intrinsic(definition: Callable[..., tuple]) -> Callable[..., Any]:
    """`intrinsic`, whose functions are called without the typing context that their definition takes first."""
    return intrinsic(definition)


@_intrinsic
def _call(typing_context, function, a, b, c):
    """Call a C function of three pointers that returns nothing; its address and the pointers are integers."""
    signature = types.void(types.intp, types.intp, types.intp, types.intp)

    def generate(context, builder, signature, arguments):
        pointer = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer] * 3).as_pointer()
        target, *values = arguments
        builder.call(builder.inttoptr(target, kind), [builder.inttoptr(v, pointer) for v in values])
        return context.get_dummy_value()

    return signature, generate


@_intrinsic
def _pointer(typing_context, address):
    """A pointer from an address, an integer."""

    def generate(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], ir.IntType(8).as_pointer())

    return types.voidptr(types.intp), generate


@compiled
def _decide(t, state, work, vertices, faces):
    """Test triangle `t` in float64: True if the ray hits it, and the depth there.

    `state` holds the ray's numbers (see COUNT and the others). `work` (8, 4) holds `matrix` and `row` of `cast`, then
    room for three corners.
    """
    x, y, keep = state[PIXEL_X], state[PIXEL_Y], state[KEEP]
    hit, _, z, _, _ = look(t, x, y, work[:4], work[4], keep, vertices, faces, work[5:])
    return hit, z


@compiled
def _insert(t, z, exact, state, nearest, work, vertices, faces):
    """Insert a hit, triangle t at depth z, among the `nearest`, by depth, then by triangle.

    These are depths, ids, and which of them are sure, all (K,). They change in place, as does their number of hits,
    `state[COUNT]`. Hits at nearly the same depth are tested in float64 first, unless they are `exact` or sure already;
    earlier ones that fail are removed. Returns False if the hit fails, is there already, or is not among the nearest.
    """
    depths, ids, sure = nearest
    slack, count, i = state[DEPTH_SLACK], int(state[COUNT]), 0
    while i < count:
        if ids[i] == t:
            return False
        if abs(depths[i] - z) <= slack:
            hit = True
            if not exact:
                exact = True
                hit, z = _decide(t, state, work, vertices, faces)
                if not hit:
                    return False
            if not sure[i]:
                hit, depths[i] = _decide(ids[i], state, work, vertices, faces)
                sure[i] = True
            if not hit:
                for k in range(i, count - 1):
                    depths[k], ids[k], sure[k] = depths[k + 1], ids[k + 1], sure[k + 1]
                count -= 1
                continue
        i += 1
    at = count
    while at > 0 and (z < depths[at - 1] or (z == depths[at - 1] and t < ids[at - 1])):
        at -= 1
    state[COUNT] = count
    if at >= len(ids):
        return False
    for k in range(min(count, len(ids) - 1), at, -1):
        depths[k], ids[k], sure[k] = depths[k - 1], ids[k - 1], sure[k - 1]
    depths[at], ids[at], sure[at] = z, t, exact
    state[COUNT] = min(count + 1, len(ids))
    return True


def _keep_nearest(arguments):
    """Insert a candidate among a ray's nearest hits: Embree's intersection filter.

    Fields of `arguments`: valid, user, context, ray, hit. A candidate is accepted only once all layers are full: the
    ray then ends at the last. Others are rejected, so that Embree searches on.
    """
    fields = carray(arguments, 5)
    valid = carray(_pointer(fields[0]), 1, np.int32)
    ray = carray(_pointer(fields[3]), 9, np.float32)
    hit = carray(_pointer(fields[4]), 5, np.float32)
    cover = carray(_pointer(fields[4]), 7, np.int32)[5]
    # Ours, behind the 16 bytes of Embree's own query context: addresses and counts.
    context = carray(_pointer(fields[2]), 15, np.intp)
    layers = context[3]
    state = carray(_pointer(context[2]), HEADER, np.float64)
    depths = carray(_pointer(context[4]), layers, np.float64)
    ids = carray(_pointer(context[5]), layers, np.int32)
    sure = carray(_pointer(context[6]), layers, np.bool_)
    vertices = carray(_pointer(context[7]), (context[8], 3), np.float32)
    faces = carray(_pointer(context[9]), (context[10], 3), np.int32)
    work = carray(_pointer(context[11]), (8, 4), np.float64)
    owners = carray(_pointer(context[12]), context[13], np.int32)
    margins = carray(_pointer(context[14]), context[10], np.uint8)

    valid[0] = REJECT
    t, exact, z = cover, True, state[START] + ray[8]
    if cover < len(faces) and margins[cover] != NEVER and state[NEAREST] < z < state[FARTHEST]:
        margin, u, v = np.float32(0.001) * margins[cover], hit[3], hit[4]
        along = hit[0] * ray[4] + hit[1] * ray[5] + hit[2] * ray[6]
        normal = hit[0] * hit[0] + hit[1] * hit[1] + hit[2] * hit[2]
        step = ray[4] * ray[4] + ray[5] * ray[5] + ray[6] * ray[6]
        within = u > margin and v > margin and u + v < 1 - margin
        exact = not (within and along * along > GRAZING * GRAZING * normal * step)
        if not exact and state[KEEP] != 0 and along > 0:  # Seen from behind.
            return
    if exact:
        t = owners[cover]
        found, z = _decide(t, state, work, vertices, faces)
        if not found:
            return
    if not _insert(t, z, exact, state, (depths, ids, sure), work, vertices, faces):
        return
    # Nothing beyond the K-th hit matters: an accepted hit ends the ray there.
    if state[COUNT] == layers:
        valid[0] = ACCEPT
        ray[8] = depths[layers - 1] - state[START] + state[REACH_SLACK]


@functools.cache
def _compiled_filter() -> Any:
    """The intersection filter, compiled in another thread: Ctrl-C in this one would leave the compiler locked."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(numba.cfunc(types.void(types.CPointer(types.intp)), cache=True), _keep_nearest).result()


def keep_nearest_address() -> int:
    """Address of the intersection filter, for Embree to call; compiled at the first call."""
    return _compiled_filter().address


class Target(NamedTuple):
    """Triangles that rays are cast at, and Embree's scene of them.

    Attributes:
        intersect: address of rtcIntersect1.
        filter_address: address of the intersection filter.
        scene: Embree's handle.
        sphere: (4,) centre and radius of the object; the scene is the object moved and scaled to the unit sphere.
        vertices: (V, 3) of the proxy.
        faces: (T, 3).
        owners: see `Covers`.
        margins: (T,), see `Covers`.
    """

    intersect: int
    filter_address: int
    scene: int
    sphere: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    owners: np.ndarray
    margins: np.ndarray


class Eye(NamedTuple):
    """Where rays come from.

    Attributes:
        matrix: (4, 4) to homogeneous pixels.
        row: (4,) coefficients of linear depth, see `depth_of`.
        ray_space: (8, 4): the camera's projection, and the inverse of its view.
        planes: (4,) depths: nothing nearer than the first or beyond the second is seen; between the others no plane
            clips.
        keep: sign of the determinants of triangles to keep, those seen from the front; 0 keeps all.
        size: (height, width) of the image.
    """

    matrix: np.ndarray
    row: np.ndarray
    ray_space: np.ndarray
    planes: np.ndarray
    keep: float
    size: tuple[int, int]


@loop
def cast(first, last, target, eye, points, fragments):
    """Fill the fragment arrays for tiles of pixels, or for pieces of the list `points`.

    Args:
        first: first tile or piece, of TILE² pixels.
        last: the tile or piece past the last.
        target: `Target`.
        eye: `Eye`.
        points: (M, 2) x and y of the positions to cast rays through; empty for all H · W pixels' centres.
        fragments: `Fragments` to fill: ids, barycentrics and depths of K layers, one point or pixel after the other.
    """
    intersect, filter_address, scene, object_sphere, vertices, faces, owners, margins = target
    (matrix, row, ray_space, planes, keep, (height, width)), (triangle_ids, barycentrics, depths_out) = eye, fragments
    layers = len(triangle_ids)
    at, (xs, ys) = np.empty(TILE * TILE, np.int64), np.empty((2, TILE * TILE))
    across = (width + TILE - 1) // TILE
    state, depths = np.empty(HEADER), np.empty(layers)
    ids, sure = np.empty(layers, np.int32), np.empty(layers, np.bool_)
    near_faces = np.empty((layers * TILE * TILE, 3), np.int32)
    near_vertices = np.empty((layers * TILE * TILE * 3, 3), np.float32)
    work = np.empty((8, 4))
    work[:4], work[4] = matrix, row
    corners = work[5:]
    ray, options = np.zeros(32, np.float32), np.zeros(4, np.intp)
    ray_bits, option_bits = ray.view(np.int32), options.view(np.int32)
    context = np.zeros(15, np.intp)
    context.view(np.int32)[:4] = -1
    context[2], context[3], context[4] = state.ctypes.data, layers, depths.ctypes.data
    context[5], context[6] = ids.ctypes.data, sure.ctypes.data
    context[7], context[8] = vertices.ctypes.data, len(vertices)
    context[9], context[10], context[11] = faces.ctypes.data, len(faces), work.ctypes.data
    context[12], context[13], context[14] = owners.ctypes.data, len(owners), margins.ctypes.data
    option_bits[0], option_bits[1] = COHERENT | INVOKE_FILTER, -1
    options[1], options[2] = context.ctypes.data, filter_address
    # Rays are read as 16-byte vectors.
    shift = (-ray.ctypes.data % 16) // 4
    ray, ray_bits = ray[shift : shift + 24], ray_bits[shift : shift + 24]
    radius = object_sphere[3]
    slack = SLACK * radius
    state[KEEP], state[DEPTH_SLACK], state[REACH_SLACK] = keep, slack, REACH_SLACK_SHARE * radius
    state[NEAREST], state[FARTHEST] = planes[2] + slack, planes[3] - slack
    for tile in range(first, last):
        pixels = _pixels(tile, across, width, height, points, at, xs, ys)
        for p in range(pixels):
            state[COUNT], state[PIXEL_X], state[PIXEL_Y] = 0, xs[p], ys[p]
            x, y = xs[p] * 2 / width - 1, 1 - ys[p] * 2 / height
            if _aim(ray_space, object_sphere, planes, x, y, ray, state):
                ray_bits[9], ray_bits[10], ray_bits[11] = -1, 0, 0
                ray_bits[17], ray_bits[18], ray_bits[19] = -1, -1, -1
                _call(intersect, scene, ray.ctypes.data, options.ctypes.data)
            count = int(state[COUNT])
            for k in range(layers):
                triangle_ids[k, at[p]] = ids[k] if k < count else -1
        # Corners are gathered by loops of their own, so short that the processor overlaps their waits for memory.
        count = 0
        for k in range(layers):
            for p in range(pixels):
                if triangle_ids[k, at[p]] >= 0:
                    t = triangle_ids[k, at[p]]
                    near_faces[count, 0] = faces[t, 0]
                    near_faces[count, 1] = faces[t, 1]
                    near_faces[count, 2] = faces[t, 2]
                    count += 1
        for n in range(count):
            for c in range(3):
                v = near_faces[n, c]
                for r in range(3):
                    near_vertices[3 * n + c, r] = vertices[v, r]
        n = 0
        for k in range(layers):
            for p in range(pixels):
                to = at[p]
                if triangle_ids[k, to] < 0:
                    barycentrics[k, to, 0] = barycentrics[k, to, 1] = depths_out[k, to] = 0
                    continue
                to_corner(matrix, near_vertices, 3 * n, corners, 0)
                to_corner(matrix, near_vertices, 3 * n + 1, corners, 1)
                to_corner(matrix, near_vertices, 3 * n + 2, corners, 2)
                ea, eb, ec, _ = edge_values(corners, 0, 1, 2, xs[p], ys[p])
                a, b, c = ea / (ea + eb + ec), eb / (ea + eb + ec), ec / (ea + eb + ec)
                barycentrics[k, to, 0], barycentrics[k, to, 1] = a, b
                depths_out[k, to] = (
                    a * depth_of(row, near_vertices, 3 * n)
                    + b * depth_of(row, near_vertices, 3 * n + 1)
                    + c * depth_of(row, near_vertices, 3 * n + 2)
                )
                n += 1
    # Compiled code lets go of an array after its last use, and of these Embree has the addresses.
    context[0] = len(depths) + len(sure) + len(ids) + len(state) + len(work) + len(ray) + len(options)


@compiled
def _pixels(tile, across, width, height, points, at, xs, ys):
    """Fill in the positions of a tile of pixels, or of a piece of `points`: index of output, x, y.

    Returns the number of positions, at most TILE².
    """
    count = 0
    if len(points) > 0:
        for m in range(tile * TILE * TILE, min(len(points), (tile + 1) * TILE * TILE)):
            at[count], xs[count], ys[count] = m, points[m, 0], points[m, 1]
            count += 1
        return count
    for j in range(tile // across * TILE, min(height, tile // across * TILE + TILE)):
        for i in range(tile % across * TILE, min(width, tile % across * TILE + TILE)):
            at[count], xs[count], ys[count] = j * width + i, i + 0.5, j + 0.5
            count += 1
    return count


@compiled
def _aim(space, sphere, planes, x, y, ray, state):
    """Write the ray through an NDC position to `ray`, its depth at the start to `state`; False if there is none.

    `space`, `sphere` and `planes` are `ray_space`, `object_sphere` and `planes` of `cast`. The ray is the part within
    the object's sphere and between `planes`. From such a start, and in units of the object, float32 is fine enough
    however far off the camera or the origin.
    """
    # See Camera.rays: the camera-space point at depth z is (start + z step, −z). Rows 0–3 are the projection, 4–6
    # those of the inverse view. (No slices here: each would cost an atomic count of references.)
    a, b = space[0, 0] - x * space[3, 0], space[0, 1] - x * space[3, 1]
    c, d = space[1, 0] - y * space[3, 0], space[1, 1] - y * space[3, 1]
    scale = 1 / (a * d - b * c)
    u, v = x * space[3, 3] - space[0, 3], y * space[3, 3] - space[1, 3]
    sx, sy = scale * (d * u - b * v), scale * (a * v - c * u)
    u, v = space[0, 2] - x * space[3, 2], space[1, 2] - y * space[3, 2]
    tx, ty = scale * (d * u - b * v), scale * (a * v - c * u)
    unit = 1 / sphere[3]
    ox = (space[4, 0] * sx + space[4, 1] * sy + space[4, 3] - sphere[0]) * unit
    oy = (space[5, 0] * sx + space[5, 1] * sy + space[5, 3] - sphere[1]) * unit
    oz = (space[6, 0] * sx + space[6, 1] * sy + space[6, 3] - sphere[2]) * unit
    dx = (space[4, 0] * tx + space[4, 1] * ty - space[4, 2]) * unit
    dy = (space[5, 0] * tx + space[5, 1] * ty - space[5, 2]) * unit
    dz = (space[6, 0] * tx + space[6, 1] * ty - space[6, 2]) * unit
    square = 1 / (dx * dx + dy * dy + dz * dz)
    middle = -(ox * dx + oy * dy + oz * dz) * square
    discriminant = middle * middle - (ox * ox + oy * oy + oz * oz - REACH) * square
    if not discriminant > 0:
        return False
    half, slack = np.sqrt(discriminant), state[DEPTH_SLACK]
    start, stop = max(middle - half, planes[0] - slack), min(middle + half, planes[1] + slack)
    if not start < stop:
        return False
    ray[0], ray[1], ray[2], ray[3] = ox + start * dx, oy + start * dy, oz + start * dz, 0
    ray[4], ray[5], ray[6], ray[7] = dx, dy, dz, 0
    ray[8] = stop - start
    state[START] = start
    return True
