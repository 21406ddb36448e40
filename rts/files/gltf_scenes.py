"""Nodes and scenes of GLB and glTF files: where meshes are. Nodes form a forest, and transforms of meshes are sound."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.files.damaged_files import Fail, warn
from rts.files.gltf_tree import LIGHTS, TOLD, Gltf, count_of
from rts.files.model_pieces import fault_of
from rts.scene.clips import node_matrix

_WIDTHS = {"matrix": 16, "translation": 3, "rotation": 4, "scale": 3}


def read_instances(gltf: Gltf) -> list[tuple[int, np.ndarray, int]]:
    """The meshes of the scene that is shown: index, transform (4, 4) scene-from-local, and node, one for each node."""
    nodes = gltf.tree.get("nodes", [])
    return [(nodes[index]["mesh"], place, index) for index, place in read_places(gltf) if "mesh" in nodes[index]]


def read_places(gltf: Gltf) -> list[tuple[int, np.ndarray]]:
    """The nodes of the scene that is shown: index, and transform (4, 4) scene-from-local.

    Refuses nodes that form no forest or have an unsound transform, and scenes of nodes that are no roots; warns of
    instances, which are not read.
    """
    path, fail, tree = gltf.path, gltf.fail, gltf.tree
    nodes, meshes, scenes = tree.get("nodes", []), tree.get("meshes", []), tree.get("scenes", [])
    parents = parents_of(nodes, fail)
    moves = [move_of(f"node {index}", node, fail) for index, node in enumerate(nodes)]
    shown = set()
    for index, node in enumerate(nodes):
        if "mesh" in node and count_of(node["mesh"]) >= len(meshes):
            raise fail(f"node {index} is of mesh {node['mesh']}, and there are {len(meshes)}")
        above = index if "mesh" in node else None
        while above is not None and above not in shown:
            shown.add(above)
            above = parents.get(above)
    for index in sorted(shown):
        if fault := fault_of(moves[index]):
            raise fail(f"the transform of node {index} {fault}")
    repeated = [index for index, node in enumerate(nodes) if TOLD in node.get("extensions", {})]
    if repeated:
        warn(f"{path}: node {repeated[0]} stands for several instances, which are not read; it is loaded once")
    if "scene" in tree and count_of(tree["scene"]) >= len(scenes):
        raise fail(f"its scene is number {tree['scene']}, and there are {len(scenes)}")
    for index, scene in enumerate(scenes):
        roots = [count_of(root) for root in scene.get("nodes", [])]
        wrong = [root for root in roots if root >= len(nodes) or root in parents or roots.count(root) > 1]
        if wrong:
            raise fail(
                f"scene {index} has node {wrong[0]}, which is there twice, is the child of another, or is missing"
            )
    places = []
    ahead = [(root, np.eye(4)) for root in scenes[tree.get("scene", 0)].get("nodes", [])] if scenes else []
    while ahead:
        index, outer = ahead.pop()
        place = outer @ moves[index]
        ahead += [(child, place) for child in nodes[index].get("children", [])]
        places.append((index, place))
    return places


def parents_of(nodes: list[dict[str, Any]], fail: Fail) -> dict[int, int]:
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


def move_of(name: str, node: dict[str, Any], fail: Fail) -> np.ndarray:
    """The transform (4, 4) of a node in its parent. Its numbers are checked."""
    entries = {key: node[key] for key in _WIDTHS if key in node}
    for key, values in entries.items():
        numbers = isinstance(values, list) and all(isinstance(x, (int, float)) and x is not True for x in values)
        if not numbers or len(values) != _WIDTHS[key]:
            raise fail(f"{key} of {name} is {str(values)[:80]}; expected {_WIDTHS[key]} numbers")
    if "matrix" in entries and len(entries) > 1:
        raise fail(
            f"{name} has both matrix and {', '.join(key for key in entries if key != 'matrix')}; expected one of them"
        )
    if "matrix" in entries:
        return np.array(entries["matrix"], np.float64).reshape(4, 4).T
    translation, rotation, scale = places_of(node)
    if not abs(np.linalg.norm(rotation) - 1) <= 0.01:
        raise fail(f"rotation of {name} is {entries['rotation']}; expected a quaternion of length 1")
    return node_matrix(translation, rotation, scale)


def places_of(node: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The translation (3,), rotation (4,), a quaternion x, y, z, w, and scale (3,) of a node of checked numbers."""
    defaults = {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]}
    translation, rotation, scale = (np.array(node.get(key, x), np.float64) for key, x in defaults.items())
    return translation, rotation, scale


def motion_in(gltf: Gltf) -> list[str]:
    """The kinds of what moves in a file: "skins", "morph targets" and "clips"."""
    tree = gltf.tree
    nodes, meshes = tree.get("nodes", []), tree.get("meshes", [])
    primitives = [primitive for mesh in meshes for primitive in mesh["primitives"]]
    there = {
        "skins": any("skin" in node for node in nodes),
        "morph targets": any(x.get("targets") for x in primitives) or any(x.get("weights") for x in (*nodes, *meshes)),
        "clips": bool(tree.get("animations")),
    }
    return [name for name, is_there in there.items() if is_there]


def surroundings_in(gltf: Gltf) -> list[str]:
    """The kinds of what else nodes of the scene that is shown have: "lights" and "cameras"."""
    nodes = [gltf.tree["nodes"][index] for index, _ in read_places(gltf)]
    there = {
        "lights": any(LIGHTS in node.get("extensions", {}) for node in nodes),
        "cameras": any("camera" in node for node in nodes),
    }
    return [name for name, is_there in there.items() if is_there]


def warn_of_left_out(gltf: Gltf, kinds: list[str]) -> None:
    """Warn of kinds of things that are in the file and not read, if there are any."""
    if kinds:
        what = " and ".join(filter(None, (", ".join(kinds[:-1]), kinds[-1])))
        warn(f"{gltf.path} has {what}, which are left out; rts.load_model reads them")
