"""A scene as other renderers see it: coloured triangles in the space of a camera that rests.

All that moves, cameras too, is a velocity of vertices or of their colours. The space is that of the camera, sheared and
scaled until its pixels are squares and its axis meets the middle of the image: so any perspective camera will do.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rts import Camera, Engine, Part, engine_of, plugin
from rts.errors import InputError
from rts.plugin_api.arrays import map_leaves
from rts.tool_api.scenes import check_scene
from rts_compare.moving_scenes import Scene

EDGE = 4.0
"""Surfaces are cut more finely until the edges of their triangles are shorter than this, pixels."""
CUTS = (1, 2, 4, 8, 16, 32, 64)
"""Cuts along each side of a patch, to choose from."""
TRIAL = 1e-3
"""Step in t for a first estimate of speeds, before they are measured over a pixel."""
COLOR_STEP = 0.1
"""A change of colour that counts as much as a motion by a pixel."""


class Unsuited(Exception):
    """A scene that other renderers cannot render; the message is a clause that says why."""


class Colored(NamedTuple):
    """Triangles of one part.

    Attributes:
        faces: (T, 3) integers, counter-clockwise as seen from the front.
        vertices: (V, 3) float64, in the camera's space: x right, y up; the camera looks along −z.
        colors: (V, 3) float64.
    """

    faces: np.ndarray
    vertices: np.ndarray
    colors: np.ndarray


class Velocity(NamedTuple):
    """The motion of a part, per unit of t.

    Attributes:
        vertices: (V, 3), or None at rest.
        colors: (V, 3), or None if constant.
    """

    vertices: np.ndarray | None
    colors: np.ndarray | None


@dataclass(frozen=True)
class RendererInput:
    """A scene in the form that other renderers take.

    Attributes:
        size: (height, width).
        focal: focal length, pixels; the axis meets the middle of the image.
        planes: depths of the near and the far plane.
        parts: one for each part of the scene.
        velocities: mode → one for each part, or the reason why there are none.
    """

    size: tuple[int, int]
    focal: float
    planes: tuple[float, float]
    parts: tuple[Colored, ...]
    velocities: Mapping[str, tuple[Velocity, ...] | str]

    def velocity(self, mode: str) -> tuple[Velocity, ...]:
        """Velocities of all parts, in one mode.

        Raises:
            InputError: the mode has no velocities; the message is the reason.
        """
        velocity = self.velocities[mode]
        if isinstance(velocity, str):
            raise InputError(velocity)
        return velocity

    @property
    def fov(self) -> float:
        """Vertical field of view, degrees."""
        return float(np.degrees(2 * np.arctan(self.size[0] / (2 * self.focal))))

    def fastest(self, mode: str) -> float:
        """The largest speed in a mode, per unit of t: of vertices in pixels, or of colours in units of `COLOR_STEP`.

        Vertices nearer than the near plane do not count.
        """
        return _fastest(self.parts, self.velocity(mode), self.focal, self.planes[0])


class Peer(abc.ABC):
    """Another differentiable renderer, with a scene.

    Attributes:
        name: of the renderer.
        settings: its settings by name.
    """

    name: str
    settings: dict[str, int]

    @abc.abstractmethod
    def derivative(self, mode: str, seed: int = 0) -> np.ndarray:
        """The derivative image (H, W, 3) along the scene's direction of a mode, per unit of t.

        Args:
            mode: a key of the scene's `directions`.
            seed: of its noise, if it has any.
        """

    @abc.abstractmethod
    def gradient(self, mode: str, weights: np.ndarray | None = None) -> Callable[[], float]:
        """A function that renders once, and returns dL/dt of L = Σ weights · image by one pass in reverse mode.

        The pass takes the gradient in all vertices and colours that the mode changes.

        Args:
            mode: a key of the scene's `directions`.
            weights: (H, W, 3); None for the first of `derivative_scores.loss_weights`.
        """


def renderer_input(scene: Scene, engine: Engine | None = None) -> RendererInput:
    """A scene at rest, and its velocities in every mode, or the reason why a mode has none.

    Velocities are central differences over a pixel to each side: exact up to rounding where vertices and colours are
    linear in t.

    Raises:
        Unsuited: the camera is orthographic, a part is no mesh and cannot be made one, its look is other than `unlit`
            or `silhouette` with opaque colours of vertices, or no mode has velocities.
    """
    first = next(iter(scene.directions))
    parts, camera = _on_host(scene, first, 0.0, engine)
    projection = np.asarray(camera.for_size(scene.size).projection, np.float64)
    if projection[3, 2] == 0:
        raise Unsuited("the camera is orthographic")
    focal = abs(float(projection[1, 1] / projection[3, 2])) * scene.size[0] / 2
    near, far = (float(d) for d in camera.depth_range())
    to_camera = _to_camera(camera, focal, scene.size)
    cuts = [1 if _is_mesh(part) else _cuts(index, part, to_camera, focal) for index, part in enumerate(parts)]
    apart = partial(_snapshot, scene, engine, focal, cuts)
    at = partial(_joined, apart, [_joints(part) for part in apart(first, 0.0)])
    rest = at(first, 0.0)
    if not np.isfinite(far):
        far = 2 * max(float(-p.vertices[:, 2].min()) for p in rest)
    velocities = {mode: _velocities(partial(at, mode), rest, focal, near) for mode in scene.directions}
    if all(isinstance(v, str) for v in velocities.values()):
        raise Unsuited(velocities[first])
    for index, part in enumerate(rest):
        _check_joined(index, part)
    wound = tuple(_turned(a) if b.cull == "none" else a for a, b in zip(rest, parts, strict=True))
    return RendererInput(scene.size, focal, (near, far), wound, velocities)


# --------------------------------------------------------------------------------------------------------------- parts


def _on_host(scene: Scene, mode: str, t: float, engine: Engine | None) -> tuple[Sequence[Part], Camera]:
    """The parts and the camera at t, their arrays in NumPy."""
    parts, camera = scene.at(scene.moved(mode, t, engine))
    host = map_leaves(lambda x: engine_of(x).to_numpy(engine_of(x).stop_gradient(x)), (parts, camera))
    return check_scene(*host)


def _snapshot(scene: Scene, engine: Engine | None, focal: float, cuts: list[int], mode: str, t: float) -> list[Colored]:
    """The parts at t as triangles, wound as in the scene; `cuts` as of `_cuts`, one a part."""
    parts, camera = _on_host(scene, mode, t, engine)
    to_camera = _to_camera(camera, focal, scene.size)
    colored = []
    for index, (part, rate) in enumerate(zip(parts, cuts, strict=True)):
        vertices, faces = _mesh(part, rate)
        colored.append(Colored(faces, _placed(vertices, to_camera, part), _colors(index, part, rate, len(vertices))))
    return colored


def _to_camera(camera: Camera, focal: float, size: tuple[int, int]) -> np.ndarray:
    """Transform (3, 4) from the world to the space of a camera of this focal length, pixels, with the same image."""
    projection = np.asarray(camera.for_size(size).projection, np.float64)
    # What is seen at NDC (x, y) with clip w is at depth w, and that far to the right and up.
    scale = np.array([size[1] / (2 * focal), size[0] / (2 * focal), -1.0]) / -projection[3, 2]
    return scale[:, None] * projection[[0, 1, 3]] @ np.asarray(camera.view, np.float64)


def _placed(vertices: np.ndarray, to_camera: np.ndarray, part: Part) -> np.ndarray:
    """Vertices (V, 3) of a part, from local space to the camera's."""
    matrix = to_camera if part.transform is None else to_camera @ np.asarray(part.transform, np.float64)
    return vertices @ matrix[:, :3].T + matrix[:, 3]


