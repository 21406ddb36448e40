"""Scenes that settings are compared on: parts and a camera as a function of parameters, with directions."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rts import Camera, Engine, Part, TriangleSurface, engine_of, plugin
from rts.errors import InputError
from rts.plugin_api.arrays import Array, Tree, constants, exemplar, leaves, map_leaves
from rts.plugin_api.checks import quoted
from rts.tool_api.scenes import check_scene

SceneFunction = Callable[[Tree], tuple[Part | Sequence[Part], Camera]]

MODES = ("translation", "rotation", "shape", "color", "camera")
"""The modes of `moving`: names of changes of parts or camera."""


@dataclass(frozen=True)
class Scene:
    """Parts and a camera that depend on parameters.

    Attributes:
        name: of the scene.
        at: parameters → (parts, camera).
        parameters: nested dicts and lists of arrays: where the derivatives are looked at.
        directions: mode → a tree like `parameters`, the direction along which the image is differentiated.
        size: (height, width) of images.
        note: what moves, and what is hard about it.
        exact: as `at`, with exact surfaces where `at` has approximations, for the true derivative. None for `at`.
        separate: whether `at` also takes NumPy arrays for parameters that a mode does not change.
    """

    name: str
    at: SceneFunction
    parameters: Tree
    directions: Mapping[str, Tree]
    size: tuple[int, int] = (256, 256)
    note: str = ""
    exact: SceneFunction | None = None
    separate: bool = False

    def with_modes(self, modes: Sequence[str]) -> Scene:
        """The scene with some of its modes."""
        return replace(self, directions={mode: self.directions[mode] for mode in modes})

    def moved(self, mode: str, by: Any = 0.0, engine: Engine | None = None) -> Tree:
        """The parameters, moved along the direction of a mode.

        Args:
            mode: a key of `directions`.
            by: the factor of the direction; a number, or a scalar of the engine.
            engine: the engine of the parameters that move or, unless the scene is `separate`, of all; None for NumPy.
        """
        direction = iter(leaves(self.directions[mode]))

        def leaf(p: Array) -> Array:
            d = next(direction)
            if engine is None:
                return np.asarray(p) + by * np.asarray(d)
            rests = not np.any(np.asarray(d))
            if rests and self.separate:
                return p
            value = p if engine.owns(p) else engine.constant(p)
            return value if rests else value + by * engine.constant(d, value)

        return map_leaves(leaf, self.parameters)


def is_constant(tree: Tree) -> bool:
    """True if every leaf is a NumPy array or a number, which are never differentiated."""
    return all(isinstance(x, (np.ndarray, np.generic, int, float, complex)) for x in leaves(tree))


def parts_of(scene: tuple[Part | Sequence[Part], Camera]) -> list[Part]:
    """The parts in the result of a scene's function, as a list."""
    return [scene[0]] if isinstance(scene[0], Part) else list(scene[0])


def moving(
    name: str,
    parts: Part | Sequence[Part],
    camera: Camera,
    size: tuple[int, int] = (256, 256),
    *,
    moves: Sequence[int] | None = None,
    modes: Sequence[str] = MODES,
    note: str = "",
    exact: Part | Sequence[Part] | None = None,
) -> Scene:
    """A scene of NumPy parts that change in up to five modes, each linearly in one number of its own.

    - translation: to the right of the image;
    - rotation: about the camera's up axis, through the middle of what moves; along the tangent, so true to first order
      only;
    - shape: points in θ that make the surface swell, unevenly, about their middle; its other numbers, such as radii or
      values on a lattice, all grow at one rate;
    - color: the base colour of the parts, see `rts.shading.shaders`, changes, each channel at its own rate;
    - camera: the camera moves ahead.

    Args:
        name: of the scene.
        parts: NumPy parts.
        camera: the camera.
        size: (height, width).
        moves: the indices of the parts that translation, rotation and shape move; None for all. Colours of all parts
            change.
        modes: names from `MODES`. Modes that change nothing are left out.
        note: what is hard about the scene.
        exact: the same parts as exact surfaces, with the same transforms. Modes that change entries of θ which exact
            parts lack, or have in another shape, are left out.

    Raises:
        InputError: not as many exact parts as parts, an unknown mode, or `moves` is empty or out of range.
    """
    parts = [parts] if isinstance(parts, Part) else list(parts)
    true = parts if exact is None else [exact] if isinstance(exact, Part) else list(exact)
    moved = tuple(range(len(parts)) if moves is None else moves)
    _check(parts, true, moved, modes)
    axes = np.linalg.inv(np.asarray(camera.view, np.float64))
    ways = _Ways(
        camera,
        moved,
        {
            "translation": _translation(axes[:3, 0]),
            "rotation": _rotation(axes[:3, 1], _middle([parts[i] for i in moved])),
        },
        {
            "shape": [_swelling(p) if i in moved else {} for i, p in enumerate(parts)],
            "color": [_coloring(p, camera) for p in parts],
        },
    )
    kept = [m for m in modes if ways.changes_something(m, parts, true)]
    parameters = {mode: np.zeros((), np.float32) for mode in kept}
    directions = {mode: {m: np.ones(()) if m == mode else np.zeros(()) for m in kept} for mode in kept}
    scene = Scene(name, partial(ways.at, parts), parameters, directions, size, note, separate=True)
    return scene if exact is None else replace(scene, exact=partial(ways.at, true))


