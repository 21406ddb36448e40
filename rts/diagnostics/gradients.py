"""Looking at derivatives: as a picture, and beside finite differences that know nothing of splatting."""

from __future__ import annotations

import contextlib
import inspect
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rts.arguments import quoted
from rts.arrays import from_numbers, kind_of
from rts.camera import Camera
from rts.checks import check_size, is_count, is_real
from rts.diagnostics.steps import pixel_step
from rts.engines import Engine, engine_of, is_constant, namespace
from rts.errors import InputError
from rts.files.srgb import decode_srgb
from rts.fitting.dependence import differentiable
from rts.fitting.names import named_leaves
from rts.fitting.run import untraceable
from rts.interfaces import Part
from rts.rendering import render
from rts.trees import Array, Tree, leaves, map_leaves

Scene = Callable[[Tree], tuple[Part | Sequence[Part], Camera]]

STEP_UNSEEN = 1e-2
"""How far the finite differences change a number that nothing seems to depend on."""
NEGLIGIBLE = 0.01
"""What does not matter, as a share of the largest effect of a step."""
LOSS_SMOOTHNESS = 4.0
"""Standard deviation of the Gaussian that smooths the weights of the default loss, pixels."""


class GradientImage(NamedTuple):
    """How an image changes with its parameters.

    Attributes:
        derivative: (H, W, C) float, change of the image for a unit step along the direction.
        scale: the change that the picture shows at full strength.
    """

    derivative: np.ndarray
    scale: float

    @property
    def picture(self) -> np.ndarray:
        """(H, W, 3) linear RGB for `rts.save_image`: middle grey is zero, brighter positive, darker negative."""
        if self.derivative.shape[2] not in (1, 3, 4):
            raise InputError(f"the image has {self.derivative.shape[2]} channels; expected 1, 3 or 4 for a picture")
        color = self.derivative if self.derivative.shape[2] in (1, 3) else self.derivative[..., :3]
        signed = np.clip(0.5 + 0.5 * color / self.scale, 0, 1)
        return decode_srgb(np.broadcast_to(signed, (*signed.shape[:2], 3)))


def gradient_image(
    image: Callable[[Tree], Array], parameters: Tree, direction: Tree = None, *, scale: float | None = None
) -> GradientImage:
    """The derivative of an image along a direction of its parameters, by forward mode, as a signed picture.

    Args:
        image: parameters → (H, W, C), such as a function that calls `rts.render`.
        parameters: a torch or jax array, or nested dicts and lists of them.
        direction: a tree of the parameters' structure; None stands for 1 if they are a single number.
        scale: the change that is shown at full strength; None for the largest there is.

    Raises:
        InputError: parameters that have no derivative, or a direction of another structure.
    """
    _check_function("image", image, "a function: parameters → (H, W, C)")
    engine, parameters = _differentiable(parameters, "rts.gradient_image")
    if direction is None:
        if [math.prod(p.shape) for p in leaves(parameters)] != [1]:
            raise InputError("parameters holds more than one number; give the direction along which to differentiate")
        direction = map_leaves(lambda p: engine.namespace.ones_like(p), parameters)
    direction = _like(from_numbers(direction), parameters, engine)
    if scale is not None and not (is_real(scale) and 0 < scale < math.inf):
        raise InputError(f"scale is {quoted(scale)}; expected a positive number, or None for the largest change")

    def checked(p: Tree) -> Array:
        found = image(p)
        if not engine.owns(found) or found.ndim != 3:
            raise InputError(f"image gave {kind_of(found)}; expected a {engine.name} array (H, W, C)")
        return found

    with _traceable(engine):
        derivative = engine.to_numpy(engine.jvp(checked, parameters, direction)[1])
    if not np.isfinite(derivative).all():
        raise InputError("the derivative of the image is not finite; check the parameters for NaN")
    largest = float(np.abs(derivative).max(initial=0.0))
    return GradientImage(derivative, float(scale) if scale is not None else largest or 1.0)


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


