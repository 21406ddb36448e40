"""Surfaces that are not their triangles: Bézier patches, refined by Newton's method, and sheets."""

import numpy as np
import pytest
from analytic import Ellipsoid

import rts
from rts.arrays.array_functions import described
from rts.operations.unit import unit
from rts.plugin_api.operations import combine
from rts.plugin_api.records import ArraySpec, Proxy


class Bezier(rts.TriangleSurface):
    """Bicubic patches of θ["points"] (m, 3); a sample is the 16 control points of its patch, and (u, v) in it.

    Triangles are coarse on purpose: refinement moves depths, swaps layers, leads two of them to one root, and misses.
    """

    sample_widths = (16, 2)
    steps = 24
    met = 1e-4
    """Pixels that a sample may be off its ray."""

    def __init__(self, indices, squares=3):
        """Patches (n, 16), whose points go first along v, then along u; `squares` along each side of a patch."""
        self.indices, self.squares = np.asarray(indices, np.int32), squares

    def check(self, theta):
        points, least = theta.get("points"), int(self.indices.max()) + 1
        shape = tuple(getattr(points, "shape", ()))
        if len(shape) != 2 or shape[0] < least or shape[1] != 3:
            raise rts.InputError(f"theta['points'] {described(points)}; expected (m, 3), m at least {least}")

    def reads(self, theta):
        return ("points",)

    def evaluate(self, theta, samples):
        (a, da), (b, db) = (bernstein(samples.params[:, i]) for i in range(2))
        points, ids = theta["points"], samples.ids
        gbuffer = rts.GBuffer(position=combine(points, ids, products(a, b)))

        def normal():
            along_u, along_v = (combine(points, ids, products(*w)) for w in ((da, b), (a, db)))
            return unit(rts.namespace(along_u).linalg.cross(along_u, along_v))

        gbuffer.defer("normal", normal)
        return gbuffer

    def proxy_inputs(self, theta):
        return theta["points"]

    def proxy(self, inputs, camera, size):
        r, patches = self.squares, len(self.indices)
        grid = np.linspace(0, 1, r + 1)
        params = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
        ids = np.repeat(self.indices, len(params), axis=0)
        index = np.arange((r + 1) ** 2, dtype=np.int32).reshape(r + 1, r + 1)
        a, b, c, d = (x.reshape(-1) for x in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
        faces = np.stack([np.stack(t, axis=-1) for t in ((a, b, c), (a, c, d))], axis=1).reshape(-1, 3)
        every = (faces + (len(params) * np.arange(patches, dtype=np.int32))[:, None, None]).reshape(-1, 3)
        return Proxy(
            points_at(inputs, ids, np.tile(params, (patches, 1)))[0].astype(np.float32),
            every,
            np.repeat(self.indices, len(faces), axis=0),
            np.tile(params.astype(np.float32)[faces], (patches, 1, 1)),
        )

    def refine(self, inputs, samples, rays):
        """(u, v) and the depth of each sample by Newton's method along its ray, within the patch."""
        cells = samples.row >= 0
        depth, params = np.ones(len(samples.ids)), samples.params.astype(np.float64)
        depth[samples.row[cells]] = samples.depth[cells]
        for _ in range(self.steps):
            point, along_u, along_v = points_at(inputs, samples.ids, params)
            off = point - rays.origins - depth[:, None] * rays.directions
            columns = np.stack([along_u, along_v, -rays.directions], axis=-1)
            determinant = np.linalg.det(columns)
            columns[np.abs(determinant) < 1e-12] = np.eye(3)
            step = np.linalg.solve(columns, -off[..., None])[..., 0]
            params = np.clip(params + np.clip(step[:, :2], -0.3, 0.3), 0, 1)
            depth = depth + np.clip(step[:, 2], -0.5, 0.5)
        off = points_at(inputs, samples.ids, params)[0] - rays.origins - depth[:, None] * rays.directions
        met = np.linalg.norm(off, axis=1) < self.met * np.abs(rays.spread[0] + rays.spread[1] * depth)
        row = np.where(cells & met[samples.row], samples.row, -1)
        return samples.replace(params=params, row=row, depth=np.where(row >= 0, depth[row], 0))

    @classmethod
    def example(cls):
        """A sheet folded twice, two patches long, and a third patch that crosses it almost in its tangent plane."""
        fold = [(-0.9, 0.5), (0.5, 0.95), (1.5, 0.5), (0.2, 0.15), (-1.1, -0.2), (-0.9, -0.9), (0.9, -0.5)]
        wave = np.array([0.1, -0.15, 0.2, 0.0])
        across = list(zip(np.linspace(-0.8, 0.8, 4), wave, strict=True))
        sheet = [(x + 0.1 * y, y, z + w) for x, z in fold for y, w in across]
        third = [(x, 0.9 * y, 0.55 - 0.12 * x * x + 0.2 * w) for x in np.linspace(-0.7, 0.8, 4) for y, w in across]
        indices = [np.arange(first, first + 16) for first in (0, 12, 28)]
        return rts.Part(cls(indices), {"points": np.array(sheet + third, np.float32)}, "normals")


def bernstein(t):
    """The four cubic Bernstein polynomials, and their derivatives."""
    s = 1 - t
    return (s**3, 3 * s * s * t, 3 * s * t * t, t**3), (-3 * s * s, 3 * s * (s - 2 * t), 3 * t * (2 * s - t), 3 * t * t)


def products(a, b):
    """(N, 16) weights of a patch's points from those along u and along v."""
    return rts.namespace(a[0]).stack([x * y for x in a for y in b], axis=-1)


def points_at(points, ids, params):
    """Points of patches and their derivatives in u and v, (N, 3) each, in float64."""
    (a, da), (b, db) = (bernstein(params[:, i].astype(np.float64)) for i in range(2))
    corners = points.astype(np.float64)[ids]
    return tuple(np.einsum("ni,nic->nc", products(*w), corners) for w in ((a, b), (da, b), (a, db)))


class Sheets(rts.TriangleSurface):
    """Squares that face +z, at the heights θ["heights"] (L,); a sample is the number of its sheet, and x and y."""

    sample_widths = (1, 2)

    def __init__(self, refining=lambda samples, rays: samples):
        """`refining` is what `refine` does."""
        self.refining = refining

    def proxy_inputs(self, theta):
        return theta["heights"]

    def proxy(self, inputs, camera, size):
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], np.float32)
        vertices = np.concatenate([np.insert(corners, 2, z, axis=1) for z in inputs])
        faces = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
        sheet = np.repeat(np.arange(len(inputs), dtype=np.int32), 2)[:, None]
        return Proxy(
            vertices, np.tile(faces, (len(inputs), 1)) + 4 * sheet, sheet, np.tile(corners[faces], (len(inputs), 1, 1))
        )

    def refine(self, inputs, samples, rays):
        return self.refining(samples, rays)

    def evaluate(self, theta, samples):
        return self.at(theta, samples.params, samples.ids[:, 0])

    @staticmethod
    def at(theta, xy, sheet):
        xp = rts.namespace(theta["heights"], xy)
        z = xp.take(theta["heights"], sheet, axis=0)
        return rts.GBuffer(position=xp.stack([xp.astype(xy[:, 0], z.dtype), xp.astype(xy[:, 1], z.dtype), z], axis=-1))


