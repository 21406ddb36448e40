"""The compiled splatters in jax against torch's derivatives of the specification."""

import contextlib
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from test_fused import KINDS, SETTINGS, cells, compiled, noise, specification

import rts
from rts_backends.fused.cells import Cells

pytestmark = pytest.mark.splatting

jax = pytest.importorskip("jax")
export = pytest.importorskip("jax.export")
torch = pytest.importorskip("torch")
jax_operations = pytest.importorskip("rts_backends.jax_engine.operations")
jnp = jax.numpy

MODES = {"eager": lambda f: f, "jit": jax.jit}


def close(found, expected, tolerance=1e-4):
    """Equal to a share of the largest."""
    expected = np.asarray(expected)
    assert np.isfinite(expected).all() and np.abs(expected).max() > 1e-3
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


def on_jax(*arrays):
    return tuple(jnp.asarray(x) for x in arrays)


def scene32(*args, **options):
    return on_jax(*cells(*args, **options, dtype=np.float32))


@pytest.fixture
def calls(monkeypatch):
    """Names of the loops that run, with what their pullbacks want."""
    found = []

    def listen(name, method):
        def call(self, *args):
            wanted = tuple(x is not None for x in args[1:])
            found.append((name, wanted) if name == "vjp" else (name,))
            return method(self, *args)

        return call

    for name in ("image", "vjp", "jvp"):
        monkeypatch.setattr(Cells, name, listen(name, getattr(Cells, name)))
    return found


@contextlib.contextmanager
def x64():
    jax.config.update("jax_enable_x64", True)
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", False)


# ------------------------------------------------------------------------------------------- the specification


@pytest.mark.parametrize("layers", [1, 2, 3, 4])
@pytest.mark.parametrize("kind", KINDS)
def test_image_vjp_and_jvp_are_those_of_the_specification(kind, layers):
    for (seed, holes, middle_holes), settings in zip(
        [(0, 0.2, False), (1, 0.02, False), (2, 0.3, True)], SETTINGS, strict=True
    ):
        scene = cells(layers, seed=seed, dtype=np.float32, holes=holes, middle_holes=middle_holes)
        *samples, row = map(torch.tensor, scene)
        splatter, g = KINDS[kind](**settings), noise(9, 11, 4, dtype=np.float32)
        tangents = [noise(*x.shape, dtype=np.float32) for x in scene[:2]]
        image = lambda p, c: specification(splatter).splat(p, c, row)  # noqa: B023, E731
        expected, pull = torch.func.vjp(image, *samples)
        pulled = pull(torch.tensor(g))
        pushed = torch.func.jvp(image, tuple(samples), tuple(map(torch.tensor, tangents)))[1]
        *samples, row = on_jax(*scene)
        for mode in MODES.values():
            image = mode(lambda p, c: splatter.splat(p, c, row))  # noqa: B023
            found, pull = jax.vjp(image, *samples)
            close(found, expected, 1e-5)
            for x, y in zip(pull(jnp.asarray(g)), pulled, strict=True):
                close(x, y)
            np.testing.assert_array_equal(pull(jnp.asarray(g))[0][:, 2], 0)
            close(jax.jvp(image, tuple(samples), on_jax(*tangents))[1], pushed)


class Smooth:
    """A scalar and an image of six parameters that move and tint every sample, in either framework."""

    def __init__(self, splatter, array, layers):
        scene = cells(layers, (4, 5), seed=1, dtype=np.float32)
        given = noise(6, *scene[0].shape), noise(6, *scene[1].shape, seed=8), noise(4, 5, 4, seed=9)
        self.positions, self.rgba, self.row = map(array, scene)
        self.moves, self.tints, self.weights = (array(x.astype(np.float32)) for x in given)
        self.x = array((noise(6, seed=3) * 0.05).astype(np.float32))
        self.eye = array(np.eye(6, dtype=np.float32))
        self.splatter = splatter

    def image(self, x, y=None):
        y = x if y is None else y
        positions = self.positions + (x[:, None, None] * self.moves).sum(0)
        return self.splatter.splat(positions, self.rgba + (y[:, None, None] * self.tints).sum(0), self.row)

    def loss(self, x, y=None):
        return (self.image(x, y) ** 2 * self.weights).sum()