def _check(parts: Sequence[Part], exact: Sequence[Part], moved: Sequence[int], modes: Sequence[str]) -> None:
    if len(exact) != len(parts):
        raise InputError(f"exact has {len(exact)} parts; expected as many as `parts`, {len(parts)}")
    if not moved or not set(moved) <= set(range(len(parts))):
        raise InputError(f"moves is {quoted(moved)}; expected indices of the {len(parts)} parts, from 0 on")
    if not set(modes) <= set(MODES):
        raise InputError(f"modes is {quoted(modes)}; expected some of {', '.join(MODES)}")


class _Ways(NamedTuple):
    """Changes of parts and a camera with the parameter of each mode.

    Attributes:
        camera: at rest.
        moved: the indices of the parts that generators move.
        generators: mode → (4, 4), the derivative of the transform, world space, that moves these parts.
        changes: mode → for each part: entry of θ → its direction; entries that θ lacks begin at ones.
    """

    camera: Camera
    moved: Sequence[int]
    generators: Mapping[str, np.ndarray]
    changes: Mapping[str, Sequence[Mapping[str, np.ndarray]]]

    def at(self, parts: Sequence[Part], parameters: Mapping[str, Any]) -> tuple[list[Part], Camera]:
        """Parts and the camera, moved by parameters: mode → number; modes that are not in it rest."""
        live = {k: t for k, t in parameters.items() if not (is_constant(t) and np.all(np.asarray(t) == 0))}
        camera = self.camera
        if "camera" in live:
            ahead = np.zeros((4, 4))
            ahead[2, 3] = 1.0  # In camera space, all parts come nearer.
            camera = camera.replace(view=_plus(np.asarray(camera.view, np.float64), live["camera"], ahead))
        return [self._part(index, part, live) for index, part in enumerate(parts)], camera

    def _part(self, index: int, part: Part, live: Mapping[str, Any]) -> Part:
        theta, transform = dict(part.theta), part.transform
        for mode in (m for m in self.changes if m in live):
            for entry, direction in self.changes[mode][index].items():
                start = theta[entry] if entry in theta else np.ones(direction.shape)
                theta[entry] = _plus(start, live[mode], direction)
        for mode in (m for m in self.generators if m in live and index in self.moved):
            start = np.eye(4) if part.transform is None else np.asarray(part.transform)
            transform = _plus(start if transform is None else transform, live[mode], self.generators[mode] @ start)
        return part.replace(theta=theta, transform=transform)

    def changes_something(self, mode: str, parts: Sequence[Part], exact: Sequence[Part]) -> bool:
        """True if a mode changes something; entries of θ that it changes must have one shape in `parts` and `exact`."""
        if mode == "camera":  # Without perspective, moving ahead changes nothing.
            return bool(np.any(np.asarray(self.camera.projection)[3, :3]))
        if mode not in self.changes:
            return True
        entries = [(i, entry) for i, changed in enumerate(self.changes[mode]) for entry in changed]
        shapes = [
            [np.shape(which[i].theta[entry]) if entry in which[i].theta else None for i, entry in entries]
            for which in (parts, exact)
        ]
        return bool(entries) and shapes[0] == shapes[1]


def _plus(start: Any, by: Any, direction: np.ndarray) -> Any:
    """`start + by * direction`, in the engine of `start` or `by`."""
    engine, like = engine_of(start, by), exemplar(start, by)
    start, by, direction = constants((start, by, direction), engine, like)
    return start + by * direction


def _translation(along: np.ndarray) -> np.ndarray:
    generator = np.zeros((4, 4))
    generator[:3, 3] = along
    return generator


