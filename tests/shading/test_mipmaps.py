"""Mipmaps: pyramids, footprints of uv and what they make of textures, by closed form and against brute force."""

import numpy as np
import pytest
from helpers import (
    ALL,
    DIFFERENTIABLE,
    FRONT,
    SIZE,
    arrays,
    finite_difference,
    gradient,
    mesh_part,
    quad,
    rigid,
    show,
    to_numpy,
)

import rts
from rts import Camera, GBuffer
from rts.contracts.records import Cells
from rts.errors import InputError
from rts.operations.texels import TEXELS
from rts.plugin_api.records import Samples
from rts.shading.mipmaps import level_of, mip_levels
from rts.shading.shaders import Textured
from rts.shading.textures import sample_texture
from rts.shading.uv_footprints import uv_footprint

pytestmark = pytest.mark.rendering

RNG = np.random.default_rng(0)
CORNERS = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
EYE = Camera.look_at((0.4, 0.7, 4), (0, 0, 0), fov_y=50, aspect=1.2)


def footprint_of_u(theta, gbuffer, camera):
    """∂u/∂x and ∂u/∂y as red and green."""
    f = gbuffer["uv_footprint"]
    xp = rts.namespace(f)
    one = xp.ones_like(f[:, :1])
    return xp.concat([xp.abs(f[:, 0:1]), xp.abs(f[:, 2:3]), 0 * one, one], axis=1)


def uv_colors(theta, gbuffer, camera):
    uv = gbuffer["uv"]
    xp = rts.namespace(uv)
    return xp.concat([uv, 0 * uv[:, :1], xp.ones_like(uv[:, :1])], axis=1)


def floor(texture, repeats, **options):
    """A floor below the eye, the texture repeated."""
    vertices = np.array([(-8, -1, 4), (8, -1, 4), (8, -1, -40), (-8, -1, -40)], np.float32)
    theta = {"texture": texture, "uv": CORNERS * np.array(repeats, np.float32)}
    return mesh_part((vertices, np.array([(0, 1, 2), (0, 2, 3)])), theta=theta, **options)


# -------------------------------------------------------------------------------------------------- the pyramid


