"""Energies of meshes: closed forms, derivatives, degenerate meshes, and what is refused."""

import copy
import functools
import importlib.util
import math

import numpy as np
import pytest
from helpers import (
    ALL,
    DIFFERENTIABLE,
    TORCH,
    arrays,
    derivative,
    finite_difference,
    gradient,
    icosphere,
    precision,
    rotation,
    to_numpy,
)

import rts
from rts.regularizers import ARAP, EdgeLength, Laplacian, NormalConsistency
from rts.regularizers.connectivity import LARGEST_COTANGENT

pytestmark = pytest.mark.fitting

VERTICES, FACES = icosphere(1)
VERTICES = VERTICES * np.array([1.0, 1.3, 0.8])  # Float64, and no two edges of one kind.
BENT = VERTICES + 0.08 * np.random.default_rng(0).normal(size=VERTICES.shape)

ENERGIES = {
    "arap": ARAP(VERTICES, FACES),
    "laplacian": Laplacian(VERTICES, FACES),
    "laplacian, cotangent": Laplacian(VERTICES, FACES, "cotangent"),
    "laplacian, relative": Laplacian(VERTICES, FACES, "cotangent", relative=True),
    "lengths": EdgeLength(VERTICES, FACES),
    "mean length": EdgeLength(VERTICES, FACES, "mean"),
    "normals": NormalConsistency(FACES),
}
every_energy = pytest.mark.parametrize("energy", ENERGIES.values(), ids=ENERGIES)


@pytest.fixture(autouse=True, scope="module")
def jax_in_double_precision():
    with precision("jax" if importlib.util.find_spec("jax") else "numpy"):
        yield


def grid(rows=5, columns=6, seed=None):
    """Vertices and faces of a flat sheet in z = 0, uneven for a seed; and which vertices are inside."""
    x, y = np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float))
    inside = ((0 < x) & (x < columns - 1) & (0 < y) & (y < rows - 1)).reshape(-1)
    vertices = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    if seed is not None:
        vertices[:, :2] += np.random.default_rng(seed).uniform(-0.35, 0.35, (len(vertices), 2))
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    faces = np.concatenate([np.stack([a, a + 1, a + columns + 1], 1), np.stack([a, a + columns + 1, a + columns], 1)])
    return vertices, faces, inside


@functools.cache
def compiled(energy):
    jax = pytest.importorskip("jax")
    return jax.jit(jax.value_and_grad(energy))


def value_and_gradient(target, energy, x):
    """Both on the host, compiled where that can be: eager jax compiles each step anew for each shape."""
    if target == "jax":
        return to_numpy(compiled(energy)(x))
    return to_numpy(energy(x)), gradient(target, energy, x)


def lengths(vertices, edges):
    return np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)


# ------------------------------------------------------------------------------------------------ closed forms


@pytest.mark.parametrize("weights", ["cotangent", "uniform"])
@pytest.mark.parametrize("degrees", [0, 20, 120, 180])
def test_rigid_motions_cost_no_rigidity_and_have_no_gradient(weights, degrees):
    energy = ARAP(VERTICES, FACES, weights)
    moved = VERTICES @ rotation((1, 2, 3), degrees).T + [3, -1, 2]
    assert energy(moved) < 1e-25
    for target in DIFFERENTIABLE:
        assert np.abs(gradient(target, energy, arrays(target, moved, np.float64))).max() < 1e-12


@pytest.mark.parametrize("weights", ["cotangent", "uniform"])
@pytest.mark.parametrize("scale", [0.5, 1.7])
def test_a_scaled_mesh_costs_what_its_edges_have_gained_from_both_ends(weights, scale):
    energy = ARAP(VERTICES, FACES, weights)
    per_edge = energy.weights * lengths(VERTICES, energy.edges) ** 2
    np.testing.assert_allclose(energy(scale * VERTICES), 2 * (scale - 1) ** 2 * per_edge.sum(), rtol=1e-12)


def test_the_least_sum_over_rotations_is_that_of_any_other_solver():
    energy = ARAP(VERTICES, FACES, "uniform")
    from scipy.spatial.transform import Rotation

    total = 0.0
    for i in range(len(VERTICES)):
        j = np.concatenate([energy.edges[energy.edges[:, 0] == i, 1], energy.edges[energy.edges[:, 1] == i, 0]])
        total += Rotation.align_vectors(BENT[i] - BENT[j], VERTICES[i] - VERTICES[j])[1] ** 2
    np.testing.assert_allclose(energy(BENT), total, rtol=1e-10)


