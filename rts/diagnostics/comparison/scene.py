"""Scenes that settings are compared on: parts and a camera as a function of parameters, and directions of these."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rts.camera import Camera
from rts.engines import Engine, constants, engine_of, exemplar
from rts.errors import InputError
from rts.interfaces import Part
from rts.trees import Array, Tree, collected, leaves, map_leaves

SceneFunction = Callable[[Tree], tuple[Part | Sequence[Part], Camera]]

MODES = ("translation", "rotation", "shape", "color", "camera")
"""The ways that `moving` moves parts."""


@dataclass(frozen=True)
class Scene:
    """Parts and a camera that depend on parameters.

    Attributes:
        name: of the scene.
        at: parameters → (parts, camera).
        parameters: nested dicts and lists of arrays: where the derivatives are looked at.
        directions: mode → the direction of the parameters, of their structure, along which the image is differentiated.
        size: (height, width) of images.
        note: what moves, and what is hard about it.
        exact: as `at`, with surfaces that are exact, where those of `at` are approximations; None for `at`.
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

    def moved(self, mode: str, by: Any = 0.0, engine: Engine | None = None) -> Tree:
        """The parameters, moved along the direction of a mode.

        Args:
            mode: a key of `directions`.
            by: how far; a number, or a scalar of the engine.
            engine: the engine of the parameters that move, and where the scene is not `separate` of all; None for NumPy.
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
    """The scene of parts in NumPy that move in up to five ways, each by a parameter of its own, linearly.

    - translation: to the right of the image;
    - rotation: about the upright axis of the camera, through the middle of what moves;
    - shape: what the surface reads swells, unevenly, about its middle; what are no points changes by one number;
    - color: what the surface does not read changes, each channel in another way;
    - camera: it moves ahead.

    Args:
        name: of the scene.
        parts: NumPy parts.
        camera: the camera.
        size: (height, width).
        moves: the indices of the parts that translations, rotations and shapes move; None for all.
        modes: some of the ways. Those that change nothing are left out.
        note: what is hard about the scene.
        exact: the same parts as exact surfaces, with the same transforms; `shape` is left out then unless their θ has
            the entries that change.
    """
    parts = [parts] if isinstance(parts, Part) else list(parts)
    moved = range(len(parts)) if moves is None else moves
    axes = np.linalg.inv(np.asarray(camera.view, np.float64))
    center = _middle([parts[i] for i in moved])
    generators = {"translation": _translation(axes[:3, 0]), "rotation": _rotation(axes[:3, 1], center)}
    changes = {
        "shape": [_swelling(p) if i in moved else {} for i, p in enumerate(parts)],
        "color": [_coloring(p) for p in parts],
    }

    def function(which: Sequence[Part]) -> SceneFunction:
        def at(parameters: Mapping[str, Any]) -> tuple[list[Part], Camera]:
            live = {k: t for k, t in parameters.items() if not (isinstance(t, (float, np.ndarray)) and t == 0)}
            seen = camera
            if "camera" in live:
                ahead = np.zeros((4, 4))
                ahead[2, 3] = 1.0  # In the camera's space what is seen comes nearer.
                seen = camera.replace(view=_plus(np.asarray(camera.view, np.float64), live["camera"], ahead))
            found = []
            for index, part in enumerate(which):
                theta, transform = dict(part.theta), part.transform
                for mode, of_parts in changes.items():
                    if mode in live:
                        for entry, direction in of_parts[index].items():
                            theta[entry] = _plus(theta[entry], live[mode], direction)
                if index in moved:
                    for mode, generator in generators.items():
                        if mode in live:
                            start = np.eye(4) if part.transform is None else np.asarray(part.transform)
                            transform = _plus(start if transform is None else transform, live[mode], generator @ start)
                found.append(part.replace(theta=theta, transform=transform))
            return found, seen

        return at

    kept = [m for m in modes if m not in changes or any(changes[m])]
    parameters = {mode: np.zeros((), np.float32) for mode in kept}
    directions = {mode: {m: np.ones(()) if m == mode else np.zeros(()) for m in kept} for mode in kept}
    true = None if exact is None else function([exact] if isinstance(exact, Part) else list(exact))
    return Scene(name, function(parts), parameters, directions, size, note, true, separate=True)


def _plus(start: Any, by: Any, direction: np.ndarray) -> Any:
    """start + by · direction, in the engine of either."""
    engine, like = engine_of(start, by), exemplar(start, by)
    start, by, direction = constants((start, by, direction), engine, like)
    return start + by * direction


def _translation(along: np.ndarray) -> np.ndarray:
    generator = np.zeros((4, 4))
    generator[:3, 3] = along
    return generator


def _rotation(about: np.ndarray, center: np.ndarray) -> np.ndarray:
    """The derivative of a rotation about an axis through a point."""
    x, y, z = about
    generator = np.zeros((4, 4))
    generator[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    generator[:3, 3] = -generator[:3, :3] @ center
    return generator


def _points(part: Part) -> np.ndarray | None:
    """What a surface is made of, (M, 3), world space: the first entry that it reads and that holds points."""
    for name in part.surface.reads(part.theta):
        array = part.theta[name]
        if isinstance(array, np.ndarray) and array.ndim >= 2 and array.shape[-1] == 3:
            points = np.asarray(array, np.float64).reshape(-1, 3)
            if part.transform is None:
                return points
            matrix = np.asarray(part.transform, np.float64)
            return points @ matrix[:3, :3].T + matrix[:3, 3]
    return None


def _middle(parts: Sequence[Part]) -> np.ndarray:
    """The middle of the box around parts, (3,); where they stand, for those that hold no points."""
    found = []
    for part in parts:
        points = _points(part)
        if points is None:
            points = np.zeros((1, 3)) if part.transform is None else np.asarray(part.transform)[None, :3, 3]
        found.append(points)
    everything = np.concatenate(found)
    return (everything.min(axis=0) + everything.max(axis=0)) / 2


UNEVEN = np.array([2.0, 3.0, 2.5])
"""How often a swelling goes up and down across an object, in radians from its middle to its end, along each axis."""


def _swelling(part: Part) -> dict[str, np.ndarray]:
    """The directions in which what the surface reads is moved, by entry."""
    found = {}
    for name in part.surface.reads(part.theta):
        array = part.theta[name]
        if not (isinstance(array, np.ndarray) and np.issubdtype(array.dtype, np.floating)) or name in ATTRIBUTES:
            continue
        if array.ndim >= 2 and array.shape[-1] in (2, 3):
            middle = (array.min(axis=tuple(range(array.ndim - 1))) + array.max(axis=tuple(range(array.ndim - 1)))) / 2
            away = array - middle
            radius = float(np.linalg.norm(away, axis=-1).max()) or 1.0
            wave = np.sin(away / radius @ UNEVEN[: array.shape[-1]])
            found[name] = away * (1 + 0.5 * wave)[..., None]
        else:
            found[name] = np.ones(array.shape)
    return found


ATTRIBUTES = ("normals", "colors", "uv")
"""What meshes interpolate beside their positions: of these only colours are changed, and by `color`."""
NO_COLORS = ("normals", "uv", "shininess", "exponent", "depth_range")
"""What shaders read that is no colour."""


def _coloring(part: Part) -> dict[str, np.ndarray]:
    """The directions in which the colours of a part change, by entry."""
    reads = set(part.surface.reads(part.theta)) - {"colors"}
    found = {}
    for name, value in part.theta.items():
        if name in reads or name in NO_COLORS or not isinstance(value, np.ndarray) or value.shape[-1:] != (3,):
            continue
        if np.issubdtype(value.dtype, np.floating) and "direction" not in name:
            found[name] = value * np.array([1.0, -0.5, 0.25])
    return found


def check_directions(scene: Scene) -> None:
    """Refuse directions of another structure than the parameters.

    Raises:
        InputError: they have other leaves, or leaves of other shapes.
    """
    wanted = [tuple(np.shape(p)) for p in collected(scene.parameters)]
    for mode, direction in scene.directions.items():
        given = [tuple(np.shape(d)) for d in collected(direction)]
        if given != wanted:
            raise InputError(f"the direction {mode!r} has arrays of shapes {given}; expected those of parameters, {wanted}")
        if not any(np.any(np.asarray(d)) for d in collected(direction)):
            raise InputError(f"the direction {mode!r} is zero; expected a way in which parameters change")
