"""Arrays on another device than the CPU: the same images and derivatives, results there, and few copies to the host.

Every machine has one such device of torch, `elsewhere.DEVICE`; GPUs are tested where torch or jax has any. Other files
test jax on the CPU.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import elsewhere
import numpy as np
import pytest
from example_surfaces import part_of
from helpers import icosphere, relative_error, to_numpy

import rts
from benchmarks.gpu.run import counts
from rts.arrays.trees import leaves, map_leaves
from rts.shadows import with_shadows

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.devices

ROOT = Path(__file__).resolve().parents[2]
SIZE = (16, 20)
CAMERA = rts.Camera.look_at((1.0, 1.5, 3.2), (0, 0, 0), fov_y=45, aspect=SIZE[1] / SIZE[0])
BALL, FACES = icosphere(2)
RNG = np.random.default_rng(0)
COLORS = RNG.uniform(0.2, 0.9, BALL.shape)


# ------------------------------------------------------------------------------------------------------- devices


class Place:
    """An engine and one of its devices.

    Args:
        name: such as "torch-cuda" or "jax-cuda"; "torch-elsewhere" for `elsewhere.DEVICE`.
    """

    def __init__(self, name):
        self.name = name
        self.engine, self.device = name.split("-")
        self.device = elsewhere.DEVICE.type if self.device == "elsewhere" else self.device

    def entered(self):
        """What has to be entered for as long as the device is used."""
        return elsewhere.Device() if self.device == elsewhere.DEVICE.type else contextlib.nullcontext()

    def put(self, tree):
        """NumPy arrays as arrays on the device; floats as float32."""
        return map_leaves(self._array, tree)

    def _array(self, x):
        x = np.asarray(x, np.float32) if np.issubdtype(np.asarray(x).dtype, np.floating) else np.asarray(x)
        if self.engine == "torch":
            return torch.from_numpy(x.copy()).to(self.device)
        import jax

        return jax.device_put(x, jax.devices(self.device)[0])

    def take(self, tree):
        """Arrays on the device as NumPy arrays; an array that is elsewhere fails the test."""
        for x in leaves(tree):
            found = x.device.type if self.engine == "torch" else next(iter(x.devices())).platform
            expected = "gpu" if (self.engine, self.device) == ("jax", "cuda") else self.device
            assert found == expected, f"an array is on {found}, not on {expected}"
        return to_numpy(tree)

    def gradient(self, f, tree):
        """The value and the gradient of a scalar function of a tree, by reverse mode, as arrays on the device."""
        return rts.engine_of(*leaves(tree)).value_and_grad(f)(tree)

    def tangent(self, f, tree, along):
        """The value of `f` and its derivative along a tree, by forward mode, as arrays on the device."""
        return rts.engine_of(*leaves(tree)).jvp(f, tree, along)


def _places():
    names = ["torch-elsewhere"]
    if torch.cuda.is_available():
        names.append("torch-cuda")
    if importlib.util.find_spec("jax"):
        import jax

        names += ["jax-cuda"] * (jax.default_backend() == "gpu")
    return names


PLACES = _places()


@pytest.fixture(params=PLACES)
def place(request):
    place = Place(request.param)
    with place.entered():
        yield place


CPU = Place("torch-cpu")


# -------------------------------------------------------------------------------------------------------- scenes


class Case(NamedTuple):
    """A picture: parts of arrays, and options of `rts.render`."""

    parts: tuple
    options: dict = {}


def ball(shader="lambert", move=(0.0, 0.0, 0.0), **theta):
    arrays = {"vertices": BALL + np.asarray(move), "colors": COLORS, **theta}
    return rts.Part(rts.Mesh(FACES), arrays, shader)


def textured(shader="textured"):
    uv = (BALL[:, :2] + 1) / 2
    return rts.Part(
        rts.Mesh(FACES), {"vertices": BALL, "uv": uv, "texture": np.random.default_rng(2).random((16, 16, 3))}, shader
    )


def glass(theta, gbuffer, camera):
    """The colour of a sample, half of which is seen through."""
    color = gbuffer["color"]
    return rts.namespace(color).concat([color, 0 * color[:, :1] + 0.5], axis=1)


def field(theta, points):
    """A ball with a bump, negative inside."""
    xp = rts.namespace(points)
    bump = 0.1 * xp.sin(5 * points[:, 0]) * xp.cos(5 * points[:, 1])
    return xp.sqrt(xp.sum(points * points, axis=1)) - theta["radius"] + bump


def isosurface(**options):
    surface = rts.Isosurface((24, 24, 24), ((-1.3,) * 3, (1.3,) * 3), field, **options)
    return rts.Part(surface, {"radius": np.array(0.9)}, "normals")


def reflecting():
    """A ball half of metal in the light of an image of all around."""
    room = {"environment": np.random.default_rng(2).uniform(0.2, 1, (8, 16, 3))}
    part = ball("pbr")
    return part.replace(theta={**part.theta, "metallic": np.array(0.5), "roughness": np.array(0.45), "light": room})


def embossed():
    """A textured ball with a normal map, half of metal, under a lamp."""
    part, rng = textured("pbr"), np.random.default_rng(2)
    bent = np.concatenate([rng.uniform(-0.3, 0.3, (8, 8, 2)), np.ones((8, 8, 1))], axis=2)
    light = {"direction": np.array([0.3, 1, 1]), "ambient": np.array(0.2), "sh": rng.uniform(0, 0.2, (9, 3))}
    return part.replace(theta={**part.theta, "normal_map": bent, "metallic": np.array(0.5), "light": light})


CASES = {
    **{
        name: lambda name=name: Case((part_of(name),))
        for name in ("mesh", "skinned", "bezier", "bspline", "revolution")
    },
    "subdivision": lambda: Case((part_of("subdivision"),)),
    "isosurface": lambda: Case((part_of("isosurface"),)),
    "sdf": lambda: Case((rts.Part(rts.Sdf(field, 1.4), {"radius": np.array(0.9)}, "normals"),)),
    **{
        name: lambda name=name: Case((ball(),), {"splatter": name, "layers": 1 if name == "single" else 2})
        for name in ("none", "single", "multi", "edges")
    },
    "translucent": lambda: Case((ball(glass), ball("unlit", (0.4, 0.2, -1.5))), {"layers": 4}),
    **{
        name: lambda name=name: Case((ball(name),))
        for name in ("unlit", "normals", "silhouette", "blinn_phong", "depth")
    },
    "environment": lambda: Case((reflecting(),)),
    "texture": lambda: Case((textured(),)),
    "normal map": lambda: Case((embossed(),)),
    "mipmaps": lambda: Case((textured(rts.plugin("shaders", "unlit")(mip=True)),)),
    "lit texture": lambda: Case((textured("lambert"),)),
    **{
        name: lambda name=name: Case((ball(),), {"sampler": name})
        for name in ("raster", "reference", "embree", "opengl")
    },
    "two parts": lambda: Case((ball(), ball("unlit", (0.7, 0.3, 0.4)))),
    "supersampled": lambda: Case((ball(),), {"supersample": 2}),
    "auto layers": lambda: Case((ball(), ball("unlit", (0.7, 0.3, 0.4))), {"layers": "auto"}),
    "capacity": lambda: Case((ball(),), {"capacity": 2000}),
    "background": lambda: Case((ball(),), {"background": (0.1, 0.4, 0.8)}),
}


def arrays_of(case):
    """Every number of the parts, and the camera's view, as NumPy arrays."""
    return {"theta": [dict(part.theta) for part in case.parts], "view": np.asarray(CAMERA.view)}


