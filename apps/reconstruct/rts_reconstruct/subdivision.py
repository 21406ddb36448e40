"""A subdivision surface in place of a mesh: fewer parameters, and smooth between them."""

from __future__ import annotations

from typing import Any

import numpy as np

import rts
from rts_reconstruct.model import Model, carried

CUTS, FACES = 2, 6
"""Pieces of each side of a face of the cage in the mesh that is written, and the number of its triangles that makes."""


def limit_of(faces: np.ndarray) -> Any:
    """The limit of Loop subdivision of a cage of triangles (T, 3).

    Raises:
        InputError: the cage has no limit surface.
        PluginError: OpenSubdiv is missing, which is named.
    """
    return rts.plugin("surfaces", "subdivision")(faces, "loop")


def tessellated(cage: Model) -> Model:
    """The mesh of the limit surface of a cage, whose colours are carried over."""
    vertices, faces = limit_of(cage.faces).tessellate({"vertices": cage.vertices}, CUTS)
    return carried(cage, vertices, faces)
