"""Step lengths of finite differences: far enough to move something by a pixel."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from rts import Engine, Splatter, namespace
from rts.plugin_api.arrays import Array, Tree, constants
from rts.plugin_api.records import Splats

STEP_PIXELS = 1.0
"""The motion of the fastest point in the image by a step, pixels."""
STEP_COLOR = 0.05
"""The change of the fastest colour by a step, if nothing moves."""
FADING = 0.7
"""The ratio of successive layers' weights: they fall, so that motions of two layers cannot cancel."""


class _Probe(Splatter):
    """A splatter whose image (H, W, 4) holds what samples have, unspread; zeros where a cell is empty.

    Args:
        color: True for the samples' colours; False for their pixel positions, (x, y, x, y).
        deep: True for the sum over layers, each weighted by `FADING` times the one in front; False for the front layer.
    """

    def __init__(self, color: bool, deep: bool):
        self.color, self.deep = color, deep

    def image(self, splats: Splats) -> Array:
        positions, rgba, row = splats.positions, splats.rgba, splats.row
        xp = namespace(positions, rgba, row)
        values = rgba if self.color else xp.concat([positions[:, :2]] * 2, axis=1)
        total = 0.0
        for k in range(row.shape[0] if self.deep else 1):
            index = xp.reshape(xp.where(row[k] >= 0, row[k], 0), (-1,))
            shown = xp.reshape(xp.take(values, index, axis=0), (*row.shape[1:], 4))
            total = total + FADING**k * xp.where((row[k] >= 0)[..., None], shown, 0.0)
        return total


def _of_engine(engine: Engine, image: Callable[[Tree], Array], parameters: Tree) -> Array:
    """The image as an array of the engine."""
    return constants(image(parameters), engine, None)


def pixel_step(
    engine: Engine, image: Callable[..., Array], parameters: Tree, direction: Tree, *, deep: bool = False
) -> float | None:
    """The step along a direction by which the fastest point in the image moves by a pixel.

    Where nothing moves, the step by which the fastest colour changes by 0.05; None where no colour changes.

    Args:
        engine: the engine of the parameters.
        image: parameters and options of `rts.render` → (H, W, 4).
        parameters: the point of the derivative.
        direction: a tree of the parameters' structure; the step is a factor of it.
        deep: True to look at motion and colour in all kept layers, not only in the front one.
    """
    for color, wanted in ((False, STEP_PIXELS), (True, STEP_COLOR)):
        probe = partial(image, splatter=_Probe(color, deep), supersample=1, background=None)
        # An image that does not depend on the parameters may be NumPy.
        probe = partial(_of_engine, engine, probe)
        speed = np.abs(engine.to_numpy(engine.jvp(probe, parameters, direction)[1])).max(initial=0.0)
        if speed > 1e-6:
            return float(wanted / speed)
    return None
