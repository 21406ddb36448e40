"""Reading GLB and glTF."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rts.files.damaged_files import warn
from rts.files.gltf_accessors import Accessor, read_accessor, read_attributes
from rts.files.gltf_materials import GltfMaterial, read_material, unit_colors
from rts.files.gltf_scenes import motion_in, read_instances, surroundings_in, warn_of_left_out
from rts.files.gltf_tree import Gltf, count_of
from rts.files.model_pieces import Piece
from rts.shading.textures import own_uv

MODES = {0: "points", 1: "lines", 2: "lines", 3: "lines"}


def read_gltf(path: Path, data: bytes, file: Callable[[str], bytes]) -> list[Piece]:
    """A piece for each primitive of each node of the scene that is shown; points and lines are pieces without faces.

    Args:
        path: the path of the file.
        data: its bytes.
        file: name → bytes of a file that it refers to.

    Raises:
        InputError: it is shorter than it promises; a part is missing, unsound or needs what is not read; accessors
            reach beyond the data; or colours are not finite or far off.
    """
    gltf = Gltf(path, data, file)
    pieces = [piece for piece, _, _ in read_scene(gltf)[0]]
    warn_of_left_out(gltf, gltf.part("its tree", motion_in, gltf) + gltf.part("its scene", surroundings_in, gltf))
    return pieces


def read_scene(gltf: Gltf) -> tuple[list[tuple[Piece, dict[str, Any], int]], list[Accessor]]:
    """The pieces of the scene that is shown, each with the JSON of its primitive and its node; and all accessors."""
    accessors = gltf.each("accessors", lambda index, _: read_accessor(gltf, index))
    materials = gltf.each("materials", lambda index, material: read_material(gltf, index, material))

    def read_mesh(index: int, mesh: dict[str, Any]) -> list[tuple[Piece, dict[str, Any]]]:
        return [(_piece(gltf, f"mesh {index}", p, accessors, materials), p) for p in mesh["primitives"]]

    meshes = gltf.each("meshes", read_mesh)
    instances = gltf.part("its scene", read_instances, gltf)
    gltf.part("its tree", gltf.check_names)
    gltf.warn_of_notes()
    pieces = [
        (piece._replace(transform=None if np.array_equal(place, np.eye(4)) else place), primitive, node)
        for mesh, place, node in instances
        for piece, primitive in meshes[mesh]
    ]
    return pieces, accessors


def _piece(
    gltf: Gltf, name: str, primitive: dict[str, Any], accessors: list[Accessor], materials: list[GltfMaterial]
) -> Piece:
    """A primitive, in local space; refused if of an unfit mode, material or attribute. `name` is for errors."""
    mode = count_of(primitive.get("mode", 4))
    if mode > 6:
        raise gltf.fail(f"{name} has mode {mode}; expected triangles (4), a strip (5) or a fan (6)")
    if mode in MODES:
        warn(f"{gltf.path}: {name} is of {MODES[mode]}, which are left out")
    if "material" in primitive and count_of(primitive["material"]) >= len(materials):
        raise gltf.fail(f"{name} has material {primitive['material']}, which is not there")
    material = materials[primitive["material"]] if "material" in primitive else GltfMaterial()
    read, corners = read_attributes(gltf, name, primitive, accessors)
    faces = corners[:0] if mode in MODES else corners
    if mode == 5:
        faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        faces[1::2] = faces[1::2, ::-1]  # Every other triangle of a strip is turned over.
    elif mode == 6:
        faces = np.stack([np.broadcast_to(corners[:1], corners[2:].shape), corners[1:-1], corners[2:]], axis=1)
    faces = faces.reshape(-1, 3)
    attributes = {}
    if "NORMAL" in read:
        attributes["normals"] = read["NORMAL"].numbers(), faces
    lookup, entries = material.lookup, material.entries
    options: dict[str, Any] = {"wrap": lookup.wrap, "filter": lookup.filter}
    if (uv := f"TEXCOORD_{lookup.texcoord}") in read:
        attributes["uv"] = lookup.uv(read[uv].numbers()), faces
    for entry, own in material.lookups.items():
        if own[:2] != lookup[:2] and (uv := f"TEXCOORD_{own.texcoord}") in read:
            attributes[own_uv(entry)] = own.uv(read[uv].numbers()), faces
    if entries is not None and (lost := [entry for entry in entries if not _placed(material, entry, read)]):
        gltf.note("maps without their coordinates, whose mean is taken", f"the {', '.join(lost)} of {name}")
        means = {entry: entries[entry].mean(axis=(0, 1)) for entry in lost if entry != "normal_map"}
        entries = {entry: x for entry, x in entries.items() if entry not in lost} | means
    if material.texture is not None and "uv" not in attributes:
        gltf.note("textures without coordinates, which are left out", f"that of {name}")
    if other := [(entry, own.wrap, own.filter) for entry, own in material.lookups.items() if own[2:] != lookup[2:]]:
        options["samplers"] = tuple(other)
    if "TANGENT" in read and entries is not None and "normal_map" in entries:
        attributes["tangents"] = read["TANGENT"].numbers(), faces
    colors = None
    if "COLOR_0" in read:
        colors = unit_colors(gltf, f"COLOR_0 of {name}", read["COLOR_0"].numbers(fractions=True))
    colors, texture, color = material.shown(colors, "uv" in attributes)
    if colors is not None:
        attributes["colors"] = colors, faces
    vertices = read["POSITION"].numbers().astype(np.float64)
    return Piece(
        vertices,
        faces,
        attributes,
        texture,
        color,
        linear=True,
        entries=entries,
        options=options,
        unlit=material.unlit,
        one_sided=not material.double_sided,
    )


def _placed(material: GltfMaterial, entry: str, read: Mapping[str, Accessor]) -> bool:
    """True unless an entry of the material is a map whose coordinates are not `read`."""
    assert material.entries is not None
    way = material.lookups.get(entry, material.lookup)
    return material.entries[entry].ndim < 3 or f"TEXCOORD_{way.texcoord}" in read
