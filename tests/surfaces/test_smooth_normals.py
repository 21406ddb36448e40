"""Smooth normals of a mesh at samples: an operation, whose loops compute what samples name and no more."""

import numpy as np
import pytest
from helpers import ALL, CAMERA, DIFFERENTIABLE, SIZE, arrays, gradient, icosphere, mesh_part, to_numpy

import rts
from rts import InputError
from rts.compiling.threads import read_only
from rts.errors import InputWarning
from rts.testing import OperationConformance
from rts_surfaces.smooth_normals import SMOOTH_NORMALS, smooth_normals, vertex_normals, warn_of_windings

pytestmark = pytest.mark.sampling

RNG = np.random.default_rng(0)
BALL, FACES = icosphere(2)


def some_samples(count=40, faces=FACES):
    """Params and ids of samples on a few triangles, so that most vertices have none."""
    params = RNG.dirichlet((1, 1, 1), count)[:, :2]
    return params, faces[RNG.integers(0, len(faces) // 8, count)]


class TestSmoothNormals(OperationConformance):
    @pytest.fixture
    def operation(self):
        return SMOOTH_NORMALS

    @pytest.fixture
    def operands(self):
        return (BALL * RNG.uniform(0.8, 1.2, BALL.shape), *some_samples(), FACES)


DOUBLE = np.concatenate([FACES, FACES[: len(FACES) // 2, ::-1]]).astype(np.int32)
"""Faces that are double on a half of the ball, and single on the other one."""


class TestSmoothNormalsWithDoubleFaces(OperationConformance):
    @pytest.fixture
    def operation(self):
        return SMOOTH_NORMALS

    @pytest.fixture
    def operands(self):
        params = RNG.dirichlet((1, 1, 1), 60)[:, :2]
        return BALL * RNG.uniform(0.8, 1.2, BALL.shape), params, DOUBLE[RNG.integers(0, len(DOUBLE), 60)], DOUBLE


@pytest.mark.parametrize("target", ALL)
def test_where_both_sides_of_faces_cancel_normals_are_those_of_the_triangle_and_side_that_samples_are_on(target):
    faces = np.concatenate([FACES, FACES[:, ::-1]]).astype(np.int32)
    params = RNG.dirichlet((1, 1, 1), 80)[:, :2]
    ids = faces[RNG.integers(0, len(faces), 80)]
    a, b, c = np.moveaxis(BALL[ids].astype(np.float64), 1, 0)
    own = np.cross(b - a, c - a)
    for size in (1e-15, 1.0, 1e15):
        found = to_numpy(smooth_normals(*arrays(target, [(size * BALL).astype(np.float32), params, ids]), faces))
        np.testing.assert_allclose(found, own / np.linalg.norm(own, axis=1, keepdims=True), atol=1e-5)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_a_double_sheet_that_turns_takes_its_normals_along(target):
    # As below, but with both sides: those of the other side turn the other way.
    vertices, faces = np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0)]), np.array([(0, 1, 2), (0, 2, 1)], np.int32)
    ids = faces[[0, 1, 1, 1]]
    given = arrays(target, [vertices, vertices[:, [1, 2, 0]], np.full((4, 2), 0.3), ids])

    def along_x(slope):
        flat, way, *samples = given
        return smooth_normals(flat + slope * way, *samples, faces)[:, 0].sum()

    np.testing.assert_allclose(gradient(target, along_x, arrays(target, np.array(0.0))), 2, rtol=1e-6)


def test_the_picture_of_a_ball_of_double_faces_is_that_of_its_flat_faces():
    faces = np.concatenate([FACES, FACES[:, ::-1]]).astype(np.int32)
    flat = BALL[FACES.ravel()], np.arange(FACES.size, dtype=np.int32).reshape(-1, 3)
    # Of two sides at one depth either may be seen; it is lit alike.
    double, split = (
        rts.render(mesh_part(mesh, shader="lambert"), CAMERA, SIZE, splatter="none") for mesh in ((BALL, faces), flat)
    )
    assert (split[..., 3] > 0.5).sum() > 20
    np.testing.assert_allclose(double, split, atol=1e-5)


@pytest.mark.parametrize("target", ALL)
def test_on_a_ball_they_are_the_radii_however_small_or_large_it_is(target):
    params, ids = some_samples()
    weights = np.column_stack([params, 1 - params.sum(1)])[:, :, None]
    for size in (1e-15, 1.0, 1e15):
        given = arrays(target, [(size * BALL).astype(np.float32), params, ids])
        np.testing.assert_allclose(to_numpy(smooth_normals(*given, FACES)), (weights * BALL[ids]).sum(1), atol=0.02)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_a_sheet_that_turns_takes_its_normals_along(target):
    # z = a x has the normal (−a, 0, 1) / √(1 + a²), whose derivative at a = 0 is (−1, 0, 0).
    x, y = (t.reshape(-1) for t in np.meshgrid(np.arange(4.0), np.arange(4.0)))
    first = np.array([i + 4 * j for j in range(3) for i in range(3)])
    faces = np.concatenate([np.stack([first, first + 1, first + 4], 1), np.stack([first + 1, first + 5, first + 4], 1)])
    params, ids = some_samples(9, faces.astype(np.int32))
    given = arrays(target, [np.stack([x, y, 0 * x], 1), np.stack([0 * x, 0 * x, x], 1), params, ids])

    def along_x(slope):
        vertices, way, *samples = given
        return smooth_normals(vertices + slope * way, *samples, faces.astype(np.int32))[:, 0].sum()

    np.testing.assert_allclose(gradient(target, along_x, arrays(target, np.array(0.0))), -9, rtol=1e-6)


def test_vertices_without_area_have_none_and_its_derivative_is_that_of_the_sum():
    # The sum around each corner is (b − a) × (c − a), which grows by 3 z for a motion of c along y.
    vertices, params, ids = np.array([(0.0, 0, 0), (3, 0, 0), (5, 0, 0)]), np.array([(0.2, 0.3)]), [(0, 1, 2)]
    operands = [read_only(x) for x in (vertices, params, np.array(ids, np.int32), np.array(ids, np.int32))]
    found, kept = SMOOTH_NORMALS.value_on_host(operands, {})
    np.testing.assert_array_equal(found, 0)
    pulled = np.zeros_like(vertices)
    SMOOTH_NORMALS.pull_on_host(operands, np.array([(0.0, 0, 1)]), (pulled, None), kept, {})
    np.testing.assert_allclose(pulled[2], (0, 3, 0), atol=1e-12)


@pytest.mark.parametrize("size", [1e-85, 1e80])
def test_float64_of_any_size_has_normals(size):
    vertices = size * np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0)])
    ids = np.array([(0, 1, 2)], np.int32)
    np.testing.assert_allclose(smooth_normals(vertices, np.array([(0.2, 0.3)]), ids, ids), [(0, 0, 1)], atol=1e-12)


