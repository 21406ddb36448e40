"""Checks of nodes and scenes of GLB and glTF files: nodes form a forest, and transforms of meshes are sound."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rts.files.damaged_files import warn
from rts.files.gltf_accessors import count_of
from rts.files.model_pieces import fault_of

_WIDTHS = {"matrix": 16, "translation": 3, "rotation": 4, "scale": 3}


def check_scenes(path: Path, tree: dict[str, Any], fail: Any) -> None:
    """Refuse nodes that form no forest or have an unsound transform, and scenes of nodes that are no roots.

    Skins, instances and morph targets, which are not read, are warned of.
    """
    nodes, meshes = tree.get("nodes", []), tree.get("meshes", [])
    parents = _check_forest(nodes, fail)
    shown = {index for index, node in enumerate(nodes) if "mesh" in node}
    ahead = list(shown)
    while ahead:
        above = {parents[index] for index in ahead if index in parents} - shown
        shown |= above
        ahead = list(above)
    for index, node in enumerate(nodes):
        matrix = _matrix(f"node {index}", node, fail)
        fault = fault_of(matrix) if index in shown else ""
        if fault:
            raise fail(f"the transform of node {index} {fault}")
        if "mesh" in node and count_of(node["mesh"]) >= len(meshes):
            raise fail(f"node {index} is of mesh {node['mesh']}, and there are {len(meshes)}")
    bent = [index for index, node in enumerate(nodes) if "skin" in node]
    if bent:
        warn(f"{path}: node {bent[0]} is bent by a skin, which is not read; it is loaded as it is without")
    repeated = [index for index, node in enumerate(nodes) if "EXT_mesh_gpu_instancing" in node.get("extensions", {})]
    if repeated:
        warn(f"{path}: node {repeated[0]} stands for several instances, which are not read; it is loaded once")
    if any(np.any(mesh.get("weights", [])) for mesh in (*meshes, *nodes)):
        warn(f"{path} has morph targets, which are not read; meshes are loaded as they are without")
    scenes = tree.get("scenes", [])
    if "scene" in tree and count_of(tree["scene"]) >= len(scenes):
        raise fail(f"its scene is number {tree['scene']}, and there are {len(scenes)}")
    for index, scene in enumerate(scenes):
        roots = [count_of(root) for root in scene.get("nodes", [])]
        wrong = [root for root in roots if root >= len(nodes) or root in parents or roots.count(root) > 1]
        if wrong:
            raise fail(
                f"scene {index} has node {wrong[0]}, which is there twice, is the child of another, or is missing"
            )


def _check_forest(nodes: list[dict[str, Any]], fail: Any) -> dict[int, int]:
    """Child → parent, indices of nodes; refused if nodes form no forest, since a walk among them might never end."""
    parents: dict[int, int] = {}
    for index, node in enumerate(nodes):
        for child in map(count_of, node.get("children", [])):
            if child in parents or child >= len(nodes):
                what = (
                    f"is one of node {parents[child]}, too" if child in parents else f"is not one of {len(nodes)} nodes"
                )
                raise fail(f"node {child}, a child of node {index}, {what}")
            parents[child] = index
    reached: set[int] = set()
    ahead = [i for i in range(len(nodes)) if i not in parents]
    while ahead:
        reached.add(ahead[-1])
        ahead += nodes[ahead.pop()].get("children", [])
    if len(reached) < len(nodes):
        raise fail(f"node {min(set(parents) - reached)} is among its own children, or below one that is")
    return parents


def _matrix(name: str, node: dict[str, Any], fail: Any) -> np.ndarray:
    """The transform (4, 4) of a node without its rotation, which changes no volume. Its numbers are checked."""
    entries = {key: node[key] for key in _WIDTHS if key in node}
    for key, values in entries.items():
        numbers = isinstance(values, list) and all(isinstance(x, (int, float)) and x is not True for x in values)
        if not numbers or len(values) != _WIDTHS[key]:
            raise fail(f"{key} of {name} is {str(values)[:80]}; expected {_WIDTHS[key]} numbers")
    if "matrix" in entries and len(entries) > 1:
        raise fail(
            f"{name} has both matrix and {', '.join(key for key in entries if key != 'matrix')}; expected one of them"
        )
    matrix = np.eye(4)
    if "matrix" in entries:
        matrix = np.array(entries["matrix"], np.float64).reshape(4, 4).T
    matrix[:3, 3] += entries.get("translation", 0)
    matrix[:3, :3] *= entries.get("scale", 1)
    length = np.linalg.norm(np.array(entries.get("rotation", [0, 0, 0, 1]), np.float64))
    if not abs(length - 1) <= 0.01:
        raise fail(f"rotation of {name} is {entries['rotation']}; expected a quaternion of length 1")
    return matrix
