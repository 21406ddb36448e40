"""All samplers of triangles, where edges, layers and planes are known; Embree and OpenGL against the reference."""

import warnings
from functools import cache

import numpy as np
import pytest
from helpers import box, icosphere, quad, quick, rotation, soup
from test_raster import CAMERAS, PIXELS, grid, thousands

import rts
from rts import Camera
from rts.plugin_api.records import Proxy
from rts.scene.camera import perspective

pytestmark = pytest.mark.sampling

pytest.importorskip("numba")

SIZE = (96, 120)
SAMPLERS = ("embree", "opengl")
EDGE_ERRORS = {"embree": 0.002, "opengl": 0.01}
"""Share of the pixels on edges that may differ: hardware snaps corners to fractions of a pixel."""


@pytest.fixture(params=SAMPLERS)
def sampler(request):
    """The name of a sampler that works here."""
    return usable(request.param)


@pytest.fixture(params=["raster", "reference", *SAMPLERS])
def every(request):
    """The name of any sampler that works here."""
    return usable(request.param)


@cache
def make(name):
    """One sampler of each kind for all tests, so that there is one OpenGL context; or why there is none."""
    try:
        made = rts.plugin("samplers", name)()
        made.rasterize(made.prepare(Proxy(*quad())), host(CAMERAS["perspective"]), (4, 4), 1, "none")
        return made
    except rts.errors.PluginError as error:
        return str(error)


def usable(name):
    made = make(name)
    if isinstance(made, str):
        pytest.skip(made)
    return name


def host(camera):
    return Camera(np.asarray(camera.view, np.float64), np.asarray(camera.projection, np.float64))


def rasterize(name, vertices, faces, camera, size=SIZE, layers=1, cull="none"):
    chosen = make(name)
    return chosen.rasterize(chosen.prepare(Proxy(vertices, faces)), host(camera), size, layers, cull)


def fewer(fragments, layers):
    return type(fragments)(*(x[:layers] for x in fragments))


def interior(fragments, jump):
    """Where all 3 × 3 pixels around show one triangle, or depths that differ by less than `jump`."""
    ids, depth = fragments.triangle_ids, fragments.depth
    height, width = ids.shape[1:]

    def around(x, value):
        x = np.pad(x, ((0, 0), (1, 1), (1, 1)), constant_values=value)
        return np.stack([x[:, j : j + height, i : i + width] for j in range(3) for i in range(3)])

    ids, depth = around(ids, -1), around(depth, 0)
    smooth = (ids == ids[4]).all(axis=0) | (depth.max(axis=0) - depth.min(axis=0) < jump)
    return (ids >= 0).all(axis=0) & smooth


def check(name, found, expected, jump=0.0, minimum=100):
    """Interior ids identical, depth to 1e-5, few differences on edges; and there is something to compare."""
    inside = interior(expected, jump)
    different = found.triangle_ids != expected.triangle_ids
    covered = expected.triangle_ids >= 0
    edges = (covered & ~inside).sum()
    assert covered.sum() >= minimum
    # The hardware's subpixels may put a speck that covers no centre before what does: a few in a soup of thousands.
    assert (different & inside).sum() <= (2e-4 * inside.sum() if name == "opengl" and not jump else 0)
    assert (different & ~inside).sum() <= EDGE_ERRORS.get(name, 0) * max(edges, 100)
    same = covered & ~different
    np.testing.assert_allclose(found.depth[same], expected.depth[same], rtol=1e-5)
    np.testing.assert_allclose(found.barycentrics[same], expected.barycentrics[same], atol=1e-5)
    assert not found.depth[found.triangle_ids < 0].any()


# ------------------------------------------------------------------------------------------------- real meshes

MESHES = {"bunny": "bunny_5k.obj", "teapot": "teapot_2464.obj", "spot": "spot/spot_triangulated.obj"}


