"""Models that move, from GLB and glTF files: parts, nodes, skins, morph targets and clips."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rts import registry
from rts.arrays.argument_checks import quoted
from rts.errors import InputError
from rts.files.damaged_files import contents, gathered, warn_once
from rts.files.gltf_bodies import Deformation, read_deformation, read_nodes, read_skins
from rts.files.gltf_cameras import read_cameras
from rts.files.gltf_clips import read_clips
from rts.files.gltf_lights import read_lights
from rts.files.gltf_reader import read_scene
from rts.files.gltf_tree import Gltf, count_of
from rts.files.model_pieces import Piece, check_cull, check_piece, cull_of
from rts.files.models import check_exists, linear, part_of, used_rows, welded_rows
from rts.files.paths import as_path, beside
from rts.files.windings import Tally
from rts.scene.model import Binding, Model
from rts.scene.parts import Part

EXTENSIONS = (".glb", ".gltf")


def load_model(path: Any, *, weld: bool = True, cull: str = "none") -> Model:
    """A model that moves: the parts of a GLB or glTF, and what `rts.load` leaves out of it.

    `model.pose(clip, time)` is a pose, and `model.posed(pose)` are the parts in it. Parts that joints bend, or that
    have morph targets, are of the surface `rts.Skinned`; others move as a whole, by their transform. In all else the
    parts are those of `rts.load`. Vertices are welded where all that moves them coincides, too.

    Args:
        path: the file. It may refer to files in its own folder only.
        weld: as of `rts.load`.
        cull: as of `rts.load`.

    Raises:
        InputError: as of `rts.load`; the file is of another kind; or a skin, morph target or clip is damaged: joints
            that are not there, matrices that are not invertible, key frames that are not in order.

    Warns:
        FileWarning: as of `rts.load`; or weights of joints do not sum to 1, and are scaled.
    """
    path = as_path(path)
    if not isinstance(weld, (bool, np.bool_)):
        raise InputError(f"weld is {quoted(weld)}; expected True or False")
    check_cull(cull)
    check_exists(path)
    if path.suffix.lower() not in EXTENSIONS:
        raise InputError(f"{path} is no model that moves; expected .glb or .gltf: rts.load reads parts of other files")
    with gathered(path) as notes, np.errstate(over="ignore", invalid="ignore"):  # Checks refuse overflow by name.
        gltf = Gltf(path, contents(path), functools.partial(beside, path))
        scene, accessors = read_scene(gltf)
        nodes = gltf.part("its nodes", read_nodes, gltf)
        skins = read_skins(gltf, accessors, nodes)
        parts, bindings, tally = [], [], Tally()
        for piece, primitive, node in scene:
            if not len(piece.faces):
                continue
            check_piece(path, piece)
            skin = gltf.part(f"node {node}", _skin_of, gltf, node, len(skins))
            name, count = f"the mesh of node {node}", None if skin is None else len(skins[skin].joints)
            deformation = gltf.part(name, read_deformation, gltf, name, primitive, accessors, count)
            is_bent = deformation is not None and deformation.joints is not None
            parts.append(_part(path, linear(piece), deformation, weld, cull_of(piece, cull), tally))
            bindings.append(Binding(node, skin if is_bent else None))
        if not parts:
            raise InputError(f"{path} holds no faces; expected a mesh with triangles")
        tally.warn(path)
        cameras = read_cameras(gltf)
        model = Model(
            tuple(parts),
            tuple(bindings),
            tuple(nodes),
            tuple(skins),
            tuple(read_clips(gltf, accessors, nodes)),
            read_lights(gltf),
            tuple(camera for _, camera in cameras),
            tuple(name for name, _ in cameras),
        )
        gltf.warn_of_notes()
    warn_once(path, notes)
    return replace(model, parts=tuple(model.posed(model.pose())))


def _skin_of(gltf: Gltf, node: int, count: int) -> int | None:
    """The skin of a node, of so many; None if it has none."""
    skin = gltf.tree["nodes"][node].get("skin")
    if skin is not None and count_of(skin) >= count:
        raise gltf.fail(f"node {node} has skin {skin}, and there are {count}")
    return skin


def _part(path: Path, piece: Piece, deformation: Deformation | None, weld: bool, cull: str, tally: Tally) -> Part:
    """The part of a piece, of the surface `skinned` if it is bent, without joint transforms and morph weights."""
    if deformation is None:
        return part_of(path, piece, weld, cull, tally)
    count, targets = deformation.displacements.shape[:2]
    joints = np.zeros((count, 0)) if deformation.joints is None else deformation.joints
    weights = np.zeros((count, 0)) if deformation.weights is None else deformation.weights
    columns = [piece.vertices, joints, weights, deformation.displacements.reshape(count, -1)]
    rows, faces = np.hstack(columns).astype(np.float32), piece.faces  # Numbers of joints are exact in float32.
    if weld:
        rows, faces = used_rows(rows, faces)
        rows, place = welded_rows(rows)
        faces = place[faces]
    vertices, joints, weights, displacements = np.split(rows, np.cumsum([3, joints.shape[1], weights.shape[1]]), axis=1)
    attributes = {name: x for name, x in piece.attributes.items() if name != "tangents"}  # They would not be bent.
    if deformation.normals is not None and "normals" in attributes:
        normals, table = attributes["normals"]
        attributes["normals"] = np.hstack([normals, deformation.normals.reshape(count, -1)]), table

    def surface(faces: np.ndarray, indices: dict[str, Any]) -> Any:
        numbers = None if deformation.joints is None else joints.astype(np.int32)
        return registry.plugin("rts.surfaces", "skinned")(faces, numbers, indices)

    piece = piece._replace(vertices=vertices, faces=faces, attributes=attributes)
    part = part_of(path, piece, False, cull, tally, surface)
    theta = dict(part.theta)
    if deformation.joints is not None:
        theta["joint_weights"] = np.ascontiguousarray(weights)
    if targets:
        theta["morph_vertices"] = _by_target(displacements)
        if "normals" in theta and theta["normals"].shape[1] > 3:
            theta["morph_normals"] = _by_target(theta["normals"][:, 3:])
            theta["normals"] = np.ascontiguousarray(theta["normals"][:, :3])
    return part.replace(theta=theta)


def _by_target(rows: np.ndarray) -> np.ndarray:
    """Displacements (M, V, 3), of rows (V, 3 M)."""
    return np.ascontiguousarray(rows.reshape(len(rows), -1, 3).swapaxes(0, 1))