def test_a_mirrored_mesh_is_not_taken_for_a_turned_one():
    energy = ARAP(VERTICES, FACES)
    assert energy(VERTICES * [1, 1, -1]) > 0.1
    flat, faces, _ = grid()
    assert ARAP(flat, faces)(flat * [1, -1, 1]) < 1e-20  # Of a flat sheet, turned over, it is one.


@pytest.mark.parametrize("target", ALL)
def test_rotations_are_those_by_singular_values(target):
    energy, rng = ARAP(VERTICES, FACES), np.random.default_rng(1)
    flat = BENT * [1, 1, 0]
    for vertices in (BENT, flat @ rotation((3, 1, 2), 50).T, BENT * [1, -1, 1], rng.normal(size=VERTICES.shape)):
        spokes = vertices[energy._ids[:, 0]] - vertices[energy._ids[:, 1]]
        spokes = arrays(target, spokes * energy._roots[:, :1], np.float64)
        found, specified = energy._turned_by_host(spokes)[0], energy._turned(spokes)[0]
        np.testing.assert_allclose(to_numpy(found), to_numpy(specified), atol=1e-9)


def test_the_rotation_of_any_matrix_is_one_and_the_best():
    pytest.importorskip("numba")
    from rts.regularizers import arap_loops

    rng = np.random.default_rng(6)
    values = [(1, 0.6, 0.2), (1, 1, 1), (1, 1e-9, 1e-12), (1, 1e-5, 0), (1, 0, 0), (0, 0, 0), (1e-90, 3e-91, 0)]
    for singular in values * 20:
        left, right = (np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2))  # Reflections among them.
        matrix, found = (left * singular) @ right, np.empty((3, 3))
        arap_loops._nearest_rotation(matrix.T.copy(), np.empty((3, 3)), found)
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(found) > 0
        best = singular[0] + singular[1] + singular[2] * np.sign(np.linalg.det(left) * np.linalg.det(right))
        np.testing.assert_allclose((found * matrix).sum(), best, rtol=1e-11)


def test_the_cotangent_laplacian_of_a_linear_function_is_zero_inside():
    vertices, faces, inside = grid(seed=3)
    energy = Laplacian(vertices, faces, "cotangent")
    linear = vertices @ np.random.default_rng(4).normal(size=(3, 3)) + [1, 2, 3]
    found = energy.residuals(linear)
    assert np.abs(found[inside]).max() < 1e-13
    assert np.abs(found[~inside]).max() > 1e-2
    assert np.abs(Laplacian(vertices, faces).residuals(linear)[inside]).max() > 1e-2


@pytest.mark.parametrize("weights", ["cotangent", "uniform"])
def test_a_laplacian_coordinate_is_the_distance_from_the_mean_of_the_neighbours(weights):
    count = 21  # More neighbours than a row of its table has room for.
    angles = 2 * np.pi * np.arange(count) / count
    rim = np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], axis=-1)
    vertices = np.concatenate([[(0, 0, 0.3)], rim])
    faces = np.stack([np.zeros(count, int), 1 + np.arange(count), 1 + (np.arange(count) + 1) % count], axis=-1)
    for target in ALL:
        found = to_numpy(Laplacian(vertices, faces, weights).residuals(arrays(target, vertices, np.float64)))
        np.testing.assert_allclose(found[0], [0, 0, -0.3], atol=1e-14)
    uniform = Laplacian(vertices, faces).residuals(vertices)
    np.testing.assert_allclose(uniform[1:], (rim[np.arange(count) - 1] + np.roll(rim, -1, 0) + vertices[0]) / 3 - rim)


def test_coordinates_at_rest_cost_nothing_shifted_or_not():
    energy = Laplacian(VERTICES, FACES, "cotangent", relative=True)
    assert energy(VERTICES) == 0 and energy(VERTICES + [5, 6, 7]) < 1e-25
    plain = Laplacian(VERTICES, FACES, "cotangent")
    np.testing.assert_allclose(energy(3 * VERTICES), 4 * plain(VERTICES), rtol=1e-12)


