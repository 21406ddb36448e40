"""A ring about the y axis: a smooth surface over (u, v), which triangles only stand for."""

import numpy as np

import rts
from rts.plugin_api.arrays import namespace
from rts.plugin_api.bases import GBuffer, TriangleSurface
from rts.plugin_api.checks import check_numbers
from rts.plugin_api.records import Proxy


class Ring(TriangleSurface):
    """θ["radii"] (2,), of the ring and of its tube. A sample is (u, v): turns about the axis and about the tube."""

    sample_widths = (0, 2)  # No integers, and u, v.
    centered = False  # A point of a triangle at (u, v) is not the surface's point at (u, v).

    def check(self, theta):
        check_numbers('theta["radii"]', theta.get("radii"), (2,))

    def proxy_inputs(self, theta):
        self.check(theta)
        return theta["radii"]

    def proxy(self, inputs, camera, size):
        u, v = np.meshgrid(np.linspace(0, 1, 65), np.linspace(0, 1, 33), indexing="ij")
        corners = np.stack([u, v], axis=-1).reshape(-1, 2)  # u = 0 and u = 1 both have a corner: no seam.
        number = np.arange(len(corners), dtype=np.int32).reshape(u.shape)
        a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
        faces = np.stack([a, b, c, b, d, c], axis=-1).reshape(-1, 3)
        points = position(np.asarray(inputs), corners).astype(np.float32)
        ids = np.zeros((len(faces), 0), np.int32)
        return Proxy(vertices=points, faces=faces, ids=ids, corner_params=corners[faces].astype(np.float32))

    def evaluate(self, theta, samples):
        self.check(theta)
        gbuffer = GBuffer(position=position(theta["radii"], samples.params))
        gbuffer.defer("normal", lambda: around(samples.params)[1])
        gbuffer.defer("uv", lambda: samples.params)
        return gbuffer

    @classmethod
    def example(cls):
        return rts.Part(cls(), {"radii": np.array([0.9, 0.4], np.float32)}, shader="lambert")


def around(params):
    """Directions (N, 3) from the axis to the middle of the tube, and from there to the surface."""
    xp = namespace(params)
    u, v = 2 * np.pi * params[:, 0], 2 * np.pi * params[:, 1]
    out = xp.stack([xp.cos(u), xp.zeros_like(u), xp.sin(u)], axis=-1)
    up = xp.stack([xp.zeros_like(u), xp.sin(v), xp.zeros_like(u)], axis=-1)
    return out, xp.cos(v)[:, None] * out + up


def position(radii, params):
    """Points (N, 3) of the surface."""
    out, normal = around(params)
    return radii[0] * out + radii[1] * normal
