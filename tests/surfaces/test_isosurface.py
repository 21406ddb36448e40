"""Isosurfaces: what samples carry, how they move, tables of lattice points, bands; and what is refused."""

import os
import warnings

import numpy as np
import pytest
from found_outlines import noted
from helpers import ALL, DIFFERENTIABLE, TORCH, arrays, gradient, refused, relative_error, to_numpy
from lattices import BALL, BOUNDS, TORUS, ball, on_lattice, torus

import rts
from rts import Camera, InputError, Part
from rts.arrays.trees import map_leaves
from rts_surfaces.implicit.narrow_band import NarrowBand

pytestmark = pytest.mark.sampling

Isosurface = rts.plugin("surfaces", "isosurface")
CAMERA, SIZE = Camera.look_at((0.4, 1.3, 2.9), (0, 0, 0), fov_y=40), (48, 48)
RADII = {"radii": np.array([0.6, 0.25], np.float32)}
MOTIONS = ("normal", "edge")
LATTICES = int(os.environ.get("RTS_LATTICES", "60"))
"""How many random lattices are tried; 10,000 of them take some minutes."""


def grid(field=TORUS, count=33, shader="silhouette", **options):
    """A part of values on a lattice."""
    values, bounds = on_lattice(field, count)
    return Part(Isosurface(bounds, **options), {"values": values}, shader)


def function(count=33, shader="silhouette", **options):
    """A part of a torus by a function of θ["radii"]."""
    return Part(Isosurface(BOUNDS, f=torus, shape=(count,) * 3, **options), dict(RADII), shader)


# ------------------------------------------------------------------------------------------------- samples


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_sample_is_six_lattice_points_and_three_barycentrics(motion):
    part = grid(motion=motion)
    samples = rts.sample(part, CAMERA, SIZE, splatter=None).samples[0]
    assert samples.ids.shape[1] == 6 and samples.ids.dtype == np.int32
    barycentrics = samples.params[:, :3].astype(np.float64)
    assert (barycentrics > -1e-6).all()
    np.testing.assert_allclose(barycentrics.sum(axis=1), 1, atol=1e-6)
    flat = part.theta["values"].reshape(-1)
    places = part.surface.field.lattice(part.theta).points(samples.ids)
    position = 0
    for k in range(3):
        a, b = (flat[samples.ids[:, 2 * k + i]].astype(np.float64) for i in range(2))
        assert ((a < 0) != (b < 0)).all()
        corner = places[:, 2 * k] + (a / (a - b))[:, None] * (places[:, 2 * k + 1] - places[:, 2 * k])
        position = position + barycentrics[:, k : k + 1] * corner
    found = part.surface.evaluate(part.theta, samples)["position"]
    np.testing.assert_allclose(found, position, atol=2e-6)
    assert np.abs(TORUS(position)).max() < 8e-3


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_nothing_but_the_six_values_moves_a_sample(target, motion):
    part = grid(count=17, motion=motion)
    samples = rts.sample(part, CAMERA, (12, 12), splatter=None).samples[0]
    on_device = arrays(target, samples)
    row = len(samples.ids) // 2

    def coordinate(values):
        return part.surface.evaluate({"values": values}, on_device)["position"][row].sum()

    found = gradient(target, coordinate, arrays(target, part.theta["values"]))
    assert set(np.flatnonzero(found)) <= set(samples.ids[row].tolist()) and found.any()


def test_motion_along_the_normal_is_by_the_change_of_the_field():
    part = grid(BALL, 65)
    samples = rts.sample(part, CAMERA, SIZE, splatter=None).samples[0]
    before = part.surface.evaluate(part.theta, samples)["position"].astype(np.float64)
    after = part.surface.evaluate({"values": part.theta["values"] - np.float32(1e-2)}, samples)["position"]
    outwards = before / np.linalg.norm(before, axis=1, keepdims=True)
    np.testing.assert_allclose(after - before, 1e-2 * outwards, atol=5e-4)


