"""Derivatives of a scene's image and loss in single numbers of its parameters, found in two ways."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from rts.arrays import kind_of
from rts.camera import Camera
from rts.checks import check_scene
from rts.diagnostics.steps import pixel_step
from rts.engines import Engine, is_constant, namespace
from rts.errors import InputError
from rts.fitting.names import named_leaves
from rts.interfaces import CheckedPart, Part
from rts.rendering import render
from rts.sampling.prepared import PreparedParts
from rts.trees import Array, Tree, leaves, map_leaves

Scene = Callable[[Tree], tuple[Part | Sequence[Part] | PreparedParts, Camera]]
Change = Callable[[list[Part], Camera], tuple[list[Part], Camera]]
"""Another scene, made of one."""

STEP_UNSEEN = 1e-2
"""How far the finite differences change a number that nothing seems to depend on."""
DEPENDS = 1.0
"""How far parameters are changed to see whether the scene depends on them at all."""
SHORT = 1e-3
"""How far they are changed to see how fast arrays of the scene change."""
DEEP = 8
"""Layers of the finite differences where shaders are not opaque."""


class Slope(NamedTuple):
    """The derivative of a loss in one number of the parameters, found in two ways.

    Attributes:
        name: where the number is, such as "pose[2]".
        autodiff: the derivative through the splatter.
        difference: the central finite difference of area-sampled hard renders.
        error: how far the difference may be off: what two sampling grids and two steps disagree on.
        step: the step of the difference, in units of the number.
    """

    name: str
    autodiff: float
    difference: float
    error: float
    step: float


class Number(NamedTuple):
    """One number of the parameters, and what it does to the image.

    Attributes:
        slope: what it does to the loss.
        direction: of the parameters' structure, 1 at the number.
        pushed: (H, W, 4), the derivative of the image through the splatter, for a step of the slope's length.
        true: (H, W, 4), the finite difference over that step.
        noise: (H, W, 4), half of what two sampling grids disagree on, signed.
    """

    slope: Slope
    direction: Tree
    pushed: np.ndarray
    true: np.ndarray
    noise: np.ndarray


class Place(NamedTuple):
    """An array of a scene: of which part, None for the camera, and its name there."""

    part: int | None
    name: str

    def __str__(self) -> str:
        return f"the camera's {self.name}" if self.part is None else f"part {self.part}'s {self.name}"


class Touched(NamedTuple):
    """Which arrays of a scene change with a number.

    Attributes:
        all: those that change.
        constant: those of them that are NumPy.
        cut: those of them that are arrays of the engine, though no derivative leads to them.
    """

    all: list[Place]
    constant: list[Place]
    cut: list[Place]

    @property
    def parts(self) -> list[int] | None:
        """The parts that change; None for all, since the camera does."""
        found = {place.part for place in self.all}
        return None if None in found else sorted(p for p in found if p is not None)


@dataclass(frozen=True, eq=False)
class Setting:
    """What is looked at: a scene, how it is rendered, and its loss.

    Attributes:
        engine: of the parameters.
        scene: parameters → (parts, camera).
        parameters: without marks of their own.
        size: (height, width).
        options: of `rts.render`.
        loss: image → scalar.
    """

    engine: Engine
    scene: Scene
    parameters: Tree
    size: tuple[int, int]
    options: Mapping[str, Any]
    loss: Callable[[Array], Array]

    def shown(self, parameters: Tree) -> tuple[Any, Camera]:
        """What the scene gives."""
        found = self.scene(parameters)
        if not isinstance(found, tuple) or len(found) != 2:
            raise InputError(f"scene gave {kind_of(found)}; expected (parts, camera)")
        return found

    def drawn(self, found: tuple[Any, Camera], change: Change | None = None, size: Any = None, **options: Any) -> Array:
        """The image of parts and a camera; a NumPy one becomes a constant of the engine."""
        parts, camera = found if change is None else change(listed_parts(found[0]), found[1])
        image = render(parts, camera, size or self.size, **{**self.options, **options})
        return image if self.engine.owns(image) else self.engine.constant(image, next(leaves(self.parameters)))

    def image(self, parameters: Tree, change: Change | None = None, **options: Any) -> Array:
        """The image (H, W, 4) of the changed scene."""
        return self.drawn(self.shown(parameters), change, **options)

    def require_dependence(self) -> None:
        """Refuse a scene of NumPy arrays which do not change with the parameters.

        Raises:
            InputError: nothing depends on them.
        """
        found = self.shown(self.parameters)
        image = render(*found, self.size, **self.options)
        if self.engine.owns(image):
            return
        ones = map_leaves(self.engine.namespace.ones_like, self.parameters)
        if not self.touched(ones, DEPENDS).all:
            raise InputError(f"the image is {kind_of(image)}: nothing in the scene depends on the parameters")

    def moved(self, direction: Tree, by: float) -> Tree:
        """The parameters, moved."""
        steps = iter(leaves(direction))
        return map_leaves(lambda p: p + by * next(steps), self.parameters)

    def hard(self, direction: Tree, by: float, samples: int, change: Change | None = None) -> Array:
        """The image without splatting, of `samples`² samples a pixel, of the moved parameters."""
        layers = self.options.get("layers", 2)
        if not self.opaque:
            layers = max(DEEP, 0 if isinstance(layers, str) else layers)
        options = dict(splatter="none", supersample=samples, layers=layers)
        return self.image(self.moved(direction, by), change, **options)

    def push(self, direction: Tree, change: Change | None = None, **options: Any) -> np.ndarray:
        """The derivative (H, W, 4) of the image along a direction, by forward mode."""
        return self._pushed(direction, partial(self.drawn, change=change, **options))

    def step(
        self, direction: Tree, change: Change | None = None, *, connect: bool = False, deep: bool = False, **given: Any
    ) -> float | None:
        """What `pixel_step` gives of a changed scene.

        Args:
            direction: of the parameters.
            change: of the scene.
            connect: whether arrays that no derivative leads to move, too.
            deep: whether to look at hidden layers, too.
            **given: options of `rts.render`.
        """
        one, unit, at = self._line(direction, connect)

        def image(t: Array, **options: Any) -> Array:
            return self.drawn(at(t), change, **{**given, **options})

        return pixel_step(self.engine, image, one * 0, unit, deep=deep)

    def _pushed(self, direction: Tree, draw: Callable[[tuple], Array]) -> np.ndarray:
        one, unit, at = self._line(direction)
        return self.engine.to_numpy(self.engine.jvp(lambda t: draw(at(t)), one * 0, unit)[1])

    def _line(self, direction: Tree, connect: bool = False) -> tuple[Array, Array, Callable[[Array], tuple]]:
        """One and a unit, and t → the scene of the parameters moved by t along a direction.

        The scene function is differentiated if it can be. One that looks at values, as NumPy does, cannot be by some
        engines' forward mode: then its arrays move by differences, and those that no derivative leads to rest.
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
        """Whether forward mode goes through the scene function."""

        def total(p: Tree) -> Array:
            self.shown(p)
            return sum(self.engine.namespace.sum(x) for x in leaves(p))

        try:
            self.engine.jvp(total, self.parameters, self.parameters)
        except RuntimeError:
            return False
        return True

    def _by_differences(self, direction: Tree, connect: bool) -> Callable[[Array], tuple]:
        rest, like = self.shown(self.parameters), next(leaves(self.parameters))
        places, here = self._arrays(rest)
        ends = [self._arrays(self.shown(self.moved(direction, by)))[1] for by in (SHORT, -SHORT)]
        tangents = []
        for place, x, a, b in zip(places, here, *ends, strict=True):
            floating = is_floating(x)
            moves = floating and (connect or (self.engine.owns(x) and place in self._gradients))
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

    def _arrays(self, found: tuple[Any, Camera]) -> tuple[list[Place], list[Array]]:
        places, arrays = [], []
        for index, part in enumerate([*listed_parts(found[0]), found[1]]):
            for name, x in named_leaves(part):
                places.append(Place(None if isinstance(part, Camera) else index, name))
                arrays.append(x)
        return places, arrays

    @cached_property
    def _gradients(self) -> dict[Place, list[np.ndarray]]:
        """For each array that some derivative leads to, the gradient of a random sum of it in the parameters."""
        engine, found = self.engine, {}
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
                found[place] = gradient
        return found

    def touched(self, direction: Tree, step: float) -> Touched:
        """The arrays of the scene that change with a step along a direction."""
        (places, before), (others, after) = (
            self._arrays(self.shown(self.moved(direction, by))) for by in (-step / 2, step / 2)
        )
        changed, constant, cut = [], [], []
        if places != others:  # Another number of parts, say.
            return Touched([], [], [])
        along = [self.engine.to_numpy(d) for d in leaves(direction)]
        for place, a, b in zip(places, before, after, strict=True):
            numpy = is_constant(a)
            x, y = (np.asarray(v) if numpy else self.engine.to_numpy(v) for v in (a, b))
            if x.shape != y.shape or x.dtype.kind != "f" or np.array_equal(x, y, equal_nan=True):
                continue
            changed.append(place)
            slopes = self._gradients.get(place)
            if numpy:
                constant.append(place)
            elif slopes is None or not any((g * d).any() for g, d in zip(slopes, along, strict=True)):
                cut.append(place)
        return Touched(changed, constant, cut)

    @cached_property
    def parts(self) -> list[CheckedPart]:
        """The parts of the scene as it is, checked."""
        parts, camera = self.shown(self.parameters)
        return check_scene(listed_parts(parts), camera)[0]

    @cached_property
    def opaque(self) -> bool:
        """Whether all shaders promise to be."""
        return all(part.shader.opaque for part in self.parts)

    @cached_property
    def weights(self) -> np.ndarray:
        """(H, W, 4), the derivative of the loss in the image."""
        return self.engine.to_numpy(self.engine.value_and_grad(self.loss)(self.image(self.parameters))[1])

    @cached_property
    def seen(self) -> np.ndarray:
        """(H, W, 4), the image."""
        return self.engine.to_numpy(self.image(self.parameters))