def image_of(case, tree):
    parts = [part.replace(theta=theta) for part, theta in zip(case.parts, tree["theta"], strict=True)]
    return rts.render(parts, CAMERA.replace(view=tree["view"]), SIZE, **case.options)


def loss_of(case, weights):
    return lambda tree: (image_of(case, tree) * weights).sum()


WEIGHTS = RNG.normal(size=(*SIZE, 4))


@functools.cache
def on_the_cpu(name):
    """Image, gradient, and derivative of the image along a direction, by torch on the CPU, as NumPy arrays."""
    case = CASES[name]()
    tree = CPU.put(arrays_of(case))
    _, gradient = CPU.gradient(loss_of(case, CPU.put(WEIGHTS)), tree)
    image, tangent = CPU.tangent(lambda t: image_of(case, t), tree, CPU.put(direction(case)))
    return to_numpy(image), to_numpy(gradient), to_numpy(tangent)


def direction(case):
    rng = np.random.default_rng(1)
    return map_leaves(lambda x: 0.1 * rng.normal(size=np.shape(x)), arrays_of(case))


def needed(name):
    """The case, unless a package that its sampler needs is missing."""
    case = CASES[name]()
    try:
        if "sampler" in case.options:
            rts.plugin("samplers", case.options["sampler"])
    except rts.errors.PluginError as error:
        pytest.skip(str(error))
    return case


