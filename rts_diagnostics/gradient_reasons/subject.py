"""A scene under test: its options, its loss, and the arrays that change with its parameters."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from operator import attrgetter
from types import FunctionType, MethodType
from typing import Any, NamedTuple

import numpy as np

from rts import Camera, Engine, Part, namespace, render
from rts.errors import InputError
from rts.plugin_api.arrays import Array, Tree, leaves, map_leaves
from rts.results import PreparedParts
from rts.tool_api.parameters import kind_of, named_leaves
from rts.tool_api.plugins import check_splatter
from rts.tool_api.scenes import check_scene
from rts_diagnostics.finite_difference_steps import pixel_step

Scene = Callable[[Tree], tuple[Part | Sequence[Part] | PreparedParts, Camera]]
Change = Callable[[list[Part], Camera], tuple[list[Part], Camera]]
"""A function from a scene to a changed one."""

DEPENDS = 1.0
"""The change of parameters that shows whether the scene depends on them at all."""
SHORT = 1e-3
"""The change of parameters for the rates of the scene's arrays, by differences."""
DEEP = 8
"""Layers of the finite differences where shaders are not opaque."""
HELD = 4
"""The depth to which functions and objects are searched for arrays."""


class Place(NamedTuple):
    """The place of an array in a scene: the part's index, None for the camera, and the name there."""

    part: int | None
    name: str

    def __str__(self) -> str:
        return f"the camera's {self.name}" if self.part is None else f"part {self.part}'s {self.name}"


class Touched(NamedTuple):
    """Arrays of a scene that change with a number.

    Attributes:
        all: all of them.
        constant: the NumPy arrays among them.
        cut: the engine's arrays among them that no derivative reaches.
    """

    all: list[Place]
    constant: list[Place]
    cut: list[Place]

    @property
    def parts(self) -> list[int] | None:
        """Indices of the parts that change; None for all, if the camera changes."""
        indices = {place.part for place in self.all}
        return None if None in indices else sorted(p for p in indices if p is not None)