FIRST = {
    "grad": lambda f, s: f.grad(s.loss),
    "grad of positions": lambda f, s: f.grad(lambda x: s.loss(x, s.x)),
    "grad of colors": lambda f, s: f.grad(lambda x: s.loss(s.x, x)),
    "jvp": lambda f, s: lambda x: f.jvp(s.image, (x,), (x + 1,))[1],
    "jvp of positions": lambda f, s: lambda x: f.jvp(lambda x: s.image(x, s.x), (x,), (x + 1,))[1],
    "jacfwd": lambda f, s: f.jacfwd(s.image),
    "jacrev": lambda f, s: f.jacrev(lambda x: s.image(x)[1]),
    "vmap": lambda f, s: lambda x: f.vmap(s.image)(x * s.eye),
    "vmap of positions": lambda f, s: lambda x: f.vmap(lambda x: s.image(x, s.x))(x * s.eye),
    "vmap of grad": lambda f, s: lambda x: f.vmap(f.grad(s.loss))(x * s.eye),
    "vmap of jacfwd": lambda f, s: lambda x: f.vmap(f.jacfwd(s.image))(x * s.eye),
    "grad of vmap": lambda f, s: f.grad(lambda x: f.vmap(s.loss)(x * s.eye).sum()),
    "grad of what items share": lambda f, s: f.grad(lambda x: f.vmap(lambda y: s.loss(y, x))(s.x * s.eye).sum()),
    "vmap of vmap": lambda f, s: (
        lambda x: f.vmap(lambda a: f.vmap(lambda b: s.image(a, b))(x * s.eye[:2]))(x * s.eye[:3])
    ),
    "vmap of jacfwd of vmap": lambda f, s: (
        lambda x: f.vmap(lambda a: f.jacfwd(lambda b: f.vmap(lambda c: s.image(a * b, c))(x * s.eye[:2]))(x))(
            x * s.eye[:3]
        )
    ),
}
SECOND = {
    "hessian": lambda f, s: f.hessian(s.loss),
    "jacrev of jacrev": lambda f, s: f.jacrev(f.jacrev(s.loss)),
    "grad of jvp": lambda f, s: f.grad(lambda x: (f.jvp(s.image, (x,), (s.x + 1,))[1] ** 2 * s.weights).sum()),
    "jacfwd of jvp": lambda f, s: f.jacfwd(lambda x: f.jvp(s.image, (x,), (s.x * 2 + 1,))[1]),
}


def check_transform(transform, kind, mode, layers=2, tolerance=1e-4):
    splatter = KINDS[kind]()
    reference = Smooth(specification(splatter), torch.tensor, layers)
    ours = Smooth(splatter, jnp.asarray, layers)
    found = MODES[mode](transform(jax, ours))(ours.x)
    close(found, transform(torch.func, reference)(reference.x), tolerance)


CASES = [("visible", name, list(MODES)[i % 2]) for i, name in enumerate(FIRST)] + [("multi", "grad", "jit")]
"""By turns eager and compiled, which takes seconds; all kinds are one operation of the engine."""


@pytest.mark.parametrize(("kind", "name", "mode"), CASES)
def test_transforms_are_those_of_the_specification(kind, name, mode):
    check_transform(FIRST[name], kind, mode)


@pytest.mark.parametrize("name", SECOND)
def test_second_derivatives_are_those_of_the_specification(name):
    check_transform(SECOND[name], "single", "jit", layers=1, tolerance=1e-3)


def test_a_second_derivative_of_visible_is_that_of_the_specification():
    check_transform(SECOND["grad of jvp"], "visible", "jit", layers=1, tolerance=1e-3)


def test_gauss_newton_products_take_loops_alone(calls):
    ours = Smooth(KINDS["visible"](), jnp.asarray, 2)
    jacobian = jax.jacfwd(ours.image)(ours.x).reshape(-1, 6)
    calls.clear()
    value, push = jax.linearize(ours.image, ours.x)
    (product,) = jax.linear_transpose(push, ours.x)(push(ours.x))
    close(product, jacobian.T @ (jacobian @ ours.x))
    assert [name for name, *_ in calls] == ["image", "jvp", "vjp"]