# --------------------------------------------------------------------------------------------------------- images

QUICK = ("mesh", "lit texture", "environment", "mipmaps")
"""Cases for `make test`."""
EVERY_CASE = [pytest.param(n, marks=[pytest.mark.thorough] * (n not in QUICK)) for n in CASES]


NAMES = ("color", "depth", "normal", "uv", "alpha", "depth_front", "part", "triangle")


def test_outputs_are_those_of_the_cpu(place):
    def outputs(place):
        parts = [place.put(dict(part.theta)) for part in (textured("lambert"), ball("unlit", (0.7, 0.3, 0.4)))]
        made = [textured("lambert").replace(theta=parts[0]), ball("unlit").replace(theta=parts[1])]
        return rts.render(made, CAMERA, SIZE, outputs=NAMES)

    found, expected = place.take(outputs(place)), to_numpy(outputs(CPU))
    for name in NAMES:
        np.testing.assert_allclose(found[name], expected[name], atol=1e-5, err_msg=name)


def test_shadows_are_those_of_the_cpu(place):
    wall = np.array([(-3, -3, -1.5), (3, -3, -1.5), (3, 3, -1.5), (-3, 3, -1.5)])

    def of(place):
        def loss(tree):
            floor = rts.Part(rts.Mesh([(0, 1, 2), (0, 2, 3)]), {"vertices": place.put(wall)}, "lambert")
            caster = rts.Part(rts.Mesh(FACES), {"vertices": place.put(BALL) + tree["move"]}, "lambert")
            light = {"direction": tree["direction"], "ambient": 0.2}
            parts = with_shadows([caster, floor], light, size=32)
            return (rts.render(parts, CAMERA, SIZE)[..., :3] ** 2).sum()

        return place.gradient(loss, place.put({"move": np.zeros(3), "direction": np.array([0.3, 0.5, 1.0])}))

    (value, slopes), (expected, others) = place.take(of(place)), to_numpy(of(CPU))
    np.testing.assert_allclose(value, expected, rtol=1e-4)
    for name, slope in others.items():
        np.testing.assert_allclose(slopes[name], slope, atol=1e-3 * np.linalg.norm(slope), err_msg=name)


@pytest.mark.parametrize("name", EVERY_CASE)
def test_images_and_derivatives_are_those_of_the_cpu(place, name):
    case = needed(name)
    tree = place.put(arrays_of(case))
    image, gradient, tangent = on_the_cpu(name)
    # Steps along rays, taken on the device, end where its rounding has them end.
    exact = 1e-5 if name != "sdf" else 1e-4
    np.testing.assert_allclose(place.take(image_of(case, tree)), image, atol=exact)
    weights = place.put(WEIGHTS)
    elsewhere.copies.clear(), elsewhere.waits.clear()
    value, slopes = place.gradient(loss_of(case, weights), tree)
    # The host gets inputs of samplers; loops along rays ask whether any goes on.
    assert elsewhere.copies or place.name != "torch-elsewhere"
    assert all(line.endswith((" to_host", " on_host")) for line in elsewhere.copies), elsewhere.copies
    loops = ("_repeated", "_cast_some") if name == "sdf" else ()
    assert all(line.endswith(loops) for line in elsewhere.waits) if loops else not elsewhere.waits, elsewhere.waits
    assert abs(float(place.take(value)) - (image * WEIGHTS).sum()) < 1e-3
    scale = max(np.linalg.norm(x) for x in leaves(gradient))
    for mine, other in zip(leaves(place.take(slopes)), leaves(gradient), strict=True):
        assert np.linalg.norm(mine - other) <= 10 * exact * max(np.linalg.norm(other), 1e-3 * scale)
    _, moved = place.tangent(lambda t: image_of(case, t), tree, place.put(direction(case)))
    assert np.linalg.norm(tangent) > 0 and relative_error(place.take(moved), tangent) < 10 * exact


# ----------------------------------------------------------------------------------------------------------- fits

POSE = np.array([0.1, -0.05, 0.08, 0.05, 0.03, -0.04])


def posed(parameters):
    return ball("lambert").replace(transform=rts.rigid(parameters["pose"]))