@pytest.mark.parametrize(
    "target, size", [*((t, (5, 7)) for t in ALL), *(("numpy", size) for size in ((8, 4), (1, 6), (3, 1), (1, 1)))]
)
def test_each_level_averages_equal_areas_of_the_one_before(target, size):
    texture = RNG.random((*size, 3))
    levels = [to_numpy(x) for x in mip_levels(arrays(target, texture))]
    assert [x.shape[:2] for x in levels][-1] == (1, 1)
    np.testing.assert_allclose(levels[0], texture, atol=1e-6)
    for above, below in zip(levels, levels[1:], strict=False):
        (h, w), (m, n) = above.shape[:2], below.shape[:2]
        assert (m, n) == (max(h // 2, 1), max(w // 2, 1))
        fine = above.repeat(m, axis=0).repeat(n, axis=1)  # (h m, w n): whole numbers of both.
        np.testing.assert_allclose(below, fine.reshape(m, h, n, w, 3).mean(axis=(1, 3)), atol=1e-6)


def test_a_footprint_is_a_few_texels_of_its_level():
    sides = np.exp(RNG.uniform(-2, 3, (300, 2)))
    longer, shorter = sides.max(axis=1), sides.min(axis=1)
    turned, other = (np.array([np.cos(a), np.sin(a)]).T for a in RNG.uniform(0, 6, (2, 300)))
    along, across = turned * longer[:, None], np.stack([-turned[:, 1], turned[:, 0]], axis=1) * shorter[:, None]
    x, y = (other[:, i : i + 1] * along + (1 - 2 * i) * other[:, 1 - i : 2 - i] * across for i in (0, 1))
    texel = 2 ** level_of(np.concatenate([x, y], axis=1) / [64, 16, 64, 16], (16, 64))
    coarse = (texel > 1) & (texel < 64)
    slender = longer > 3.2 * shorter
    assert (slender & coarse).sum() > 50 and (~slender & coarse).sum() > 20
    np.testing.assert_allclose((shorter / texel)[coarse & ~slender], 2.5, rtol=1e-6)
    np.testing.assert_allclose((longer / texel)[coarse & slender], 8, rtol=1e-6)
    assert (longer[texel == 1] <= 8 + 1e-9).all()


def test_wild_footprints_have_a_level():
    footprint = np.array([(0, 0, 0, 0), (9, 0, 0, 18), (0, np.inf, 0, 0), (0, np.nan, 0, 0), (1e30, 0, 0, 0)])
    level = level_of(footprint.astype(np.float32), (8, 16))
    np.testing.assert_allclose(level[[0, 1, 3]], [0, 4, 0])
    assert (level >= 0).all() and (level <= 4).all()


@pytest.mark.parametrize("target", ALL)
def test_lookup_is_linear_between_levels(target):
    texture, uv = RNG.random((6, 5, 3)), RNG.uniform(-1, 2, (20, 2))
    for level in (0, 0.25, 1, 1.75, 2, 7):
        side = 2.5 * 2**level
        footprint = np.tile([side / 5, 0, 0, side / 6], (20, 1))
        finer, share = (min(int(level), 1), min(level, 2) - min(int(level), 1))
        a, b = (sample_texture(x, uv, "repeat", footprint) for x in mip_levels(texture)[finer : finer + 2])
        given = arrays(target, (texture, uv, footprint))
        found = to_numpy(sample_texture(given[0], given[1], "repeat", given[2], mip=True))
        np.testing.assert_allclose(found, a + share * (b - a), atol=2e-5)


# ---------------------------------------------------------------------------------------- means over footprints


@pytest.mark.parametrize("target", ALL)
def test_footprints_are_means_of_lookups_side_by_side(target):
    texture, uv = RNG.random((12, 10, 3)), RNG.uniform(-1, 2, (200, 2))
    footprint = RNG.uniform(-1, 1, (200, 4)) * np.exp(RNG.uniform(-4, 0.3, (200, 2))).repeat(2, axis=1)
    a, b = footprint[:, :2], footprint[:, 2:]
    counts = [
        np.select([n <= 0.5, n <= 3, n <= 6], [1, 2, 4], 8) for n in (np.hypot(*(x * [10, 12]).T) for x in (a, b))
    ]
    counts = [np.where(other >= 4, np.minimum(own, 4), own) for own, other in (counts, counts[::-1])]
    assert {(1, 1), (2, 2), (2, 4), (4, 4), (8, 2)} <= set(zip(*counts, strict=True))
    expected = np.zeros((200, 3))
    for n, (i, j) in enumerate(zip(*counts, strict=True)):
        s, t = (((np.arange(m) + 0.5) / m - 0.5)[:, None] for m in (i, j))
        places = (uv[n] + s * a[n])[:, None] + t * b[n]
        expected[n] = sample_texture(texture, places.reshape(-1, 2)).mean(axis=0)
    given = arrays(target, (texture, uv, footprint))
    np.testing.assert_allclose(to_numpy(sample_texture(given[0], given[1], "repeat", given[2])), expected, atol=2e-5)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("mip", [False, True])
def test_the_derivative_in_uv_is_that_of_the_mean(target, mip):
    """Along a side it is the difference of the means over the two sides across: here of a ramp, and of steps."""
    steps = np.repeat(np.repeat(np.arange(16) % 2, 4)[None, :, None] * 1.0, 48, axis=0)  # Along u, four texels each.
    ramp = np.repeat(np.linspace(1, 0, 48)[:, None, None], 64, axis=1)  # Along v, from 1 down to 0.
    texture, uv = np.concatenate([steps, ramp, 0 * ramp], axis=2), RNG.uniform(0.3, 0.7, (200, 2))
    footprint = np.tile([2.0 / 64, 0.5 / 48, -0.6 / 64, 2.4 / 48], (200, 1))
    on = arrays(target, (texture, footprint))
    of_steps, of_ramp = (
        gradient(
            target, lambda x, k=k: sample_texture(on[0], x, "repeat", on[1], mip=mip)[:, k].sum(), arrays(target, uv)
        )
        for k in (0, 1)
    )
    np.testing.assert_allclose(of_ramp, np.tile([0, 48 / 47], (200, 1)), atol=2e-3)
    # By closed form: the mean over many more places.
    s, t = np.meshgrid((np.arange(64) + 0.5) / 64 - 0.5, (np.arange(64) + 0.5) / 64 - 0.5)
    inside = np.stack([s * footprint[0, i] + t * footprint[0, 2 + i] for i in (0, 1)], axis=-1).reshape(-1, 2)
    slopes = []
    for place in uv:
        a, b = (sample_texture(texture, place + inside + [d, 0])[:, 0].mean() for d in (0.01 / 64, -0.01 / 64))
        slopes.append((a - b) / (0.02 / 64))
    error = np.linalg.norm(of_steps[:, 0] - slopes) / np.linalg.norm(slopes)
    assert error < 0.12  # A texel's own slope is off by 1.0.
    by_points = gradient(target, lambda x: sample_texture(on[0], x)[:, 0].sum(), arrays(target, uv))
    assert np.linalg.norm(by_points[:, 0] - slopes) / np.linalg.norm(slopes) > 0.5


def test_footprints_that_are_slivers_or_lines_tell_what_they_can():
    """Sides of one direction, and one side alone: along it the derivative is a difference, else the mean slope."""
    ramp = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0)), axis=-1)
    texture, uv = np.concatenate([ramp, 0 * ramp[..., :1]], axis=2), np.full((4, 2), 0.5)
    footprint = np.array([(4, 0, 2, 0), (4, 4, -4, -4), (0, 3, 0, 0), (0, 0, 0.01, 3)]) / 20
    for moved, of_x, of_y in (((1, 0), 20, 0), ((0, 1), 0, -20)):
        out = np.empty((4, 3))
        TEXELS.push(
            [texture.reshape(-1, 3), uv, np.zeros(0, np.int32), footprint],
            [None, np.tile(np.float64(moved), (4, 1))],
            out,
            sizes=((20, 20),),
            wrap=("clamp", "clamp"),
            filter="linear",
        )
        np.testing.assert_allclose(out, np.tile([of_x, of_y, 0], (4, 1)), atol=1e-9)


@pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
def test_wrap_modes_hold_in_every_level(wrap):
    texture, uv, coarse = RNG.random((8, 8, 3)), RNG.uniform(-2, 3, (50, 2)), np.zeros((50, 4))
    coarse[:, [0, 3]] = 5 / 8  # Level 1.
    expected = sample_texture(mip_levels(texture)[1], uv, wrap, coarse)
    np.testing.assert_allclose(sample_texture(texture, uv, wrap, coarse, mip=True), expected, atol=1e-12)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("mip", [False, True])
def test_gradients_in_the_texture_are_finite_differences(target, mip):
    given = {"texture": RNG.random((5, 6, 3))}
    uv, footprint, weights = RNG.uniform(0, 1, (7, 2)), RNG.uniform(0, 0.7, (7, 4)), RNG.standard_normal((7, 3))

    def f(x, uv=uv, footprint=footprint, weights=weights):
        return (sample_texture(x["texture"], uv, "repeat", footprint, mip=mip) * weights).sum()

    on = arrays(target, (uv, footprint, weights))
    found = gradient(target, lambda x: f(x, *on), arrays(target, given))
    expected = finite_difference(f, given)
    for name in given:
        np.testing.assert_allclose(found[name], expected[name], atol=2e-4 * np.abs(expected[name]).max())


# ------------------------------------------------------------------------------------------------ the footprint


@pytest.mark.parametrize("target", ALL)
def test_parallel_to_the_image_it_is_texture_over_pixels(target):
    part = mesh_part(quad(-2.4, 2.4, -2, 2), theta={"uv": CORNERS * 3}, shader=footprint_of_u)
    image = show(arrays(target, part), arrays(target, FRONT), splatter="none")
    np.testing.assert_allclose(image[..., 0], 3 / 24, rtol=1e-4)
    np.testing.assert_allclose(image[..., 1], 0, atol=1e-5)


def test_in_perspective_it_is_the_derivative_of_uv_on_the_plane():
    part = floor(np.ones((2, 2, 3)), (1, 1), shader=footprint_of_u)
    turned = part.replace(theta={**part.theta, "uv": part.theta["uv"][:, ::-1].copy()})
    found = np.concatenate([show(p, EYE, splatter="none")[..., :2] for p in (part, turned)], axis=-1)
    step = 1e-4
    shifts: list = [(0, 0), (0, step), (step, 0)]
    rays = [EYE.window(SIZE, shift, SIZE).rays(SIZE) for shift in shifts]
    points = [r.origins + ((-1 - r.origins[..., 1]) / r.directions[..., 1])[..., None] * r.directions for r in rays]
    uv = [np.stack([(p[..., 0] + 8) / 16, (4 - p[..., 2]) / 44], axis=-1) for p in points]
    along_x, along_y = ((x - uv[0]) / step for x in uv[1:])
    seen = found.any(axis=-1)
    expected = np.stack([along_x[..., 0], along_y[..., 0], along_x[..., 1], along_y[..., 1]], axis=-1)
    assert seen.sum() > 200
    np.testing.assert_allclose(found[seen], np.abs(expected[seen]), rtol=2e-3, atol=2e-5)