def test_checkpoint_keeps_the_gradient():
    ours = Smooth(KINDS["visible"](), jnp.asarray, 2)
    for mode in MODES.values():
        close(mode(jax.grad(jax.checkpoint(ours.loss)))(ours.x), jax.grad(ours.loss)(ours.x), 1e-6)


# ------------------------------------------------------------------------------------------------------- costs


@pytest.mark.parametrize("mode", MODES)
def test_one_sweep_pushes_all_columns_of_a_jacobian(mode, calls):
    ours = Smooth(KINDS["visible"](), jnp.asarray, 2)
    MODES[mode](jax.jacfwd(ours.image))(ours.x).block_until_ready()
    assert sorted(name for name, *_ in calls) in (["image", "jvp"], ["jvp"])


@pytest.mark.parametrize("mode", MODES)
def test_what_is_constant_costs_no_derivative(mode, calls):
    ours = Smooth(KINDS["visible"](), jnp.asarray, 2)
    MODES[mode](jax.value_and_grad(lambda x: (ours.splatter.splat(ours.positions * x[0], ours.rgba, ours.row)).sum()))(
        ours.x
    )[1].block_until_ready()
    assert calls == [("image",), ("vjp", (True, False))]


def test_colors_that_are_all_alike_are_not_written_out():
    positions, rgba, row = scene32(2)
    splatter, count = KINDS["visible"](), len(positions)

    def image(positions, color):
        alpha = jnp.ones_like(positions[:, :1])
        return splatter.splat(positions, jnp.concat([jnp.broadcast_to(color, (count, 3)), alpha], axis=1), row)

    def loss(positions, color):
        return (image(positions, color) ** 2).sum()

    color = jnp.asarray([0.2, 0.9, 0.4])
    program = jax.jit(image).lower(positions, color).compile()
    assert f"f32[{count},3]" in program.as_text() and f"f32[{count},4]" not in program.as_text()
    np.testing.assert_array_equal(program(positions, color), image(positions, color))
    gradient = jax.grad(loss, (0, 1))
    for found, expected in zip(jax.jit(gradient)(positions, color), gradient(positions, color), strict=True):
        close(found, expected, 1e-6)
    along = lambda p, c: jax.jvp(image, (p, c), (p, c))[1]  # noqa: E731
    close(jax.jit(along)(positions, color), along(positions, color), 1e-6)
    many = jnp.stack([color, color[::-1]])
    found = jax.jit(jax.vmap(image, (None, 0)))(positions, many)
    np.testing.assert_array_equal(found, jnp.stack([image(positions, c) for c in many]))
    # Alike in a column, or as many as there are samples, is not alike in all rows.
    shades = jnp.linspace(0, 1, count)
    grey = lambda s: splatter.splat(positions, jnp.broadcast_to(s[:, None], (count, 4)), row)  # noqa: E731
    np.testing.assert_array_equal(jax.jit(grey)(shades), grey(shades))


@pytest.mark.parametrize("mode", MODES)
def test_what_the_image_decides_is_not_decided_again(mode, monkeypatch):
    decided = []

    class Listening(type(Cells.choices)):
        def __get__(self, instance, owner=None):
            if instance is not None and "choices" not in instance.__dict__:
                decided.append(1)
            return super().__get__(instance, owner)

    listening = Listening(Cells.choices.func)
    listening.__set_name__(Cells, "choices")
    monkeypatch.setattr(Cells, "choices", listening)
    ours = Smooth(KINDS["visible"](), jnp.asarray, 3)
    gradient, along = jax.grad(ours.loss), lambda x: jax.jvp(ours.image, (x,), (x + 1,))[1]
    several = jax.vmap(jax.grad(ours.loss))
    given = ours.x, ours.x, ours.x * ours.eye[:3]
    expected = []
    for f, x, times in zip((gradient, along, several), given, (1, 1, 3), strict=True):
        decided.clear()
        expected.append(MODES[mode](f)(x).block_until_ready())
        assert len(decided) == times
    # Nor is it needed: what is no longer known is decided anew.
    monkeypatch.setattr(jax_operations, "MOST_KEPT", 0)
    for f, x, known in zip((gradient, along, several), given, expected, strict=True):
        decided.clear()
        np.testing.assert_array_equal(MODES[mode](f)(x), known)
        assert decided