def test_a_scaled_mesh_costs_what_its_edges_are_longer():
    energy = EdgeLength(VERTICES, FACES)
    at_rest = lengths(VERTICES, energy.edges)
    assert energy.terms == len(energy.edges) == 3 * len(FACES) // 2
    np.testing.assert_allclose(energy(1.5 * VERTICES), 0.25 * (at_rest**2).sum(), rtol=1e-12)
    np.testing.assert_allclose(EdgeLength(VERTICES, FACES, 0)(VERTICES), (at_rest**2).sum(), rtol=1e-12)
    np.testing.assert_allclose(EdgeLength(VERTICES, FACES, 0.2)(VERTICES), ((at_rest - 0.2) ** 2).sum(), rtol=1e-12)
    even = EdgeLength(VERTICES, FACES, "mean")
    np.testing.assert_allclose(even(2 * VERTICES), 4 * at_rest.var() * len(at_rest), rtol=1e-12)


def test_normals_of_a_flat_sheet_are_consistent_and_a_fold_costs_its_angle():
    flat, faces, _ = grid(seed=5)
    energy = NormalConsistency(faces)
    assert energy(flat) < 1e-25 and energy.terms == 2 * 4 * 5 + 4 * 5 - 5 - 4
    hinge = NormalConsistency([(0, 1, 2), (1, 0, 3)])
    for degrees in (1, 60, 90, 170):
        fold = np.array([(0, 0, 0), (0, 2, 0), (-1, 0.5, 0), (0, 0, 0)], float)
        fold[3] = np.cos(np.radians(degrees)), 0.7, np.sin(np.radians(degrees))
        for faces in ([(0, 1, 2), (1, 0, 3)], [(0, 1, 2), (0, 1, 3)], [(2, 0, 1), (0, 3, 1)]):
            found = NormalConsistency(faces)(fold)
            np.testing.assert_allclose(found, 1 - math.cos(math.radians(degrees)), rtol=1e-9)
    assert hinge.terms == 1


def test_all_pairs_of_faces_at_an_edge_count():
    fan = np.array([(0, 0, 0), (0, 0, 1), (1, 0, 0), (0, 1, 0), (-1, 0, 0)], float)
    energy = NormalConsistency([(0, 1, 2), (0, 1, 3), (0, 1, 4)])
    assert energy.terms == 3
    # Sheets a quarter apart, and two that are one flat sheet.
    folds = [1 - math.cos(math.radians(180 - apart)) for apart in (90, 90, 180)]
    np.testing.assert_allclose(energy(fan), sum(folds), atol=1e-12)
    weights = ARAP(fan, [(0, 1, 2), (0, 1, 3), (0, 1, 4)]).weights
    np.testing.assert_allclose(weights[0], 3 * 0.5 * 1 / math.tan(math.radians(45)), rtol=1e-12)


# ------------------------------------------------------------------------------------------------- derivatives


@every_energy
def test_gradients_are_those_of_finite_differences(energy):
    expected, along = finite_difference(energy, BENT), np.random.default_rng(2).normal(size=BENT.shape)
    for target in DIFFERENTIABLE:
        x, dx = arrays(target, BENT, np.float64), arrays(target, along, np.float64)
        found = value_and_gradient(target, energy, x)[1]
        np.testing.assert_allclose(found, expected, atol=1e-7)
        value, slope = derivative(target, pytest.importorskip("jax").jit(energy) if target == "jax" else energy, x, dx)
        np.testing.assert_allclose(value, energy(BENT), rtol=1e-12)
        np.testing.assert_allclose(slope, (found * along).sum(), rtol=1e-9)


@every_energy
def test_compiled_and_in_batches_it_is_what_it_is_alone(energy):
    jax, torch = pytest.importorskip("jax"), pytest.importorskip("torch")
    batch = np.stack([BENT, VERTICES @ np.diag([1, 2, 3.0])])
    value = [energy(x) for x in batch]
    slope = [gradient("torch-cpu", energy, torch.from_numpy(x)) for x in batch]
    jax_batch = jax.jit(jax.vmap(jax.value_and_grad(energy)))(jax.numpy.asarray(batch))
    torch_batch = torch.func.vmap(torch.func.grad_and_value(energy))(torch.from_numpy(batch))
    for found_value, found_slope in (jax_batch, torch_batch[::-1]):
        np.testing.assert_allclose(found_value, value, rtol=1e-12)
        np.testing.assert_allclose(found_slope, slope, atol=1e-12)


