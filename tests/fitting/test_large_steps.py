"""`LargeSteps`: closed forms, derivatives, engines, and what is refused."""

import copy
import math
import pickle

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, arrays, derivative, finite_difference, gradient, icosphere, to_numpy

import rts
from rts.fitting.large_steps import SOLVE
from rts.testing import OperationConformance

pytestmark = pytest.mark.fitting

RNG = np.random.default_rng(0)
VERTICES, FACES = icosphere(1)
VERTICES = VERTICES * np.array([1.0, 1.3, 0.8]) + 0.1 * RNG.normal(size=VERTICES.shape)
STEPS = rts.LargeSteps(VERTICES, FACES)
MILD = rts.LargeSteps(VERTICES, FACES, 0.05)  # For second derivatives, whose array code is quick.
TETRAHEDRON = [(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)]
TRIANGLE = [(0, 1, 2)]


# ------------------------------------------------------------------------------------------------ closed forms


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("faces, count", [(TRIANGLE, 3), (TETRAHEDRON, 4)])
@pytest.mark.parametrize("smoothness", [1e-9, 0.5, 19.0, 1e5])
def test_where_all_are_neighbours_the_distance_from_the_mean_shrinks(target, faces, count, smoothness):
    # L is count · (I − the mean), whose eigenvalues are 0 and count.
    steps, u = rts.LargeSteps(np.zeros((count, 3)), faces, smoothness), RNG.normal(size=(count, 3))
    mean = u.mean(axis=0)
    found = to_numpy(steps.decode(arrays(target, u)))
    np.testing.assert_allclose(found, mean + (u - mean) / (1 + count * smoothness), atol=1e-6)
    back = to_numpy(steps.encode(arrays(target, u)))
    np.testing.assert_allclose(back, mean + (u - mean) * (1 + count * smoothness), rtol=1e-5, atol=1e-5 * smoothness)