@pytest.mark.parametrize("kind", KINDS)
def test_images_without_their_border(kind):
    positions, rgba, row = scene32(2)
    splatter, g = KINDS[kind](), jnp.asarray(noise(5, 7, 4, dtype=np.float32))
    inside = lambda p, c: splatter.splat(p, c, row, border=2)  # noqa: E731
    cropped = lambda p, c: splatter.splat(p, c, row)[2:-2, 2:-2]  # noqa: E731
    for mode in MODES.values():
        (found, pull), (expected, expected_pull) = (jax.vjp(mode(f), positions, rgba) for f in (inside, cropped))
        np.testing.assert_array_equal(found, expected)
        for x, y in zip(pull(g), expected_pull(g), strict=True):
            np.testing.assert_array_equal(x, y)
    if kind == "single":  # The others compile for long, and take the same way.
        second = lambda f: jax.jit(lambda x: jax.jvp(jax.grad(lambda p: (f(p, rgba) ** 2).sum()), (x,), (x,))[1])  # noqa: E731
        close(second(inside)(positions), second(cropped)(positions))


def test_eager_calls_compile_nothing():
    positions, rgba, row = scene32(2)
    splatter, g = KINDS["visible"](), jnp.asarray(noise(9, 11, 4, dtype=np.float32))
    seen = []

    def step(positions):
        return jax.vjp(lambda p: splatter.splat(p, rgba, row), positions)[1](g)

    moved = [positions + 0.01 * i for i in range(4)]
    step(moved[0])
    listen = lambda name, *args, **options: seen.append(name) if "backend_compile" in name else None  # noqa: E731
    jax.monitoring.register_event_duration_secs_listener(listen)
    jax.jit(lambda x: x + 12345)(1.0)
    assert seen  # Compilations are heard.
    seen.clear()
    for x in moved:
        step(x)
    assert not seen


# -------------------------------------------------------------------------------------------------- robustness


@pytest.mark.parametrize("kind", KINDS)
def test_rows_beyond_the_samples_are_refused(kind):
    positions, rgba, row = scene32(2)
    row, splatter = row.at[0, 0, 0].set(len(positions)), KINDS[kind]()
    message = f"row refers to sample {len(positions)} of {len(positions)}"
    with pytest.raises(rts.InputError, match=message):
        splatter.splat(positions, rgba, row)
    with pytest.raises(jax.errors.JaxRuntimeError, match=f"InputError: {message}"):
        jax.jit(splatter.splat)(positions, rgba, row).block_until_ready()
    splatter.splat(positions, rgba, row.at[0, 0, 0].set(-1))


@pytest.mark.parametrize("kind", KINDS)
def test_results_are_bitwise_those_of_the_loops(kind, monkeypatch):
    scene = cells(3, (70, 150), dtype=np.float32)
    g, tangents = noise(70, 150, 4, dtype=np.float32), noise(*scene[0].shape, dtype=np.float32)
    splatter = KINDS[kind]()
    splats = compiled(splatter, scene)
    expected = splats.image(), *splats.vjp(g), splats.jvp(tangents[None], None)[0]
    positions, rgba, row, g, tangents = on_jax(*scene, g, tangents)

    def everything(positions, rgba, row):
        image, pull = jax.vjp(lambda p, c: splatter.splat(p, c, row), positions, rgba)
        return image, *pull(g), jax.jvp(lambda p: splatter.splat(p, rgba, row), (positions,), (tangents,))[1]

    run = [mode(everything) for mode in MODES.values()]
    for threads in "123":
        monkeypatch.setenv("RTS_NUM_THREADS", threads)
        for call in run:
            for found, known in zip(call(positions, rgba, row), expected, strict=True):
                np.testing.assert_array_equal(found, known)


