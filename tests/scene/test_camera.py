"""Cameras: conventions of space, converters from other libraries, derivatives of the constructors."""

import copy
import math
import pickle

import numpy as np
import pytest
from helpers import (
    ALL,
    DIFFERENTIABLE,
    arrays,
    derivative,
    finite_difference,
    gradient,
    refused,
    rigid,
    rotation,
    to_numpy,
)

import rts
from rts import Camera, InputError
from rts.scene.camera import look_at, orthographic, perspective
from rts_surfaces.mesh import Mesh

pytestmark = pytest.mark.rendering

SIZE = (40, 60)
QUARTER_TURN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
SKEWED_K = np.array([[50.0, 2.0, 31.0], [0.0, 45.0, 22.0], [0.0, 0.0, 1.0]])


def pixel(camera, point, size=SIZE):
    """Pixel x, y and depth of one world point."""
    return camera.project(np.array([point], np.float64), size)[0]


CAMERAS = {
    "perspective": Camera.look_at((1.0, 2.0, 5.0), (0.2, -0.3, 0.1), fov_y=50.0, aspect=1.5),
    "off-centre": Camera.look_at((1.0, 2.0, 5.0), (0.0, 0.0, 0.0), aspect=1.5, principal_point=(0.3, -0.2)),
    "orthographic": Camera.orthographic((1.0, 2.0, 5.0), (0.0, 0.0, 0.0), height=3.0, aspect=1.5),
    "orthographic off-centre": Camera.orthographic(
        (1.0, 2.0, 5.0), (0.0, 0.0, 0.0), height=3.0, aspect=1.5, principal_point=(0.3, -0.2)
    ),
    "skewed": Camera.from_opencv(SKEWED_K, rotation((1, 2, 3), 40), (0.1, 0.2, 6.0), SIZE),
}


# --------------------------------------------------------------------------------------------- conventions


def test_perspective_pixel_of_a_point_is_the_written_out_number():
    # At depth 5 a field of view of 90° shows y from −5 to 5: 4 pixels a unit.
    camera = Camera.look_at((0, 0, 5), (0, 0, 0), fov_y=90, aspect=1.5)
    np.testing.assert_allclose(pixel(camera, (1, 2, 0)), (30 + 4, 20 - 8, 5), atol=1e-12)


def test_a_camera_without_a_pose_is_at_the_origin_and_looks_along_minus_z():
    camera = Camera.perspective(90)
    np.testing.assert_array_equal(camera.view, np.eye(4))
    # At depth 5 an image of 200 rows shows ±5: 20 pixels a unit, from the middle (150, 100).
    np.testing.assert_allclose(camera.project(np.array([[1.0, 2, -5]]), (200, 300)), [[170, 60, 5]], atol=1e-9)
    looking = Camera.look_at((1, 2, 5), (0, 0, 0), fov_y=30, near=0.1, far=9)
    assert Camera.perspective(30, view=looking.view, near=0.1, far=9) == looking
    assert Camera.perspective(30, aspect=1.5).aspect == 1.5
    for wrong, said in ({"view": np.zeros((4, 4))}, "singular"), ({"view": np.eye(3)}, "shape"), ({"near": 0}, "near"):
        with pytest.raises(InputError, match=said):
            Camera.perspective(40, **wrong)


def test_a_camera_of_a_matrix_is_differentiable_in_it():
    torch = pytest.importorskip("torch")
    view = torch.eye(4, dtype=torch.float64, requires_grad=True)
    Camera.perspective(90, view=view).project(torch.tensor([[1.0, 2, -5]]).double(), (200, 300))[0, 0].backward()
    assert view.grad[0, 3] == pytest.approx(20)  # Pixels a unit.


def test_orthographic_pixel_of_a_point_is_the_written_out_number():
    # 8 units high, 40 pixels high: 5 pixels a unit at any depth.
    camera = Camera.orthographic((0, 0, 5), (0, 0, 0), height=8, aspect=1.5)
    np.testing.assert_allclose(pixel(camera, (1, 2, 0)), (30 + 5, 20 - 10, 5), atol=1e-12)
    np.testing.assert_allclose(pixel(camera, (1, 2, -7)), (30 + 5, 20 - 10, 12), atol=1e-12)


