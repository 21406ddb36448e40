"""Outlines of fields move as closed forms say: balls, tori, cylinders and rounded boxes, grown, shifted and turned."""

import math

import numpy as np
import pytest
from found_outlines import sampled_with_outlines
from helpers import TORCH, arrays, quick, to_numpy

import rts
from rts import Camera, Part
from rts_surfaces.implicit.deepest import deepest
from rts_surfaces.implicit.narrow_band import NarrowBand

pytestmark = pytest.mark.rendering

Sdf, Isosurface = rts.plugin("surfaces", "sdf"), rts.plugin("surfaces", "isosurface")
SIZE, HEIGHT = (80, 80), 3.2
PIXEL = HEIGHT / SIZE[0]
BOUNDS, SHAPE = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5)), (121, 121, 121)
SHIFT = 0.013
"""Keeps outlines off the symmetry of the pixels."""
WALL = 0.05
"""Half the thickness of a wall."""


# -------------------------------------------------------------------------------------------------------- fields


def length(x):
    return rts.namespace(x).sqrt(rts.namespace(x).sum(x * x, axis=-1) + 1e-12)


def stack(*columns):
    return rts.namespace(columns[0]).stack(list(columns), axis=-1)


def ball(q, p):
    return length(p) - q[0]


def shell(q, p):
    """A hollow ball, whose wall is four cells of the lattice thick."""
    return rts.namespace(p).abs(length(p) - q[0]) - WALL


def torus(q, p):
    """About the y axis: radii of the ring and of the tube."""
    return length(stack(length(stack(p[:, 0], p[:, 2])) - q[0], p[:, 1])) - q[1]


def cylinder(q, p):
    """About the y axis: radius and half the height."""
    xp = rts.namespace(p)
    return xp.maximum(length(stack(p[:, 0], p[:, 2])) - q[0], xp.abs(p[:, 1]) - q[1])


def rounded_box(q, p):
    """Half the sides within the rounding along x and z, of 0.5 along y; turned about y by the third entry."""
    xp = rts.namespace(p)
    c, s = xp.cos(q[2]), xp.sin(q[2])
    x, z = c * p[:, 0] - s * p[:, 2], s * p[:, 0] + c * p[:, 2]
    d = stack(xp.abs(x) - q[0], xp.abs(p[:, 1]) - 0.5, xp.abs(z) - q[1])
    return length(xp.clip(d, 0.0, None)) + xp.clip(xp.max(d, axis=-1), None, 0.0) - 0.1


def shadow(q):
    """Derivatives of the area of the turned box as seen along z: a rectangle with rounded corners."""
    c, s, high = math.cos(q[2]), math.sin(q[2]), 2 * (0.5 + 0.1)
    return 2 * c * high, 2 * s * high, (2 * q[1] * c - 2 * q[0] * s) * high


ALONG, ACROSS = (0, 4, 0), (0, 0, 4)
SHAPES = {
    "ball": (ball, (0.9,), ACROSS, lambda q: [2 * math.pi * q[0]]),
    "shell": (shell, (0.9,), ACROSS, lambda q: [2 * math.pi * (q[0] + WALL)]),
    "torus along its axis": (torus, (0.9, 0.3), ALONG, lambda q: [4 * math.pi * q[1], 4 * math.pi * q[0]]),
    "torus across": (torus, (0.9, 0.3), ACROSS, lambda q: [4 * q[1], 4 * q[0] + 2 * math.pi * q[1]]),
    "cylinder across": (cylinder, (0.7, 0.6), ACROSS, lambda q: [4 * q[1], 4 * q[0]]),
    "cylinder along": (cylinder, (0.7, 0.6), ALONG, lambda q: [2 * math.pi * q[0], 0]),
    "box, turned": (rounded_box, (0.6, 0.4, 0.5), ACROSS, shadow),
}
"""A field, its parameters, the eye, and the derivatives of the area of its outline."""

