"""Robust losses: closed forms, SciPy's, finite differences, and fits to images of which a part is wrong."""

import dataclasses
import math
from fractions import Fraction

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, icosphere, quad, refused, to_numpy
from scipy.optimize import least_squares

import rts
from rts.arrays.engines import engine_of
from rts.errors import InputError
from rts.fitting.normal_equations import normal_equations

pytestmark = pytest.mark.fitting

ROBUST = ("soft_l1", "huber", "cauchy")
targets = pytest.mark.parametrize("target", DIFFERENTIABLE)
losses = pytest.mark.parametrize("name", ROBUST)
SIZE = (18, 23)
CAMERA = rts.Camera.look_at((0.7, 0.9, 3.2), (0, 0, 0), fov_y=40, aspect=23 / 18)
POSE = np.float32([0.2, -0.3, 0.1, 0.05, -0.07, 0.1])


def goal(channels, seed=0):
    rng = np.random.default_rng(seed)
    weights = rng.random((*SIZE, channels)) * (rng.random((*SIZE, channels)) > 0.3)
    return rng.random((*SIZE, channels)).astype(np.float32), weights.astype(np.float32)


def moving(pose, shader="silhouette"):
    wall = rts.Part(rts.Mesh(quad()[1]), {"vertices": quad(-0.9, 0.8, -1.1, 0.6, -0.8)[0]}, shader)
    return [rts.Mesh.example().replace(transform=rts.rigid(pose), shader=shader), wall]


def residuals(shader="silhouette", channels=1, **options):
    image, weights = goal(channels)
    given = {"weights": weights, **options}
    return rts.ImageResiduals(lambda pose: moving(pose, shader), CAMERA, SIZE, image, **given)


def gradient(f, x):
    return to_numpy(engine_of(x).value_and_grad(f)(x)[1])


def mean_loss(residuals):
    """Their mean loss, as a function of the parameters."""
    return lambda parameters: residuals.loss(residuals(parameters))


def cost(name, r, s):
    """s² ρ((r / s)²) of one number."""
    z = (r / s) ** 2
    rho = {"linear": z, "soft_l1": 2 * (math.sqrt(1 + z) - 1), "cauchy": math.log(1 + z)}
    return s**2 * (rho[name] if name in rho else z if z <= 1 else 2 * math.sqrt(z) - 1)


def slope(name, r, s):
    """Its derivative."""
    z = (r / s) ** 2
    return 2 * r / {"soft_l1": math.sqrt(1 + z), "huber": max(1, math.sqrt(z)), "cauchy": 1 + z}[name]


# ------------------------------------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("target", ["numpy", *DIFFERENTIABLE])
@pytest.mark.parametrize("name", ("linear", *ROBUST))
def test_of_one_number_they_are_their_closed_forms(name, target):
    for s in (0.1, 2.0):
        for r in (-3.0, -0.1, 0.0, 0.01, 0.1, 1.0, 5.0):
            assert float(rts.Loss(name, s)(arrays(target, np.array([r])))) == pytest.approx(cost(name, r, s), rel=1e-6)


@losses
@targets
def test_derivatives_are_finite_and_right_everywhere(name, target):
    """At zero, where it turns into robust, and far beyond."""
    for s in (0.125, 2.0):
        r = np.array([-3.0, -s, 0.0, 1e-30, 0.01, s, 5.0, 1e6])
        found = gradient(lambda x, s=s: 8 * rts.Loss(name, s)(x), arrays(target, r))
        np.testing.assert_allclose(found, [slope(name, x, s) for x in r], rtol=1e-5, atol=1e-30)


@losses
def test_weights_are_derivatives_and_curvatures_second_ones(name):
    torch = pytest.importorskip("torch")
    r = torch.tensor([-3.0, -0.9, -0.1, 0.3, 0.6, 1.3, 5.0], dtype=torch.float64)
    loss = rts.Loss(name, 0.7)
    first = torch.func.vmap(torch.func.grad(loss))(r)
    second = torch.func.vmap(torch.func.grad(torch.func.grad(loss)))(r)
    weights, curvatures = loss.weights(r)
    torch.testing.assert_close(weights * r, first / 2)
    torch.testing.assert_close(curvatures, torch.maximum(second / 2, weights / 10))
    assert (second < 0).any() or name != "cauchy"
    ones = rts.Loss().weights(r)
    assert (ones[0] == 1).all() and (ones[1] == 1).all()


