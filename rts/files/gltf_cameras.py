"""Cameras of GLB and glTF files."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rts.files.gltf_scenes import read_places
from rts.files.gltf_tree import Gltf, count_of
from rts.files.model_pieces import fault_of
from rts.scene.camera import Camera
from rts.scene.transforms import orthographic, perspective

FAR = 1e13
"""The depth of a far plane that is missing, as a multiple of the near plane's; `Camera` takes it for infinite."""


def read_cameras(gltf: Gltf) -> list[tuple[str, Camera]]:
    """The cameras of the scene that is shown, in the order of its nodes, and the cameras' names.

    The scale of a node does not count. A camera's name is its node's, else its own, else "". A camera without an aspect
    ratio takes that of the rendered size; one without a far plane has none.

    Raises:
        InputError: a camera is invalid, or its node's transform is.
    """
    nodes, kinds = gltf.tree.get("nodes", []), gltf.tree.get("cameras", [])
    places = gltf.part("its scene", read_places, gltf) if kinds else []
    return [
        gltf.part(f"the camera of node {index}", _named_camera, gltf, kinds, index, place)
        for index, place in sorted(places, key=lambda pair: pair[0])
        if "camera" in nodes[index]
    ]


def _named_camera(gltf: Gltf, cameras: list[dict[str, Any]], index: int, place: np.ndarray) -> tuple[str, Camera]:
    """The name and the camera of a node, of index `index` and transform `place` (4, 4)."""
    node = gltf.tree["nodes"][index]
    camera = cameras[count_of(node["camera"])]
    return str(node.get("name") or camera.get("name") or ""), _camera(gltf, camera, index, place)


def _camera(gltf: Gltf, camera: dict[str, Any], index: int, place: np.ndarray) -> Camera:
    """The camera of JSON `camera` of a node, of index `index` and transform `place` (4, 4)."""
    if fault := fault_of(place):
        raise gltf.fail(f"the transform of the camera of node {index} {fault}")
    left, _, right = np.linalg.svd(place[:3, :3])
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3], world_from_camera[:3, 3] = left @ right, place[:3, 3]  # Without scale.
    view = np.linalg.inv(world_from_camera)
    numbers = camera[camera["type"]]
    near = float(numbers["znear"])
    if camera["type"] == "orthographic":
        width, height, far = (float(numbers[key]) for key in ("xmag", "ymag", "zfar"))
        if 0 <= near < far < math.inf and 0 < width < math.inf and 0 < height < math.inf:
            aspect = width / height
            return Camera(view, orthographic(2 * height, aspect, near, far), aspect)
    else:
        fov_y, far = float(numbers["yfov"]), float(numbers.get("zfar", FAR * near))
        ratio = float(numbers.get("aspectRatio", 1.0))
        if 0 < near < far < math.inf and 0 < fov_y < math.pi and 0 < ratio < math.inf:
            aspect = ratio if "aspectRatio" in numbers else "open"
            return Camera(view, perspective(math.degrees(fov_y), ratio, near, far), aspect)
    raise gltf.fail(f"the camera of node {index} makes no image: {str(numbers)[:200]}")