def test_motion_along_edges_keeps_corners_on_their_edges():
    part = grid(BALL, 33, motion="edge")
    samples = rts.sample(part, CAMERA, SIZE, splatter=None).samples[0]
    moved = on_lattice(lambda p: BALL(p) - 4e-3, 33)[0]
    after = part.surface.evaluate({"values": moved}, samples)["position"]
    flat, places = moved.reshape(-1), part.surface.field.lattice(part.theta).points(samples.ids)
    expected = 0
    for k in range(3):
        a, b = (flat[samples.ids[:, 2 * k + i]].astype(np.float64) for i in range(2))
        corner = places[:, 2 * k] + (a / (a - b))[:, None] * (places[:, 2 * k + 1] - places[:, 2 * k])
        expected = expected + samples.params[:, k : k + 1] * corner
    np.testing.assert_allclose(after, expected, atol=2e-6)


# ------------------------------------------------------------------------------------------------- silhouettes


def disk(radius, height, distance=3.2, half=np.pi / 9):
    """The area in pixels of the outline of a ball seen from a distance."""
    focal = height / 2 / np.tan(half)
    return np.pi * focal**2 * radius**2 / (distance**2 - radius**2)


@pytest.mark.parametrize("supersample", [1, 4])
@pytest.mark.parametrize("motion", MOTIONS)
def test_the_outline_of_a_ball_grows_as_its_disk_does(motion, supersample):
    torch = pytest.importorskip("torch")
    camera, height = Camera.look_at((0, 0, 3.2), (0, 0, 0), fov_y=40), 128
    values, bounds = on_lattice(BALL, 128)
    offset = torch.zeros((), requires_grad=True)
    part = Part(Isosurface(bounds, motion=motion), {"values": torch.from_numpy(values) - offset})
    area = rts.render(part, camera, (height, height), supersample=supersample)[..., 3].sum()
    (slope,) = torch.autograd.grad(area, offset)
    expected = (disk(0.701, height) - disk(0.699, height)) / 2e-3
    assert area.item() == pytest.approx(disk(0.7, height), rel=5e-3)
    assert slope.item() == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("motion", MOTIONS)
def test_rays_and_triangles_agree_on_gradients(motion):
    torch = pytest.importorskip("torch")
    sdf = rts.plugin("surfaces", "sdf")(torus, radius=1.2)
    iso = Isosurface(BOUNDS, f=torus, shape=(128,) * 3, lipschitz=1.0, motion=motion)
    slopes = []
    for surface, sampler in ((sdf, "auto"), (iso, "auto"), (iso, "rays")):
        radii = torch.tensor(RADII["radii"], requires_grad=True)
        image = rts.render(Part(surface, {"radii": radii}), CAMERA, (160, 160), sampler=sampler)
        slopes.append(torch.autograd.grad(image[..., 3].sum(), radii)[0].numpy())
    assert relative_error(slopes[1], slopes[0]) < 0.03
    assert relative_error(slopes[2], slopes[0]) < 1e-3


# ---------------------------------------------------------------------------------------------------- functions


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("target", ALL)
def test_a_function_is_its_values_on_the_lattice(target, motion):
    options = dict(motion=motion, near_singular="keep")
    shown = function(21, **options).replace(theta=arrays(target, RADII))
    values = on_lattice(lambda p: torus(RADII, p.reshape(-1, 3)).reshape(p.shape[:-1]), 21)[0]
    expected = rts.render(Part(Isosurface(BOUNDS, **options), {"values": values}), CAMERA, SIZE)
    np.testing.assert_allclose(to_numpy(rts.render(shown, CAMERA, SIZE)), expected, atol=2e-4)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_a_table_changes_nothing_but_how_often_the_function_is_called(target, motion):
    calls = []

    def counting(theta, points):
        calls.append(points.shape[0])
        return torus(theta, points)

    found = []
    for table in (False, True):
        surface = Isosurface(BOUNDS, f=counting, shape=(17,) * 3, motion=motion, table=table)
        sampled = rts.sample(Part(surface, arrays(target, RADII)), CAMERA, SIZE)
        calls.clear()

        def loss(radii, surface=surface, sampled=sampled):
            return rts.render_samples(sampled, Part(surface, {"radii": radii}), CAMERA)[..., 3].sum()

        radii = arrays(target, RADII["radii"])
        found.append((float(loss(radii)), gradient(target, loss, radii), calls[0]))
    (plain, slope, six), (merged, same, points) = found
    assert merged == pytest.approx(plain, rel=1e-5) and relative_error(same, slope) < 1e-4
    assert points < six / 3


