"""Operations: the library's and a stranger's, in every engine, against closed forms and the specification."""

from dataclasses import fields, replace

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, arrays, derivative, gradient, refused, to_numpy

import rts
from rts.operations import linear, projection
from rts.operations.combine import COMBINE, combine, interpolate
from rts.operations.linear import affine_map, matmul
from rts.operations.projection import projective_map, projective_map_of_views
from rts.operations.take import TAKE, take
from rts.operations.texels import TEXELS, texels
from rts.operations.unit import UNIT, unit
from rts.plugin_api.operations import Operation
from rts.scene.rigid import RIGID
from rts.testing import OperationConformance

pytestmark = pytest.mark.engines

RNG = np.random.default_rng(0)


# --------------------------------------------------------------------------------------- the library's, by closed form


def test_combine_is_a_sum_of_rows_with_weights():
    rows, weights = RNG.normal(size=(7, 4)), RNG.normal(size=(50, 16))
    ids = RNG.integers(0, 7, (50, 16)).astype(np.int32)
    np.testing.assert_allclose(combine(rows, ids, weights), (weights[..., None] * rows[ids]).sum(1), atol=1e-12)


def test_interpolation_is_combine_with_the_weight_that_the_others_lack_of_one():
    rows, weights = RNG.normal(size=(7, 3)), RNG.random((40, 2))
    ids = RNG.integers(0, 7, (40, 6)).astype(np.int32)
    whole = np.concatenate([weights, 1 - weights.sum(1, keepdims=True)], 1)
    found = interpolate(rows, ids, 3, weights)
    np.testing.assert_allclose(found, combine(rows, ids[:, 3:], whole), rtol=1e-12, atol=1e-12)
    # The loops for any number of rows agree with those for triangles.
    from rts.operations import combine_loops

    general, special = np.empty_like(found), np.empty_like(found)
    combine_loops.parallel(
        combine_loops._sum, 40, *combine_loops_read(rows, ids), 3, 3, True, *combine_loops_read(weights), general
    )
    combine_loops.forward(*combine_loops_read(rows, weights, ids), special, 3, 3, True)
    np.testing.assert_allclose(general, special, rtol=1e-12)


def combine_loops_read(*given):
    from rts.compiling.threads import read_only

    return [read_only(x) for x in given]


def test_combine_refuses_what_does_not_fit_in_one_line():
    rows, ids, weights = np.ones((4, 3)), np.zeros((5, 2), np.int32), np.ones((5, 2))
    with refused(r"shapes \(4, 3\), \(5, 2\), \(5, 1\); expected \(V, C\), \(N, I\), \(N, I\)"):
        combine(rows, ids, weights[:, :1])


@pytest.mark.parametrize("target", ALL)
def test_products_are_those_of_linear_algebra(target):
    a, b = RNG.normal(size=(2, 4, 4))
    np.testing.assert_allclose(to_numpy(matmul(*arrays(target, (a, b)))), a @ b, atol=1e-5)


def test_affine_maps_are_those_of_linear_algebra():
    rows, points = RNG.normal(size=(5, 4)), RNG.normal(size=(30, 3))
    np.testing.assert_allclose(affine_map(rows, points), points @ rows[:, :3].T + rows[:, 3], atol=1e-12)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_points_without_an_image_are_finite_with_finite_derivatives(target):
    rows, points = np.random.default_rng(0).normal(size=(4, 4)), np.random.default_rng(1).normal(size=(7, 3))
    rows[2, 3] = points[0] = 0
    at = list(arrays(target, (rows, points)))
    expected = to_numpy(projection.PROJECTION.specification(*at))
    np.testing.assert_allclose(to_numpy(projective_map(*at)), expected, rtol=1e-4)
    for jit in (False, True):
        value, along = derivative(target, lambda x: projective_map(*x), at, at, jit)
        pulled = gradient(target, lambda x: projective_map(*x).sum(), at, jit)
        assert all(np.isfinite(x).all() for x in (value, along, *pulled))


