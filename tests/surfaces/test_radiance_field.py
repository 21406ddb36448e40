"""Radiance fields: weights, networks in every engine, lattices, colours on surfaces, volume rendering."""

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, arrays, gradient, icosphere, mesh_part, relative_error, to_numpy
from networks import FIELD, network

import rts
from rts import Camera, InputError, Ndc
from rts.arrays.trees import map_leaves, placed_leaves
from rts.operations.unit import unit
from rts.testing import ShaderConformance, SurfaceConformance
from rts_surfaces.radiance_field import lattice as lattices
from rts_surfaces.radiance_field.chunks import in_chunks
from rts_surfaces.radiance_field.field import RadianceField, load_radiance_field
from rts_surfaces.radiance_field.network import check_network, density, density_and_radiance, encoding, radiance
from rts_surfaces.radiance_field.projected import Projected
from rts_surfaces.radiance_field.shader import RadianceShader

pytestmark = pytest.mark.rendering

CAMERA, SIZE = Camera.look_at((2, 1.5, 3), (0, 0, 0), fov_y=40), (20, 24)
POINTS = np.random.default_rng(2).uniform(-1, 1, (50, 3)).astype(np.float32)
DIRECTIONS = unit(np.random.default_rng(3).standard_normal((50, 3))).astype(np.float32)