WAYS = {
    "sdf": lambda f: (Sdf(f, 1.6, lipschitz=None), {"sampler": "rays"}),
    "rays": lambda f: (Isosurface(BOUNDS, f=f, shape=SHAPE), {"sampler": "rays"}),
    "lattice": lambda f: (Isosurface(BOUNDS, f=f, shape=SHAPE), {}),
    "edge": lambda f: (Isosurface(BOUNDS, f=f, shape=SHAPE, motion="edge"), {}),
    "band": lambda f: (Isosurface(BOUNDS, f=f, shape=SHAPE, band=NarrowBand()), {}),
}


def camera(eye):
    up = (0, 1, 0) if eye[1] == 0 else (0, 0, -1)
    return Camera.orthographic(eye, (0, 0, 0), up, height=HEIGHT)


def coverage(f, eye, way, **more):
    """A function of q and a shift (3,) to the coverage (H, W) of a field."""
    surface, options = WAYS[way](lambda theta, p: f(theta["q"], p - theta["shift"]))

    def image(q, shift):
        return rts.render(Part(surface, {"q": q, "shift": shift}, "silhouette"), camera(eye), SIZE, **options, **more)[
            ..., 3
        ]

    return image


@pytest.mark.parametrize("way", quick(["lattice", "sdf", "rays", "edge", "band"], 2))
@pytest.mark.parametrize("name", SHAPES)
def test_areas_of_outlines_grow_as_closed_forms_say(name, way):
    torch = pytest.importorskip("torch")
    f, q, eye, expected = SHAPES[name]
    image, shift = coverage(f, eye, way), torch.tensor([SHIFT, SHIFT, SHIFT])
    found = torch.func.jacrev(lambda q: image(q, shift).sum() * PIXEL**2)(torch.tensor(q)).numpy()
    np.testing.assert_allclose(found, expected(q), rtol=0.02, atol=0.02 * max(map(abs, expected(q))))


@pytest.mark.parametrize("way", quick(["lattice", "sdf", "edge", "rays", "band"]))
@pytest.mark.parametrize("name", ["torus across", "box, turned"])
def test_outlines_shift_with_the_surface(name, way):
    """As x shifts by one unit, the sum of x · α grows by the area; and nothing grows."""
    torch = pytest.importorskip("torch")
    f, q, eye, _ = SHAPES[name]
    image, q = coverage(f, eye, way, supersample=2), torch.tensor(q)
    x = (torch.arange(SIZE[1]) + 0.5 - SIZE[1] / 2) * PIXEL
    shift = torch.tensor([SHIFT, SHIFT, SHIFT])
    area = float(image(q, shift).sum()) * PIXEL**2
    moment, grown = torch.func.jacrev(lambda s: torch.stack([(x * image(q, s)).sum(), image(q, s).sum()]) * PIXEL**2)(
        shift
    ).numpy()[:, 0]
    assert abs(moment - area) < 0.02 * area
    assert abs(grown) < 0.02 * area


# -------------------------------------------------------------------------------------------------- deepest points


def unit_rays(count, seed=0):
    """Rays along −z towards a unit ball, from its surface, at distances below one from its axis."""
    rng = np.random.default_rng(seed)
    angle, off = rng.uniform(0, 2 * math.pi, count), np.sqrt(rng.uniform(0.5, 0.99, count))
    points = np.stack([off * np.cos(angle), off * np.sin(angle), np.sqrt(1 - off**2)], axis=1)
    return points, np.tile([0.0, 0.0, -2.0], (count, 1)), off


@pytest.mark.parametrize("target", ["numpy", *TORCH, pytest.param("jax", marks=pytest.mark.thorough)])
def test_the_deepest_point_of_a_ball_is_nearest_to_its_centre(target):
    points, directions, off = unit_rays(50)
    given = (arrays(target, x, np.float64) for x in (points, directions, np.full(50, 0.5)))
    params, there = map(to_numpy, deepest(lambda p: length(p) - 1, lambda p: p[:, 0] == p[:, 0], *given))
    np.testing.assert_array_equal(there, 1 - off < 0.5)
    pair, own = params[there].astype(np.float64), points[there] * [1, 1, 0]
    np.testing.assert_allclose(pair[:, :, :3], np.repeat(own[:, None], 2, axis=1), atol=2e-3)
    # Growing by one moves the outline by one, outwards.
    np.testing.assert_allclose(pair[:, :, 3:6].mean(axis=1), own / off[there, None], atol=5e-3)
    np.testing.assert_allclose(pair[:, 0, 6], off[there] - 1, atol=1e-5)