@dataclass(frozen=True, eq=False)
class Subject:
    """A scene under test: how it is rendered, and its loss.

    Attributes:
        engine: the engine of the parameters.
        scene: parameters → (parts, camera).
        parameters: values that are not traced.
        size: (height, width).
        options: options of `rts.render`.
        loss: image → scalar.
    """

    engine: Engine
    scene: Scene
    parameters: Tree
    size: tuple[int, int]
    options: Mapping[str, Any]
    loss: Callable[[Array], Array]

    def shown(self, parameters: Tree) -> tuple[Any, Camera]:
        """Parts and camera of the scene at some parameters."""
        scene = self.scene(parameters)
        if not isinstance(scene, tuple) or len(scene) != 2:
            raise InputError(f"scene gave {kind_of(scene)}; expected (parts, camera)")
        return scene

    def drawn(self, scene: tuple[Any, Camera], change: Change | None = None, size: Any = None, **options: Any) -> Array:
        """The image (H, W, 4) of a scene, as an array of the engine.

        Args:
            scene: parts and camera.
            change: a function that changes these first.
            size: (height, width) where it is not the subject's.
            **options: options of `rts.render`, in place of the subject's.

        Raises:
            InputError: shaders give another number of colours than 3, or `rts.render` refuses the scene.
        """
        parts, camera = scene if change is None else change(listed_parts(scene[0]), scene[1])
        image = render(parts, camera, size or self.size, **{**self.options, **options})
        if image.shape[-1] != 4:
            raise InputError(
                f"the scene's shaders give {image.shape[-1] - 1} channels besides alpha; expected 3: look at three of "
                f"them at a time, by a shader that gives those"
            )
        return image if self.engine.owns(image) else self.engine.constant(image, next(leaves(self.parameters)))

    def image(self, parameters: Tree, change: Change | None = None, **options: Any) -> Array:
        """The image (H, W, 4) of the scene at some parameters, parts and camera changed by `change`; see `drawn`."""
        return self.drawn(self.shown(parameters), change, **options)

    def require_dependence(self) -> None:
        """Refuse a scene of NumPy arrays that do not change with the parameters.

        Raises:
            InputError: nothing in the scene depends on the parameters.
        """
        scene = self.shown(self.parameters)
        image = render(*scene, self.size, **self.options)
        if self.engine.owns(image):
            return
        ones = map_leaves(self.engine.namespace.ones_like, self.parameters)
        if not self.touched(ones, DEPENDS).all:
            raise InputError(f"the image is {kind_of(image)}: nothing in the scene depends on the parameters")

    def moved(self, direction: Tree, by: float) -> Tree:
        """The parameters plus `by` times a direction, a tree of their structure."""
        steps = iter(leaves(direction))
        return map_leaves(lambda p: p + by * next(steps), self.parameters)

    def hard(self, direction: Tree, by: float, samples: int, change: Change | None = None) -> Array:
        """The image (H, W, 4) at parameters that are `moved`, without splatting, with `samples`² samples a pixel.

        If shaders are not opaque, at least `DEEP` layers are kept.
        """
        layers = self.options.get("layers", "auto")
        if not self.opaque:
            layers = max(DEEP, 0 if isinstance(layers, str) else layers)
        options = dict(splatter="none", supersample=samples, layers=layers)
        return self.image(self.moved(direction, by), change, **options)

    def push(
        self, direction: Tree, change: Change | None = None, *, connect: bool = False, **options: Any
    ) -> np.ndarray:
        """The derivative (H, W, 4) of the image along a direction, by forward mode.

        Args:
            direction: a tree of the parameters' structure.
            change: a change of the scene.
            connect: True to move arrays that no derivative reaches, too.
            **options: options of `rts.render`.
        """
        return self.pushed(partial(self.drawn, change=change, **options), direction, connect)

    def pushed(self, draw: Callable[[tuple[Any, Camera]], Array], direction: Tree, connect: bool = False) -> np.ndarray:
        """The derivative of what `draw` gives for a scene, an array of the engine, along a direction; see `push`."""
        one, unit, at = self._line(direction, connect)
        return self.engine.to_numpy(self.engine.jvp(lambda t: draw(at(t)), one * 0, unit)[1])

    def step(
        self, direction: Tree, change: Change | None = None, *, connect: bool = False, deep: bool = False, **fixed: Any
    ) -> float | None:
        """The result of `pixel_step` for a changed scene: a factor of the direction, or None where nothing changes.

        Args:
            direction: a tree of the parameters' structure.
            change: a change of the scene.
            connect: True to move arrays that no derivative reaches, too.
            deep: True to look at hidden layers, too.
            **fixed: options of `rts.render`.
        """
        one, unit, at = self._line(direction, connect)

        def image(t: Array, **options: Any) -> Array:
            return self.drawn(at(t), change, **{**fixed, **options})

        return pixel_step(self.engine, image, one * 0, unit, deep=deep)

    def _line(self, direction: Tree, connect: bool = False) -> tuple[Array, Array, Callable[[Array], tuple]]:
        """A 1, a unit tangent, and t → the scene of the parameters moved by t along a direction.

        The scene function is differentiated if possible. Some engines' forward mode fails in functions that read
        values, as NumPy does. Then the scene's arrays move by differences, but arrays that no derivative reaches do
        not move, unless `connect` is set.
        """
        xp = self.engine.namespace
        one = self.engine.constant(np.ones(()), next(leaves(self.parameters)))

        def at(t: Array) -> tuple:
            steps = iter(leaves(direction))
            return self.shown(
                map_leaves(lambda p: p + xp.astype(t, p.dtype, copy=False) * next(steps), self.parameters)
            )

        return one, one, at if self._forward and not connect else self._by_differences(direction, connect)

    @cached_property
    def _forward(self) -> bool:
        """True if forward mode works through the scene function."""

        def total(p: Tree) -> Array:
            self.shown(p)
            return sum(self.engine.namespace.sum(x) for x in leaves(p))

        try:
            self.engine.jvp(total, self.parameters, self.parameters)
        except (RuntimeError, TypeError):  # Of torch and of jax.
            return False
        return True

    def _by_differences(self, direction: Tree, connect: bool) -> Callable[[Array], tuple]:
        rest, like = self.shown(self.parameters), next(leaves(self.parameters))
        places, here = self._arrays(rest)
        ends = [self._placed(self.shown(self.moved(direction, by))) for by in (SHORT, -SHORT)]
        tangents = []
        for place, x in zip(places, here, strict=True):
            a, b = (end.get(place, np.empty(0)) for end in ends)
            alike = is_floating(x) and np.shape(a) == np.shape(b) == np.shape(x)
            moves = alike and (connect or (self.engine.owns(x) and place in self._gradients))
            tangent = (a - b) / (2 * SHORT) if moves else None
            tangents.append(tangent if self.engine.owns(x) or tangent is None else self.engine.constant(tangent, like))

        def at(t: Array) -> tuple:
            it, xp = iter(tangents), self.engine.namespace

            def leaf(x: Array) -> Array:
                tangent = next(it)
                if tangent is None:
                    return x
                x = x if self.engine.owns(x) else self.engine.constant(np.asarray(x), like)
                return x + xp.astype(t, x.dtype, copy=False) * tangent

            return tuple(map_leaves(leaf, [listed_parts(rest[0]), rest[1]]))

        return at

    # ------------------------------------------------------------------------------------------ arrays of the scene

    def _arrays(self, scene: tuple[Any, Camera]) -> tuple[list[Place], list[Array]]:
        places, arrays = [], []
        for index, part in enumerate([*listed_parts(scene[0]), scene[1]]):
            for name, x in named_leaves(part):
                places.append(Place(None if isinstance(part, Camera) else index, name))
                arrays.append(x)
        return places, arrays

    def _placed(self, scene: tuple[Any, Camera]) -> dict[Place, Array]:
        return dict(zip(*self._arrays(scene), strict=True))

    @cached_property
    def _gradients(self) -> dict[Place, list[np.ndarray | None]]:
        """For each array that a derivative reaches, the gradient of its sum under random weights.

        A list by leaf of the parameters; None for leaves where the gradient is 0.
        """
        engine, gradients = self.engine, {}
        places, arrays = self._arrays(self.shown(self.parameters))
        for k, (place, x) in enumerate(zip(places, arrays, strict=True)):
            if not engine.owns(x) or not is_floating(x):
                continue
            weights = np.random.default_rng(k).normal(size=tuple(x.shape))

            def total(p: Tree, k: int = k, weights: np.ndarray = weights) -> Array:
                y = self._arrays(self.shown(p))[1][k]
                return namespace(y).sum(y * engine.constant(weights, y))

            gradient = [engine.to_numpy(g) for g in leaves(engine.value_and_grad(total)(self.parameters)[1])]
            if any(g.any() for g in gradient):
                gradients[place] = [g if g.any() else None for g in gradient]
        return gradients

    def touched(self, direction: Tree, step: float) -> Touched:
        """The arrays of the scene that differ half a step behind and ahead along a direction.

        Arrays that shaders and surfaces hold count, too, by the names "shader" and "surface".
        """
        scenes = [self.shown(self.moved(direction, by)) for by in (-step / 2, step / 2)]
        before, after = map(self._placed, scenes)
        changed, constant, cut = [], [], []
        along = [self.engine.to_numpy(d) for d in leaves(direction)]
        for place in dict.fromkeys([*before, *after]):
            if place.part is not None and place.part >= len(self.parts):
                continue  # The scene at the current parameters has no such part.
            ends = [x.get(place) for x in (before, after)]
            if all(x is not None for x in ends) and self._alike(*ends):
                continue
            changed.append(place)
            slopes = self._gradients.get(place)
            if not self.engine.owns(next(x for x in ends if x is not None)):
                constant.append(place)
            elif slopes is None or not any((g * d).any() for g, d in zip(slopes, along, strict=True) if g is not None):
                cut.append(place)
        for index, pair in enumerate(zip(*(listed_parts(parts) for parts, _ in scenes), strict=False)):
            for name in ("shader", "surface") if index < len(self.parts) else ():
                of = attrgetter(name)
                a, b = (list(_held(of(part), self._is_array)) for part in pair)
                if len(a) != len(b) or not all(map(self._alike, a, b)):
                    changed.append(Place(index, name))
                    constant += [changed[-1]] if not any(map(self.engine.owns, [*a, *b])) else []
        return Touched(changed, constant, cut)

    def _is_array(self, x: Any) -> bool:
        return isinstance(x, np.ndarray) or self.engine.owns(x)

    def _alike(self, a: Array, b: Array) -> bool:
        if a is b:
            return True
        x, y = (self.engine.to_numpy(v) if self.engine.owns(v) else np.asarray(v) for v in (a, b))
        return x.shape == y.shape and np.array_equal(x, y, equal_nan=x.dtype.kind == y.dtype.kind == "f")

    @cached_property
    def parts(self) -> list[Any]:
        """The checked parts of the scene at the current parameters."""
        scene_parts, camera = self.shown(self.parameters)
        return check_scene(listed_parts(scene_parts), camera)[0]

    @cached_property
    def supersample(self) -> int:
        """Samples along each axis of a pixel."""
        return int(self.options.get("supersample", 1))

    def splats_as(self, name: str) -> bool:
        """True if the scene's splatter is of the kind with this name."""
        return type(check_splatter(self.options.get("splatter", "auto"))) is type(check_splatter(name))

    @cached_property
    def opaque(self) -> bool:
        """True if all shaders promise to be opaque."""
        return all(part.shader.opaque for part in self.parts)

    @cached_property
    def weights(self) -> np.ndarray:
        """(H, W, 4), the derivative of the loss in the image."""
        return self.engine.to_numpy(self.engine.value_and_grad(self.loss)(self.image(self.parameters))[1])

    @cached_property
    def rendered(self) -> np.ndarray:
        """(H, W, 4), the image."""
        return self.engine.to_numpy(self.image(self.parameters))


