"""Scenes at other rates of their surfaces: with other tolerances, lattices, numbers of faces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rts import Camera, Part
from rts.plugin_api.arrays import Tree
from rts.plugin_api.records import Rate
from rts_compare.moving_scenes import SceneFunction, parts_of


class SceneAtRate(NamedTuple):
    """A scene some of whose surfaces have another rate (`rts.plugin_api.records.Rate`).

    Attributes:
        at: parameters → (parts, camera).
        work: estimated cost relative to the scene as it is given.
    """

    at: SceneFunction
    work: float


def scenes_at_rates(at: SceneFunction, parts: Sequence[Part]) -> dict[str, SceneAtRate]:
    """Name of a rate, such as "tolerance=0.4" → the scene at this rate; "" → the scene as it is given.

    Surfaces of one class are changed together: in one scene each to the first rate that it offers, in the next to its
    second, and so on.

    Args:
        at: parameters → (parts, camera).
        parts: the parts that `at` gives; arrays of an engine in θ are differentiated, NumPy arrays are not.
    """
    offered: dict[tuple[type, int], dict[int, Rate]] = {}
    for index, part in enumerate(parts):
        surface = part.surface
        for number, rate in enumerate(surface.rates(part.theta)):
            offered.setdefault((type(surface), number), {})[index] = rate
    found = {"": SceneAtRate(at, 1.0)}
    for rates in offered.values():
        work = np.mean([rates[i].work if i in rates else 1.0 for i in range(len(parts))])
        found[" ".join(dict.fromkeys(r.setting for r in rates.values()))] = SceneAtRate(
            _changed(at, rates), float(work)
        )
    return found


def _changed(at: SceneFunction, rates: Mapping[int, Rate]) -> SceneFunction:
    """The scene with the surfaces and θ of `rates`, index of a part → its rate."""

    def changed(parameters: Tree) -> tuple[list[Part], Camera]:
        found = at(parameters)
        parts = parts_of(found)
        for index, rate in rates.items():
            theta = parts[index].theta if rate.theta is None else rate.theta(parts[index].theta)
            parts[index] = parts[index].replace(surface=rate.surface, theta=theta)
        return parts, found[1]

    return changed
