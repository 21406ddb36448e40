"""Surfaces of fields that rays are cast at, against closed forms."""

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, arrays, finite_difference, gradient, quick, to_numpy
from quartic import RADII, closed_form, some_rays

import rts
from rts.plugin_api.records import Samples
from rts.rendering import settings
from rts.testing import SurfaceConformance
from rts_surfaces.implicit.casting import cast, moving
from rts_surfaces.implicit.fields import sphere, swept_sphere, union
from rts_surfaces.implicit.regions import ball, box
from rts_surfaces.implicit.sdf import Sdf

pytestmark = pytest.mark.sampling

CAMERA = rts.Camera.look_at((0.9, 1.6, 3.2), (0, 0, 0), fov_y=40)
TORUS = Sdf(swept_sphere, 1.3, reads=("radii",))
CENTER = np.array([0.13, -0.07, 0.21], np.float32)


def distances(surface, theta, origins, directions, layers=4):
    hits = surface.intersect(theta, origins, directions, layers)
    xp = rts.namespace(hits.distance)
    for x in (hits.distance, hits.params):
        assert np.isfinite(to_numpy(x)).all()
    return to_numpy(xp.where(hits.hit, hits.distance, xp.inf))


# ------------------------------------------------------------------------------------------------------ hits


@pytest.mark.parametrize("options", [{}, {"lipschitz": None}, {"isovalue": 0.35}, {"inside": "above"}])
def test_rays_meet_the_torus_where_the_quartic_is_zero(options):
    def f(theta, points):
        level = swept_sphere(theta, points) + options.get("isovalue", 0.0)
        return -level if options.get("inside") == "above" else level

    origins, directions, roots = some_rays()
    for layers in (1, 4):
        found = distances(Sdf(f, 1.3, **options), {"radii": RADII}, origins, directions, layers)
        np.testing.assert_allclose(found, closed_form(roots, layers), rtol=0, atol=1e-7)


