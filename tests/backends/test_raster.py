"""The rasterizer and the reference sampler, against ray casting and each other; triangles at points."""

import numpy as np
import pytest
from helpers import icosphere, quad, rotation, soup

import rts
from rts import Camera
from rts.plugin_api.records import Proxy
from rts.sampling.points import at_points
from rts.scene.camera import orthographic, perspective

pytestmark = pytest.mark.sampling

numba = pytest.importorskip("numba")

SIZE = (24, 30)
NEAR, FAR = 0.5, 9.0
SAMPLERS = ("raster", "reference")


def rasterize(name, vertices, faces, camera, size=SIZE, layers=1, cull="none"):
    sampler = rts.plugin("samplers", name)()
    camera = Camera(np.asarray(camera.view, np.float64), np.asarray(camera.projection, np.float64))
    return sampler.rasterize(sampler.prepare(Proxy(vertices, faces)), camera, size, layers, cull)


def cast(vertices, faces, camera, size, layers, cull, near=NEAR, far=FAR, points=None):
    """Fragments by intersecting every pixel's ray, or every point's, with every triangle (Möller and Trumbore 1997)."""
    a, b, c = np.moveaxis(vertices[faces].astype(np.float64), 1, 0)
    rays, size = camera.rays(size, points), size if points is None else (1, len(points))
    origins, directions = (x.reshape(-1, 1, 3) for x in rays[:2])
    p = np.cross(directions, c - a)
    determinant = (p * (b - a)).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        v = (p * (origins - a)).sum(-1) / determinant
        q = np.cross(origins - a, b - a)
        w = (q * directions).sum(-1) / determinant
        depth = (q * (c - a)).sum(-1) / determinant
        hit = (v > 0) & (w > 0) & (v + w < 1) & (depth >= near) & (depth <= far)
    if cull == "back":
        hit &= (np.cross(b - a, c - a) * directions).sum(-1) < 0
    depth = np.where(hit, depth, np.inf)
    order = np.argsort(depth, axis=1, kind="stable")[:, :layers]
    found = np.isfinite(np.take_along_axis(depth, order, axis=1))

    def layered(x):
        x = np.where(found, np.take_along_axis(x, order, axis=1), 0)
        return np.moveaxis(x.reshape(*size, -1), -1, 0)

    triangles = np.moveaxis(np.where(found, order, -1).reshape(*size, -1), -1, 0)
    return triangles, np.stack([layered(1 - v - w), layered(v)], -1), layered(depth)


def triangles(kind, seed=0):
    """A soup of one kind, around the origin."""
    rng = np.random.default_rng(seed)
    if kind == "tiny":
        return soup(400, seed, size=0.03)
    vertices, faces = soup(50, seed, size=30.0 if kind == "huge" else 0.7)
    corners = vertices.reshape(-1, 3, 3)
    if kind == "slivers":
        between = rng.uniform(0.2, 0.8, (50, 1)).astype(np.float32)
        corners[:, 2] = corners[:, 0] * between + corners[:, 1] * (1 - between)
        corners[:, 2] += rng.normal(0, 0.02, (50, 3))
    if kind == "degenerate":
        corners[::3, 1] = corners[::3, 0]
        corners[1::6] = corners[1::6, :1]
    return vertices, faces


KINDS = ("interpenetrating", "slivers", "tiny", "degenerate", "huge")


def thousands():
    parts = [triangles(kind, seed) for seed in (1, 2) for kind in KINDS] + [soup(2000, 3, size=0.2)]
    offsets = np.cumsum([0, *(len(v) for v, _ in parts)])
    vertices = np.concatenate([v for v, _ in parts])
    return vertices, np.concatenate([f + o for (_, f), o in zip(parts, offsets, strict=False)]).astype(np.int32)