def test_a_table_has_each_lattice_point_once():
    part = function(17, table=True)
    sampled = rts.sample(part, CAMERA, SIZE, splatter=None)
    samples, plain = sampled.samples[0], rts.sample(function(17), CAMERA, SIZE, splatter=None).samples[0]
    points = samples.tables["points"]
    assert len(np.unique(points)) == len(points) < len(samples.ids)
    np.testing.assert_array_equal(points[samples.ids], plain.ids)


@pytest.mark.thorough
@pytest.mark.parametrize("motion", MOTIONS)
def test_a_compiled_loop_with_a_capacity_compiles_once(motion):
    jax = pytest.importorskip("jax")
    surface = Isosurface(BOUNDS, f=torus, shape=(17,) * 3, motion=motion, table=True)
    traces = []

    @jax.jit
    def step(radii):
        traces.append(1)

        def area(radii):
            return rts.render(Part(surface, {"radii": radii}), CAMERA, SIZE, capacity=3000)[..., 3].sum()

        return jax.value_and_grad(area)(radii)

    radii = jax.numpy.asarray(RADII["radii"])
    for factor in (1.0, 0.9, 0.4):  # The last one has no hole.
        at = radii * jax.numpy.asarray([factor, 1.0])
        value, slope = step(at)
        plain = Part(Isosurface(BOUNDS, f=torus, shape=(17,) * 3, motion=motion), {"radii": at})
        expected = rts.render(plain, CAMERA, SIZE)[..., 3].sum()
        assert float(value) == pytest.approx(float(expected), rel=1e-5) and np.isfinite(slope).all()
    assert len(traces) == 1


def test_samples_that_find_no_room_in_a_table_are_counted():
    jax = pytest.importorskip("jax")
    full = rts.sample(function(33, table=True), CAMERA, SIZE, splatter=None, layers=2).samples[0]
    surface = Isosurface(BOUNDS, f=torus, shape=(33,) * 3, table=200)

    @jax.jit
    def sampled(radii):
        found = rts.sample(Part(surface, {"radii": radii}), CAMERA, SIZE, capacity=4000, splatter=None, layers=2)
        return found.overflow, found.row, found.samples[0].ids

    overflow, row, ids = map(np.asarray, sampled(jax.numpy.asarray(RADII["radii"])))
    assert overflow == len(full.ids) - (row >= 0).sum() > 0 and ids.max() < 200


def glass(theta, gbuffer, camera):
    """Normals, a third of whose light passes through; a shader that may ask for its view."""
    xp = rts.namespace(gbuffer["normal"])
    return xp.concat([gbuffer["normal"] / 3, xp.full_like(gbuffer["normal"][:, :1], 2 / 3)], axis=-1)


