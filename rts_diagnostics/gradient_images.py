"""Derivative images of a scene along a direction of its parameters."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from rts import Engine, engine_of, namespace
from rts.errors import InputError
from rts.plugin_api.arrays import Array, Tree, from_numbers, leaves, map_leaves
from rts.plugin_api.checks import quoted
from rts.tool_api.parameters import differentiable, is_real, kind_of, named_leaves, untraceable
from rts.tool_api.pictures import decode_srgb


class GradientImage(NamedTuple):
    """The derivative of an image along a direction of its parameters.

    Attributes:
        derivative: (H, W, C) float, change of the image for a unit step along the direction.
        scale: the change that the picture shows at full strength: as 1 in a channel, or, if negative, as 0.
    """

    derivative: np.ndarray
    scale: float

    @property
    def picture(self) -> np.ndarray:
        """(H, W, 3) linear RGB for `rts.save_image`: middle grey is zero, brighter positive, darker negative.

        One channel becomes grey; of four channels the last is left out.

        Raises:
            InputError: the image has another number of channels than 1, 3 or 4.
        """
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
        InputError: parameters that have no derivative or are traced; a direction of another structure, or none for
            several numbers; a scale that is not positive; an image that is no (H, W, C) array of the parameters'
            engine, or whose derivative is not finite.
        EngineError: arrays of two engines.
    """
    check_callable("image", image, "a function: parameters → (H, W, C)")
    engine, parameters = checked_parameters(parameters, "rts.gradient_image")
    if direction is None:
        if [math.prod(p.shape) for p in leaves(parameters)] != [1]:
            raise InputError("parameters holds more than one number; give the direction along which to differentiate")
        direction = map_leaves(lambda p: engine.namespace.ones_like(p), parameters)
    direction = _like(from_numbers(direction, "direction"), parameters, engine)
    if scale is not None and not (is_real(scale) and 0 < scale < math.inf):
        raise InputError(f"scale is {quoted(scale)}; expected a positive number, or None for the largest change")

    def checked(p: Tree) -> Array:
        result = image(p)
        if not engine.owns(result) or result.ndim != 3:
            raise InputError(f"image gave {kind_of(result)}; expected a {engine.name} array (H, W, C)")
        return result

    with traceable(engine):
        derivative = engine.to_numpy(engine.jvp(checked, parameters, direction)[1])
    if not np.isfinite(derivative).all():
        raise InputError("the derivative of the image is not finite; check the parameters for NaN")
    largest = float(np.abs(derivative).max(initial=0.0))
    return GradientImage(derivative, float(scale) if scale is not None else largest or 1.0)


@contextlib.contextmanager
def traceable(engine: Engine) -> Iterator[None]:
    """Turn errors of a framework that cannot trace the user's function into one line."""
    try:
        yield
    except Exception as error:
        refusal = untraceable(error, engine)
        if refusal is None:
            raise
        raise refusal from error


def checked_parameters(parameters: Tree, caller: str) -> tuple[Engine, Tree]:
    """The engine of a user's parameters, and these with dicts in the order of `leaves`; traced ones are refused."""
    engine = differentiable(parameters)
    if any(engine.traced(x) for x in leaves(parameters)):
        raise InputError(f"parameters holds traced arrays; call {caller} outside jit and other transforms")
    return engine, map_leaves(lambda p: p, parameters)


def check_callable(name: str, function: Any, expected: str) -> None:
    """Refuse anything but a function; `expected` says of what."""
    if not callable(function):
        raise InputError(f"{name} is {quoted(function)}; expected {expected}")


def _like(direction: Tree, parameters: Tree, engine: Engine) -> Tree:
    """The direction as arrays of the engine and of the parameters' dtypes; other names or shapes are refused."""
    shapes, expected = ([(name, tuple(np.shape(x))) for name, x in named_leaves(t)] for t in (direction, parameters))
    if shapes != expected:
        raise InputError(f"direction has arrays of shapes {shapes}; expected those of the parameters, {expected}")
    if engine_of(direction, parameters) is not engine:  # Arrays of two engines are refused by `engine_of`.
        raise InputError(f"direction holds arrays of another engine; expected {engine.name}")
    values = iter(leaves(direction))

    def leaf(p: Array) -> Array:
        d = next(values)
        return namespace(p).astype(d if engine.owns(d) else engine.constant(np.asarray(d), p), p.dtype, copy=False)

    return map_leaves(leaf, parameters)
