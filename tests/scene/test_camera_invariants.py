"""Cameras of all kinds: rays and pixels are inverses, converters are, and size is only a unit."""

import numpy as np
import pytest
from helpers import moved, rigid
from hypothesis import given
from hypothesis import strategies as st
from strategies import PROPERTIES, affine_maps, cameras, reals, rotations, sizes, vectors, views

from rts import Camera
from rts.scene.camera import look_at

pytestmark = pytest.mark.rendering

PERSPECTIVE = "look_at", "skewed"


def seen_at(camera, pixels, depths, size):
    """World points at pixel positions (N, 2) and depths (N,), by the inverse of the matrices."""
    height, width = size
    ndc = np.array(pixels) * [2 / width, -2 / height] + [-1, 1]
    p = camera.projection
    points = []
    for (x, y), z in zip(ndc, depths, strict=True):
        # x w = X and y w = Y, where w = p32 z + p33 and z = −depth.
        w = p[3, 3] - p[3, 2] * z
        rest = np.array([x, y]) * w - p[:2, 3] + p[:2, 2] * z
        points.append([*np.linalg.solve(p[:2, :2], rest), -z, 1.0])
    return (np.array(points) @ np.linalg.inv(camera.view).T)[:, :3]


@st.composite
def scenes(draw, kinds=("look_at", "orthographic", "skewed")):
    """A camera, a size, and world points that it sees in the image at depths of at least 0.2, with their pixels."""
    camera, size = draw(cameras(kinds)), draw(sizes())
    count = draw(st.integers(1, 5))
    pixels = np.array([draw(vectors(0, 1, 2)) * size[::-1] for _ in range(count)])
    depths = np.array([draw(reals(0.2, 30)) for _ in range(count)])
    return camera, size, seen_at(camera, pixels, depths, size), np.column_stack([pixels, depths])


def close(found, expected, atol=1e-7):
    """To rounding: relative, and absolute for pixels and units of about one."""
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=atol)


def assert_same(found, expected):
    """That two cameras have the same matrices."""
    close(found.view, expected.view)
    close(found.projection, expected.projection)


# ------------------------------------------------------------------------------------- projection and rays


@PROPERTIES
@given(scenes())
def test_points_are_seen_where_they_were_put(scene):
    camera, size, points, expected = scene
    close(camera.project(points, size), expected)


@PROPERTIES
@given(scenes())
def test_the_ray_through_a_points_pixel_meets_the_point_at_its_depth(scene):
    camera, size, points, _ = scene
    for point, (x, y, depth) in zip(points, camera.project(points, size), strict=True):
        # A window of one pixel around it, whose only ray is the one through the middle.
        rays = camera.window(size, (y - 0.5, x - 0.5), (1, 1)).rays((1, 1))
        close((rays.origins + depth * rays.directions)[0, 0], point, 1e-6)


@PROPERTIES
@given(cameras(), sizes(12), reals(0.1, 30))
def test_rays_are_seen_at_the_centres_of_their_pixels_at_every_depth(camera, size, depth):
    rays = camera.rays(size)
    found = camera.project((rays.origins + depth * rays.directions).reshape(-1, 3), size)
    rows, columns = np.indices(size).reshape(2, -1) + 0.5
    close(found, np.column_stack([columns, rows, np.full(rows.size, depth)]))


@PROPERTIES
@given(cameras(), sizes(6), reals(0.1, 30))
def test_the_spread_of_rays_is_the_side_of_a_square_of_a_pixels_area(camera, size, depth):
    # Of a window of 2 × 2 pixels, since the image may have but one.
    rays = camera.window(size, (0, 0), (2, 2)).rays((2, 2))
    points = rays.origins + depth * rays.directions
    area = np.linalg.norm(np.cross(points[0, 1] - points[0, 0], points[1, 0] - points[0, 0]))
    spread = camera.rays(size).spread
    close(spread[0] + spread[1] * depth, np.sqrt(area))


@PROPERTIES
@given(scenes())
def test_toward_is_against_the_ray_to_a_point(scene):
    camera, size, points, _ = scene
    for (x, y, _), toward in zip(camera.project(points, size), camera.toward(points), strict=True):
        direction = camera.window(size, (y - 0.5, x - 0.5), (1, 1)).rays((1, 1)).directions[0, 0]
        close(toward / np.linalg.norm(toward), -direction / np.linalg.norm(direction), 1e-6)