VIEW = Camera.look_at((1, 2, 3), (0, 0, 0)).view
LENS = perspective(50.0, 1.25, NEAR, FAR)
CAMERAS = {
    "perspective": Camera(VIEW, LENS),
    "orthographic": Camera(VIEW, orthographic(3.0, 1.25, NEAR, FAR)),
    "inside": Camera.look_at((0.1, 0.2, 0.3), (1, 2, -1), aspect=1.25, near=NEAR, far=FAR),
    "orthographic inside": Camera.orthographic(
        (0.1, 0.2, 0.3), (1, 2, -1), height=3.0, aspect=1.25, near=NEAR, far=FAR
    ),
    "between close planes": Camera(VIEW, perspective(50.0, 1.25, 3.5, 4.0)),
    "skewed": Camera.from_opencv(
        np.array([[30.0, 4, 17], [0, 25, 10], [0, 0, 1]]),
        rotation((1, 2, 3), 40),
        (0.1, 0.2, 4),
        SIZE,
        near=NEAR,
        far=FAR,
    ),
    "upside down": Camera(VIEW, np.diag([1.0, -1, 1, 1]) @ LENS),
    "half turn": Camera(VIEW, np.diag([-1.0, -1, 1, 1]) @ LENS),
    "mirrored": Camera(np.diag([-1.0, 1, 1, 1]) @ VIEW, LENS),
    "mirrored and upside down": Camera(np.diag([-1.0, 1, 1, 1]) @ VIEW, np.diag([1.0, -1, 1, 1]) @ LENS),
    "orthographic upside down": Camera(VIEW, np.diag([1.0, -1, 1, 1]) @ orthographic(3.0, 1.25, NEAR, FAR)),
    "seen through a stretched part": Camera(VIEW @ np.diag([-2.0, 0.7, 1.3, 1]), LENS),
}


# ---------------------------------------------------------------------------------------- against ray casting


