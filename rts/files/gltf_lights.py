"""Lights of GLB and glTF files: the extension KHR_lights_punctual."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rts.files.gltf_scenes import read_places
from rts.files.gltf_tree import LIGHTS, Gltf, count_of
from rts.files.model_pieces import fault_of

BRIGHTEST = 1e12
"""Brighter lights are mistakes: the sun, seen from here, has 1e5 lux."""


def read_lights(gltf: Gltf) -> dict[str, np.ndarray]:
    """The lights of the scene that is shown, float32, in the form of θ["light"]; empty if there are none.

    "direction" and "color" (L, 3) are of directional lights, "position" and "intensity" (P, 3) of point lights, as far
    as the file has them; "ambient" () is 0. glTF's lux and candela are divided by π: θ["light"] has irradiance / π.
    Spot lights are noted, and left out.

    Raises:
        InputError: a light is invalid, or its node's transform is.
    """
    nodes = gltf.tree.get("nodes", [])
    lights = gltf.part("its lights", lambda: gltf.tree.get("extensions", {}).get(LIGHTS, {}).get("lights", []))
    found: dict[str, list[Any]] = {}
    for index, place in gltf.part("its scene", read_places, gltf):
        if LIGHTS in nodes[index].get("extensions", {}):
            gltf.part(f"the light of node {index}", _add, gltf, lights, index, place, found)
    if not found:
        return {}
    return {name: np.array(rows, np.float32) for name, rows in found.items()} | {"ambient": np.zeros((), np.float32)}


def _add(gltf: Gltf, lights: list[Any], index: int, place: np.ndarray, found: dict[str, list[Any]]) -> None:
    """Add the light of a node, of index `index` and transform `place` (4, 4), to the rows of θ["light"]."""
    name = f"the light of node {index}"
    light = lights[count_of(gltf.tree["nodes"][index]["extensions"][LIGHTS]["light"])]
    color, intensity = np.array(light.get("color", [1.0] * 3), np.float64), light.get("intensity", 1.0)
    if color.shape != (3,) or not ((color >= 0) & (color <= BRIGHTEST)).all():
        raise gltf.fail(f"{name} has color {str(light['color'])[:80]}; expected three numbers, at least 0")
    if type(intensity) not in (int, float) or not 0 <= intensity <= BRIGHTEST:
        raise gltf.fail(f"{name} has intensity {str(intensity)[:80]}; expected a number from 0 to {BRIGHTEST:g}")
    color *= intensity / math.pi
    if fault := fault_of(place):
        raise gltf.fail(f"the transform of {name} {fault}")
    match light["type"]:
        case "directional":  # It shines along −z.
            rows = {"direction": place[:3, 2] / np.linalg.norm(place[:3, 2]), "color": color}
        case "point":
            rows = {"position": place[:3, 3], "intensity": color}
        case "spot":
            gltf.note("spot lights, which are left out", name)
            return
        case other:
            raise gltf.fail(f"{name} is of type {other!r}; expected directional, point or spot")
    if "range" in light:
        gltf.note("lights of limited range, which is not followed", name)
    for entry, row in rows.items():
        found.setdefault(entry, []).append(row)