def test_arrays_of_numpy_beside_those_of_another_engine_are_constants():
    torch = pytest.importorskip("torch")
    points = torch.rand(5, 3, requires_grad=True)
    rows = RNG.normal(size=(4, 4))
    rows[2, 3] += 6
    out = projective_map(rows, points)
    assert isinstance(out, torch.Tensor) and out.dtype == torch.float32
    out.sum().backward()
    assert points.grad.abs().sum() > 0
    assert isinstance(affine_map(torch.rand(4, 4), points.detach().numpy()), torch.Tensor)


# ----------------------------------------------------------------------------------------------------- a stranger's


def specification(x, scale, *, power):
    xp = rts.namespace(x, scale)
    return scale * xp.tanh(x / scale) ** power


CALLS = []


def forward(operands, out, *, power):
    x, scale = operands
    CALLS.append(("forward", len(x)))
    kept = np.tanh(x / scale)
    out[...] = scale * kept**power
    return kept


def slopes(operands, power, kept):
    x, scale = operands
    t = np.tanh(x / scale) if kept is None else kept
    by_x = power * t ** (power - 1) * (1 - t * t)
    return by_x, t**power - by_x * x / scale


def push(operands, tangents, out, *, power, kept):
    CALLS.append(("push", kept is not None))
    by_x, by_scale = slopes(operands, power, kept)
    dx, dscale = tangents
    out[...] = 0 if dx is None else by_x * dx
    if dscale is not None:
        out += by_scale * dscale


def pull(operands, g, results, *, power, kept):
    CALLS.append(("pull", kept is not None))
    by_x, by_scale = slopes(operands, power, kept)
    if results[0] is not None:
        results[0][...] = by_x * g
    if results[1] is not None:
        results[1][...] = (by_scale * g).sum(axis=0)


CLAMP = Operation(
    "tests.clamp",
    specification,
    ranks=(2, 1),
    shape=lambda x, scale, power: x,
    forward=forward,
    push=push,
    pull=pull,
    differentiable=2,
    packed=(0,),
    packed_result=True,
    keeps=True,
)


def operands():
    return [RNG.normal(size=(6, 3)), RNG.uniform(0.8, 1.5, 3)]


@pytest.fixture
def calls():
    CALLS.clear()
    return CALLS


@pytest.mark.parametrize("target", ALL)
def test_a_stranger_s_operation_runs_its_own_code_in_every_engine(target, calls):
    given = operands()
    found = to_numpy(CLAMP(*arrays(target, given), power=3))
    np.testing.assert_allclose(found, given[1] * np.tanh(given[0] / given[1]) ** 3, rtol=0, atol=1e-5)
    assert calls == [("forward", 6)]


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_its_derivatives_are_its_own_in_both_modes_and_see_what_was_kept(target, calls):
    at, along = list(arrays(target, operands())), list(arrays(target, operands()))
    gradient(target, lambda x: (CLAMP(*x, power=2) ** 2).sum(), at)
    assert ("pull", True) in calls
    derivative(target, lambda x: CLAMP(*x, power=2), at, along)
    assert ("push", True) in calls  # Their numbers are compared by the kit, below.


def test_loops_get_arrays_one_by_one_that_are_contiguous_and_read_only():
    seen, asked = [], []

    def noting(results):
        return lambda *arrays: seen.append((arrays[:-results], arrays[-results:]))

    def loops():
        asked.append(True)
        return noting(1), noting(1), noting(2)

    def check(x, scale):
        if len(scale) != 3:
            raise rts.InputError("scale is not of 3")

    operation = Operation.of_loops(
        "tests.loops", CLAMP.specification, (2, 1), CLAMP.shape, loops, check, differentiable=2
    )
    assert not asked and operation.differentiable == 2
    x, scale = operands()
    operation.push_on_host((x, scale), [x.T.copy().T[None], None], np.empty((1, 6, 3)), None, {})
    (_, _, moved, none), (out,) = seen.pop()
    assert moved.flags.c_contiguous and not moved.flags.writeable and none is None and out.flags.writeable
    operation.pull_on_host((x, scale), x.T.copy().T, [None, out[0]], None, {})
    (_, _, g), results = seen.pop()
    assert g.flags.c_contiguous and not g.flags.writeable and results[0] is None and results[1].flags.writeable
    operation.pull_on_host((x, scale), x, [None, None], None, {})
    assert not seen
    with pytest.raises(rts.InputError, match="scale is not of 3"):
        operation.forward((x, scale[:2]), out)


