"""Light: θ["light"], checked, as the built-in shaders see it.

θ["light"] is a dict. All entries are in world space, and differentiable:

    "direction" (3,) or (L, 3)       towards distant lights, of any length; by default from above the camera's left
                                     shoulder
    "color" (3,) or (L, 3)           of distant lights, by default 0.8: irradiance / π, so that a white diffuse surface
                                     that faces the light has this colour
    "position" (3,) or (P, 3)        of point lights
    "intensity" (3,) or (P, 3)       of point lights, by default 1: the "color" that they have at a distance of 1, and
                                     less with the square of the distance
    "axis" (3,) or (P, 3)            the direction in which a spot light shines, of any length; zero, the default, for a
                                     point light that shines all around
    "cone" (2,) or (P, 2)            beside an axis, by default 0 and π / 4: the angles from the axis up to which they
                                     are as bright as on it, and from which they are dark; radians, by glTF's formula
    "ambient" () or (3,)             light from all around, by default 0.2: its radiance
    "sh" (1, 3), (4, 3), (9, 3)      radiance from each direction, as coefficients of `rts.shading.harmonics`
      or (16, 3)
    "environment" (h, w, 3)          radiance from each direction, as an image; see `rts.shading.prefiltered`
    "shadow" list                    for each distant light, then for each point light, what is seen from it: a result
                                     of `rts.shadows.seen_from`; a list of several, whose shadows are averaged; or None

The defaults hold while θ["light"] has none of "position", "sh" and "environment". A light with one of them has no
distant lights unless it has a "direction" or a "color", and no ambient light unless it has "ambient".
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import dot, shape_of
from rts.arrays.engines import engine_of, namespace, value_of
from rts.arrays.trees import Array, Tree
from rts.errors import InputError
from rts.operations.unit import unit
from rts.scene.camera import Camera
from rts.scene.row_cameras import RowCameras
from rts.shading.environment import blurs, prefiltered, reflected
from rts.shading.spherical_harmonics import COUNTS, irradiance, radiance
from rts.shading.theta_entries import check_entry

DEFAULT_LIGHT = {"ambient": 0.2, "color": 0.8, "direction": (-0.3, 0.5, 0.81)}
"""Light from all around and a distant light, where θ has none; the direction is in camera space."""
CONE = (0.0, math.pi / 4)
WIDEST = math.pi + 1e-6
"""The largest angle of a cone, with room for rounding."""
FURTHER = ("position", "sh", "environment")
"""Entries besides which there are no defaults."""
PLURALS = {"color": "colors", "intensity": "intensities", "axis": "axes", "cone": "cones"}
ENTRIES = (
    *("direction", "color", "position", "intensity", "axis", "cone"),
    *("ambient", "sh", "environment", "shadow"),
)
LEAST_FADE = 1e-3
"""The least difference of the cosines of a cone's two angles, as glTF says."""


