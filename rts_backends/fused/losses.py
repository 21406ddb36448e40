"""The losses of `rts.fitting.losses` as compiled functions of one residual."""

from __future__ import annotations

import math

import numpy as np

from rts import Loss
from rts.plugin_api.loops import compiled

LINEAR, SOFT_L1, HUBER, CAUCHY = range(4)
NUMBERS = {"linear": LINEAR, "soft_l1": SOFT_L1, "huber": HUBER, "cauchy": CAUCHY}
"""The losses that are compiled. Normal equations of others are array code."""
FAR, LEAST_SHARE = Loss.FAR, Loss.LEAST_SHARE


def in_numbers(loss: Loss, dtype: np.dtype) -> tuple[int, np.floating]:
    """A loss of `NUMBERS` as loops take it: its number, such as HUBER, and its scale in the residuals' dtype."""
    return NUMBERS[loss.name], np.dtype(dtype).type(loss.f_scale)


@compiled
def cost_and_weight(residual, loss):
    """Cost s² ρ((r / s)²) of a residual r, for a loss ρ of scale s, given `in_numbers`; and the weight ρ' there."""
    place, scale = loss
    one = type(scale)(1)
    if place == LINEAR or residual == 0:
        return residual * residual, one
    if place == HUBER:
        kept = min(max(residual, -scale), scale)
        return kept * (residual + residual - kept), kept / residual
    ratio = residual / scale
    z, far = ratio * ratio, abs(ratio) > type(scale)(FAR)
    if place == SOFT_L1:
        root = abs(ratio) if far else math.sqrt(one + z)
        return (residual + residual) * (scale * (ratio / (one + root))), one / root
    if place == CAUCHY:
        log = math.log(abs(ratio)) if far else math.log1p(z)
        return scale * (scale * (log + log if far else log)), one / (one + z)
    raise ValueError("a loss of this number is not compiled")


@compiled
def curvature(weight, loss):
    """The weight of a residual in the Hessian, the second result of `Loss.weights`, from its weight ρ'."""
    place, scale = loss
    one = type(scale)(1)
    if place == LINEAR:
        share = one
    elif place == SOFT_L1:
        share = weight * weight
    elif place == HUBER:
        share = type(scale)(0) if weight < one else one
    elif place == CAUCHY:
        share = weight + weight - one
    else:
        raise ValueError("a loss of this number is not compiled")
    return weight * max(share, type(scale)(LEAST_SHARE))