def test_other_dtypes_are_left_to_its_specification(calls):
    torch = pytest.importorskip("torch")
    x, scale = (torch.tensor(v, dtype=torch.bfloat16) for v in operands())
    assert CLAMP(x, scale, power=2).dtype == torch.bfloat16
    assert CLAMP(x.float().to("meta"), scale.float().to("meta"), power=2).device.type == "meta"
    assert not calls


def test_floats_of_two_widths_are_widened_by_numpy_and_need_no_specification(calls):
    x, scale = operands()
    found = CLAMP(x.astype(np.float32), scale.astype(np.float64), power=2)
    assert found.dtype == np.float64 and len(calls) == 1
    np.testing.assert_allclose(found, CLAMP(x, scale, power=2), rtol=1e-6)


def test_operations_of_one_name_do_not_take_each_other_s_place():
    jax = pytest.importorskip("jax")

    def doubled(operands, out, *, power):
        forward(operands, out, power=power)
        out *= 2

    x, scale = arrays("jax", operands())
    other = replace(CLAMP, forward=doubled, keeps=False)
    one, two = (jax.jit(lambda x, s, f=f: f(x, s, power=2))(x, scale) for f in (CLAMP, other))
    np.testing.assert_allclose(two, 2 * one, rtol=1e-6)


# ----------------------------------------------------------------------------------------------------- unit vectors


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_unit_vectors_of_any_length_and_the_derivative_of_zero(dtype):
    direction = np.array([0.6, 0, 0.8])
    sizes = {np.float32: (1e-40, 1e-30, 1.0, 1e30), np.float64: (1e-300, 1e-150, 1.0, 1e150, 1e300)}[dtype]
    vectors = np.array([size * direction for size in sizes]).astype(dtype)
    rtol = 1e-4 if dtype is np.float32 else 1e-12  # Of the least float32 numbers few digits are left.
    np.testing.assert_allclose(unit(vectors), np.tile(direction, (len(sizes), 1)), rtol=rtol)
    zero, g, found = np.zeros((1, 3), dtype), np.array([(1.0, 2.0, 3.0)], dtype), np.full((1, 3), np.nan, dtype)
    np.testing.assert_array_equal(unit(zero), zero)
    UNIT.pull_on_host([zero], g, [found], None, {})
    np.testing.assert_array_equal(found, g)
    assert np.isnan(unit(np.array([(np.nan, 1, 1)], dtype))).all()


# ----------------------------------------------------------------------------------------------------------- texels


def test_lookups_that_are_nowhere_name_no_texel():
    """NaN and infinite coordinates give NaN, by loops and by array code."""
    table, nowhere = RNG.random((12, 3)).astype(np.float32), np.float32([[np.nan, 0.5], [0.5, np.inf], [1e30, 0.5]])
    for wrap in ("repeat", "mirror", "clamp"):
        found = texels(table, nowhere, [(3, 4)], wrap=(wrap, wrap))
        with np.errstate(invalid="ignore"):
            by_arrays = TEXELS.specification(
                table, nowhere, np.zeros(0, np.int32), table[:0], sizes=((3, 4),), wrap=(wrap, wrap), filter="linear"
            )
        assert np.isnan(found[:2]).all() and np.isfinite(found[2]).all()
        np.testing.assert_array_equal(np.isnan(found), np.isnan(by_arrays))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_far_lookups_are_those_of_array_code(dtype):
    table = RNG.random((12, 3)).astype(dtype)
    far = np.array([[s * 10.0**n, 0.4] for n in range(2, 12) for s in (-1, 1)], dtype)
    for wrap in ("repeat", "clamp"):  # By "clamp" the first or the last texel of a row, however far.
        found = texels(table, far, [(3, 4)], wrap=(wrap, wrap))
        by_arrays = TEXELS.specification(
            table, far, np.zeros(0, np.int32), table[:0], sizes=((3, 4),), wrap=(wrap, wrap), filter="linear"
        )
        np.testing.assert_allclose(found, by_arrays, atol=1e-6)