def listed_parts(parts: Any) -> list[Part]:
    """The parts in a list, without what was built for them."""
    if isinstance(parts, PreparedParts):
        parts = parts.parts
    return list(parts) if isinstance(parts, (list, tuple)) else [parts]


def measured(setting: Setting, name: str, direction: Tree, slope: float | None, samples: int) -> Number:
    """What one number does, found in two ways.

    Args:
        setting: what is looked at.
        name: of the number.
        direction: in which it changes.
        slope: the derivative of the loss by reverse mode; None for that by forward mode.
        samples: the square root of the number of samples a pixel.
    """
    step = setting.step(direction) or _step_of_hidden(setting, direction) or STEP_UNSEEN
    to_numpy = setting.engine.to_numpy

    def hard(length: float, count: int) -> tuple[float, np.ndarray]:
        after, before = (setting.hard(direction, sign * length / 2, count) for sign in (1, -1))
        difference = float(to_numpy(setting.loss(after))) - float(to_numpy(setting.loss(before)))
        return difference / length, to_numpy(after).astype(np.float64) - to_numpy(before)

    (coarse, image), (fine, other), (wide, _) = hard(step, samples), hard(step, samples + 1), hard(2 * step, samples)
    error = abs(coarse - fine) / 2 + abs(wide - coarse) / 3
    pushed = setting.push(direction).astype(np.float64) * step
    if slope is None:
        slope = float((setting.weights * pushed).sum() / step)
    found = Slope(name, slope, (coarse + fine) / 2, error, step)
    return Number(found, direction, pushed, (image + other) / 2, (image - other) / 2)