@dataclass
class Light:
    """Checked light.

    Attributes:
        distant: for each distant light the unit vector towards it, (3,) or (N, 3), and its colour.
        points: for each point light its position (3,), intensity, axis (3,) and cone (2,); axes are None without any.
        ambient: the radiance from all around, a number, () or (3,); None for none.
        sh: coefficients (n, 3); None for none.
        environment: the result of `prefiltered`; None for none.
        shadows: what is seen from each distant light, then from each point light; empty for no shadows.
    """

    distant: list[tuple[Array, Any]] = field(default_factory=list)
    points: list[tuple[Array, Any, Any, Any]] = field(default_factory=list)
    ambient: Any = None
    sh: Array | None = None
    environment: Mapping[str, Array] | None = None
    shadows: Sequence[Any] = ()

    def lamps(self, positions: Array) -> Iterator[tuple[Array, Any]]:
        """For each distant or point light the unit vectors towards it, (3,) or (N, 3), and irradiances / π at points.

        Where a light has a shadow, its irradiances are less by it.

        Args:
            positions: (N, 3) world.
        """
        if not self.shadows:
            yield from self._unshadowed(positions)
            return
        from rts.shading.visibility import mean_visibility

        for (direction, brightness), shadow in zip(self._unshadowed(positions), self.shadows, strict=True):
            yield direction, brightness if shadow is None else brightness * mean_visibility(shadow, positions)

    def _unshadowed(self, positions: Array) -> Iterator[tuple[Array, Any]]:
        """The result of `lamps` without shadows."""
        yield from self.distant
        for position, intensity, axis, cone in self.points:
            offset = position - positions
            square, toward = dot(offset, offset), unit(offset)
            # A light has no effect on the point where it is.
            brightness = intensity / namespace(square).where(square > 0, square, square + 1)
            yield toward, brightness if axis is None else brightness * _in_cone(toward, axis, cone)

    def diffuse(self, normals: Array) -> Any:
        """The irradiance / π of surfaces with unit normals (N, 3), of all light but lamps: a number, (3,) or (N, 3)."""
        total = 0.0 if self.ambient is None else self.ambient
        if self.sh is not None:
            total = total + irradiance(self.sh, normals)
        if self.environment is not None:
            total = total + irradiance(self.environment["sh"], normals)
        return total

    @property
    def directed(self) -> bool:
        """True if `diffuse` depends on normals."""
        return self.sh is not None or self.environment is not None

    @property
    def surrounds(self) -> bool:
        """True if light comes from all around."""
        return self.ambient is not None or self.directed

    def reflected(self, directions: Array, roughness: Array) -> Any:
        """Radiance from unit directions (N, 3), blurred for roughnesses (N, 1), of all light but lamps."""
        total = 0.0 if self.ambient is None else self.ambient
        if self.sh is not None:
            total = total + radiance(self.sh, directions, blurs(roughness))
        if self.environment is not None:
            total = total + reflected(self.environment, directions, roughness)
        return total


def light_of(theta: Mapping[str, Tree], camera: Camera | RowCameras) -> Light:
    """The light in θ, or the default light.

    Raises:
        InputError: θ["light"] is no dict, has an unknown entry, or an entry of another shape or dtype, that is not
            finite, or that does not go with the others.
    """
    entries = theta.get("light", {})
    if not isinstance(entries, Mapping):
        raise InputError(f"theta['light'] is a {type(entries).__name__}; expected a dict of {', '.join(ENTRIES)}")
    check_light(entries)
    usual = not any(name in entries for name in FURTHER)
    light = Light(ambient=entries.get("ambient", DEFAULT_LIGHT["ambient"] if usual else None), sh=entries.get("sh"))
    if usual or "direction" in entries or "color" in entries:
        if "direction" in entries:
            vectors = value_of(entries["direction"])
            if vectors is not None and not vectors.any(axis=-1).all():
                raise InputError(
                    "theta['light']['direction'] is zero; expected vectors towards the lights, of any length"
                )
            directions = _separate_vectors(unit(entries["direction"]))
        else:
            directions = [camera.to_world(DEFAULT_LIGHT["direction"])]
        light.distant = _paired("direction", directions, "color", entries, DEFAULT_LIGHT["color"])
    if "position" in entries:
        light.points = _points(entries)
    elif given := [name for name in ("intensity", "axis", "cone") if name in entries]:
        raise InputError(f"theta['light'] has {given[0]!r}, but no 'position' of point lights; give both, or a 'color'")
    if "environment" in entries:
        environment = entries["environment"]
        light.environment = environment if isinstance(environment, Mapping) else prefiltered(environment)
    if "shadow" in entries:
        light.shadows, count = entries["shadow"], len(light.distant) + len(light.points)
        if len(light.shadows) != count:
            raise InputError(
                f"theta['light']['shadow'] has {len(light.shadows)} entries, and there are {count} lights; expected "
                f"one for each distant light, then one for each point light: a result of seen_from, or None"
            )
    return light


def check_light(entries: Mapping[str, Any]) -> None:
    """Refuse entries of θ["light"] with a wrong name, shape or dtype, or that are not finite."""
    for name, value in entries.items():
        _check(name, value)