@PROPERTIES
@given(views(), reals(0.1, 1), reals(1.5, 60), st.booleans())
def test_the_planes_are_at_clip_minus_one_and_one(view, near, ratio, perspective):
    planes = {"near": near, "far": ratio * near}
    camera = Camera.look_at(*view, **planes) if perspective else Camera.orthographic(*view, height=2, **planes)
    close(camera.depth_range(), (near, ratio * near))
    for depth, expected in ((near, -1), (ratio * near, 1)):
        clip = camera.projection @ (0, 0, -depth, 1)
        close(clip[2] / clip[3], expected)


# -------------------------------------------------------------------------------------------- resolution


@PROPERTIES
@given(scenes(), st.integers(2, 9))
def test_in_more_pixels_everything_is_at_the_same_place(scene, factor):
    camera, size, points, _ = scene
    fine = camera.project(points, tuple(factor * n for n in size))
    close(fine, camera.project(points, size) * [factor, factor, 1])


@PROPERTIES
@given(cameras(), sizes(5), st.sampled_from([3, 5]), reals(0.1, 30))
def test_the_ray_of_a_pixel_is_that_of_its_middle_part(camera, size, factor, depth):
    coarse, fine = camera.rays(size), camera.rays((factor * size[0], factor * size[1]))
    middle = slice(factor // 2, None, factor)
    for found, expected in zip(fine[:2], coarse[:2], strict=True):
        close(found[middle, middle], expected)
    close(fine.spread * factor, coarse.spread)


@PROPERTIES
@given(scenes(), st.integers(0, 9))
def test_a_border_moves_pixels_by_its_width_and_nothing_else(scene, border):
    camera, size, points, _ = scene
    wide = size[0] + 2 * border, size[1] + 2 * border
    close(camera.with_border(size, border).project(points, wide), camera.project(points, size) + [border, border, 0])


@PROPERTIES
@given(cameras(), sizes(8), st.integers(0, 4))
def test_the_rays_inside_a_border_are_those_without_it(camera, size, border):
    found = camera.with_border(size, border).rays((size[0] + 2 * border, size[1] + 2 * border))
    expected = camera.rays(size)
    inside = slice(border, border + size[0]), slice(border, border + size[1])
    close(found.origins[inside], expected.origins)
    close(found.directions[inside], expected.directions)
    close(found.spread, expected.spread)


@PROPERTIES
@given(cameras(), sizes(), sizes(), sizes(), st.tuples(*[st.integers(-9, 40)] * 4))
def test_a_window_of_a_window_is_a_window(camera, size, outer, inner, corners):
    (top, left), (down, right) = corners[:2], corners[2:]
    twice = camera.window(size, (top, left), outer).window(outer, (down, right), inner)
    assert_same(twice, camera.window(size, (top + down, left + right), inner))
    assert_same(camera.window(size, (0, 0), size), camera)


# ------------------------------------------------------------------------------------------------- views


@PROPERTIES
@given(views())
def test_a_view_is_rigid_and_looks_from_the_eye_to_the_target_with_up_upward(view):
    eye, target, up = view
    matrix = look_at(eye, target, up)
    close(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3))
    close(np.linalg.det(matrix[:3, :3]), 1)
    np.testing.assert_array_equal(matrix[3], (0, 0, 0, 1))
    close(moved(matrix, eye), np.zeros(3))
    close(moved(matrix, target), (0, 0, -np.linalg.norm(target - eye)))
    sideways, upward, _ = matrix[:3, :3] @ up
    close(sideways, 0)
    assert upward > 0


@PROPERTIES
@given(views(), sizes(), reals(5, 130), reals(0.3, 3), vectors(-0.8, 0.8, 2), st.booleans())
def test_the_target_is_at_the_principal_point_and_half_a_field_of_view_is_half_an_image(
    view, size, fov, aspect, point, perspective
):
    eye, target, up = view
    distance = np.linalg.norm(target - eye)
    half = np.tan(np.radians(fov) / 2) * distance
    options = {"aspect": aspect, "principal_point": point}
    if perspective:
        camera = Camera.look_at(eye, target, up, fov_y=fov, **options)
    else:
        camera = Camera.orthographic(eye, target, up, height=2 * half, **options)
    right, upward, _ = camera.view[:3, :3]
    points = target + np.array([np.zeros(3), half * upward, half * aspect * right])
    middle, (height, width) = np.array([1 + point[0], 1 - point[1]]) * size[::-1] / 2, size
    expected = middle + np.array([(0, 0), (0, -height / 2), (width / 2, 0)])
    close(camera.project(points, size), np.column_stack([expected, [distance] * 3]))