@losses
@targets
def test_an_image_of_one_colour_has_the_loss_of_that_colour(name, target):
    vertices, faces = quad(-9, 9, -9, 9, 0)
    part = rts.Part(rts.Mesh(faces), {"vertices": vertices}, "unlit")
    wanted, color = np.float32([0.25, 0.45, 0.1]), np.float32([0.2, 0.5, 0.9])
    swept = rts.ImageResiduals(
        lambda color: part.replace(theta={"vertices": vertices, "color": color}),
        *(CAMERA, SIZE, np.broadcast_to(wanted, (*SIZE, 3)).copy()),
        **{"weights": np.full(SIZE, 0.5, np.float32), "loss": name, "f_scale": 0.1},
    )
    off = 0.5 * (color - wanted).astype(float)
    value, found = engine_of(arrays(target, color)).value_and_grad(mean_loss(swept))(arrays(target, color))
    assert float(value) == pytest.approx(np.mean([cost(name, r, 0.1) for r in off]), rel=1e-5)
    np.testing.assert_allclose(to_numpy(found), [0.5 * slope(name, r, 0.1) / 3 for r in off], 1e-4)
    value, matrix, half = map(to_numpy, swept.normal_equations(arrays(target, color)))
    assert float(value) == pytest.approx(np.mean([cost(name, r, 0.1) for r in off]), rel=1e-5)
    np.testing.assert_allclose(2 * half, to_numpy(found), 1e-4)
    curvatures = rts.Loss(name, 0.1).weights(off)[1]
    np.testing.assert_allclose(matrix, np.diag(0.25 * curvatures / 3), rtol=1e-4, atol=1e-9)


@losses
@pytest.mark.parametrize("target", ["numpy", *DIFFERENTIABLE])
def test_losses_of_huge_residuals_are_finite_and_right(name, target):
    """In float32, where (r / s)² is too large a number."""
    for s in (1e-10, 1e-3, 0.1, 1e3):
        loss = rts.Loss(name, s)
        for r in (0.9e8 * s, 1.1e8 * s, 1e12, 1e18, -1e20):
            expected = cost(name, r, s), slope(name, r, s)
            given = arrays(target, np.array([r], np.float32))
            assert float(loss(given)) == pytest.approx(expected[0], rel=1e-5)
            weights, curvatures = map(to_numpy, loss.weights(given))
            assert 0 <= curvatures[0] <= weights[0] <= 1
            if target != "numpy":
                np.testing.assert_allclose(gradient(loss, given), [expected[1]], rtol=1e-5, atol=1e-30)


# ------------------------------------------------------------------------------------- other implementations


@pytest.mark.parametrize("name", ("linear", *ROBUST))
def test_cost_and_gradient_are_those_of_scipy(name):
    torch = pytest.importorskip("torch")
    swept = residuals("lambert", 3, loss=name, f_scale=0.1)
    pose = torch.tensor(POSE, dtype=torch.float64)

    def rows(x):
        return torch.func.jacfwd(swept)(torch.tensor(x)).reshape(-1, 6).numpy()

    theirs = least_squares(
        lambda x: swept(torch.tensor(x)).numpy().ravel(), pose.numpy(), rows, loss=name, f_scale=0.1, max_nfev=1
    )
    count = math.prod((*SIZE, 3))
    value, found = engine_of(pose).value_and_grad(mean_loss(swept))(pose)
    assert float(value) == pytest.approx(2 * theirs.cost / count, rel=1e-9)
    np.testing.assert_allclose(found, 2 * theirs.grad / count, rtol=1e-8, atol=1e-14)
    value, _, half = swept.normal_equations(pose)
    assert float(value) == pytest.approx(2 * theirs.cost / count, rel=1e-9)
    np.testing.assert_allclose(half, theirs.grad / count, rtol=1e-8, atol=1e-14)