def test_vmap_over_rows():
    positions, rgba, row = scene32(2)
    rows, tints = jnp.stack([row, row[:, ::-1], row[:, :, ::-1]]), jnp.linspace(0, 1, 3)
    splatter = KINDS["visible"]()
    found = jax.vmap(lambda r, t: splatter.splat(positions, rgba * t, r))(rows, tints)
    for image, r, t in zip(found, rows, tints, strict=True):
        np.testing.assert_array_equal(image, splatter.splat(positions, rgba * t, r))


@pytest.mark.parametrize("size", [(0, 5), (5, 0)], ids=str)
def test_images_of_no_pixels(size):
    positions, rgba, row = jnp.ones((3, 3)), jnp.ones((3, 4)), jnp.zeros((2, *size), np.int32)
    for mode in MODES.values():
        image, pull = jax.vjp(mode(lambda p: KINDS["multi"]().splat(p, rgba, row)), positions)
        assert image.shape == (*size, 4)
        np.testing.assert_array_equal(pull(image)[0], 0)


def test_double_precision():
    scene = cells(3)
    splatter, g = KINDS["visible"](), noise(9, 11, 4)
    splats = compiled(splatter, scene)
    with x64():
        for dtype in (np.int32, np.int64):
            positions, rgba, row = on_jax(*scene[:2], scene[2].astype(dtype))
            for mode in MODES.values():
                image, pull = jax.vjp(mode(lambda p, c: splatter.splat(p, c, row)), positions, rgba)  # noqa: B023
                assert image.dtype == np.float64
                for x, y in zip((image, *pull(jnp.asarray(g))), (splats.image(), *splats.vjp(g)), strict=True):
                    np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16], ids=str)
def test_other_dtypes_are_left_to_the_specification(dtype, calls):
    positions, rgba, row = scene32(1)
    scene = positions.astype(dtype), rgba.astype(dtype), row
    found, expected = (s.splat(*scene) for s in (KINDS["single"](), specification(KINDS["single"]())))
    np.testing.assert_array_equal(found, expected)
    assert not calls


def test_other_devices_are_left_to_the_specification():
    positions, rgba, row = scene32(2)
    f = jax.jit(jax.grad(lambda p: KINDS["single"]().splat(p, rgba, row).sum()))
    assert "callback" in f.lower(positions).as_text()
    assert "callback" not in export.export(f, platforms=["cuda"])(positions).mlir_module()


def test_many_calls_at_once():
    positions, rgba, row = scene32(2)
    splatter = KINDS["visible"]()
    f = jax.jit(jax.grad(lambda p: (splatter.splat(p, rgba, row) ** 2).sum()))
    expected, found = f(positions), []
    pending = [f(positions) for _ in range(50)]

    def work():
        for _ in range(20):
            found.append((f(positions), jax.grad(lambda p: (splatter.splat(p, rgba, row) ** 2).sum())(positions)))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert len(found) == 80
    for x in (*pending, *(x for pair in found for x in pair)):
        np.testing.assert_array_equal(x, expected)


def test_several_devices():
    code = """
import sys
sys.path.insert(0, sys.argv[1])
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from test_fused_jax import KINDS, scene32

positions, rgba, row = scene32(2, (6, 8))
splatter = KINDS["visible"]()
expected = splatter.splat(positions, rgba, row)
assert not expected.committed
other = jax.devices()[1]
assert splatter.splat(jax.device_put(positions, other), rgba, row).devices() == {other}
with jax.default_device(other):
    elsewhere = splatter.splat(*(jax.numpy.asarray(np.asarray(x)) for x in (positions, rgba, row)))
assert elsewhere.devices() == {other} and not elsewhere.committed
mesh = Mesh(np.array(jax.devices()), ("a",))
rows = jax.device_put(row, NamedSharding(mesh, PartitionSpec(None, "a")))
for f in (splatter.splat, jax.jit(splatter.splat)):
    np.testing.assert_array_equal(f(positions, rgba, rows), expected)
"""
    variables = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", code, str(Path(__file__).parent)]
    subprocess.run(command, env=os.environ | variables, check=True, timeout=120)
