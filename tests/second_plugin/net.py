"""Colours of positions by a network of two layers."""

import numpy as np

import rts
from rts.plugin_api.arrays import namespace
from rts.plugin_api.bases import Shader

from .softplus import SOFTPLUS


class Net(Shader):
    opaque, reads = True, ("net",)

    def __call__(self, theta, gbuffer, camera):
        net, position = theta.get("net", {}), gbuffer["position"]
        missing = [name for name in random_net() if name not in net]
        if missing:
            raise rts.InputError(f"shader 'net': θ['net'] lacks {', '.join(missing)}")
        xp = namespace(position, net["weights1"])
        hidden = SOFTPLUS(xp.matmul(position, net["weights1"]) + net["biases1"], net["sharpness"])
        color = 0.5 + 0.5 * xp.tanh(xp.matmul(hidden, net["weights2"]) + net["biases2"])
        return xp.concat([color, xp.ones_like(color[:, :1])], axis=-1)


def random_net(width=8, seed=0):
    rng = np.random.default_rng(seed)
    shapes = {"weights1": (3, width), "biases1": (width,), "weights2": (width, 3), "biases2": (3,)}
    net = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    return {**net, "sharpness": np.full(width, 4, np.float32)}