@every_energy
def test_engines_and_dtypes_agree_and_stay(energy):
    expected = energy(BENT)
    for target in ALL:
        for dtype, tolerance in ((np.float64, 1e-13), (np.float32, 1e-5))[target == "jax" :]:  # Float64 is above.
            x = arrays(target, BENT, dtype)
            found = energy(x)
            assert found.dtype == x.dtype and to_numpy(found).shape == ()
            np.testing.assert_allclose(to_numpy(found), expected, rtol=tolerance)
            assert getattr(found, "device", None) == getattr(x, "device", None)
            residuals = to_numpy(energy.residuals(x))
            assert residuals.dtype == dtype
            np.testing.assert_allclose((residuals.astype(np.float64) ** 2).sum(), expected, rtol=tolerance)


@pytest.mark.thorough
def test_levenberg_marquardt_finds_the_shape_at_rest_again():
    torch = pytest.importorskip("torch")
    vertices, faces = icosphere(0)
    energy = ARAP(vertices, faces)
    start = torch.tensor(vertices * 1.2, dtype=torch.float64)
    found = rts.fit(energy.residuals, start, method="lm", steps=60, tolerance=1e-12)
    assert found.loss * energy.terms * 3 < 1e-12
    np.testing.assert_allclose(
        lengths(found.parameters.numpy(), energy.edges), lengths(vertices, energy.edges), rtol=1e-5
    )


def test_a_step_by_residuals_never_raises_the_rigidity():
    torch = pytest.importorskip("torch")
    energy = ENERGIES["arap"]
    x = torch.from_numpy(BENT * [1, 1, -1])
    before = float(energy(x))
    for _ in range(5):
        jacobian = torch.func.jacrev(energy.residuals)(x).reshape(-1, x.numel())
        x = x - torch.linalg.lstsq(jacobian, energy.residuals(x).reshape(-1, 1), driver="gelsd")[0].reshape(x.shape)
        assert float(energy(x)) < before
        before = float(energy(x))


def test_copies_are_the_same_energy():
    for energy in ENERGIES.values():
        assert copy.deepcopy(energy)(BENT) == energy(BENT)
        assert type(energy).__name__ in repr(energy)


# ------------------------------------------------------------------------------------------------- degenerate


DEGENERATE = {
    "a needle": ([(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0)], [(0, 1, 2), (0, 2, 3)]),
    "two vertices in one place": ([(0, 0, 0), (0, 0, 0), (1, 0, 0), (0, 1, 1)], [(0, 1, 2), (1, 2, 3)]),
    "all in one place": ([(1, 1, 1)] * 4, [(0, 1, 2), (1, 2, 3)]),
    "a corner named twice": ([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], [(0, 0, 1), (0, 1, 2), (1, 2, 3)]),
    "a tiny triangle": ([(0, 0, 0), (1e-20, 0, 0), (0, 1e-20, 0), (1, 1, 0)], [(0, 1, 2), (1, 2, 3)]),
    "a face twice": ([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 0)], [(0, 1, 2), (0, 1, 2)]),
    "no pair, and a vertex of no face": ([(0, 0, 0), (1, 0, 0), (0, 1, 0), (5, 5, 5)], [(0, 1, 2)]),
}


DEGENERATE["all of these"] = (
    [v for vertices, _ in DEGENERATE.values() for v in vertices],
    [tuple(4 * i + c for c in face) for i, (_, faces) in enumerate(DEGENERATE.values()) for face in faces],
)


@pytest.mark.parametrize(
    "target, name, dtype",
    [
        *[(t, n, d) for t in TORCH for n in DEGENERATE for d in (np.float32, np.float64)],
        ("jax", "all of these", np.float32),
    ],
)
def test_degenerate_meshes_have_finite_energies_and_gradients(target, name, dtype):
    vertices, faces = np.array(DEGENERATE[name][0], np.float64), DEGENERATE[name][1]
    made = [
        *[ARAP(vertices, faces, w) for w in ("cotangent", "uniform")],
        *[Laplacian(vertices, faces, w, relative=True) for w in ("cotangent", "uniform")],
        *[EdgeLength(vertices, faces, t) for t in ("rest", "mean", 0.5)],
        NormalConsistency(faces),
    ]
    lifted = vertices + [[0, 0, 0.1], *[[0, 0, 0]] * (len(vertices) - 1)]
    for energy in made:
        for moved in (vertices, lifted)[: 1 if target == "jax" else 2]:
            value, slope = value_and_gradient(target, energy, arrays(target, moved, dtype))
            assert np.isfinite(value) and np.isfinite(slope).all()


