"""Cameras of GLB and glTF files."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rts.files.gltf_scenes import read_places
from rts.files.gltf_tree import Gltf, count_of
from rts.files.model_pieces import fault_of
from rts.scene.camera import Camera


def read_cameras(gltf: Gltf) -> list[Camera]:
    """The cameras of the scene that is shown, in the order of its nodes, whose scale does not count.

    One without an aspect ratio takes that of the rendered size; one without a far plane has none.

    Raises:
        InputError: a camera is invalid, or its node's transform is.
    """
    nodes, kinds = gltf.tree.get("nodes", []), gltf.tree.get("cameras", [])
    places = gltf.part("its scene", read_places, gltf) if kinds else []
    return [
        gltf.part(f"the camera of node {index}", _camera, gltf, kinds[count_of(nodes[index]["camera"])], index, place)
        for index, place in sorted(places, key=lambda pair: pair[0])
        if "camera" in nodes[index]
    ]


def _camera(gltf: Gltf, camera: dict[str, Any], index: int, place: np.ndarray) -> Camera:
    """The camera of a node, of index `index` and transform `place` (4, 4)."""
    if fault := fault_of(place):
        raise gltf.fail(f"the transform of the camera of node {index} {fault}")
    left, _, right = np.linalg.svd(place[:3, :3])
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3], world_from_camera[:3, 3] = left @ right, place[:3, 3]  # Without scale.
    view = np.linalg.inv(world_from_camera)
    numbers = camera[camera["type"]]
    near, far = float(numbers["znear"]), float(numbers.get("zfar", math.inf))
    if camera["type"] == "orthographic":
        width, height = float(numbers["xmag"]), float(numbers["ymag"])
        sound = 0 <= near < far < math.inf and width != 0 and height != 0
        x, y, depth = 1 / width, 1 / height, [0, 0, -2 / (far - near), -(far + near) / (far - near)]
        last, aspect = [0, 0, 0, 1], abs(width / height)
    else:
        fov_y, aspect = float(numbers["yfov"]), numbers.get("aspectRatio", "open")
        sound = 0 < near < far and 0 < fov_y < math.pi and (aspect == "open" or 0 < aspect < math.inf)
        y = 1 / math.tan(fov_y / 2)
        x = y if aspect == "open" else y / aspect
        share = 0.0 if far == math.inf else near / far
        depth = [0, 0, -(1 + share) / (1 - share), -2 * near / (1 - share)]
        last = [0, 0, -1, 0]
    if not sound:
        raise gltf.fail(f"the camera of node {index} makes no image: {numbers}")
    return Camera(view, np.array([[x, 0, 0, 0], [0, y, 0, 0], depth, last]), aspect)