@pytest.mark.parametrize("target", ALL)
def test_hits_in_single_precision_are_right_to_five_digits(target):
    origins, directions, roots = some_rays()
    theta, *rays = arrays(target, ({"radii": RADII}, origins, directions))
    found = distances(TORUS, theta, *rays)
    np.testing.assert_allclose(found, closed_form(roots), rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_hits_are_the_same_compiled_and_batched(target):
    origins, directions, roots = some_rays()
    radii, *rays = arrays(target, (np.stack([RADII, RADII]), origins, directions))

    def found(radii):
        hits = TORUS.intersect({"radii": radii}, *rays, 4)
        return rts.namespace(radii).where(hits.hit, hits.distance, np.inf)

    if target == "jax":
        import jax

        every = jax.jit(jax.vmap(found))(radii)
    else:
        import torch

        every = torch.func.vmap(found)(radii)
    for one in every:
        np.testing.assert_allclose(to_numpy(one), closed_form(roots), rtol=0, atol=2e-5)


def test_a_sample_is_the_point_and_the_slope_over_its_square():
    origins, directions, _ = some_rays()
    surface = Sdf(lambda theta, p: 3 * swept_sphere(theta, p), 1.3, lipschitz=3.0)
    hits = surface.intersect({"radii": RADII}, origins, directions, 2)
    point = origins + hits.distance[..., None] * directions
    np.testing.assert_allclose(hits.params[..., :3][hits.hit], point[hits.hit], atol=1e-9)
    along = hits.params[..., 3:][hits.hit]
    np.testing.assert_allclose(np.linalg.norm(along, axis=-1), 1 / 3, rtol=1e-6)
    assert (hits.params[~hits.hit] == 0).all() and (hits.distance[~hits.hit] == 0).all()


def test_what_is_outside_of_the_ball_is_cut_off():
    plane = Sdf(lambda theta, p: p[:, 1] - 0.3, 1.0, center=(2, 0, 0))
    x = np.linspace(0.5, 3.5, 31)
    origins = np.stack([x, np.full(31, 5.0), np.zeros(31)], axis=1)
    found = distances(plane, {}, origins, np.tile([0.0, -2.0, 0], (31, 1)), 2)
    seen = np.abs(x - 2) < 0.91**0.5
    np.testing.assert_allclose(found[0], np.where(seen, 2.35, np.inf), atol=1e-9)
    assert np.isinf(found[1]).all()


def test_cameras_far_away_and_slopes_of_any_size_do_not_matter():
    origins, directions, roots = some_rays()
    scaled = Sdf(lambda theta, p: 1e-4 * swept_sphere(theta, p), 1.3, lipschitz=1e-4)
    far = 1e5
    found = distances(scaled, {"radii": RADII}, origins - far * directions, directions, 1)
    outside = swept_sphere({"radii": RADII}, origins) >= 0
    # Rays that begin within the tube now meet it before.
    np.testing.assert_allclose(
        found[0, outside] - far, np.minimum(closed_form(roots, 1)[0, outside], np.inf), atol=1e-5
    )


@pytest.mark.thorough
def test_rays_are_clipped_to_boxes_as_to_balls():
    origins, directions, roots = some_rays()
    directions[0] *= (1, 0, 1)
    origins[1], directions[1] = (0, 5, 0), (0, -1, 0)

    low, high = np.array([-1.26, -0.36, -1.26]), np.array([1.26, 0.36, 1.26])
    for engine in ALL:
        rays, theta = arrays(engine, (origins, directions)), arrays(engine, {"radii": RADII})

        def level(p, theta=theta):
            return swept_sphere(theta, p)

        pair = [
            cast(level, lambda p, hit, f=level: moving(f, p, hit), *rays, 4, within=within, lipschitz=1.0)
            for within in (ball(np.zeros(3), 1.3), box(low, high))
        ]
        first, second = ([to_numpy(x) for x in hits[:2]] for hits in pair)
        np.testing.assert_array_equal(first[0], second[0])
        np.testing.assert_allclose(first[1], second[1], atol=2e-5)


# ------------------------------------------------------------------------------------------------ silhouettes


def image_area(camera, size, center, radius):
    """The area in pixels of a ball's image: π f² r² √(|c|² − r²) / (z² − r²)^{3/2}, c the center from the camera."""
    at = np.asarray(camera.view, np.float64) @ [*center, 1]
    focal = np.asarray(camera.projection, np.float64)[1, 1] * size[0] / 2
    return np.pi * (focal * radius) ** 2 * (at[:3] @ at[:3] - radius**2) ** 0.5 / (at[2] ** 2 - radius**2) ** 1.5


@pytest.mark.parametrize("supersample", [1, 4])
def test_the_derivative_of_a_balls_area_in_its_radius_is_the_closed_form(supersample):
    torch, size = pytest.importorskip("torch"), (160, 160)
    center, radius = CENTER, torch.tensor(0.8, requires_grad=True)
    part = rts.Part(Sdf(sphere, 1.3), {"center": center, "radius": radius}, "silhouette")
    alpha = rts.render(part, CAMERA, size, sampler="rays", supersample=supersample)[..., 3].sum()
    alpha.backward()
    alpha = alpha.detach()
    ends = [image_area(CAMERA, size, center, 0.8 + step) for step in (1e-5, -1e-5)]
    assert float(alpha) == pytest.approx(image_area(CAMERA, size, center, 0.8), rel=5e-3)
    assert float(radius.grad) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=0.03)


# --------------------------------------------------------------------------------------------------- networks


def network(torch):
    """A small network, trained to nothing: a ball, bent by it."""
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(3, 16), torch.nn.Tanh(), torch.nn.Linear(16, 1))

    def f(theta, points):
        bent = torch.func.functional_call(net, theta["net"], (points,))[:, 0]
        return (points * points).sum(1) - 0.6 + 0.2 * bent

    return f, dict(net.named_parameters())