def test_at_a_kink_each_side_has_its_share():
    """A wedge of two planes, seen along −z: its edge moves by each plane as their slopes along the ray say."""
    tilts = np.radians([[35.0, 60.0]])
    a, b = (np.array([math.sin(t), 0, s * math.cos(t)]) for t, s in zip(tilts[0], (1, -1), strict=True))

    def level(p):
        return np.maximum(p @ a, p @ b)

    x = np.array([-0.02, -0.1])
    points = np.stack([x, 0 * x, -x * math.tan(tilts[0, 0])], axis=1)
    params, there = deepest(level, lambda p: p[:, 0] < 9, points, np.tile([0.0, 0, -1], (2, 1)), np.full(2, 0.5))
    assert there.all()
    # The edge a · p = b · p = 0 seen along z: level of the ray is the combination without z.
    share = math.cos(tilts[0, 1]) / np.cos(tilts[0]).sum()
    g = share * a + (1 - share) * b
    np.testing.assert_allclose(params[:, 0, 3], 2 * share / g[0], rtol=1e-5)
    np.testing.assert_allclose(params[:, 1, 3], 2 * (1 - share) / g[0], rtol=1e-5)
    assert (params[:, 0, 2] > params[:, 1, 2]).all()


def test_rays_through_the_middle_of_a_wall_have_no_pair():
    """A wall across the ray has an outline nowhere near; and a ray that finds no least level has none."""
    points, directions = np.array([[0.0, 0, 0.3], [0, 0, 0]]), np.tile([0.0, 0, -1], (2, 1))

    def level(p):
        return np.where(p[:, 0] == 0, np.abs(p[:, 2]) - 0.3, 0)

    _, there = deepest(level, lambda p: p[:, 0] < 9, points[:1], directions[:1], np.full(1, 0.5))
    assert not there.any()
    _, there = deepest(lambda p: p[:, 2], lambda p: p[:, 0] < 9, points[1:], directions[1:], np.full(1, 0.5))
    assert not there.any()


# -------------------------------------------------------------------------------------------------------- samplers


def paired(name, way):
    """Outlines of a shape, and for each crossing that has a pair the positions (B, 2, 3) of both, in pixels."""
    f, q, eye, _ = SHAPES[name]
    surface, options = WAYS[way](lambda theta, p: f(theta["q"], p))
    part = Part(surface, {"q": np.array(q, np.float32)}, "silhouette")
    found, outlines = sampled_with_outlines(part, camera(eye), SIZE, **options)
    points = np.asarray(surface.evaluate(part.theta, found.samples[0])["position"])
    wide = camera(eye).for_size(SIZE).with_border(SIZE, found.border)
    places = np.asarray(wide.project(points, found.row.shape[1:]))
    return outlines, places[np.maximum(outlines.rows[:, 4:], 0)], places


@pytest.mark.parametrize("way", quick(list(WAYS), 4))
def test_pairs_lie_on_the_rays_of_the_last_samples_behind_them(way):
    outlines, pairs, places = paired("torus across", way)
    pair = outlines.rows[:, 4:]
    there, index = pair[:, 0] >= 0, np.arange(len(outlines.kind))
    # Rays leave a band where pixels are wider than cells.
    assert there.mean() > (0.1 if way == "band" else 0.9) and (pair[~there] == -1).all()
    last = places[outlines.rows[index, np.minimum(outlines.kind, 1)]]
    for side in (0, 1):
        np.testing.assert_allclose(pairs[there, side, :2], last[there, :2], atol=2e-3)
        assert (pairs[there, side, 2] > last[there, 2] - 1e-4).all()