@cache
def real(path):
    part = rts.load(path)
    part = part if isinstance(part, rts.Part) else part[0]
    vertices = np.asarray(part.theta["vertices"], np.float32)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return vertices, part.surface.faces, (low + high) / 2, float(np.linalg.norm(high - low) / 2)


def views(center, radius):
    planes = {"aspect": 1.25, "near": 0.1 * radius, "far": 10 * radius}
    eye = center + radius * np.array([1.0, 0.8, 2.0])
    behind = center + radius * np.array([-1.5, 1.2, -1.0])
    return {
        "perspective": Camera.look_at(eye, center, fov_y=45, **planes),
        "orthographic": Camera.orthographic(behind, center, height=2 * radius, **planes),
    }


@cache
def expectation(path, view, cull):
    vertices, faces, center, radius = real(path)
    return rasterize("reference", vertices, faces, views(center, radius)[view], SIZE, 4, cull)


@pytest.mark.parametrize("cull", ["none", "back"])
@pytest.mark.parametrize("view", ["perspective", "orthographic"])
@pytest.mark.parametrize("mesh", quick(MESHES))
def test_real_meshes_are_sampled_as_by_the_reference(sampler, mesh, view, cull, data):
    path = data / "meshes" / MESHES[mesh]
    vertices, faces, center, radius = real(path)
    expected = expectation(path, view, cull)
    for layers in (1, 2, 4):
        found = rasterize(sampler, vertices, faces, views(center, radius)[view], SIZE, layers, cull)
        check(sampler, found, fewer(expected, layers), jump=0.1 * radius, minimum=1000)


def test_a_rendered_picture_does_not_depend_on_the_sampler(sampler, data):
    part = rts.load(data / "meshes" / "spot" / "spot_triangulated.obj")
    camera = Camera.look_at((1, 0.8, -2), (0, 0, 0), fov_y=40)
    expected = rts.render(part, camera, SIZE, sampler="raster")
    found = rts.render(part, camera, SIZE, sampler=sampler)
    assert np.mean(np.abs(found - expected).max(axis=-1) > 1e-4) < 0.005
    assert 0.1 < np.mean(expected[..., 3]) < 0.9


# --------------------------------------------------------------------------------------------------- soups


@cache
def soup_expectation(scene, camera, cull):
    return rasterize("reference", *SCENES[scene](), CAMERAS[camera], SIZE, 4, cull)


SCENES = {
    "thousands of triangles": thousands,
    "large triangles": lambda: soup(40, 5, size=0.9),
    "sphere": lambda: icosphere(3),
}


@pytest.mark.parametrize("camera", quick(CAMERAS))
@pytest.mark.parametrize("scene", SCENES)
def test_soups_and_spheres_are_sampled_as_by_the_reference(sampler, scene, camera):
    for cull in ("none", "back"):
        expected = soup_expectation(scene, camera, cull)
        jump = 0.5 if scene == "sphere" else 0.0
        for layers in (1, 2, 4):
            found = rasterize(sampler, *SCENES[scene](), CAMERAS[camera], SIZE, layers, cull)
            check(sampler, found, fewer(expected, layers), jump, minimum=0 if scene == "sphere" else 100)


def test_an_oblique_near_plane_cuts_as_in_the_reference(sampler):
    # Clip z replaced so that the near plane is x + 2 z + 6 = 0 in camera space (Lengyel 2005).
    camera = CAMERAS["perspective"]
    projection = np.array(camera.projection)
    plane = np.array([1.0, 0.0, 2.0, 6.0]) * -1
    corner = np.linalg.inv(projection) @ [np.sign(plane[0]), np.sign(plane[1]), 1, 1]
    projection[2] = plane * 2 / (plane @ corner) - projection[3]
    camera = camera.replace(projection=projection)
    vertices, faces = soup(40, 5, size=0.9)
    whole = rasterize("reference", vertices, faces, CAMERAS["perspective"], SIZE, 4)
    expected = rasterize("reference", vertices, faces, camera, SIZE, 4)
    assert (expected.triangle_ids != whole.triangle_ids).mean() > 0.02
    check(sampler, rasterize(sampler, vertices, faces, camera, SIZE, 4), expected)


