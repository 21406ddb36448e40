"""Schedules of fits: sizes of stages, what targets and weights become, and fits that a schedule leads home."""

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, box, quad, to_numpy

import rts
from rts.errors import InputError
from rts.fitting.schedule import blurred, box_filtered
from rts.fitting.targets import shrunk

pytestmark = pytest.mark.fitting

torch_targets = pytest.mark.parametrize("target", [t for t in DIFFERENTIABLE if t != "jax"])
"""For what takes the same way in every engine: jax compiles for seconds."""

CAMERA = rts.Camera.look_at((0.9, 0.8, 2.2), (0, 0, 0), fov_y=45)
POSE = np.array([0.12, -0.18, 0.1, 0.06, -0.05, 0.08])


def mesh(vertices, faces, shader="silhouette", **theta):
    return rts.Part(rts.plugin("rts.surfaces", "mesh")(faces), {"vertices": vertices, **theta}, shader)


def block(shader="silhouette"):
    vertices, faces = box(0.5)
    vertices = vertices * np.array([1.5, 0.9, 0.6], np.float32)
    colors = np.random.default_rng(0).random((8, 3)).astype(np.float32)
    return mesh(vertices, faces, shader, colors=colors)


def turned(size, *, channels=1, camera=CAMERA, **options):
    """Residuals of a block's pose, whose target is the block at POSE."""
    part = block("silhouette" if channels == 1 else "unlit")
    moved = lambda p: part.replace(transform=rts.rigid(p))  # noqa: E731
    goal = rts.render(moved(POSE), camera, size)
    return rts.ImageResiduals(moved, camera, size, goal[..., 3] if channels == 1 else goal[..., :channels], **options)


# ------------------------------------------------------------------------------------------------------ stages


@pytest.mark.parametrize(
    ("size", "options", "sides"),
    [
        ((256, 256), {}, [16, 32, 64, 128, 256]),
        ((100, 320), {"largest": 256}, [16, 32, 64, 128, 256]),
        ((320, 100), {"coarsest": 100}, [160, 320]),
        ((97, 31), {}, [24, 48, 97]),
        ((20, 12), {}, [20, 20]),
        ((7, 5), {"coarsest": 1}, [1, 3, 7]),
    ],
)
def test_a_pyramid_doubles_from_its_coarsest_side(size, options, sides):
    stages = rts.pyramid(size, **options)
    found = [stage.size(size) for stage in stages]
    assert [max(s) for s in found] == sides
    for height, width in found:
        assert abs(height - width * size[0] / size[1]) <= max(1, size[0] / size[1])
    assert [stage.sigma for stage in stages] == [sides[0] / 16, *[0] * (len(sides) - 1)]
    assert stages[-1].supersample is None and all(stage.supersample > 1 for stage in stages[:-1])