# The direction of view, `up`, and what is then to the right and on top.
ALONG_UP = [
    ((0, -5, 0), (0, 1, 0), (1, 0, 0), (0, 0, -1)),
    ((0, 5, 0), (0, 3, 0), (1, 0, 0), (0, 0, 1)),
    ((0, 0, -2), (0, 0, 1), (1, 0, 0), (0, 1, 0)),
    ((0, 0, -2), (0, 0, -1), (1, 0, 0), (0, 1, 0)),
    ((4, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ((1, 1, 1), (2, 2, 2), (2 / 6**0.5, -1 / 6**0.5, -1 / 6**0.5), (0, -(0.5**0.5), 0.5**0.5)),
]


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("direction, up, right, top", ALONG_UP)
def test_a_view_along_up_has_x_to_the_right(direction, up, right, top, target):
    eye = np.array((0.5, -1, 2))
    given = arrays(target, (eye, eye + direction, np.array(up, np.float64)))
    view = to_numpy(look_at(*given))
    np.testing.assert_allclose(view[:2, :3], (right, top), atol=1e-6)
    np.testing.assert_allclose(view[:3, :3] @ view[:3, :3].T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(view @ [*eye, 1], (0, 0, 0, 1), atol=1e-6)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_derivatives_of_a_view_along_up_are_finite(target):
    weights, target_at = arrays(target, VIEW_WEIGHTS), np.zeros(3)
    given = arrays(target, {"eye": np.array((0.0, 5, 0)), "target": target_at, "up": np.array((0.0, 1, 0))})
    found = gradient(target, lambda a: (weights * look_at(a["eye"], a["target"], a["up"])).sum(), given)
    assert all(np.isfinite(x).all() for x in found.values())
    # Eye and target that move together move the world alone: −W of the translation, in the world.
    linear = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    np.testing.assert_allclose(found["eye"] + found["target"], -linear.T @ VIEW_WEIGHTS[:3, 3], atol=1e-5)


def test_views_near_up_are_continuous():
    # From in front, and ever steeper: the view comes nearer to that from above.
    above = look_at((0, 5, 0), (0, 0, 0))
    for slope in 1e-3, 1e-6, 1e-9, 1e-12:
        np.testing.assert_allclose(look_at((0, 5, 5 * slope), (0, 0, 0)), above, atol=10 * slope)
    np.testing.assert_allclose(look_at((5e-9, 5, 0), (0, 0, 0))[:2, :3], [(0, 0, -1), (-1, 0, 0)], atol=1e-8)


@pytest.mark.parametrize("make", [Camera.look_at, Camera.perspective])
def test_a_field_of_view_in_radians_is_warned_of(make):
    places = ((0, 0, 5), (0, 0, 0)) if make == Camera.look_at else ()
    for radians in math.radians(10), np.float32(math.radians(15)), 0.6911112, np.float32(math.pi / 4), math.pi / 2:
        with pytest.warns(
            rts.errors.InputWarning, match=r"fov_y is .*, and is in degrees: of radians give math.degrees"
        ):
            make(*places, fov_y=radians)
    for degrees in 2.0, 0.29, 0.19, 0.1, np.float32(0.05), 0.01:  # The others are of telephoto lenses.
        make(*places, fov_y=degrees)
    Camera.from_blender(np.eye(4), SIZE, focal=5000.0)  # Of half a degree, which nobody gave as an angle.


def test_normalised_intrinsics_are_refused_and_scaled_ones_are_not():
    K = np.array([[1.2, 0, 0.5], [0, 1.6, 0.5], [0, 0, 1]])
    scaled = np.diag([SIZE[1], SIZE[0], 1]) @ K
    with pytest.raises(rts.InputError, match=rf"K looks normalised.*np.diag\(\[{SIZE[1]}, {SIZE[0]}, 1\]\) @ K"):
        Camera.from_opencv(K, np.eye(3), np.zeros(3), SIZE)
    camera = Camera.from_opencv(scaled, np.eye(3), np.zeros(3), SIZE, pixel_center=0.5)
    np.testing.assert_allclose(camera.projection[:2, :3], [[2.4, 0, 0], [0, 3.2, 0]], atol=1e-12)
    # A small image, a wide lens, and a cut-out that begins at the principal point are in pixels.
    Camera.from_opencv(K, np.eye(3), np.zeros(3), (2, 2))
    Camera.from_opencv([[8, 0, 32], [0, 8, 24], [0, 0, 1]], np.eye(3), np.zeros(3), (48, 64))
    Camera.from_opencv([[50, 0, 0], [0, 50, 0], [0, 0, 1]], np.eye(3), np.zeros(3), (48, 64))


FLOOR = 2e5 * np.array([[-1.0, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]])


@pytest.mark.parametrize("make", ["look_at", "perspective", "from_opencv", "from_blender"])
def test_a_floor_reaches_its_horizon(make):
    """The floor ends where the plane of the eye meets the image: rows above it are empty, the row across it is cut."""
    size, view, fov = (48, 64), look_at((0, 1.6, 0), (0, 0.3, -10)), 40.0
    focal = 24 / math.tan(math.radians(20))
    intrinsics = [[focal, 0, 32], [0, focal, 24], [0, 0, 1]]
    flipped = np.diag([1.0, -1, -1]) @ view[:3]
    camera = {
        "look_at": lambda: Camera.look_at((0, 1.6, 0), (0, 0.3, -10), fov_y=fov),
        "perspective": lambda: Camera.perspective(fov, view=view),
        "from_opencv": lambda: Camera.from_opencv(intrinsics, flipped[:, :3], flipped[:, 3], size, pixel_center=0.5),
        "from_blender": lambda: Camera.from_blender(np.linalg.inv(view), size, focal=focal),
    }[make]()
    image = rts.render(rts.Part(Mesh([[0, 1, 2], [0, 2, 3]]), {"vertices": FLOOR}, "silhouette"), camera, size)
    horizon = 24 - focal * 0.13  # The axis falls by 1.3 in 10.
    np.testing.assert_allclose(image[..., -1].sum(0), 48 - horizon, atol=2e-3)


def test_near_and_far_default_to_a_hundredth_and_a_million_times_the_distance():
    camera = Camera.look_at((0, 0, 5), (0, 0, 0))
    np.testing.assert_allclose(camera.projection, perspective(45.0, 1.0, 0.05, 5e6))


def test_the_first_pixel_centre_is_at_one_half():
    camera = Camera.orthographic((0, 0, 5), (0, 0, 0), height=40, aspect=1.5)
    np.testing.assert_allclose(pixel(camera, (-29.5, 19.5, 0)), (0.5, 0.5, 5), atol=1e-12)


def test_points_on_the_plane_of_the_camera_project_to_finite_values_with_depth_zero():
    x, y, depth = pixel(Camera.look_at((0, 0, 5), (0, 0, 0)), (1, 2, 5))
    assert np.isfinite((x, y)).all() and depth == 0


# ---------------------------------------------------------------------------------------------- converters


@pytest.mark.parametrize("pixel_center, expected", [(0.0, (44.5, 33.75, 4)), (0.5, (44.0, 33.25, 4))])
def test_opencv_point_lands_half_a_pixel_beyond_its_u_v(pixel_center, expected):
    # R X + t = (3, 2, −1) + t = (1, 1, 4); u = (50 · 1 + 2 · 1) / 4 + 31 = 44, v = 45 / 4 + 22 = 33.25, where
    # OpenCV has the centre of the first pixel at (0, 0) and we at (0.5, 0.5).
    camera = Camera.from_opencv(SKEWED_K, QUARTER_TURN, (-2, -1, 5), SIZE, pixel_center=pixel_center)
    np.testing.assert_allclose(pixel(camera, (1, 2, 3)), expected, atol=1e-12)


def test_opencv_translation_may_be_a_column():
    row = Camera.from_opencv(SKEWED_K, QUARTER_TURN, (-2, -1, 5), SIZE)
    column = Camera.from_opencv(SKEWED_K, QUARTER_TURN, np.array([[-2], [-1], [5]]), SIZE)
    np.testing.assert_array_equal(row.view, column.view)


def test_opengl_window_point_is_ours_counted_from_the_top():
    # glFrustum(−1, 2, −1, 1.5, 1, 10), eye space (0.5, 0.25, −2): NDC x = (2/3 · 0.5 − 1/3 · 2) / 2 = −1/6
    # and y = (0.8 · 0.25 − 0.2 · 2) / 2 = −0.1; window (5/6 · 30, 0.9 · 20) = (25, 18) from the lower left.
    frustum = np.array([[2 / 3, 0, 1 / 3, 0], [0, 0.8, 0.2, 0], [0, 0, -11 / 9, -20 / 9], [0, 0, -1, 0]])
    modelview = np.eye(4)
    modelview[:3, 3] = (0.5, 0.25, -1.0)
    camera = Camera.from_opengl(modelview, frustum)
    np.testing.assert_allclose(pixel(camera, (0, 0, -1)), (25, 40 - 18, 2), atol=1e-12)


def test_nvdiffrast_sample_position_is_ours_with_rows_reversed():
    # nvdiffrast samples column i, row j at NDC ((2 i + 1) / w − 1, (2 j + 1) / h − 1), row 0 at NDC y = −1.
    # Clip (0.75, −0.3, ·, 3): column coordinate 1.25 · 30 = 37.5, row coordinate 0.9 · 20 = 18, from below.
    projection = np.array([[1.5, 0, 0, 0], [0, 0.6, 0, 0], [0, 0, -11 / 9, -20 / 9], [0, 0, -1, 0]])
    point = (0.5, -0.5, -3.0)
    np.testing.assert_allclose(pixel(Camera.from_nvdiffrast(np.eye(4), projection), point), (37.5, 22, 3), atol=1e-12)
    # Negating y puts nvdiffrast's row 0 on top: its row coordinate, 22, is then ours.
    flipped = np.diag([1.0, -1, 1, 1]) @ projection
    camera = Camera.from_nvdiffrast(np.eye(4), flipped, top_down=True)
    np.testing.assert_allclose(pixel(camera, point), (37.5, 22, 3), atol=1e-12)


@pytest.mark.parametrize("size, expected", [((40, 60), (13, 14, 4)), ((60, 40), (3, 24, 4)), ((40, 40), (3, 14, 4))])
def test_pytorch3d_ndc_spans_the_shorter_side_with_x_left_and_y_up(size, expected):
    # X R + T = (−3, 2, 1) + T = (1, 1, 4); NDC x = 3 / 4 + 0.1 = 0.85, y = 2 / 4 − 0.2 = 0.3; the shorter
    # side, 40 pixels, is 2 long, and the pixel is (w / 2 − 20 · 0.85, h / 2 − 20 · 0.3).
    camera = Camera.from_pytorch3d(
        QUARTER_TURN, (4, -1, 3), focal_length=(3, 2), principal_point=(0.1, -0.2), size=size
    )
    np.testing.assert_allclose(pixel(camera, (1, 2, 3), size), expected, atol=1e-12)


def test_pytorch3d_focal_length_may_be_one_number_and_is_the_cotangent_of_half_the_field_of_view():
    R = np.diag([-1.0, 1.0, -1.0])
    camera = Camera.from_pytorch3d(R, (0, 0, 0), focal_length=1 / np.tan(np.radians(25)), size=SIZE, near=0.1, far=9)
    np.testing.assert_allclose(camera.projection, perspective(50, 1.5, 0.1, 9), atol=1e-12)
    np.testing.assert_allclose(camera.view, np.eye(4), atol=1e-12)


@pytest.mark.parametrize("rows", [3, 4])
def test_blender_camera_looks_along_its_minus_z_with_focal_in_pixels(rows):
    # Camera space (0.4, 0.2, −2): pixel (30 + 50 · 0.4 / 2, 20 − 50 · 0.2 / 2).
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3], camera_to_world[:3, 3] = QUARTER_TURN, (1, 2, 3)
    # QUARTER_TURN (0.4, 0.2, −2) + (1, 2, 3)
    world = (-1.0, 2.2, 2.6)
    camera = Camera.from_blender(camera_to_world[:rows], SIZE, focal=50.0)
    np.testing.assert_allclose(pixel(camera, world), (40, 15, 2), atol=1e-12)


# --------------------------------------------------------------------------------------------- derivatives

PLACE = {"eye": (1.0, 2.0, 5.0), "target": (0.1, 0.2, 0.3), "up": (0.1, 1.0, 0.2)}
PLANES = {"near": 0.5, "far": 9.0}
IMAGE = {"aspect": 1.5, "principal_point": (0.1, 0.2), **PLANES}
POSE = rigid((1, 2, 3), 40, (0.1, 0.2, 6.0))
MATRICES = {"modelview": POSE, "projection": perspective(50.0, 1.5, 0.5, 9.0)}
CONSTRUCTORS = {
    "look_at": (lambda a: Camera.look_at(**a), {**PLACE, **IMAGE, "fov_y": 50.0}),
    "look_at, default planes": (
        lambda a: Camera.look_at(**a).for_size((20, 30)),
        {"eye": PLACE["eye"], "target": PLACE["target"]},
    ),
    "orthographic": (lambda a: Camera.orthographic(**a), {**PLACE, **IMAGE, "height": 3.0}),
    "from_opencv": (
        lambda a: Camera.from_opencv(**a, size=SIZE),
        {"K": SKEWED_K, "R": POSE[:3, :3], "t": (0.1, 0.2, 6.0), **PLANES},
    ),
    "from_mvp": (
        lambda a: Camera.from_mvp(**a),
        {"matrix": CAMERAS["off-centre"].projection @ CAMERAS["off-centre"].view},
    ),
    "from_opengl": (lambda a: Camera.from_opengl(**a), MATRICES),
    "from_nvdiffrast": (lambda a: Camera.from_nvdiffrast(**a, top_down=True), MATRICES),
    "from_pytorch3d": (
        lambda a: Camera.from_pytorch3d(**a, size=SIZE),
        {"R": POSE[:3, :3], "T": (0.1, 0.2, 6.0), "focal_length": (3.0, 2.0), "principal_point": (0.1, -0.2), **PLANES},
    ),
    "from_blender": (lambda a: Camera.from_blender(**a, size=SIZE), {"camera_to_world": POSE, "focal": 50.0, **PLANES}),
}
VIEW_WEIGHTS, PROJECTION_WEIGHTS = np.random.default_rng(0).normal(size=(2, 4, 4))


def weighted_sum(make, target, dtype=np.float64):
    """A scalar function of a constructor's arguments that depends on all 32 numbers of the camera."""
    weights = arrays(target, (VIEW_WEIGHTS, PROJECTION_WEIGHTS), dtype)

    def f(arguments):
        return sum((w * m).sum() for w, m in zip(weights, make(arguments), strict=True))

    return f


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("name", CONSTRUCTORS)
def test_constructor_gradient_and_jvp_in_all_arguments_are_the_finite_difference(name, target):
    make, arguments = CONSTRUCTORS[name]
    arguments = {key: np.array(value, np.float64) for key, value in arguments.items()}
    expected = finite_difference(weighted_sum(make, "numpy"), arguments)
    dtype, tolerance = (np.float32, 2e-3) if target == "jax" else (np.float64, 1e-6)
    f, given = weighted_sum(make, target, dtype), arrays(target, arguments, dtype)
    found = gradient(target, f, given)
    for key in arguments:
        np.testing.assert_allclose(found[key], expected[key], rtol=tolerance, atol=tolerance, err_msg=key)
    rng = np.random.default_rng(1)
    direction = {key: rng.normal(size=value.shape) for key, value in arguments.items()}
    _, along = derivative(target, f, given, arrays(target, direction, dtype))
    product = sum(np.sum(expected[key] * direction[key]) for key in arguments)
    assert along == pytest.approx(product, rel=tolerance, abs=tolerance)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("name, argument", [(n, a) for n in CONSTRUCTORS for a in CONSTRUCTORS[n][1]])
def test_each_argument_alone_may_be_differentiable_beside_plain_numbers(name, argument, target):
    make, arguments = CONSTRUCTORS[name]
    camera = make(arguments | {argument: arrays(target, np.array(arguments[argument]))})
    plain = make(arguments)
    for found, expected in zip(camera, plain, strict=True):
        assert type(found) is type(arrays(target, np.zeros(1)))
        np.testing.assert_allclose(np.asarray(found), expected, rtol=1e-4, atol=1e-4)


def test_an_eye_listed_as_traced_scalars_is_differentiable():
    torch = pytest.importorskip("torch")
    x = torch.tensor(1.0, requires_grad=True)
    camera = Camera.look_at((x, 2.0, 5.0), (0.0, 0.0, 0.0))
    x_of_camera = -(camera.view[:3, :3].T @ camera.view[:3, 3])[0]
    (slope,) = torch.autograd.grad(x_of_camera, x)
    assert slope == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_project_gradient_in_points_is_the_finite_difference(target):
    points = np.random.default_rng(0).normal(size=(3, 3))
    weights = np.random.default_rng(1).normal(size=(3, 3))
    camera = CAMERAS["skewed"]
    expected = finite_difference(lambda p: (camera.project(p, SIZE) * weights).sum(), points)
    there, w = arrays(target, camera), arrays(target, weights)
    found = gradient(target, lambda p: (there.project(p, SIZE) * w).sum(), arrays(target, points))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_project_gradient_is_finite_on_the_plane_of_the_camera(target):
    camera = arrays(target, Camera.look_at((0, 0, 5), (0, 0, 0)))
    found = gradient(target, lambda p: camera.project(p, SIZE).sum(), arrays(target, np.array([[1.0, 2.0, 5.0]])))
    assert np.isfinite(found).all()


# -------------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda: perspective(45, 1, 2.0, 1.0), ("near", "2.0", "far")),
        (lambda: perspective(45, 1, 1.0, 1.0), ("near < far",)),
        (lambda: perspective(45, 1, 0.0, 1.0), ("near > 0",)),
        (lambda: perspective(45, 1, 0.1, float("inf")), ("finite",)),
        (lambda: perspective(45, 1, float("nan"), 1.0), ("finite",)),
        (lambda: perspective(0), ("fov_y", "degrees")),
        (lambda: perspective(-30), ("fov_y", "-30")),
        (lambda: orthographic(0), ("height", "positive")),
        (lambda: orthographic(2, 1, 3.0, 2.0), ("near", "far")),
        (lambda: look_at((1, 2, 3), (1, 2, 3)), ("upright", "[1.0, 2.0, 3.0]")),
        (lambda: look_at((0, 5, 0), (0, 0, 1), (0, 0, 0)), ("upright",)),
        (lambda: look_at((0, 5), (0, 0, 0)), ("eye has shape (2,)", "expected (3,)")),
        (lambda: look_at((0, float("nan"), 1), (0, 0, 0)), ("eye", "nan", "finite")),
        (lambda: Camera.from_opencv(np.eye(3), np.eye(3), np.zeros(3), SIZE, near=2, far=1), ("near < far",)),
        (lambda: Camera.from_nvdiffrast(np.eye(4), np.eye(3)), ("projection", "(3, 3)", "(4, 4)")),
    ],
)
def test_bad_camera_is_an_input_error_that_says_what_was_given(call, words):
    with pytest.raises(InputError) as error:
        call()
    message = str(error.value)
    assert "\n" not in message
    for word in words:
        assert word in message


