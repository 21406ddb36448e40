"""Reports of fits: missing inputs, undetermined directions, the floor of the loss; and refusals in one line."""

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, box, crooked_box, icosphere, mesh_part, quad, to_numpy

import rts
from rts.errors import EngineError, InputError

pytestmark = pytest.mark.fitting

targets = pytest.mark.parametrize("target", DIFFERENTIABLE)
methods = pytest.mark.parametrize("method", ["adam", "lm"])
MESH = rts.plugin("rts.surfaces", "mesh")


def one_line(error):
    text = str(error.value)
    assert text and "\n" not in text and len(text) < 500
    return text


# ------------------------------------------------------------------------------------------- what is missing


def cut(target):
    """Ways in which no derivative leads from parameters to residuals."""
    if target == "jax":
        jax = pytest.importorskip("jax")
        return jax.lax.stop_gradient, lambda p: jax.numpy.ones(3), jax.numpy.round
    torch = pytest.importorskip("torch")
    return lambda p: p.detach(), lambda p: torch.ones(3), lambda p: torch.tensor([x.item() for x in p])


@targets
@methods
@pytest.mark.parametrize("way", [0, 1, 2])
@pytest.mark.parametrize("jit", [True, False])
def test_residuals_that_depend_on_nothing_are_refused(target, method, way, jit):
    lost = cut(target)[way]
    with pytest.raises(InputError, match="^residuals do not depend on the parameters: ") as error:
        rts.fit(lambda p: lost(p) - 3, arrays(target, np.ones(3)), method=method, jit=jit)
    one_line(error)


@targets
def test_a_loss_that_depends_on_nothing_is_refused(target):
    with pytest.raises(InputError, match="^loss does not depend on the residuals: ") as error:
        rts.fit(lambda p: p, arrays(target, np.ones(3)), loss=lambda r: cut(target)[0](r).sum())
    one_line(error)


@methods
def test_gradients_switched_off_are_no_gradients(method):
    torch = pytest.importorskip("torch")

    def residuals(p):
        with torch.no_grad():
            return p - torch.zeros(2)

    if method == "lm":  # Forward mode does not heed it.
        assert rts.fit(residuals, torch.ones(2), method="lm").loss < 1e-9
        return
    with pytest.raises(InputError, match="do not depend .* no_grad"):
        rts.fit(residuals, torch.ones(2), method=method)


@pytest.mark.filterwarnings("ignore::rts.errors.EmptyImageWarning")
@targets
@methods
def test_an_object_out_of_view_is_named_as_the_reason(target, method):
    camera = rts.Camera.look_at((0, 0, 4), (0, 0, 0), aspect=1.0)
    part = rts.Part(MESH(box(0.5)[1]), {"vertices": box(0.5)[0]})
    goal = np.zeros((16, 16))
    goal[5:9] = 1
    residuals = rts.ImageResiduals(lambda p: part.replace(transform=rts.rigid(p)), camera, (16, 16), goal)
    start = arrays(target, np.array([0, 0, 0, 40.0, 0, 0]))
    fit = rts.fit(residuals, start, method=method, steps=4)
    assert "the gradient is exactly zero" in fit.reason and "is the object in view" in fit.reason
    assert "\n" not in fit.reason
    np.testing.assert_array_equal(to_numpy(fit.parameters), to_numpy(start))


@targets
@methods
def test_a_solution_at_the_start_is_not_called_a_missing_gradient(target, method):
    fit = rts.fit(lambda p: p * 2, arrays(target, np.zeros(2)), method=method, patience=3)
    assert fit.reason.endswith("the loss is zero") and fit.loss == 0


@targets
@methods
def test_arrays_that_never_had_a_gradient_are_named(target, method):
    start = arrays(target, {"used": np.ones(2), "lost": {"one": np.ones(3), "two": np.ones(1)}})
    fit = rts.fit(lambda p: p["used"] - 3, start, method=method, steps=3)
    assert fit.reason.endswith("; the gradient was zero throughout in lost.one, lost.two")
    both = rts.fit(lambda p: p["used"] - 3 + p["lost"]["one"][:2] + p["lost"]["two"], start, method="adam", steps=3)
    assert "throughout" not in both.reason


# ------------------------------------------------------------------------------------------ what is left open


