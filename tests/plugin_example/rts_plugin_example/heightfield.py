"""Heights over a square: y = h(x, z) on [−1, 1]², a uniform bicubic B-spline."""

import dataclasses

import numpy as np

import rts
from rts.plugin_api.records import Proxy, Samples


@dataclasses.dataclass(frozen=True)
class Heightfield(rts.TriangleSurface):
    """θ["heights"] (R, C) are the control heights, rows along z and columns along x, at least four of each."""

    sample_widths = (0, 2)  # A sample has no integers; its parameters are u along x and v along z, counted in patches.
    squares, newton_steps = 5, 6  # Squares of two triangles along the side of a patch.

    def check(self, theta):
        shape = tuple(getattr(theta.get("heights"), "shape", ()))
        if len(shape) != 2 or min(shape) < 4:
            raise rts.InputError(f"theta['heights'] has shape {shape}; expected (rows, columns), at least (4, 4)")

    def evaluate(self, theta, samples):
        u, v = samples.params[:, 0], samples.params[:, 1]
        xp, (y, slope_u, slope_v) = rts.namespace(u), height(theta["heights"], u, v)
        per_z, per_x = ((n - 3) / 2 for n in theta["heights"].shape)  # Patches a unit.
        gbuffer = rts.GBuffer(position=xp.stack([u / per_x - 1, y, v / per_z - 1], axis=-1))
        gbuffer.defer("normal", lambda: xp.stack([-slope_u * per_x, xp.ones_like(u), -slope_v * per_z], axis=-1))
        return gbuffer

    def proxy_inputs(self, theta):
        return theta["heights"]

    def proxy(self, inputs, camera, size):
        counts = [self.squares * (n - 3) + 1 for n in inputs.shape]
        params = np.indices(counts, np.float32)[::-1].reshape(2, -1).T / self.squares
        vertices = self.evaluate({"heights": inputs}, Samples(None, params, None, None))["position"]
        index = np.arange(len(params), dtype=np.int32).reshape(counts)
        a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]  # From above, counter-clockwise.
        faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
        return Proxy(vertices.astype(np.float32), faces, np.zeros((len(faces), 0), np.int32), params[faces])

    def refine(self, inputs, samples, rays):
        """Move the samples from the triangles to the surface, along their rays, by Newton's method."""
        cells, start = samples.row >= 0, np.ones(len(samples.params))
        start[samples.row[cells]] = samples.depth[cells]
        per_z, per_x = ((n - 3) / 2 for n in inputs.shape)
        depth, (dx, dy, dz) = start, rays.directions.T
        for _ in range(self.newton_steps):
            x, y, z = (rays.origins + depth[:, None] * rays.directions).T
            u, v = (x + 1) * per_x, (z + 1) * per_z
            h, slope_u, slope_v = height(inputs.astype(np.float64), u, v)
            step = (h - y) / (dy - slope_u * per_x * dx - slope_v * per_z * dz + 1e-30)
            depth = depth + np.clip(step, -0.1, 0.1)
        met = (np.abs(step) < 1e-6) & (np.abs(depth - start) < 0.1)  # Past an outline, rays meet triangles only.
        params = np.where(met[:, None], np.stack([u, v], axis=-1), samples.params).astype(np.float32)
        row = np.where(cells & met[samples.row], samples.row, -1)
        refined = np.where(row >= 0, depth[row], 0).astype(np.float32)
        return samples.replace(params=params, row=row, depth=refined)

    @classmethod
    def example(cls):
        z, x = np.mgrid[-1:1:7j, -1:1:8j].astype(np.float32)
        return rts.Part(cls(), {"heights": 0.5 * np.cos(3 * x) * np.cos(2 * z + 1)}, shader="normals")


def height(heights, u, v):
    """The height and its slopes along u and v, each (N,)."""
    xp, (rows, columns) = rts.namespace(heights, u), heights.shape
    i, j = xp.clip(xp.floor(u), 0, columns - 4), xp.clip(xp.floor(v), 0, rows - 4)
    (a, da), (b, db) = basis(u - i), basis(v - j)
    first, flat = xp.astype(j * columns + i, xp.int32), xp.reshape(heights, (-1,))
    pairs = [(m, n, xp.take(flat, first + (m * columns + n), axis=0)) for m in range(4) for n in range(4)]
    return tuple(sum(p[m] * q[n] * c for m, n, c in pairs) for p, q in ((b, a), (b, da), (db, a)))


def basis(t):
    """The four cubic B-splines over one interval, and their derivatives."""
    s = 1 - t
    values = s**3 / 6, (4 - 3 * t * t * (2 - t)) / 6, (4 - 3 * s * s * (2 - s)) / 6, t**3 / 6
    return values, (-s * s / 2, t * (3 * t - 4) / 2, s * (4 - 3 * s) / 2, t * t / 2)
