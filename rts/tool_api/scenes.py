"""Scenes as renders see them: their extent, cameras that see all of it, checks, and steps from triangles to samples."""

from rts.arrays.argument_checks import check_pixels, is_invertible
from rts.contracts.checked_parts import check_scene
from rts.contracts.result_checks import ATTRIBUTE_WIDTHS
from rts.rendering.settings import APRON
from rts.sampling.layer_order import refined
from rts.sampling.packing import pack_fragments
from rts.scene.default_camera import Bounds, bounds_of, default_camera, orbit
from rts.scene.row_cameras import RowCameras
from rts.shading.light import DEFAULT_LIGHT

__all__ = [
    "APRON",
    "ATTRIBUTE_WIDTHS",
    "DEFAULT_LIGHT",
    "Bounds",
    "RowCameras",
    "bounds_of",
    "check_pixels",
    "check_scene",
    "default_camera",
    "is_invertible",
    "orbit",
    "pack_fragments",
    "refined",
]
