"""Wrong values for every argument: one line that names the argument, or an acceptance that is documented."""

import math

import numpy as np
import pytest

import rts
from rts import Camera

pytestmark = pytest.mark.rendering

SIZE = (12, 16)
CAMERA = Camera.look_at((0.4, 0.5, 4), (0, 0, 0))
Mesh = rts.plugin("surfaces", "mesh")
PART = Mesh.example()
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


def theta(**entries):
    return PART.replace(theta={**PART.theta, **entries})


def shaded(name, **entries):
    """A render by a shader whose θ has these entries, the wrong value in place of None."""

    def call(value):
        given = {key: value if entry is None else entry for key, entry in entries.items()}
        return rts.render(theta(**given).replace(shader=name), CAMERA, SIZE)

    return call


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
    "sample.parts": lambda v: rts.sample(v, CAMERA, SIZE),
    "sample.size": lambda v: rts.sample(PART, CAMERA, v),
    "sample.layers": lambda v: rts.sample(PART, CAMERA, SIZE, layers=v),
    "sample.splatter": lambda v: rts.sample(PART, CAMERA, SIZE, splatter=v),
    "render_samples.splatter": lambda v: rts.render_samples(SAMPLED, PART, CAMERA, splatter=v),
    "render_samples.background": lambda v: rts.render_samples(SAMPLED, PART, CAMERA, background=v),
    "prepare.camera": lambda v: rts.prepare(PART, camera=v),
    "prepare.size": lambda v: rts.prepare(PART, camera=CAMERA, size=v),
    "prepare.parts": lambda v: rts.prepare(v),
    "prepare.sampler": lambda v: rts.prepare(PART, v),
    "explain.parts": lambda v: rts.explain(v, CAMERA),
    "explain.camera": lambda v: rts.explain(PART, v),
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
    "splatter.sigma": lambda v: rts.plugin("splatters", "visible")(sigma=v),
    "splatter.calibration": lambda v: rts.plugin("splatters", "visible")(calibration=v),
    "exact_calibration.sigma": rts.exact_calibration,
    "gradient.f": lambda v: rts.gradient(v, np.zeros((1, 3))),
    "combine.rows": lambda v: rts.combine(v, np.zeros((1, 1), np.int32), np.ones((1, 1), np.float32)),
    "combine.ids": lambda v: rts.combine(np.ones((2, 3), np.float32), v, np.ones((1, 1), np.float32)),
    "combine.weights": lambda v: rts.combine(np.ones((2, 3), np.float32), np.zeros((1, 1), np.int32), v),
    "rigid.pose": rts.rigid,
    "rigid.center": lambda v: rts.rigid(np.zeros(6), v),
    "plugin.group": lambda v: rts.plugin(v, "mesh"),
    "plugin.name": lambda v: rts.plugin("surfaces", v),
    "plugins.group": rts.plugins,
}


def splatter():
    return rts.plugin("splatters", "visible")()


ACCEPTED = {
    "a function": ["gradient.f"],
    # None is a default, or stands for "no such entry".
    "None": [
        *("render.background", "render.capacity", "render.engine", "Part.transform", "Mesh.indices", "look_at.aspect"),
        *(
            "look_at.near",
            "look_at.far",
            "sample.splatter",
            "render_samples.background",
            "prepare.camera",
            "prepare.size",
        ),
        *("within.transform", "splatter.calibration"),
    ],
    # A number like any other.
    "a fraction": [
        *("shader.specular", "shader.shininess", "shader.ambient", "look_at.fov_y", "look_at.aspect", "look_at.near"),
        *("look_at.far", "orthographic.height", "from_opencv.pixel_center", "from_pytorch3d.focal_length"),
        *(
            "from_blender.focal",
            "splatter.sigma",
            "splatter.calibration",
            "exact_calibration.sigma",
            "from_opencv.near",
        ),
    ],
    "minus one": ["from_opencv.pixel_center"],
    # No points have no pixels; sums and products of NaN are NaN.
    "an empty array": ["project.points"],
    "an array of NaN": ["combine.rows", "within.transform"],
}
"""Wrong values of some arguments are right ones of others."""


def word(call):
    """What a message must say: the name of the argument."""
    return call.partition(".")[2]


@pytest.mark.filterwarnings("ignore::rts.EmptyImageWarning")
@pytest.mark.parametrize("value", WRONG)
@pytest.mark.parametrize("call", CALLS)
def test_a_wrong_value_is_one_line_that_names_the_argument_or_accepted(call, value):
    if call in ACCEPTED.get(value, ()):
        CALLS[call](WRONG[value])
        return
    with pytest.raises(rts.RtsError) as caught:
        CALLS[call](WRONG[value])
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 300, message
    assert word(call) in message