def _step_of_hidden(setting: Setting, direction: Tree) -> float | None:
    """A step that moves by a pixel what is behind something, or what no derivative leads to."""
    touched = setting.touched(direction, STEP_UNSEEN)
    connect = bool(touched.constant or touched.cut)
    kept = touched.parts

    def alone(parts: list[Part], camera: Camera) -> tuple[list[Part], Camera]:
        return [p for i, p in enumerate(parts) if kept is None or i in kept], camera

    return (
        setting.step(direction, alone, connect=connect, deep=True, layers=DEEP, capacity=None) if touched.all else None
    )


def is_floating(x: Array) -> bool:
    """Whether an array, or a number, is of floating numbers."""
    return np.asarray(x).dtype.kind == "f" if is_constant(x) else namespace(x).isdtype(x.dtype, "real floating")


def chosen(gradient: np.ndarray, count: int) -> list[int]:
    """Indices of the largest entries and of some others, fixed by the seed."""
    if gradient.size <= count:
        return list(range(gradient.size))
    largest = np.argsort(-np.abs(gradient), kind="stable")[: (count + 1) // 2]
    rest = np.setdiff1d(np.arange(gradient.size), largest)
    others = np.random.default_rng(0).choice(rest, count - len(largest), replace=False)
    return sorted(map(int, (*largest, *others)))


def unit(engine: Engine, parameters: Tree, number: int, index: int) -> Tree:
    """The direction in which one number of one leaf changes."""
    count = iter(range(sum(1 for _ in leaves(parameters))))

    def leaf(p: Array) -> Array:
        found = np.zeros(math.prod(p.shape))
        found[index if next(count) == number else slice(0)] = 1
        return namespace(p).astype(engine.constant(found.reshape(p.shape), p), p.dtype, copy=False)

    return map_leaves(leaf, parameters)
