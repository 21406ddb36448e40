"""Wrong values for every argument: one line that names the argument, or an acceptance that is documented."""

import math
from importlib import import_module
from inspect import isabstract

import misuses
import numpy as np
import pytest
from helpers import refused

import rts
import rts_compare
from rts import Camera
from rts.plugin_api.operations import combine, gradient
from rts_surfaces.implicit.narrow_band import NarrowBand

pytestmark = pytest.mark.rendering

SIZE = (12, 16)
CAMERA = Camera.look_at((0.4, 0.5, 4), (0, 0, 0))
Mesh = rts.plugin("surfaces", "mesh")
PART = Mesh.example()
Bezier = rts.plugin("surfaces", "bezier")
Sdf = rts.plugin("surfaces", "sdf")
PATCH, VASE, PAWN = (rts.plugin("surfaces", name).example() for name in ("bezier", "bspline", "revolution"))
SAMPLED = rts.sample(PART, CAMERA, SIZE)
K = np.array([[14.0, 0, 8], [0, 14, 6], [0, 0, 1]])


class Thing:
    """Nothing that the library knows."""

    def __repr__(self):
        return "Thing\nof two lines"


WRONG = {
    "None": None,
    "a word": "abc",
    "bytes": b"abc",
    "minus one": -1,
    "a fraction": 2.5,
    "NaN": math.nan,
    "infinity": math.inf,
    "an empty list": [],
    "a ragged list": [[1.0, 2.0], [3.0]],
    "a list of words": ["a", "b", "c"],
    "a dict": {"a": 1},
    "a set": {1, 2},
    "a thing": Thing(),
    "a function": lambda *_: None,
    "a class": Thing,
    "a complex number": 1j,
    "an array of NaN": np.full((4, 4), np.nan),
    "an array of words": np.array(["a", "b"]),
    "an array of objects": np.array([None, Thing()], object),
    "an empty array": np.zeros((0, 3), np.float32),
    "an array of five axes": np.zeros((1, 1, 1, 1, 1), np.float32),
}


BAR = rts.Skinned.example()


def bar(**entries):
    return BAR.replace(theta={**BAR.theta, **entries})


def theta(**entries):
    return PART.replace(theta={**PART.theta, **entries})


def shaded(name, **entries):
    """A render by a shader whose θ has these entries, the wrong value in place of None."""

    def call(value):
        given = {key: value if entry is None else entry for key, entry in entries.items()}
        return rts.render(theta(**given).replace(shader=name), CAMERA, SIZE)

    return call


def isosurface(bounds=((-1, -1, -1), (1, 1, 1)), **options):
    return rts.plugin("surfaces", "isosurface")(bounds, **options)


def ball(theta, points):
    return rts.namespace(points).sum(points * points, axis=-1) - 0.5


def rendered(surface, entries):
    return rts.render(rts.Part(surface, entries), CAMERA, SIZE)


UV, TEXTURE = np.zeros((12, 2), np.float32), np.ones((2, 2, 3), np.float32)