# ------------------------------------------------------------------------------------ one matrix for everything


def two_layers():
    """A red triangle in front of a green one, which it hides; seen from +z."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)
    vertices = np.concatenate([corners, corners * 1.5 - [0, 0, 1]]).astype(np.float32)
    colors = np.repeat(np.eye(3, dtype=np.float32)[:2], 3, axis=0)
    return rts.Part(
        rts.plugin("surfaces", "mesh")([[0, 1, 2], [3, 4, 5]]), {"vertices": vertices, "colors": colors}, "unlit"
    )


@pytest.mark.parametrize("sampler", ["raster", "reference", "embree"])
def test_a_product_as_projection_is_refused_and_taken_apart_it_gives_the_same_picture(sampler):
    camera = Camera.look_at((0.5, 1, 3), (0, 0, 0), fov_y=50, aspect=1.5)
    product = camera.projection @ camera.view
    with pytest.raises(InputError, match=r"last row of the camera's projection .* Camera.from_mvp"):
        rts.render(two_layers(), Camera(np.eye(4), product), SIZE, sampler=sampler)
    expected = rts.render(two_layers(), camera, SIZE, sampler=sampler)
    assert expected[20, 30].tolist() == [1, 0, 0, 1]
    found = rts.render(two_layers(), Camera.from_mvp(product), SIZE, sampler=sampler)
    np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("scale", [1.0, 3.7, 1e-3])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_from_mvp_has_the_pixels_depths_and_planes_of_the_camera_whose_product_it_is(camera, scale):
    found = Camera.from_mvp(scale * (camera.projection @ camera.view))
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    expected, pixels = camera.project(points, SIZE), found.project(points, SIZE)
    np.testing.assert_allclose(pixels[:, :2], expected[:, :2], atol=1e-8)
    near, far = camera.depth_range()
    if camera.projection[3, 2] == 0:  # Where parallel rays start does not show in their image.
        expected[:, 2] -= near
        near, far = 0, far - near
    np.testing.assert_allclose(pixels[:, 2], expected[:, 2], rtol=1e-7)
    np.testing.assert_allclose(found.depth_range(), (near, far), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.view[:3, :3] @ found.view[:3, :3].T, np.eye(3), atol=1e-12)


def views():
    """Poses (4, 4): turned and moved, each alone and both; none that a product with it does not show."""
    turned = [rotation(axis, angle) for axis, angle in (((1, 2, 3), 40), ((0, 1, 0), 170), ((3, -1, 1), 95))]
    for linear in (np.eye(3), *turned):
        for shift in (0.0, 0, -5), (1.0, 2, -3):
            yield np.block([[linear, np.array(shift)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def with_depths(projection, z):
    """A projection with another row of clip z."""
    return np.stack([projection[0], projection[1], np.array([0, 0, *z]), projection[3]])


LENS = perspective(45, 1.3, 0.1, 100.0)
PRODUCTS = {
    "centred": LENS,
    "off-centre": perspective(30, 1.3, 0.5, 20.0, (0.3, -0.2)),
    "infinite": with_depths(LENS, (-1, -0.2)),
    "infinite, reversed": with_depths(LENS, (1, 0.2)),
    "parallel": orthographic(3, 1.3, 0.1, 10.0),
    "depths from 0 to 1": with_depths(LENS, (-100 / 99.9, -10 / 99.9)),
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", PRODUCTS)
def test_from_mvp_tells_other_products_apart(name, dtype):
    for view in views():
        projection, view = PRODUCTS[name].astype(dtype), view.astype(dtype)
        Camera.from_mvp(projection @ view)
        Camera.from_mvp(np.float32(3.7) * (projection @ view))
        with pytest.raises(InputError, match="matrix is transposed, .* give matrix.T"):
            Camera.from_mvp((projection @ view).T)
        turns = not np.array_equal(view[:3, :3], np.eye(3))
        if name != "parallel" and turns:
            with pytest.raises(InputError, match="matrix is view @ projection; expected projection @ view"):
                Camera.from_mvp(view @ projection)


@pytest.mark.parametrize("z", [(0.1 / 99.9, 10 / 99.9), (0.0, 0.1)], ids=["finite", "infinite"])
def test_from_mvp_refuses_depths_from_1_to_0(z):
    for view in views():
        with pytest.raises(InputError, match="plane behind the camera, at the depth -.* depths from -1 to 1"):
            Camera.from_mvp(with_depths(LENS, z) @ view)


def test_from_mvp_of_depths_from_0_to_1_has_the_same_picture():
    camera = Camera.look_at((0.5, 1, 3), (0, 0, 0), fov_y=45, near=0.1, far=100, aspect=1.3)
    found = Camera.from_mvp(PRODUCTS["depths from 0 to 1"] @ camera.view)
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    np.testing.assert_allclose(found.project(points, SIZE), camera.project(points, SIZE), rtol=1e-9)


@pytest.mark.parametrize("sampler", ["raster", "reference", "embree"])
def test_a_camera_that_looks_along_plus_z_shows_what_is_in_front(sampler):
    camera = Camera.look_at((0.5, 1, 3), (0, 0, 0), fov_y=50, aspect=1.5)
    flip = np.diag([1.0, 1, -1, 1])
    found = rts.render(two_layers(), Camera(flip @ camera.view, camera.projection @ flip), SIZE, sampler=sampler)
    np.testing.assert_allclose(found, rts.render(two_layers(), camera, SIZE, sampler=sampler), atol=1e-6)


def test_a_traced_projection_along_plus_z_is_refused():
    jax = pytest.importorskip("jax")
    camera = Camera.look_at((0.5, 1, 3), (0, 0, 0), aspect=1.5)
    flip = np.diag([1.0, 1, -1, 1])
    part = two_layers()
    with pytest.raises(Exception, match=r"looks along \+z"):
        jax.jit(lambda p: rts.render(part, Camera(flip @ camera.view, p), SIZE))(camera.projection @ flip)


@pytest.mark.parametrize("last", [(1e-18, 0, 0, 1), (0, 3e-8, 0, 1), (0, 0, 0, 1 + 1e-7)])
@pytest.mark.parametrize("where", ["view", "transform"])
def test_a_last_row_that_is_affine_up_to_rounding_is_accepted(where, last):
    camera = Camera.look_at((0.5, 1, 3), (0, 0, 0), aspect=1.5)
    expected = rts.render(two_layers(), camera, SIZE)
    rounded = np.concatenate([(camera.view if where == "view" else np.eye(4))[:3], [last]])
    part = two_layers() if where == "view" else two_layers().replace(transform=rounded)
    found = rts.render(part, camera.replace(view=rounded) if where == "view" else camera, SIZE)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_last_row_that_is_not_affine_is_refused():
    camera = Camera.look_at((0.5, 1, 3), (0, 0, 0), aspect=1.5)
    with pytest.raises(InputError, match="last row of the camera's view"):
        rts.render(two_layers(), camera.replace(view=camera.view + np.eye(4)[3][:, None] * 1e-4), SIZE)


# ------------------------------------------------------------------------------------------ width over height


def square():
    """A square of two units in the plane z = 0."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    return rts.Part(rts.plugin("surfaces", "mesh")([[0, 1, 2], [0, 2, 3]]), {"vertices": corners})


