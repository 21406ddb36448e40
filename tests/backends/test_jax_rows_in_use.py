"""Compiled jax programs shade the rows in use, in pieces, and give what shading all rows at once gives."""

import numpy as np
import pytest

import rts
from rts.arrays.engines import context_of
from rts.contracts.records import Cells, Samples, Stencil
from rts.rendering.splats import all_in_use

pytestmark = pytest.mark.engines

jax = pytest.importorskip("jax")
columns = pytest.importorskip("rts_backends.jax_engine.columns")
rows_in_use = pytest.importorskip("rts_backends.jax_engine.row_blocks")
jnp = jax.numpy

ALL, PIECE = 21, 4
CAMERA = rts.Camera.look_at((0, 0.5, 3), (0, 0, 0), fov_y=40)


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch):
    monkeypatch.setattr(rows_in_use, "LEAST", 1)
    monkeypatch.setattr(rows_in_use, "PIECE", PIECE)


def weighed(scale, x, y):
    """A function of rows, whose derivatives are known: the first of each sum is that of what it closes over."""
    return jnp.concatenate([scale * jnp.sqrt(x) + y[:, :1], x * y[:, :1]], axis=1)


def computed(scale, used, x, y):
    return rows_in_use.apply(lambda x, y: weighed(scale, x, y), used, [x, y])


def operands(items=()):
    random = np.random.default_rng(0)
    # Rows that are not in use are zeros, where the root has no derivative.
    x, y = (random.uniform(1, 2, (*items, ALL, 2)).astype(np.float32) for _ in range(2))
    return x, y