@losses
def test_the_gradient_is_that_of_finite_differences(name):
    torch = pytest.importorskip("torch")
    image, weights = goal(3)
    ball = rts.Mesh.example().replace(shader="unlit")

    def scene(color):
        return ball.replace(theta={**ball.theta, "color": color})

    swept = rts.ImageResiduals(scene, CAMERA, SIZE, image, weights=weights, loss=name, f_scale=0.3)
    color = torch.tensor([0.3, 0.6, 0.8], dtype=torch.float64)
    step = 1e-6 * torch.eye(3, dtype=torch.float64)
    slopes = [float(mean_loss(swept)(color + h) - mean_loss(swept)(color - h)) / 2e-6 for h in step]
    found = gradient(mean_loss(swept), color)
    np.testing.assert_allclose(found, slopes, rtol=1e-6, atol=1e-9)
    assert np.abs(found).min() > 1e-3


@losses
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"supersample": 2},
        {"background": (0.2, 0.7, 0.1)},
        {"splatter": "single", "layers": 1},
        {"splatter": "multi", "layers": 2},
    ],
    ids=["plain", "finer", "background", "single", "multi"],
)
def test_normal_equations_are_those_of_the_jacobian(name, options):
    torch = pytest.importorskip("torch")
    swept = residuals("lambert", 4, loss=name, f_scale=0.1, **options)
    pose = torch.tensor(POSE, dtype=torch.float64)
    expected = normal_equations(swept, pose, engine_of(pose), swept.loss)
    for a, b in zip(swept.normal_equations(pose), expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-10)
    assert float(torch.linalg.eigvalsh(expected[1]).min()) > 0
    half = gradient(lambda p: mean_loss(swept)(p) / 2, pose)
    np.testing.assert_allclose(expected[2], half, rtol=1e-6, atol=1e-10)


