"""A scene for tests of `rts.Adaptive`, and masks that replace the choice of active pixels."""

import numpy as np
from helpers import icosphere, quad, to_numpy

import rts
from rts.sampling import fine_samples

MESH = rts.plugin("rts.surfaces", "mesh")
CAMERA = rts.Camera.look_at((0.4, 0.5, 3.2), (0, 0, 0))
SIZE = (21, 26)
BALL, FACES = icosphere(2, 0.8)
CARD, CARD_FACES = quad(-0.9, 0.7, -0.2, 1.1, -0.4)
FAR, FAR_FACES = quad(-40.0, 40.0, -30.0, -9.0, -60.0)


def scene(vertices=BALL, shader="unlit"):
    """A ball before a card before a far card; colours vary."""
    part = rts.Part(MESH(FACES), {"vertices": vertices, "colors": (BALL + 1) / 2}, shader)
    cards = [(CARD, CARD_FACES, (0.2, 0.9, 0.4)), (FAR, FAR_FACES, (0.9, 0.3, 0.1))]
    return [part, *(rts.Part(MESH(f), {"vertices": v, "color": np.array(c)}, shader) for v, f, c in cards)]


def render(parts, supersample, **options):
    return rts.render(parts, CAMERA, SIZE, supersample=supersample, **{"splatter": "visible", "layers": 3, **options})


def activate(monkeypatch, mask):
    """Make a mask of pixels (H, W) the active ones."""
    monkeypatch.setattr(fine_samples, "active", lambda *_, **__: np.ascontiguousarray(mask))


def random_mask(seed=0, share=0.3):
    return np.random.default_rng(seed).random(SIZE) < share


def apart(parts, mask, s, atol=1e-6, **options):
    """Compare an adaptive image with the finer one at active pixels, and with the plain one at the others."""
    adaptive = to_numpy(render(parts, rts.Adaptive(s), **options))
    finer, plain = (to_numpy(render(parts, n, **options)) for n in (s, 1))
    np.testing.assert_allclose(adaptive[mask], finer[mask], rtol=0, atol=atol)
    np.testing.assert_allclose(adaptive[~mask], plain[~mask], rtol=0, atol=atol)