@pytest.mark.parametrize("used", [0, 1, PIECE, 9, ALL - 1, ALL])
def test_value_and_derivatives_are_those_of_the_rows_in_use(used):
    x, y = operands()
    x[used:] = 0
    scale, g = np.float32([2, 3]), np.ones((ALL, 4), np.float32)
    g[used:] = 0
    function = jax.jit(lambda scale, x, y, used, g: jax.vjp(lambda s, x, y: computed(s, used, x, y), scale, x, y)[1](g))
    value = jax.jit(computed)(scale, used, x, y)
    np.testing.assert_allclose(value[:used], weighed(scale, x, y)[:used], 1e-6)
    np.testing.assert_array_equal(value[-(-used // PIECE) * PIECE :], 0)  # They were not looked at.
    g_scale, g_x, g_y = function(scale, x, y, used, g)
    np.testing.assert_allclose(g_scale, np.sqrt(x[:used]).sum(0), 1e-5)
    np.testing.assert_allclose(g_x[:used], scale / (2 * np.sqrt(x[:used])) + y[:used, :1], 1e-5)
    np.testing.assert_allclose(g_y[:used, 0], 2 + x[:used].sum(1), 1e-5)
    for found in (g_x[used:], g_y[used:]):
        np.testing.assert_array_equal(found, 0)


def test_batches_forward_mode_and_second_derivatives_are_those_of_the_whole():
    (x, y), used, scale = operands((3,)), np.int32([3, 21, 8]), np.float32([2, 3])
    there = (np.arange(ALL) < used[:, None])[:, :, None]

    def loss(shade, scale, used, x, y, there):
        return (jnp.where(there, shade(scale, used, x, y), 0) ** 2).sum()

    def found(shade):
        def one(used, x, y, there):
            f = lambda scale: loss(shade, scale, used, x, y, there)  # noqa: E731
            along = jax.jvp(jax.grad(f), (scale,), (scale,))[1]
            twice = jax.jacrev(jax.grad(f))(scale)
            return jax.value_and_grad(f)(scale), jax.jacfwd(f)(scale), along, twice

        return jax.vmap(one)(used, x, y, there)

    expected = jax.tree.leaves(jax.jit(lambda: found(lambda scale, _, x, y: weighed(scale, x, y)))())
    for a, b in zip(jax.tree.leaves(jax.jit(lambda: found(computed))()), expected, strict=True):
        np.testing.assert_allclose(a, b, 1e-5)
    eager = jax.vmap(lambda *item: loss(computed, scale, *item))(used, x, y, there)
    np.testing.assert_allclose(eager, expected[0], 1e-5)


def test_what_need_not_be_computed_in_pieces_is_left_alone(monkeypatch):
    x, y = operands()

    def refused(f):
        seen = []
        jax.jit(lambda x, used: seen.append(rows_in_use.apply(f, used, [x])))(x, 3)
        return seen == [None]

    assert refused(lambda x: jnp.ones_like(x))  # It reads no row.
    assert not refused(jnp.sin)

    def printing(x):
        jax.debug.print("once")
        return jnp.sin(x)

    assert refused(printing)
    seen = []
    table = np.ones((ALL, 2), np.float32)
    monkeypatch.setattr(rows_in_use, "CLOSED", table.size - 1)
    jax.jit(lambda t, used: seen.append(rows_in_use.apply(lambda x: x * t.sum(0), used, [x])))(table, 3)
    assert seen[0] is not None  # The sum is made once, for all pieces.
    jax.jit(lambda t, used: seen.append(rows_in_use.apply(lambda x: t[x[:, 0].astype(int)], used, [x])))(table, 3)
    assert seen[1] is None  # Gradients of the table would take long.


@pytest.mark.parametrize("shader", ["lambert", "textured"])
def test_images_and_their_derivatives_are_those_of_all_rows(shader, monkeypatch):
    part = rts.Mesh.example().replace(shader=shader)
    theta = {name: jnp.asarray(x) for name, x in part.theta.items()}
    random = np.random.default_rng(1)
    theta |= {"uv": theta["vertices"][:, :2], "texture": jnp.asarray(random.random((4, 4, 3), np.float32))}
    weights = random.random((12, 12, 4), np.float32)

    def loss(pose, theta):
        posed = part.replace(transform=rts.rigid(pose), theta=theta)
        return (rts.render(posed, CAMERA, (12, 12)) * weights).sum()

    poses = jnp.asarray([[0.1, 0.2, 0.3, 0, 0, 0], [0, 0, 0, 0.1, 0.2, -1]], jnp.float32)

    def found():
        # A new function each time: jax keeps what it has compiled.
        gradients = jax.jit(jax.vmap(lambda pose, theta: jax.grad(loss, (0, 1))(pose, theta), (0, None)))
        along = jax.jit(lambda pose, theta: jax.jvp(loss, (pose, theta), (pose, theta)))
        return jax.tree.leaves((gradients(poses, theta), along(poses[0], theta)))

    calls = []
    apply = rows_in_use.apply
    monkeypatch.setattr(rows_in_use, "apply", lambda *given: calls.append(apply(*given)) or calls[-1])
    monkeypatch.setattr(rows_in_use, "PIECE", 100)
    pieces = found()
    assert calls and all(x is not None for x in calls)
    monkeypatch.setattr(rows_in_use, "LEAST", 1 << 30)
    for a, b in zip(pieces, found(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4 * float(np.abs(b).max()))


def test_sums_of_vectors_are_sums_of_columns():
    x = np.random.default_rng(0).random((6, 3), np.float32)

    def f(x):
        return jnp.sum(x * x, axis=1), jax.nn.relu(x.sum(0)), jnp.sum(x[:2, :2], axis=-1)

    found = columns.summed_by_columns(f)
    for a, b in zip(found(x), f(x), strict=True):
        np.testing.assert_allclose(a, b, 1e-6)
    sums = [line for line in str(jax.make_jaxpr(found)(x)).splitlines() if "reduce_sum" in line]
    assert len(sums) == 2  # Of rows, and of an array that is as short as its rows.


def test_a_shader_may_ask_whether_an_attribute_is_there():
    def shader(theta, gbuffer, camera):
        position = gbuffer["position"]
        color = 0.5 + 0 * position if "normal" in gbuffer else 0.2 * position
        return jnp.concatenate([color, jnp.ones_like(position[:, :1])], axis=1)

    part = rts.Mesh.example().replace(shader=shader)

    def image(vertices):
        return rts.render(part.replace(theta={"vertices": vertices}), CAMERA, (12, 15), capacity=400)

    vertices = jnp.asarray(part.theta["vertices"])
    np.testing.assert_allclose(jax.jit(image)(vertices), image(vertices), rtol=0, atol=1e-6)


def stencil_of(colors=(), motions=(), stacks=None):
    """A stencil of 2 × 2 cells with entries (sample, weight)."""
    colors, motions = (np.array(x, np.float32).reshape(-1, 2) for x in (colors, motions))
    of_colors = np.zeros(len(colors), np.int32), colors[:, 0].astype(np.int32), colors[:, 1]
    cell, sample, pair = (np.zeros((len(motions), *more), np.int32) for more in ((), (), (2,)))
    sample[:] = motions[:, 0]
    weight = np.pad(motions[:, 1:], ((0, 0), (2, 0)))
    stacks = None if stacks is None else np.array(stacks, np.int32).reshape(-1, 2)
    return Stencil(np.ones((2, 2, 2), bool), *of_colors, cell, sample, weight, pair, stacks)


@pytest.mark.parametrize(
    ("row", "stencil", "used"),
    [
        (-1, stencil_of(), False),
        (4, stencil_of(), True),  # A centre sees the part.
        (-1, stencil_of(colors=[(4, 0.5)]), True),
        (-1, stencil_of(colors=[(4, 0.0), (2, 0.5), (6, 0.5)], motions=[(2, 1.0), (6, 1.0)]), False),
        (-1, stencil_of(motions=[(5, -1.0)]), True),
        (-1, stencil_of(motions=[(5, 0.0)]), False),
        # Where light passes through, 4 and 5 are composites: that of the first stack, and of the second.
        (-1, stencil_of(colors=[(4, 0.5)], stacks=[(2, -1), (3, 4)]), False),
        (-1, stencil_of(colors=[(5, -0.5)], stacks=[(2, -1), (3, 4)]), True),
        (-1, stencil_of(colors=[(3, 0.5), (5, 0.0)], stacks=[(2, -1), (3, 4)]), False),
        (-1, stencil_of(colors=[(3, 0.5)], stacks=[]), False),
    ],
)
def test_a_part_is_in_use_where_a_centre_or_an_entry_that_has_an_effect_names_it(row, stencil, used):
    """Samples 3 to 5 are those of the part."""
    like = jnp.zeros(1)
    cells = Cells(jnp.full((1, 2, 2), -1).at[0, 0, 0].set(row))
    samples = Samples(jnp.zeros((3, 0), int), jnp.zeros((3, 0)), cells, jnp.int32(0))
    found = jax.jit(lambda samples, stencil: all_in_use(samples, context_of(like), stencil, 3).row)(samples, stencil)
    np.testing.assert_array_equal(found, [[[0, 1, 2]]] if used else [[[-1, -1, -1]]])