@pytest.mark.parametrize(
    ("target", "shader"),
    [*((t, s) for t in ("numpy", *TORCH) for s in ("normals", glass)), ("jax", "normals"), ("jax.jit", glass)],
)
def test_samples_beside_outlines_are_joined_to_tables(target, shader):
    """Two parts, each with a table, in one view and in two: images and gradients are those without tables."""
    engine, weights = target.removesuffix(".jit"), np.random.default_rng(0).random((*SIZE, 4), np.float32)
    moved = np.eye(4, dtype=np.float32)
    moved[:3, 3] = 0.35, 0.1, 0.2
    cameras = CAMERA, Camera.look_at((-0.4, -1.3, 2.9), (0, 0, 0), fov_y=40)

    def found(table, views):
        surface = Isosurface(BOUNDS, f=torus, shape=(17,) * 3, table=table)

        def image(radii):
            parts = [Part(surface, {"radii": s * radii}, shader, transform=t) for s, t in ((1, None), (0.8, moved))]
            if views:
                return rts.render_views(parts, cameras, SIZE)
            return rts.render(parts, CAMERA, SIZE)

        def loss(radii):
            return (image(radii) * arrays(engine, weights)).sum()

        if target == "jax.jit":
            import jax

            image, loss = jax.jit(image), jax.jit(loss)
        radii = arrays(engine, RADII["radii"])
        slope = np.zeros(2) if target == "numpy" else to_numpy(gradient(engine, loss, radii))
        return to_numpy(image(radii)), slope

    for views in (True,) if target.startswith("jax") else (False, True):
        (expected, slope), (shown, same) = found(False, views), found(True, views)
        np.testing.assert_allclose(shown, expected, atol=2e-5)
        np.testing.assert_allclose(same, slope, rtol=1e-4)
        assert expected.any() and (target == "numpy" or slope.all())


def test_crossings_without_room_in_a_table_are_left_out_and_counted():
    """In few pixels most samples lie beside outlines; the table has room for half of all points."""
    jax = pytest.importorskip("jax")
    size = (10, 10)
    room = len(rts.sample(function(33, table=True), CAMERA, size).samples[0].tables["points"]) // 2

    def sampled(table):
        surface = Isosurface(BOUNDS, f=torus, shape=(33,) * 3, table=table)

        @jax.jit
        def own(radii):
            part = Part(surface, {"radii": radii})
            found = rts.sample(part, CAMERA, size, capacity=1000)
            image = rts.render_samples(found, part, CAMERA)
            return found.overflow, found.row >= 0, image

        with noted() as seen:
            results = [np.asarray(x) for x in own(jax.numpy.asarray(RADII["radii"]))]
        outlines, _ = seen[-1]  # Of as many breaks as there is room for, after those of more.
        return *results, len(outlines.place)

    none, seen, _, every = sampled(True)
    with pytest.warns(rts.errors.InputWarning, match="edge crossings find no room beside"):
        left, still, image, fewer = sampled(room)
    assert (still == seen).all() and none == 0 and left == every - fewer > 0 < fewer and np.isfinite(image).all()


def test_a_network_is_fitted_through_its_parameters():
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(3, 16), torch.nn.Tanh(), torch.nn.Linear(16, 1))

    def field(theta, points):
        ball = points.norm(dim=-1) - 0.6
        return ball + 0.1 * torch.func.functional_call(net, theta["weights"], points)[:, 0]

    surface = Isosurface(BOUNDS, f=field, shape=(21,) * 3, table=True)
    part = Part(surface, {"weights": dict(net.named_parameters())}, "normals")
    image = rts.render(part, CAMERA, SIZE)
    image.square().mean().backward()
    assert image.detach().any() and all(p.grad.isfinite().all() for p in net.parameters())
    assert net[0].weight.grad.abs().max() > 1e-6


@pytest.mark.parametrize("target", ALL)
def test_a_band_shows_what_the_lattice_shows(target):
    theta = arrays(target, RADII)
    whole = rts.render(function(40).replace(theta=theta), CAMERA, SIZE)
    for band in (NarrowBand(lipschitz=1.0), NarrowBand()):
        part = function(40, band=band).replace(theta=theta)
        np.testing.assert_allclose(to_numpy(rts.render(part, CAMERA, SIZE)), to_numpy(whole), atol=2e-4)
        extracted = part.surface.extract(theta)
        assert extracted.evaluations < 0.5 * 40**3
        assert len(extracted.faces) == len(function(40).surface.extract(theta).faces)


