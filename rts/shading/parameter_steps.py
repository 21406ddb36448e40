"""A surface beside its samples, a step away in each parameter: how position and uv change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array, Tree
from rts.contracts.records import Samples
from rts.contracts.surface import Surface
from rts.errors import InputError


def check_two_parameters(surface: Surface, samples: Samples, attribute: str, reader: str) -> None:
    """Refuse samples of another number of parameters than two; the error names the attribute, and what reads it."""
    count = samples.params.shape[-1]
    if count != 2:
        raise InputError(
            f"{surface!r} has {count} parameters a sample; expected two: without them {attribute!r}, which {reader} "
            f"need, is not known"
        )


def steps_beside(
    surface: Surface, theta: Mapping[str, Tree], samples: Samples, position: Array, uv: Array, name: str = "uv"
) -> list[tuple[Array, Array]]:
    """The changes of position (N, 3), local space, and of uv (N, 2) along both parameters, a step of each.

    The surface is evaluated once for each parameter, `Surface.param_step` away from the sample's.

    Args:
        surface: a surface of two parameters a sample.
        theta: the entries that the surface reads, arrays of the engine of `position`.
        samples: the samples, in arrays of this engine.
        position: (N, 3), of the samples.
        uv: (N, 2), of the samples.
        name: the attribute of the surface that `uv` is.
    """
    params, xp, changes = samples.params, namespace(position), []
    for i in range(2):
        axis = engine_of(params).constant(surface.param_step * np.eye(2)[i : i + 1], params)
        # A step towards the middle stays on the patch.
        beside = surface.evaluate(theta, replace(samples, params=params + xp.where(params < 0.5, axis, -axis)))
        changes.append((beside["position"] - position, beside[name] - uv))
    return changes
