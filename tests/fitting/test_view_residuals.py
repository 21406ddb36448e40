"""Residuals of pictures from many views: what they draw, read and compare."""

import numpy as np
import pytest
from helpers import DIFFERENTIABLE, arrays, box, quick, to_numpy

import rts
from rts.arrays.engines import engine_of, namespace
from rts.errors import FileWarning, InputError, InputWarning

pytestmark = pytest.mark.fitting

targets = pytest.mark.parametrize("target", quick(DIFFERENTIABLE))
SIZE = (20, 26)
EYES = np.array([[0.3, 0.4, 3], [3, 0.2, 0.4], [-0.5, 0.3, -3], [-3, 0.6, 0.2], [0.2, 3, 0.6]])
CAMERAS = [rts.Camera.look_at(eye, (0, 0, 0), fov_y=45, aspect=26 / 20) for eye in EYES]
VERTICES, FACES = box()
LIGHT = {"direction": np.array([0.3, 0.8, 0.5], np.float32)}


def part(parameters, shader="lambert"):
    """A box that a pose moves."""
    theta = {"vertices": np.asarray(VERTICES, np.float32), "light": LIGHT}
    return rts.Part(rts.Mesh(FACES), theta, shader, transform=rts.rigid(parameters["pose"]))


STILL = {"pose": np.zeros(6, np.float32)}
IMAGES = [rts.render(part(STILL), camera, SIZE) for camera in CAMERAS]


SMOOTH = [rts.render(part(STILL), camera, SIZE, supersample=2) for camera in CAMERAS]
"""Pictures that fits with two samples a pixel along each side can reach."""


def views(images=IMAGES, **options):
    pairs = enumerate(zip(CAMERAS, images, strict=True))
    return [rts.View(camera, image, name=f"{i}.png", **options) for i, (camera, image) in pairs]


TURNS = np.float32([0.0, 0.4, -0.3, 0.8, 0.1])


def turned(parameters, number, turns=TURNS):
    """A box that a pose moves, turned in each view by an angle of its own."""
    xp = namespace(parameters["pose"])
    angle = xp.take(engine_of(parameters["pose"]).constant(turns, parameters["pose"]), xp.asarray(number)[None])
    return part({"pose": xp.concat([parameters["pose"][:2], parameters["pose"][2:3] + angle, parameters["pose"][3:]])})


def moved(target):
    return arrays(target, {"pose": np.array([0.1, -0.05, 0.08, 0.03, 0.02, -0.04])})


# ------------------------------------------------------------------------------------------------------- terms


@targets
def test_scenes_may_differ_from_view_to_view(target):
    p = moved(target)
    residuals = rts.ViewResiduals(turned, views(), per_view=True)
    for number, turn in enumerate(TURNS):
        alone = rts.ImageResiduals(lambda q: turned(q, 0, [turn]), CAMERAS[number], SIZE, IMAGES[number])  # noqa: B023
        found = residuals.of(residuals.load((number, None)))
        np.testing.assert_allclose(to_numpy(found(p)), to_numpy(alone(p)), atol=1e-6)
    images = [rts.render(turned(STILL, i), camera, SIZE) for i, camera in enumerate(CAMERAS)]
    residuals = rts.ViewResiduals(turned, views(images), per_view=True)
    fit = rts.fit(residuals, p, method="lm", steps=8)
    np.testing.assert_allclose(to_numpy(fit.parameters["pose"]), STILL["pose"], atol=2e-3)


@targets
def test_each_view_is_an_image_residual(target):
    p = moved(target)
    residuals = rts.ViewResiduals(part, views(), loss="huber", weights=np.arange(1, 6))
    assert len(residuals.draw(0)) == 5 and residuals.loss == rts.Loss("huber", 0.1)
    for number in (0, 3):
        own = rts.ImageResiduals(
            part, CAMERAS[number], SIZE, IMAGES[number], weights=np.full(SIZE, number + 1, np.float32), loss="huber"
        )
        of = residuals.of(residuals.load((number, None)))
        np.testing.assert_allclose(to_numpy(of(p)), to_numpy(own(p)), atol=1e-6)
        for a, b in zip(of.normal_equations(p), own.normal_equations(p), strict=True):
            np.testing.assert_allclose(to_numpy(a), to_numpy(b), rtol=1e-5, atol=1e-7)


