"""save_views: the cameras of views, written in Blender's format or in COLMAP's."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.argument_checks import check_pixels, check_rotation, quoted
from rts.arrays.engines import value_of
from rts.errors import InputError
from rts.files.paths import as_path, output_file, output_folder, writing
from rts.files.views.lenses import COEFFICIENTS, FISHEYE, MODELS, Lens
from rts.scene.camera import Camera
from rts.scene.view import View

SKEW = 1e-6
"""Largest accepted skew, in focal lengths; neither format has one."""


def save_views(path: Any, views: Any) -> None:
    """Write the cameras of views, such as fitted ones, for `rts.load_views` and for other tools.

    Pictures and masks are not written: they stay where they are. Where the pictures are of a lens that distorts, its
    coefficients are written as well. So files speak of the pictures as they are on disk, at the views' size. Near and
    far planes, and masks' names, are not written. A camera of another `pixel_center` is written as it is, shifted.

    Args:
        path: a name ending in .json, for Blender's format with fl_x, fl_y, cx, cy, w, h in each frame. It names
            pictures relative to its folder, and `rts.load_views` only reads those in the folder or below. Or a folder
            without cameras.bin, for a model of COLMAP as text, without points. It names pictures as the views do.
            Folders that do not exist are made.
        views: views of `rts.load_views`; their `camera` may be of any engine.

    Raises:
        InputError: no views, or two pictures of one name; a camera that is orthographic, skewed, mirrored, scaled or
            traced; a folder with a binary model, which readers prefer; or a path that cannot be or may not be written
            to.
    """
    path = as_path(path)
    is_json = path.suffix.lower() == ".json"
    if not is_json and path.suffix and not path.is_dir():
        raise InputError(f"the path is {quoted(str(path))}; expected a name ending in .json, or a folder")
    path = output_file(path, "file of views", (".json",)) if is_json else output_folder(path)
    if not isinstance(views, (list, tuple)) or not views or not all(isinstance(view, View) for view in views):
        raise InputError(f"views is {quoted(views)}; expected a list of views, as rts.load_views gives it")
    entries = [_entry(f"views[{i}]", view) for i, view in enumerate(views)]
    if is_json:
        folder, files = path.parent, {path.name: _blender(path.parent, entries)}
    else:
        folder, files = path, _colmap(path, entries)
    with writing(path):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")


class _Entry(NamedTuple):
    """A view as files have it.

    `rotation` and `translation` are OpenCV's, world to camera; `camera_to_world` has OpenGL's axes. `lens` is that of
    the picture on disk, in pixels of the view's size.
    """

    view: View
    place: str
    model: str
    lens: Lens
    rotation: np.ndarray
    translation: np.ndarray
    camera_to_world: np.ndarray


def _entry(place: str, posed: View) -> _Entry:
    height, width = check_pixels(posed.size)
    camera: Any = posed.camera
    if not isinstance(camera, Camera) or camera.is_stacked:
        raise InputError(f"{place} has a camera that is {quoted(camera)}; expected an rts.Camera of one view")
    known: list[Any] = [value_of(matrix) for matrix in (camera.view, camera.projection)]
    if any(matrix is None or not np.isfinite(matrix).all() for matrix in known):
        raise InputError(f"{place} has a camera that is traced, NaN or infinite; expected one of finite numbers")
    view, projection = (np.asarray(matrix, np.float64) for matrix in known)
    camera = Camera(view, projection, camera.aspect)
    K, rotation, translation = camera.to_opencv((height, width), pixel_center=0.5)
    if min(K[0, 0], K[1, 1]) <= 0 or abs(K[0, 1]) > SKEW * K[0, 0]:
        raise InputError(f"{place} has a camera that mirrors or skews, K = {K.tolist()}; these formats have none")
    check_rotation(f"the rotation of {place}.camera", rotation)
    lens = replace(posed.lens or Lens(1, 1, 0, 0), fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2])
    model = "FULL_OPENCV" if any((lens.k3, lens.k4, lens.k5, lens.k6)) else "OPENCV"
    model = FISHEYE if lens.fisheye else model if lens.distorts else "PINHOLE"
    return _Entry(posed, place, model, lens, rotation, translation, np.linalg.inv(view))


def _blender(folder: Path, entries: list[_Entry]) -> str:
    """The text of a transforms.json."""
    frames = []
    for entry in entries:
        (height, width), lens = entry.view.size, entry.lens
        frame: dict[str, Any] = {
            "file_path": _relative(folder, entry),
            "transform_matrix": entry.camera_to_world.tolist(),
            **{"w": width, "h": height, "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy},
        }
        if lens.distorts:
            frame |= {"camera_model": entry.model, **{k: getattr(lens, k) for k in COEFFICIENTS if getattr(lens, k)}}
        frames.append(frame)
    tree: dict[str, Any] = {"frames": frames}
    angles = {2 * math.atan(0.5 * frame["w"] / frame["fl_x"]) for frame in frames}
    if len(angles) == 1:  # For readers that know no other statement.
        tree = {"camera_angle_x": angles.pop(), **tree}
    return json.dumps(tree, indent=1)


def _relative(folder: Path, entry: _Entry) -> str:
    """The name of a view's picture, relative to a folder."""
    if entry.view.path is None:
        if not entry.view.name:
            raise InputError(f"{entry.place} names no picture; expected rts.View(camera, image, name='0.png'), say")
        return entry.view.name
    return Path(os.path.relpath(entry.view.path.resolve(), folder.resolve())).as_posix()


def _colmap(folder: Path, entries: list[_Entry]) -> dict[str, str]:
    """The texts of a model of COLMAP, by file."""
    from scipy.spatial.transform import Rotation

    if (folder / "cameras.bin").exists():
        raise InputError(f"the path {folder} has cameras.bin, which readers prefer to text; choose another folder")
    if len({entry.view.name for entry in entries} - {""}) < len(entries):
        raise InputError("views has two of one name, or one without; expected a name for each")
    cameras: dict[str, int] = {}
    images = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of keypoints"]
    for number, entry in enumerate(entries, start=1):
        parameters = " ".join(repr(float(getattr(entry.lens, name))) for name in MODELS[entry.model].split())
        camera = f"{entry.model} {entry.view.size[1]} {entry.view.size[0]} {parameters}"
        x, y, z, w = Rotation.from_matrix(entry.rotation).as_quat()
        pose = " ".join(repr(float(value)) for value in (w, x, y, z, *entry.translation))
        images += [f"{number} {pose} {cameras.setdefault(camera, len(cameras) + 1)} {entry.view.name}", ""]
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS", *(f"{number} {camera}" for camera, number in cameras.items())]
    return {
        "cameras.txt": "\n".join([*lines, ""]),
        "images.txt": "\n".join([*images, ""]),
        "points3D.txt": "# No points\n",
    }
