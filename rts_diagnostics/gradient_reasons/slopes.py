"""Derivatives of a scene's image and loss in single numbers of its parameters, by autodiff and by differences."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rts import Camera, Engine, Part, namespace
from rts.plugin_api.arrays import Array, Tree, leaves, map_leaves
from rts_diagnostics.gradient_reasons.subject import DEEP, Subject
from rts_diagnostics.smoothing import low_pass

NEGLIGIBLE = 0.01
"""The largest negligible effect, as a share of the largest effect of a step."""
BLOCK = 8
"""The side of blocks of pixels whose contributions to a derivative are compared with it."""
STEP_UNSEEN = 1e-2
"""The step of finite differences for a number that nothing seems to depend on."""


class Slope(NamedTuple):
    """The derivative of a loss in one number of the parameters, by autodiff and by a finite difference.

    Attributes:
        name: the number's place in the parameters, such as "pose[2]".
        autodiff: the derivative through the splatter.
        difference: the central finite difference of renders without splatting, of many samples a pixel.
        error: bound on the error of `difference`: the disagreement of two sampling grids and two steps, and rounding.
        step: the step of the difference, in units of the number.
        contributions: the norm of what blocks of `BLOCK`² pixels contribute to `difference`: about how large it would
            be if their signs were random. It is larger than `difference` where these cancel.
    """

    name: str
    autodiff: float
    difference: float
    error: float
    step: float
    contributions: float = 0.0


class Number(NamedTuple):
    """One number of the parameters, and its effect on the image.

    Attributes:
        slope: its effect on the loss.
        direction: a tree of the parameters' structure, 1 at the number and 0 elsewhere.
        pushed: (H, W, 4) float32, the derivative of the image through the splatter, for a step of the slope's length;
            NaN if forward mode fails there.
        true: (H, W, 4) float32, the finite difference over that step.
        noise: half the norm of the low-passed disagreement of two sampling grids.
        forward: True if forward mode works through the splatter.
    """

    slope: Slope
    direction: Tree
    pushed: np.ndarray
    true: np.ndarray
    noise: float
    forward: bool


def measured(subject: Subject, name: str, direction: Tree, slope: float | None, samples: int) -> Number:
    """The effect of one number, by autodiff and by finite differences.

    Args:
        subject: the scene under test.
        name: the number's name.
        direction: a tree of the parameters' structure, along which the number changes.
        slope: the derivative of the loss by reverse mode; None to take it by forward mode.
        samples: samples a pixel along each axis.
    """
    step = subject.step(direction) or _step_of_hidden(subject, direction) or STEP_UNSEEN
    try:
        pushed, forward = subject.push(direction) * step, True
    except (RuntimeError, TypeError):  # Of torch and of jax, for a user's own operation.
        pushed, forward = np.full_like(subject.rendered, np.nan), False
    if slope is None:
        slope = float((subject.weights * pushed.astype(np.float64)).sum() / step)
    nothing = Slope(name, slope, math.nan, math.nan, step)
    return differenced(
        subject, Number(nothing, direction, pushed.astype(np.float32), pushed, math.nan, forward), samples
    )


def differenced(subject: Subject, number: Number, samples: int) -> Number:
    """A copy of `number` with new finite differences, by `samples`² and (`samples` + 1)² samples a pixel.

    These are `true`, `noise`, and `difference` and `error` of its slope.
    """
    step, direction = number.slope.step, number.direction
    to_numpy = subject.engine.to_numpy

    rounding: list[float] = []

    def hard(length: float, count: int) -> tuple[float, np.ndarray]:
        after, before = (subject.hard(direction, sign * length / 2, count) for sign in (1, -1))
        losses = [to_numpy(subject.loss(x)) for x in (after, before)]
        rounding.append(max(float(abs(x) * np.finfo(x.dtype).eps) for x in losses) / length)
        return (float(losses[0]) - float(losses[1])) / length, to_numpy(after).astype(np.float64) - to_numpy(before)

    (coarse, image), (fine, other), (wide, _) = hard(step, samples), hard(step, samples + 1), hard(2 * step, samples)
    error = abs(coarse - fine) / 2 + abs(wide - coarse) / 3 + max(rounding)
    true, noise = (image + other) / 2, float(np.linalg.norm(low_pass((image - other) / 2)))
    of_blocks = (subject.weights * true).sum(axis=-1) / step
    for axis in range(2):
        of_blocks = np.add.reduceat(of_blocks, np.arange(0, of_blocks.shape[axis], BLOCK), axis=axis)
    found = {"difference": (coarse + fine) / 2, "error": error, "contributions": float(np.linalg.norm(of_blocks))}
    return number._replace(slope=number.slope._replace(**found), true=true.astype(np.float32), noise=noise)


def _step_of_hidden(subject: Subject, direction: Tree) -> float | None:
    """The step that moves the changed parts, drawn alone, by a pixel, or else changes their colour; None if neither.

    Arrays that no derivative reaches move by differences; see `connect` of `Subject.step`.
    """
    touched = subject.touched(direction, STEP_UNSEEN)
    connect = bool(touched.constant or touched.cut)
    kept = touched.parts

    def alone(parts: list[Part], camera: Camera) -> tuple[list[Part], Camera]:
        return [p for i, p in enumerate(parts) if kept is None or i in kept], camera

    return (
        subject.step(direction, alone, connect=connect, deep=True, layers=DEEP, capacity=None) if touched.all else None
    )


def largest_and_random(gradient: np.ndarray, count: int) -> list[int]:
    """Sorted indices of `count` entries of (n,), or all: half the largest or NaN, others random, by a fixed seed."""
    if gradient.size <= count:
        return list(range(gradient.size))
    largest = np.argsort(-np.nan_to_num(np.abs(gradient), nan=np.inf), kind="stable")[: (count + 1) // 2]
    rest = np.setdiff1d(np.arange(gradient.size), largest)
    others = np.random.default_rng(0).choice(rest, count - len(largest), replace=False)
    return sorted(map(int, (*largest, *others)))


def unit(engine: Engine, parameters: Tree, number: int, index: int) -> Tree:
    """The direction along which entry `index` of leaf `number` changes alone: a tree of the parameters' structure."""
    count = iter(range(sum(1 for _ in leaves(parameters))))

    def leaf(p: Array) -> Array:
        direction = np.zeros(math.prod(p.shape))
        direction[index if next(count) == number else slice(0)] = 1
        return namespace(p).astype(engine.constant(direction.reshape(p.shape), p), p.dtype, copy=False)

    return map_leaves(leaf, parameters)
