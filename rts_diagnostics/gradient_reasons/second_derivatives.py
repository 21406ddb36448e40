"""Second derivatives of a loss in single numbers, by autodiff and by differences of gradients."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rts.errors import InputError, RtsError
from rts.plugin_api.arrays import Tree, leaves
from rts_diagnostics.gradient_reasons.slopes import NEGLIGIBLE, Number, unit
from rts_diagnostics.gradient_reasons.subject import Subject
from rts_diagnostics.progress import Phase

REACH = 2.0
"""Half the distance of the gradients whose difference is taken, in steps of a slope: pixels, where something moves."""


class HessianCheck(NamedTuple):
    """Second derivatives of a loss in the numbers that `check_gradient` looked at; as a string, a table.

    Entry (i, j) is the derivative, in number i, of the slope in number j.

    Attributes:
        names: the numbers' names, n of them.
        autodiff: (n, n) float64, by reverse mode over forward mode. Samples stay as they are.
        difference: (n, n), the central difference of two gradients, by reverse mode, two steps ahead and two behind
            in number i. Samples are cast anew for each.
        error: (n, n), bound on the error of `difference` that the lengths of differences have: 4/3 of its
            disagreement with those over half the distance.
        steps: (n,), the steps of the slopes: each moves the fastest point by a pixel, or else the fastest colour
            by 0.05.
        tolerance: the largest error of a derivative, relative to it.
    """

    names: list[str]
    autodiff: np.ndarray
    difference: np.ndarray
    error: np.ndarray
    steps: np.ndarray
    tolerance: float

    @property
    def agreement(self) -> np.ndarray:
        """(n, n) bool: automatic second derivatives and differences differ by at most what may be.

        That is the sum of the tolerance, three error bars, and 1 % of the effect of the largest entry.
        """
        effects = self.steps[:, None] * self.steps
        sizes = np.abs([self.autodiff, self.difference]) * effects
        largest = np.max(sizes, where=np.isfinite(sizes), initial=0.0)
        allowed = self.tolerance * np.abs(self.difference) + 3 * self.error + NEGLIGIBLE * largest / effects
        return np.abs(self.autodiff - self.difference) <= allowed

    @property
    def ok(self) -> bool:
        """True if all entries agree."""
        return bool(self.agreement.all())

    def eigenvalues(self, hessian: np.ndarray) -> np.ndarray:
        """(n,) ascending, of the symmetric part of one of the matrices, in units of the loss, for steps as units."""
        effect = self.steps[:, None] * hessian * self.steps
        if not np.isfinite(effect).all():
            return np.full(len(self.steps), np.nan)
        return np.linalg.eigvalsh((effect + effect.T) / 2)

    def __str__(self) -> str:
        width, agrees = max(9, *map(len, self.names)), self.agreement
        lines = [f"{'curvature':{width}}    autodiff  difference      ± error"]
        for i, name in enumerate(self.names):
            values = f"{self.autodiff[i, i]:11.4g} {self.difference[i, i]:11.4g} {self.error[i, i]:12.2g}"
            lines.append(f"{name:{width}} {values}{'' if agrees[i, i] else '  differs'}")
        ends = [self.eigenvalues(x)[[0, -1]] for x in (self.autodiff, self.difference)]
        autodiff, difference = (f"{low:.4g} … {high:.4g}" for low, high in ends)
        lines.append(
            f"Hessian for steps of a pixel: eigenvalues {autodiff} by autodiff, {difference} by differences; "
            f"{np.count_nonzero(~agrees)} of {agrees.size} entries differ."
        )
        if not self.ok:
            lines.append(
                "Second derivatives by autodiff are those of weights in pixels, not of the areas that these stand for: "
                'take Gauss–Newton (rts.fit with method="lm"), or differences of gradients.'
            )
        return "\n".join(lines)


def require_second_derivatives(subject: Subject) -> None:
    """Refuse a scene that its engine cannot differentiate twice.

    Raises:
        InputError: the engine, the splatter, a shader or the user's functions have no derivative of a derivative.
    """
    _curvature(subject, unit(subject.engine, subject.parameters, 0, 0))


def curvatures(
    subject: Subject, numbers: Sequence[Number], tolerance: float, going: Callable[[], bool], phase: Phase
) -> HessianCheck:
    """Second derivatives in these numbers, or the first of them: at least one, and those begun while `going()`."""
    rows, done = [], phase("second derivatives", len(numbers))
    for number in numbers:
        if rows and not going():
            break
        near, far = (_difference(subject, number, reach) for reach in (REACH / 2, REACH))
        rows.append((_curvature(subject, number.direction), far, 4 / 3 * np.abs(far - near)))
        done()
    looked = numbers[: len(rows)]
    places = [int(_flat(subject, n.direction).argmax()) for n in looked]
    autodiff, difference, error = (np.stack(x)[:, places] for x in zip(*rows, strict=True))
    slopes = [n.slope for n in looked]
    return HessianCheck(
        [s.name for s in slopes], autodiff, difference, error, np.array([s.step for s in slopes]), tolerance
    )


def _curvature(subject: Subject, direction: Tree) -> np.ndarray:
    """The derivative of the gradient along a direction, flat, float64: the gradient of the slope along it."""
    engine = subject.engine

    def slope(parameters: Tree) -> Tree:
        return engine.jvp(lambda p: subject.loss(subject.image(p)), parameters, direction)[1]

    try:
        return _flat(subject, engine.value_and_grad(slope)(subject.parameters)[1])
    except RtsError:
        raise
    except (RuntimeError, TypeError, NotImplementedError) as error:  # Of torch and of jax.
        why = textwrap.shorten(str(error) or type(error).__name__, 120, placeholder="...")
        raise InputError(
            f"hessian=True: {engine.name} cannot differentiate this scene and its loss twice ({why}); leave it out"
        ) from error


def _difference(subject: Subject, number: Number, reach: float) -> np.ndarray:
    """The difference of gradients, flat, `reach` steps ahead of a number and behind, over their distance."""
    length = reach * number.slope.step

    def gradient(by: float) -> np.ndarray:
        at = subject.moved(number.direction, by)
        return _flat(subject, subject.engine.value_and_grad(lambda p: subject.loss(subject.image(p)))(at)[1])

    return (gradient(length) - gradient(-length)) / (2 * length)


def _flat(subject: Subject, tree: Tree) -> np.ndarray:
    return np.concatenate([np.ravel(subject.engine.to_numpy(x)).astype(np.float64) for x in leaves(tree)])