@pytest.mark.parametrize("size", [(64, 128), (128, 64), (50, 50)])
@pytest.mark.parametrize("make", [Camera.look_at, lambda *a: Camera.orthographic(*a, height=6.0)])
def test_a_camera_without_a_ratio_takes_it_from_the_size_and_a_square_stays_square(make, size):
    image = rts.render(square(), make((0, 0, 6), (0, 0, 0)), size, splatter="none", supersample=4)
    height, width = image[..., 3].sum(axis=0).max(), image[..., 3].sum(axis=1).max()
    assert height == pytest.approx(width, abs=0.6)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Camera.look_at((0, 0, 6), (0, 0, 0), aspect=1.5),
        lambda: Camera.orthographic((0, 0, 6), (0, 0, 0), height=6.0, aspect=1.5),
        lambda: Camera.from_opencv(SKEWED_K, np.eye(3), (0, 0, 6), SIZE),
        lambda: Camera.from_pytorch3d(np.eye(3), (0, 0, 6), focal_length=2.0, size=SIZE),
        lambda: Camera.from_blender(rigid((1, 0, 0), 0, (0, 0, 6)), SIZE, focal=50.0),
    ],
)
def test_an_image_of_another_ratio_than_its_cameras_is_warned_of_with_both(make):
    camera = make()
    with pytest.warns(rts.errors.AspectWarning, match=r"width / height = 1\.5, and size is \(40, 40\), of 1") as caught:
        rts.render(square(), camera, (40, 40))
    assert caught[0].filename == __file__
    for size in (SIZE, (80, 120), (27, 40)):  # The last is the ratio up to a pixel.
        rts.render(square(), camera, size)