def _is_mesh(part: Part) -> bool:
    return isinstance(part.surface, plugin("rts.surfaces", "mesh"))


def _mesh(part: Part, rate: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 of a part in its local space, and faces (T, 3); patches are cut `rate` times a side."""
    if _is_mesh(part):
        return np.asarray(part.theta["vertices"], np.float64), part.surface.faces
    vertices, faces = part.surface.tessellate(part.theta, rate)
    return np.asarray(vertices, np.float64), faces


def _cuts(index: int, part: Part, to_camera: np.ndarray, focal: float) -> int:
    """The first of `CUTS` that makes all edges shorter than `EDGE` on screen, or adds no faces; else the last.

    Raises:
        Unsuited: the part cannot be made a mesh.
    """
    if not hasattr(part.surface, "tessellate"):
        raise Unsuited(f"part {index} is no mesh, and cannot be made one")
    before = 0
    for rate in CUTS:
        try:
            vertices, faces = _mesh(part, rate)
        except InputError as error:
            raise Unsuited(f"part {index} is no mesh, and cannot be made one: {error}") from None
        points = _placed(vertices, to_camera, part)
        pixels = focal * points[:, :2] / points[:, 2:]
        longest = np.linalg.norm(pixels[faces] - pixels[np.roll(faces, 1, axis=1)], axis=-1).max(initial=0.0)
        if longest < EDGE or len(faces) == before:
            return rate
        before = len(faces)
    return CUTS[-1]


def _colors(index: int, part: Part, rate: int, count: int) -> np.ndarray:
    """Colours (V, 3) of the `count` vertices of a part, as its shader shows them; white for silhouettes.

    Raises:
        Unsuited: another shader, a texture, or colours that are translucent or not those of vertices.
    """
    theta: Mapping[str, Any] = part.theta
    colors = np.ones((count, 3))
    if type(part.shader) is plugin("rts.shaders", "silhouette"):
        return colors
    if type(part.shader) is not plugin("rts.shaders", "unlit"):
        raise Unsuited(f"the shader of part {index} is {part.shader!r}, neither 'unlit' nor 'silhouette'")
    if "texture" in theta:
        raise Unsuited(f"part {index} has a texture")
    if "colors" in theta or "color" in getattr(part.surface, "attributes", ()):
        colors = _rgb(index, part, _of_vertices(index, part, rate))
    if "color" in theta:
        colors = colors * _rgb(index, part, np.asarray(theta["color"], np.float64)[None])
    return colors


def _of_vertices(index: int, part: Part, rate: int) -> np.ndarray:
    """Colours (V, C) of vertices, as in θ; of control points, blended to the cut patches. Others are `Unsuited`."""
    colors = part.theta.get("colors")
    if isinstance(colors, np.ndarray):
        if _is_mesh(part) and part.surface.sample_widths[0] == 3:
            return np.asarray(colors, np.float64)
        points = part.surface.reads(part.theta)[0]
        if hasattr(part.surface, "control_points") and np.shape(part.theta[points]) == colors.shape:
            # Colours of control points are blended like the points.
            return _mesh(part.replace(theta={**part.theta, points: colors}), rate)[0]
    raise Unsuited(f"the colours of part {index} are not those of vertices")


def _rgb(index: int, part: Part, colors: np.ndarray) -> np.ndarray:
    """RGB colours (n, 3) of colours (n, C), as `unlit` shows them; one channel is a grey.

    A fourth channel, even of ones, is `Unsuited` unless the shader is opaque. Errors name the part by `index`.
    """
    if colors.shape[1] == 4 and not part.shader.opaque:
        raise Unsuited(f"part {index} is translucent")
    return colors[:, :3] if colors.shape[1] >= 3 else np.repeat(colors[:, :1], 3, axis=1)


def _joints(part: Colored) -> tuple[np.ndarray, np.ndarray]:
    """Indices (V',) of the vertices to keep if several share place and colour, and (V,) the kept one for each."""
    _, first, became = np.unique(
        np.hstack([part.vertices, part.colors]), axis=0, return_index=True, return_inverse=True
    )
    return first, became.reshape(-1)


def _joined(
    at: Callable[[str, float], list[Colored]], joints: list[tuple[np.ndarray, np.ndarray]], mode: str, t: float
) -> list[Colored]:
    """The parts at t, vertices joined that share place and colour at rest: edges of patches are then no outlines.

    Parts that have another number of vertices than at rest are left as they are.
    """
    return [
        Colored(became[part.faces], part.vertices[first], part.colors[first])
        if len(part.vertices) == len(became)
        else part
        for part, (first, became) in zip(at(mode, t), joints, strict=True)
    ]


def _check_joined(index: int, part: Colored) -> None:
    """Refuse a part that shows fronts and backs, and has triangles that meet without shared vertices.

    An edge between a front and a back would count as two outlines.
    """
    a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c))
    _, place = np.unique(part.vertices, axis=0, return_inverse=True)
    edges = np.sort(np.concatenate([part.faces[:, [0, 1]], part.faces[:, [1, 2]], part.faces[:, [2, 0]]]), axis=1)
    alone, counts = np.unique(edges, axis=0, return_counts=True)
    ends = np.sort(place.reshape(-1)[alone[counts == 1]], axis=1)
    if len(np.unique(ends, axis=0)) < len(ends) and volumes.min() < 0 < volumes.max():
        raise Unsuited(f"triangles of part {index} meet at edges whose vertices they do not share")