def lit(target):
    """A sphere lit from its side and a camera, whose light and field of view are asked for, from far off."""
    vertices, faces = icosphere(3, 1.0)
    surface = MESH(faces)

    def scene(p):
        part = rts.Part(surface, {"vertices": vertices.astype(np.float32), "light": p["light"]}, "lambert")
        return part, rts.Camera.look_at((0.5, 0.6, 3.2), (0, 0, 0), fov_y=p["fov"], aspect=1.0)

    light = {"direction": np.array([1, 0.2, 0.1], np.float32), "color": np.array([0.7, 0.6, 0.5], np.float32)}
    goal = rts.render(*scene({"light": light, "fov": np.float32(45)}), (64, 64))
    rng = np.random.default_rng(4)
    direction = rng.normal(size=3)
    start = {"direction": direction / np.linalg.norm(direction), "color": rng.uniform(0.1, 1, 3)}
    residuals = rts.ImageResiduals(scene, None, (64, 64), goal)
    return residuals, arrays(target, {"light": start, "fov": np.array(40.0)})


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.thorough
def test_lm_does_not_run_away_along_the_length_of_a_light(known):
    residuals, start = lit("torch-cpu")
    fit = rts.fit(residuals if known else lambda p: residuals(p), start, method="lm")
    adam = rts.fit(residuals, start, method="adam", steps=400, learning_rate=0.05)
    assert adam.loss < 1e-6 and fit.loss < 1e-6
    found = to_numpy(fit.parameters)
    assert np.linalg.norm(found["light"]["direction"]) < 10
    direction = found["light"]["direction"] / np.linalg.norm(found["light"]["direction"])
    np.testing.assert_allclose(direction, np.array([1, 0.2, 0.1]) / np.sqrt(1.05), atol=5e-3)
    # The open direction is that of the vector itself.
    assert fit.reason.split("; ")[-1].startswith("not determined: light.direction along (")
    told = np.array([float(x) for x in fit.reason.rpartition("(")[2].rstrip(")").split(",")])
    np.testing.assert_allclose(told, direction, atol=0.02)


@targets
def test_directions_that_change_nothing_are_told_and_not_taken(target):
    start = arrays(target, {"a": np.array([3.0, 1.0]), "b": np.array(2.0), "c": np.ones(5), "free": np.ones(2)})

    def residuals(p):
        total = p["a"][:1] + p["b"]  # Their difference is open.
        c = p["c"]
        return rts.namespace(c).concat([total - 1, p["a"][1:] - 4, c[:1] - c[1:2] - 2, c[2:], 0 * p["free"]])

    fit = rts.fit(residuals, start, method="lm", tolerance=0)
    assert fit.loss < 1e-9
    assert "the gradient was zero throughout in free" in fit.reason
    assert "a[0] (0.71) with b (-0.71)" in fit.reason or "a[0] (-0.71) with b (0.71)" in fit.reason
    assert "c[0] (0.71) with c[1] (0.71)" in fit.reason and "c[2]" not in fit.reason
    found = to_numpy(fit.parameters)
    # The shortest way there.
    np.testing.assert_allclose(found["a"][0] - found["b"], 1.0, atol=1e-4)
    np.testing.assert_allclose(found["c"][:2], [2, 0], atol=1e-4)
    np.testing.assert_array_equal(found["free"], 1)


@targets
def test_nothing_is_called_open_where_all_is_determined(target):
    matrix = arrays(target, np.random.default_rng(0).normal(size=(9, 3)) * [1e-2, 1, 1e2])
    fit = rts.fit(lambda p: matrix @ p - 1, arrays(target, np.zeros(3)), method="lm", tolerance=1e-9)
    assert "not determined" not in fit.reason


# ------------------------------------------------------------------------------------------ where no step helps


def silhouette(supersample):
    part = mesh_part(crooked_box())
    camera = rts.Camera.look_at((0.9, 0.8, 2.2), (0, 0, 0), fov_y=40, aspect=1.0)

    def moved(p):
        return part.replace(transform=rts.rigid(p))

    goal = rts.render(moved(np.array([0.12, -0.18, 0.1, 0.06, -0.05, 0.08])), camera, (64, 64), supersample=8)
    # Found outlines move smoothly: points and splats alone have a floor.
    options = {"splatter": "multi", "layers": 2, "supersample": supersample}
    return rts.ImageResiduals(moved, camera, (64, 64), goal[..., 3], **options)