def test_a_transform_moves_it_as_moved_vertices_do():
    transform = rigid((1, 2, 0), 50, (0.1, 0.2, -0.3))
    transform[:3, :3] *= 1.5
    vertices, faces = quad()
    theta = {"uv": CORNERS}
    one = show(mesh_part((vertices, faces), theta=theta, shader=footprint_of_u, transform=transform), EYE)
    there = (vertices @ transform[:3, :3].T + transform[:3, 3]).astype(np.float32)
    np.testing.assert_allclose(one, show(mesh_part((there, faces), theta=theta, shader=footprint_of_u), EYE), atol=1e-4)


def surfaces():
    yield "bspline", lambda: (rts.plugin("surfaces", "bspline")((4, 4), "clamped"), "points", (4, 4))
    yield "bezier", lambda: (rts.plugin("surfaces", "bezier")(np.arange(16).reshape(1, 16)), "points", (16,))
    yield "subdivision", lambda: (rts.plugin("surfaces", "subdivision")(cage()), "vertices", (16,))
    yield (
        "subdivision of triangles",
        lambda: (
            rts.plugin("surfaces", "subdivision")(
                [t for a, b, c, d in cage() for t in ((a, b, c), (a, c, d))], scheme="loop"
            ),
            "vertices",
            (16,),
        ),
    )


def cage():
    return [(4 * i + j, 4 * i + j + 4, 4 * i + j + 5, 4 * i + j + 1) for i in range(3) for j in range(3)]


@pytest.mark.parametrize("make", [pytest.param(f, id=name) for name, f in surfaces()])
def test_on_curved_surfaces_it_is_what_uv_changes_by_from_pixel_to_pixel(make):
    try:
        surface, name, shape = make()
    except rts.errors.PluginError as error:
        pytest.skip(str(error))
    x, y = np.meshgrid(np.linspace(-2, 2, 4), np.linspace(-2, 2, 4), indexing="ij")
    points = np.stack([x, y, 0.3 * x * y - 0.2 * x * x], axis=-1).astype(np.float32)
    uv = (points[..., :2] + 0.1 * points[..., 1::-1] ** 2).astype(np.float32)
    part = rts.Part(surface, {name: points.reshape(*shape, 3), "uv": uv.reshape(*shape, 2)}, uv_colors)
    size = (40, 48)
    at = show(part, EYE, size, splatter="none")
    found = show(part.replace(shader=footprint_of_u), EYE, size, splatter="none")[..., :2]
    expected = np.abs(np.stack([np.gradient(at[..., 0], axis=1), np.gradient(at[..., 0], axis=0)], axis=-1))
    inner = at[..., 3] > 0
    for axis in (0, 1):
        inner &= np.roll(inner, 1, axis) & np.roll(inner, -1, axis)
    inner[[0, -1]] = inner[:, [0, -1]] = False
    assert inner.sum() > 300
    assert np.abs(found - expected)[inner].max() < 0.02 * expected[inner].max()


def test_more_samples_have_smaller_footprints():
    vertices, faces = quad(-1.5, 1.5, -1.2, 1.2)
    part = mesh_part((vertices, faces), theta={"uv": CORNERS}, shader=footprint_of_u)
    coarse, fine = (show(part, FRONT, splatter="none", supersample=s)[..., 0] for s in (1, 4))
    inside = coarse > 0
    step = 1 / 3 * 4 / 20
    np.testing.assert_allclose(coarse[inside], step, rtol=1e-4)
    deep = inside.copy()
    for axis in (0, 1):
        for shift in (-1, 1):
            deep &= np.roll(inside, shift, axis)
    np.testing.assert_allclose(fine[deep], step / 4, rtol=1e-4)


# -------------------------------------------------------------------------------------------------- the images