def test_a_camera_of_plain_matrices_is_compared_with_no_size():
    camera = Camera.look_at((0, 0, 6), (0, 0, 0), aspect=1.5)
    plain = Camera(camera.view, camera.projection)
    np.testing.assert_array_equal(rts.render(square(), plain, (40, 40)), rts.render(square(), plain, (40, 40)))


@pytest.mark.parametrize("use", ["unpacked", "to_opengl", "to_nvdiffrast"])
def test_an_open_ratio_is_never_taken_for_a_square_without_a_word(use):
    camera = Camera.look_at((0, 0, 6), (0, 0, 0))
    with pytest.raises(InputError, match=r"ratio of width to height open .* for_size"):
        tuple(camera) if use == "unpacked" else getattr(camera, use)()
    expected = Camera.look_at((0, 0, 6), (0, 0, 0), aspect=1.5)
    view, projection = camera.for_size(SIZE)
    np.testing.assert_allclose(projection, expected.projection)
    np.testing.assert_array_equal(view, expected.view)
    if use != "unpacked":
        for found, wanted in zip(getattr(camera, use)(size=SIZE), getattr(expected, use)(), strict=True):
            np.testing.assert_allclose(found, wanted)


def test_an_open_ratio_passes_through_transforms_of_the_engines():
    jax = pytest.importorskip("jax")
    camera = Camera.look_at((0, 0, 6), (0, 0, 0))
    found = jax.jit(lambda c: rts.render(square(), c, (30, 60)))(camera)
    np.testing.assert_allclose(found, rts.render(square(), camera, (30, 60)), atol=1e-5)