@pytest.mark.parametrize("seed", range(4))
def test_cameras_with_any_principal_point_and_skew_agree(sampler, seed):
    rng = np.random.default_rng(seed)
    focal, skew = rng.uniform(60, 200, 2), rng.uniform(-30, 30)
    point = rng.uniform(-0.5, 1.5, 2) * SIZE[::-1]
    matrix = np.array([[focal[0], skew, point[0]], [0, focal[1], point[1]], [0, 0, 1]])
    # So that the origin is seen in the middle.
    ray = np.linalg.solve(matrix, [SIZE[1] / 2, SIZE[0] / 2, 1])
    camera = Camera.from_opencv(matrix, rotation(rng.normal(size=3), 360 * rng.random()), 4 * ray, SIZE, near=0.5)
    vertices, faces = soup(60, seed, size=0.7)
    expected = rasterize("reference", vertices, faces, camera, SIZE, 4)
    check(sampler, rasterize(sampler, vertices, faces, camera, SIZE, 4), expected)


# ------------------------------------------------------------------------------------------ edges and layers


@pytest.mark.parametrize("flip", [False, True], ids=["upright", "y-flipped"])
@pytest.mark.parametrize("corner, step", [(-0.5, 1.0), (-0.5, 0.5), (-1.0, 1.0), (-1.5, 3.0), (-0.25, 0.75)])
def test_a_grid_through_pixel_centres_covers_each_pixel_once(every, corner, step, flip):
    vertices, faces = grid(corner, step, int(np.ceil(34 / step)))
    camera = PIXELS.replace(projection=np.diag([1.0, -1, 1, 1]) @ PIXELS.projection) if flip else PIXELS
    found = rasterize(every, vertices, faces, camera, (32, 32), 2)
    assert (found.triangle_ids[0] >= 0).all()
    assert (found.triangle_ids[1] == -1).all()


def test_a_fan_around_a_pixel_centre_covers_each_pixel_once(every):
    count = 48
    angles = 2 * np.pi * np.arange(count) / count
    rim = np.round(64 * np.stack([np.cos(angles), np.sin(angles)], -1)) + (16.5, -16.5)
    vertices = np.concatenate([[(16.5, -16.5)], rim])
    vertices = np.concatenate([vertices, np.zeros((len(vertices), 1))], axis=1).astype(np.float32)
    around = np.arange(count)
    faces = np.stack([np.zeros(count, int), 1 + around, 1 + (around + 1) % count], -1).astype(np.int32)
    for order in (faces, faces[:, ::-1].copy(), np.roll(faces, 1, axis=1)):
        found = rasterize(every, vertices, order, PIXELS, (32, 32), 2)
        assert (found.triangle_ids[0] >= 0).all()
        assert (found.triangle_ids[1] == -1).all()


@pytest.mark.parametrize("unshared", [False, True], ids=["shared corners", "corners of their own"])
@pytest.mark.parametrize("camera", ["orthographic", "perspective"])
def test_a_rough_sheet_has_neither_holes_nor_double_hits(every, camera, unshared):
    depth = np.random.default_rng(0).uniform(-0.4, 0.4, (35, 35))
    vertices, faces = grid(-1.0, 1.0, 34, depth)
    if unshared:
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    # From afar and with a long lens no cell hides another.
    lens = Camera.look_at((16, -16, 400), (16, -16, 0), fov_y=4.5, near=300, far=500)
    found = rasterize(every, vertices, faces, PIXELS if camera == "orthographic" else lens, (32, 32), 2)
    assert (found.triangle_ids[0] >= 0).all()
    assert (found.triangle_ids[1] == -1).all()


@pytest.mark.parametrize("camera", ["perspective", "orthographic", "inside"])
def test_triangles_with_corners_of_their_own_have_no_gaps_between_them(sampler, camera):
    vertices, faces = icosphere(4)
    expected = rasterize("reference", vertices, faces, CAMERAS[camera], (200, 250), 2)
    apart, separate = vertices[faces].reshape(-1, 3), np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    check(sampler, rasterize(sampler, apart, separate, CAMERAS[camera], (200, 250), 2), expected, jump=0.5)