def test_a_wave_along_a_closed_band_shrinks_by_its_eigenvalue():
    # A torus of n × n vertices, six neighbours each: waves of one coordinate are eigenvectors of L.
    n, smoothness = 12, 3.0
    i, j = np.divmod(np.arange(n * n), n)
    a, b, c, d = i * n + j, (i + 1) % n * n + j, (i + 1) % n * n + (j + 1) % n, i * n + (j + 1) % n
    faces = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)])
    for k in (1, 2, n // 2):
        wave = np.cos(2 * np.pi * k * i / n)[:, None] * [1.0, -2.0, 0.5]
        eigenvalue = 4 * (1 - math.cos(2 * math.pi * k / n))  # Four of the six neighbours lie across.
        found = rts.LargeSteps(np.zeros((n * n, 3)), faces, smoothness).decode(wave)
        np.testing.assert_allclose(found, wave / (1 + smoothness * eigenvalue), atol=1e-13)


@pytest.mark.parametrize("target", ALL)
def test_vertices_in_one_place_and_vertices_of_no_face_stay(target):
    one = arrays(target, np.full(VERTICES.shape, 7.3))
    np.testing.assert_array_equal(to_numpy(STEPS.encode(one)), to_numpy(one))
    np.testing.assert_allclose(to_numpy(STEPS.decode(one)), to_numpy(one), rtol=2e-7)
    steps = rts.LargeSteps(np.zeros((len(VERTICES) + 3, 3)), FACES + 2)
    u = arrays(target, np.concatenate([RNG.normal(size=(2, 3)), VERTICES, [(4.0, 5.0, 6.0)]]))
    for f in (steps.encode, steps.decode):
        np.testing.assert_array_equal(to_numpy(f(u))[[0, 1, -1]], to_numpy(u)[[0, 1, -1]])
    np.testing.assert_allclose(to_numpy(steps.decode(u))[2:-1], STEPS.decode(to_numpy(u)[2:-1]), rtol=1e-5)


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("smoothness", [0.1, 19.0, 300.0])
def test_decoding_undoes_encoding(target, smoothness):
    steps = rts.LargeSteps(VERTICES, FACES, smoothness)
    for dtype, tolerance in ((np.float32, 1e-5), (np.float64, 1e-12))[: 1 if target == "jax" else 2]:
        vertices = arrays(target, VERTICES, dtype)
        found = steps.decode(steps.encode(vertices))
        assert found.dtype == vertices.dtype
        assert getattr(found, "device", None) == getattr(vertices, "device", None)
        np.testing.assert_allclose(to_numpy(found), VERTICES, atol=tolerance * max(1, smoothness / 19))


def test_an_edge_of_several_faces_counts_once():
    fan = [(0, 1, 2), (0, 1, 3), (1, 0, 4), (0, 1, 1)]
    u = np.arange(15.0).reshape(5, 3)
    expected = 1.0 * u[0] + 2.0 * sum(u[0] - u[j] for j in (1, 2, 3, 4))
    np.testing.assert_allclose(rts.LargeSteps(np.zeros((5, 3)), fan, 2.0).encode(u)[0], expected)


def test_array_code_solves_as_the_factorisation_does():
    torch = pytest.importorskip("torch")
    rim = np.arange(60)
    fan = np.stack([0 * rim, 1 + rim, 1 + (rim + 1) % 60], axis=-1)  # A vertex with 60 neighbours.
    for faces, smoothness in ((FACES, 19.0), (FACES, 1e-12), (fan, 50.0)):
        steps = rts.LargeSteps(np.zeros((61, 3)), faces, smoothness)
        u = RNG.normal(size=(61, 3))
        for dtype in (np.float64, np.float32):
            x, tolerance = torch.tensor(u.astype(dtype)), np.finfo(dtype).eps * (1 + steps._spread)
            found = SOLVE.specification(x, steps=steps)
            assert found.dtype == x.dtype
            np.testing.assert_allclose(found, steps.decode(u), atol=tolerance)


# ------------------------------------------------------------------------------------------------- derivatives


class TestSolve(OperationConformance):
    @pytest.fixture
    def operation(self):
        return SOLVE

    @pytest.fixture
    def operands(self):
        return [RNG.normal(size=(len(VERTICES), 3))]

    @pytest.fixture
    def params(self):
        return {"steps": MILD}


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("f", [STEPS.encode, STEPS.decode], ids=["encode", "decode"])
def test_both_modes_are_the_map_itself_and_its_transpose(target, f):
    factors, move = RNG.normal(size=VERTICES.shape), RNG.normal(size=VERTICES.shape)
    weights = arrays(target, factors)
    expected = finite_difference(lambda x: (f(x) * factors).sum(), VERTICES, step=1e-3)  # Linear: any step will do.
    pulled = gradient(target, lambda x: (f(x) * weights).sum(), arrays(target, VERTICES))
    value, pushed = derivative(target, f, arrays(target, VERTICES), arrays(target, move))
    scale = np.abs(expected).max()
    np.testing.assert_allclose(pulled, expected, atol=1e-6 * scale)
    np.testing.assert_allclose(value, f(VERTICES), atol=1e-6 * scale)
    np.testing.assert_allclose(pushed, f(move), atol=1e-6 * scale)
    np.testing.assert_allclose((pushed * factors).sum(), (pulled * move).sum(), rtol=1e-4)


@pytest.mark.parametrize("f", [MILD.encode, MILD.decode], ids=["encode", "decode"])
def test_torch_checks_first_and_second_derivatives(f):
    torch = pytest.importorskip("torch")
    x = torch.tensor(VERTICES, requires_grad=True)
    assert torch.autograd.gradcheck(f, [x], check_forward_ad=True, check_batched_grad=True, fast_mode=True)
    assert torch.autograd.gradgradcheck(lambda x: f(x) ** 3, [x], fast_mode=True)


@pytest.mark.parametrize("f", [STEPS.encode, STEPS.decode], ids=["encode", "decode"])
def test_in_batches_it_is_what_it_is_alone_with_torch(f):
    torch = pytest.importorskip("torch")
    batch = np.stack([VERTICES, VERTICES @ np.diag([1, 2, 3.0])])
    loss = lambda x: (f(x) ** 3).sum()  # noqa: E731
    slopes, values = torch.func.vmap(torch.func.grad_and_value(loss))(torch.tensor(batch))
    np.testing.assert_allclose(values, [loss(x) for x in batch], rtol=1e-12)
    np.testing.assert_allclose(slopes, [gradient("torch-cpu", loss, torch.tensor(x)) for x in batch], rtol=1e-11)


@pytest.mark.parametrize("f", [STEPS.encode, STEPS.decode], ids=["encode", "decode"])
def test_compiled_and_in_batches_it_is_what_it_is_alone_with_jax(f):
    jax, torch = pytest.importorskip("jax"), pytest.importorskip("torch")
    batch = np.stack([VERTICES, VERTICES @ np.diag([1, 2, 3.0])]).astype(np.float32)
    loss = lambda x: (f(x) ** 3).sum()  # noqa: E731
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(loss)))(jax.numpy.asarray(batch))
    np.testing.assert_allclose(values, [loss(x) for x in batch.astype(np.float64)], rtol=1e-4)
    expected = [gradient("torch-cpu", loss, torch.tensor(x, dtype=torch.float64)) for x in batch]
    np.testing.assert_allclose(slopes, expected, atol=1e-5 * np.abs(expected).max())