def test_called_it_gives_all_differences_in_a_row():
    p = moved("torch-cpu")
    residuals = rts.ViewResiduals(part, views())
    expected = np.concatenate(
        [to_numpy(rts.ImageResiduals(part, c, SIZE, i)(p)).ravel() for c, i in zip(CAMERAS, IMAGES, strict=True)]
    )
    np.testing.assert_allclose(to_numpy(residuals(p)), expected, atol=1e-6)


@targets
def test_a_window_is_the_differences_there(target):
    p = moved(target)
    whole = rts.ViewResiduals(part, views())
    residuals = rts.ViewResiduals(part, views(), batch=5, window=(8, 10), seed=3)
    corners = set()
    for number, corner in residuals.draw(2):
        top, left = corner
        corners.add(corner)
        own = to_numpy(residuals.of(residuals.load((number, corner)))(p))
        expected = to_numpy(whole.of(whole.load((number, None)))(p))[top : top + 8, left : left + 10]
        np.testing.assert_allclose(own, expected, atol=1e-5)
    assert len(corners) > 2


def test_draws_go_through_all_views_and_repeat_by_their_seed():
    residuals = rts.ViewResiduals(part, views(), batch=2, seed=1)
    drawn = [residuals.draw(step) for step in range(50)]
    numbers = [number for keys in drawn for number, _ in keys]
    for epoch in range(20):
        assert sorted(numbers[5 * epoch : 5 * epoch + 5]) == list(range(5))
    assert len({tuple(numbers[5 * epoch : 5 * epoch + 5]) for epoch in range(20)}) > 10
    again = rts.ViewResiduals(part, views(), batch=2, seed=1)
    assert [again.draw(step) for step in (7, 3)] == [drawn[7], drawn[3]]
    assert [rts.ViewResiduals(part, views(), batch=2, seed=2).draw(step) for step in range(5)] != drawn[:5]


@targets
@pytest.mark.parametrize("method", ["adam", "lm"])
def test_a_pose_is_found_from_several_views(target, method):
    options = {"batch": 3, "supersample": 2} if method == "adam" else {"supersample": 2}
    residuals = rts.ViewResiduals(part, views(SMOOTH), **options)
    steps, rate = (60, 0.01) if method == "adam" else (15, None)
    fit = rts.fit(residuals, moved(target), method=method, steps=steps, learning_rate=rate)
    assert np.abs(to_numpy(fit.parameters)["pose"]).max() < (0.02 if method == "adam" else 0.004)


@targets
def test_cameras_may_be_fitted(target):
    shift = np.zeros((5, 6), np.float32)
    shift[:, 3:] = np.random.default_rng(0).normal(size=(5, 3)) * 0.03
    residuals = rts.ViewResiduals(
        lambda p: part(STILL),
        views(SMOOTH),
        cameras=lambda p, camera, i: camera.within(rts.rigid(p["cameras"][i])),
        supersample=2,
    )
    fit = rts.fit(residuals, arrays(target, {"cameras": shift}), method="lm", steps=12)
    assert fit.loss < 0.05 * fit.history[0]


@targets
def test_gain_and_offset_of_a_view(target):
    gain, offset = np.array([1.0, 0.5, 1, 1, 1], np.float32), np.zeros((5, 3), np.float32)
    offset[1] = 0.2, 0.0, 0.1
    exposed = views()
    image = IMAGES[1].copy()
    image[..., :3] = 0.5 * image[..., :3] + offset[1] * image[..., 3:]
    exposed[1] = rts.View(CAMERAS[1], image)
    # The true gain and offset leave no difference.
    p = arrays(target, {"gain": gain, "offset": offset})
    residuals = rts.ViewResiduals(lambda p: part(STILL), exposed, exposure=lambda p: (p["gain"], p["offset"]))
    np.testing.assert_allclose(to_numpy(residuals(p)), 0, atol=1e-5)
    start = arrays(target, {"gain": np.ones(5), "offset": np.zeros((5, 3))})
    fit = rts.fit(residuals, start, method="lm", steps=10)
    np.testing.assert_allclose(to_numpy(fit.parameters)["gain"], gain, atol=2e-3)
    np.testing.assert_allclose(to_numpy(fit.parameters)["offset"], offset, atol=2e-3)


def test_exposures_that_do_not_fit():
    p = moved("torch-cpu")
    for exposure, expected in (
        (lambda p: p["pose"], "no pair"),
        (lambda p: (p["pose"], None), r"gain of shape \(6,\); expected \(5,\)"),
    ):
        residuals = rts.ViewResiduals(part, views(), exposure=exposure)
        with pytest.raises(InputError, match=expected):
            residuals(p)


