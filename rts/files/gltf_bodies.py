"""Moving things in GLB and glTF files: nodes, skins, and the joints and morph targets of primitives."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rts.files.damaged_files import warn
from rts.files.gltf_accessors import Accessor, read_table
from rts.files.gltf_scenes import move_of, parents_of, places_of
from rts.files.gltf_tree import Gltf, count_of
from rts.files.model_pieces import LARGEST, fault_of
from rts.scene.model import Node, Skin

SUM_TOLERANCE = 1e-2
"""The most that the weights of a vertex may sum to beside 1 without a warning; bytes are rounded to 1/255."""


class Deformation(NamedTuple):
    """How a primitive is bent, in rows as of its POSITION.

    Attributes:
        joints: (V, I) int, indices of the skin's joints, or None.
        weights: (V, I) float32, which sum to 1, or None.
        displacements: (V, M, 3) float32 of morph targets; M is 0 where there are none.
        normals: (V, M, 3) float32 of morph targets, or None.
    """

    joints: np.ndarray | None
    weights: np.ndarray | None
    displacements: np.ndarray
    normals: np.ndarray | None


def read_nodes(gltf: Gltf) -> list[Node]:
    """All nodes, at rest; refused if they form no forest, or if one has no finite transform.

    The morph weights of a node are its own, else its mesh's, else zeros, one for each target of the mesh.
    """
    nodes, meshes = gltf.tree.get("nodes", []), gltf.tree.get("meshes", [])
    parents = parents_of(nodes, gltf.fail)

    def read_node(index: int, node: dict[str, Any]) -> Node:
        name = f"node {index}"
        transform = move_of(name, node, gltf.fail)
        if not np.abs(transform).max() <= LARGEST or np.abs(transform[3] - [0, 0, 0, 1]).max() > 1e-5:
            raise gltf.fail(f"the transform of {name} is too large, or no affine map")
        weights = None
        if "mesh" in node:
            mesh = meshes[count_of(node["mesh"])]
            targets = {len(primitive.get("targets", ())) for primitive in mesh["primitives"]}
            if len(targets) > 1:
                raise gltf.fail(
                    f"primitives of mesh {node['mesh']} have {sorted(targets)} morph targets; expected one number"
                )
            count = max(targets, default=0)
            weights = np.array(node.get("weights", mesh.get("weights", [0.0] * count)), np.float64)
            if weights.shape != (count,) or not np.isfinite(weights).all():
                raise gltf.fail(f"the morph weights of {name} are {weights.tolist()}; expected {count} numbers")
        parent = parents.get(index, -1)
        return Node(str(node.get("name", "")), parent, transform, *places_of(node), weights if "mesh" in node else None)

    return gltf.each("nodes", read_node)


def read_skins(gltf: Gltf, accessors: list[Accessor], nodes: list[Node]) -> list[Skin]:
    """All skins; refused if a joint is no node, or an inverse bind matrix is missing, damaged or not invertible."""

    def read_skin(index: int, skin: dict[str, Any]) -> Skin:
        name, joints = f"skin {index}", [count_of(joint) for joint in skin["joints"]]
        if not joints or max(joints) >= len(nodes) or len(set(joints)) < len(joints):
            raise gltf.fail(f"{name} has the joints {joints[:20]}; expected different ones of {len(nodes)} nodes")
        inverse = np.tile(np.eye(4), (len(joints), 1, 1))
        if "inverseBindMatrices" in skin:
            of = f"the inverseBindMatrices of {name}"
            rows = read_table(gltf, of, "inverseBindMatrices", skin["inverseBindMatrices"], accessors)
            if len(rows) < len(joints):
                raise gltf.fail(f"{of} are {len(rows)}; expected {len(joints)}, one a joint")
            inverse = rows[: len(joints)].reshape(-1, 4, 4).swapaxes(1, 2).astype(np.float64)
        for i, matrix in enumerate(inverse):
            if fault := fault_of(matrix):
                raise gltf.fail(f"the inverse bind matrix of joint {i} of {name} {fault}")
        return Skin(str(skin.get("name", "")), np.array(joints), inverse)

    return gltf.each("skins", read_skin)


def read_deformation(
    gltf: Gltf, name: str, primitive: dict[str, Any], accessors: list[Accessor], joints: int | None
) -> Deformation | None:
    """How a primitive is bent; None if it is not.

    Warns of weights that do not sum to 1, which are scaled, and of displacements that are not read.

    Args:
        gltf: the file.
        name: of the primitive, for errors.
        primitive: its JSON.
        accessors: all accessors.
        joints: the number of joints of its skin, or None where it has none.
    """
    count = accessors[primitive["attributes"]["POSITION"]].count
    indices, weights = None, None
    if joints is not None and "JOINTS_0" in primitive["attributes"]:
        indices, weights = _read_joints(gltf, name, primitive["attributes"], accessors, joints)
    targets = primitive.get("targets", [])
    tables: dict[str, list[np.ndarray]] = {"POSITION": [], "NORMAL": []}
    for i, target in enumerate(targets):
        for kind in set(target) - {"POSITION", "NORMAL", "TANGENT"}:
            warn(f"{gltf.path}: displacements of {kind} of {name} are left out; positions and normals are read")
        for kind, rows in tables.items():
            of = f"{kind} of morph target {i} of {name}"
            read = read_table(gltf, of, "displacements", target[kind], accessors) if kind in target else None
            rows.append(np.zeros((count, 3), np.float32) if read is None else read)
            if len(rows[-1]) != count:
                raise gltf.fail(f"{of} has {len(rows[-1])} rows, and POSITION {count}")
    if indices is None and not targets:
        return None
    displaced = np.stack(tables["POSITION"], axis=1) if targets else np.zeros((count, 0, 3), np.float32)
    turned = any("NORMAL" in target for target in targets)
    return Deformation(indices, weights, displaced, np.stack(tables["NORMAL"], axis=1) if turned else None)


def _read_joints(
    gltf: Gltf, name: str, attributes: dict[str, Any], accessors: list[Accessor], joints: int
) -> tuple[np.ndarray, np.ndarray]:
    """The joints (V, I) of a primitive's vertices, and their weights, which sum to 1; joints without weight are 0."""
    sets = [kind.partition("_")[2] for kind in attributes if kind.startswith("JOINTS_")]
    tables: dict[str, list[np.ndarray]] = {"JOINTS": [], "WEIGHTS": []}
    for number in sets:
        for kind, what in (("JOINTS", "joints"), ("WEIGHTS", "weights of joints")):
            key = f"{kind}_{number}"
            if key not in attributes:
                raise gltf.fail(f"{name} has JOINTS_{number} without {key}")
            tables[kind].append(read_table(gltf, f"{key} of {name}", what, attributes[key], accessors))
    indices = np.concatenate(tables["JOINTS"], axis=1).astype(np.int64)
    weights = np.concatenate(tables["WEIGHTS"], axis=1).astype(np.float64)
    if (weights < 0).any():
        raise gltf.fail(f"{name} has the weight {weights.min():g} of a joint; expected none below 0")
    indices = np.where(weights > 0, indices, 0)
    if indices.max(initial=0) >= joints:
        row = int(np.argmax(indices.max(axis=1)))
        raise gltf.fail(f"vertex {row} of {name} has joint {indices[row].max()}, and its skin has {joints}, from 0 on")
    total = weights.sum(axis=1, keepdims=True)
    wrong = np.abs(total[:, 0] - 1) > SUM_TOLERANCE
    if wrong.any():
        first = int(np.argmax(wrong))
        warn(
            f"{gltf.path}: {int(wrong.sum())} vertices of {name} have weights that do not sum to 1, the first is "
            f"vertex {first} with {total[first, 0]:g}; they are scaled, and those without any go with the first joint"
        )
    weights[total[:, 0] <= 0, 0] = 1
    weights /= np.where(total > 0, total, 1)
    return indices, weights.astype(np.float32)