class Crowded(Sheets):
    """Sheets whose samples find x, y and their sheet in a table that has room for some: a sample is its entry."""

    sample_widths = (1, 0)

    def __init__(self, room):
        self.room = room

    def table_specs(self, rows, capacity):
        return {"places": ArraySpec((self.room, 3), np.float32, packed=capacity is None)}

    def refine(self, inputs, samples, rays):
        entry = np.arange(len(samples.ids), dtype=np.int32)[:, None]
        row = np.where(samples.row < self.room, samples.row, -1)
        return samples.replace(
            ids=np.minimum(entry, self.room - 1),
            params=samples.params[:, :0],
            row=row,
            overflow=samples.overflow + ((samples.row >= 0) & (row < 0)).sum(),
            tables={"places": np.column_stack([samples.params, samples.ids])[: self.room]},
        )

    def evaluate(self, theta, samples):
        xp = rts.namespace(samples.ids)
        places = xp.take(samples.tables["places"], samples.ids[:, 0], axis=0)
        return self.at(theta, places[:, :2], xp.astype(places[:, 2], samples.ids.dtype))


def ball_of_field(theta, points):
    """The distance of points from a sphere."""
    return ((points - theta["center"]) ** 2).sum(-1) ** 0.5 - theta["radius"]


def part_of(surface):
    """The example of a surface; skipped where its package is missing."""
    center = np.array([0.05, 0.02, 0], np.float32)
    if surface == "field":
        return rts.Part(rts.Sdf(ball_of_field), {"radius": np.float32(0.8), "center": center}, "lambert")
    if surface == "ellipsoid":
        return rts.Part(Ellipsoid(), {"center": center, "radii": np.array([1, 0.7, 0.8], np.float32)}, "lambert")
    try:
        return rts.plugin("surfaces", surface).example()
    except rts.errors.PluginError as error:
        pytest.skip(str(error))