@pytest.mark.thorough
def test_the_floor_of_point_sampling_is_told_from_a_minimum():
    # From some starts the last gradient happens to promise nothing, and then it is called a minimum.
    point, told = silhouette(1), "no step lowers the loss: it is at the floor of point sampling; supersample=2, 3"
    starts = [arrays("torch-cpu", 0.05 * np.random.default_rng(seed).normal(size=6)) for seed in range(3)]
    fits = [rts.fit(point, start, method="lm", tolerance=0, steps=100) for start in starts]
    # Rounding decides whether a fit at the floor goes on by gains of a millionth.
    ended = [fit for fit in fits if len(fit.history) < 100]
    assert len(ended) >= 2 and all(fit.reason.startswith("no step lowers the loss") for fit in ended)
    start, coarse = next((start, fit) for start, fit in zip(starts, fits, strict=True) if fit.reason.startswith(told))
    finer = rts.fit(silhouette(3), start, method="lm", tolerance=0, steps=300)
    assert finer.loss < coarse.loss / 4
    # A function does not say that it is an image.
    unknown = (rts.fit(lambda p: point(p), start, method="lm", tolerance=0, steps=300).reason for start in starts)
    told = next(reason for reason in unknown if "though the gradient promises it" in reason)
    assert told.startswith("no step lowers the loss") and "of point-sampled images" in told


@targets
def test_a_local_minimum_is_called_so(target):
    # Of images, too: their colours are smooth.
    vertices, faces = quad(-5, 5, -5, 5)
    camera = rts.Camera.look_at((0, 0, 3), (0, 0, 0), aspect=1.0)
    goal = np.random.default_rng(1).random((16, 16, 3))
    surface = MESH(faces)

    def scene(color):
        return rts.Part(surface, {"vertices": vertices, "color": color}, "unlit")

    start = arrays(target, np.array([0.9, 0.5, 0.2]))
    fit = rts.fit(rts.ImageResiduals(scene, camera, (16, 16), goal), start, method="lm", tolerance=0)
    assert fit.reason == "no step lowers the loss: a minimum, if perhaps a local one"
    np.testing.assert_allclose(to_numpy(fit.parameters), goal.mean(axis=(0, 1)), atol=1e-4)
    # And of a function of its own, with a residual that stays.
    smooth = rts.fit(lambda p: rts.namespace(p).sin(3 * p) + 2, arrays(target, np.ones(1)), method="lm", tolerance=0)
    assert smooth.reason in ("no step lowers the loss: a minimum, if perhaps a local one", "the gradient is zero")
    assert smooth.loss == pytest.approx(1, abs=1e-4)


# ----------------------------------------------------------------------------------------------------- printed


@targets
def test_a_fit_prints_three_lines(target):
    start = arrays(target, {"light": {"color": np.ones(3)}, "pose": np.zeros(6), "gain": np.array(1.0)})
    fit = rts.fit(lambda p: p["pose"] - p["gain"] + p["light"]["color"].sum(), start, steps=40)
    for text in (str(fit), repr(fit), f"{fit}"):
        first, second, third = text.split("\n")
        assert first.startswith(f"loss {fit.history[0]:.4g} → {fit.loss:.4g} in 40 steps and ") and first.endswith(" s")
        assert second == fit.reason == "all 40 steps made"
        assert third == "parameters: gain (), light.color (3,), pose (6,)"
    assert fit._fields == ("parameters", "loss", "history", "steps", "reason", "seconds", "stages", "validated")
    parameters, loss, history, steps, reason, *_ = fit
    assert (loss, steps, reason) == (fit.loss, 40, fit.reason) and parameters is fit.parameters and len(history) == 40


def test_many_arrays_and_few_steps_print_short():
    start = {f"part{i:03}": arrays("torch-cpu", np.ones(2)) for i in range(100)}
    fit = rts.fit(lambda p: p["part000"] * 2, start, steps=1)
    assert str(fit).count("\n") == 2 and max(map(len, str(fit).split("\n"))) < 250
    assert " in 1 step and " in str(fit) and "94 more" in str(fit).split("\n")[2]
    assert fit.reason.startswith("the one step made; the gradient was zero throughout in part001, part002, part003, 96")


# ----------------------------------------------------------------------------------------------------- refused