@pytest.mark.parametrize("method", [pytest.param("lm", marks=pytest.mark.thorough), "adam"])
def test_fits_stay_on_the_device(place, method):
    target = rts.render(ball("lambert"), CAMERA, SIZE)
    residuals = rts.ImageResiduals(posed, CAMERA, SIZE, target)
    found = rts.fit(residuals, place.put({"pose": POSE}), method=method, steps=6, progress=False)
    expected = rts.fit(residuals, CPU.put({"pose": POSE}), method=method, steps=6, progress=False)
    assert found.loss < 0.8 * found.history[0]
    np.testing.assert_allclose(place.take(found.parameters)["pose"], to_numpy(expected.parameters)["pose"], atol=2e-4)


def test_views_are_fitted_on_the_device(place):
    cameras = [CAMERA, rts.Camera.look_at((-2.0, 1.0, 3.0), (0, 0, 0), fov_y=45, aspect=SIZE[1] / SIZE[0])]
    views = [rts.View(c, rts.render(ball("lambert"), c, SIZE), name=str(i)) for i, c in enumerate(cameras)]
    found, expected = (
        rts.fit(rts.ViewResiduals(posed, views), p.put({"pose": POSE}), steps=4, progress=False) for p in (place, CPU)
    )
    np.testing.assert_allclose(place.take(found.parameters)["pose"], to_numpy(expected.parameters)["pose"], atol=2e-4)


def test_large_steps_and_energies(place):
    steps = rts.LargeSteps(BALL, FACES)
    bent = BALL + 0.05 * np.random.default_rng(3).normal(size=BALL.shape)
    for f in (
        lambda v: (steps.decode(steps.encode(v) * 1.1) ** 2).sum(),
        rts.regularizers.ARAP(BALL, FACES),
        rts.regularizers.Laplacian(BALL, FACES, "cotangent"),
        rts.regularizers.EdgeLength(BALL, FACES),
        rts.regularizers.NormalConsistency(FACES),
    ):
        value, slope = place.take(place.gradient(f, place.put(bent)))
        expected, other = to_numpy(CPU.gradient(f, CPU.put(bent)))
        np.testing.assert_allclose(value, expected, rtol=1e-4)
        # The solution of `LargeSteps` is by array code in float32 there, not by a factorisation in float64.
        assert relative_error(slope, other) < 1e-3


# ---------------------------------------------------------------------------------------------------- other users


def test_gradients_are_checked(place):
    pose = place.put(np.zeros(6))
    found = rts.check_gradient(
        lambda p: (ball("silhouette").replace(transform=rts.rigid(p)), CAMERA),
        pose,
        SIZE,
        entries=2,
        samples=2,
        progress=False,
    )
    assert found is not None


def test_images_of_derivatives(place):
    def image(pose):
        return rts.render(ball("lambert").replace(transform=rts.rigid(pose)), CAMERA, SIZE)

    along = np.eye(6)[3]
    mine, other = (rts.gradient_image(image, p.put(np.zeros(6)), p.put(along)) for p in (place, CPU))
    assert relative_error(to_numpy(mine.derivative), to_numpy(other.derivative)) < 1e-4


# --------------------------------------------------------------------------------------------------------- errors


def test_arrays_on_two_devices_are_refused_in_one_line(place):
    if place.device == "cpu":
        pytest.skip("this is the CPU")
    case, host = CASES["mesh"](), Place(f"{place.engine}-cpu")
    tree = place.put(arrays_of(case))
    for mixed in (
        {**tree, "view": host.put(arrays_of(case)["view"])},
        {**tree, "theta": [{**tree["theta"][0], "colors": host.put(case.parts[0].theta["colors"])}]},
    ):
        with pytest.raises(rts.errors.EngineError) as error:
            image_of(case, mixed)
        assert "\n" not in str(error.value) and "on the devices" in str(error.value) and "cpu" in str(error.value)


def test_a_target_on_another_device_is_refused_in_one_line(place):
    if place.engine == "jax":
        pytest.skip("jax moves constants of a compiled program to its device")
    if place.device == "cpu":
        pytest.skip("this is the CPU")
    target = CPU.put(rts.render(ball("lambert"), CAMERA, SIZE))
    with pytest.raises(rts.errors.EngineError, match="on the devices .*cpu"):
        rts.fit(rts.ImageResiduals(posed, CAMERA, SIZE, target), place.put({"pose": POSE}), steps=2, progress=False)


# ------------------------------------------------------------------------------------------------------ operations


