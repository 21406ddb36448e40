"""Host functions inside jax programs."""

import gc
import weakref

import numpy as np
import pytest

pytestmark = pytest.mark.engines

jax = pytest.importorskip("jax")
jax_host = pytest.importorskip("rts_backends.jax_engine.host")
jnp = jax.numpy
mlir = pytest.importorskip("jax.interpreters.mlir")


@pytest.fixture(params=["_in_place", "_copying", "_emitted"], autouse=True)
def way(request, monkeypatch):
    """All ways of calling; the second is that of other devices, the third that of jax before 0.6.1."""

    def use(name):
        rule = mlir.lower_fun(getattr(jax_host, name), multiple_results=True)
        mlir.register_lowering(jax_host._call, rule, platform="cpu")

    if request.param == "_emitted":
        monkeypatch.setattr(jax_host, "buffer_callback", None)
    use("_copying" if request.param == "_copying" else "_in_place")
    yield
    use("_in_place")


def shape(*size, dtype=np.float32):
    return jax.ShapeDtypeStruct(size, dtype)


def test_arrays_of_any_dtype_pass_and_short_results_are_padded():
    dtypes = [np.bool_, np.int8, np.uint8, np.int16, np.int32, np.uint32, np.float32]

    def function(*given):
        assert all(type(x) is np.ndarray for x in given)
        return [*given, 2 * given[-1][:1, :2], np.float64(7), np.zeros((0, 3))]

    given = [jnp.asarray(np.arange(6).reshape(2, 3) % 2, dtype) for dtype in dtypes]
    shapes = (*(shape(2, 3, dtype=d) for d in dtypes), shape(2, 3), shape(), shape(2, 3))
    *found, short, scalar, none = jax.jit(lambda *x: jax_host.call(function, shapes, *x))(*given)
    for x, y in zip(found, given, strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)
    np.testing.assert_array_equal(short, [[0, 2, 0], [0, 0, 0]])
    np.testing.assert_array_equal(none, np.zeros((2, 3)))
    assert scalar == 7


def test_results_of_another_shape_are_refused():
    for wrong in (np.zeros(4), np.zeros((3, 1))):
        call = jax.jit(lambda x, wrong=wrong: jax_host.call(lambda x: [wrong], (shape(3),), x)[0])
        with pytest.raises(jax.errors.JaxRuntimeError, match="a host function returned an array of shape"):
            call(jnp.zeros(3)).block_until_ready()


def test_errors_carry_their_message():
    def function(x):
        raise KeyError("what happened")

    call = jax.jit(lambda x: jax_host.call(function, (shape(3),), x)[0])
    with pytest.raises(jax.errors.JaxRuntimeError, match="KeyError: 'what happened'"):
        call(jnp.zeros(3)).block_until_ready()


def test_a_call_that_is_interrupted_fails_the_program():
    def left(x):
        raise KeyboardInterrupt

    functions = [left, lambda x: [x + 1]]
    call = jax.jit(lambda x: jax_host.call(lambda x: functions.pop(0)(x), (shape(3),), x)[0])
    with pytest.raises(jax.errors.JaxRuntimeError, match="KeyboardInterrupt"):
        call(jnp.zeros(3)).block_until_ready()
    np.testing.assert_array_equal(call(jnp.zeros(3)), 1)


def test_vmap_calls_for_each_item():
    def both(x, y):
        return jax_host.call(lambda x, y: [x + y, x - y], (shape(2), shape(2)), x, y)

    x, y = jnp.arange(12.0).reshape(2, 3, 2), jnp.arange(2.0)
    for f in (jax.vmap(jax.vmap(both, (0, None)), (0, None)), jax.vmap(jax.vmap(both, (0, None)), (1, None), 1)):
        for mode in (f, jax.jit(f)):
            for found, expected in zip(mode(x, y), (x + y, x - y), strict=True):
                np.testing.assert_array_equal(found, expected)


def test_a_call_whose_results_are_not_used_is_not_made():
    calls = []

    def function(x):
        calls.append(1)
        return [x, x]

    jax.jit(lambda x: (jax_host.call(function, (shape(3), shape(3)), x), x)[1])(jnp.zeros(3)).block_until_ready()
    assert not calls
    (one,) = jax.jit(lambda x: jax_host.call(function, (shape(3), shape(3)), x)[1:])(jnp.ones(3))
    np.testing.assert_array_equal(one, 1)
    assert calls == [1]


def test_functions_live_as_long_as_their_programs():
    class Function:
        def __call__(self, x):
            return [x + 1]

    function = Function()
    life = weakref.ref(function)
    program = jax.jit(lambda x, f=function: jax_host.call(f, (shape(3),), x)[0])
    program = program.lower(jnp.zeros(3)).compile()
    del function
    jax.clear_caches()
    gc.collect()
    np.testing.assert_array_equal(program(jnp.zeros(3)), 1)
    del program
    jax.clear_caches()
    gc.collect()
    assert life() is None


@pytest.mark.parametrize("live", [(), ([True],)], ids=["before jax 0.12", "jax 0.12"])
def test_results_that_a_program_does_not_use_are_left_out_of_its_call(live):
    shapes = [jax.ShapeDtypeStruct((2,), np.float32)] * 2
    traced = jax.make_jaxpr(lambda x: jax_host.call(lambda x: (x, x), shapes, x))(jnp.zeros(2))
    (equation,) = traced.jaxpr.eqns
    read, less = jax_host._without_unused([False, True], *live, equation)
    assert read == [True] and less.params["used"] == (1,) and less.outvars == equation.outvars[1:]
    assert jax_host._without_unused([False, False], *live, equation) == ([False], None)