@pytest.mark.thorough
def test_a_band_cannot_be_traced():
    jax = pytest.importorskip("jax")
    part = function(20, band=NarrowBand(lipschitz=1.0))

    def area(radii):
        return rts.render(part.replace(theta={"radii": radii}), CAMERA, SIZE)[..., 3].sum()

    radii = jax.numpy.asarray(RADII["radii"])
    assert np.isfinite(jax.grad(area)(radii)).all()
    with pytest.raises(InputError, match="narrow band.*traced.*rts.sample"):
        jax.jit(area)(radii)
    torch = pytest.importorskip("torch")
    with pytest.raises(InputError, match="narrow band.*traced"):
        torch.func.vmap(area)(torch.tensor(RADII["radii"])[None])


def test_attributes_are_functions_of_position():
    part = grid(shader="unlit").replace(
        surface=Isosurface(BOUNDS, attributes={"color": lambda theta, p: 0.5 + 0.4 * p * theta["scale"]}),
        theta={"values": on_lattice(TORUS, 33)[0], "scale": np.float32(0.5)},
    )
    image = rts.render(part, CAMERA, SIZE)
    inside = image[..., 3] > 0.99
    sampled = rts.sample(part, CAMERA, SIZE, splatter=None)
    position = part.surface.evaluate(part.theta, sampled.samples[0])["position"]
    border = sampled.border
    row = sampled.row[0, border:-border, border:-border]
    assert inside.sum() > 200
    # Splatting blends colours of neighbours, which differ where another part of the surface begins.
    off = np.abs(image[inside][:, :3] - (0.5 + 0.2 * position[row])[inside])
    assert np.quantile(off, 0.9) < 2e-3


# -------------------------------------------------------------------------------------------- what is unstable