class GradientCheck(NamedTuple):
    """The result of `check_gradient`; as a string, a table.

    Attributes:
        slopes: one for each number that was looked at.
        tolerance: how far a derivative may be off, relative to itself.
    """

    slopes: list[Slope]
    tolerance: float

    def agrees(self, slope: Slope) -> bool:
        """Whether autodiff and the difference agree.

        They may be off by the tolerance, three error bars and what is negligible beside the other slopes. Slopes of
        different units are compared by what a step of a pixel does to the loss.
        """
        largest = max(abs(s.difference * s.step) for s in self.slopes)
        allowed = self.tolerance * abs(slope.difference) + 3 * slope.error + NEGLIGIBLE * largest / slope.step
        return abs(slope.autodiff - slope.difference) <= allowed

    @property
    def ok(self) -> bool:
        """Whether all slopes agree."""
        return all(map(self.agrees, self.slopes))

    def __str__(self) -> str:
        width = max(len(s.name) for s in self.slopes)
        lines = [f"{'parameter':{max(width, 9)}}    autodiff  difference      ± error   ratio"]
        for s in self.slopes:
            ratio = f"{s.autodiff / s.difference:7.3f}" if abs(s.difference) > s.error else "      –"
            verdict = "" if self.agrees(s) else "  differs"
            lines.append(
                f"{s.name:{max(width, 9)}} {s.autodiff:11.4g} {s.difference:11.4g} {s.error:12.2g} {ratio}{verdict}"
            )
        return "\n".join(lines)


def check_gradient(
    scene: Scene,
    parameters: Tree,
    size: tuple[int, int],
    *,
    loss: Callable[[Array], Array] | None = None,
    entries: int = 6,
    samples: int = 8,
    tolerance: float = 0.1,
    **options: Any,
) -> GradientCheck:
    """Compare the gradient of a loss of a rendered scene with finite differences, to see whether it can be trusted.

    The differences are of images without splatting, of `samples`² and (`samples` + 1)² samples a pixel, over a step
    that moves what moves fastest by one pixel, and over twice that step.

    Args:
        scene: parameters → (parts, camera).
        parameters: a torch or jax array, or nested dicts and lists of them.
        size: (height, width).
        loss: image (H, W, 4) → scalar; None for a smooth random weighting of the image, with a fixed seed.
        entries: how many numbers to look at in each array: those of largest gradient, and some at random.
        samples: the square root of the number of samples a pixel.
        tolerance: how far a derivative may be off, relative to itself.
        **options: splatter, layers, supersample, background, … of `rts.render`.

    Raises:
        InputError: parameters that have no derivative, or arguments that `rts.render` refuses.
    """
    _check_function("scene", scene, "a function: parameters → (parts, camera)")
    if loss is not None:
        _check_function("loss", loss, "a function: image (H, W, 4) → scalar, or None")
    engine, parameters = _differentiable(parameters, "rts.check_gradient")
    size = check_size(size, 1, None, 1)
    for name, count in (("samples", samples), ("entries", entries)):
        if not is_count(count):
            raise InputError(f"{name} is {quoted(count)}; expected an integer of at least 1")
    if not (is_real(tolerance) and 0 <= tolerance < math.inf):
        raise InputError(f"tolerance is {quoted(tolerance)}; expected a number, at least 0")
    known = [n for n in inspect.signature(render).parameters if n not in ("parts", "camera", "size")]
    if unknown := [name for name in options if name not in known]:
        raise InputError(f"there is no option {unknown[0]!r}; expected {', '.join(known)}")
    loss = _scalar(_smooth_weighting(size, engine, parameters) if loss is None else loss, engine)

    def image(p: Tree, **changes: Any) -> Array:
        found = scene(p)
        if not isinstance(found, tuple) or len(found) != 2:
            raise InputError(f"scene gave {kind_of(found)}; expected (parts, camera)")
        return render(*found, size, **{**options, **changes})

    with _traceable(engine):
        value, gradient = engine.value_and_grad(lambda p: loss(image(p)))(parameters)
    slopes = []
    for number, ((name, value), slope) in enumerate(zip(named_leaves(parameters), leaves(gradient), strict=True)):
        flat = engine.to_numpy(slope).reshape(-1)
        for index in _chosen(flat, entries):
            direction = _unit(engine, parameters, number, index)
            step = pixel_step(engine, image, parameters, direction) or STEP_UNSEEN
            hard = partial(_difference, engine, loss, partial(image, splatter="none"), parameters, direction)
            coarse, fine, wide = hard(step, samples), hard(step, samples + 1), hard(2 * step, samples)
            difference = (coarse + fine) / 2
            error = abs(coarse - fine) / 2 + abs(wide - coarse) / 3
            place = ", ".join(map(str, np.unravel_index(index, value.shape)))
            label = f"{name}[{place}]" if value.shape else name
            slopes.append(Slope(label, float(flat[index]), difference, error, step))
    return GradientCheck(slopes, tolerance)