@pytest.mark.parametrize("target", ALL)
def test_a_texture_of_4_x_4_texels_a_pixel_is_averaged(target):
    texture = RNG.random((80, 96, 3))
    theta = {"texture": texture, "uv": CORNERS}
    part = mesh_part(quad(-2.4, 2.4, -2, 2), theta=theta, shader=Textured(mip=True))
    found = show(arrays(target, part), arrays(target, FRONT), splatter="none")[..., :3]
    # Sixteen lookups a pixel lie on the centres of its texels.
    plain = show(arrays(target, part.replace(shader="textured")), arrays(target, FRONT), splatter="none")[..., :3]
    np.testing.assert_allclose(plain, texture.reshape(20, 4, 24, 4, 3).mean(axis=(1, 3)), atol=1e-4)
    # Mipmaps are the mean of this and of a level of 2 x 2 texels.
    brute = show(part.replace(shader="textured"), FRONT, splatter="none", supersample=16)[..., :3]
    assert np.sqrt(np.mean((found - brute) ** 2)) < 0.25 * np.std(brute)


@pytest.mark.parametrize("target", ALL)
def test_transparent_texels_count_by_their_alpha(target):
    # Half of the texels are white, the others black and not there: what is seen is half white.
    texture = np.where((np.indices((80, 96)).sum(axis=0) % 2)[..., None], 0.0, np.ones(4))
    part = mesh_part(quad(-2.4, 2.4, -2, 2), theta={"texture": texture, "uv": CORNERS})
    part = part.replace(shader=Textured(mip=True, opaque=False))
    found = show(arrays(target, part), arrays(target, FRONT), splatter="none")
    np.testing.assert_allclose(found, 0.5, atol=1e-5)


def test_what_a_texture_cuts_out_has_smooth_edges():
    y, x = (np.mgrid[:512, :512] + 0.5) / 512 - 0.5
    disk = np.stack([np.ones((512, 512))] * 3 + [x**2 + y**2 < 0.3**2], axis=-1).astype(np.float32)

    def alpha(supersample=1, **options):
        shader = rts.plugin("shaders", "unlit")(opaque=False, **options)
        part = mesh_part(quad(), shader=shader, theta={"texture": disk, "uv": CORNERS})
        return show(part, EYE, size=(40, 48), supersample=supersample)[..., 3]

    true = alpha(64)
    edge = (true > 0.02) & (true < 0.98)
    plain, smooth = (np.sqrt(np.mean((found - true)[edge] ** 2)) for found in (alpha(), alpha(mip=True)))
    assert plain < 0.06 and smooth < 0.06, (plain, smooth)


def test_a_checker_floor_is_its_average():
    checker = (np.indices((32, 32)).sum(axis=0) % 2)[..., None] * np.ones(3, np.float32)
    size = (40, 48)
    plain, mip = (floor(checker, (2, 5.5), shader=Textured(mip=m)) for m in (False, True))
    brute = show(plain, EYE, size, splatter="none", supersample=32)
    error = [np.sqrt(np.mean((show(p, EYE, size, splatter="none") - brute)[..., :3] ** 2)) for p in (plain, mip)]
    assert error[0] < 0.05 and error[1] < 0.05, error


@pytest.mark.parametrize("degrees, most", [(0, 0.007), (60, 0.006), (75, 0.009), (80, 0.012), (85, 0.015)])
def test_slanted_smooth_textures_are_their_average(degrees, most):
    y, x = np.mgrid[:128, :128] / 128 * 2 * np.pi
    texture = 0.5 + 0.25 * (np.cos(12 * x + 5 * y) + np.cos(9 * y - 4 * x))[..., None] * np.ones(3)
    slope, reach = np.radians(degrees), 1.5 / np.cos(np.radians(degrees))
    corners = np.array([(x, y * np.cos(slope), y * np.sin(slope)) for x, y in 2 * CORNERS * (1, reach) - (1, reach)])
    theta = {"texture": texture, "uv": CORNERS * np.array([1, reach], np.float32)}
    plane = mesh_part((corners.astype(np.float32), np.array([(0, 1, 2), (0, 2, 3)])), theta=theta)
    camera, size = Camera.look_at((0, 0, 9), (0, 0, 0), fov_y=10), (32, 32)
    brute = show(plane.replace(shader="textured"), camera, size, splatter="none", supersample=16)
    inside = brute[..., 3] > 0.999
    found = show(plane.replace(shader=Textured(mip=True)), camera, size, splatter="none")
    assert inside.sum() > 500 and np.sqrt(np.mean((found - brute)[inside] ** 2)) < most


