"""Views and losses that tests of surfaces share."""

import numpy as np

import rts
from rts.sampling import layer_order
from rts.sampling.packing import pack_fragments

SIZE = (24, 28)
CAMERA = rts.Camera.look_at((0.9, 1.6, 3.2), (0, 0, 0), aspect=28 / 24)
VIEWS = {
    "perspective": CAMERA,
    "orthographic": rts.Camera.orthographic((1.1, 1.3, 3.1), (0, 0.1, 0), height=3.1, aspect=28 / 24, near=0.5, far=9),
    "cut by near and far plane": rts.Camera.look_at((0.9, 1.6, 3.2), (0, 0, 0), aspect=28 / 24, near=3.3, far=4.2),
}


def rays_spread(camera, size=SIZE):
    return np.asarray(camera.rays(size).spread, np.float64)


def stages(part, camera, layers, size=SIZE):
    """Samples on the triangles, refined, and settled."""
    sampler, inputs = rts.plugin("samplers", "raster")(), part.theta["points"]
    proxy = part.surface.proxy(inputs, camera, size)
    lifted = pack_fragments(sampler.rasterize(sampler.prepare(proxy), camera, size, layers, "none"), proxy)
    moved, rays = layer_order.refined(part.surface, inputs, lifted, camera, {})
    return lifted, moved, layer_order.settle(moved, camera, rays.spread)


WEIGHTS = np.random.default_rng(0).normal(size=(*SIZE, 4)).astype(np.float32)


def loss_of(part, name, camera=CAMERA, **options):
    """A loss of the image, as a function of one entry of θ, an array of any engine."""

    def loss(value):
        image = rts.render(part.replace(theta={name: value}), camera, SIZE, **options)
        return (image * rts.engine_of(image).constant(WEIGHTS, image)).sum()

    return loss


def close(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-4 * np.abs(expected).max())
