"""A torus about the y axis, traced by its distance function: θ["radii"] (2,), of the ring and of the tube."""

import numpy as np

import rts
from rts.plugin_api.arrays import engine_of, namespace
from rts.plugin_api.bases import GBuffer, RaySurface
from rts.plugin_api.operations import gradient
from rts.plugin_api.records import RayHits

from .net import Net, random_net

EPSILON = 1e-3  # A step goes so much beyond the distance to the surface: only in there can the sign change.


def norm(xp, *xs):
    return xp.sqrt(sum(x * x for x in xs) + 1e-20)


def distance(radii, points):
    xp = namespace(radii, points)
    ring = norm(xp, points[..., 0], points[..., 2])
    return norm(xp, ring - radii[0], points[..., 1]) - radii[1]


class Torus(RaySurface):
    """A sample is two angles, about the axis and about the ring."""

    sample_widths = (0, 2)

    def check(self, theta):
        if "radii" not in theta or tuple(theta["radii"].shape) != (2,):
            raise rts.InputError("torus: θ['radii'] must be (2,), the radii of the ring and of the tube")

    def reads(self, theta):
        return ("radii",)

    def evaluate(self, theta, samples):
        radii = theta["radii"]
        xp = namespace(radii)
        angles = xp.astype(samples.params, radii.dtype)
        u, v = angles[:, 0], angles[:, 1]
        out = radii[0] + radii[1] * xp.cos(v)
        position = xp.stack([out * xp.cos(u), radii[1] * xp.sin(v), out * xp.sin(u)], axis=-1)
        gbuffer = GBuffer(position=position)
        gbuffer.defer("normal", lambda: gradient(lambda p: distance(radii, p), position))
        return gbuffer

    def intersect(self, theta, origins, directions, layers):
        radii, engine = theta["radii"], engine_of(origins)
        xp = namespace(origins)
        length = norm(xp, directions[:, 0], directions[:, 1], directions[:, 2])
        unit = directions / length[:, None]
        far = norm(xp, origins[:, 0], origins[:, 1], origins[:, 2]) + radii[0] + radii[1]
        layer = engine.constant(np.arange(layers)[:, None], origins)

        def at(t):
            return distance(radii, origins + t[:, None] * unit)

        def body(state):
            t, d, count, roots = state
            step = xp.where(t < far, xp.abs(d) + EPSILON, 0.0)  # Who is past it stays there.
            ahead = at(t + step)
            crossed = (d < 0) != (ahead < 0)
            change = xp.where(crossed, d - ahead, 1.0)
            root = t + step * d / change
            roots = xp.where(crossed[None] & (layer == count[None]), root[None], roots)
            return t + step, ahead, count + xp.astype(crossed, count.dtype), roots

        def going(state):
            t, _, count, _ = state
            return xp.any((t < far) & (count < layers))

        start = xp.zeros_like(length)
        count = xp.zeros_like(start, dtype=layer.dtype)
        roots = xp.zeros_like(start[None] + xp.astype(layer, start.dtype))
        _, _, count, roots = engine.repeat(body, going, (start, at(start), count, roots), 1000)
        hit = layer < count[None]
        points = origins + roots[..., None] * unit
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        angles = xp.stack([xp.atan2(z, x), xp.atan2(y, norm(xp, x, z) - radii[0])], axis=-1)
        return RayHits(hit=hit, distance=roots / length, params=angles)

    @staticmethod
    def example():
        theta = {"radii": np.array([0.9, 0.4], np.float32), "net": random_net()}
        return rts.Part(Torus(), theta, Net())