def test_a_texture_of_one_colour_stays_as_it_is():
    part = floor(np.full((7, 5, 3), 0.25, np.float32), (9, 30), shader=Textured(mip=True, wrap="mirror"))
    image = show(part, EYE, splatter="none")
    assert np.abs(image[image[..., 3] > 0] - (0.25, 0.25, 0.25, 1)).max() < 1e-6


def test_outlines_and_seams_of_uv_have_no_effect():
    vertices, faces = quad(-2.4, 2.4, -2, 2)
    seam = CORNERS[faces.reshape(-1)].copy()
    seam[3:] += 7  # The second triangle repeats the texture elsewhere.
    texture, indices = RNG.random((20, 24, 3)), {"uv": np.arange(6).reshape(2, 3)}
    cut = mesh_part((vertices, faces), theta={"texture": texture, "uv": seam}, indices=indices)
    whole = mesh_part((vertices, faces), theta={"texture": texture, "uv": CORNERS})
    one, two = (show(part.replace(shader=Textured(mip=True)), FRONT, splatter="none") for part in (cut, whole))
    np.testing.assert_allclose(one, two, atol=1e-4)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_the_gradient_of_an_image_reaches_the_texture(target):
    texture = RNG.random((12, 9, 3))
    part = floor(texture, (3, 9), shader=Textured(mip=True))
    weights = RNG.standard_normal((*SIZE, 4))
    theta, camera, on = arrays(target, (part.theta, EYE, weights))
    sampled = rts.sample(part.replace(theta=theta), camera, SIZE)

    def f(texture, part=part, sampled=sampled, camera=camera, weights=on):
        return (rts.render_samples(sampled, part.replace(theta={**theta, "texture": texture}), camera) * weights).sum()

    found = gradient(target, f, theta["texture"])
    # The image is linear in the texture.
    at, along = arrays(target, (texture, RNG.standard_normal(texture.shape)))
    change = float(to_numpy(f(at + along))) - float(to_numpy(f(at)))
    assert abs(change) > 0.01 and abs(np.sum(found * to_numpy(along)) - change) < 2e-3 * max(abs(change), 0.5)


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("surface", ["mesh", "skinned", "subdivision", "constant"])
def test_footprints_by_loops_are_those_of_array_code(surface, target, monkeypatch):
    name = {"mesh": "mesh", "constant": "mesh"}.get(surface, surface)
    part = rts.plugin("surfaces", name).example()
    shape = next(n for n in ("vertices", "points") if n in part.theta)
    uv = part.theta[shape][:, :2].astype(np.float32) * 0.3
    part = part.replace(theta={**part.theta, "uv": uv}, shader=footprint_of_u)
    part = part if surface == "constant" else part.replace(theta=arrays(target, part.theta))
    camera = Camera.look_at((0.3, 0.4, 5), (0, 0, 0), fov_y=40)
    camera = arrays(target, camera)
    found = show(part, camera, splatter="none")
    monkeypatch.setattr("rts.shading.uv_footprints._on_host", lambda *_: None)
    np.testing.assert_allclose(found, show(part, camera, splatter="none"), rtol=1e-3, atol=1e-4)
    assert (found[..., 0] > 0).sum() > 40


# ------------------------------------------------------------------------------------------------------ errors


def test_a_shader_called_without_footprints_says_so():
    gbuffer = GBuffer(position=np.zeros((1, 3)), uv=np.zeros((1, 2)))
    with pytest.raises(InputError, match="'uv_footprint'"):
        Textured(mip=True)({"texture": np.ones((2, 2, 3))}, gbuffer, FRONT)


def test_surfaces_of_other_parameters_are_refused():
    vertices, faces = quad()
    one, three = np.zeros((1, 3), np.int32), np.zeros((1, 3), np.float32)
    samples = Samples(one, three, Cells(np.zeros((1, 1, 1), np.int32), np.ones((1, 1, 1))), np.int32(0))
    surface = mesh_part((vertices, faces)).surface
    with pytest.raises(InputError, match="3 parameters a sample"):
        uv_footprint(surface, {}, samples, {}, FRONT.pixel_rows(SIZE), None, rts.engine_of(three), None)
