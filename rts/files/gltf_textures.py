"""How the maps of GLB and glTF files are looked up: sets of coordinates, their transforms, and samplers."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rts.files.gltf_tree import Gltf, count_of
from rts.shading.textures import Wrap

TRANSFORM = "KHR_texture_transform"
LARGEST = 1e6
"""The largest number of a transform."""
WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST = 9728
FILTERS = {NEAREST: "nearest", 9729: "linear"}


class Lookup(NamedTuple):
    """The way in which a map is looked up.

    Attributes:
        texcoord: the number of the set of coordinates, the attribute TEXCOORD_0 or a further one.
        matrix: two rows of three numbers, the affine map of these coordinates, whose second points down.
        wrap: as of `rts.shading.sample_texture`.
        filter: likewise.
    """

    texcoord: int = 0
    matrix: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    wrap: Wrap = "repeat"
    filter: str = "linear"

    def uv(self, rows: np.ndarray) -> np.ndarray:
        """Coordinates (A, 2) float64 of rts, whose second points up, for those of the file."""
        matrix = np.array(self.matrix)
        u, v = matrix[:, :2] @ rows.T.astype(np.float64) + matrix[:, 2:]
        return np.stack([u, 1 - v], axis=1)


class Maps:
    """The maps of a material.

    Attributes:
        gltf: the file.
        lookups: entry of θ → the way in which its map is looked up, in the order in which maps were read.
    """

    def __init__(self, gltf: Gltf):
        self.gltf = gltf
        self.lookups: dict[str, Lookup] = {}

    def read(self, entry: dict[str, Any], key: str, name: str, *uses: str) -> np.ndarray | None:
        """The pixels of a map as the file has them; None if the entry has no such key, or the kind is not read.

        `name` is for notes and errors; `uses` are the entries of θ that the map is for.
        """
        if key not in entry:
            return None
        pixels = self.gltf.picture(entry[key]["index"], name)
        if pixels is not None:
            self.lookups |= dict.fromkeys(uses, _lookup(self.gltf, entry[key], name))
        return pixels

    @property
    def lookup(self) -> Lookup:
        """The way of the first map that was read."""
        return next(iter(self.lookups.values()), Lookup())


def _lookup(gltf: Gltf, reference: dict[str, Any], name: str) -> Lookup:
    """The way to look up a map that is referred to; refused if its transform or sampler is invalid."""
    transform = reference.get("extensions", {}).get(TRANSFORM, {})
    texcoord = count_of(transform.get("texCoord", reference.get("texCoord", 0)))
    numbers = [*transform.get("offset", (0, 0)), transform.get("rotation", 0), *transform.get("scale", (1, 1))]
    if len(numbers) != 5 or not all(type(x) in (int, float) and abs(x) <= LARGEST for x in numbers):
        raise gltf.fail(f"{TRANSFORM} of {name} is {str(transform)[:80]}; expected numbers up to {LARGEST:g}")
    x, y, angle, along_u, along_v = numbers
    # The image turns clockwise, and coordinates point right and down.
    cos, sin = math.cos(angle), math.sin(angle)
    matrix = (cos * along_u, sin * along_v, float(x)), (-sin * along_u, cos * along_v, float(y))
    texture = gltf.tree["textures"][reference["index"]]
    sampler = gltf.tree["samplers"][count_of(texture["sampler"])] if "sampler" in texture else {}
    across, down = (_named(gltf, sampler, key, WRAPS, "repeat", name) for key in ("wrapS", "wrapT"))
    smaller = FILTERS.get(sampler.get("minFilter", -1))  # None for averages in mipmaps, which are an option of shaders.
    filter = _named(gltf, sampler, "magFilter", FILTERS, smaller or "linear", name)
    if smaller not in (None, filter):
        gltf.note("maps whose minFilter is another than their magFilter, which is taken for both", name)
    return Lookup(texcoord, matrix, across if across == down else (across, down), filter)


def _named(gltf: Gltf, sampler: dict[str, Any], key: str, names: dict[int, str], default: str, name: str) -> str:
    """The name of a sampler's number; refused if the format has none."""
    if key not in sampler:
        return default
    if sampler[key] not in names:
        raise gltf.fail(f"{key} of the sampler of {name} is {str(sampler[key])[:80]}; expected one of {list(names)}")
    return names[sampler[key]]
