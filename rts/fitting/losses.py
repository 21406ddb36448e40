"""Losses of residuals: the square, and robust ones, to which a large difference counts less than its square."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from rts.arguments import quoted
from rts.checks import is_real
from rts.engines import namespace
from rts.errors import InputError
from rts.trees import Array


class _Form(NamedTuple):
    """A loss of residuals r as array code.

    Attributes:
        cost: (namespace, r, f_scale) → s² ρ(z).
        weight: (namespace, r, f_scale) → ρ'(z).
        share: (namespace, ρ') → what 1 + 2 z ρ'' / ρ' is there.
    """

    cost: Callable[[Any, Array, float], Array]
    weight: Callable[[Any, Array, float], Array]
    share: Callable[[Any, Array], Array]


def _soft_root(xp: Any, r: Array, f_scale: float) -> Array:
    return xp.sqrt(1 + (r / f_scale) ** 2)


def _huber(xp: Any, r: Array, f_scale: float) -> Array:
    kept = xp.clip(r, -f_scale, f_scale)
    return kept * (2 * r - kept)


# The forms lose no digits where z is small, and have the right gradient at 0 and where they change.
FORMS = {
    "linear": _Form(lambda xp, r, f_scale: r * r, lambda xp, r, f_scale: xp.ones_like(r), lambda xp, weight: weight),
    "soft_l1": _Form(
        lambda xp, r, f_scale: 2 * r * r / (1 + _soft_root(xp, r, f_scale)),
        lambda xp, r, f_scale: 1 / _soft_root(xp, r, f_scale),
        lambda xp, weight: weight * weight,
    ),
    "huber": _Form(
        _huber,
        lambda xp, r, f_scale: f_scale / xp.clip(abs(r), f_scale, None),
        lambda xp, weight: xp.where(weight < 1, 0.0, weight),
    ),
    "cauchy": _Form(
        lambda xp, r, f_scale: f_scale * (f_scale * xp.log1p((r / f_scale) ** 2)),
        lambda xp, r, f_scale: 1 / (1 + (r / f_scale) ** 2),
        lambda xp, weight: 2 * weight - 1,
    ),
}
"""Name → form. Compiled loops know them by their places in this order."""

LEAST_SHARE = 0.1
"""What residuals beyond the scale keep of the curvature that their weight gives them."""


@dataclass(frozen=True)
class Loss:
    """The mean of s² ρ((r / s)²) over residuals r, with s for `f_scale`: what a fit makes small.

    The losses are those of `scipy.optimize.least_squares`, whose cost is half the sum where this is the mean:

    - "linear": ρ(z) = z, the mean square.
    - "soft_l1": ρ(z) = 2 (√(1 + z) − 1), a smooth form of "huber".
    - "huber": ρ(z) = z up to 1, 2 √z − 1 beyond: square for small residuals, linear for large ones.
    - "cauchy": ρ(z) = log(1 + z): large residuals count least, and there may be more local minima.

    It is a function of the residuals, and so may be the `loss` of `rts.fit`.

    Attributes:
        name: one of the above.
        f_scale: s, the residual at which square turns into robust, in units of the residuals; 0.1 suits masks. It has
            no effect on "linear".

    Raises:
        InputError: another name, or a scale that is not positive and finite.
    """

    name: str = "linear"
    f_scale: float = 1.0

    def __post_init__(self):
        if not isinstance(self.name, str) or self.name not in FORMS:
            raise InputError(f"loss is {quoted(self.name)}; expected one of {', '.join(FORMS)}")
        if not (is_real(self.f_scale) and 0 < self.f_scale < math.inf):
            raise InputError(f"f_scale is {quoted(self.f_scale)}; expected a positive, finite number")
        object.__setattr__(self, "f_scale", float(self.f_scale))

    def __call__(self, residuals: Array) -> Array:
        """The mean loss () of residuals of any shape."""
        xp = namespace(residuals)
        return xp.mean(FORMS[self.name].cost(xp, residuals, self.f_scale))

    def weights(self, residuals: Array) -> tuple[Array, Array]:
        """Weights W and curvatures S of residuals, for normal equations JᵀSJ and JᵀWr.

        Half the derivative of a residual's loss is W r, where W is ρ', in (0, 1]. S is half its second derivative,
        but a tenth of W where it is less, or negative: JᵀSJ is positive semidefinite. (Triggs et al. 2000; scipy takes
        them so, too, with the rounding for a tenth.)
        """
        xp, form = namespace(residuals), FORMS[self.name]
        weight = form.weight(xp, residuals, self.f_scale)
        return weight, weight * xp.clip(form.share(xp, weight), LEAST_SHARE, None)

    @property
    def robust(self) -> bool:
        """Whether it is another than the square."""
        return self.name != "linear"

    @property
    def place(self) -> int:
        """Its place among the losses; 0 is the square."""
        return list(FORMS).index(self.name)


SQUARE = Loss()