def test_a_quad_with_edges_through_pixel_centres_is_at_most_those_wider(sampler):
    found = rasterize(sampler, *quad(4.5, 8.5, -10.5, -5.5), PIXELS, (32, 32))
    expected = np.zeros((32, 32), bool)
    expected[5:10, 4:8] = True
    found = found.triangle_ids[0] >= 0
    # Centres exactly on an open edge may go either way; all others may not.
    touched = np.zeros((32, 32), bool)
    touched[5:11, 4:9] = True
    assert found[6:10, 5:8].all() and not found[~touched].any()
    assert (found[expected]).mean() > 0.5


@pytest.mark.parametrize("copies", [2, 3])
def test_of_triangles_at_one_depth_all_are_kept_and_the_first_is_in_front(every, copies):
    vertices, faces = icosphere(2)
    many = np.concatenate([faces] * copies)
    one = rasterize("reference", vertices, faces, CAMERAS["perspective"], SIZE, 1, "back").triangle_ids[0]
    found = rasterize(every, vertices, many, CAMERAS["perspective"], SIZE, copies, "back").triangle_ids
    same = found[0] == one
    assert same.sum() > 1000 and (~same).sum() < (10 if every in SAMPLERS else 1)
    assert (one >= 0).sum() > 1000
    for k in range(copies):
        np.testing.assert_array_equal(found[k][same], np.where(one >= 0, one + k * len(faces), -1)[same])


@pytest.mark.parametrize("tilt", [0.0, 1.0])
def test_coplanar_layers_keep_the_order_of_their_indices(sampler, tilt):
    # Three different triangulations of one rectangle, tilted so that rounding differs between them.
    vertices, faces = quad(-9, 9, -9, 9)
    other = np.array([(0, 1, 3), (1, 2, 3)], np.int32)
    vertices = (vertices @ rotation((1, 2, 0), 20 * tilt).T).astype(np.float32)
    faces = np.concatenate([faces, other, faces])
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), aspect=1.0)
    expected = rasterize("reference", vertices, faces, camera, SIZE, 4)
    found = rasterize(sampler, vertices, faces, camera, SIZE, 4)
    np.testing.assert_array_equal(np.sort(found.triangle_ids, axis=0), np.sort(expected.triangle_ids, axis=0))
    np.testing.assert_allclose(found.depth, expected.depth, rtol=1e-6)
    # Depths of different triangles may differ in their last bits; those of copies are equal, and go by index.
    for t in (0, 1):
        covered = (found.triangle_ids == t).any(axis=0)
        first, second = (np.argmax(found.triangle_ids == i, axis=0)[covered] for i in (t, t + 4))
        assert (first < second).all() and covered.mean() > 0.2


# -------------------------------------------------------------------------------------- scales and places


@pytest.mark.parametrize("lens", ["perspective", "orthographic"])
@pytest.mark.parametrize("offset", [1e3, 1e4])
def test_a_mesh_far_from_the_origin_has_no_holes(sampler, offset, lens):
    # Corners are rounded to float32 there: the surface is rough, and sampled all the same.
    vertices, faces = icosphere(4)
    place = np.array([1.0, -0.7, 0.4]) * offset
    vertices = (vertices + place).astype(np.float32)
    eye = place + (1, 2, 3)
    if lens == "perspective":
        camera = Camera.look_at(eye, place, aspect=1.25, near=0.5, far=9)
    else:
        camera = Camera.orthographic(eye, place, height=3, aspect=1.25, near=0.5, far=9)
    expected = rasterize("reference", vertices, faces, camera, SIZE, 2)
    found = rasterize(sampler, vertices, faces, camera, SIZE, 2)
    inside = interior(expected, 0.5)
    assert inside.sum() > 1000
    assert (found.triangle_ids >= 0)[inside].all()
    assert ((found.triangle_ids >= 0) != (expected.triangle_ids >= 0)).sum() < 20
    assert (found.triangle_ids == expected.triangle_ids)[inside].mean() > 0.995
    np.testing.assert_allclose(found.depth[inside], expected.depth[inside], rtol=1e-4)