def scaled_gradients(field_values, near_singular, motion):
    """The gradient of an image's sum in the values of a lattice."""
    torch = pytest.importorskip("torch")
    values = torch.from_numpy(field_values).requires_grad_()
    bounds = ((-1, -1, -1), (1, 1, 1))
    part = Part(Isosurface(bounds, motion=motion, near_singular=near_singular), {"values": values}, "normals")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rts.errors.EmptyImageWarning)
        image = rts.render(part, CAMERA, (24, 24))
    weights = torch.from_numpy(np.random.default_rng(0).standard_normal((24, 24, 4)).astype(np.float32))
    (image * weights).sum().backward()
    return image.detach().numpy(), values.grad.numpy()


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("near_singular", ["bound", "drop", "keep"])
def test_random_lattices_have_finite_images_and_gradients(near_singular, motion):
    for seed in range(LATTICES // 6 or 1):
        rng = np.random.default_rng(seed)
        values = rng.standard_normal(rng.integers(2, 12, 3)).astype(np.float32)
        if seed % 3 == 1:
            values = np.rint(values)
        if seed % 3 == 2:
            values *= np.float32(10.0) ** rng.integers(-30, 30)
        for found in scaled_gradients(values, near_singular, motion):
            assert np.isfinite(found).all(), seed


def test_near_singular_edges_are_counted_bounded_or_dropped():
    # Beside a point that is a hair inside, both ends of edges are almost alike.
    values = on_lattice(BALL, 17)[0]
    toward = np.array([0.4, 1.3, 2.9])
    low, high = map(np.array, BOUNDS)
    tie = np.rint((0.7 * toward / np.linalg.norm(toward) - low) / (high - low) * 16).astype(int)
    for axis in range(3):
        beside = list(tie)
        beside[axis] += 1
        values[tuple(beside)] = 1e-7
    values[tuple(tie)] = -1e-7
    surface = Isosurface(BOUNDS)
    assert surface.extract({"values": values}).near_singular >= 3
    norms = {how: np.abs(scaled_gradients(values, how, "edge")[1]).max() for how in ("bound", "drop", "keep")}
    assert norms["keep"] > 100 * norms["bound"] and norms["keep"] > 100 * norms["drop"]
    faces = [
        len(Isosurface(BOUNDS, near_singular=how).tessellate({"values": values}, 1)[1]) for how in ("keep", "drop")
    ]
    assert faces[0] > faces[1]


# ------------------------------------------------------------------------------------------------- bad input


def test_samples_of_prepared_parts_are_those_of_what_was_prepared():
    for band in (None, NarrowBand(lipschitz=1.0)):
        part = function(33, band=band)
        prepared = rts.prepare(part, "raster")
        other = {"radii": np.array([0.3, 0.1], np.float32)}
        found = rts.sample(prepared.replace(theta=other), CAMERA, SIZE, splatter=None)
        expected = rts.sample(part, CAMERA, SIZE, splatter=None)
        np.testing.assert_array_equal(found.row, expected.row)
        np.testing.assert_array_equal(found.samples[0].params, expected.samples[0].params)


def test_a_band_that_finds_nothing_carries_nothing():
    surface = Isosurface(BOUNDS, f=lambda theta, p: torus(RADII, p) + 5, shape=(40,) * 3, band=NarrowBand(1.0))
    with pytest.warns(rts.errors.EmptyImageWarning, match="its band found no place"):
        assert not rts.render(Part(surface, {}), CAMERA, SIZE).any()


@pytest.mark.parametrize("lipschitz", [None, 1.0])
def test_rays_see_what_triangles_see_wherever_they_come_from(lipschitz):
    corner = Isosurface(((-1,) * 3, (1,) * 3), f=beside_corner, shape=(33,) * 3, lipschitz=lipschitz)
    thin = Isosurface(((-5, -0.5, -0.5), (5, 0.5, 0.5)), f=slab, shape=(11, 41, 41), lipschitz=lipschitz)
    for surface, eye in ((corner, (-3, -3, -3)), (thin, (0.5, 4, 6))):
        camera = Camera.look_at(eye, (0, 0, 0), fov_y=40)
        shown = [rts.render(Part(surface, {}), camera, SIZE, sampler=s)[..., 3] for s in ("raster", "rays")]
        assert shown[0].sum() > 20 and shown[1].sum() == pytest.approx(shown[0].sum(), rel=0.03)


def beside_corner(theta, points):
    xp = rts.namespace(points)
    return xp.sqrt(xp.sum((points - 0.6) ** 2, axis=-1)) - 0.3


def slab(theta, points):
    return rts.namespace(points).abs(points[:, 1]) - 0.03


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_caps_are_met_by_rays_and_face_outwards(scale):
    def field(theta, p):
        xp = rts.namespace(p)
        return scale * (xp.sqrt(p[:, 0] ** 2 + p[:, 1] ** 2 + (p[:, 2] - 1.1) ** 2) - 0.6 - theta["more"])

    surface = Isosurface(BOUNDS, f=field, shape=(33,) * 3, lipschitz=scale)
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=40)
    part = Part(surface, {"more": np.float32(0)})
    areas = []
    for sampler in ("raster", "rays"):
        sampled = rts.sample(part, camera, SIZE, sampler=sampler, splatter=None)
        gbuffer = surface.evaluate(part.theta, sampled.samples[0])
        front = sampled.row[0][sampled.row[0] >= 0]
        np.testing.assert_allclose(gbuffer["position"][front][:, 2], BOUNDS[1][2], atol=1e-5)
        np.testing.assert_allclose(gbuffer["normal"][front], [[0, 0, 1]] * len(front), atol=1e-6)
        areas.append(float(rts.render(part, camera, SIZE, sampler=sampler)[..., 3].sum()))
    assert areas[1] == pytest.approx(areas[0], rel=0.02) and areas[0] > 50


