"""Models in the light and the view that their files give them, for pictures of them as they are."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rts.files.damaged_files import contents, gathered, warn_once
from rts.files.gltf_cameras import read_cameras
from rts.files.gltf_lights import read_lights
from rts.files.gltf_reader import read_scene
from rts.files.gltf_scenes import motion_in, warn_of_left_out
from rts.files.gltf_tree import Gltf
from rts.files.model_pieces import check_cull
from rts.files.models import check_exists, load, parts_of
from rts.files.moving_models import EXTENSIONS
from rts.files.paths import beside
from rts.scene.camera import Camera
from rts.scene.parts import Part


class LitModel(NamedTuple):
    """The parts of a file, and its lights and cameras.

    Attributes:
        parts: those of `rts.load`.
        lights: as `rts.results.Model.lights`.
        cameras: as `rts.results.Model.cameras`.
        camera_names: as `rts.results.Model.camera_names`.
    """

    parts: list[Part]
    lights: dict[str, np.ndarray]
    cameras: tuple[Camera, ...]
    camera_names: tuple[str, ...]


def load_lit(
    path: Path, *, surface: str = "mesh", cull: str = "none", lights: bool = True, cameras: bool = True
) -> LitModel:
    """The parts of a file by `rts.load`, and the lights and cameras of a GLB or glTF. Files of other kinds have none.

    Args:
        path: the file.
        surface: as of `rts.load`.
        cull: as of `rts.load`.
        lights: False to leave out lights, without a warning, so that damaged ones do no harm.
        cameras: likewise.

    Raises:
        InputError: as of `rts.load`; or a light or camera is invalid.

    Warns:
        FileWarning: as of `rts.load`, but for lights and cameras.
    """
    if surface != "mesh" or path.suffix.lower() not in EXTENSIONS:
        return LitModel(load(path, surface=surface, cull=cull), {}, (), ())
    check_cull(cull)
    check_exists(path)
    with gathered(path) as notes, np.errstate(over="ignore", invalid="ignore"):  # Checks refuse overflow by name.
        gltf = Gltf(path, contents(path), functools.partial(beside, path))
        parts = parts_of(path, [piece for piece, _, _ in read_scene(gltf)[0]], cull=cull)
        warn_of_left_out(gltf, gltf.part("its tree", motion_in, gltf))
        found = read_cameras(gltf) if cameras else []
        model = LitModel(
            parts, read_lights(gltf) if lights else {}, tuple(c for _, c in found), tuple(name for name, _ in found)
        )
        gltf.warn_of_notes()
    warn_once(path, notes)
    return model
