"""A surface that intersects rays itself: an axis-aligned ellipsoid."""

from rts import GBuffer, RaySurface
from rts.arrays.engines import namespace
from rts.operations.unit import unit
from rts.plugin_api.records import RayHits


class Ellipsoid(RaySurface):
    """θ["center"] (3,) and θ["radii"] (3,); the parameters of a sample are its point on the unit sphere."""

    sample_widths = (0, 3)

    def evaluate(self, theta, samples):
        gbuffer = GBuffer(position=theta["center"] + samples.params * theta["radii"])
        gbuffer.defer("normal", lambda: unit(samples.params / theta["radii"]))
        return gbuffer

    def intersect(self, theta, origins, directions, layers):
        xp = namespace(origins)
        o, d = (origins - theta["center"]) / theta["radii"], directions / theta["radii"]
        a, b, c = xp.sum(d * d, axis=1), xp.sum(o * d, axis=1), xp.sum(o * o, axis=1) - 1
        square = b * b - a * c
        root = xp.sqrt(xp.where(square > 0, square, 0.0))
        first, second = (-b - root) / a, (-b + root) / a
        outside = first >= 0
        nearest = xp.where(outside, first, second)
        distance = xp.stack([nearest, second, *[second] * (layers - 2)][:layers])
        seen = square > 0
        hit = xp.stack([seen & (second >= 0), seen & outside, *[seen & ~seen] * (layers - 2)][:layers])
        params = unit(o[None] + distance[..., None] * d[None])
        return RayHits(hit, distance, params)