AT_CENTRES = [(name, kind, False) for name in SAMPLERS for kind in KINDS]
AT_POINTS = [(name, kind, True) for name in (*SAMPLERS, "embree") for kind in KINDS]


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize(
    ("name", "kind", "elsewhere"),
    [
        pytest.param(*case, marks=[pytest.mark.thorough] * (case[1] not in KINDS[: 1 if case[2] else 3]))
        for case in AT_CENTRES + AT_POINTS
    ],
)
def test_fragments_are_the_nearest_hits_of_each_ray(name, kind, elsewhere, camera):
    try:
        sampler = rts.plugin("samplers", name)()
    except rts.errors.PluginError as error:
        pytest.skip(str(error))
    near, far = (3.5, 4.0) if camera is CAMERAS["between close planes"] else (NEAR, FAR)
    vertices, faces = triangles(kind)
    host = Camera(np.asarray(camera.view, np.float64), np.asarray(camera.projection, np.float64))
    points = np.random.default_rng(0).uniform((0, 0), SIZE[::-1], (700, 2)) if elsewhere else None
    proxy, total = Proxy(vertices, faces), 0
    for layers, cull in ((1, "none"), (2, "back"), (4, "none")):
        view, prepared = (host, SIZE, layers, cull), sampler.prepare(proxy)
        if elsewhere:
            found = sampler.rasterize_points(prepared, *view, points) or at_points(proxy, *view, points)
        else:
            found = sampler.rasterize(prepared, *view)
        ids, barycentrics, depth = cast(vertices, faces, camera, SIZE, layers, cull, near, far, points)
        np.testing.assert_array_equal(found.triangle_ids, ids)
        np.testing.assert_allclose(found.barycentrics, barycentrics, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(found.depth, depth, rtol=1e-6)
        total += (ids >= 0).sum()
    assert total > 5


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_raster_finds_what_the_reference_finds_among_thousands(camera):
    vertices, faces = thousands()
    for layers in (1, 2, 4):
        for cull in ("none", "back"):
            found = rasterize("raster", vertices, faces, camera, SIZE, layers, cull)
            expected = rasterize("reference", vertices, faces, camera, SIZE, layers, cull)
            np.testing.assert_array_equal(found.triangle_ids, expected.triangle_ids)
            np.testing.assert_allclose(found.barycentrics, expected.barycentrics, rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(found.depth, expected.depth, rtol=1e-6)


# ------------------------------------------------------------------------------------------- shared edges

PIXELS = Camera.orthographic((16, -16, 50), (16, -16, 0), height=32, near=1, far=100)
"""Looks at 32 × 32 pixels of which (x, y) has its corners at world (x, −y), (x + 1, −y − 1)."""


def grid(corner, step, count, depth=None):
    """A grid of count² cells of two triangles each, from `corner` to the right and downwards."""
    rows, columns = np.indices((count + 1, count + 1))
    z = np.zeros_like(rows) if depth is None else depth
    vertices = np.stack([corner + step * columns, -(corner + step * rows), z], -1).reshape(-1, 3)
    index = np.arange((count + 1) ** 2).reshape(count + 1, count + 1)
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    odd = (np.indices((count, count)).sum(axis=0) % 2).ravel()[:, None]
    first = np.where(odd, np.stack([a, b, c], -1), np.stack([a, b, d], -1))
    second = np.where(odd, np.stack([a, c, d], -1), np.stack([b, c, d], -1))
    return vertices.astype(np.float32), np.concatenate([first, second]).astype(np.int32)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_a_quad_owns_the_pixel_centres_of_its_top_and_left_edges_only(sampler):
    vertices, faces = quad(4.5, 8.5, -10.5, -5.5)
    found = rasterize(sampler, vertices, faces, PIXELS, (32, 32))
    expected = np.zeros((32, 32), bool)
    expected[5:10, 4:8] = True
    np.testing.assert_array_equal(found.triangle_ids[0] >= 0, expected)


# ----------------------------------------------------------------------------------------------- the rest


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_a_mesh_far_from_the_origin_is_sampled_as_well_as_near_it(sampler):
    vertices, faces = icosphere(2)
    vertices = np.round(vertices * 512) / 512  # So that float32 holds them exactly at 10 000 too.
    offset = np.array([1e4, -1e4, 1e4])
    near = rasterize(sampler, vertices.astype(np.float32), faces, Camera.look_at((1, 2, 3), (0, 0, 0)), SIZE, 2)
    far = rasterize(
        sampler, (vertices + offset).astype(np.float32), faces, Camera.look_at(offset + (1, 2, 3), offset), SIZE, 2
    )
    np.testing.assert_array_equal(far.triangle_ids, near.triangle_ids)
    np.testing.assert_allclose(far.barycentrics, near.barycentrics, atol=1e-5)
    np.testing.assert_allclose(far.depth, near.depth, rtol=1e-6)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_faces_may_be_integers_of_any_size_and_order(sampler):
    vertices, faces = icosphere(1)
    expected = rasterize(sampler, vertices, faces.astype(np.int32), CAMERAS["perspective"])
    for given in (faces.astype(np.int64), np.asfortranarray(faces.astype(np.int32))):
        found = rasterize(sampler, vertices, given, CAMERAS["perspective"])
        np.testing.assert_array_equal(found.triangle_ids, expected.triangle_ids)


def test_the_rasterizer_drops_triangles_with_nan_and_keeps_the_others():
    vertices, faces = quad(-9, 9, -9, 9)
    vertices[3] = np.nan
    found = rasterize("raster", vertices, faces, Camera.look_at((0, 0, 3), (0, 0, 0)), (16, 16), 2)
    assert set(np.unique(found.triangle_ids)) == {-1, 0}


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_render_refuses_vertices_that_are_not_finite_and_names_the_first(sampler, bad):
    vertices, faces = icosphere(0)
    vertices[7, 1] = bad
    part = rts.Part(rts.plugin("surfaces", "mesh")(faces), {"vertices": vertices})
    with pytest.raises(rts.InputError) as error:
        rts.render(part, CAMERAS["perspective"], SIZE, sampler=sampler)
    assert "1 of the 12 vertices" in str(error.value) and "vertex 7" in str(error.value)


def pixels(size):
    """A camera in whose image of this size pixel (x, y) has its corners at world (x, −y), (x + 1, −y − 1)."""
    height, width = size
    middle = width / 2, -height / 2
    return Camera.orthographic((*middle, 50), (*middle, 0), height=height, aspect=width / height, near=1, far=100)


@pytest.mark.parametrize("size", [(3000, 2), (2, 3000), (5, 7)])
def test_no_small_triangle_is_lost_to_rounding_on_screen(size):
    rng = np.random.default_rng(0)
    count = 3000
    centers = np.floor(rng.uniform(0, size[::-1], (count, 2))) + 0.5
    corners = centers[:, None] + rng.normal(size=(count, 3, 2)) * 10 ** rng.uniform(-2, 0.5, (count, 1, 1))
    vertices = np.concatenate([corners * (1, -1), rng.uniform(-1, 1, (count, 3, 1))], -1).reshape(-1, 3)
    vertices, faces = vertices.astype(np.float32), np.arange(3 * count).reshape(-1, 3).astype(np.int32)
    for cull in ("none", "back"):
        found = rasterize("raster", vertices, faces, pixels(size), size, 9, cull)
        expected = rasterize("reference", vertices, faces, pixels(size), size, 9, cull)
        np.testing.assert_array_equal(found.triangle_ids, expected.triangle_ids)
        assert len(np.unique(found.triangle_ids)) > 150


def test_large_triangles_and_many_small_ones_in_one_band_lose_nothing():
    # More hits at once than a row and a block of small triangles have: those of the large one are kept till the end.
    size, count = (16, 40), 63
    large = np.array([(0.0, 0.0), (31.0, 0.0), (0.0, 400.0)])
    corners = np.array([(0.3, 0.3), (1.7, 0.4), (1.0, 1.7)]) + np.indices((9, 7)).reshape(2, -1).T[:, None] * 2
    flat = np.concatenate([large[None], corners]).reshape(-1, 2)
    depth = np.repeat([0.5, *np.linspace(-0.5, 0.4, count)], 3)[:, None]
    vertices = np.concatenate([flat * (1, -1), depth], -1).astype(np.float32)
    faces = np.arange(3 * (count + 1), dtype=np.int32).reshape(-1, 3)
    found, expected = (rasterize(name, vertices, faces, pixels(size), size, 3) for name in ("raster", "reference"))
    np.testing.assert_array_equal(found.triangle_ids, expected.triangle_ids)
    assert len(np.unique(found.triangle_ids)) == count + 2


@pytest.mark.parametrize("layers", [1, 2])
def test_triangles_seen_from_behind_around_a_full_image_are_found(layers):
    # Where the layers are full of triangles seen from the front, only those behind all of these may be left out.
    size, rng = (48, 48), np.random.default_rng(1)
    wall, faces = grid(-1.3, 10.1, 5)
    wall[:, 2] = 1 / 8
    centres, offsets = rng.uniform(0, 48, (120, 1, 2)), rng.uniform(-6, 6, (120, 3, 2))
    x, y = np.moveaxis(centres + offsets, -1, 0)
    # Some lie a hair before or behind the wall, others far.
    away = 1 / 8 + rng.choice([1e-4, -1e-4, 1.0, -1.0], (120, 1)) * rng.uniform(0.5, 1, (120, 1))
    corners = np.stack([x, -y, np.broadcast_to(away, x.shape)], -1).reshape(-1, 3)
    (ax, ay), (bx, by) = (offsets[:, 1] - offsets[:, 0]).T, (offsets[:, 2] - offsets[:, 0]).T
    own = np.arange(360).reshape(-1, 3)
    own = np.where((ax * by > ay * bx)[:, None], own, own[:, ::-1])
    vertices = np.concatenate([corners, wall, wall - (0, 0, 0.5)]).astype(np.float32)
    faces = np.concatenate([own, faces + 360, faces + 360 + len(wall)]).astype(np.int32)
    found, expected = (rasterize(name, vertices, faces, pixels(size), size, layers) for name in ("raster", "reference"))
    np.testing.assert_array_equal(found.triangle_ids, expected.triangle_ids)
    np.testing.assert_allclose(found.depth, expected.depth, rtol=1e-6)
    assert len(np.unique(found.triangle_ids[found.triangle_ids < 120])) > 40


@pytest.mark.parametrize("x", [-1000.0, -9.0, 1000.0])
def test_a_corner_far_outside_does_not_bend_a_thin_triangle(x):
    # At the pixel on the border its edges are 0.04 apart around the centre; its third corner is one row lower.
    near = 1.2 if x < 0 else 5.8
    vertices = np.array([(near, -0.48, 0), (near, -0.52, 0), (x, -0.9, 0)], np.float32)
    vertices[:2, 1] += (0.4 - 0.02) * (0.7 / abs(x - near))
    found = rasterize("raster", vertices, np.array([(0, 1, 2)], np.int32), pixels((5, 7)), (5, 7))
    expected = np.full((5, 7), -1)
    expected[0, 0 if x < 0 else 6] = 0
    np.testing.assert_array_equal(found.triangle_ids[0], expected)