@pytest.mark.parametrize("sampler", ["raster", "rays"])
def test_the_rim_of_a_cap_moves(sampler):
    torch = pytest.importorskip("torch")

    def field(theta, p):
        return (p[:, 0] ** 2 + p[:, 1] ** 2 + 1e-12) ** 0.5 - theta["radius"]

    # A cylinder along the view: nothing is seen of it but a cap.
    bounds = ((-1, -1, -1), (1, 1, 1))
    surface = Isosurface(bounds, f=field, shape=(65,) * 3, lipschitz=1.0)
    camera = Camera.orthographic((0, 0, 4), (0, 0, 0), height=2.5)
    radius = torch.tensor(0.7, requires_grad=True)
    area = rts.render(Part(surface, {"radius": radius}), camera, (128, 128), sampler=sampler, layers=1)[..., 3].sum()
    (slope,) = torch.autograd.grad(area, radius)
    per_area = (128 / 2.5) ** 2
    assert area.item() == pytest.approx(np.pi * 0.49 * per_area, rel=5e-3)
    assert slope.item() == pytest.approx(2 * np.pi * 0.7 * per_area, rel=0.05)


def test_a_constant_surface_with_a_table_has_its_normals():
    torch = pytest.importorskip("torch")
    part = function(21, shader="normals", table=True)
    camera = CAMERA.map(lambda m: torch.from_numpy(np.asarray(m, np.float32)))
    found = rts.render(part, camera, SIZE)
    np.testing.assert_allclose(found.numpy(), rts.render(function(21, shader="normals"), CAMERA, SIZE), atol=1e-4)


def test_torch_transforms_look_through_a_band():
    torch = pytest.importorskip("torch")

    def area(radii):
        part = function(20, band=NarrowBand(lipschitz=1.0)).replace(theta={"radii": radii})
        return rts.render(part, CAMERA, SIZE)[..., 3].sum()

    radii = torch.tensor(RADII["radii"])
    expected = gradient("torch-cpu", area, radii)
    np.testing.assert_allclose(torch.func.grad(area)(radii), expected, rtol=1e-4)


def test_a_field_in_small_units_moves_as_one_in_large_ones():
    torch = pytest.importorskip("torch")
    sdf, slopes = rts.plugin("surfaces", "sdf"), []
    for scale in (1.0, 1e-9):
        surface = sdf(lambda theta, p, s=scale: s * (torus(theta, p) - theta["more"]), radius=1.2, lipschitz=scale)
        more = torch.zeros((), requires_grad=True)
        part = Part(surface, {"radii": torch.tensor(RADII["radii"]), "more": more})
        slopes.append(torch.autograd.grad(rts.render(part, CAMERA, SIZE)[..., 3].sum(), more)[0].item())
    assert slopes[1] == pytest.approx(slopes[0], rel=1e-2) and slopes[0] > 100


def test_what_is_bounded_does_not_depend_on_the_view():
    part = grid(motion="edge")
    least = [
        rts.sample(part, c, SIZE, splatter=None).samples[0].params[0, 3]
        for c in (CAMERA, Camera.look_at((0.3, 0.2, 1.5), (0, 0, 0)))
    ]
    assert least[0] == least[1] > 0


def test_half_precision_is_computed_in_single():
    torch = pytest.importorskip("torch")
    part = grid(BALL, 21)
    values = torch.from_numpy(part.theta["values"]).to(torch.float16)
    samples = map_leaves(torch.as_tensor, rts.sample(part, CAMERA, SIZE, splatter=None).samples[0])
    position = part.surface.evaluate({"values": values}, samples)["position"]
    assert position.dtype == torch.float32
    expected = part.surface.evaluate({"values": values.float()}, samples)["position"]
    np.testing.assert_allclose(position, expected, atol=1e-6)
    assert len(part.surface.extract({"values": part.theta["values"].astype(np.float16)}).faces) > 100