@pytest.mark.filterwarnings("ignore::rts.errors.InputWarning")  # A telephoto lens.
def test_a_camera_far_from_the_mesh_sees_it_as_the_reference_does(sampler):
    vertices, faces = icosphere(3)
    camera = Camera.look_at((1e4, 2e4, 3e4), (0, 0, 0), fov_y=0.004, aspect=1.25, near=1e3, far=1e5)
    expected = rasterize("reference", vertices, faces, camera, SIZE, 2)
    check(sampler, rasterize(sampler, vertices, faces, camera, SIZE, 2), expected, jump=0.5, minimum=1000)


# -------------------------------------------------------------------------- near planes, backs and odd scenes


def test_inside_a_closed_box_only_back_faces_are_seen_and_none_when_culled(every):
    vertices, faces = box(2.0)
    camera = Camera.look_at((0.3, 0.2, 0.1), (1, 0.5, 0.2), fov_y=80, near=0.1, far=10)
    found = rasterize(every, vertices, faces, camera, SIZE, 4)
    expected = rasterize("reference", vertices, faces, camera, SIZE, 4)
    check(every, found, expected)
    assert (found.triangle_ids[0] >= 0).all() and (found.triangle_ids[1] == -1).all()
    assert (rasterize(every, vertices, faces, camera, SIZE, 2, "back").triangle_ids == -1).all()
    found = rasterize(every, vertices, faces[:, ::-1].copy(), camera, SIZE, 2, "back")
    assert (found.triangle_ids[0] >= 0).all()


def test_outside_a_closed_box_culling_leaves_the_front_layer(every):
    vertices, faces = box()
    camera = CAMERAS["perspective"]
    both = rasterize(every, vertices, faces, camera, SIZE, 2)
    front = rasterize(every, vertices, faces, camera, SIZE, 2, "back")
    if every in SAMPLERS:
        check(every, both, rasterize("reference", vertices, faces, camera, SIZE, 2), jump=0.5)
    else:
        np.testing.assert_array_equal(both.triangle_ids[0] >= 0, both.triangle_ids[1] >= 0)
    assert (front.triangle_ids[0] != both.triangle_ids[0]).sum() < (5 if every in SAMPLERS else 1)
    assert (front.triangle_ids[1] == -1).all() and (front.triangle_ids[0] >= 0).sum() > 500


def test_a_triangle_across_the_near_plane_is_cut_there(every):
    # A floor one unit below the eye: at depth z it is seen at tan(angle) = 1 / z, from the near plane on.
    vertices, faces = quad(-100, 100, -100, 100)
    vertices = vertices[:, [0, 2, 1]] - np.float32([0, 1, 0])
    camera = Camera(np.eye(4), perspective(90.0, 1.0, 2.0, 50.0))
    found = rasterize(every, vertices, faces, camera, (64, 64), 2)
    slope = (np.arange(64) + 0.5) / 32 - 1
    with np.errstate(divide="ignore"):
        depth = np.where((slope > 0) & (1 / slope >= 2.0) & (1 / slope <= 50.0), 1 / slope, 0)
    np.testing.assert_allclose(found.depth[0], np.broadcast_to(depth[:, None], (64, 64)), rtol=1e-5)
    assert (found.triangle_ids[1] == -1).all()


def test_what_lies_behind_the_camera_or_beyond_the_far_plane_is_not_seen(every):
    camera = Camera(np.eye(4), perspective(90.0, 1.0, 0.5, 10.0))
    for z in (1.0, 3.0, -0.4, -10.1):
        assert (rasterize(every, *quad(-50, 50, -50, 50, z), camera).triangle_ids == -1).all()
    for z in (-0.6, -9.9):
        assert (rasterize(every, *quad(-50, 50, -50, 50, z), camera).triangle_ids >= 0).all()