def listed_parts(parts: Any) -> list[Part]:
    """The parts in a list; those of `rts.prepare` without their prepared data."""
    if isinstance(parts, PreparedParts):
        parts = parts.parts
    return list(parts) if isinstance(parts, (list, tuple)) else [parts]


def _held(thing: Any, is_array: Callable[[Any], bool], depth: int = HELD) -> Iterator[Array]:
    """Arrays that a function or an object holds: in its closure, defaults and attributes.

    Args:
        thing: a function, object, container or array.
        is_array: value → True if it is an array to yield.
        depth: how many levels of such things are entered.
    """
    if is_array(thing):
        yield thing
    elif depth and not isinstance(thing, (str, bytes, type)):
        if isinstance(thing, Mapping):
            inside = list(thing.values())
        elif isinstance(thing, (list, tuple)):
            inside = list(thing)
        elif isinstance(thing, MethodType):
            inside = [thing.__self__, *_held_by_function(thing.__func__)]
        elif isinstance(thing, FunctionType):
            inside = _held_by_function(thing)
        elif isinstance(thing, partial):
            inside = [thing.func, thing.args, thing.keywords]
        else:
            try:
                inside = [vars(thing)]
            except TypeError:  # It has no attributes of its own.
                inside = []
        for x in inside:
            yield from _held(x, is_array, depth - 1)


def _held_by_function(function: FunctionType) -> list[Any]:
    """Objects that a function of Python holds in its defaults, its attributes and its closure."""
    inside: list[Any] = [function.__defaults__, function.__kwdefaults__, vars(function)]
    for cell in function.__closure__ or ():
        with contextlib.suppress(ValueError):  # A variable that is not assigned yet.
            inside.append(cell.cell_contents)
    return inside


def is_floating(x: Array) -> bool:
    """True if an array or a number is of floating point."""
    return isinstance(x, float) or (not isinstance(x, int) and namespace(x).isdtype(x.dtype, "real floating"))
