"""Compiled operations in jax: the same as their specifications, in every transform."""

import os
import subprocess
import sys

import numpy as np
import pytest
from helpers import icosphere, precision

import rts
from rts.operations.combine import COMBINE, combine, interpolate
from rts.operations.projection import PROJECTION, projective_map

pytestmark = pytest.mark.engines

jax = pytest.importorskip("jax")
export = pytest.importorskip("jax.export")
jax_operations = pytest.importorskip("rts_backends.jax_engine.operations")
host = pytest.importorskip("rts_backends.jax_engine.host")
jnp = jax.numpy

MODES = {"eager": lambda f: f, "jit": jax.jit}

COLUMN, ROWS, COUNT = 3, 5, 7
IDS = np.random.default_rng(2).integers(0, ROWS, (COUNT, 6)).astype(np.int32)


def close(found, expected, tolerance=1e-4):
    """Equal to a share of the largest."""
    expected = np.asarray(expected)
    assert np.isfinite(expected).all() and np.abs(expected).max() > 1e-3
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


projected = PROJECTION.specification


def interpolated(rows, weights):
    return COMBINE.specification(rows, weights, jnp.asarray(IDS), column=COLUMN, count=3, affine=True)


def numbers(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


FUNCTIONS = {
    "projection": (projective_map, projected, (numbers(4, 4).at[2, 3].add(6), numbers(COUNT, 3, seed=1))),
    "interpolation": (
        lambda rows, weights: interpolate(rows, jnp.asarray(IDS), COLUMN, weights),
        interpolated,
        (numbers(ROWS, 4), numbers(COUNT, 2, seed=1)),
    ),
}


def weighted(f, shape):
    weights = numbers(*shape, seed=3)
    return lambda a, b: (f(a, b) ** 2 * weights).sum()


def stacked(x):
    return jnp.stack([x, 0.5 * x + 0.1, x * x])


def over_items(f):
    """Items of both operands, of the first and of the second."""
    return lambda a, b: (
        jax.vmap(f)(stacked(a), stacked(b)),
        jax.vmap(f, (0, None))(stacked(a), b),
        jax.vmap(f, (None, 0))(a, stacked(b)),
    )


TRANSFORMS = {
    "value": lambda f, s: f,
    "grad": lambda f, s: jax.grad(s, (0, 1)),
    "grad of the first": lambda f, s: jax.grad(s),
    "grad of the second": lambda f, s: jax.grad(s, 1),
    "jvp": lambda f, s: lambda a, b: jax.jvp(f, (a, b), (a + 1, b * b))[1],
    "jvp of the first": lambda f, s: lambda a, b: jax.jvp(lambda a: f(a, b), (a,), (a + 1,))[1],
    "jvp of the second": lambda f, s: lambda a, b: jax.jvp(lambda b: f(a, b), (b,), (b + 1,))[1],
    "jacfwd": lambda f, s: jax.jacfwd(f, (0, 1)),
    "jacrev": lambda f, s: jax.jacrev(f, (0, 1)),
    "vmap": lambda f, s: over_items(f),
    "vmap of grad": lambda f, s: over_items(jax.grad(s, (0, 1))),
    "vmap of jacfwd": lambda f, s: over_items(jax.jacfwd(f, (0, 1))),
    "grad of vmap": lambda f, s: jax.grad(lambda a, b: sum(x.sum() for x in over_items(s)(a, b)), (0, 1)),
    "jacrev of vmap": lambda f, s: jax.jacrev(lambda a, b: over_items(f)(a, b)[1], (0, 1)),
    "hessian": lambda f, s: jax.hessian(s, (0, 1)),
    "jacrev of grad": lambda f, s: jax.jacrev(jax.grad(s, (0, 1)), (0, 1)),
    "grad of jvp": lambda f, s: jax.grad(lambda a, b: (jax.jvp(f, (a, b), (b[:1, :1] + a, b))[1] ** 2).sum(), (0, 1)),
    "grad of checkpoint": lambda f, s: jax.grad(jax.checkpoint(s), (0, 1)),
}


SECOND = ("hessian", "jacrev of grad", "grad of jvp")
"""Eagerly these take seconds, and the same rules."""


CASES = [
    (list(FUNCTIONS)[j % 2], transform, "jit" if transform in SECOND else list(MODES)[j // 2 % 2])
    for j, transform in enumerate(TRANSFORMS)
]
"""Both functions by turns, and by turns eager and compiled: each program takes seconds to compile."""


@pytest.mark.parametrize(("name", "transform", "mode"), CASES)
def test_transforms_are_those_of_plain_jax(name, transform, mode):
    ours, plain, given = FUNCTIONS[name]
    shape = plain(*given).shape
    found, expected = (MODES[mode](TRANSFORMS[transform](f, weighted(f, shape)))(*given) for f in (ours, plain))
    found, expected = jax.tree.leaves(found), jax.tree.leaves(expected)
    largest = max(float(np.abs(x).max()) for x in expected)
    assert len(found) == len(expected) and largest > 1e-3
    for x, y in zip(found, expected, strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=2e-5 * largest)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_double_precision_and_finite_differences(name):
    ours, plain, given = FUNCTIONS[name]
    with precision("jax"):
        a, b = (jnp.asarray(np.asarray(x), jnp.float64) for x in given)
        move = jnp.sin(100 * a), jnp.cos(100 * b)
        step = lambda h: (a + h * move[0], b + h * move[1])  # noqa: E731
        for mode in MODES.values():
            value, along = mode(lambda a, b: jax.jvp(ours, (a, b), move))(a, b)
            assert value.dtype == along.dtype == np.float64
            np.testing.assert_allclose(value, plain(a, b), rtol=1e-12, atol=1e-12)
            difference = (plain(*step(1e-6)) - plain(*step(-1e-6))) / 2e-6
            np.testing.assert_allclose(along, difference, rtol=1e-7, atol=1e-7)
            g = jnp.sin(jnp.arange(value.size, dtype=jnp.float64)).reshape(value.shape)
            pulled = mode(lambda a, b: jax.vjp(ours, a, b)[1](g))(a, b)  # noqa: B023
            product = sum(float((x * t).sum()) for x, t in zip(pulled, move, strict=True))
            np.testing.assert_allclose(product, float((along * g).sum()), rtol=1e-12)


def test_other_dtypes_are_left_to_array_code():
    rows, points = (x.astype(jnp.float16) for x in FUNCTIONS["projection"][2])
    assert projective_map(rows, points).dtype == jnp.float16
    vertices, weights = FUNCTIONS["interpolation"][2]
    found = interpolate(vertices.astype(jnp.float16), jnp.asarray(IDS), COLUMN, weights)
    close(found, interpolated(vertices, weights), 1e-2)


def test_other_devices_are_left_to_array_code():
    ours, _, given = FUNCTIONS["projection"]
    f = jax.jit(jax.grad(lambda a, b: ours(a, b).sum(), (0, 1)))
    assert "callback" in f.lower(*given).as_text()
    assert "callback" not in export.export(f, platforms=["cuda"])(*given).mlir_module()


# ---------------------------------------------------------------------------------------------- rows that are not used

MANY, USED = 70_000, 20_001


def long(columns):
    return jnp.where(jnp.arange(MANY)[:, None] < USED, numbers(MANY, columns, seed=4), 0.0)


@pytest.mark.parametrize("mode", MODES)
def test_what_is_not_used_is_zero_and_gives_no_gradient(mode):
    rows, points = FUNCTIONS["projection"][2][0], long(3)
    vertices, weights = numbers(100, 3), long(2)
    ids = jnp.asarray(np.random.default_rng(5).integers(0, 100, (MANY, 3)), jnp.int32)
    g = numbers(MANY, 3, seed=6)
    triangles = {"column": 0, "count": 3, "affine": True}
    project = lambda r, p: jax_operations.apply(PROJECTION, (r, p), {}, np.int32(USED))  # noqa: E731
    at = lambda v, w: jax_operations.apply(COMBINE, (v, w, ids), triangles, np.int32(USED))  # noqa: E731
    blend = lambda v, w: COMBINE.specification(v, w, ids, **triangles)  # noqa: E731
    for ours, plain, given in ((project, projected, (rows, points)), (at, blend, (vertices, weights))):
        value, pull = jax.vjp(MODES[mode](ours), *given)
        expected, expected_pull = jax.vjp(plain, *given)
        close(value[:USED], expected[:USED], 1e-5)
        np.testing.assert_array_equal(value[USED:], 0)
        for x, y in zip(pull(g), expected_pull(g.at[USED:].set(0)), strict=True):
            close(x, y, 1e-5)
        tangents = tuple(jnp.cos(x) for x in given)
        pushed, expected = (jax.jvp(MODES[mode](f), given, tangents)[1] for f in (ours, plain))
        close(pushed[:USED], expected[:USED], 1e-5)
        np.testing.assert_array_equal(pushed[USED:], 0)


@pytest.mark.parametrize("constant", [True, False])
def test_a_shader_may_divide_by_what_it_reads(constant):
    # Rows that are allotted but not used hold what makes no NaN of a zero gradient.
    vertices, faces = icosphere(1)
    vertices = np.asarray(vertices, np.float32) if constant else jnp.asarray(vertices, jnp.float32)

    def shader(theta, gbuffer, camera):
        normal = gbuffer["normal"] / jnp.linalg.norm(gbuffer["normal"], axis=1, keepdims=True)
        color = normal @ theta["w"] / jnp.linalg.norm(gbuffer["position"], axis=1, keepdims=True)
        return jnp.concatenate([color, jnp.ones_like(color[:, :1])], axis=1)

    def loss(w):
        part = rts.Part(rts.plugin("rts.surfaces", "mesh")(faces), {"vertices": vertices, "w": w}, shader)
        return rts.render(part, rts.Camera.look_at((0, 0, 4), (0, 0, 0)), (24, 24)).sum()

    gradient = jax.grad(loss)
    eager = gradient(jnp.ones((3, 3)))
    assert np.isfinite(eager).all() and np.abs(eager).max() > 1
    close(jax.jit(gradient)(jnp.ones((3, 3))), eager)


# ---------------------------------------------------------------------------------------------------------- robustness


def test_weights_that_do_not_count_have_no_gradient():
    rows, weights = FUNCTIONS["interpolation"][2]
    wide = jnp.concatenate([weights, jnp.full((COUNT, 2), 9.0)], axis=1)
    for mode in MODES.values():
        f = mode(lambda w: interpolate(rows, jnp.asarray(IDS), COLUMN, w))
        value, pull = jax.vjp(f, wide)
        close(value, interpolated(rows, weights), 1e-5)
        expected = jax.vjp(lambda w: interpolated(rows, w), weights)[1](value)[0]
        close(pull(value)[0], jnp.pad(expected, ((0, 0), (0, 2))), 1e-5)


def test_gradients_in_the_place_of_operands_leave_what_is_read_later():
    rows, points = FUNCTIONS["projection"][2]
    weights = numbers(COUNT, 3, seed=3)

    def both(points, later):
        moved = points + 0.01 * jnp.sin(points)
        found = jax.grad(lambda x: (weights * projective_map(rows, x) ** 2).sum())(moved)
        return (found, jnp.cos(moved)) if later else found

    for later in (False, True):
        found, expected = jax.jit(lambda x, later=later: both(x, later))(points), both(points, later)
        for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(x, y, atol=1e-5)
    if host.buffer_callback is None:
        return  # This jax has no calls that take over the memory of operands.
    assert "output_operand_alias" in jax.jit(lambda x: both(x, False)).lower(points).as_text()


@pytest.mark.parametrize("devices", [1, 2])
def test_a_process_ends_though_nobody_waits_for_its_last_program(devices):
    code = """
import jax, jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from rts.operations.projection import projective_map

@jax.jit
def program(x, points):
    for _ in range(3):
        x = jnp.sin(x @ x)
    return projective_map(x[:4, :4], points)

mesh = jax.sharding.Mesh(np.array(jax.devices()), ("a",))
given = jax.device_put((jnp.ones((600, 600)), jnp.ones((5, 3))), NamedSharding(mesh, PartitionSpec()))
program.lower(*given).compile()
program(*given)
"""
    variables = {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}", "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", code], env=os.environ | variables, check=True, timeout=60)


def test_many_programs_at_once_end_on_a_single_core():
    code = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import jax, jax.numpy as jnp
from rts_backends.jax_engine import host

@jax.jit
def program(x):
    for _ in range(3):
        (x,) = host.call(lambda x: [x + 1], [jax.ShapeDtypeStruct(x.shape, x.dtype)], jnp.sin(x))
    return x

x = jnp.ones((1000, 1000))
for _ in range(5):
    jax.block_until_ready([program(x + i) for i in range(8)])
"""
    subprocess.run([sys.executable, "-c", code], env=os.environ | {"JAX_PLATFORMS": "cpu"}, check=True, timeout=100)


def test_eager_derivatives_in_batches_are_those_one_by_one():
    rng = np.random.default_rng(4)
    rows, weights, ids = rng.normal(size=(5, 3)), rng.random((7, 2)), rng.integers(0, 5, (7, 2)).astype(np.int32)
    rows, weights = jax.device_put(rows.astype(np.float32)), jax.device_put(weights.astype(np.float32))

    def f(rows, weights):
        return combine(rows, ids, weights)

    def alike(found, expected):
        for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(np.asarray(x), np.asarray(y), atol=1e-6)

    _, pull = jax.vjp(f, rows, weights)
    gradients = rng.normal(size=(2, 4, 7, 3)).astype(np.float32)
    by_one = [[pull(g) for g in some] for some in gradients]
    expected = jax.tree.map(lambda *x: np.reshape(np.stack(x), (2, 4, *x[0].shape)), *by_one[0], *by_one[1])
    alike(jax.vmap(jax.vmap(pull))(gradients), expected)
    alike(jax.jit(jax.vmap(jax.vmap(pull)))(gradients), expected)

    _, push = jax.linearize(f, rows, weights)
    along, other = rng.normal(size=(4, 5, 3)).astype(np.float32), rng.normal(size=(7, 2)).astype(np.float32)
    expected = np.stack([push(x, other) for x in along])
    alike(jax.vmap(push, (0, None))(along, other), expected)
    alike(jax.jit(jax.vmap(push, (0, None)))(along, other), expected)

    # The gradient of a batch: rows are of all items, weights of each.
    many = rng.random((4, 7, 2)).astype(np.float32)
    _, pull = jax.vjp(jax.vmap(f, (None, 0)), rows, jax.device_put(many))
    by_one = [jax.vjp(f, rows, w)[1](g) for w, g in zip(many, gradients[0], strict=True)]
    alike(pull(gradients[0]), (sum(r for r, _ in by_one), np.stack([w for _, w in by_one])))