def drawing_refused(match, surface=None, theta=None, **options):
    with refused(match):
        surface = surface or Isosurface(BOUNDS, **options)
        rts.render(Part(surface, theta), CAMERA, (8, 8))


def test_values_that_are_no_lattice_are_refused():
    good = on_lattice(BALL, 5)[0]
    drawing_refused(r"shape \(5, 5\).*\(X, Y, Z\)", theta={"values": good[0]})
    drawing_refused(r"\(5, 1, 5\).*at least 2 points", theta={"values": good[:, :1]})
    drawing_refused(r"\(5, 5, 5\).*\(4, 4, 4\)", shape=(4, 4, 4), theta={"values": good})
    drawing_refused("dtype int", theta={"values": np.rint(good).astype(np.int32)})
    drawing_refused("no 'values'", theta={"density": good})
    bad = good.copy()
    bad[1, 2, 3] = np.nan
    drawing_refused(r"nan at lattice point \[1, 2, 3\]", theta={"values": bad})
    bad[1, 2, 3] = np.inf
    drawing_refused(r"inf at lattice point \[1, 2, 3\]", theta={"values": bad})


@pytest.mark.parametrize("band", [None, NarrowBand(lipschitz=1.0)])
def test_functions_that_break_their_promise_are_refused(band):
    def made(f):
        return Isosurface(BOUNDS, f=f, shape=(5, 5, 5), band=band)

    drawing_refused(r"shape \(\d+, 1\)", made(lambda theta, p: p[:, :1]), {})
    drawing_refused("gave bool for points of float32", made(lambda theta, p: p[:, 0] > 0), {})
    drawing_refused(r"nan at lattice point", made(lambda theta, p: 0 * p[:, 0] + np.float32(np.nan)), {})
    drawing_refused("finds no 'radii'", made(torus), {"radius": np.float32(1)})
    drawing_refused("arrays of NumPy.*into theta", made(lambda theta, p: p.norm(dim=-1)), {})


def test_arguments_are_refused_in_one_line():
    for match, arguments in (
        ("bounds", dict(bounds=((1, 0, 0), (0, 1, 1)))),
        ("shape is None", dict(f=ball)),
        ("2\\*\\*31", dict(f=ball, shape=(1300, 1300, 1300))),
        ("at least 2", dict(f=ball, shape=(5, 5))),
        ("at least 2", dict(f=ball, shape=(5, 5, 1))),
        ("function", dict(table=True)),
        ("reads", dict(reads=("values",))),
        ("isovalue", dict(isovalue=1e300)),
    ):
        with refused(match):
            Isosurface(**{"bounds": BOUNDS, **arguments})


@pytest.mark.parametrize("engine", DIFFERENTIABLE)
def test_isovalues_whose_derivative_would_be_lost_are_refused(engine):
    isovalue, refusal = arrays(engine, np.array(0.5)), "isovalue is an array of .*subtract it from the values"
    for make in (lambda v: Isosurface(BOUNDS, v), lambda v: rts.plugin("surfaces", "sdf")(torus, isovalue=v)):
        with refused(refusal):
            make(isovalue)
        make(float(isovalue))
        make(np.float32(0.5))


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("isovalue", [0.0, 9.0])
def test_without_a_change_of_sign_there_is_an_empty_image_and_a_warning(target, isovalue):
    values = arrays(target, 1 + np.abs(on_lattice(BALL, 5)[0]))
    surface = Isosurface(BOUNDS, isovalue, inside="below" if isovalue == 0 else "above")

    def area(values):
        return rts.render(Part(surface, {"values": values}), CAMERA, (8, 8))[..., 3].sum()

    with pytest.warns(
        rts.errors.EmptyImageWarning, match="the field is outside of the isovalue [09] all over its bounds"
    ):
        slope = gradient(target, area, values, jit=False)
    assert not slope.any()