def test_cameras_are_equal_if_their_matrices_and_ratios_are():
    torch = pytest.importorskip("torch")
    camera = Camera.look_at((0, 0, 6), (0, 0, 0))
    assert (camera == Camera.look_at((0, 0, 6), (0, 0, 0))) is True
    assert (camera == Camera.look_at((0, 0, 7), (0, 0, 0))) is False
    assert (camera == Camera.look_at((0, 0, 6), (0, 0, 0), aspect=1.0)) is False
    assert (camera == 3) is False
    assert (camera.map(torch.tensor) == camera.map(torch.tensor)) is True
    assert camera.map(torch.tensor) == camera
    assert pickle.loads(pickle.dumps(camera)) == copy.deepcopy(camera) == camera


# ------------------------------------------------------------------------------------------------- derivatives


def test_forward_mode_through_a_scalar_that_was_divided_by_gives_the_derivative():
    torch = pytest.importorskip("torch")
    camera = Camera.look_at((0, 0, 6), (0, 0, 0), aspect=1.0)
    lower = torch.tensor(camera.projection[1:], dtype=torch.float32)
    part = square().replace(theta={"vertices": torch.tensor(square().theta["vertices"])})

    def image(x):
        # The tangent of 1 / x is in float64 where x is a scalar in float32, by torch's own rule.
        first = torch.stack([1 / x, 0 * x, 0 * x, 0 * x])
        return rts.render(part, Camera(camera.view, torch.cat([first[None], lower])), (32, 32)).sum()

    x = torch.tensor(0.5)
    _, along = torch.func.jvp(image, (x,), (torch.tensor(1.0),))
    x.requires_grad_(True)
    (slope,) = torch.autograd.grad(image(x), x)
    assert along.dtype == torch.float32
    assert float(along) == pytest.approx(float(slope), rel=1e-4)


