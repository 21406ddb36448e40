"""Images of any number of channels: each is what it would be in an image of three."""

import numpy as np
import pytest
from helpers import ALL, CAMERA, DIFFERENTIABLE, SIZE, arrays, gradient, icosphere, mesh_part, quad, show, to_numpy

import rts
from rts.errors import InputError

pytestmark = pytest.mark.rendering

RNG = np.random.default_rng(0)


class Features(rts.Shader):
    """Some channels of the attribute "features", which are behind a veil where not opaque."""

    reads = ("features",)

    def __init__(self, first, last, alpha=1.0):
        self.first, self.last, self.alpha = first, last, alpha
        self.channels, self.opaque = last - first, alpha == 1.0

    def __call__(self, theta, gbuffer, camera):
        features = gbuffer["features"][:, self.first : self.last]
        xp = rts.namespace(features)
        return self.alpha * xp.concat([features, xp.ones_like(features[:, :1])], axis=1)


def scene(first, last):
    """A sphere that a veil cuts."""
    meshes = icosphere(2, 0.9), quad(-0.2, 1.6, -0.9, 0.8, 0.3)
    parts = []
    for mesh, alpha in zip(meshes, (1.0, 0.6), strict=True):
        features = np.random.default_rng(len(parts)).standard_normal((len(mesh[0]), 7)).astype(np.float32)
        shader = Features(first, last, alpha)
        parts.append(mesh_part(mesh, theta={"features": features}, indices={"features": None}, shader=shader))
    return parts


def in_threes(render, count):
    """Images of three channels each, the last ones shared where they overlap; put together."""
    images = [render(min(first, 7 - 3), min(first, 7 - 3) + 3) for first in range(0, count, 3)]
    channels = np.concatenate([im[..., max(0, 3 * i - 4) : 3] for i, im in enumerate(images)], axis=-1)[..., :count]
    return np.concatenate([channels, images[0][..., 3:]], axis=-1)


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("count", [1, 3, 7])
def test_each_channel_is_as_in_an_image_of_three(target, count):
    def render(first, last):
        parts, camera = arrays(target, (scene(first, last), CAMERA))
        return show(parts, camera, layers=4)

    found = render(0, count)
    assert found.shape == (*SIZE, count + 1)
    np.testing.assert_allclose(found, in_threes(render, count), atol=2e-6)


@pytest.mark.parametrize(
    "options",
    [{"splatter": "none"}, {"splatter": "multi"}, {"splatter": "single", "supersample": 2}, {"supersample": 3}],
    ids=str,
)
@pytest.mark.filterwarnings("ignore:samples are translucent")
def test_so_it_is_with_every_splatter_and_number_of_samples(options):
    found = show(scene(0, 7), **options)
    np.testing.assert_allclose(found, in_threes(lambda a, b: show(scene(a, b), **options), 7), atol=2e-6)
    assert found.shape == (*SIZE, 8) and np.isfinite(found).all()


@pytest.mark.parametrize("wide", [False, True])
def test_backgrounds_have_as_many_channels(wide):
    over = RNG.random(8)
    bare = show(scene(0, 7))
    found = show(scene(0, 7), background=over if wide else over[:7])
    over[7] = over[7] if wide else 1
    np.testing.assert_allclose(found, bare + (1 - bare[..., 7:]) * over, atol=1e-6)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_gradients_are_the_sum_of_those_of_each_three(target):
    weights = RNG.standard_normal((*SIZE, 8)).astype(np.float32)
    parts, camera, on = arrays(target, (scene(0, 7), CAMERA, weights))

    def loss(theta, first, last, weights):
        shown = parts[0].replace(theta=theta, shader=Features(first, last))
        other = parts[1].replace(shader=Features(first, last, 0.6))
        return (rts.render([shown, other], camera, SIZE) * weights).sum()

    found = gradient(target, lambda x: loss(x, 0, 7, on), parts[0].theta)
    expected = {name: 0.0 for name in found}
    for first, own in ((0, slice(0, 3)), (3, slice(3, 6)), (4, slice(6, 7))):
        some = np.zeros((*SIZE, 4), np.float32)
        some[..., 3 - (own.stop - own.start) : 3] = weights[..., own]
        some[..., 3] = weights[..., 7] if first == 0 else 0
        there = arrays(target, some)
        one = gradient(target, lambda x, f=first, w=there: loss(x, f, f + 3, w), parts[0].theta)
        expected = {name: expected[name] + one[name] for name in found}
    for name in found:
        assert np.abs(found[name]).max() > 0
        np.testing.assert_allclose(found[name], expected[name], atol=2e-5 * np.abs(expected[name]).max())


