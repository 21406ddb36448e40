"""Softplus log(1 + exp(s x)) / s of rows x (N, C) with sharpness s (C,), compiled."""

import numpy as np

from rts.plugin_api.arrays import namespace
from rts.plugin_api.operations import Operation


def specification(x, sharpness):
    xp = namespace(x, sharpness)
    return xp.logaddexp(sharpness * x, xp.zeros_like(x)) / sharpness


def parts(x, sharpness):
    """The value, and its derivatives in x and in the sharpness."""
    value = np.logaddexp(sharpness * x, 0) / sharpness
    by_x = 0.5 + 0.5 * np.tanh(0.5 * sharpness * x)
    return value, by_x, (x * by_x - value) / sharpness


def forward(operands, out):
    out[...] = parts(*operands)[0]


def push(operands, tangents, out):
    _, by_x, by_s = parts(*operands)
    out[...] = 0
    for derivative, tangent in zip((by_x, by_s), tangents, strict=True):
        if tangent is not None:
            out += derivative * tangent


def pull(operands, gradient, results):
    _, by_x, by_s = parts(*operands)
    if results[0] is not None:
        results[0][...] = by_x * gradient
    if results[1] is not None:
        results[1][...] = (by_s * gradient).sum(axis=0)


SOFTPLUS = Operation(
    "second_plugin.softplus",
    specification,
    ranks=(2, 1),
    shape=lambda x, sharpness: x,
    forward=forward,
    push=push,
    pull=pull,
    differentiable=2,
    packed=(0,),
    packed_result=True,
)
