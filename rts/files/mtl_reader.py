"""Reading MTL, the materials of Wavefront OBJ files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from rts.errors import InputError
from rts.files.bump_maps import holds_normals, normals_of_heights
from rts.files.damaged_files import contents, lines_of, warn
from rts.files.images import read_image
from rts.files.paths import inside
from rts.files.srgb import decode_srgb

# Options of a map statement, such as "-s 2 2 1 -clamp on"; the rest is the file's name, spaces and all.
_VALUE = r"(?:on|off|[rgbmlz]|sphere|cube_\w+|[-+]?[\d.][-+.\deE]*)"
# What follows these options is a value, whatever it is, unless that leaves no name.
_WORDS = "bm|colorspace|imfchan|texres|type"
_MAP_OPTIONS = re.compile(
    rf"^(?:(?:-(?:{_WORDS})\s+(?!-[a-z])\S+\s+(?=\S)|-[a-z]+\s+)(?:{_VALUE}\s+)*)+", re.IGNORECASE
)
_OPTION = re.compile(r"(-[a-z]+)\s+((?:[^-\s]\S*\s+|-[\d.]\S*\s+)*)", re.IGNORECASE)
_USUAL = {"-s": {1.0}, "-o": {0.0}, "-t": {0.0}, "-bm": {1.0}, "-mm": {0.0, 1.0}}
"""Options of numbers → those that change nothing."""
_SWITCHES = {"-blendu": "on", "-blendv": "on", "-cc": "off", "-clamp": "off"}
_COLORS = ("map_kd", "map_ke", "map_ks")
"""Maps of colours, which are sRGB; numbers of others are linear."""
_MESHLAB = re.compile(r"\s*#.*(?:meshlab|vcglib)", re.IGNORECASE)
"""A comment by which MeshLab signs; its Tr is 1 for opaque materials."""
_MAPS = ("map_", "bump", "disp", "decal", "refl", "norm")
NUMBERS = {"pm": "metallic", "pr": "roughness", "ke": "emissive"}
"""Statements of numbers that the shader `pbr` reads → entries of θ."""
MAPS = {
    "map_pm": "metallic",
    "map_pr": "roughness",
    "map_ke": "emissive",
    "norm": "normal_map",
    "map_bump": "bump",
    "map_ks": "specular",
}
"""Statements of maps that it reads, or, of "bump", of which its normal map is made; map_Ks only beside another one."""
BLENDER = 2.0
"""Times 4 % that a white map_Ks reflects: Blender takes it for a level, which is 4 % in the middle."""
STEEPEST = 1e6
"""The largest multiplier of heights."""


class MtlMaterial(NamedTuple):
    """The part of an MTL material that shaders use.

    Attributes:
        color: (3,) Kd, sRGB, or (4,) with alpha where d or Tr make it translucent. Without a Kd, or with a texture, it
            is white with alpha, or None where opaque. Without d, alpha is 1 − Tr, unless Tr is at least 1 or MeshLab
            wrote the file: then Tr is taken for d.
        texture: file of map_Kd, or None. It replaces Kd.
        numbers: "metallic" () of Pm and "roughness" () of Pr, both in [0, 1], and "emissive" (3,) of Ke, sRGB and not
            black, as far as the material has them.
        maps: files of "metallic", "roughness", "emissive", "specular", and "normal_map" or else "bump". They replace
            numbers.
        multiplier: the option -bm of "bump", by which its slopes are multiplied.
        unread: statements of other maps.
        options: options of maps that are read, which are not followed: "-s of map_kd", for instance.
        missing: statements of maps whose files are not there, and the names of these. All else is as without them.
    """

    color: np.ndarray | None = None
    texture: Path | None = None
    numbers: Mapping[str, np.ndarray] = MappingProxyType({})
    maps: Mapping[str, Path] = MappingProxyType({})
    multiplier: float = 1.0
    unread: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()

    def entries(self) -> tuple[dict[str, np.ndarray] | None, bool]:
        """Entries of θ for the shader `pbr`, linear, None if the material has none.

        With it, True where map_Bump has the colours of a normal map, and is taken for one.

        Raises:
            InputError: a map cannot be read.
        """
        entries = {name: decode_srgb(x) if name == "emissive" else x for name, x in self.numbers.items()}
        mistaken = False
        for name, file in self.maps.items():
            pixels = read_image(file)[..., :3]
            match name:
                case "emissive":
                    entries[name] = decode_srgb(pixels)
                case "normal_map":
                    entries[name] = 2 * pixels - 1
                case "specular":
                    entries[name] = BLENDER * pixels
                case "bump" if holds_normals(pixels):
                    scale = np.array([self.multiplier, self.multiplier, 1], np.float32)  # As the scale of a glTF.
                    entries["normal_map"], mistaken = (2 * pixels - 1) * scale, True
                case "bump":
                    entries["normal_map"] = normals_of_heights(pixels, self.multiplier)
                case _:
                    entries[name] = np.ascontiguousarray(pixels[..., :1])
        return entries or None, mistaken


def read_mtl(library: Path, folder: Path) -> dict[str, MtlMaterial]:
    """The materials of a library by name. Textures are looked for in the folder.

    Raises:
        InputError: the library cannot be read, a number is not finite, or it refers to a file outside the folder.
    """
    materials: dict[str, dict[str, Any]] = {}
    current: dict[str, Any] = {}
    lines = lines_of(contents(library))
    of_meshlab = any(_MESHLAB.match(line) for line in lines)
    for number, line in enumerate(lines, start=1):
        key, _, rest = line.replace("\t", " ").strip().partition(" ")
        key, rest = {"bump": "map_bump"}.get(key.lower(), key.lower()), rest.strip()
        values = _numbers(library, number, rest) if key in ("kd", "d", "tr", *NUMBERS) else []
        if key == "newmtl":
            current = materials.setdefault(rest, {})
        elif key == "kd" and len(values) in (1, 3):
            current["color"] = np.resize(values, 3)
        elif key == "d" and len(values) == 1:
            current["alpha"] = values[0]
        elif key == "tr" and len(values) == 1:
            current.setdefault("alpha", values[0] if of_meshlab or values[0] >= 1 else 1 - values[0])
        elif key.startswith(_MAPS) and rest:
            file = inside(folder, _MAP_OPTIONS.sub("", rest), library)
            if key == "map_bump":
                current["multiplier"] = _multiplier(library, number, rest)
            if key == "map_kd" or key in MAPS:
                current.setdefault("options", {})[key] = _unfollowed(key, rest)
            if key == "map_kd":
                current["texture"] = file
                current.setdefault("files", {})[key] = "texture", file
            elif key in MAPS:
                current.setdefault("maps", {})[MAPS[key]] = file
                current.setdefault("files", {})[key] = MAPS[key], file
            else:
                current.setdefault("unread", {})[key] = file
        elif key in NUMBERS and len(values) in ((1, 3) if key == "ke" else (1,)):
            numbers = np.maximum(np.resize(values, 3), 0) if key == "ke" else np.clip(values[0], 0, 1)
            current.setdefault("numbers", {})[NUMBERS[key]] = np.asarray(numbers, np.float32)
    return {name: _material(values) for name, values in materials.items()}


def _unfollowed(key: str, rest: str) -> list[str]:
    """The options of a map statement that are not followed, in small letters, but for those that change nothing."""
    found = []
    for name, words in _options(rest):
        try:
            usual = {float(word) for word in words} <= _USUAL.get(name, set())
        except ValueError:
            space = "srgb" if key in _COLORS else "linear"
            usual = words == [space if name == "-colorspace" else _SWITCHES.get(name)]
        if not usual and (key, name) != ("map_bump", "-bm"):
            found.append(name)
    return found


def _options(rest: str) -> list[tuple[str, list[str]]]:
    """The options of a map statement and their values, in small letters."""
    options = _MAP_OPTIONS.match(rest.lower())
    return [(name, values.split()) for name, values in _OPTION.findall(options.group() if options else "")]


def _multiplier(library: Path, number: int, rest: str) -> float:
    """The number of the option -bm in a map statement; 1 without one, and, with a warning, where it is bad."""
    multiplier = 1.0
    for words in (words for name, words in _options(rest) if name == "-bm"):
        try:
            [multiplier] = map(float, words)
        except ValueError:
            multiplier = np.inf
        if not abs(multiplier) <= STEEPEST:
            multiplier = 1.0
            warn(
                f"{library}, line {number}: -bm is {' '.join(words)[:60]!r} in {rest[:60]!r}, not one number from "
                f"{-STEEPEST:g} to {STEEPEST:g}; it is taken for 1"
            )
    return multiplier


def _numbers(library: Path, number: int, text: str) -> list[float]:
    """The numbers of a line; none where it is of another kind, such as "Kd spectral file.rfl"."""
    try:
        values = [float(x) for x in text.split()]
    except ValueError:
        return []
    if not np.isfinite(values).all():
        raise InputError(f"{library}, line {number}: {text!r} is not finite; expected numbers from 0 to 1")
    return values


def _material(values: dict[str, Any]) -> MtlMaterial:
    values = {**values, "maps": dict(values.get("maps", {})), "options": dict(values.get("options", {}))}
    missing = []
    for key, (kind, file) in values.get("files", {}).items():
        if kind != "specular" and not file.is_file():
            missing.append(f"{file.name!r} ({key})")
            values["options"].pop(key, None)
            (values if kind == "texture" else values["maps"]).pop(kind, None)
    color, alpha = values.get("color"), values.get("alpha", 1.0)
    if "texture" in values:
        color = None if alpha >= 1 else np.ones(3)
    if alpha < 1:
        color = np.append(np.ones(3) if color is None else color, max(alpha, 0.0))
    texture, numbers = values.get("texture"), dict(values.get("numbers", {}))
    if not numbers.get("emissive", np.zeros(3)).any():
        numbers.pop("emissive", None)
    # The map of the ambient colour is mostly that of the diffuse one.
    unread = [key for key, file in values.get("unread", {}).items() if file != texture]
    maps, options = values["maps"], values["options"]
    if {"normal_map", "bump"} <= {*maps}:
        del options["map_bump"]
        if maps.pop("bump") != maps["normal_map"]:
            unread.append("map_bump")
    if {*maps} == {"specular"} and not numbers:
        del maps["specular"], options["map_ks"]
        unread.insert(0, "map_ks")
    if "specular" in maps and not maps["specular"].is_file():
        missing.append(f"{maps.pop('specular').name!r} (map_ks)")
        del options["map_ks"]
    unfollowed = [f"{name} of {key}" for key, names in options.items() for name in names]
    multiplier = values.get("multiplier", 1.0)
    return MtlMaterial(color, texture, numbers, maps, multiplier, tuple(unread), tuple(unfollowed), tuple(missing))