def test_normal_equations_in_a_compiled_program():
    jax, _ = pytest.importorskip("jax"), pytest.importorskip("torch")
    swept = residuals("lambert", 4, loss="huber", f_scale=0.1)
    found = jax.jit(swept.normal_equations)(arrays("jax", POSE))
    for a, b in zip(found, swept.normal_equations(arrays("torch-cpu", POSE)), strict=True):
        np.testing.assert_allclose(to_numpy(a), to_numpy(b), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("sigma", [0.0, 0.8])
def test_stages_have_the_loss_of_their_own_residuals(sigma):
    torch = pytest.importorskip("torch")
    stage = residuals("lambert", 4, loss="cauchy", f_scale=0.1).at_stage(rts.Stage(0.5, supersample=2, sigma=sigma))
    pose = torch.tensor(POSE)
    expected = float(rts.Loss("cauchy", 0.1)(stage(pose)))
    assert stage.loss == rts.Loss("cauchy", 0.1)
    assert float(mean_loss(stage)(pose)) == pytest.approx(expected, rel=1e-5)
    assert float(stage.normal_equations(pose)[0]) == pytest.approx(expected, rel=1e-5)


def test_normal_equations_are_bitwise_the_same_on_any_number_of_threads(monkeypatch):
    torch = pytest.importorskip("torch")
    image = np.random.default_rng(0).random((144, 184, 4)).astype(np.float32)
    swept = rts.ImageResiduals(lambda p: moving(p, "lambert"), CAMERA, (144, 184), image, loss="huber", f_scale=0.2)
    found = []
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("RTS_NUM_THREADS", threads)
        found.append(torch.cat([x.reshape(-1) for x in swept.normal_equations(torch.tensor(POSE))]))
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


# --------------------------------------------------------------------------------------------------------- fits


BALL = icosphere(2, 0.8)
SHIFT = np.float32([0.05, -0.03, 0.1])


def shifted(shift):
    vertices = engine_of(shift).constant(BALL[0], shift) + shift
    return rts.Part(rts.Mesh(BALL[1]), {"vertices": vertices}, "silhouette")


def cut_mask(side):
    """The mask of a ball of which the right sixth is hidden, and how much of it."""
    camera = rts.Camera.look_at((0.5, 0.9, 3), (0, 0, 0), fov_y=40)
    whole = rts.render(shifted(SHIFT), camera, (side, side), supersample=4)[..., 3]
    mask = whole.copy()
    mask[:, np.nonzero(whole > 0.5)[1].max() - side // 8 :] = 0
    return camera, mask, 1 - mask.sum() / whole.sum()


@pytest.mark.parametrize("method", ["lm", "adam", "sgd"])
def test_a_place_is_found_though_a_part_of_the_mask_is_hidden(method):
    torch = pytest.importorskip("torch")
    camera, mask, hidden = cut_mask(48)
    assert 0.14 < hidden < 0.18
    rate = {"lm": None, "adam": 0.005, "sgd": 0.3}[method]
    off = {}
    for name in ("linear", "cauchy"):
        found = rts.fit(
            rts.ImageResiduals(shifted, camera, mask.shape, mask, supersample=2, loss=name, f_scale=0.1),
            torch.tensor(SHIFT + np.float32([0.03, -0.04, -0.05])),
            **{"method": method, "steps": 60, "learning_rate": rate, "progress": False},
        )
        off[name] = np.linalg.norm(found.parameters.numpy() - SHIFT)
    assert off["cauchy"] < 0.5 * off["linear"]


@targets
@pytest.mark.parametrize("method", ["lm", "adam"])
def test_a_line_through_points_of_which_some_are_wrong(target, method):
    """Residuals are a function of one's own; the least squares are off by one tenth of the outliers."""
    x = np.linspace(-1, 1, 40)
    points = arrays(target, np.where(np.arange(40) % 10 == 3, 4.0, 0.5 + 2 * x))
    powers = arrays(target, np.stack([np.ones(40), x], 1))

    def off(p):
        return powers @ p - points

    loss, start = rts.Loss("cauchy", 0.1), arrays(target, np.array([0.0, 1.0]))
    options = {"method": method, "steps": 600, "progress": False, "tolerance": 0.0}
    if method == "adam":
        options["learning_rate"] = 0.05
    found = rts.fit(off, start, loss=loss, **options)
    theirs = least_squares(lambda p: to_numpy(off(arrays(target, p))), [0.5, 2.0], loss="cauchy", f_scale=0.1)
    np.testing.assert_allclose(to_numpy(found.parameters), theirs.x, atol=1e-3)
    np.testing.assert_allclose(to_numpy(found.parameters), [0.5, 2], atol=0.02)
    assert np.abs(to_numpy(rts.fit(off, start, **options).parameters) - [0.5, 2]).max() > 0.2
    assert found.loss == pytest.approx(2 * theirs.cost / 40, rel=1e-4)


@losses
def test_levenberg_marquardt_comes_back_from_trials_with_huge_residuals(name):
    """Colours are exp(p), of which the first step is far too long; compiled and by the Jacobian."""
    torch = pytest.importorskip("torch")
    vertices, faces = quad(-9, 9, -9, 9, 0)
    part = rts.Part(rts.Mesh(faces), {"vertices": vertices}, "unlit")
    target = np.full((*SIZE, 3), 0.5, np.float32)
    swept = rts.ImageResiduals(
        lambda p: part.replace(theta={"vertices": vertices, "color": torch.exp(p)}), CAMERA, SIZE, target, loss=name
    )
    for own, start in ((swept, -2.5), (lambda p: torch.exp(p) - 0.5, -2.5), (lambda p: torch.exp(p) - 0.5, -3.7)):
        found = rts.fit(own, torch.full((3,), start), method="lm", loss=rts.Loss(name, 0.1), progress=False)
        assert max(found.history) > 10 * found.history[0] and found.loss < 1e-6
        np.testing.assert_allclose(found.parameters.exp(), 0.5, atol=1e-3)


@losses
def test_normal_equations_of_residuals_without_a_weight_are_finite(name):
    torch = pytest.importorskip("torch")
    pose, given = torch.tensor(POSE), {"loss": name, "f_scale": 1e-10}
    swept = residuals("lambert", 4, weights=np.full((*SIZE, 1), 1e15, np.float32), **given)
    for found in (swept.normal_equations(pose), normal_equations(swept, pose, engine_of(pose), swept.loss)):
        assert all(bool(torch.isfinite(x).all()) for x in found) and float(found[0]) > 0


class Off(rts.Residuals):
    """p less a point, with normal equations for the loss that it says."""

    def __init__(self, loss):
        self.loss = loss

    def __call__(self, p):
        return p - arrays("torch-cpu", np.array([0.0, 0.0, 9.0]))

    def normal_equations(self, p):
        return normal_equations(self, p, engine_of(p), self.loss or rts.Loss())


class Staged(Off):
    """Residuals of which every stage is another object."""

    def __init__(self, loss, stages):
        super().__init__(loss)
        self.stages = stages

    def at_stage(self, stage):
        return self.stages


HUBER = rts.Loss("huber", 0.5)


@pytest.mark.parametrize("method", ["lm", "adam"])
@pytest.mark.parametrize(
    ("outer", "inner", "given", "expected"),
    [
        (None, HUBER, None, HUBER),
        (rts.Loss("cauchy"), HUBER, None, HUBER),
        (HUBER, None, None, HUBER),
        (None, HUBER, rts.Loss(), rts.Loss()),
        (None, None, HUBER, HUBER),
    ],
)
def test_each_stage_has_its_own_loss(method, outer, inner, given, expected):
    torch = pytest.importorskip("torch")
    options = {"method": method, "steps": 20, "progress": False, "schedule": [rts.Stage()], "loss": given}
    found = rts.fit(Staged(outer, Off(inner)), torch.zeros(3), **options)
    assert found.history[0] == pytest.approx(float(expected(torch.tensor([0.0, 0.0, -9.0]))))
    assert found.loss < found.history[0]


def test_residuals_of_ones_own_may_say_their_loss():
    torch = pytest.importorskip("torch")

    class Off(rts.Residuals):
        loss = rts.Loss("huber", 0.5)

        def __call__(self, p):
            return p - torch.tensor([0.0, 0.0, 9.0])

    class Unrelated:  # No `rts.Residuals`: a function, of which nothing else is looked at.
        def loss(self):
            raise AssertionError

        def __call__(self, p):
            return p - torch.tensor([0.0, 0.0, 9.0])

    start, options = torch.zeros(3), {"steps": 1, "progress": False}
    for method in ("lm", "adam"):
        assert rts.fit(Off(), start, method=method, **options).loss == pytest.approx((9 - 0.25) / 3)
        assert rts.fit(Off(), start, method=method, loss=rts.Loss(), **options).loss == pytest.approx(27)
        assert rts.fit(Unrelated(), start, method=method, **options).loss == pytest.approx(27)
    for loss in ("huber", 3, abs):
        Off.loss, Unrelated.loss = staticmethod(loss) if loss is abs else loss, loss
        with pytest.raises(InputError, match="the residuals' loss is .*; expected an rts.Loss, or None"):
            rts.fit(Off(), start, **options)
        assert rts.fit(Off(), start, loss=rts.Loss(), **options).loss == pytest.approx(27)
        assert rts.fit(Unrelated(), start, **options).loss == pytest.approx(27)


def test_another_loss_than_that_of_the_image_is_taken_of_its_residuals():
    torch = pytest.importorskip("torch")
    swept, pose = residuals("lambert", 4, loss="huber", f_scale=0.1), torch.tensor(POSE)
    for method in ("lm", "adam"):
        own = rts.fit(swept, pose, method=method, steps=1, progress=False)
        assert own.loss == pytest.approx(float(swept.loss(swept(pose))), rel=1e-5)
        other = rts.fit(swept, pose, method=method, loss=rts.Loss(), steps=1, progress=False)
        assert other.loss == pytest.approx(float((swept(pose) ** 2).mean()), rel=1e-5)


def test_a_subclass_with_more_residuals_has_the_normal_equations_of_all_of_them():
    torch = pytest.importorskip("torch")

    class Held(rts.ImageResiduals):
        def __call__(self, parameters):
            return torch.cat([super().__call__(parameters).reshape(-1), 3 * parameters])

    image, weights = goal(1)
    given = {"weights": [weights] * 2, "loss": "huber"}
    swept = Held(lambda p: moving(p, "silhouette"), [CAMERA, CAMERA], SIZE, [image] * 2, **given)
    pose = torch.tensor(POSE)
    value, found = engine_of(pose).value_and_grad(mean_loss(swept))(pose)
    equations = swept.normal_equations(pose)
    torch.testing.assert_close(equations[0], value)
    torch.testing.assert_close(2 * equations[2], found, rtol=1e-4, atol=1e-7)


def test_images_have_a_scale_that_suits_them():
    assert residuals(loss="huber").loss == rts.Loss("huber", 0.1)
    assert residuals(loss=rts.Loss("huber", 0.3)).loss == rts.Loss("huber", 0.3)
    assert residuals(f_scale=0.2).loss == rts.Loss() == rts.Loss("linear", 0.2)
    assert residuals(loss="huber").loss == rts.Loss("huber") == rts.Loss("huber", 0.1)
    with pytest.raises(InputError, match="loss is .*and f_scale 0.2; expected one of them to say the scale"):
        residuals(loss=rts.Loss("huber"), f_scale=0.2)
    with pytest.raises(AttributeError):
        residuals().loss = rts.Loss("huber")


# ------------------------------------------------------------------------------------------------------- misuse


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"loss": "square"}, "loss is 'square'; expected one of linear, soft_l1, huber, cauchy"),
        ({"loss": None}, "loss is None; expected one of"),
        ({"loss": "huber", "f_scale": 0}, "f_scale is 0; expected a positive number from 1e-10 to 1e.10"),
        ({"loss": "huber", "f_scale": -0.1}, "f_scale is -0.1"),
        ({"loss": "huber", "f_scale": math.inf}, "f_scale is inf"),
        ({"loss": "cauchy", "f_scale": math.nan}, "f_scale is nan"),
        ({"loss": "cauchy", "f_scale": "wide"}, "f_scale is 'wide'"),
        ({"f_scale": 0}, "f_scale is 0"),
        ({"loss": "huber", "f_scale": 10**400}, "f_scale is 10+.*; expected a positive number"),
        ({"loss": "huber", "f_scale": Fraction(1, 10**400)}, "f_scale is .*; expected a positive number"),
        ({"loss": "huber", "f_scale": 1e40}, r"f_scale is 1e.40; expected a positive number from 1e-10 to 1e.10"),
        ({"loss": "huber", "f_scale": 1e-20}, "f_scale is 1e-20"),
    ],
)
def test_losses_that_are_none_are_refused(options, expected):
    with refused(expected):
        residuals(**options)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (np.array([1, 2]), "residuals has dtype int64; expected floating numbers"),
        (np.zeros((0, 3)), r"residuals has shape \(0, 3\); expected an array of floats, of at least one"),
        (2.0, "residuals is a float; expected an array of floats"),
        (None, "residuals is a NoneType; expected an array of floats"),
    ],
)
def test_residuals_that_have_no_loss_are_refused(given, expected):
    for call in (rts.Loss("huber"), rts.Loss().weights):
        with pytest.raises(InputError, match=expected):
            call(given)
    assert float(rts.Loss("huber", 0.5)([0.5, 1, -1])) == pytest.approx((0.25 + 2 * 0.75) / 3)


def test_losses_are_values():
    loss = rts.Loss("huber", np.float32(0.5))
    assert loss == rts.Loss("huber", 0.5) and hash(loss) == hash(rts.Loss("huber", 0.5)) and loss.robust
    assert not rts.Loss().robust and rts.Loss() == rts.Loss("linear", 1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        loss.f_scale = 1.0