CALLS = {
    "render.parts": lambda v: rts.render(v, CAMERA, SIZE),
    "render.camera": lambda v: rts.render(PART, v, SIZE),
    "render.size": lambda v: rts.render(PART, CAMERA, v),
    "render.sampler": lambda v: rts.render(PART, CAMERA, SIZE, sampler=v),
    "render.splatter": lambda v: rts.render(PART, CAMERA, SIZE, splatter=v),
    "render.layers": lambda v: rts.render(PART, CAMERA, SIZE, layers=v),
    "render.supersample": lambda v: rts.render(PART, CAMERA, SIZE, supersample=v),
    "render.background": lambda v: rts.render(PART, CAMERA, SIZE, background=v),
    "render.capacity": lambda v: rts.render(PART, CAMERA, SIZE, capacity=v),
    "render.engine": lambda v: rts.render(PART, CAMERA, SIZE, engine=v),
    "render_samples.sampled": lambda v: rts.render_samples(v, PART, CAMERA),
    "render_samples.parts": lambda v: rts.render_samples(SAMPLED, v, CAMERA),
    "render_samples.camera": lambda v: rts.render_samples(SAMPLED, PART, v),
    "sample.parts": lambda v: rts.sample(v, CAMERA, SIZE, splatter=None),
    "sample.size": lambda v: rts.sample(PART, CAMERA, v, splatter=None),
    "sample.layers": lambda v: rts.sample(PART, CAMERA, SIZE, layers=v, splatter=None),
    "sample.splatter": lambda v: rts.sample(PART, CAMERA, SIZE, splatter=v),
    "render_samples.splatter": lambda v: rts.render_samples(SAMPLED, PART, CAMERA, splatter=v),
    "render_samples.background": lambda v: rts.render_samples(SAMPLED, PART, CAMERA, background=v),
    "prepare.camera": lambda v: rts.prepare(PART, camera=v),
    "prepare.size": lambda v: rts.prepare(PART, camera=CAMERA, size=v),
    "prepare.parts": lambda v: rts.prepare(v),
    "prepare.sampler": lambda v: rts.prepare(PART, v),
    "explain.parts": lambda v: rts.explain(v, CAMERA),
    "explain.camera": lambda v: rts.explain(PART, v),
    "profile.parts": lambda v: rts.profile(v, CAMERA, SIZE),
    "profile.repeats": lambda v: rts.profile(PART, CAMERA, SIZE, repeats=v),
    "render.outputs": lambda v: rts.render(PART, CAMERA, SIZE, outputs=v),
    "Part.surface": lambda v: rts.render(PART.replace(surface=v), CAMERA, SIZE),
    "Part.theta": lambda v: rts.render(PART.replace(theta=v), CAMERA, SIZE),
    "Part.shader": lambda v: rts.render(PART.replace(shader=v), CAMERA, SIZE),
    "Part.transform": lambda v: rts.render(PART.replace(transform=v), CAMERA, SIZE),
    "Part.cull": lambda v: rts.render(PART.replace(cull=v), CAMERA, SIZE),
    "Mesh.faces": Mesh,
    "Mesh.indices": lambda v: Mesh(PART.surface.faces, v),
    "Mesh.vertices": lambda v: rts.render(theta(vertices=v), CAMERA, SIZE),
    "Mesh.colors": lambda v: rts.render(theta(colors=v), CAMERA, SIZE),
    "Mesh.normals": lambda v: rts.render(theta(normals=v), CAMERA, SIZE),
    "Skinned.faces": rts.Skinned,
    "Skinned.joints": lambda v: rts.Skinned(PART.surface.faces, v),
    "Skinned.joint_transforms": lambda v: rts.render(bar(joint_transforms=v), CAMERA, SIZE),
    "Skinned.joint_weights": lambda v: rts.render(bar(joint_weights=v), CAMERA, SIZE),
    "Skinned.morph_weights": lambda v: rts.render(bar(morph_weights=v), CAMERA, SIZE),
    "Skinned.morph_vertices": lambda v: rts.render(bar(morph_vertices=v), CAMERA, SIZE),
    "Mesh.uv": shaded("textured", uv=None, texture=TEXTURE),
    "shader.texture": shaded("textured", uv=UV, texture=None),
    "shader.color": shaded("unlit", color=None),
    "shader.light": shaded("lambert", light=None),
    "shader.specular": shaded("blinn_phong", specular=None),
    "shader.shininess": shaded("blinn_phong", shininess=None),
    "shader.depth_range": shaded("depth", depth_range=None),
    "shader.direction": lambda v: shaded("lambert", light=None)({"direction": v}),
    "shader.ambient": lambda v: shaded("lambert", light=None)({"ambient": v}),
    "shader.wrap": lambda v: rts.plugin("shaders", "unlit")(wrap=v),
    "Camera.view": lambda v: rts.render(PART, Camera(v, CAMERA.projection), SIZE),
    "Camera.projection": lambda v: rts.render(PART, Camera(CAMERA.view, v), SIZE),
    "look_at.eye": lambda v: Camera.look_at(v, (0, 0, 0)),
    "look_at.target": lambda v: Camera.look_at((0, 0, 4), v),
    "look_at.up": lambda v: Camera.look_at((0, 0, 4), (0, 0, 0), v),
    "look_at.fov_y": lambda v: Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=v),
    "look_at.aspect": lambda v: Camera.look_at((0, 0, 4), (0, 0, 0), aspect=v),
    "look_at.near": lambda v: Camera.look_at((0, 0, 4), (0, 0, 0), near=v, far=5.0),
    "look_at.far": lambda v: Camera.look_at((0, 0, 4), (0, 0, 0), near=0.1, far=v),
    "look_at.principal_point": lambda v: Camera.look_at((0, 0, 4), (0, 0, 0), principal_point=v),
    "orthographic.height": lambda v: Camera.orthographic((0, 0, 4), (0, 0, 0), height=v),
    "from_opencv.K": lambda v: Camera.from_opencv(v, np.eye(3), np.zeros(3), SIZE),
    "from_opencv.R": lambda v: Camera.from_opencv(K, v, np.zeros(3), SIZE),
    "from_opencv.t": lambda v: Camera.from_opencv(K, np.eye(3), v, SIZE),
    "from_opencv.size": lambda v: Camera.from_opencv(K, np.eye(3), np.zeros(3), v),
    "from_opencv.pixel_center": lambda v: Camera.from_opencv(K, np.eye(3), np.zeros(3), SIZE, pixel_center=v),
    "from_opencv.near": lambda v: Camera.from_opencv(K, np.eye(3), np.zeros(3), SIZE, near=v, far=9.0),
    "from_mvp.matrix": Camera.from_mvp,
    "from_opengl.projection": lambda v: Camera.from_opengl(np.eye(4), v),
    "from_nvdiffrast.modelview": lambda v: Camera.from_nvdiffrast(v, np.eye(4)),
    "from_opengl.modelview": lambda v: Camera.from_opengl(v, np.eye(4)),
    "from_pytorch3d.R": lambda v: Camera.from_pytorch3d(v, np.zeros(3), focal_length=1.0, size=SIZE),
    "from_pytorch3d.T": lambda v: Camera.from_pytorch3d(np.eye(3), v, focal_length=1.0, size=SIZE),
    "from_pytorch3d.focal_length": lambda v: Camera.from_pytorch3d(np.eye(3), np.zeros(3), focal_length=v, size=SIZE),
    "from_pytorch3d.principal_point": lambda v: Camera.from_pytorch3d(
        np.eye(3), np.zeros(3), focal_length=1.0, principal_point=v, size=SIZE
    ),
    "from_pytorch3d.size": lambda v: Camera.from_pytorch3d(np.eye(3), np.zeros(3), focal_length=1.0, size=v),
    "from_blender.size": lambda v: Camera.from_blender(np.eye(4), v, focal=9.0),
    "from_blender.camera_to_world": lambda v: Camera.from_blender(v, SIZE, focal=9.0),
    "from_blender.focal": lambda v: Camera.from_blender(np.eye(4), SIZE, focal=v),
    "to_opencv.size": lambda v: CAMERA.to_opencv(v),
    "for_size.size": CAMERA.for_size,
    "to_pytorch3d.size": lambda v: CAMERA.to_pytorch3d(v),
    "to_blender.size": lambda v: CAMERA.to_blender(v),
    "within.transform": CAMERA.within,
    "project.points": lambda v: CAMERA.project(v, SIZE),
    "project.size": lambda v: CAMERA.project(np.zeros((1, 3)), v),
    "rays.size": lambda v: CAMERA.rays(v),
    "splat.positions": lambda v: splatter().splat(v, np.ones((1, 4), np.float32), np.zeros((1, 2, 2), np.int32)),
    "splat.rgba": lambda v: splatter().splat(np.ones((1, 3), np.float32), v, np.zeros((1, 2, 2), np.int32)),
    "splat.row": lambda v: splatter().splat(np.ones((1, 3), np.float32), np.ones((1, 4), np.float32), v),
    "splatter.sigma": lambda v: rts.plugin("splatters", "multi")(sigma=v),
    "splatter.calibration": lambda v: rts.plugin("splatters", "multi")(calibration=v),
    "exact_calibration.sigma": rts.splatting.exact_calibration,
    "gradient.f": lambda v: gradient(v, np.zeros((1, 3))),
    "combine.rows": lambda v: combine(v, np.zeros((1, 1), np.int32), np.ones((1, 1), np.float32)),
    "combine.ids": lambda v: combine(np.ones((2, 3), np.float32), v, np.ones((1, 1), np.float32)),
    "combine.weights": lambda v: combine(np.ones((2, 3), np.float32), np.zeros((1, 1), np.int32), v),
    "rigid.pose": rts.rigid,
    "rigid.center": lambda v: rts.rigid(np.zeros(6), v),
    "Isosurface.bounds": lambda v: isosurface(bounds=v),
    "Isosurface.isovalue": lambda v: isosurface(isovalue=v),
    "Isosurface.f": lambda v: rendered(isosurface(f=v, shape=(4, 4, 4)), {}),
    "Isosurface.shape": lambda v: isosurface(f=ball, shape=v),
    "Isosurface.motion": lambda v: isosurface(motion=v),
    "Isosurface.inside": lambda v: isosurface(inside=v),
    "Isosurface.at_bounds": lambda v: isosurface(at_bounds=v),
    "Isosurface.near_singular": lambda v: isosurface(near_singular=v),
    "Isosurface.table": lambda v: isosurface(f=ball, shape=(4, 4, 4), table=v),
    "Isosurface.band": lambda v: isosurface(f=ball, shape=(4, 4, 4), band=v),
    "Isosurface.lipschitz": lambda v: isosurface(f=ball, shape=(4, 4, 4), lipschitz=v),
    "Isosurface.reads": lambda v: isosurface(f=ball, shape=(4, 4, 4), reads=v),
    "Isosurface.attributes": lambda v: isosurface(attributes=v),
    "Isosurface.values": lambda v: rendered(isosurface(), {"values": v}),
    "Sdf.f": lambda v: rendered(Sdf(v), {}),
    "Sdf.radius": lambda v: Sdf(ball, radius=v),
    "Sdf.center": lambda v: Sdf(ball, center=v),
    "Sdf.lipschitz": lambda v: Sdf(ball, lipschitz=v),
    "Sdf.steps": lambda v: Sdf(ball, steps=v),
    "NarrowBand.lipschitz": lambda v: NarrowBand(lipschitz=v),
    "NarrowBand.coarse": lambda v: NarrowBand(coarse=v),
    "NarrowBand.margin": lambda v: NarrowBand(margin=v),
    "NarrowBand.chunk": lambda v: NarrowBand(chunk=v),
    "Bezier.indices": Bezier,
    "Bezier.tolerance": lambda v: Bezier(PATCH.surface.table, tolerance=v),
    "Bezier.points": lambda v: rts.render(PATCH.replace(theta={"points": v}), CAMERA, SIZE),
    "tessellate.rate": lambda v: PATCH.surface.tessellate(PATCH.theta, v),
    "BSpline.shape": rts.plugin("surfaces", "bspline"),
    "BSpline.ends": lambda v: rts.plugin("surfaces", "bspline")((4, 4), v),
    "BSpline.points": lambda v: rts.render(VASE.replace(theta={"points": v}), CAMERA, SIZE),
    "BSpline.colors": lambda v: rts.render(VASE.replace(theta={**VASE.theta, "colors": v}), CAMERA, SIZE),
    "Revolution.heights": rts.plugin("surfaces", "revolution"),
    "Revolution.count": lambda v: rts.plugin("surfaces", "revolution")(np.arange(5.0), count=v),
    "Revolution.radii": lambda v: rts.render(PAWN.replace(theta={"radii": v}), CAMERA, SIZE),
    "load.path": rts.load,
    "load.surface": lambda v: rts.load("no such model.obj", surface=v),
    "load.merge": lambda v: rts.load("no such model.obj", merge=v),
    "load_image.path": rts.load_image,
    "show.thing": rts.show,
    "show.over": lambda v: rts.show(np.zeros((2, 2, 4)), v),
    "save_image.path": lambda v: rts.save_image(v, np.zeros((2, 2, 4))),
    "save_image.image": lambda v: rts.save_image("never written.png", v),
    "save_animation.path": lambda v: rts.save_animation(v, [np.zeros((2, 2, 4))]),
    "save_animation.frames": lambda v: rts.save_animation("never written.gif", v),
    "save_animation.fps": lambda v: rts.save_animation("never written.gif", [np.zeros((2, 2, 4))], v),
    "ImageResiduals.scene": lambda v: rts.ImageResiduals(v, CAMERA, SIZE, MASK)(START()),
    "ImageResiduals.camera": lambda v: rts.ImageResiduals(scene, v, SIZE, MASK)(START()),
    "ImageResiduals.size": lambda v: rts.ImageResiduals(scene, CAMERA, v, MASK),
    "ImageResiduals.target": lambda v: rts.ImageResiduals(scene, CAMERA, SIZE, v),
    "ImageResiduals.weights": lambda v: rts.ImageResiduals(scene, CAMERA, SIZE, MASK, weights=v),
    "ImageResiduals.loss": lambda v: rts.ImageResiduals(scene, CAMERA, SIZE, MASK, loss=v),
    "ImageResiduals.f_scale": lambda v: rts.ImageResiduals(scene, CAMERA, SIZE, MASK, loss="huber", f_scale=v),
    "fit.residuals": lambda v: rts.fit(v, START()),
    "fit.parameters": lambda v: rts.fit(lambda p: p, v),
    "fit.method": lambda v: rts.fit(lambda p: p, START(), method=v),
    "fit.loss": lambda v: rts.fit(lambda p: p, START(), loss=v),
    "fit.steps": lambda v: rts.fit(lambda p: p, START(), steps=v),
    "fit.learning_rate": lambda v: rts.fit(lambda p: p, START(), learning_rate=v),
    "fit.tolerance": lambda v: rts.fit(lambda p: p, START(), tolerance=v),
    "fit.patience": lambda v: rts.fit(lambda p: p, START(), patience=v),
    "fit.callback": lambda v: rts.fit(lambda p: p, START(), callback=v),
    "fit.schedule": lambda v: rts.fit(lambda p: p, START(), schedule=v),
    "Stage.scale": lambda v: rts.Stage(v),
    "Stage.supersample": lambda v: rts.Stage(supersample=v),
    "Stage.sigma": lambda v: rts.Stage(sigma=v),
    "pyramid.size": lambda v: rts.pyramid(v),
    "pyramid.coarsest": lambda v: rts.pyramid(SIZE, coarsest=v),
    "pyramid.largest": lambda v: rts.pyramid(SIZE, largest=v),
    "check_gradient.scene": lambda v: rts.check_gradient(v, START(), SIZE),
    "check_gradient.parameters": lambda v: rts.check_gradient(lambda p: (scene(p), CAMERA), v, SIZE),
    "check_gradient.size": lambda v: rts.check_gradient(lambda p: (scene(p), CAMERA), START(), v),
    "check_gradient.entries": lambda v: rts.check_gradient(lambda p: (scene(p), CAMERA), START(), SIZE, entries=v),
    "gradient_image.image": lambda v: rts.gradient_image(v, START()[:1]),
    "gradient_image.scale": lambda v: rts.gradient_image(lambda p: p.reshape(1, 1, 1), START()[:1], scale=v),
    "plugin.group": lambda v: rts.plugin(v, "mesh"),
    "plugin.name": lambda v: rts.plugin("surfaces", v),
    "plugins.group": rts.plugins,
}