# ----------------------------------------------------------------------------------- what makes no image at all

NONSENSE = {
    "aspect": (lambda a: Camera.look_at((0, 0, 4), (0, 0, 0), aspect=a(-1.0)), "aspect is .*-1.*; expected a positive"),
    "fov_y": (lambda a: Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=a(180.0)), "fov_y is .*180.*degrees, more than 0"),
    "planes": (lambda a: Camera.look_at((0, 0, 4), (0, 0, 0), near=a(2.0), far=a(1.0)), "near is .*near < far"),
    "near": (lambda a: Camera.look_at((0, 0, 4), (0, 0, 0), near=a(-2.0), far=a(1.0)), "near is .*near > 0"),
    "height": (lambda a: Camera.orthographic((0, 0, 4), (0, 0, 0), height=a(0.0)), "height is .*positive"),
    "K": (lambda a: Camera.from_opencv(a(np.ones((3, 3))), np.eye(3), np.zeros(3), SIZE), "K is .*fx, skew"),
    "K upside down": (
        lambda a: Camera.from_opencv(a(SKEWED_K * [[1], [-1], [1]]), np.eye(3), np.zeros(3), SIZE),
        "K is .*positive fx and fy",
    ),
    "R scaled": (lambda a: Camera.from_opencv(SKEWED_K, a(2 * np.eye(3)), np.zeros(3), SIZE), "R is off by 3"),
    "R mirrored": (
        lambda a: Camera.from_opencv(SKEWED_K, a(np.diag([1.0, 1, -1])), np.zeros(3), SIZE),
        "R mirrors; expected a rotation",
    ),
    "R of PyTorch3D": (
        lambda a: Camera.from_pytorch3d(a(2 * np.eye(3)), np.zeros(3), focal_length=1.0, size=SIZE),
        "R is off by 3",
    ),
    "focal length": (
        lambda a: Camera.from_pytorch3d(np.eye(3), np.zeros(3), focal_length=a(-1.0), size=SIZE),
        "focal_length is .*positive",
    ),
    "principal point": (
        lambda a: Camera.look_at((0, 0, 4), (0, 0, 0), principal_point=a(np.zeros(3))),
        r"principal_point has shape \(3,\); expected \(2,\)",
    ),
    "singular pose": (lambda a: Camera.from_blender(a(np.diag([1.0, 1, 0, 1])), SIZE, focal=9.0), "is singular"),
    "singular product": (lambda a: Camera.from_mvp(a(np.diag([1.0, 0, 1, 1]))), "matrix is singular"),
    "upright": (lambda a: Camera.look_at(a(np.array([0.0, 4, 0])), (0, 0, 0), (0, 0, 0)), "has no upright"),
    "orthographic": (
        lambda a: Camera.orthographic(a(np.array([0.0, 1, 4])), (0, 0, 0), height=2.0, aspect=1.5).to_opencv(SIZE),
        "the camera is orthographic; to_opencv needs a perspective one",
    ),
    "orthographic for PyTorch3D": (
        lambda a: Camera.orthographic(a(np.array([0.0, 1, 4])), (0, 0, 0), height=2.0, aspect=1.5).to_pytorch3d(SIZE),
        "the camera is orthographic; to_pytorch3d",
    ),
}


