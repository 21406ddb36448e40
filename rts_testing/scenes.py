"""Cameras and parts for the kit's checks; everything lies about the origin, within two units of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts import Camera, Part, plugin, render, render_samples, sample
from rts.plugin_api.arrays import Array
from rts.results import Sampled
from rts.tool_api.scenes import check_scene
from rts_testing import compatibility
from rts_testing.claims import claim
from rts_testing.compatibility import BORDER, CAPACITY, LAYERS, SIZE
from rts_testing.derivatives import single

GRID = SIZE[0] + 2 * BORDER, SIZE[1] + 2 * BORDER


def _rounded(camera: Camera) -> Camera:
    """The camera rounded to float32, the same for every engine."""
    return camera.map(single)


def _look(eye: tuple, at: tuple = (0, 0, 0), up: tuple = (0, 1, 0), **options: Any) -> Camera:
    return _rounded(Camera.look_at(eye, at, up, fov_y=options.pop("fov_y", 45), aspect=SIZE[1] / SIZE[0], **options))


def shifted(camera: Camera, by: float, axis: int) -> Camera:
    """A camera whose image is shifted by `by` pixels, to the right (axis 0) or upward (axis 1)."""
    shift = np.eye(4)
    shift[axis, 3] = 2 * by / SIZE[1 - axis]
    return camera.replace(projection=shift @ camera.projection)


CAMERA = _rounded(compatibility.CAMERA)
AWAY = _look((0, 0, 5), (0, 0, 9))
AFAR = _look((5, 9, 18))
BESIDE = _look((0, 0, 5), (40, 0, 5.5))
NEAR = _look((0.9, 1.6, 3.2), near=3.4, far=4.2)
"""A camera whose near and far planes cut through the parts about the origin."""

INSIDE = _look((0.1, 0.05, 0.2), (0.6, 0.2, -1), near=0.05, far=20, fov_y=75)
PARALLEL = _rounded(
    Camera.orthographic((1.1, 1.3, 3.1), (0, 0.1, 0), height=3.1, aspect=SIZE[1] / SIZE[0], near=0.5, far=9)
)
AXES = [_look(e, up=u) for e, u in (((4, 0, 0), (0, 1, 0)), ((0, 4, 0), (0, 0, 1)), ((0, 0, 4), (0, 1, 0)))]
VIEWS = {"perspective": CAMERA, "orthographic": PARALLEL, "from inside": INSIDE, "cut by near and far plane": NEAR}
UNSEEN = {"behind the camera": AWAY, "beside the image": BESIDE}


def mesh(vertices: Any, faces: Any, **options: Any) -> Part:
    """A part that is a triangle mesh."""
    surface = plugin("rts.surfaces", "mesh")(faces)
    return Part(surface, {"vertices": np.asarray(vertices, np.float32)}, **options)


def soup(count: int = 14, seed: int = 3) -> Part:
    """Random triangles that pierce each other."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-0.8, 0.8, (count, 1, 3)) + rng.normal(0, 0.6, (count, 3, 3))
    return mesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def ball(**options: Any) -> Part:
    """A closed surface of few, large triangles."""
    return plugin("rts.surfaces", "mesh").example().replace(shader="unlit", **options)


def flat() -> Part:
    """A square in the plane x = 0, which the camera on the z-axis sees edge-on."""
    return mesh([(0, -1, -1), (0, 1, -1), (0, 1, 1), (0, -1, 1)], [(0, 1, 2), (0, 2, 3)])


def checked(part: Part) -> Part:
    """The part as the core checks it and passes it to samplers."""
    return check_scene(part, CAMERA)[0][0]


def find(part: Part, camera: Camera = CAMERA, sampler: Any = "auto", layers: int = LAYERS, **options: Any) -> Sampled:
    """The samples of a part whose θ holds NumPy arrays."""
    return sample(part, camera, SIZE, sampler=sampler, splatter=None, layers=layers, **options)


def frozen(part: Part, camera: Camera = CAMERA, sampler: Any = "auto") -> Sampled:
    """Samples of a part whose θ holds NumPy arrays, in `CAPACITY` rows, to evaluate in any engine.

    Fails if there are fewer than 20: the part should be at the origin, at a size of about one.
    """
    sampled = find(part, camera, sampler, capacity=CAPACITY)
    claim(
        (np.asarray(sampled.row) >= 0).sum() >= 20,
        "the camera sees too little of the part: move it to the origin, at a size of about one",
    )
    return sampled


def shown(part: Part, camera: Camera = CAMERA, sampler: Any = "auto") -> Array:
    """An image in the engine of the part, by the cheapest splatter with derivatives everywhere."""
    return render(part, camera, SIZE, sampler=sampler, splatter="single", layers=LAYERS, capacity=CAPACITY)


def shown_at(sampled: Sampled, part: Part, camera: Camera = CAMERA) -> Array:
    """The image of given samples."""
    return render_samples(sampled, part, camera, splatter="single")