def plainly(weights, points, directions):
    """Density and colours in float64, a row at a time, as the architecture is written."""

    def waves(v, levels):
        return np.concatenate([v] + [f(2.0**i * v) for i in range(levels) for f in (np.sin, np.cos)])

    def linear(layer, x):
        return np.asarray(layer["weight"], np.float64) @ x + layer["bias"]

    levels = [(weights["layer1"]["weight"].shape[1] - 3) // 6]
    features = weights["fc_feat"]["weight"].shape[0]
    levels.append((weights["layers_dir"][0]["weight"].shape[1] - features - 3) // 6)
    sigma, rgb = [], []
    for p, d in zip(points.astype(np.float64), directions.astype(np.float64), strict=True):
        h = linear(weights["layer1"], waves(p, levels[0]))
        for layer in weights["layers_xyz"]:
            h = np.maximum(linear(layer, h), 0)
        sigma.append(max(linear(weights["fc_alpha"], h)[0], 0))
        g = np.concatenate([np.maximum(linear(weights["fc_feat"], h), 0), waves(d, levels[1])])
        g = np.maximum(linear(weights["layers_dir"][0], g), 0)
        rgb.append(1 / (1 + np.exp(-linear(weights["fc_rgb"], g))))
    return np.array(sigma), np.array(rgb)


# ------------------------------------------------------------------------------------------------------------ network


@pytest.mark.parametrize("target", ALL)
def test_the_network_is_what_is_written(target):
    for levels in ((3, 2), (0, 0), (6, 4)):
        weights = network(6, levels)
        expected = plainly(weights, POINTS, DIRECTIONS)
        assert (expected[0] > 0).any() and (expected[0] == 0).any()
        points, directions = arrays(target, (POINTS, DIRECTIONS))
        for given in (weights, arrays(target, weights)):
            sigma, rgb = to_numpy(density_and_radiance(given, points, directions))
            assert sigma.dtype == rgb.dtype == np.float32
            np.testing.assert_allclose(sigma, expected[0], atol=1e-5)
            np.testing.assert_allclose(rgb, expected[1], atol=1e-5)
            np.testing.assert_array_equal(to_numpy(density(given, points)), sigma)
            np.testing.assert_array_equal(to_numpy(radiance(given, points, directions)), rgb)


@pytest.mark.parametrize("target", ALL)
def test_positions_are_encoded_without_a_factor(target):
    found = to_numpy(encoding(arrays(target, np.array([[0.1, 0.2, 0.3]])), 2))[0]
    v = np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(found, np.concatenate([v, np.sin(v), np.cos(v), np.sin(2 * v), np.cos(2 * v)]), 1e-6)


@pytest.mark.parametrize("target", ALL)
@pytest.mark.parametrize("scene", ["lego", "fern"])
def test_pretrained_networks_give_what_is_expected_of_them(data, scene, target):
    field = rts.load_radiance_field(data / f"nerf/{scene}_lowres.npz")
    levels = {"lego": 10, "fern": 6}[scene]
    assert field.architecture() == (levels, 4, 128, 4, {"lego": 84548, "fern": 81476}[scene])
    queries = np.load(data / f"nerf/{scene}_queries.npz")
    points, directions = arrays(target, (queries["xyz"], queries["viewdir"]))
    for name in ("coarse", "fine"):
        weights = arrays(target, field.weights[name])
        sigma, rgb = to_numpy(density_and_radiance(weights, points, directions))
        expected = np.maximum(queries[f"{name}_sigma_raw"], 0)
        np.testing.assert_allclose(sigma, expected, atol=1e-5 * expected.max())
        # What is expected was computed in float32, too, and is up to 1.8e-5 off itself.
        np.testing.assert_allclose(rgb, queries[f"{name}_rgb"], atol=2e-5)


@pytest.mark.parametrize("target", ALL)
def test_chunks_change_nothing_but_memory(target):
    weights, points = arrays(target, (FIELD.weights["fine"], POINTS))
    whole = to_numpy(density(weights, points))
    for rows in (1, 7, 25, 50, 1000):
        found = to_numpy(in_chunks(lambda p: density(weights, p), rows, points))
        np.testing.assert_allclose(found, whole, atol=1e-6)


# -------------------------------------------------------------------------------------------------------------- files


def saved(path, weights, **changes):
    """Weights as an .npz; a change is an array in place of one, or None to leave it out."""
    named = {".".join(map(str, place)): x for place, x in placed_leaves(weights)} | changes
    np.savez(path, **{name: x for name, x in named.items() if x is not None})
    return path


def refused(call, *parts):
    with pytest.raises(InputError) as caught:
        call()
    text = str(caught.value)
    assert all(part in text for part in parts) and "\n" not in text, text


@pytest.mark.parametrize("target", ALL)
def test_weights_come_back_from_files(tmp_path, target):
    path = tmp_path / "new" / "field.npz"
    RadianceField(arrays(target, FIELD.weights)).save(path)
    found = rts.load_radiance_field(path)
    for (place, a), (expected, b) in zip(placed_leaves(found.weights), placed_leaves(FIELD.weights), strict=True):
        assert place == expected and a.dtype == np.float32
        np.testing.assert_array_equal(a, b)
    assert "position_levels=3" in repr(found)
    refused(lambda: found.save(tmp_path / "field.pt"), "ending in .npz")


def test_wrong_weights_are_refused_by_the_name_of_the_layer(tmp_path):
    def load(**changes):
        return lambda: load_radiance_field(saved(tmp_path / "x.npz", FIELD.weights, **changes))

    load()()
    coarse = {name: None for name in np.load(tmp_path / "x.npz") if name.startswith("coarse")}
    refused(load(**coarse), "lacks the layer 'coarse.layer1'")
    nothing = {"fine.layer1.weight": None, "fine.layer1.bias": None}
    refused(load(**nothing), "'fine'", "lacks the layer 'layer1'")
    refused(load(**{"fine.fc_rgb.bias": None}), "'weight' and 'bias' of the layer 'fc_rgb'")
    gap = {"fine.layers_xyz.0.weight": None, "fine.layers_xyz.0.bias": None}
    refused(load(**gap), "lacks the layer 'fine.layers_xyz.0'")
    none = {f"fine.layers_dir.0.{kind}": None for kind in ("weight", "bias")}
    refused(load(**none), "lacks the layer 'layers_dir'")
    for name, shape, layer in (
        ("layer1.weight", (8, 20), "'layer1' for 20"),
        ("layers_xyz.1.weight", (8, 7), "'layers_xyz.1'"),
        ("fc_alpha.bias", (2,), "'fc_alpha'"),
        ("fc_feat.weight", (8,), "'fc_feat'"),
        ("layers_dir.0.weight", (6, 8), "'layers_dir.0' for 0"),
        ("fc_rgb.weight", (4, 6), "'fc_rgb'"),
    ):
        refused(load(**{f"fine.{name}": np.zeros(shape, np.float32)}), "'fine'", layer)
    for name in ("layer1.weight", "fine.layer1", "fine.layer1.0.weight", "fine.fc_rgb.scale", "fine.layers_xyz.weight"):
        refused(load(**{name: np.zeros((2, 2), np.float32)}), f"'{name}'", "no layer that is known")
    refused(load(**{"fine.fc_rgb.bias": np.zeros(3, np.int32)}), "dtype int32")
    refused(load(**{"fine.fc_rgb.bias": np.array([0, np.nan, 0])}), "NaN", "'fine.fc_rgb.bias'")
    refused(load(**{"fine.fc_rgb.bias": np.array([0, 1e300, 0])}), "too large", "'fine.fc_rgb.bias'")
    refused(lambda: RadianceField({"fine": network()}), "'coarse' and 'fine'")
    refused(lambda: check_network([1]), "dict of layers")


def test_pickles_and_damaged_files_are_refused(tmp_path):
    path = saved(tmp_path / "field.npz", FIELD.weights, **{"fine.fc_rgb.bias": np.array([{"a": 1}], object)})
    refused(lambda: rts.load_radiance_field(path), "no .npz of weights", "allow_pickle=False")
    content = saved(path, FIELD.weights).read_bytes()
    for damaged in (content[:2000], b"", b"text", content[:3000] + b"damage" + content[3006:]):
        path.write_bytes(damaged)
        refused(lambda: rts.load_radiance_field(path), "no .npz of weights")
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "array.npy").rename(path)
    refused(lambda: rts.load_radiance_field(path), "no .npz of weights")
    refused(lambda: rts.load_radiance_field(tmp_path / "none.npz"), "no file")
    refused(lambda: rts.load_radiance_field(3), "the path is a int")


# ------------------------------------------------------------------------------------------------------------ lattice

BOUNDS, SHAPE = ((-1, -0.5, 0), (1, 0.5, 0.25)), (5, 4, 3)


def test_a_lattice_holds_the_density_at_its_points(tmp_path):
    found = FIELD.lattice(BOUNDS, SHAPE, keep=False)
    axes = [np.linspace(a, b, n) for a, b, n in zip(*BOUNDS, SHAPE, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    expected = plainly(FIELD.weights["fine"], points, points)[0].reshape(SHAPE)
    assert found.dtype == np.float32 and (expected > 0).any()
    np.testing.assert_allclose(found, expected, atol=1e-5)
    coarse = FIELD.lattice(BOUNDS, SHAPE, keep=tmp_path, network="coarse")
    assert np.abs(coarse - found).max() > 0.1


def test_a_lattice_is_evaluated_once(tmp_path, monkeypatch):
    calls = []
    computed = lattices._computed
    monkeypatch.setattr(lattices, "_computed", lambda *args: calls.append(1) or computed(*args))
    folder = tmp_path / "cache"

    def lattice(field=FIELD, bounds=BOUNDS, shape=SHAPE):
        return field.lattice(bounds, shape, keep=folder)

    first = lattice()
    (file,) = folder.iterdir()
    np.testing.assert_array_equal(lattice(), first)
    assert len(calls) == 1
    for damaged in (file.read_bytes()[:-30], b"", file.read_bytes().replace(first.tobytes(), b"\1" * first.nbytes)):
        file.write_bytes(damaged)
        np.testing.assert_array_equal(lattice(), first)
        assert list(folder.iterdir()) == [file]
    assert len(calls) == 4
    np.savez(file, density=first[:2])
    np.testing.assert_array_equal(lattice(), first)
    weights = map_leaves(lambda x: x.copy(), FIELD.weights)
    weights["fine"]["fc_rgb"]["bias"][1] += 1
    for change in (
        {"field": RadianceField(weights)},
        {"bounds": ((-1, -0.5, 0), (1, 0.5, 0.26))},
        {"shape": (4, 5, 3)},
    ):
        lattice(**change)
    assert len(calls) == 8 and len(list(folder.iterdir())) == 4


def test_the_users_cache_is_where_lattices_are_kept_by_default(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    FIELD.lattice(BOUNDS, SHAPE)
    assert len(list((tmp_path / "rts").glob("density-*.npz"))) == 1
    # What cannot be kept is computed all the same.
    (tmp_path / "file").write_text("")
    assert FIELD.lattice(BOUNDS, SHAPE, keep=tmp_path / "file").shape == SHAPE


def test_a_lattice_has_a_progress_bar(capsys):
    FIELD.lattice(BOUNDS, SHAPE, keep=False, progress=True)
    assert "density" in capsys.readouterr().err


def test_wrong_lattices_are_refused():
    for bounds, shape, message in (
        (((0, 0, 0), (1, 1, 0)), SHAPE, "each x0 < x1"),
        ((0, 1), SHAPE, "bounds"),
        (BOUNDS, (3, 3), "shape (3, 3)"),
        (BOUNDS, (3, 3, 1), "at least 2 points"),
        (BOUNDS, (3, 3, 2.5), "shape (3, 3, 2.5)"),
        (BOUNDS, (2000, 2000, 2000), "at most 2**31"),
    ):
        refused(lambda b=bounds, s=shape: FIELD.lattice(b, s, keep=False), message)
    refused(lambda: FIELD.lattice(BOUNDS, SHAPE, network="finest"), "network is 'finest'")


# ------------------------------------------------------------------------------------------------------------- shader


class TestRadianceShader(ShaderConformance):
    @pytest.fixture
    def shader(self):
        return RadianceShader(chunk=25)

    @pytest.fixture
    def theta(self):
        return {"weights": network(6)}


def surface(target="numpy", chunk=100, ndc=None, network_=FIELD.weights["fine"]):
    return mesh_part(
        arrays(target, icosphere(2)),
        theta={"weights": arrays(target, network_)},
        shader=RadianceShader(ndc=ndc, chunk=chunk),
    )


def test_colours_are_those_of_the_ray_that_meets_the_surface():
    part = surface()
    image = rts.render(part, CAMERA, SIZE, splatter="none")
    samples = rts.sample(part, CAMERA, SIZE, layers=1, splatter=None).samples[0]
    found = part.surface.evaluate(part.theta, samples)["position"]
    eye = np.linalg.inv(CAMERA.view)[:3, 3]
    expected = plainly(part.theta["weights"], found, unit(found - eye))[1]
    border = (samples.row.shape[1] - SIZE[0]) // 2
    row = samples.row[0, border : border + SIZE[0], border : border + SIZE[1]]
    assert (row >= 0).sum() > 100
    np.testing.assert_allclose(image[row >= 0][:, :3], expected[row[row >= 0]], atol=1e-4)
    np.testing.assert_array_equal(image[..., 3], row >= 0)
    named = rts.render(part.replace(shader="radiance"), CAMERA, SIZE, splatter="none")
    np.testing.assert_allclose(named, image, atol=1e-6)


def compared(a, b, tolerance):
    """Gradients in weights are alike; density has no part in colours."""
    for (place, x), (_, y) in zip(placed_leaves(a), placed_leaves(b), strict=True):
        if place[0] == "fc_alpha":
            assert not x.any() and not y.any()
        else:
            assert np.abs(y).max() > 0 and relative_error(x, y) < tolerance, place


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_gradients_in_chunks_are_those_of_the_whole(target):
    factor = np.random.default_rng(5).standard_normal((len(POINTS), 4))
    weights, position, factor, camera = arrays(target, (FIELD.weights["fine"], POINTS, factor, CAMERA))

    def loss(weights, chunk):
        shader = RadianceShader(chunk=chunk)
        return (shader({"weights": weights}, rts.GBuffer(position=position), camera) * factor).sum()

    whole, parts = (gradient(target, lambda w, c=chunk: loss(w, c), weights) for chunk in (50, 20))
    compared(parts, whole, 1e-4)


def test_only_colours_are_kept_for_the_gradient():
    torch = pytest.importorskip("torch")
    weights, points, directions = arrays("torch-cpu", (network(width=64, narrow=32), POINTS, DIRECTIONS))
    points, directions = points.repeat(40, 1), directions.repeat(40, 1)
    weights = map_leaves(lambda x: x.requires_grad_(True), weights)

    def kept(chunk):
        held = {}

        def pack(x):
            held[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
            return x

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
            loss = in_chunks(lambda p, d: radiance(weights, p, d), chunk, points, directions).sum()
        return sum(held.values()), loss

    few, a = kept(100)
    many, b = kept(2000)
    assert few < 0.1 * many
    found, expected = (torch.autograd.grad(x, weights["layer1"]["weight"])[0] for x in (a, b))
    assert relative_error(found, expected) < 1e-4


def test_a_compiled_program_may_shade():
    jax = pytest.importorskip("jax")
    part = surface("jax")

    @jax.jit
    def image(theta):
        return rts.render(part.replace(theta=theta), CAMERA, SIZE)

    np.testing.assert_allclose(image(part.theta), rts.render(surface(), CAMERA, SIZE), atol=1e-4)


def test_a_surface_in_the_world_may_have_a_field_in_ndc():
    ndc = Ndc.of_images(SIZE, 20)
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=40)
    part = surface(ndc=ndc, chunk=10_000).replace(transform=np.diag([0.5, 0.5, 0.5, 1]))
    samples = rts.sample(part, camera, SIZE, layers=1, splatter=None)
    assert (samples.samples[0].row >= 0).sum() > 50
    position = POINTS - [0, 0, 3]
    found = part.shader(part.theta, rts.GBuffer(position=position), camera)
    direction = unit(position - [0, 0, 3])
    np.testing.assert_allclose(
        found[:, :3], plainly(FIELD.weights["fine"], ndc.from_world(position), direction)[1], atol=1e-5
    )


def test_wrong_shaders_are_refused():
    refused(lambda: RadianceShader(chunk=0), "chunk is 0")
    refused(lambda: RadianceShader(ndc=3), "ndc is 3")
    part = surface()
    refused(lambda: rts.render(part.replace(theta={"vertices": part.theta["vertices"]}), CAMERA, SIZE), "['vertices']")
    theta = {**part.theta, "weights": {**part.theta["weights"], "fc_rgb": part.theta["weights"]["fc_alpha"]}}
    refused(lambda: rts.render(part.replace(theta=theta), CAMERA, SIZE), "theta['weights']", "'fc_rgb'")


# ---------------------------------------------------------------------------------------------------------------- NDC


@pytest.mark.parametrize("target", ALL)
def test_ndc_is_that_of_nerf(target):
    size, focal = (30, 40), 35.0
    ndc = Ndc.of_images(size, focal)
    points = POINTS * [2, 2, 1] - [0, 0, 3]
    found = to_numpy(ndc.from_world(arrays(target, points)))
    x, y, z = points.T
    # Appendix C of the paper.
    expected = np.stack([-focal / 20 * x / z, -focal / 15 * y / z, 1 + 2 / z], axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(to_numpy(ndc.to_world(arrays(target, found))), points, rtol=1e-4, atol=1e-5)
    # Behind the camera and at infinity numbers stay numbers.
    awkward = arrays(target, np.array([[0.1, 0.2, 0.0], [0.1, 0.2, 1.0], [0.0, 0.0, 2.0]]))
    for found in (ndc.from_world(awkward), ndc.to_world(awkward)):
        assert np.isfinite(to_numpy(found)).all()


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_ndc_is_differentiable(target):
    ndc, points = Ndc((1.5, 2.0)), POINTS - np.float32([0, 0, 3])
    back = gradient(target, lambda p: (ndc.to_world(ndc.from_world(p)) ** 2).sum(), arrays(target, points))
    np.testing.assert_allclose(back, 2 * points, rtol=1e-3, atol=1e-3)


def test_rays_in_ndc_are_straight_and_reach_infinity():
    ndc = Ndc((1.5, 2.0), near=0.5)
    origins, directions = 0.2 * POINTS.astype(np.float64), DIRECTIONS * [0.3, 0.3, 0] - [0, 0, 1]
    start, step = ndc.rays(origins, directions)
    np.testing.assert_allclose(start[:, 2], -1, atol=1e-12)
    np.testing.assert_allclose(step[:, 2], 2, atol=1e-12)
    for t in (0.0, 0.3, 0.9):
        world = ndc.to_world(start + t * step)
        np.testing.assert_allclose(np.cross(world - origins, directions), 0, atol=1e-9)
    refused(lambda: Ndc.of_images((3, 4), -1), "focal is -1")


# ------------------------------------------------------------------------------------------------------------- volume


def test_a_volume_is_what_its_quadrature_says():
    found = FIELD.volume_render(CAMERA, (5, 6), near=1, far=5, samples=(10, 7), background=None)
    assert found.image.shape == (5, 6, 4) and (found.coarse, found.fine) == (300, 510)
    rays = CAMERA.rays((5, 6))
    for y, x in ((0, 0), (3, 2), (4, 5)):
        o, d = rays.origins[y, x], rays.directions[y, x]

        def shaded(name, t, o=o, d=d):
            view = np.tile(d / np.linalg.norm(d), (len(t), 1))
            sigma, rgb = plainly(FIELD.weights[name], o + t[:, None] * d, view)
            alpha = 1 - np.exp(-sigma * np.append(np.diff(t), 1e10) * np.linalg.norm(d))
            weights = alpha * np.cumprod(np.append(1, 1 - alpha[:-1]))
            return weights, weights @ rgb

        t = np.linspace(1, 5, 10)
        weights = shaded("coarse", t)[0][1:-1] + 1e-5
        total = np.append(0, np.cumsum(weights / weights.sum()))
        placed = np.interp(np.linspace(0, 1, 7), total, (t[1:] + t[:-1]) / 2)
        weights, color = shaded("fine", np.sort(np.append(t, placed)))
        np.testing.assert_allclose(found.image[y, x], [*color, weights.sum()], atol=1e-3)
    white = FIELD.volume_render(CAMERA, (5, 6), near=1, far=5, samples=(10, 7)).image
    np.testing.assert_allclose(white, found.image[..., :3] + 1 - found.image[..., 3:], atol=1e-6)


def test_lego_is_the_reference(data):
    field = rts.load_radiance_field(data / "nerf/lego_lowres.npz")
    reference = np.load(data / "nerf/lego_reference_render.npz")
    camera = Camera.from_blender(reference["c2w"], (100, 100), focal=float(reference["focal"]))
    # NeRF's rays pass through 0.375 of the pixels.
    camera = camera.window((100, 100), (45 - 0.125, -0.125), (10, 100))
    found = field.volume_render(camera, (10, 100))
    np.testing.assert_allclose(found.image, reference["rgb"][45:55], atol=3e-3)
    assert (found.coarse, found.fine) == (64_000, 128_000)
    images = np.load(data / "nerf/lego_images_100.npz")
    psnr = -10 * np.log10(np.mean((found.image - images["test_rgb"][0][45:55] / 255) ** 2))
    assert psnr > 22


def test_fern_is_like_its_photograph(data):
    field = rts.load_radiance_field(data / "nerf/fern_lowres.npz")
    fern = np.load(data / "nerf/fern_images_378.npz")
    height, width, focal = fern["hwf"]
    ndc = Ndc.of_images((int(height), int(width)), focal)
    size, n = (42, 56), 9
    photo = (fern["rgb"][0] / 255).reshape(42, n, 56, n, 3).mean(axis=(1, 3))
    camera = Camera.from_blender(fern["c2w"][0], size, focal=focal / n)
    shift = (n - 1) / (2 * n) - 0.5
    camera = camera.window(size, (15 + shift, shift), (12, 56))
    found = field.volume_render(camera, (12, 56), ndc=ndc, background="black")
    assert -10 * np.log10(np.mean((found.image - photo[15:27]) ** 2)) > 22


@pytest.mark.parametrize("target", ALL)
def test_weights_of_every_engine_are_drawn(target):
    options = {"near": 1, "far": 5, "samples": (8, 8)}
    expected = FIELD.volume_render(CAMERA, (4, 5), **options).image
    field = RadianceField(arrays(target, FIELD.weights))
    np.testing.assert_array_equal(field.volume_render(CAMERA, (4, 5), **options).image, expected)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"camera": 3}, "camera is 3"),
        ({"camera": Camera.orthographic((0, 0, 5), (0, 0, 0), height=2)}, "orthographic"),
        ({"size": (0, 3)}, "size is (0, 3)"),
        ({"samples": 64}, "samples is 64"),
        ({"samples": (2, 64)}, "samples is (2, 64)"),
        ({"near": 7}, "near < far"),
        ({"near": -1}, "near > 0"),
        ({"background": "pink"}, "'pink'"),
        ({"ndc": Ndc((1, 1)), "near": 1}, "near and far are given with ndc"),
        ({"ndc": 3}, "ndc is 3"),
    ],
)
def test_wrong_arguments_are_refused(changes, message):
    given = {"camera": CAMERA, "size": (4, 5), **changes}
    refused(lambda: FIELD.volume_render(**given), message)


# ------------------------------------------------------------------------------------------------ surfaces out of NDC


class TestProjected(SurfaceConformance):
    @pytest.fixture
    def part(self):
        return Projected.example()


def test_a_ball_in_ndc_is_a_ball_in_the_world():
    part = Projected.example()
    camera = Camera.look_at((0.6, 0.4, 2), (0, 0, 0), fov_y=50)
    samples = rts.sample(part, camera, (48, 48), layers=2, splatter=None).samples[0]
    found = part.surface.evaluate(part.theta, samples)
    outward = found["position"] + [0, 0, 2]
    radius = np.linalg.norm(outward, axis=1)
    assert len(radius) > 1000 and np.abs(radius - 0.7).max() < 0.02
    assert ((found["normal"] * outward).sum(axis=1) / radius).min() > 0.99
    # Triangles face outwards.
    front = rts.render(part.replace(cull="back"), camera, (48, 48), layers=1)
    np.testing.assert_allclose(front, rts.render(part, camera, (48, 48), layers=1), atol=1e-6)


def test_surfaces_whose_triangles_move_are_not_projected():
    ndc = Ndc((1, 1))
    refused(lambda: Projected(rts.plugin("surfaces", "bspline").example().surface, ndc), "no camera changes")
    refused(lambda: Projected(Projected.example().surface.surface, 3), "ndc is 3")