def test_triangles_without_area_are_never_hit(every):
    vertices = np.array([(-1, -1, 0), (1, 1, 0), (0, 0, 0), (-1, 0, 0), (1, 0, 0)], np.float32)
    faces = np.array([(0, 1, 2), (0, 0, 1), (2, 2, 2), (3, 4, 3), (3, 2, 4)], np.int32)
    camera = Camera.look_at((0, 0, 3), (0, 0, 0))
    assert (rasterize(every, vertices, faces, camera, (33, 33), 2).triangle_ids == -1).all()
    # Nor does one in front hide what is behind it.
    wall, wall_faces = quad(-9, 9, -9, 9, -0.5)
    found = rasterize(every, np.concatenate([vertices, wall]), np.concatenate([faces, wall_faces + 5]), camera, SIZE)
    assert (found.triangle_ids[0] >= len(faces)).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 50), (50, 1), (7, 9), (8, 8), (17, 3)])
def test_any_size_of_image_is_filled(every, size):
    found = rasterize(every, *quad(-900, 900, -900, 900), Camera.look_at((0, 0, 3), (0, 0, 0)), size, 2)
    assert found.triangle_ids.shape == (2, *size)
    assert (found.triangle_ids[0] >= 0).all() and (found.triangle_ids[1] == -1).all()


@pytest.mark.parametrize("name", ["raster", *SAMPLERS])
def test_the_result_depends_neither_on_the_number_of_threads_nor_on_chance(name, monkeypatch):
    usable(name)
    results, mesh = [], soup(30000, size=0.1) if name == "raster" else thousands()
    for threads in ("1", "2", "3", "2"):
        monkeypatch.setenv("RTS_NUM_THREADS", threads)
        results.append(rasterize(name, *mesh, CAMERAS["perspective"], SIZE, 3))
    for one, *others in zip(*results, strict=True):
        for other in others:
            np.testing.assert_array_equal(one, other)


# ------------------------------------------------------------------------- rays, at edges and at any size


@pytest.mark.parametrize("scale", [1e-2, 1e-4, 1e-6, 1e-8])
def test_rays_find_triangles_however_small_they_are_in_their_mesh(scale):
    usable("embree")
    vertices, faces = soup(20, 3, size=0.4)
    far = np.array([(9, 0, -30), (10, 0, -30), (9, 1, -30)], np.float32)
    vertices, faces = np.concatenate([vertices * np.float32(scale), far]), np.concatenate([faces, [[60, 61, 62]]])
    camera = Camera.look_at(
        (scale, 2 * scale, 3 * scale), (0, 0, 0), fov_y=50, aspect=1.25, near=0.5 * scale, far=9 * scale
    )
    found = rasterize("embree", vertices, faces.astype(np.int32), camera, SIZE, 4)
    expected = rasterize("reference", vertices, faces.astype(np.int32), camera, SIZE, 4)
    assert (expected.triangle_ids >= 0).sum() > 2000
    np.testing.assert_array_equal(found.triangle_ids, expected.triangle_ids)