def test_gradients_reach_the_weights_of_a_network():
    torch = pytest.importorskip("torch")
    f, weights = network(torch)
    tint = torch.tensor([0.9, 0.3, 0.1], requires_grad=True)
    surface = Sdf(f, 1.5, lipschitz=None, reads=("net",), attributes={"color": lambda t, p: t["tint"] + 0 * p})
    part = rts.Part(surface, {"net": weights, "tint": tint}, "lambert")
    image = rts.render(part, CAMERA, (32, 32), layers=2)
    assert 100 < float((image[..., 3] > 0.5).sum()) < 900
    image.square().sum().backward()
    for value in (*weights.values(), tint):
        assert torch.isfinite(value.grad).all() and value.grad.abs().max() > 1e-3


def test_a_network_may_be_closed_over():
    torch = pytest.importorskip("torch")
    f, weights = network(torch)
    part = rts.Part(Sdf(lambda theta, p: f({"net": weights}, p), 1.5, lipschitz=None), {}, "silhouette")
    rts.render(part, CAMERA, (24, 24), engine="torch")[..., 3].sum().backward()
    assert all(w.grad.abs().max() > 0 for w in weights.values())


# -------------------------------------------------------------------------------------------------- evaluation


def at_some_samples(target, dtype=np.float32):
    origins, directions, _ = some_rays(60)
    hits = TORUS.intersect({"radii": RADII}, origins, directions, 2)
    params = hits.params[hits.hit].astype(np.float32)
    return Samples(np.zeros((len(params), 0), np.int32), arrays(target, params, dtype), None, None)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("name", ["position", "normal", "height"])
def test_gradients_of_the_g_buffer_are_finite_differences(target, name):
    surface = Sdf(swept_sphere, 1.3, attributes={"height": lambda theta, p: theta["radii"][0] * p[:, 1:2] ** 2})
    samples, host = at_some_samples(target), at_some_samples("numpy")
    weights = np.random.default_rng(1).normal(size=surface.evaluate({"radii": RADII}, host)[name].shape) / 10

    def product(radii, weights=weights, samples=host):
        return (surface.evaluate({"radii": radii}, samples)[name] * weights).sum()

    moved = arrays(target, weights)
    found = gradient(target, lambda radii: product(radii, moved, samples), arrays(target, RADII))
    np.testing.assert_allclose(found, finite_difference(product, RADII, 1e-5), rtol=1e-3, atol=1e-4)


def test_points_move_along_the_normal():
    host = at_some_samples("numpy")
    before, after = (TORUS.evaluate({"radii": np.array([0.9, r])}, host) for r in (0.35, 0.36))
    np.testing.assert_allclose(after["position"] - before["position"], 0.01 * before["normal"], atol=1e-6)


@pytest.mark.thorough
def test_a_function_without_derivative_at_the_origin_does_no_harm():
    jax = pytest.importorskip("jax")

    def f(theta, points):
        return jax.numpy.linalg.norm(points - theta["center"], axis=-1) - 0.8

    def loss(center):
        return rts.render(rts.Part(Sdf(f, 1.3), {"center": center}, "normals"), CAMERA, (8, 8), layers=1).sum()

    assert np.isfinite(jax.jit(jax.grad(loss))(jax.numpy.zeros(3))).all()