def _turned(part: Colored) -> Colored:
    """A part that is drawn from both sides, for renderers that draw fronts alone: all faces rewound if inside out.

    A closed part is inside out if its volume is negative; an open one, if none of its triangles faces the camera.
    """
    a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c))  # Negative for a triangle that faces the camera.
    edges = np.concatenate([part.faces[:, [0, 1]], part.faces[:, [1, 2]], part.faces[:, [2, 0]]])
    ends, counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    inside_out = volumes.sum() < 0 if len(ends) and counts.min() == 2 else not (volumes < 0).any()
    return part._replace(faces=part.faces[:, ::-1]) if inside_out else part


# ---------------------------------------------------------------------------------------------------------- velocities


def _velocities(
    at: Callable[[float], list[Colored]], rest: list[Colored], focal: float, near: float
) -> tuple[Velocity, ...] | str:
    """Velocities of all parts in one mode, or the reason why there are none."""
    try:
        guess = _differences(at, rest, TRIAL)
        speed = _fastest(rest, guess, focal, near)
        return _differences(at, rest, 1 / speed) if speed else guess
    except Unsuited as reason:
        return str(reason)


def _differences(at: Callable[[float], list[Colored]], rest: list[Colored], step: float) -> tuple[Velocity, ...]:
    velocities = []
    for index, (a, b, c) in enumerate(zip(at(step), at(-step), rest, strict=True)):
        if not (np.array_equal(a.faces, c.faces) and np.array_equal(b.faces, c.faces)):
            raise Unsuited(f"the triangles of part {index} are others when it moves")
        velocities.append(Velocity(_slope(a.vertices, b.vertices, step), _slope(a.colors, b.colors, step)))
    return tuple(velocities)


def _slope(ahead: np.ndarray, behind: np.ndarray, step: float) -> np.ndarray | None:
    return None if np.array_equal(ahead, behind) else (ahead - behind) / (2 * step)


def _fastest(parts: Sequence[Colored], velocities: Sequence[Velocity], focal: float, near: float) -> float:
    """See `RendererInput.fastest`."""
    speed = 0.0
    for part, velocity in zip(parts, velocities, strict=True):
        if velocity.colors is not None:
            speed = max(speed, float(np.abs(velocity.colors).max()) / COLOR_STEP)
        if velocity.vertices is not None:
            ahead = -part.vertices[:, 2] >= near
            points, change = part.vertices[ahead], velocity.vertices[ahead]
            pixels = focal * (change[:, :2] - points[:, :2] * change[:, 2:] / points[:, 2:]) / points[:, 2:]
            speed = max(speed, float(np.linalg.norm(pixels, axis=1).max(initial=0.0)))
    return speed
