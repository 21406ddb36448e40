"""Lights of GLB and glTF files: the extension KHR_lights_punctual."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rts.files.gltf_scenes import read_places
from rts.files.gltf_tree import LIGHTS, Gltf, count_of
from rts.files.model_pieces import fault_of
from rts.shading.light import CONE

BRIGHTEST = 1e12
"""Brighter lights are mistakes: the sun, seen from here, has 1e5 lux."""

ANGLE = math.pi / 2 + 1e-6
"""The largest angle of a cone, with room for rounding."""


def read_lights(gltf: Gltf) -> dict[str, np.ndarray]:
    """The lights of the scene that is shown, float32, in the form of θ["light"]; empty if there are none.

    "direction" and "color" (L, 3) are of directional lights, "position" and "intensity" (P, 3) of point lights, as far
    as the file has them; so are "axis" (P, 3) and "cone" (P, 2), where there is a spot light. "ambient" () is 0. glTF's
    lux and candela are divided by π: θ["light"] has irradiance / π.

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
    if not np.any(found.get("axis", 0)):
        found = {name: rows for name, rows in found.items() if name not in ("axis", "cone")}
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
            rows = {"position": place[:3, 3], "intensity": color, "axis": np.zeros(3), "cone": CONE}
        case "spot":
            axis = -place[:3, 2] / np.linalg.norm(place[:3, 2])
            rows = {"position": place[:3, 3], "intensity": color, "axis": axis, "cone": _cone(gltf, light, name)}
        case other:
            raise gltf.fail(f"{name} is of type {other!r}; expected directional, point or spot")
    if "range" in light:
        gltf.note("lights of limited range, which is not followed", name)
    for entry, row in rows.items():
        found.setdefault(entry, []).append(row)


def _cone(gltf: Gltf, light: dict[str, Any], name: str) -> tuple[float, float]:
    """The two angles of a spot light; refused unless they rise from 0 to a quarter of a turn."""
    spot = light.get("spot", {})
    inner, outer = spot.get("innerConeAngle", CONE[0]), spot.get("outerConeAngle", CONE[1])
    if any(type(angle) not in (int, float) for angle in (inner, outer)) or not 0 <= inner <= outer <= ANGLE:
        raise gltf.fail(f"{name} has the cone {str([inner, outer])[:80]}; expected two angles, rising, from 0 to π / 2")
    return float(inner), float(outer)