MASK = np.ones(SIZE, np.float32)


def START():
    """A pose that is differentiable."""
    return pytest.importorskip("torch").zeros(6)


def scene(pose):
    return PART.replace(transform=rts.rigid(pose))


def splatter():
    return rts.plugin("splatters", "multi")()


OPTIONAL = """
    render.background render.capacity render.engine render.outputs sample.splatter render_samples.background
    prepare.camera prepare.size show.over splatter.calibration
    Part.transform Mesh.indices Skinned.joints look_at.aspect look_at.near look_at.far within.transform
    ImageResiduals.weights ImageResiduals.f_scale fit.loss fit.steps fit.learning_rate fit.callback gradient_image.scale
    fit.patience fit.schedule Stage.supersample pyramid.largest
    Isosurface.band Isosurface.lipschitz Isosurface.reads Isosurface.attributes Sdf.lipschitz Sdf.steps
    NarrowBand.lipschitz NarrowBand.coarse
"""
NUMBERS = """
    shader.specular shader.shininess shader.ambient look_at.fov_y look_at.aspect look_at.near look_at.far
    orthographic.height from_opencv.near from_opencv.pixel_center from_pytorch3d.focal_length from_blender.focal
    splatter.sigma splatter.calibration exact_calibration.sigma save_animation.fps fit.learning_rate fit.tolerance
    ImageResiduals.weights ImageResiduals.f_scale gradient_image.scale Bezier.tolerance tessellate.rate
    Isosurface.isovalue Isosurface.lipschitz Sdf.radius Sdf.lipschitz NarrowBand.lipschitz Stage.sigma
"""
ACCEPTED = {
    "None": OPTIONAL.split(),
    "a fraction": NUMBERS.split(),
    "minus one": [
        *("from_opencv.pixel_center", "Isosurface.isovalue"),
        *("shader.specular", "shader.shininess", "shader.ambient"),
    ],
    "an empty list": ["Isosurface.reads"],
    "a list of words": ["Isosurface.reads"],
    "infinity": ["fit.tolerance"],
    "a function": ["fit.callback"],
    # No points have no pixels; sums and products of NaN are NaN.
    "an empty array": ["project.points"],
    "an array of NaN": ["combine.rows", "within.transform"],
}
"""Wrong values of some arguments are right ones of others."""


