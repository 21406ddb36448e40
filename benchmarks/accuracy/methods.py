"""The methods compared on the scenes: this library's splatters and other renderers, each a name and two functions.

A method gives the derivative image by forward mode, and the slope of a scalar loss by reverse mode.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from benchmarks.accuracy import scenes
from benchmarks.accuracy.scenes import MOTION
from rts_compare.failures.method_renderers import Own
from rts_compare.other_renderers.installed_renderers import Peer, peers

CASES = ("A", "B", "C")
"""The scenes that peers render too, and that times are taken of."""
CLOSED = {
    "box over card": (0,),
    "card behind box": (0,),
    "turned box": (0,),
    "spheres": (0, 1),
    "spot": (0,),
    "spot turns": (0,),
    "sphere": (0,),
}
"""Scene → its parts that are closed, whose back faces are hidden whether they are culled or not."""


class Method(NamedTuple):
    """A renderer of one scene.

    Attributes:
        name: in tables.
        derivative: seed → derivative image (H, W, 3) a pixel of motion.
        gradient: weights (H, W, 3) → the slope dL/dt of L = Σ weights · image, by reverse mode.
        seeds: how many derivatives differ by their noise.
    """

    name: str
    derivative: Callable[[int], np.ndarray]
    gradient: Callable[[np.ndarray], float]
    seeds: int = 1


def name_of(splatter: str, layers: int, supersample: int = 1) -> str:
    """The name of a method of ours."""
    return f"{splatter}, K = {layers}" + (f", {supersample} × {supersample}" if supersample > 1 else "")


def ours(scene: scenes.Scene, splatter: str, layers: int, supersample: int = 1) -> Method:
    """A splatter of this library."""
    drawn = Own(scene.moving, {"splatter": splatter, "layers": layers, "supersample": supersample})

    def gradient(weights: np.ndarray) -> float:
        return float(drawn.slopes(np.zeros(1), lambda image: weights)[0])

    return Method(name_of(splatter, layers, supersample), lambda seed: drawn.derivative(MOTION), gradient)


def splatters(scene: scenes.Scene) -> list[Method]:
    """All of ours that are scored on a scene."""
    found = [ours(scene, name, 1, s) for name in ("edges", "single") for s in (1, 2)]
    found += [ours(scene, "multi", k, s) for k in scene.layers for s in (1, 2)]
    if scene.name in CASES:
        found += [ours(scene, "none", 1), ours(scene, "edges", 1, 4)]
    return found


def others(scene: scenes.Scene, spp: list[int]) -> tuple[list[Method], list[str]]:
    """DEODR and Mitsuba with each number of samples a pixel, and why they are left out where they are.

    See `rts_compare.other_renderers.installed_renderers`.
    """
    found, left_out = peers(scene.moving, spp)
    return [_method(peer) for peer in found], left_out


def _method(peer: Peer) -> Method:
    spp = peer.settings.get("spp")
    return Method(
        peer.name if spp is None else f"{peer.name}, {spp} spp",
        partial(peer.derivative, MOTION),
        lambda weights: peer.gradient(MOTION, weights)(),
        # Mitsuba's noise has heavy tails, and many samples take long.
        seeds=1 if spp is None else 4 if spp <= 64 else 2,
    )


def turned_over(scene: scenes.Scene) -> scenes.Scene | None:
    """A scene with the closed parts' back faces culled, or drawn if they were culled; None if no part is closed."""
    if scene.name not in CLOSED:
        return None
    rest = list(scene.rest)
    cull = "none" if rest[CLOSED[scene.name][0]].cull == "back" else "back"
    for i in CLOSED[scene.name]:
        rest[i] = rest[i].replace(cull=cull)
    name = scene.name + (" culled" if cull == "back" else " unculled")
    return replace(scene, name=name, rest=tuple(rest), layers=(1, 2) if cull == "back" else (2, 4))
