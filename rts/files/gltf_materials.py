"""Materials of GLB and glTF files."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from rts.files.damaged_files import warn
from rts.files.gltf_textures import Lookup, Maps
from rts.files.gltf_tree import Gltf
from rts.files.srgb import decode_srgb

UNLIT = "KHR_materials_unlit"
STATED = ("metallicFactor", "roughnessFactor", "metallicRoughnessTexture")
"""Entries of `pbrMetallicRoughness` beside the base colour."""
LARGEST = 1e6
"""The largest factor."""
OLDER = "KHR_materials_pbrSpecularGlossiness"
"""An older kind of material; of what it is made of, the diffuse colour is read."""
SPECULAR = "KHR_materials_specular"
"""The strength and the colour of what anything but metals reflects."""


class GltfMaterial(NamedTuple):
    """The part of a material that shaders use.

    Attributes:
        color: (4,) the factor of the base colour, linear; or None.
        texture: (h, w, 3 or 4) of the base colour, as `rts.files.images.pixels` gives it; or None.
        alpha_mode: "OPAQUE", "MASK" or "BLEND".
        cutoff: the least alpha that is shown, of "MASK".
        entries: entries of θ for the shader `pbr`, linear: "metallic", "roughness", "normal_map", "occlusion",
            "emissive" and "specular", numbers or maps; None where the material tells nothing but its base colour.
        lookup: the way in which the texture is looked up, and most maps.
        lookups: entry of θ → the way in which its map is looked up, where it is another one.
        unlit: True if it has no light.
        double_sided: False if it is not seen from behind.
    """

    color: np.ndarray | None = None
    texture: np.ndarray | None = None
    alpha_mode: str = "OPAQUE"
    cutoff: float = 0.5
    entries: dict[str, np.ndarray] | None = None
    lookup: Lookup = Lookup()
    lookups: Mapping[str, Lookup] = MappingProxyType({})
    unlit: bool = False
    double_sided: bool = False

    def shown(
        self, rows: np.ndarray | None, mapped: bool
    ) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
        """Vertex colours (A, 3 or 4), the texture and the factor, with the alpha that the mode gives them.

        It is none where the mode is OPAQUE. Where the mode is MASK, the product of alpha is 1 from the cutoff on, and 0
        below; colours have no alpha there beside a texture that is `mapped`. Arrays of three components have no alpha,
        and stay as they are, as None does.
        """
        values = [rows, self.texture, self.color]
        if self.alpha_mode == "BLEND":
            return rows, self.texture, self.color
        plain = [None if x is None else x[..., :3] for x in values]
        if self.alpha_mode == "MASK":
            at = 1 if mapped and self.texture is not None else 0
            shown, alpha = values[at], 1.0 if self.color is None else float(self.color[3])
            if shown is not None and shown.shape[-1] == 4:
                opaque = (shown[..., 3:] * alpha).astype(np.float32) >= np.float32(self.cutoff)
                plain[at] = np.concatenate([shown[..., :3], opaque], axis=-1, dtype=shown.dtype)
            elif self.color is not None:
                plain[2] = np.append(self.color[:3], float(alpha >= self.cutoff))
        return plain[0], plain[1], plain[2]


def read_material(gltf: Gltf, index: int, material: dict[str, Any]) -> GltfMaterial:
    """A material; refused if a colour or texture is invalid. Notes what is not followed."""
    name, maps = f"material {index}", Maps(gltf)
    look = dict(material.get("pbrMetallicRoughness", {}))
    older = material.get("extensions", {}).get(OLDER, {})
    for ours, theirs in (("baseColorFactor", "diffuseFactor"), ("baseColorTexture", "diffuseTexture")):
        if theirs in older:
            look[ours] = older[theirs]
    factor = np.array(look.get("baseColorFactor", [1.0] * 4), np.float64)
    if factor.shape != (4,):
        raise gltf.fail(f"the baseColorFactor of {name} is {factor.tolist()}; expected four numbers")
    color = unit_colors(gltf, f"baseColorFactor of {name}", factor[None])[0] if "baseColorFactor" in look else None
    texture = maps.read(look, "baseColorTexture", f"the texture of {name}", "texture")
    if older:
        gltf.note(f"{OLDER}, of which the diffuse colour alone is read", name)
    unlit = UNLIT in material.get("extensions", {})
    entries = None if unlit or older else _entries(maps, material, look, name)
    return GltfMaterial(
        color,
        texture,
        alpha_mode=material.get("alphaMode", "OPAQUE"),
        cutoff=float(material.get("alphaCutoff", 0.5)),
        entries=entries,
        lookup=maps.lookup,
        lookups={entry: way for entry, way in maps.lookups.items() if way != maps.lookup},
        unlit=unlit,
        double_sided=bool(material.get("doubleSided", False)),
    )


def _entries(maps: Maps, material: dict[str, Any], look: dict[str, Any], name: str) -> dict[str, np.ndarray] | None:
    """`GltfMaterial.entries`; refused where a factor is no number, or out of its range."""
    gltf = maps.gltf
    keys = {*look} & set(STATED) | {*material} & {"normalTexture", "occlusionTexture", "emissiveTexture"}
    shine = material.get("extensions", {}).get(SPECULAR)
    if not keys and shine is None:
        return None
    surface = maps.read(
        look, "metallicRoughnessTexture", f"the metallicRoughnessTexture of {name}", "metallic", "roughness"
    )
    entries = {}
    for entry, key, channel in (("metallic", "metallicFactor", 2), ("roughness", "roughnessFactor", 1)):
        factor = _number(gltf, look, key, 1.0, name, most=1.0)
        entries[entry] = np.asarray(factor if surface is None else factor * surface[..., channel : channel + 1])
    bumps = maps.read(material, "normalTexture", f"the normalTexture of {name}", "normal_map")
    if bumps is not None:
        scale = _number(gltf, material["normalTexture"], "scale", 1.0, name, least=-LARGEST)
        entries["normal_map"] = (2 * bumps[..., :3] - 1) * [scale, scale, 1.0]
    open_ = maps.read(material, "occlusionTexture", f"the occlusionTexture of {name}", "occlusion")
    if open_ is not None:
        strength = _number(gltf, material["occlusionTexture"], "strength", 1.0, name, most=1.0)
        entries["occlusion"] = 1 + strength * (open_[..., :1] - 1)
    strong = material.get("extensions", {}).get("KHR_materials_emissive_strength", {})
    factor = np.array(material.get("emissiveFactor", [0.0] * 3), np.float64)
    if factor.shape != (3,) or not (np.abs(factor - 0.5) <= 0.5).all():
        raise gltf.fail(f"the emissiveFactor of {name} is {factor.tolist()}; expected three numbers from 0 to 1")
    factor = factor * _number(gltf, strong, "emissiveStrength", 1.0, name)
    if factor.any():
        glow = maps.read(material, "emissiveTexture", f"the emissiveTexture of {name}", "emissive")
        entries["emissive"] = factor if glow is None else factor * decode_srgb(glow[..., :3])
    if shine is not None:
        entries["specular"] = _specular(maps, shine, name)
    return {entry: np.asarray(value, np.float32) for entry, value in entries.items()}


def _specular(maps: Maps, shine: dict[str, Any], name: str) -> np.ndarray:
    """The entry "specular" (3,) or (h, w, 3) of an extension `SPECULAR`: the product of its factors and maps.

    The factor dims grazing reflection, too, by the extension, and not by `pbr`.
    """
    gltf = maps.gltf
    color = np.array(shine.get("specularColorFactor", [1.0] * 3), np.float64)
    if color.shape != (3,) or not ((color >= 0) & (color <= LARGEST)).all():
        raise gltf.fail(f"the specularColorFactor of {name} is {color.tolist()}; expected three numbers from 0 on")
    tint = maps.read(shine, "specularColorTexture", f"the specularColorTexture of {name}", "specular")
    of_tint = maps.lookups.get("specular")
    strength = maps.read(shine, "specularTexture", f"the specularTexture of {name}", "specular")
    product = color * _number(gltf, shine, "specularFactor", 1.0, name, most=1.0)
    product = product if tint is None else product * decode_srgb(tint[..., :3])
    if strength is not None and strength.shape[-1] == 4:  # Without alpha it is 1.
        alpha = strength[..., 3:]
        if tint is not None and (tint.shape[:2] != alpha.shape[:2] or of_tint != maps.lookups["specular"]):
            gltf.note(
                "a specularTexture of another size than the specularColorTexture, or looked up in another way, whose "
                "mean is taken",
                name,
            )
            alpha = alpha.mean()
        product = product * alpha
    if of_tint is not None:
        maps.lookups["specular"] = of_tint
    return product


def _number(
    gltf: Gltf, entry: dict[str, Any], key: str, default: float, name: str, least: float = 0.0, most: float = LARGEST
) -> float:
    """A number of an entry; refused outside of a range."""
    value = entry.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not least <= value <= most:
        raise gltf.fail(f"{key} of {name} is {str(value)[:80]}; expected a number from {least:g} to {most:g}")
    return float(value)


def unit_colors(gltf: Gltf, name: str, colors: np.ndarray) -> np.ndarray:
    """Colours (N, C) clipped to [0, 1], with a warning; refused if NaN or beyond ±255."""
    wrong = ~(np.abs(colors) <= 255).all(axis=1)
    if wrong.any():
        at = int(np.argmax(wrong))
        raise gltf.fail(f"row {at} of {name} is {colors[at].tolist()}; expected colours from 0 to 1")
    if ((colors < 0) | (colors > 1)).any():
        warn(f"{gltf.path}: {name} has colours that are not from 0 to 1, which are clipped")
    return np.clip(colors, 0, 1)