@targets
def test_masks_leave_pixels_out(target):
    mask = np.ones(SIZE, np.float32)
    mask[:, :13] = 0
    spoiled = [image.copy() for image in IMAGES]
    for image in spoiled:
        image[:, :13] = 0.7
    masked = [rts.View(c, image, mask=mask) for c, image in zip(CAMERAS, spoiled, strict=True)]
    p = moved(target)
    own, clean = rts.ViewResiduals(part, masked), rts.ViewResiduals(part, views())
    expected = to_numpy(clean(p)).reshape(5, *SIZE, 4) * mask[..., None]
    np.testing.assert_allclose(to_numpy(own(p)).reshape(5, *SIZE, 4), expected, atol=1e-6)


def test_a_target_of_ones_own():
    p = moved("torch-cpu")
    residuals = rts.ViewResiduals(part, views(), target=lambda view: view.image[..., 3])
    own = rts.ImageResiduals(part, CAMERAS[2], SIZE, IMAGES[2][..., 3])
    np.testing.assert_allclose(to_numpy(residuals.of(residuals.load((2, None)))(p)), to_numpy(own(p)), atol=1e-6)


def test_stages_are_those_of_images():
    p = moved("torch-cpu")
    stage = rts.Stage(0.5, supersample=2, sigma=1.0)
    residuals = rts.ViewResiduals(part, views()).at_stage(stage)
    own = rts.ImageResiduals(part, CAMERAS[2], SIZE, IMAGES[2]).at_stage(stage)
    of = residuals.of(residuals.load((2, None)))
    assert residuals.supersample == 2 and tuple(of(p).shape) == (10, 13, 4)
    np.testing.assert_allclose(to_numpy(of(p)), to_numpy(own(p)), atol=1e-6)


@pytest.mark.thorough
def test_jax_compiles_once_for_all_views_of_a_size():
    jax = pytest.importorskip("jax")
    traces = []

    def scene(p):
        traces.append(1)
        return part(p)

    p = moved("jax")
    rts.fit(rts.ViewResiduals(scene, views(), batch=1), p, steps=2, validate_every=100)
    first = len(traces)
    rts.fit(rts.ViewResiduals(scene, views(), batch=1), p, steps=11, validate_every=100)
    assert len(traces) == 2 * first
    del jax


# ---------------------------------------------------------------------------------------------------- pictures


class Counted:
    """Pictures that are read, and how often."""

    def __init__(self):
        self.reads = []

    def views(self):
        return [rts.View(c, lambda i=i: self.read(i), SIZE, name=f"{i}.png") for i, c in enumerate(CAMERAS)]

    def read(self, number):
        self.reads.append(number)
        return IMAGES[number]


def test_pictures_are_read_when_needed_and_kept_within_a_bound():
    counted = Counted()
    residuals = rts.ViewResiduals(part, counted.views(), memory=2 * IMAGES[0].nbytes)
    assert counted.reads == []
    for number in (0, 1, 0, 2, 0, 1, 1):  # 1 was not used for longest when 2 came.
        residuals.load((number, None))
    assert counted.reads == [0, 1, 2, 1]
    counted = Counted()
    residuals = rts.ViewResiduals(part, counted.views(), memory=0)
    residuals.load((3, None)), residuals.load((3, None))
    assert counted.reads == [3, 3]