def _rotation(about: np.ndarray, center: np.ndarray) -> np.ndarray:
    """The derivative (4, 4), by the angle in radians, of a rotation about a unit axis (3,) through a point (3,)."""
    x, y, z = about
    generator = np.zeros((4, 4))
    generator[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    generator[:3, 3] = -generator[:3, :3] @ center
    return generator


# ------------------------------------------------------------------------------------------------ where parts are

CUTS = 4
"""Cuts along each side of patches, to find their extent."""


def _middle(parts: Sequence[Part]) -> np.ndarray:
    """The middle (3,) of the box around parts, world space."""
    points_of = []
    for part in parts:
        points = _points(part)
        if part.transform is not None:
            matrix = np.asarray(part.transform, np.float64)
            points = points @ matrix[:3, :3].T + matrix[:3, 3]
        points_of.append(points)
    everything = np.concatenate(points_of)
    return (everything.min(axis=0) + everything.max(axis=0)) / 2


def _points(part: Part) -> np.ndarray:
    """Points (M, 3) of a surface, local space; without triangles, its attribute `center`, or 0."""
    surface = part.surface
    if isinstance(surface, TriangleSurface):
        with contextlib.suppress(InputError):  # Triangles may depend on the view.
            vertices, faces = surface.tessellate(part.theta, CUTS)
            if len(faces):
                return np.asarray(vertices, np.float64)[np.unique(faces)]
    return np.reshape(np.asarray(getattr(surface, "center", np.zeros(3)), np.float64), (1, 3))


# ------------------------------------------------------------------------------------- how shapes and colours change

UNEVEN = np.array([2.0, 3.0, 2.5])
"""Phase of a swelling's wave from an object's middle to its end along each axis, radians."""

NO_SHAPE = ("normals", "colors", "uv", "color", "texture", "light", "specular", "shininess", "depth_range")
"""Entries of θ that do not shape a surface: attributes of its vertices, and entries that shaders read."""

TINT = np.array([1.0, -0.5, 0.25, 0.0])
"""Relative changes of red, green, blue and alpha."""


def _swelling(part: Part) -> dict[str, np.ndarray]:
    """Entry of θ that shapes the surface → the direction in which it changes."""
    reads = part.surface.reads(part.theta)
    # Beside its vertices a mesh may have attributes of any name.
    names = ("vertices",) if "vertices" in reads else [name for name in reads if name not in NO_SHAPE]
    directions = {}
    for name in names:
        if not isinstance(part.theta.get(name), (np.ndarray, np.floating)):
            continue
        array = np.asarray(part.theta[name])
        if not np.issubdtype(array.dtype, np.floating):
            continue
        direction = _away(array) if array.ndim >= 2 and array.shape[-1] in (2, 3) else np.ones(array.shape)
        if direction.any():
            directions[name] = direction
    return directions


def _away(points: np.ndarray) -> np.ndarray:
    """Velocities of points (..., 2 or 3) that move away from their middle, unevenly."""
    rows = np.asarray(points, np.float64).reshape(-1, points.shape[-1])
    away = rows - (rows.min(axis=0) + rows.max(axis=0)) / 2
    radius = float(np.linalg.norm(away, axis=1).max(initial=0.0)) or 1.0
    wave = np.sin(away / radius @ UNEVEN[: rows.shape[1]])
    return (away * (1 + 0.5 * wave)[:, None]).reshape(points.shape)


def _coloring(part: Part, camera: Camera) -> dict[str, np.ndarray]:
    """Entry of θ with the base colour → the direction in which it changes; {} if none can change.

    An unlit part without colours changes "color", an entry that its θ lacks.
    """
    theta, reads = part.theta, part.surface.reads(part.theta)
    [checked], _ = check_scene(part, camera)
    if checked.reads is not None and not {"color", "uv"} & set(checked.reads):
        return {}
    sources = {"texture": "uv" in theta, "colors": "colors" in reads, "color": True}
    for name, used in sources.items():
        value = theta.get(name)
        if used and isinstance(value, np.ndarray) and value.shape[-1:] in ((1,), (3,), (4,)):
            direction = value * TINT[: value.shape[-1]]
            return {name: direction} if direction.any() else {}
    return {"color": TINT[:3]} if isinstance(checked.shader, plugin("rts.shaders", "unlit")) else {}


def check_directions(scene: Scene) -> None:
    """Refuse directions that do not suit the parameters.

    Raises:
        InputError: a direction has other leaves than the parameters, leaves of other shapes, or zeros alone.
    """
    wanted = [tuple(np.shape(p)) for p in leaves(scene.parameters)]
    for mode, direction in scene.directions.items():
        given = [tuple(np.shape(d)) for d in leaves(direction)]
        if given != wanted:
            raise InputError(
                f"the direction {mode!r} has arrays of shapes {given}; expected those of parameters, {wanted}"
            )
        if not any(np.any(np.asarray(d)) for d in leaves(direction)):
            raise InputError(f"the direction {mode!r} is zero; expected a way in which parameters change")