@pytest.mark.parametrize("target", ALL)
def test_whole_numbers_are_coordinates(target):
    table, whole = RNG.random((12, 3)).astype(np.float32), np.array([[0, 0], [1, 1]], np.int32)
    found, expected = (texels(*arrays(target, (table, uv)), [(3, 4)]) for uv in (whole, whole.astype(np.float32)))
    np.testing.assert_allclose(to_numpy(found), to_numpy(expected), atol=1e-6)


def test_images_that_are_not_there_are_refused():
    table, uv = np.zeros((12, 3), np.float32), np.zeros((2, 2), np.float32)
    with pytest.raises(rts.InputError, match="images from 0 to 1 were asked for, of 1"):
        texels(table, uv, [(3, 4)], np.int32([0, 1]))
    for wrong, sizes in ((np.zeros((2, 3), np.float32), (3, 4)), (uv, (30, 40))):
        with refused(r"for images of sizes .* expected \(M, C\), with a row for each texel"):
            texels(table, wrong, [sizes])


# ------------------------------------------------------------------------------------------- all of them, by the kit


def cases():
    """Each operation with operands and parameters; those of surfaces are in tests of these."""
    rng = np.random.default_rng(3)
    ids, index = rng.integers(0, 7, (20, 6)).astype(np.int32), rng.integers(0, 7, 20).astype(np.int32)
    rows, ahead = rng.normal(size=(7, 3)), rng.normal(size=(3, 4, 4)) * 0.3 + np.diag([0, 0, 0, 6])[[0, 1, 3, 2]]
    points, places = rng.normal(size=(20, 3)), np.array([[0.0, 0], [9, 9], [20, 10]])
    view = np.array([1] * 8 + [3] * 12, np.int32)
    table, uv = rng.random((3 * 4 + 5 * 2, 3)), 1.5 * rng.normal(size=(20, 2))
    image, sizes = rng.integers(0, 2, 20).astype(np.int32), {"sizes": ((3, 4), (5, 2))}
    over = rng.normal(size=(20, 4)) * np.exp(rng.uniform(-4, 2, (20, 1)))
    over[:4] = [(0.3, 0.2, 0.6, 0.4), (0, 0, 0, 0), (0.9, 0, 0.01, 0.02), (0.01, 0.02, 0, -4)]
    return {
        "combine": (COMBINE, [rows, rng.normal(size=(20, 6)), ids], {"column": 2, "count": 4, "affine": False}),
        "interpolate": (COMBINE, [rows, rng.random((20, 2)), ids], {"column": 1, "count": 3, "affine": True}),
        "take": (TAKE, [rows, index], {}),
        "rigid": (RIGID, [rng.normal(size=6), rng.normal(size=3)], {}),
        "affine": (linear.AFFINE, [rng.normal(size=(5, 4)), points], {}),
        "affine_of_views": (linear.VIEWS, [rng.normal(size=(3, 2, 4)), points, view], {}),
        "projection": (projection.PROJECTION, [ahead[0], points], {}),
        "projection_of_views": (projection.VIEWS, [ahead, points, view, places], {}),
        "unit": (UNIT, [points], {}),
        "texels": (TEXELS, [table, uv, image, over], {**sizes, "wrap": ("repeat", "mirror"), "filter": "linear"}),
        "texels of one": (
            TEXELS,
            [table, uv, image[:0], over[:0]],
            {**sizes, "wrap": ("clamp", "repeat"), "filter": "linear"},
        ),
        "nearest texels": (
            TEXELS,
            [table, uv, image, over],
            {**sizes, "wrap": ("mirror", "clamp"), "filter": "nearest"},
        ),
        "a stranger's": (CLAMP, operands(), {"power": 2}),
    }