@targets
@pytest.mark.parametrize(
    ("loss", "expected"),
    [
        ("mse", "loss is 'mse'; expected a function of the residuals, such as rts.Loss"),
        (3, "loss is 3"),
        (lambda r: None, "loss gave None"),
        (lambda r: 1.0, "loss gave a float; expected"),
        (lambda r: r, r"loss gave an array of shape \(3,\); expected a \w+ scalar"),
        (lambda r: np.float32(1), "loss gave a numpy.float32; expected"),
        (lambda r: (r > 0).any(), "loss gave a number of dtype .*bool; expected a floating one"),
    ],
)
def test_losses_of_any_kind_are_refused(target, loss, expected):
    with pytest.raises(InputError, match=expected) as error:
        rts.fit(lambda p: p, arrays(target, np.ones(3)), loss=loss)
    one_line(error)


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        (lambda one: {"a": one, 1: one}, "parameters has keys that cannot be sorted; expected names"),
        (lambda one: one[:0], "parameters holds no number, only empty arrays"),
        (lambda one: one.to_sparse(), "parameters holds an array whose values cannot be read"),
        (lambda one: one.cfloat(), "dtype .*complex64; expected a floating one"),
    ],
)
def test_parameters_of_any_kind_are_refused(parameters, expected):
    given = parameters(arrays("torch-cpu", np.ones(3)))
    with pytest.raises(InputError, match=expected) as error:
        rts.fit(lambda p: p, given)
    one_line(error)


@methods
def test_arrays_of_two_engines_are_told_with_both_names(method):
    torch, jnp = pytest.importorskip("torch"), pytest.importorskip("jax").numpy
    one, other = torch.ones(3), jnp.ones(3)
    for residuals, start in (
        (lambda p: p - other, one),
        (lambda p: other - p, one),
        (lambda p: p - one, other),
        (lambda p: jnp.sin(p), one),
        (lambda p: torch.sin(p), other),
        (lambda p: torch.as_tensor(p) * 2, other),
    ):
        own = "torch" if start is one else "jax"
        with pytest.raises(EngineError, match=f"torch and jax arrays met .*the parameters are {own} arrays") as error:
            rts.fit(residuals, start, method=method)
        one_line(error)
    with pytest.raises(EngineError, match="jax and torch met in one call") as error:
        rts.fit(lambda p: p["a"], {"a": one, "b": other}, method=method)
    one_line(error)


@methods
def test_what_jax_cannot_trace_is_told_in_one_line(method):
    jax = pytest.importorskip("jax")
    for residuals in (
        lambda p: p if p[0] > 0 else -p,
        lambda p: p * np.asarray(p),
        lambda p: p * float(p[0]),
        lambda p: p[p > 0],
    ):
        with pytest.raises(InputError, match="^jax cannot trace the function .*jit=False") as error:
            rts.fit(residuals, jax.numpy.ones(3), method=method)
        one_line(error)
    with pytest.raises(InputError, match="parameters holds traced arrays; call rts.fit outside jit") as error:
        jax.jit(lambda q: rts.fit(lambda p: p, q, method=method).parameters)(jax.numpy.ones(3))
    one_line(error)


@targets
def test_open_directions_are_told_beside_arrays_that_never_mattered(target):
    """The zeros of JᵀJ are one space, in which any basis may be found."""
    start = arrays(target, {"lost": np.ones((2, 3)), "pair": np.array([1.0, 5.0]), "sum": np.array([2.0, 3.0, 4.0])})
    weights = arrays(target, np.random.default_rng(0).normal(size=(4, 1)))

    def residuals(p):
        xp = rts.namespace(weights)
        return xp.concat([weights[:, 0] * (p["pair"].sum() - 2), p["sum"].sum() * weights[:1, 0] - 1])

    fit = rts.fit(residuals, start, method="lm", tolerance=0)
    assert fit.reason.split("; ")[1] == "the gradient was zero throughout in lost"
    told = fit.reason.split("; ")[2].removeprefix("not determined: ")
    assert told.startswith("pair along (0.71, -0.71), sum along (") or told.startswith("pair along (-0.71, 0.71), sum")
    assert told.count("sum along (") == 2 and "lost" not in told
    np.testing.assert_allclose(to_numpy(fit.parameters["pair"]), [-1, 3], atol=1e-3)
