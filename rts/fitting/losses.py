"""Losses of residuals: the square, and robust ones, to which a large difference counts less than its square."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import described, from_numbers, shape_of
from rts.arrays.engines import namespace
from rts.arrays.trees import Array
from rts.contracts.checks import check_floating, is_real
from rts.errors import InputError


class _Form(NamedTuple):
    """A loss of residuals r as array code, of z = (r / s)² with s for `f_scale`.

    Attributes:
        cost: (namespace, r, f_scale) → s² ρ(z).
        weight: (namespace, r, f_scale) → ρ'(z).
        share: (namespace, ρ'(z)) → 1 + 2 z ρ''(z) / ρ'(z), the curvature over the weight.
    """

    cost: Callable[[Any, Array, float], Array]
    weight: Callable[[Any, Array, float], Array]
    share: Callable[[Any, Array], Array]


FAR = 1e8
"""Residuals beyond so many scales take the limits of the forms, since their z may overflow.

The limits differ from the forms by less than the rounding of float64.
"""


def _split(xp: Any, r: Array, f_scale: float) -> tuple[Array, Array, Array]:
    """Marks of far residuals, with |r| / s > `FAR`; |r| / s of these (others 1); and r / s of the others (these 0)."""
    ratio = r / f_scale
    far = abs(ratio) > FAR
    return far, xp.where(far, abs(ratio), 1.0), xp.where(far, 0.0, ratio)


def _soft_l1(xp: Any, r: Array, f_scale: float) -> Array:
    far, _, near = _split(xp, r, f_scale)
    small = 2 * xp.where(far, 0.0, r) * (f_scale * (near / (1 + xp.sqrt(1 + near * near))))
    return xp.where(far, 2 * f_scale * (abs(r) - f_scale), small)


def _soft_weight(xp: Any, r: Array, f_scale: float) -> Array:
    far, ratio, near = _split(xp, r, f_scale)
    return 1 / xp.where(far, ratio, xp.sqrt(1 + near * near))


def _huber(xp: Any, r: Array, f_scale: float) -> Array:
    kept = xp.clip(r, -f_scale, f_scale)
    return kept * (2 * r - kept)


def _cauchy(xp: Any, r: Array, f_scale: float) -> Array:
    far, ratio, near = _split(xp, r, f_scale)
    return f_scale * (f_scale * xp.where(far, 2 * xp.log(ratio), xp.log1p(near * near)))


# The forms lose no digits where z is small, and have the right gradient at 0 and where they change.
FORMS = {
    "linear": _Form(lambda xp, r, f_scale: r * r, lambda xp, r, f_scale: xp.ones_like(r), lambda xp, weight: weight),
    "soft_l1": _Form(_soft_l1, _soft_weight, lambda xp, weight: weight * weight),
    "huber": _Form(
        _huber,
        lambda xp, r, f_scale: f_scale / xp.clip(abs(r), f_scale, None),
        lambda xp, weight: xp.where(weight < 1, 0.0, weight),
    ),
    "cauchy": _Form(
        _cauchy,
        lambda xp, r, f_scale: _soft_weight(xp, r, f_scale) ** 2,
        lambda xp, weight: 2 * weight - 1,
    ),
}
"""Name → form."""

LEAST_SHARE = 0.1
"""Least curvature of a residual, as a share of its weight."""

SCALES = 1e-10, 1e10
"""Least and largest scale: with these float32 holds losses of residuals up to 1e20, and their derivatives."""


@dataclass(frozen=True)
class Loss:
    """A loss for fits: the mean of s² ρ((r / s)²) over residuals r, with s for `f_scale`.

    Each is the loss of its name in `scipy.optimize.least_squares`, whose cost is half the sum where this is the mean:

    - "linear": ρ(z) = z, the mean square.
    - "soft_l1": ρ(z) = 2 (√(1 + z) − 1), a smooth form of "huber".
    - "huber": ρ(z) = z up to 1, 2 √z − 1 beyond: square for small residuals, linear for large ones.
    - "cauchy": ρ(z) = log(1 + z): large residuals count least, and there may be more local minima.

    A `Loss` is a function of the residuals, and so may be the `loss` of `rts.fit`.

    Attributes:
        name: one of the above.
        f_scale: s, the residual at which square turns into robust, in units of the residuals, from 1e-10 to 1e10. The
            default, 0.1, suits differences of images in [0, 1]; SciPy's is 1. "linear" has none: it is 1 there,
            whatever is given.

    Raises:
        InputError: another name, or a scale that is no number from 1e-10 to 1e10.
    """

    name: str = "linear"
    f_scale: float = 0.1

    def __post_init__(self):
        if not isinstance(self.name, str) or self.name not in FORMS:
            raise InputError(f"loss is {quoted(self.name)}; expected one of {', '.join(FORMS)}")
        scale = _checked_scale(self.f_scale)
        object.__setattr__(self, "f_scale", scale if self.robust else 1.0)

    def __call__(self, residuals: Array) -> Array:
        """The mean loss () of residuals, an array of floats of any shape, or a list of numbers.

        Raises:
            InputError: an array of integers, or without numbers.
        """
        residuals = _checked_residuals(residuals)
        xp = namespace(residuals)
        return xp.mean(FORMS[self.name].cost(xp, residuals, self.f_scale))

    def weights(self, residuals: Array) -> tuple[Array, Array]:
        """Weights W and curvatures S, of the residuals' shape, for normal equations JᵀSJ and JᵀWr.

        Half the derivative of a residual's loss is W r, where W is ρ', at most 1. S is half its second derivative, at
        least a tenth of W, so that JᵀSJ is positive semidefinite. (Triggs et al. 2000; SciPy has the rounding error in
        place of a tenth.) Both are zero only where the dtype has no number so small.

        Raises:
            InputError: see `__call__`.
        """
        residuals = _checked_residuals(residuals)
        xp, form = namespace(residuals), FORMS[self.name]
        weight = form.weight(xp, residuals, self.f_scale)
        return weight, weight * xp.clip(form.share(xp, weight), LEAST_SHARE, None)

    @property
    def robust(self) -> bool:
        """True for every loss but the square."""
        return self.name != "linear"


def _checked_scale(value: Any) -> float:
    try:
        scale = float(value) if is_real(value) else 0.0
    except OverflowError:
        scale = 0.0
    least, largest = SCALES
    if not least <= scale <= largest:
        raise InputError(f"f_scale is {quoted(value)}; expected a positive number from {least:g} to {largest:g}")
    return scale


def _checked_residuals(value: Any) -> Array:
    residuals = from_numbers(value, "residuals")
    if not hasattr(residuals, "dtype") or 0 in shape_of(residuals):
        raise InputError(f"residuals {described(residuals)}; expected an array of floats, of at least one")
    check_floating("residuals", residuals)
    return residuals


SQUARE = Loss()
