"""A lofted surface: a skin of triangles over closed cross-sections."""

from dataclasses import dataclass

import numpy as np

import rts
from rts.plugin_api.arrays import engine_of, namespace
from rts.plugin_api.bases import GBuffer, TriangleSurface
from rts.plugin_api.checks import check_numbers
from rts.plugin_api.operations import interpolate
from rts.plugin_api.records import Proxy


@dataclass(frozen=True)
class Loft(TriangleSurface):
    """A skin over closed polygons: θ["curves"] (sections, points, 3), counter-clockwise seen from the last section."""

    sections: int
    points: int

    sample_widths = (3, 2)  # The three corners of a triangle, and two barycentrics.

    def check(self, theta):
        check_numbers('theta["curves"]', theta.get("curves"), (self.sections, self.points, 3))

    def proxy_inputs(self, theta):
        self.check(theta)
        return rows(theta["curves"])

    def proxy(self, inputs, camera, size):
        corner = np.arange(len(inputs), dtype=np.int32).reshape(self.sections, self.points + 1)
        a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
        faces = np.stack([a, b, c, b, d, c], axis=-1).reshape(-1, 3)
        return Proxy(vertices=np.asarray(inputs, np.float32), faces=faces)

    def evaluate(self, theta, samples):
        self.check(theta)
        curves = theta["curves"]
        xp = namespace(curves)

        def normal():
            around = xp.roll(curves, -1, axis=1) - xp.roll(curves, 1, axis=1)
            along = xp.concat([curves[1:], curves[-1:]]) - xp.concat([curves[:1], curves[:-1]])
            return interpolate(rows(xp.linalg.cross(around, along)), samples.ids, 0, samples.params)

        def uv():
            u, v = np.meshgrid(np.linspace(0, 1, self.points + 1), np.linspace(0, 1, self.sections))
            corners = engine_of(curves).constant(np.stack([u, v], axis=-1).reshape(-1, 2), curves)
            return interpolate(corners, samples.ids, 0, samples.params)

        gbuffer = GBuffer(position=interpolate(rows(curves), samples.ids, 0, samples.params))
        gbuffer.defer("normal", normal)
        gbuffer.defer("uv", uv)
        return gbuffer

    @classmethod
    def example(cls):
        z, turn = np.meshgrid(np.linspace(-1, 1, 7), 2 * np.pi * np.arange(12) / 12, indexing="ij")
        radius = 0.6 + 0.2 * np.sin(3 * z)
        curves = np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=-1)
        return rts.Part(cls(7, 12), {"curves": curves.astype(np.float32)}, shader="lambert")


def rows(grid):
    """The rows (sections * (points + 1), 3) of a grid whose first column is repeated as its last."""
    xp = namespace(grid)
    return xp.reshape(xp.concat([grid, grid[:, :1]], axis=1), (-1, grid.shape[2]))