def _check(name: str, value: Any) -> None:
    """Refuse an entry of θ["light"] with a wrong name, shape or dtype, or that is not finite."""
    if name not in ENTRIES:
        raise InputError(f"theta['light'] has an entry {name!r}; expected {', '.join(ENTRIES)}")
    place, shape = f"['light'][{name!r}]", shape_of(value)
    if name == "ambient":
        check_entry(place, value, "() or (3,)", shape in ((), (1,), (3,)))
    elif name == "shadow":
        _check_shadow(value)
    elif name == "sh":
        check_entry(place, value, "(n, 3), n = 1, 4, 9 or 16", len(shape) == 2 and shape in [(n, 3) for n in COUNTS])
    elif name == "environment":
        if isinstance(value, Mapping):
            if set(value) != {"sh", "image", "levels"}:
                raise InputError(f"theta{place} has {sorted(value)}; expected an image, or what prefiltered made of it")
        else:
            check_entry(place, value, "(h, w, 3)", len(shape) == 3 and shape[2] == 3 and 0 not in shape)
    else:
        width = 2 if name == "cone" else 3
        fits = len(shape) in (1, 2) and shape[-1] == width and shape[0] > 0
        check_entry(place, value, f"({width},) or (L, {width})", fits)


def _check_shadow(value: Any) -> None:
    """Refuse shadows that are no list of records, of lists of records, and of None."""
    from rts.shading.visibility import Seen

    shadows = value if isinstance(value, (list, tuple)) else [value]
    for shadow in shadows:
        several = shadow if isinstance(shadow, (list, tuple)) and shadow else [shadow]
        if value is not shadows or not (shadow is None or all(isinstance(one, Seen) for one in several)):
            raise InputError(
                f"theta['light']['shadow'] has {quoted(shadow)}; expected a list with an entry for each light: what "
                f"rts.shadows.seen_from gave, a list of several, or None"
            )


def _points(entries: Mapping[str, Any]) -> list[tuple[Array, Any, Any, Any]]:
    """`Light.points`."""
    positions = _separate_vectors(entries["position"])
    pairs = _paired("position", positions, "intensity", entries, 1.0)
    if "axis" not in entries:
        if "cone" in entries:
            raise InputError("theta['light'] has a cone, but no axis; give both")
        return [(*pair, None, None) for pair in pairs]
    cones = value_of(entries.get("cone", np.array(CONE)))
    if cones is not None:
        inner, outer = cones[..., 0], cones[..., 1]
        if not ((inner >= 0) & (outer >= inner) & (outer <= WIDEST)).all():
            raise InputError(
                f"theta['light']['cone'] is {quoted(cones)}; expected two angles from 0 to π, in radians, the second "
                f"no smaller than the first"
            )
    default = engine_of(entries["position"]).constant(np.array(CONE), entries["position"])
    axes, cones = (_paired("position", positions, name, entries, default) for name in ("axis", "cone"))
    return [(*pair, axis, cone) for pair, (_, axis), (_, cone) in zip(pairs, axes, cones, strict=True)]


def _in_cone(toward: Array, axis: Array, cone: Array) -> Array:
    """The share (N, 1) of a spot light's brightness that points get, from unit vectors (N, 3) towards it."""
    xp = namespace(toward, axis)
    inner, outer = xp.cos(cone[0]), xp.cos(cone[1])
    fade = xp.where(inner - outer > LEAST_FADE, inner - outer, LEAST_FADE)
    share = xp.clip((-dot(toward, unit(axis)) - outer) / fade, 0.0, 1.0)
    return xp.where(xp.any(axis != 0), share * share, xp.ones_like(share))


def _paired(place: str, places: list[Array], name: str, entries: Mapping[str, Any], default: Any) -> list[tuple]:
    """Each place of a light with its entry `name`, of which one may serve all."""
    values = _separate_vectors(entries[name]) if name in entries else [default]
    if len(values) not in (1, len(places)):
        raise InputError(f"theta['light'] has {len(places)} {place}s but {len(values)} {PLURALS[name]}")
    return list(zip(places, values * len(places) if len(values) == 1 else values, strict=True))


def _separate_vectors(vectors: Array) -> list[Array]:
    """The vectors (C,) of an array (C,) or (L, C)."""
    vectors = namespace(vectors).reshape(vectors, (-1, shape_of(vectors)[-1]))
    return [vectors[i, :] for i in range(vectors.shape[0])]