def test_features_are_fitted_to_an_image_of_theirs():
    target = show(scene(0, 5)[0])
    part = arrays("torch-cpu", scene(0, 5)[0])
    start = arrays("torch-cpu", {"scale": np.full(5, 0.5)})

    def scaled(p):
        return part.replace(theta={**part.theta, "features": part.theta["features"][:, :5] * p["scale"]})

    residuals = rts.ImageResiduals(scaled, CAMERA, SIZE, target[..., :5], channels=5)
    fit = rts.fit(residuals, start, method="lm", steps=4)
    np.testing.assert_allclose(to_numpy(fit.parameters["scale"]), 1, atol=1e-3)
    alpha = rts.ImageResiduals(lambda p: part, CAMERA, SIZE, target[..., 5], channels=5)
    assert float((alpha(start) ** 2).max()) < 1e-10


# ------------------------------------------------------------------------------------------------------ errors


def test_what_does_not_fit_is_refused():
    parts, plain = scene(0, 7), mesh_part(quad())

    class Short(rts.Shader):
        def __call__(self, theta, gbuffer, camera):
            return gbuffer["features"]

    short = Short()
    with pytest.raises(InputError, match="part 0 gives 7 channels and that of part 1 gives 3"):
        show([parts[0], plain])
    with pytest.raises(InputError, match=r"expected \(\d+, 4\): 3 channels and alpha, as its attribute `channels`"):
        show(parts[0].replace(shader=short))
    short.channels = 7
    with pytest.raises(InputError, match=r"returned has shape \(\d+, 7\); expected \(\d+, 8\)"):
        show(parts[0].replace(shader=short))
    short.channels = 0
    with pytest.raises(InputError, match="is 0; expected an integer of at least 1"):
        show(parts[0].replace(shader=short))
    with pytest.raises(InputError, match=r"background has shape \(3,\); expected \(7,\), \(8,\), \(20, 24, 7\)"):
        show(parts, background=np.zeros(3))
    with pytest.raises(InputError, match=r"image has shape \(20, 24, 8\)"):
        rts.save_image("features.png", show(parts))
    draw = rts.prepare(plain).renderer(CAMERA, SIZE, background=np.zeros(3))
    with pytest.raises(InputError, match="background"):
        draw(shader=Features(0, 7), theta={**parts[1].theta})


@pytest.mark.parametrize("method", ["lm", "adam"])
def test_targets_for_other_channels_are_refused(method):
    part = arrays("torch-cpu", scene(0, 7)[0])
    start = {"features": part.theta["features"]}
    residuals = rts.ImageResiduals(
        lambda p: part.replace(theta={**part.theta, **p}), CAMERA, SIZE, np.zeros((*SIZE, 3))
    )
    with pytest.raises(InputError, match="give channels=7"):
        rts.fit(residuals, start, method=method, steps=1)
    with pytest.raises(InputError, match="channels is 0"):
        rts.ImageResiduals(lambda p: part, CAMERA, SIZE, np.zeros((*SIZE, 3)), channels=0)


def test_gradients_are_checked_of_colours_alone():
    part = arrays("torch-cpu", scene(0, 7)[0])
    with pytest.raises(InputError, match="give 7 channels besides alpha; expected 3"):
        rts.check_gradient(
            lambda x: (part.replace(theta={**part.theta, "vertices": x}), CAMERA), part.theta["vertices"], SIZE
        )
    image = to_numpy(rts.render(part, CAMERA, SIZE))
    assert image.shape == (*SIZE, 8)
