"""Models of formats without a reader here, made GLB by trimesh and read as that."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rts.errors import InputError
from rts.files.damaged_files import unreadable
from rts.files.gltf_reader import read_gltf
from rts.files.model_pieces import Piece

OWN = {"obj", "ply", "stl", "stl_ascii", "glb", "gltf", "off"}
"""Extensions of formats with a reader here."""
POINTS = {"xyz"}
"""Extensions of formats without faces."""


class _Folder:
    """Resolver of file names for trimesh; keeps the first error, which trimesh only logs."""

    def __init__(self, file: Callable[[str], bytes]):
        self.file, self.problem = file, None

    def get(self, name: str) -> bytes:
        try:
            return self.file(name)
        except InputError as problem:
            self.problem = self.problem or problem
            raise

    __getitem__ = get


def read_with_trimesh(path: Path, data: bytes, file: Callable[[str], bytes]) -> list[Piece]:
    """The meshes of a file. Which formats trimesh reads depends on packages that are installed.

    Args:
        path: the path of the file.
        data: its bytes.
        file: name → bytes of a file that it refers to.

    Raises:
        InputError: the format is not known, trimesh fails, or a file is missing.
    """
    import trimesh
    from trimesh.exchange.load import mesh_formats

    extension, others = path.suffix[1:].lower(), sorted(mesh_formats() - OWN - POINTS)
    if extension not in others:
        more = f", or another of trimesh's: {', '.join(others)}" if others else ""
        raise InputError(
            f"{path} has the extension {path.suffix!r}, which is not known; expected obj, ply, stl, glb, "
            f"gltf or off{more}"
        )
    folder: Any = _Folder(file)
    try:
        scene: Any = trimesh.load(io.BytesIO(data), file_type=extension, resolver=folder, force="scene", process=False)
        glb = scene.export(file_type="glb")
    except Exception as error:
        said = " ".join(f"{type(error).__name__}: {error}".split())
        raise folder.problem or unreadable(path, extension.upper(), said) from error
    if folder.problem:
        raise folder.problem
    return [piece._replace(linear=False) for piece in read_gltf(path, glb, file)]