def test_a_mesh_collapsed_to_a_point_has_a_finite_gradient():
    for energy in ENERGIES.values():
        for target in DIFFERENTIABLE:
            x = arrays(target, 0 * VERTICES, np.float64)
            assert np.isfinite(value_and_gradient(target, energy, x)[1]).all()


def test_cotangents_are_bounded_and_rigidity_has_no_negative_weights():
    needle = [(0, 0, 0), (1, 0, 0), (2, 0, 0)]
    np.testing.assert_allclose(
        Laplacian(needle, [(0, 1, 2)], "cotangent").weights, np.array([0.5, -0.5, 0.5]) * LARGEST_COTANGENT
    )
    np.testing.assert_allclose(ARAP(needle, [(0, 1, 2)]).weights, np.array([0.5, 0, 0.5]) * LARGEST_COTANGENT)


@every_energy
@pytest.mark.parametrize("target", ALL)
def test_what_is_not_finite_gives_an_energy_that_is_not(energy, target):
    broken = np.where(np.arange(len(BENT))[:, None] == 3, np.nan, BENT)
    x = arrays(target, broken, np.float64)
    assert np.isnan(energy(x) if target == "numpy" else value_and_gradient(target, energy, x)[0])


# ----------------------------------------------------------------------------------------------------- misuse


def one_line(message):
    return rf"^(?!.*\n).*{message}"


@pytest.mark.parametrize("make", [ARAP, Laplacian, EdgeLength])
@pytest.mark.parametrize(
    "vertices, faces, message",
    [
        (VERTICES, [(0, 1, 999)], "faces name vertex 999, but there are 42 vertices"),
        (VERTICES, [(0, 1, -1)], "faces holds the index -1"),
        (VERTICES, np.zeros((0, 3), int), "at least one triangle"),
        (VERTICES, [(0, 1, 2, 3)], r"expected \(T, 3\)"),
        (VERTICES, [(0.0, 1.0, 2.0)], "expected integers"),
        (VERTICES, [(2, 2, 2)], "faces have no edge"),
        (VERTICES, None, "faces is None"),
        (np.zeros((0, 3)), [(0, 1, 2)], r"vertices is .*expected \(V, 3\) numbers, at least one row"),
        (VERTICES[:, :2], FACES, r"expected \(V, 3\) numbers"),
        (np.where(VERTICES > 1, np.nan, VERTICES), FACES, "expected finite numbers"),
        ("abc", FACES, "vertices is 'abc'"),
        (None, FACES, "vertices is None"),
    ],
)
def test_a_mesh_that_is_none_is_refused(make, vertices, faces, message):
    with pytest.raises(rts.InputError, match=one_line(message)):
        make(vertices, faces)


@every_energy
@pytest.mark.parametrize(
    "vertices, message",
    [
        (VERTICES[:5], r"vertices have 5 rows; expected 42"),
        (VERTICES[:, :2], r"vertices has shape \(42, 2\); expected \(V, 3\)"),
        (VERTICES[None], r"expected \(V, 3\)"),
        (np.zeros((42, 3), int), "expected float32 or float64"),
        (None, "vertices is a NoneType"),
        ("abc", "vertices is 'abc'"),
    ],
)
def test_vertices_of_another_mesh_are_refused(energy, vertices, message):
    with pytest.raises(rts.InputError, match=one_line(message)):
        energy(vertices)
    with pytest.raises(rts.InputError, match=one_line(message)):
        energy.residuals(vertices)


def test_wrong_options_are_refused():
    for make in (ARAP, Laplacian):
        for weights in ("cot", None, 1.0, ["uniform"]):
            with pytest.raises(rts.InputError, match=one_line("weights is .*expected one of cotangent, uniform")):
                make(VERTICES, FACES, weights)
    for target in ("median", None, -1.0, math.nan, math.inf, True, VERTICES):
        with pytest.raises(rts.InputError, match=one_line("target is .*expected 'rest', 'mean' or a length")):
            EdgeLength(VERTICES, FACES, target)
    with pytest.raises(rts.InputError, match=one_line("relative is 'yes'")):
        Laplacian(VERTICES, FACES, relative="yes")


def test_traced_vertices_at_rest_are_refused_with_what_to_do():
    jax = pytest.importorskip("jax")
    with pytest.raises(rts.InputError, match="^vertices is traced; make it outside of jit"):
        jax.jit(lambda x: ARAP(x, FACES)(x))(VERTICES)