@pytest.mark.parametrize("turned", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_rays_through_free_edges_and_corners_are_decided_as_the_rasterizer_decides(turned):
    usable("embree")
    rng = np.random.default_rng(0)
    for _ in range(20):
        corners = np.concatenate([rng.integers(0, 64, (30, 3, 2)) / 2, rng.integers(-9, 9, (30, 3, 1))], axis=2)
        vertices = (corners * [1, -1, 1]).reshape(-1, 3).astype(np.float32)
        faces = np.arange(90, dtype=np.int32).reshape(-1, 3)[:, list(turned)]
        found, expected = (rasterize(name, vertices, faces, PIXELS, (32, 32), 30) for name in ("embree", "raster"))
        np.testing.assert_array_equal(np.sort(found.triangle_ids, 0), np.sort(expected.triangle_ids, 0))


def test_rays_find_moved_triangles_that_have_become_thin():
    usable("embree")
    sampler, (vertices, faces) = make("embree"), soup(60, 4, size=0.5)
    camera = host(CAMERAS["perspective"])
    thin = vertices.reshape(-1, 3, 3).copy()
    thin[::2, 2] = (thin[::2, 0] + thin[::2, 1]) / 2 + np.float32(1e-3)
    prepared = sampler.prepare(Proxy(vertices, faces))
    for moved in (thin.reshape(-1, 3), vertices, vertices[::-1].copy()):
        proxy = Proxy(moved, faces)
        prepared = sampler.update(prepared, proxy) or sampler.prepare(proxy)  # As a `TriangleSampler` does.
        found = sampler.rasterize(prepared, camera, SIZE, 60, "none")
        expected = rasterize("reference", moved, faces, CAMERAS["perspective"], SIZE, 60)
        assert (expected.triangle_ids >= 0).sum() > 3000
        np.testing.assert_array_equal(found.triangle_ids, expected.triangle_ids)


def ground(half, near):
    """A ground to the horizon, and a camera close above it."""
    corners = np.array([(x, 0, z) for x in (-half, half) for z in (-half, half)], np.float32)
    camera = Camera.look_at((0, 1, 3), (0, 0.3, 0), fov_y=50, near=near, far=max(1e6, 3 * half))
    return corners, np.array([(0, 1, 3), (0, 3, 2)], np.int32), camera


@pytest.mark.parametrize("half, near", [(1e5, 1e-3), (1e9, 1.0), (1e9, 1e-3)])
def test_a_ground_to_the_horizon_is_seen_and_opengl_says_once_that_it_does_not_draw_it(half, near, sampler):
    vertices, faces, camera = ground(half, near)
    chosen = rts.plugin("samplers", sampler)()
    prepared, size = chosen.prepare(Proxy(vertices, faces)), (64, 64)
    expected = rasterize("reference", vertices, faces, camera, size)
    assert 2000 < (expected.triangle_ids >= 0).sum() < 64 * 64
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = [chosen.rasterize(prepared, host(camera).for_size(size), size, 1, "none") for _ in range(2)]
    for each in found:
        assert ((each.triangle_ids >= 0) != (expected.triangle_ids >= 0)).sum() <= (sampler == "embree")
    assert [w.category for w in caught] == [rts.errors.SamplerWarning] * (sampler == "opengl")


def test_opengl_draws_itself_what_is_no_larger_than_a_room():
    usable("opengl")
    vertices, faces, camera = ground(100.0, 0.1)
    found = rasterize("opengl", vertices, faces, camera, (64, 64))  # Warnings are errors.
    assert (found.triangle_ids >= 0).sum() > 2000


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_the_scale_does_not_matter(sampler, scale):
    vertices, faces = soup(300, 7, size=0.3)
    vertices = (vertices * scale).astype(np.float32)
    planes = {"aspect": 1.25, "near": 0.5 * scale, "far": 9 * scale}
    for camera in (
        Camera.look_at(np.array([1, 2, 3]) * scale, (0, 0, 0), fov_y=50, **planes),
        Camera.orthographic(np.array([1, 2, 3]) * scale, (0, 0, 0), height=3 * scale, **planes),
    ):
        expected = rasterize("reference", vertices, faces, camera, SIZE, 4)
        check(sampler, rasterize(sampler, vertices, faces, camera, SIZE, 4), expected)


def test_planes_far_apart_do_not_coarsen_the_depth(sampler):
    vertices, faces = soup(300, 7, size=0.3)
    camera = Camera.look_at((1, 2, 3), (0, 0, 0), aspect=1.25, near=1e-4, far=1e6)
    expected = rasterize("reference", vertices, faces, camera, SIZE, 4)
    check(sampler, rasterize(sampler, vertices, faces, camera, SIZE, 4), expected)