# ---------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"f": 3}, "f is 3; expected a function"),
        ({"f": dict}, "f is <class 'dict'>; expected a function"),
        ({"radius": 0}, "radius is 0; expected a positive number"),
        ({"center": (0, 0)}, "center"),
        ({"center": (0, 0, np.nan)}, "center"),
        ({"isovalue": np.inf}, "isovalue is array(inf); expected finite numbers"),
        ({"isovalue": [1, 2]}, "isovalue"),
        ({"inside": "within"}, "inside is 'within'; expected 'below' or 'above'"),
        ({"reads": "radii"}, "reads is 'radii'; expected names"),
        ({"reads": 3}, "reads is 3; expected names"),
        ({"attributes": [1]}, "attributes is [1]; expected a dict"),
        ({"attributes": {"normal": swept_sphere}}, "attributes declares 'normal'"),
        ({"attributes": {"color": 1}}, "attributes['color'] is 1; expected a function"),
    ],
)
def test_wrong_arguments_are_refused(options, message):
    with pytest.raises(rts.InputError) as caught:
        Sdf(**{"f": swept_sphere, **options})
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("f", "message"),
    [
        (lambda theta, p: p[:, :1], "f gave shape ("),
        (lambda theta, p: p.sum(), "f gave shape () for"),
        (lambda theta, p: 0.5, "f gave a float for points of numpy"),
        (lambda theta, p: None, "f gave None for points of numpy"),
        (lambda theta, p: (p[:, 0] > 0).astype(np.int32), "f gave int32 for points of float32; expected float32"),
        (lambda theta, p: p[:, 0].astype(np.float64), "f gave float64 for points of float32"),
    ],
)
def test_wrong_results_are_refused(f, message):
    with pytest.raises(rts.InputError) as caught:
        rts.render(rts.Part(Sdf(f), {"radii": RADII.astype(np.float32)}, "normals"), CAMERA, (8, 8))
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_arrays_of_another_engine_are_refused():
    torch, jax = pytest.importorskip("torch"), pytest.importorskip("jax")
    part = rts.Part(Sdf(lambda theta, p: jax.numpy.ones(len(p))), {"radii": torch.tensor(RADII)}, "normals")
    with pytest.raises(rts.InputError, match="f gave a .* for points of torch"):
        rts.render(part, CAMERA, (8, 8))


def test_missing_entries_and_wrong_attributes_are_refused():
    with pytest.raises(rts.InputError, match=r"theta has no 'radii', which swept_sphere reads; it has \[\]"):
        rts.render(rts.Part(TORUS, {}, "normals"), CAMERA, (8, 8))
    surface = Sdf(swept_sphere, attributes={"color": lambda theta, p: p[:, 0]})
    with pytest.raises(rts.InputError, match=r"attributes\['color'\] gave shape .*; expected \(\d+, C\)"):
        rts.render(rts.Part(surface, {"radii": RADII}, "unlit"), CAMERA, (8, 8))


def test_only_what_is_read_goes_to_the_surface():
    theta = {"radii": RADII, "tint": np.ones(3)}
    assert TORUS.reads(theta) == ("radii",) and Sdf(swept_sphere).reads(theta) == ("radii", "tint")
    assert Sdf(swept_sphere, reads=("radii",), attributes={"color": sphere}).reads(theta) == ("radii", "tint")


def test_unions_of_fields_have_hits_of_all():
    pair = union(lambda t, p: sphere(t["left"], p), lambda t, p: sphere(t["right"], p))
    theta = {
        side: {"center": np.array([x, 0, 0.0]), "radius": np.array(0.3)} for side, x in (("left", -0.5), ("right", 0.5))
    }
    found = distances(Sdf(pair), theta, np.array([[-4.0, 0, 0]]), np.array([[2.0, 0, 0]]), 5)
    np.testing.assert_allclose(found[:, 0], [1.6, 1.9, 2.1, 2.4, np.inf], atol=1e-9)


class TestSdf(SurfaceConformance):
    @pytest.fixture
    def part(self):
        return Sdf.example()

    @pytest.fixture
    def sampler(self):
        return "rays"


def test_pictures_of_torch_are_the_same_in_every_mode_and_require_no_gradient():
    torch = pytest.importorskip("torch")
    part = rts.Sdf.example()
    still = part.replace(theta={name: torch.tensor(x) for name, x in part.theta.items()})
    camera = rts.Camera.look_at((1, 1.5, 3), (0, 0, 0))
    image = rts.render(still, camera, (20, 24))
    assert not image.requires_grad and image[..., 3].max() > 0.9
    for mode in (torch.no_grad, torch.inference_mode):
        with mode():
            assert torch.equal(rts.render(still, camera, (20, 24)), image)