def _scaled(calls):
    """The operation x · k of arrays (N, 2) and (2,), which notes the calls of its compiled functions."""

    def forward(operands, out):
        calls.append("forward")
        np.multiply(*operands, out=out)

    def pull(operands, g, results):
        calls.append("pull")
        if results[0] is not None:
            results[0][...] = g * operands[1]
        if results[1] is not None:
            results[1][...] = (g * operands[0]).sum(0)

    def push(operands, tangents, out):
        calls.append("push")
        dx, dk = tangents
        out[...] = (0 if dx is None else dx * operands[1]) + (0 if dk is None else operands[0] * dk)

    functions = {"forward": forward, "push": push, "pull": pull}
    return rts.plugin_api.operations.Operation(
        "tests.scaled", lambda x, k: x * k, (2, 1), lambda x, k: x, **functions, differentiable=2
    )


def test_operations_on_a_device_run_their_array_code(place):
    x, k = RNG.normal(size=(5, 2)), np.array([2.0, -3.0])
    for where, compiled in ((place, place.device == "cpu"), (CPU, True)):
        calls = []
        scaled = _scaled(calls)
        tree = where.put([x, k])
        value, slopes = where.gradient(lambda t, f=scaled: (f(*t) ** 2).sum(), tree)
        assert float(where.take(value)) == pytest.approx(((x * k) ** 2).sum(), rel=1e-5)
        for found, expected in zip(where.take(slopes), (2 * x * k * k, (2 * x * x * k).sum(0)), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-5)
        _, moved = where.tangent(lambda t, f=scaled: f(*t), tree, where.put([x, k]))
        np.testing.assert_allclose(where.take(moved), 2 * x * k, rtol=1e-5)
        assert set(calls) == ({"forward", "pull", "push"} if compiled else set())


@pytest.mark.parametrize("shader", ["silhouette", "lambert"])
def test_no_positions_and_no_colours_cross_in_a_step(place, shader):
    """A splat that is computed on the host would copy both there, and their gradients back."""
    if place.engine == "jax":
        pytest.skip("copies of jax are not counted")
    crossings = pytest.importorskip("benchmarks.gpu.crossings")
    theta = {"vertices": place.put(BALL), "colors": place.put(COLORS)}
    part = rts.prepare(rts.Part(rts.Mesh(FACES), theta, shader))
    pose, weights = place.put(np.full(6, 0.05)).requires_grad_(), place.put(WEIGHTS)
    shapes = []

    class Kept(rts.plugin("splatters", "edges")):
        def cropped(self, splats):
            shapes.append((splats.positions.shape, splats.rgba.shape))
            return super().cropped(splats)

    with crossings.Counted(place.device) as counts:
        moved = part.replace(transform=rts.rigid(pose))
        (rts.render(moved, CAMERA, SIZE, splatter=Kept()) * weights).sum().backward()
    assert np.abs(place.take(pose.grad)).max() > 0.1
    rows = shapes[0][0][0]
    assert shapes == [((rows, 3), (rows, 4))] and rows > 30 and rows not in (len(BALL), len(FACES))
    of_samples = [crossing for crossing in counts.crossings if crossing.shape in ((rows, 3), (rows, 4))]
    # Indices of corners, from the sampler; its barycentrics cross with them.
    assert [(one.way, one.line.split()[-1]) for one in of_samples] == [("to the device", "in_engine")]
    assert (rows, 2) in [crossing.shape for crossing in counts.crossings]
    height, width = SIZE
    images = {(height, width, 4), (height * width, 4), (height + 4, width + 4, 4), ((height + 4) * (width + 4), 4)}
    assert not images & {crossing.shape for crossing in counts.crossings}


# ---------------------------------------------------------------------------------- the command for machines with a GPU


def test_the_command_says_what_it_left_out(tmp_path):
    command = [sys.executable, str(ROOT / "benchmarks/gpu/run.py"), "--device", "cpu", "--minutes", "0.1"]
    done = subprocess.run([*command, "--out", str(tmp_path)], capture_output=True, text=True)
    found = json.loads((tmp_path / "gpu.json").read_text())
    assert done.returncode == 1 and found["versions"]["torch"] in torch.__version__
    assert [(step["step"], step["result"]) for step in found["steps"]] == [("tree", "left out: no time")]


def test_the_command_counts_tests(tmp_path):
    file = tmp_path / "test_three.py"
    file.write_text("def test_good(): pass\ndef test_bad(): assert False\ndef test_raw(): raise OSError\n")
    run = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junitxml={tmp_path / 'tests.xml'}"]
    subprocess.run([*run, str(file)], capture_output=True, cwd=tmp_path)
    found = counts(tmp_path / "tests.xml")
    assert (found["tests"], found["failures"], found["errors"], found["skipped"]) == (3, 2, 0, 0)
    assert found["failed"] == ["test_three::test_bad", "test_three::test_raw"]