CASES = cases()


class TestEachOperation(OperationConformance):
    @pytest.fixture(params=CASES)
    def case(self, request):
        return CASES[request.param]

    @pytest.fixture
    def operation(self, case):
        return case[0]

    @pytest.fixture
    def operands(self, case):
        return case[1]

    @pytest.fixture
    def params(self, case):
        return case[2]


# ------------------------------------------------------------------------------------- gradients of functions of points


@pytest.mark.parametrize("target", ALL)
def test_the_gradient_of_a_function_of_points_is_that_of_its_closed_form(target):
    points = RNG.normal(size=(9, 3)).astype(np.float32)
    xp_points = arrays(target, points)
    f = lambda p: p[:, 0] ** 2 * p[:, 1] + 3 * p[:, 2]  # noqa: E731
    expected = np.stack([2 * points[:, 0] * points[:, 1], points[:, 0] ** 2, np.full(9, 3.0)], -1)
    np.testing.assert_allclose(to_numpy(rts.plugin_api.operations.gradient(f, xp_points)), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_it_is_differentiable_in_what_the_function_closes_over_and_in_the_points(target):
    points = RNG.normal(size=(9, 3)).astype(np.float32)
    given = {"k": np.array(2.0, np.float32), "p": points}

    def total(t):
        return (rts.plugin_api.operations.gradient(lambda p: t["k"] * (p**3).sum(-1), t["p"]) ** 2).sum()

    found = gradient(target, total, arrays(target, given))
    # The gradient is 3 k p², its square 9 k² p⁴.
    np.testing.assert_allclose(found["k"], 18 * 2.0 * (points**4).sum(), rtol=1e-4)
    np.testing.assert_allclose(found["p"], 36 * 4.0 * points**3, rtol=1e-3, atol=1e-3)


def test_a_function_that_gives_another_shape_is_refused():
    with pytest.raises(rts.InputError, match=r"f gave shape \(4, 3\) for 4 points; expected \(4,\)"):
        rts.plugin_api.operations.gradient(lambda p: p, np.ones((4, 3)))


# ------------------------------------------------------------------------------------------------- operands of any kind


@pytest.mark.parametrize("target", ALL)
def test_an_operand_may_be_a_number(target):
    scaled = Operation(
        "tests.scaled",
        lambda x, k: x * k,
        ranks=[2, 0],
        shape=lambda x, k: x,
        forward=lambda operands, out: np.multiply(*operands, out=out) is None,
        push=lambda operands, tangents, out: (
            out.__setitem__(..., 0 if tangents[0] is None else tangents[0] * operands[1])
            or (out.__iadd__(operands[0] * tangents[1]) if tangents[1] is not None else None)
        ),
        pull=lambda operands, g, results: [
            r.__setitem__(..., v)
            for r, v in zip(results, (g * operands[1], (g * operands[0]).sum()), strict=True)
            if r is not None
        ],
        differentiable=2,
    )
    x = RNG.normal(size=(4, 2))
    given = list(arrays(target, (x, np.array(3.0))))
    np.testing.assert_allclose(to_numpy(scaled(*given)), 3 * x, atol=1e-5)
    if target != "numpy":
        g_x, g_k = gradient(target, lambda v: scaled(*v).sum(), given)
        np.testing.assert_allclose(g_x, 3.0, rtol=1e-6)
        assert g_k == pytest.approx(x.sum(), rel=1e-4, abs=1e-5) and g_k.shape == ()


@pytest.mark.parametrize("target", ALL)
def test_operands_of_another_rank_are_refused(target):
    for call in (
        lambda: take(*arrays(target, (np.ones((2, 4, 3)), np.array([1, 0])))),
        lambda: projective_map(*arrays(target, (np.eye(4), np.ones(3)))),
    ):
        with pytest.raises(rts.InputError, match="the operation rts.* was given shapes .*; expected ranks"):
            call()
    with pytest.raises(rts.InputError, match="the operation tests.clamp takes 2 operands; it was given 1"):
        CLAMP(*arrays(target, (np.ones((2, 3)),)), power=2)


def test_what_is_no_operation_is_refused_when_it_is_made():
    for change, words in (
        ({"name": ""}, "an operation is named ''"),
        ({"differentiable": 3}, "has 2 operands, by its ranks, of which the first 3"),
        ({"packed": (2,)}, "has no operand 2 of packed rows"),
    ):
        with pytest.raises(rts.InputError, match=words):
            replace(CLAMP, **change)


@pytest.mark.parametrize("value", [None, 7, "abc", [None], np.ones(2), {1}, 0.5], ids=str)
@pytest.mark.parametrize("name", [field.name for field in fields(Operation) if field.init])
def test_a_wrong_field_is_one_line_that_names_it(name, value):
    if (name, repr(value)) in (("used", "None"), ("name", "'abc'"), ("second", "'abc'")):
        pytest.skip("it is a right one")
    with refused(f"{name}|first" if name != "name" else "named") as error:
        replace(CLAMP, **{name: value})
    assert len(str(error.value)) < 250


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize(
    "change, words",
    [
        ({"shape": lambda x, scale, power: (x[0],)}, "broadcast|shape"),
        ({"shape": lambda x, scale, power: [6, 3]}, r"gives \[6, 3\] .* expected a tuple of integers"),
        ({"shape": lambda x, power: x}, "shape of the operation tests.clamp cannot take operands of shapes"),
        ({"forward": lambda operands, out: None}, "forward of the operation tests.clamp cannot take operands"),
    ],
)
def test_functions_that_cannot_take_the_operands_are_refused(target, change, words):
    odd = replace(CLAMP, keeps=False, **change)
    with refused(words):
        to_numpy(odd(*arrays(target, operands()), power=3))


@pytest.mark.parametrize("target", ALL)
def test_operands_that_do_not_fit_each_other_are_refused(target):
    x, scale = operands()
    with pytest.raises(rts.InputError, match=r"tests.clamp cannot take operands of shapes \(6, 3\), \(2,\)"):
        to_numpy(CLAMP(*arrays(target, (x, scale[:2])), power=3))


def test_a_camera_of_numpy_and_of_another_engine_projects():
    torch = pytest.importorskip("torch")
    camera = rts.Camera.look_at((0, 0, 3), (0, 0, 0))
    points = RNG.normal(size=(5, 3))
    expected = camera.project(points, (8, 9))
    for mixed in (
        camera.replace(projection=torch.tensor(camera.projection)),
        camera.replace(view=torch.tensor(camera.view)),
    ):
        for given in (points, torch.tensor(points)):
            np.testing.assert_allclose(to_numpy(mixed.project(given, (8, 9))), expected, rtol=1e-10)


def test_the_gradient_of_numpy_suits_scenes_of_any_size():
    for size in (1e-5, 1.0, 1e5):
        points = size * np.array([[0.6, 0.8, 0.0]])
        found = rts.plugin_api.operations.gradient(lambda p: np.sqrt((p * p).sum(-1)), points)
        np.testing.assert_allclose(found, [[0.6, 0.8, 0.0]], atol=1e-6)


@pytest.mark.parametrize("target", ALL)
def test_points_of_views_are_projected_by_the_rows_of_each_and_put_in_place(target):
    generator = np.random.default_rng(5)
    rows, points = generator.normal(size=(3, 4, 4)), generator.normal(size=(7, 3))
    rows[:, 2, 3] += 4
    view = np.array([1, 1, 1, 3, 3, 0, 0], np.int32)  # Nothing is seen in the second, and two rows are not used.
    places = np.array([[0, 0], [9, 9], [20, 10]])
    found = to_numpy(projective_map_of_views(*arrays(target, (rows, points)), *arrays(target, (view, places))))
    for n, b in enumerate(view[:5] - 1):
        (expected,) = to_numpy(projective_map(rows[b], points[n : n + 1]))
        expected = expected + [*places[b], 0]
        np.testing.assert_allclose(found[n], expected, rtol=1e-4, atol=1e-4)
