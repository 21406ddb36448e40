"""A lofted surface: a skin of triangles over cross-sections."""

from dataclasses import dataclass

import numpy as np

import rts
from rts.plugin_api.checks import check_numbers, is_count
from rts.plugin_api.operations import interpolate
from rts.plugin_api.records import Proxy


@dataclass(frozen=True)
class Loft(rts.TriangleSurface):
    """A skin between cross-sections, each a polyline of as many points.

    θ["curves"] (sections, points, 3) are the points. Neighbours of two sections make a quadrilateral, cut into two
    triangles, which are the surface. Its outside is where (along a section) × (to the next section) points. For a
    tube, end each section with its first point.

    Attributes:
        sections: how many cross-sections there are, at least 2.
        points: how many points make a cross-section, at least 2.
    """

    sections: int
    points: int

    sample_widths = (3, 2)  # The corners of the triangle, in the flattened grid, and barycentrics.
    param_step = 0.25  # Position and uv are linear in the barycentrics.
    proxy_is_cheap = True

    def __post_init__(self):
        for name in ("sections", "points"):
            if not is_count(getattr(self, name)) or getattr(self, name) < 2:
                raise rts.InputError(f"A loft's {name} must be a whole number of at least 2.")

    @property
    def face_count(self):
        return 2 * (self.sections - 1) * (self.points - 1)

    def reads(self, theta):
        return ("curves",)

    def check(self, theta):
        if "curves" not in theta:
            raise rts.InputError('A loft needs θ["curves"].')
        check_numbers('θ["curves"]', theta["curves"], (self.sections, self.points, 3))

    def proxy_inputs(self, theta):
        self.check(theta)
        return rts.namespace(theta["curves"]).reshape(theta["curves"], (-1, 3))

    def proxy(self, inputs, camera, size):
        return Proxy(np.asarray(inputs, np.float32), self.faces())

    def pieces(self, proxy):
        return np.ones(1, np.int16)  # All triangles are wound alike.

    def faces(self):
        """(T, 3) int32, the triangles by the points' numbers in the flattened grid."""
        grid = np.arange(self.sections * self.points, dtype=np.int32).reshape(self.sections, self.points)
        a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]
        return np.stack([a, b, c, b, d, c], axis=-1).reshape(-1, 3)

    def evaluate(self, theta, samples):
        """Position, normal (mean of the neighbours', interpolated) and uv: u along sections, v from first to last."""
        self.check(theta)
        curves = theta["curves"]
        xp = rts.namespace(curves)

        def at(grid):  # (sections, points, C) at the samples.
            return interpolate(xp.reshape(grid, (-1, grid.shape[2])), samples.ids, 0, samples.params)

        def normal():
            return at(xp.linalg.cross(differences(xp, curves, 1), differences(xp, curves, 0)))

        def uv():
            u, v = np.meshgrid(np.linspace(0, 1, self.points), np.linspace(0, 1, self.sections))
            return at(rts.engine_of(curves).constant(np.stack([u, v], axis=-1), curves))

        gbuffer = rts.GBuffer(position=at(curves))
        gbuffer.defer("normal", normal)
        gbuffer.defer("uv", uv)
        return gbuffer

    @classmethod
    def example(cls):
        """A wavy arch of seven sections."""
        along, arc = np.meshgrid(np.linspace(-1, 1, 7), np.linspace(0.15, np.pi - 0.15, 9), indexing="ij")
        radius = 0.8 + 0.2 * np.sin(3 * along)
        curves = np.stack([radius * np.cos(arc), radius * np.sin(arc) - 0.4, along], axis=-1)
        return rts.Part(cls(7, 9), {"curves": curves[::-1].astype(np.float32)}, "lambert")


def differences(xp, grid, axis):
    """Central differences along an axis of a grid (m, n, C), one-sided ones at its ends; not divided by a step."""
    low, high = ((slice(None),) * axis + (part,) for part in (slice(None, 1), slice(-1, None)))
    before, after = ((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
    return xp.concat([grid[after], grid[high]], axis=axis) - xp.concat([grid[low], grid[before]], axis=axis)