# --------------------------------------------------------------------------------------------------- parameters


@contextlib.contextmanager
def _traceable(engine: Engine) -> Iterator[None]:
    """Errors of a framework that cannot trace the user's function are told in one line."""
    try:
        yield
    except Exception as error:
        told = untraceable(error, engine)
        if told is None:
            raise
        raise told from error


def _differentiable(parameters: Tree, caller: str) -> tuple[Engine, Tree]:
    """The engine of parameters that have derivatives, and the parameters, dicts in the order of `leaves`."""
    engine = differentiable(parameters)
    if any(engine.traced(x) for x in leaves(parameters)):
        raise InputError(f"parameters holds traced arrays; call {caller} outside jit and other transforms")
    return engine, map_leaves(lambda p: p, parameters)


def _check_function(name: str, given: Any, expected: str) -> None:
    if not callable(given):
        raise InputError(f"{name} is {quoted(given)}; expected {expected}")


def _like(direction: Tree, parameters: Tree, engine: Engine) -> Tree:
    """The direction as arrays of the engine, of the parameters' names and shapes."""
    given, wanted = ([(name, tuple(np.shape(x))) for name, x in named_leaves(t)] for t in (direction, parameters))
    if given != wanted:
        raise InputError(f"direction has arrays of shapes {given}; expected those of the parameters, {wanted}")
    if engine_of(direction, parameters) is not engine:  # Arrays of two engines are refused by `engine_of`.
        raise InputError(f"direction holds arrays of another engine; expected {engine.name}")
    values = iter(leaves(direction))

    def leaf(p: Array) -> Array:
        d = next(values)
        return namespace(p).astype(engine.constant(np.asarray(d), p) if is_constant(d) else d, p.dtype, copy=False)

    return map_leaves(leaf, parameters)


def _scalar(loss: Callable[[Array], Array], engine: Engine) -> Callable[[Array], Array]:
    """The loss, refused where it is no scalar of the engine."""

    def call(image: Array) -> Array:
        if not engine.owns(image):
            raise InputError(f"the image is {kind_of(image)}: nothing in the scene depends on the parameters")
        value = loss(image)
        if not engine.owns(value) or value.shape != ():
            raise InputError(f"loss gave {kind_of(value)}; expected a {engine.name} scalar, of shape ()")
        return value

    return call


def _chosen(gradient: np.ndarray, count: int) -> list[int]:
    """Indices of the largest entries and of some others, fixed by the seed."""
    if gradient.size <= count:
        return list(range(gradient.size))
    largest = np.argsort(-np.abs(gradient), kind="stable")[: (count + 1) // 2]
    rest = np.setdiff1d(np.arange(gradient.size), largest)
    others = np.random.default_rng(0).choice(rest, count - len(largest), replace=False)
    return sorted(map(int, (*largest, *others)))


def _unit(engine: Engine, parameters: Tree, number: int, index: int) -> Tree:
    """The direction in which one number of one leaf changes."""
    count = iter(range(sum(1 for _ in leaves(parameters))))

    def leaf(p: Array) -> Array:
        unit = np.zeros(math.prod(p.shape))
        unit[index if next(count) == number else slice(0)] = 1
        return namespace(p).astype(engine.constant(unit.reshape(p.shape), p), p.dtype, copy=False)

    return map_leaves(leaf, parameters)


# ------------------------------------------------------------------------------------------- finite differences


def _difference(
    engine: Engine, loss: Callable, image: Callable, parameters: Tree, direction: Tree, step: float, samples: int
) -> float:
    """Central difference of the loss of hard images."""

    def at(by: float) -> float:
        steps = iter(leaves(direction))
        moved = map_leaves(lambda p: p + by * next(steps), parameters)
        return float(engine.to_numpy(loss(image(moved, supersample=samples))))

    return (at(step / 2) - at(-step / 2)) / step


def _smooth_weighting(size: tuple[int, int], engine: Engine, parameters: Tree) -> Callable[[Array], Array]:
    """Image → the sum of its pixels with smooth random weights."""
    from scipy.ndimage import gaussian_filter

    weights = np.random.default_rng(0).normal(size=(*size, 4))
    weights = gaussian_filter(weights, (LOSS_SMOOTHNESS, LOSS_SMOOTHNESS, 0))
    weights = engine.constant(weights / weights.std(), next(leaves(parameters)))
    return lambda image: namespace(image).sum(image * weights)