def test_operands_of_wrong_shapes_are_refused():
    params, ids = some_samples()
    for wrong in (
        (BALL, params[:, :1], ids),
        (BALL, params[:9], ids),
        (BALL, params, ids[:, :2]),
        (BALL[:, :2], params, ids),
    ):
        operands = [read_only(x, np.float64 if x.dtype.kind == "f" else None) for x in (*wrong, FACES)]
        with pytest.raises(InputError, match="expected \\(V, 3\\), \\(N, 2\\)"):
            SMOOTH_NORMALS.value_on_host(operands, {})


def test_vertices_that_no_sample_names_have_no_row():
    params, ids = some_samples()
    kept = SMOOTH_NORMALS.value_on_host([read_only(x) for x in (BALL, params.astype(BALL.dtype), ids, FACES)], {})[1]
    named = np.unique(ids)
    np.testing.assert_array_equal(np.flatnonzero(kept.row_of), named)
    assert kept.unit.shape == (len(named), 3) and len(named) < len(BALL) / 2
    np.testing.assert_allclose(kept.unit[kept.row_of[named] - 1], vertex_normals(BALL, FACES)[0][named], atol=1e-5)


@pytest.mark.parametrize("target", ALL)
def test_what_names_no_vertex_is_refused(target):
    params, ids = some_samples()
    for vertices, named, faces in ((BALL, ids - 9, FACES), (BALL, ids + len(BALL), FACES), (BALL, ids, FACES + 500)):
        given = arrays(target, [vertices, params.astype(vertices.dtype), named])
        with pytest.raises(InputError, match=f"not among {len(BALL)}; sample the mesh anew"):
            to_numpy(smooth_normals(*given, faces))


@pytest.mark.parametrize("target", ALL)
def test_faces_wound_against_their_neighbours_are_warned_of_once_where_normals_are_read(target):
    away = RNG.random(len(FACES)) < 0.5
    faces = np.where(away[:, None], FACES[:, ::-1], FACES)
    given = arrays(target, BALL)
    part = mesh_part((given, faces), shader="lambert")
    rts.render(part.replace(shader="silhouette"), CAMERA, SIZE)
    rts.render(part.replace(theta={**part.theta, "normals": given}), CAMERA, SIZE)
    with pytest.warns(InputWarning, match=r"across (4|5)\d% of the edges of a mesh .* wound against one another"):
        rts.render(part, CAMERA, SIZE)
    rts.render(part, CAMERA, SIZE)


def test_double_faces_strips_with_one_side_and_single_faces_turned_over_are_not_warned_of():
    around = np.arange(15)  # An odd number of triangles makes a strip with one side.
    strip = np.stack([around, (around + 1) % 15, (around + 2) % 15], 1)
    strip[1::2] = strip[1::2, ::-1]
    single = np.concatenate([FACES[:1, ::-1], FACES[1:]])
    twice = np.array([[0, 1, 2], [1, 2, 0], [2, 1, 3]])
    for faces in (FACES, FACES[:, ::-1], DOUBLE, single, strip, twice, FACES[:0]):
        warn_of_windings(faces)