@PROPERTIES
@given(views(), rotations(), vectors(-5, 5))
def test_a_world_that_moves_with_the_camera_looks_the_same(view, linear, shift):
    motion = rigid(translation=shift)
    motion[:3, :3] = linear
    eye, target, up = view
    close(look_at(moved(motion, eye), moved(motion, target), linear @ up) @ motion, look_at(eye, target, up))


@PROPERTIES
@given(scenes(), affine_maps())
def test_within_a_transform_local_points_are_seen_where_the_moved_ones_are(scene, transform):
    camera, size, points, expected = scene
    local = moved(np.linalg.inv(transform), points)
    close(camera.within(transform).project(local, size), expected, 1e-6)
    assert camera.within(None) is camera


@PROPERTIES
@given(cameras(), affine_maps(), sizes(6))
def test_rays_within_a_transform_are_those_of_the_world_in_local_space(camera, transform, size):
    local, world = camera.within(transform).rays(size), camera.rays(size)
    close(moved(transform, local.origins), world.origins, 1e-6)
    close(local.directions @ transform[:3, :3].T, world.directions, 1e-6)
    close(local.spread * abs(np.linalg.det(transform)) ** (1 / 3), world.spread, 1e-6)


@PROPERTIES
@given(cameras(), affine_maps(), affine_maps())
def test_transforms_within_each_other_multiply(camera, outer, inner):
    assert_same(camera.within(outer).within(inner), camera.within(outer @ inner))


# ------------------------------------------------------------------------------------------- conventions


@PROPERTIES
@given(scenes(PERSPECTIVE), st.sampled_from([0.0, 0.5]))
def test_opencv_sees_points_in_the_same_pixels_and_its_numbers_give_the_camera_back(scene, center):
    camera, size, points, expected = scene
    k, r, t = camera.to_opencv(size, pixel_center=center)
    x = (points @ r.T + t) @ k.T
    close(x[:, :2] / x[:, 2:] + (0.5 - center), expected[:, :2], 1e-6)
    close(x[:, 2], expected[:, 2])
    near, far = camera.depth_range()
    assert_same(Camera.from_opencv(k, r, t, size, near=near, far=far, pixel_center=center), camera)


@PROPERTIES
@given(scenes(("look_at",)))
def test_pytorch3d_sees_points_in_the_same_place_and_its_numbers_give_the_camera_back(scene):
    camera, size, points, expected = scene
    r, t, focal, middle = camera.to_pytorch3d(size)
    x = points @ r + t
    # Its axes lead left and up from the middle; half the shorter side is one unit.
    ndc = focal * x[:, :2] / x[:, 2:] + middle
    close((np.array(size[::-1]) - ndc * min(size)) / 2, expected[:, :2], 1e-6)
    close(x[:, 2], expected[:, 2])
    near, far = camera.depth_range()
    back = Camera.from_pytorch3d(r, t, focal_length=focal, principal_point=middle, size=size, near=near, far=far)
    assert_same(back, camera)


@PROPERTIES
@given(views(), sizes(), reals(5, 130), reals(0.1, 1), reals(1.5, 60))
def test_blenders_numbers_give_cameras_of_square_pixels_back(view, size, fov, near, ratio):
    eye, target, up = view
    planes = {"near": near, "far": ratio * near}
    camera = Camera.look_at(eye, target, up, fov_y=fov, aspect=size[1] / size[0], **planes)
    matrix, focal = camera.to_blender(size)
    close(matrix[:3, 3], eye)
    close(-matrix[:3, 2], (target - eye) / np.linalg.norm(target - eye))
    close(focal, size[0] / 2 / np.tan(np.radians(fov) / 2))
    assert_same(Camera.from_blender(matrix, size, focal=focal, **planes), camera)
    assert_same(Camera.from_blender(matrix[:3], size, focal=focal, **planes), camera)


@PROPERTIES
@given(scenes(), st.booleans())
def test_nvdiffrast_sees_points_in_the_same_rows_or_upside_down_and_gives_the_camera_back(scene, top_down):
    camera, size, points, expected = scene
    modelview, projection = camera.to_nvdiffrast(top_down=top_down)
    clip = np.column_stack([points, np.ones(len(points))]) @ (projection @ modelview).T
    # Row 0 is the bottom, −1, there.
    row = (1 + clip[:, 1] / clip[:, 3]) * size[0] / 2
    close(row if top_down else size[0] - row, expected[:, 1])
    assert_same(Camera.from_nvdiffrast(modelview, projection, top_down=top_down), camera)


@PROPERTIES
@given(cameras())
def test_opengls_matrices_are_the_cameras(camera):
    assert_same(Camera.from_opengl(*camera.to_opengl()), camera)