def test_pixels_that_overlap_in_part_count_by_their_share():
    image = np.array([[1.0], [2.0], [4.0]]).reshape(1, 3, 1)
    np.testing.assert_allclose(box_filtered(image, (1, 2))[0, :, 0], [4 / 3, 10 / 3])
    image = np.random.default_rng(1).random((12, 15, 4))
    blocks = image.reshape(4, 3, 3, 5, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(box_filtered(image, (4, 3)), blocks, rtol=1e-12)
    # Areas under a row, read off its running sum.
    sums = np.concatenate([[0], np.cumsum(image[0, :, 0])])
    shares = np.diff(np.interp(np.arange(8) * 15 / 7, np.arange(16), sums)) * 7 / 15
    np.testing.assert_allclose(box_filtered(image[:1], (1, 7))[0, :, 0], shares, rtol=1e-12)
    np.testing.assert_array_equal(box_filtered(image, (12, 15)), image)


def test_a_blur_is_a_gaussian_of_unit_weight():
    image = np.zeros((41, 61, 1))
    image[20, 30] = 1
    found = blurred(image, 3.0)[..., 0]
    y, x = np.indices(found.shape)
    expected = np.exp(-((y - 20) ** 2 + (x - 30) ** 2) / 18)
    np.testing.assert_allclose(found, expected / expected.sum(), atol=1e-5)
    assert found.sum() == pytest.approx(1)


@pytest.mark.parametrize("target", ["numpy", *DIFFERENTIABLE])
def test_weighted_targets_keep_the_sum_of_squares_but_for_a_constant(target):
    rng = np.random.default_rng(2)
    goal, weights = rng.random((12, 10, 3)), rng.random((12, 10)) * (rng.random((12, 10)) > 0.3)
    weights[:3, :5] = 0
    small, factors = map(to_numpy, shrunk(arrays(target, goal), arrays(target, weights), (4, 2)))
    assert small.shape == (4, 2, 3) and factors.shape == (4, 2) and factors[0, 0] == 0
    assert np.isfinite(small).all()

    def coarse(image):
        return 15 * ((factors[..., None] * (image - small)) ** 2).sum()

    def fine(image):
        return ((weights[..., None] * (np.kron(image, np.ones((3, 5, 1))) - goal)) ** 2).sum()

    one, other = rng.random((2, 4, 2, 3))
    assert coarse(one) - coarse(other) == pytest.approx(fine(one) - fine(other), rel=1e-4)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("aspect", [None, 43 / 57])
def test_a_stage_sees_what_the_whole_image_sees(channels, aspect):
    size = 57, 43
    camera = rts.Camera.look_at((0.9, 0.8, 2.2), (0, 0, 0), fov_y=45, aspect=aspect)
    weights = np.ones((*size, channels), np.float32)
    whole = turned(size, channels=channels, camera=camera, weights=weights, background=np.zeros((*size, 4), np.float32))
    stage = whole.at_stage(rts.Stage(0.2, supersample=6))  # Warnings are errors.
    assert stage.size == (11, 9) and stage.supersample == 6
    found = np.abs(stage(POSE))
    assert found.shape == ((11, 9) if channels == 1 else (11, 9, channels))
    # Of coarse pixels a point-sampled outline is off by a fifth of one; half a pixel of shift would be twice as much.
    assert found.max() < 0.2 and found.mean() < 0.015
    assert whole.size == size and np.abs(whole(POSE)).max() < 1e-6


@torch_targets
def test_normal_equations_of_a_stage_are_those_of_its_jacobian(target):
    residuals = turned((40, 36), channels=4, splatter="single").at_stage(rts.Stage(0.3, 2, 0.7))
    pose = arrays(target, POSE * 0.8)
    engine = rts.engine_of(pose)
    value, matrix, gradient = map(to_numpy, engine.jit(residuals.normal_equations)(pose))
    r, rows = engine.jit(engine.jacobian(lambda p: rts.namespace(p).reshape(residuals(p), (-1,))))(pose)
    r, rows = to_numpy(r), to_numpy(rows)
    plain = to_numpy(turned((40, 36), channels=4, splatter="single").at_stage(rts.Stage(0.3, 2))(pose))
    np.testing.assert_allclose(r, blurred(plain, 0.7).ravel(), atol=1e-6)
    np.testing.assert_allclose(matrix, rows @ rows.T / len(r), rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(gradient, rows @ r / len(r), rtol=1e-3, atol=1e-6)
    assert value == pytest.approx(float((r * r).mean()), rel=1e-4)


# -------------------------------------------------------------------------------------------------------- fits


@pytest.mark.parametrize(("method", "target"), [(m, t) for t in DIFFERENTIABLE for m in ("lm", "adam")][:-1])
def test_one_stage_is_no_schedule_bit_for_bit(method, target):
    residuals, start = turned((24, 24), splatter="single"), arrays(target, np.zeros(6))
    plain = rts.fit(residuals, start, method=method, steps=6)
    staged = rts.fit(residuals, start, method=method, steps=6, schedule=[rts.Stage()])
    assert staged.history == plain.history and staged.reason == plain.reason and staged.loss == plain.loss
    np.testing.assert_array_equal(to_numpy(staged.parameters), to_numpy(plain.parameters))
    assert plain.stages == staged.stages == (plain.steps,)


def comb(teeth=7, pixel=1 / 16):
    """Teeth of three pixels, six apart, on an image of 32 × 64."""
    quads = [quad(6 * k * pixel, (6 * k + 3) * pixel, -0.6, 0.6) for k in range(teeth)]
    vertices = np.concatenate([v for v, _ in quads]) - [3 * teeth * pixel, 0, 0]
    faces = np.concatenate([f + 4 * k for k, (_, f) in enumerate(quads)])
    part = mesh(vertices.astype(np.float32), faces)
    camera = rts.Camera.orthographic((0, 0, 5), (0, 0, 0), height=2, near=1, far=9)

    def moved(x):
        xp = rts.namespace(x)
        return part.replace(transform=rts.rigid(xp.concat([xp.zeros_like(x) for _ in range(3)] + [x, 0 * x, 0 * x])))

    goal = rts.render(moved(np.zeros(1)), camera, (32, 64), supersample=4)[..., 3]
    return rts.ImageResiduals(moved, camera, (32, 64), goal, supersample=4)


@pytest.mark.thorough
@torch_targets
def test_a_pyramid_finds_the_tooth_that_fine_ones_miss(target):
    residuals, start = comb(), arrays(target, np.array([8 / 16]))
    plain = rts.fit(residuals, start, method="lm", jit=False)
    assert abs(float(plain.parameters[0])) > 4 / 16
    fit = rts.fit(residuals, start, method="lm", jit=False, schedule=rts.pyramid((32, 64)))
    assert abs(float(fit.parameters[0])) < 0.1 / 16
    assert fit.loss < plain.loss / 100
    blurs = [rts.Stage(sigma=6), rts.Stage()]
    assert abs(float(rts.fit(residuals, start, method="lm", jit=False, schedule=blurs).parameters[0])) < 0.1 / 16


def test_a_fit_says_what_it_did_at_each_stage():
    torch = pytest.importorskip("torch")
    residuals, seen = turned((48, 48), splatter="single"), []
    schedule = [rts.Stage(0.25), rts.Stage(0.5), rts.Stage()]
    fit = rts.fit(
        residuals, torch.zeros(6), method="lm", schedule=schedule, callback=lambda *given: seen.append(given), steps=9
    )
    assert len(fit.stages) == 3 and max(fit.stages) <= 9
    assert fit.steps == sum(fit.stages) == len(fit.history)
    assert [(step, loss) for step, _, loss in seen] == list(enumerate(fit.history))
    firsts = np.cumsum((0, *fit.stages))
    ends = [fit.history[a:b] for a, b in zip(firsts, firsts[1:], strict=False)]
    assert fit.loss == min(ends[-1])
    # A stage begins at the best of the one before.
    best = seen[int(firsts[1] + np.argmin(ends[1]))][1]
    np.testing.assert_array_equal(seen[firsts[2]][1], best)
    np.testing.assert_allclose(float((residuals(best) ** 2).mean()), ends[2][0], rtol=1e-4)
    assert f"in {fit.steps} steps ({' + '.join(map(str, fit.stages))})" in repr(fit)
    assert repr(fit).startswith("loss of the last stage ")


@pytest.mark.parametrize("method", ["lm", "adam"])
@pytest.mark.parametrize("last", [0, 4])
def test_a_callback_stops_all_stages(method, last):
    torch = pytest.importorskip("torch")
    fit = rts.fit(
        turned((24, 24)),
        torch.zeros(6),
        method=method,
        steps=3,
        tolerance=0,
        schedule=[rts.Stage(0.5)] * 4,
        callback=lambda step, p, loss: step == last,
    )
    assert fit.steps == last + 1 and fit.stages == ((1,) if last == 0 else (3, 2))
    assert fit.reason.startswith("the callback asked to")


def test_jax_goes_through_the_stages_that_torch_does():
    residuals, schedule = turned((20, 20), splatter="single"), [rts.Stage(0.5, 2, 1.0), rts.Stage()]
    ours, theirs = (
        rts.fit(residuals, arrays(target, np.zeros(6)), method="lm", steps=4, schedule=schedule)
        for target in ("jax", "torch-cpu")
    )
    assert ours.stages == theirs.stages == (4, 4) and ours.loss < ours.history[0]
    np.testing.assert_allclose(ours.history, theirs.history, rtol=1e-2)


class Line(rts.Residuals):
    """Residuals of one's own: p − goal, where coarse stages are off, and see nothing but a wall beyond 5."""

    def __init__(self, off=0.0, wall=None):
        self.off, self.wall = off, wall

    def __call__(self, p):
        if self.wall is not None and float(p[0].detach()) > self.wall:
            raise InputError("beyond the wall")
        return p - 3 - self.off

    def at_stage(self, stage):
        return Line(self.off + (1 - stage.scale), None if stage.scale < 1 else self.wall)


@pytest.mark.parametrize("method", ["lm", "sgd"])
def test_residuals_of_ones_own_have_stages(method):
    torch = pytest.importorskip("torch")
    schedule = [rts.Stage(0.5), rts.Stage()]
    options = {"method": method, "steps": 40, "learning_rate": 0.3 if method == "sgd" else None}
    fit = rts.fit(Line(), torch.zeros(1), schedule=schedule, **options)
    assert float(fit.parameters[0]) == pytest.approx(3, abs=1e-4)
    assert fit.history[fit.stages[0]] == pytest.approx(0.25, rel=1e-3)
    # What the coarse stage found is kept where the next one cannot begin.
    fit = rts.fit(Line(wall=3.2), torch.zeros(1), schedule=schedule, jit=False, **options)
    assert float(fit.parameters[0]) == pytest.approx(3.5, abs=1e-3)
    assert fit.reason.startswith("beyond the wall") and fit.stages[1] == 0 and fit.loss == min(fit.history)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"scale": 0}, r"scale is 0; expected a share"),
        ({"scale": 1.5}, r"scale is 1.5; expected a share"),
        ({"scale": None}, r"scale is None; expected a share"),
        ({"scale": float("nan")}, r"scale is nan; expected a share"),
        ({"supersample": 0}, r"supersample is 0; expected an integer"),
        ({"supersample": 1.5}, r"supersample is 1.5; expected an integer"),
        ({"supersample": "adaptive"}, r"supersample is 'adaptive'; expected an integer of at least 1, or None"),
        ({"sigma": -1}, r"sigma is -1; expected a number of pixels"),
        ({"sigma": float("inf")}, r"sigma is inf; expected a number of pixels"),
        ({"sigma": "wide"}, r"sigma is 'wide'; expected a number of pixels"),
    ],
)
def test_stages_of_nonsense_are_refused(options, expected):
    with pytest.raises(InputError, match=expected):
        rts.Stage(**options)


def test_schedules_that_cannot_be_followed_are_refused_before_work_starts():
    torch = pytest.importorskip("torch")
    start, calls = torch.zeros(6), []
    residuals = turned((24, 24))
    for wrong in ([], "pyramid", rts.Stage(), [0.5, 1.0], 3):
        with pytest.raises(InputError, match=r"schedule is .*; expected a list of rts.Stage"):
            rts.fit(residuals, start, schedule=wrong, callback=lambda *a: calls.append(a))
    with pytest.raises(InputError, match=r"whose resolution nobody knows; with a schedule pass rts.ImageResiduals"):
        rts.fit(lambda p: p, start, schedule=rts.pyramid((64, 64)))

    class Nothing(Line):
        def at_stage(self, stage):
            return None

    with pytest.raises(InputError, match="what at_stage gave is None; expected a function of the parameters, or "):
        rts.fit(Nothing(), start, schedule=[rts.Stage()])
    for size, options in (((0, 4), {}), ((64, 64), {"coarsest": 0}), ((64, 64), {"largest": 2.5})):
        with pytest.raises(InputError, match=r"expected .*pixels|coarsest|largest|size"):
            rts.pyramid(size, **options)
    assert not calls