def test_a_picture_that_cannot_be_read_is_named(tmp_path):
    folder = pictures(tmp_path)
    known = rts.load_views(folder)
    content = (folder / "3.png").read_bytes()
    (folder / "3.png").write_bytes(content[: len(content) // 2])
    torch = pytest.importorskip("torch")
    residuals = rts.ViewResiduals(part, known)
    with pytest.raises(InputError, match=r"view 3: .*3\.png"):
        residuals(moved("torch-cpu"))
    # Once there is something to keep, the fit ends with its best.
    residuals = rts.ViewResiduals(part, known, batch=1, seed=5)
    later = next(step for step in range(9) if residuals.draw(step)[0][0] == 3)
    assert later > 0
    fit = rts.fit(residuals, moved("torch-cpu"), steps=9, validation=rts.ViewResiduals(part, known[:2]))
    assert fit.steps == later and "view 3" in fit.reason and torch.isfinite(fit.parameters["pose"]).all()
    with pytest.warns(FileWarning, match=r"3\.png is left out"):
        residuals = rts.ViewResiduals(part, known, unreadable="skip")
    assert [view.name for view in residuals.views] == ["0.png", "1.png", "2.png", "4.png"]
    (folder / "0.png").unlink()
    with pytest.raises(InputError, match=r"view 0: .*0\.png"):
        residuals(moved("torch-cpu"))


def pictures(folder):
    """A folder of the views as Blender writes them."""
    import json

    frames = []
    for i, (camera, image) in enumerate(zip(CAMERAS, IMAGES, strict=True)):
        rts.save_image(folder / f"{i}.png", image)
        matrix = np.linalg.inv(camera.view)
        frames.append({"file_path": f"{i}.png", "transform_matrix": matrix.tolist()})
    angle = 2 * np.arctan(np.tan(np.radians(45) / 2) * 26 / 20)
    (folder / "transforms_train.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return folder


def test_pictures_of_another_size_are_named():
    other = rts.View(CAMERAS[0], lambda: IMAGES[0][:-1], SIZE, name="short.png")
    with pytest.raises(InputError, match=r"view 0 \(short.png\) has a picture of shape \(19, 26, 4\)"):
        rts.ViewResiduals(part, [other])(moved("torch-cpu"))


def test_inverted_masks_are_warned_of_once():
    cameras = [rts.Camera.look_at(4 * eye, (0, 0, 0), fov_y=45, aspect=26 / 20) for eye in EYES]
    images = [rts.render(part(STILL), camera, SIZE) for camera in cameras]
    p, alpha = moved("torch-cpu"), lambda view: view.image[..., 3]
    right = [rts.View(*pair) for pair in zip(cameras, images, strict=True)]
    rts.ViewResiduals(part, right, target=alpha)(p)
    inverted = [rts.View(camera, 1 - image) for camera, image in zip(cameras, images, strict=True)]
    for target in (alpha, None):
        with pytest.warns(InputWarning, match="view 0 .*is the mask inverted") as told:
            rts.ViewResiduals(part, inverted, target=target)(p)
        assert len(told) == 1


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"scene": 3}, "scene is 3"),
        ({"views": []}, r"views is \[\]; expected a list of at least one view"),
        ({"views": [3]}, "expected a list of at least one view"),
        ({"batch": 6}, "batch is 6; expected a number of views from 1 to 5"),
        ({"batch": 0}, "batch is 0"),
        ({"window": (21, 5)}, r"window is \(21, 5\), and the view 0.png has \(20, 26\) pixels"),
        ({"window": 3}, "expected"),
        ({"seed": -1}, "seed is -1"),
        ({"cameras": 1}, "cameras is 1"),
        ({"exposure": 1}, "exposure is 1"),
        ({"target": 1}, "target is 1"),
        ({"weights": [1, 2]}, "weights"),
        ({"weights": [0] * 5}, "not all zero"),
        ({"unreadable": "ignore"}, "unreadable is 'ignore'"),
        ({"memory": -1}, "memory is -1"),
        ({"per_view": 1}, "per_view is 1"),
        ({"supersample": 0}, "supersample is 0"),
        ({"loss": "square"}, "square"),
    ],
)
def test_wrong_arguments(options, expected):
    with pytest.raises(InputError, match=expected):
        rts.ViewResiduals(**{"scene": part, "views": views(), **options})


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((3, IMAGES[0]), "camera is 3"),
        ((CAMERAS[0], lambda: IMAGES[0]), "size is None"),
        ((CAMERAS[0], IMAGES[0], (4, 4)), r"image has shape \(20, 26, 4\); expected \(4, 4, 3 or 4\)"),
        ((CAMERAS[0], IMAGES[0][..., 0]), "image has shape"),
    ],
)
def test_views_that_are_none(arguments, expected):
    with pytest.raises(InputError, match=expected):
        rts.View(*arguments)
    with pytest.raises(InputError, match=r"mask has shape \(3, 3\); expected \(20, 26\)"):
        rts.View(CAMERAS[0], IMAGES[0], mask=np.ones((3, 3)))


def test_cameras_that_see_nothing_are_said():
    away = rts.Camera.look_at((0, 0, 3), (0, 0, 9), aspect=26 / 20)
    residuals = rts.ViewResiduals(part, [rts.View(away, IMAGES[0], name="away.png")])
    with pytest.warns(rts.errors.EmptyImageWarning):
        fit = rts.fit(residuals, moved("torch-cpu"), steps=3)
    assert "is the object in view" in fit.reason