WORDS = {
    "save_image.path": "picture",
    "save_animation.path": "animation",
    "show.thing": "image",
    "save_animation.frames": "frame",
}
"""Words for an argument in messages, if they are not its name alone."""


def named(call, message):
    """True if a message names the argument."""
    argument = call.partition(".")[2]
    return argument in message or WORDS.get(call, argument) in message


FUNCTIONS = "ImageResiduals.scene fit.loss fit.callback check_gradient.scene gradient_image.image".split()
"""A class is a function, too, and its own error is its author's."""


def complaint(call, value):
    """The fault of the error that a wrong value raises, or None."""
    try:
        CALLS[call](WRONG[value])
    except rts.RtsError as error:
        message = str(error)
    else:
        return "no error"
    short = "\n" not in message and len(message) < 300
    return None if short and named(call, message) else message


@pytest.mark.filterwarnings("ignore::rts.errors.EmptyImageWarning")
@pytest.mark.parametrize("call", CALLS)
def test_a_wrong_value_is_one_line_that_names_the_argument_or_accepted(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    values = {value for value in WRONG if value != "a class" or call not in FUNCTIONS}
    accepted = {value for value in values if call in ACCEPTED.get(value, ())}
    for value in accepted:
        CALLS[call](WRONG[value])
    complaints = {value: complaint(call, value) for value in values - accepted}
    assert not {value: said for value, said in complaints.items() if said}


@pytest.mark.filterwarnings("ignore::rts.errors.RtsWarning", "ignore::RuntimeWarning", "ignore::DeprecationWarning")
@pytest.mark.parametrize(
    "call", [pytest.param(c, marks=[pytest.mark.thorough] * c.startswith("tune.")) for c in misuses.CALLS]
)
def test_a_wrong_value_is_one_line_or_works(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    raw = []
    for value, given in {**WRONG, "integers": np.ones((2, 3), int), "a tuple": (1, 2, 3)}.items():
        if value == "a class" or (value == "None" and call in misuses.ALL):
            continue  # The error of a class that is called is its author's.
        try:
            misuses.CALLS[call](given)
        except rts.RtsError as error:
            message = str(error)
            if "\n" in message or len(message) > 400:
                raw.append(f"{value}: {message}")
        except Exception as error:
            raw.append(f"{value}: {type(error).__name__}: {error}")
    assert not raw


def public():
    """Names that users call."""
    modules = (rts, rts.regularizers, rts_compare)
    names = {name: getattr(module, name) for module in modules for name in module.__all__}
    names |= {name: getattr(rts, name) for name in rts.registry.built_in_attributes()}
    names |= {
        name: getattr(import_module(place), name) for place, moved in rts._MOVED.items() for name in moved.split()
    }
    return {name for name, value in names.items() if callable(value) and not is_base(value)}


def is_base(value):
    """True for an error, or for a base that plugins subclass."""
    return isinstance(value, type) and (issubclass(value, Exception) or isabstract(value))


def test_every_public_name_is_tried():
    tried = {call.partition(".")[0] for call in {**CALLS, **misuses.CALLS}}
    assert public() - tried == set(misuses.RECORDS) - tried
    assert not tried & set(misuses.RECORDS)


def test_right_values_are_not_written_out():
    class Unwritten(np.ndarray):
        def __repr__(self):
            raise AssertionError("the text of a message that nobody reads")

    eye = np.array([0.4, 0.5, 4]).view(Unwritten)
    np.testing.assert_array_equal(Camera.look_at(eye, (0, 0, 0)).view, CAMERA.view)


def test_arrays_of_two_engines_are_refused():
    torch, jnp = pytest.importorskip("torch"), pytest.importorskip("jax.numpy")
    part, points = theta(vertices=torch.tensor(PART.theta["vertices"])), torch.zeros(4, 3)
    eye, ndc = jnp.eye(4), rts.Ndc((1.0, 1.0))
    sampled = rts.sample(part, CAMERA, SIZE)
    for call in (
        lambda: rts.render(part.replace(theta={**part.theta, "colors": jnp.ones((12, 3))}), CAMERA, SIZE),
        lambda: rts.render(part.replace(transform=eye), CAMERA, SIZE),
        lambda: rts.render(part, Camera(eye, CAMERA.projection), SIZE),
        lambda: rts.render(part, CAMERA, SIZE, background=eye[0, :3]),
        lambda: rts.render_samples(SAMPLED, part.replace(transform=eye), CAMERA),
        lambda: rts.render_samples(sampled, PART.replace(transform=eye), CAMERA),
        lambda: rts.render_views(part.replace(transform=eye), [CAMERA] * 2, SIZE),
        lambda: rts.sample(part.replace(transform=eye), CAMERA, SIZE),
        lambda: combine(points, np.zeros((1, 1), np.int32), eye[:1, :1]),
        lambda: rts.rigid(torch.zeros(6), eye[0, :3]),
        lambda: CAMERA.replace(view=eye).project(points, SIZE),
        lambda: ndc.rays(points, jnp.ones((4, 3))),
        lambda: rts.namespace(points, eye),
        lambda: rts.engine_of(points, {"a": eye}),
        lambda: rts.fit(lambda p: p["a"], {"a": points, "b": eye}),
        lambda: rts.check_gradient(lambda p: (part, CAMERA), {"a": points, "b": eye}, SIZE),
    ):
        with pytest.raises(rts.errors.EngineError, match="^arrays of jax and torch .*convert one side.*\\)$"):
            call()


def flat(**changes):
    """A card of two barycentrics a sample, with a table of its proxy altered, and other widths."""
    widths = changes.pop("widths", (3, 2))
    card = misuses.Card(**changes)
    card.sample_widths = widths
    return misuses.drawn(card)


class Plane(misuses.Card):
    """A card whose samples have no integers: its corners are in its params."""

    sample_widths = (0, 3)

    def __init__(self):
        super().__init__(corner_params=misuses.VERTICES[misuses.FACES])

    def evaluate(self, theta, samples):
        return rts.GBuffer(position=samples.params)

    def image(self):
        return misuses.drawn(self)


def of_numpy(theta, points):
    return np.sqrt((points * points).sum(-1)) - theta["r"]


def tensor(*shape):
    return pytest.importorskip("torch").zeros(shape)


def prepared_in_jit():
    jax = pytest.importorskip("jax")
    vertices = jax.numpy.asarray(PART.theta["vertices"])
    jax.jit(lambda v: rts.render(rts.prepare(theta(vertices=v)), CAMERA, SIZE))(vertices)


FAULTS = {
    "narrow corners": (
        lambda: flat(corner_params=np.zeros((2, 3, 1), np.float32)),
        "corner_params of 1 numbers a corner, but sample_widths says 2",
    ),
    "no corners": (lambda: flat(widths=(3, 4)), "no corner_params, and so 2 barycentrics a corner, but .* says 4"),
    "a number for NDC": (lambda: rts.Ndc(2.0), r"scale is 2.0; expected \(2,\)"),
    "points of NDC": (lambda: misuses.NDC.from_world(np.zeros((4, 2))), r"points has shape \(4, 2\); expected"),
    "a stacked camera": (lambda: misuses.volume(camera=Camera.stack([CAMERA] * 2)), "camera is of several views"),
    "nothing depends": (
        lambda: misuses.tuned(scene=lambda p: (PART, CAMERA)),
        "nothing in the image of '<lambda>' changes with 'parameters",
    ),
    "a field of points alone": (lambda: Sdf(lambda points: points[:, 0]), "expected a function of two arguments"),
    "a field of NumPy": (
        lambda: rendered(Sdf(of_numpy), {"r": tensor().requires_grad_(True)}),
        "of_numpy fails on points .* of torch .* write it in array code|numpy.ndarray",
    ),
    "prepared in jit": (prepared_in_jit, "rts.prepare was given a traced array"),
    "an energy of other vertices": (
        lambda: rts.regularizers.NormalConsistency(misuses.VERTICES, misuses.FACES)(np.zeros((5, 3))),
        "vertices have 5 rows; expected 4",
    ),
    "faces of other vertices": (
        lambda: rts.regularizers.NormalConsistency(misuses.VERTICES[:3], misuses.FACES),
        "faces name vertex 3, but there are 3 vertices",
    ),
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_told_before_any_work(fault):
    call, words = FAULTS[fault]
    with refused(words):
        call()


def test_what_may_be_left_out_is():
    assert Plane().image()[..., 3].max() > 0.5
    energy, faces = rts.regularizers.NormalConsistency, misuses.FACES
    both = energy(misuses.VERTICES, faces), energy(faces), energy(faces=faces)
    assert len({float(e(misuses.VERTICES)) for e in both}) == 1