def test_a_step_for_one_vertex_moves_all_and_the_farther_ones_less():
    torch = pytest.importorskip("torch")
    u = torch.tensor(MILD.encode(VERTICES), requires_grad=True)
    MILD.decode(u)[0].sum().backward()
    moved = -(MILD.decode((u - u.grad).detach()).numpy() - VERTICES)
    beside = np.unique(FACES[(FACES == 0).any(axis=1)])[1:]
    rest = np.setdiff1d(np.arange(1, len(VERTICES)), beside)
    assert moved[0].min() > moved[beside].max() and moved[beside].min() > moved[rest].max() and moved.min() > 0


@pytest.mark.thorough
def test_fit_takes_the_parameters():
    torch = pytest.importorskip("torch")
    truth = torch.tensor(VERTICES * [1.2, 0.9, 1.0])
    start = torch.tensor(STEPS.encode(VERTICES))
    found = rts.fit(lambda u: STEPS.decode(u) - truth, start, method="lm", progress=False)
    np.testing.assert_allclose(STEPS.decode(found.parameters), truth, atol=1e-6)


def test_copies_are_the_same_parametrisation():
    for other in (copy.deepcopy(STEPS), pickle.loads(pickle.dumps(STEPS))):
        np.testing.assert_array_equal(other.decode(VERTICES), STEPS.decode(VERTICES))
    assert repr(STEPS) == f"LargeSteps({len(VERTICES)} vertices, smoothness 19)"


# ----------------------------------------------------------------------------------------------------- misuse


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"faces": [(0, 1, 2, 3)]}, r"faces has shape \(1, 4\); expected \(T, 3\)"),
        ({"faces": [(0.0, 1.0, 2.0)]}, "faces has dtype float64; expected integers"),
        ({"faces": [(0, 1, -1)]}, "faces holds the index -1"),
        ({"faces": [(1, 1, 1)]}, "faces have no edge"),
        ({"vertices": VERTICES[:41]}, "faces name vertex 41, but there are 41 vertices"),
        ({"vertices": VERTICES[:, :2]}, r"expected \(V, 3\) numbers"),
        ({"smoothness": 0}, "smoothness is 0; expected a positive number"),
        ({"smoothness": -1.0}, "smoothness is -1.0; expected a positive number"),
        ({"smoothness": math.nan}, r"smoothness is array\(nan\); expected finite numbers"),
        ({"smoothness": 1e6}, "smoothness is 1000000.0; expected a known number of at most 100000"),
        ({"smoothness": "19"}, "smoothness is '19'; expected a number"),
    ],
)
def test_what_is_no_mesh_or_no_smoothness_is_refused(changes, message):
    with pytest.raises(rts.InputError, match=rf"^(?!.*\n).*{message}"):
        rts.LargeSteps(**{"vertices": VERTICES, "faces": FACES, **changes})


@pytest.mark.parametrize("name, f", [("vertices", STEPS.encode), ("u", STEPS.decode)])
def test_rows_of_another_mesh_are_refused(name, f):
    for rows, message in (
        (VERTICES[:5], r"has shape \(5, 3\); expected \(42, 3\), a row for each vertex"),
        (VERTICES[:, :2], r"has shape \(42, 2\)"),
        (VERTICES[None], r"has shape \(1, 42, 3\)"),
        (VERTICES.astype(int), "has dtype int64; expected float32 or float64"),
        (None, "is a NoneType"),
        ("abc", "is 'abc'"),
    ):
        with pytest.raises(rts.InputError, match=rf"^(?!.*\n){name} {message}"):
            f(rows)


def test_a_smoothness_that_is_traced_is_refused():
    jax = pytest.importorskip("jax")
    with pytest.raises(rts.InputError, match="smoothness is traced; expected a known number"):
        jax.jit(lambda x: rts.LargeSteps(VERTICES, FACES, x).decode(VERTICES))(19.0)


def test_the_order_of_old_works_with_a_warning():
    for arguments, named in [((FACES, 42), {}), ((FACES,), {"count": 42}), ((), {"faces": FACES, "count": 42})]:
        with pytest.warns(DeprecationWarning, match=r"take LargeSteps\(vertices, faces\)"):
            old = rts.LargeSteps(*arguments, **named)
        np.testing.assert_array_equal(old.decode(VERTICES), STEPS.decode(VERTICES))
    for count in (42.0, True, 0):
        with pytest.warns(DeprecationWarning), pytest.raises(rts.InputError, match="count is .*positive integer"):
            rts.LargeSteps(FACES, count=count)