@pytest.mark.parametrize("grad", quick([False, True]))
def test_bands_of_a_large_picture_have_the_gradient_of_the_whole(monkeypatch, grad):
    torch = pytest.importorskip("torch")
    part, camera = rts.Sdf.example(), rts.Camera.look_at((1, 1.5, 3), (0, 0, 0))

    def image():
        radii = torch.tensor(part.theta["radii"], requires_grad=grad)
        return radii, rts.render(part.replace(theta={"radii": radii}), camera, (24, 20), supersample=3, layers=2)

    radii, whole = image()
    monkeypatch.setattr(settings, "BAND", 500)
    other, banded = image()
    # Breaks are found to 1e-4 of a cell, of which there are nine in a pixel.
    assert torch.allclose(whole, banded, atol=5e-5) and banded.requires_grad == grad
    if grad:
        slopes = [torch.autograd.grad((x * x).mean(), r)[0] for x, r in ((whole, radii), (banded, other))]
        assert torch.allclose(*slopes, rtol=2e-3) and slopes[0].abs().min() > 1e-4


def test_a_function_of_jax_alone_is_called_with_few_shapes():
    """It is compiled for each; in a compiled program and out of it, the image is that of torch."""
    jax, torch = pytest.importorskip("jax"), pytest.importorskip("torch")
    shapes = set()

    def field(theta, points):
        shapes.add(points.shape)
        return jax.numpy.sqrt((points * points).sum(axis=1) + 1e-12) - theta["radius"]

    def same(theta, points):
        return torch.sqrt((points * points).sum(dim=1) + 1e-12) - theta["radius"]

    def image(f):
        camera = rts.Camera.look_at((1, 1.5, 3), (0, 0, 0))
        return lambda radius: rts.render(rts.Part(rts.Sdf(f, 1.2), {"radius": radius}, "normals"), camera, (20, 24))

    radius, one = jax.numpy.float32(0.9), jax.numpy.float32(1)
    expected = [x.numpy() for x in torch.func.jvp(image(same), (torch.tensor(0.9),), (torch.tensor(1.0),))]
    for way in (image(field), jax.jit(image(field))):
        shapes.clear()
        for mine, other in zip(jax.jvp(way, (radius,), (one,)), expected, strict=True):
            # In a program slopes of the function are differences of its values, which are of single precision.
            assert np.linalg.norm(np.asarray(mine) - other) < 5e-3 * np.linalg.norm(other)
        assert len(shapes) < 10


def test_a_function_has_the_arrays_of_jax_that_theta_has():
    """Out of a program, functions may do what jax alone does, of numbers of all kinds; and close over traced arrays."""
    jax = pytest.importorskip("jax")
    camera = rts.Camera.look_at((1, 1.5, 3), (0, 0, 0))

    def image(theta, scale=1.0):
        def field(theta, points):
            radius = theta["of"]["radius"].at[0].multiply(scale)[0]
            return jax.numpy.sqrt((points * points).sum(axis=1) * theta["count"] + 1e-12) - radius

        part = rts.Part(rts.Sdf(field, 1.2), theta, "silhouette")
        return rts.render(part, camera, (12, 16), splatter="none")[..., 3]

    def theta(radius):
        return {"of": {"radius": jax.numpy.full(1, radius)}, "count": jax.numpy.int32(1)}

    expected = np.asarray(image(theta(0.9)))
    assert 10 < expected.sum() < 100
    np.testing.assert_array_equal(jax.jvp(lambda s: image(theta(1.8), s), (0.5,), (1.0,))[0], expected)
    radii = jax.numpy.asarray([0.9, 0.5], "float32")
    both = jax.vmap(lambda r: image({"of": {"radius": r[None]}, "count": 1}))(radii)
    np.testing.assert_array_equal(both[0], expected)
    assert 0 < both[1].sum() < expected.sum()


def test_cameras_may_be_batched():
    torch = pytest.importorskip("torch")
    part = rts.Part(Sdf(swept_sphere, 1.3, reads=("radii",)), {"radii": torch.tensor([0.9, 0.35])}, "normals")
    camera = rts.Camera.look_at((0, 1, 4), (0, 0, 0))
    views = torch.tensor(np.stack([camera.view, rts.Camera.look_at((1, 1, 4), (0, 0, 0)).view]), dtype=torch.float32)
    projection = torch.tensor(camera.projection, dtype=torch.float32)

    def image(view):
        return rts.render(part, rts.Camera(view, projection), (16, 16))

    torch.testing.assert_close(torch.func.vmap(image)(views), torch.stack([*map(image, views)]), atol=5e-4, rtol=0)