@pytest.mark.parametrize("target", ["numpy", *DIFFERENTIABLE])
@pytest.mark.parametrize("name", NONSENSE)
def test_a_camera_of_nonsense_is_refused_of_numbers_and_of_arrays(name, target):
    make, message = NONSENSE[name]
    with refused(message):
        make(lambda value: arrays(target, np.array(value)))


def test_complex_matrices_are_refused():
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), aspect=1.5)
    with pytest.raises(InputError, match="the camera's view has dtype complex128; expected real numbers"):
        rts.render(square(), camera.replace(view=camera.view.astype(complex)), SIZE)
    with pytest.raises(InputError, match="eye has dtype complex128"):
        Camera.look_at(np.array([0, 0, 4j]), (0, 0, 0))


def test_a_window_is_for_images_of_its_own_ratio():
    part = rts.plugin("surfaces", "mesh").example()
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), aspect=1.5)
    whole = rts.render(part, camera, SIZE)
    window = camera.window(SIZE, (10, 20), (20, 12))
    assert window.aspect == pytest.approx(12 / 20)
    # Warnings are errors: none is given of another ratio.
    np.testing.assert_allclose(rts.render(part, window, (20, 12))[2:-2, 2:-2], whole[12:28, 22:30], atol=1e-5)
    assert Camera.look_at((0, 0, 4), (0, 0, 0)).window(SIZE, (0, 0), (20, 20)).aspect == pytest.approx(1)
