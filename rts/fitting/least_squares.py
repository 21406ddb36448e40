"""Levenberg–Marquardt on the mean square of residuals, or on a robust loss of them."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence

import numpy as np

from rts.arrays.engine_base import Engine
from rts.arrays.trees import Tree, leaves
from rts.errors import InputError
from rts.fitting.checkpoint import arrays_in, is_like
from rts.fitting.dependence import directions_in_words, refuse_independent
from rts.fitting.losses import Loss
from rts.fitting.normal_equations import Linearization, flatten, least_squares_functions
from rts.fitting.parameter_names import named_leaves
from rts.fitting.run import NO_GRADIENT, Run
from rts.fitting.saving import Saving
from rts.fitting.terms import Terms

FIRST_DAMPING = 1e-3
LARGEST_DAMPING = 1e12
TINY = 1e-300
RESOLVED = 10.0
"""Least predicted gain that must show in the loss, in rounding errors of the loss."""


class _Model:
    """The quadratic model of a loss, in the eigenspaces of JᵀJ that stand out of its rounding.

    Unknowns are scaled so that JᵀJ has a diagonal of ones (Marquardt). The column of an unknown is taken to be at least
    as large as the largest of its array times the square root of the rounding: numbers of an array are of like units,
    and a column of rounding errors must not be scaled up. No step goes along eigenvectors whose eigenvalue is below the
    rounding. Of steps that differ along these only, the shortest is taken, in units of each array. Such a direction is
    the length of a vector that is normalised: a step that is shortest in Marquardt's units would run away along it.

    Args:
        linear: the normal equations.
        sizes: the number of entries of each array of the parameters.

    Attributes:
        least: the least damping to use, and the eigenvalue below which a direction counts as undetermined.
        open: (U, k), columns that span the undetermined directions, in numbers of the parameters.
        units: (U,), factors that make changes of different arrays comparable.
    """

    def __init__(self, linear: Linearization, sizes: Sequence[int]):
        self.least = linear.rounding * len(linear.gradient)
        diagonal = np.diag(linear.matrix).copy()
        largest = np.concatenate(
            [np.full(n, d.max(initial=0)) for n, d in zip(sizes, _split(diagonal, sizes), strict=True)]
        )
        scale = np.sqrt(np.maximum(diagonal, self.least * largest).clip(1e-12 * max(diagonal.sum(), TINY)))
        values, vectors = np.linalg.eigh(linear.matrix / scale[:, None] / scale)
        kept = values > self.least
        self._values, self._directions = values[kept], vectors[:, kept] / scale[:, None]
        self._downhill = -(linear.gradient @ self._directions)
        self.open = vectors[:, ~kept] / scale[:, None]
        self.units = np.sqrt(np.where(largest > 0, largest, 1.0))
        self._open = np.linalg.qr(self.open * self.units[:, None])[0] if self.open.shape[1] else None

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """The step (U,), and how far the loss falls by it, as the model predicts.

        Args:
            damping: positive number, added to the eigenvalues of the scaled JᵀSJ.
        """
        along = self._downhill / (self._values + damping)
        change = self._directions @ along
        if self._open is not None:
            change = change * self.units
            change = (change - self._open @ (self._open.T @ change)) / self.units
        return change, float(along @ (damping * along + self._downhill))


class _Control:
    """The control of the damping.

    Attributes:
        damping: the damping of the next step.
        growth: the factor by which it grows if the step gains nothing.
        promising: True if the last step gained.
        jumps: True if a short step that should have gained more than rounding gained nothing, since the last gain.
    """

    def __init__(self):
        self.damping, self.growth, self.promising, self.jumps = FIRST_DAMPING, 2.0, True, False

    def packed(self, vector: np.ndarray) -> bytes:
        """The control, and the vector (U,) of parameters that it belongs to, as bytes."""
        file = io.BytesIO()
        np.savez(file, vector=vector, **vars(self))
        return file.getvalue()

    def unpacked(self, packed: bytes, like: np.ndarray) -> np.ndarray:
        """Set the control to the state in bytes of `packed`. Returns the vector (U,).

        Raises:
            InputError: the bytes are no such state, or the vector is not like the other one.
        """
        arrays, expected = arrays_in(packed) or {}, {"vector": like, **vars(self)}
        sound = all(name in arrays and is_like(arrays[name], np.asarray(value)) for name, value in expected.items())
        if not sound or not (arrays["damping"] > 0 and arrays["growth"] > 0):
            raise InputError("the state of its method is damaged")
        self.__dict__.update({name: arrays[name].item() for name in vars(self)})
        return arrays["vector"]


def _split(x: np.ndarray, sizes: Sequence[int]) -> list[np.ndarray]:
    return np.split(x, np.cumsum(sizes)[:-1])


def levenberg_marquardt(
    terms: Terms,
    parameters: Tree,
    engine: Engine,
    run: Run,
    saving: Saving,
    *,
    jit: bool,
    loss: Loss,
    own_equations: bool,
    supersample: int | None,
) -> None:
    """Minimise a loss of residuals by normal equations; `run` records the steps and keeps the result.

    Scaling is Marquardt's; the damping is controlled as by Nielsen (Madsen et al. 2004), and never below the rounding
    of JᵀJ.

    The model of a robust loss has the loss's second derivative where that is positive enough (`Loss.weights`). With ρ'
    alone (iteratively reweighted least squares) the model would lie above the loss, but steps would be shorter: up to
    2.7 times as many (docs/results/hidden-masks.md).

    Args:
        terms: the terms of the loss; all of them count at every step.
        parameters: where to start; a private copy.
        engine: the engine of the parameters.
        run: takes note of each step, and says when to stop.
        saving: keeps checkpoints, and gives the state to go on from.
        jit: True to compile.
        loss: the loss of the residuals.
        own_equations: True to take the residuals' own `normal_equations`; see `rts.Residuals`.
        supersample: samples a pixel along each axis, for words on why the fit stopped; None if no images are fitted.

    Raises:
        InputError: the terms are drawn in batches; or at the start the residuals do not depend on the parameters, or
            loss or Jacobian is not finite.
    """
    if not terms.whole:
        raise InputError('method "lm" needs all terms at every step; leave out batch and window, or use "adam"')
    vector, unflatten = flatten(parameters)
    sizes = [math.prod(x.shape) for x in leaves(parameters)]
    linearize, loss_at = least_squares_functions(terms, loss, own_equations, parameters, engine, run, jit)
    control = _Control()

    def taken(linear: Linearization, start: bool) -> tuple[Linearization, _Model]:
        linear = linear.checked(start)
        run.note_gradient([bool(d.any()) for d in _split(np.diag(linear.matrix), sizes)])
        return linear, _Model(linear, sizes)

    def state() -> bytes:
        return control.packed(engine.to_numpy(vector))

    def restore(packed: bytes, _: Tree) -> None:
        nonlocal vector
        values = control.unpacked(packed, engine.to_numpy(vector))
        vector = engine.namespace.astype(engine.constant(values, vector), vector.dtype, copy=False)

    going = True
    if saving.resumes:
        saving.resumed(parameters, restore)
        going = run.left > 0
    current, model = taken(linearize(vector), start=run.fresh)
    if not run.history:
        going = run.record(unflatten(vector), current.value)
    while going:
        packed = state()
        saving.note(unflatten(vector), lambda packed=packed: packed)
        if not current.matrix.any() and len(run.history) == 1:
            refuse_independent(terms.of(terms.first()), None, parameters, engine)
        if not current.value or not current.gradient.any():
            run.stop(_at_rest(current))
            break
        damping = max(control.damping, model.least)
        delta, predicted = model.step(damping)
        trial = vector + engine.constant(delta, vector)
        # A trial after an accepted one is probably accepted, too: its normal equations come with its loss.
        at_trial = linearize(trial) if control.promising and run.left > 1 else None
        trial_value = loss_at(trial) if at_trial is None else at_trial.value
        going = run.record(unflatten(trial), trial_value)
        if not going:
            break
        gain = current.value - trial_value
        control.promising = gain > 0  # False for a trial that is not finite, too.
        if not control.promising:
            if damping >= 1 and predicted > RESOLVED * _loss_rounding(current, run.residuals):
                control.jumps = math.isfinite(trial_value)
            control.damping, control.growth = damping * control.growth, control.growth * 2
            going = control.damping <= LARGEST_DAMPING or run.stop(_no_step(control.jumps, supersample))
        elif gain <= run.tolerance * current.value:
            going = run.stop(f"the last step gained less than {run.tolerance:g} of the loss")
        else:
            ratio = gain / max(predicted, gain)
            control.damping, control.growth = damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3), 2.0
            vector, control.jumps = trial, False
            current, model = taken(at_trial or linearize(vector), start=False)
    _note_open(model, parameters, sizes, run)


def _at_rest(current: Linearization) -> str:
    """The reason, in words, that nothing can fall further."""
    moves = bool(current.matrix.any())
    if not current.value:
        # No depth is compared where nothing is seen any more.
        return "the loss is zero" if moves else "the loss and its derivatives are zero: all is met, or nothing compared"
    return "the gradient is zero" if moves else NO_GRADIENT


def _loss_rounding(linear: Linearization, count: int) -> float:
    """Rounding error of a mean loss of `count` residuals, each the difference of two numbers of about 1."""
    return linear.rounding * (linear.value + 2 * math.sqrt(linear.value / max(count, 1)))


def _no_step(jumps: bool, supersample: int | None) -> str:
    """The reason, in words, that no step lowers the loss.

    Short steps along the gradient gain what it promises where the loss is smooth. If they gain nothing, though the gain
    would exceed rounding, the loss has jumps. An image with one sample a pixel has: it is constant until an outline
    passes a sample.
    """
    if not jumps:
        return "no step lowers the loss: a minimum, if perhaps a local one"
    if supersample is None:
        return (
            "no step lowers the loss, though the gradient promises it: the loss has jumps at this scale; where it is "
            "of point-sampled images, a supersample of 2 to 4 goes further"
        )
    finer = "supersample=2, 3 or 4" if supersample == 1 else f"a supersample above {supersample}"
    return f"no step lowers the loss: it is at the floor of point sampling; {finer} goes further"


def _note_open(model: _Model, parameters: Tree, sizes: Sequence[int], run: Run) -> None:
    """Add a remark to the run on directions that the residuals do not determine, if there are some.

    Arrays whose gradient was zero throughout are left out: another remark names these.

    Args:
        model: the model at the last accepted step.
        parameters: a tree with the names and shapes of the parameters.
        sizes: the number of entries of each array.
        run: the run, which knows whose gradient was not zero.
    """
    names, arrays = zip(*named_leaves(parameters), strict=True)
    mattered = np.concatenate([np.full(n, m) for n, m in zip(sizes, run.mattered, strict=True)])
    # Without those arrays, columns may depend on each other.
    columns, sizes_left, _ = np.linalg.svd(model.open * (model.units * mattered)[:, None], full_matrices=False)
    columns = columns[:, sizes_left > 1e-6 * sizes_left.max(initial=0)] / model.units[:, None]
    if columns.shape[1]:
        shapes = [tuple(x.shape) for x in arrays]
        run.remarks.append(f"not determined: {directions_in_words(columns, model.units, names, shapes)}")
