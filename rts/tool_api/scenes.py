"""Scenes as renders see them: their extent, cameras that see all of it, checks, and steps from triangles to samples."""

from rts.advice.empty_images import out_of_view
from rts.arrays.argument_checks import check_pixels, is_invertible
from rts.contracts.checked_parts import check_scene
from rts.contracts.result_checks import ATTRIBUTE_WIDTHS
from rts.diagnostics.shader_steps import COLOR_JUMP, STEP_CAUSE, STEP_REMEDY
from rts.rendering.settings import BORDER
from rts.sampling.layer_order import refined
from rts.sampling.packing import pack_fragments
from rts.scene.default_camera import Bounds, bounds_of, default_camera, orbit
from rts.scene.row_cameras import RowCameras
from rts.shading.light import DEFAULT_LIGHT

__all__ = [
    "BORDER",
    "ATTRIBUTE_WIDTHS",
    "COLOR_JUMP",
    "DEFAULT_LIGHT",
    "STEP_CAUSE",
    "STEP_REMEDY",
    "Bounds",
    "RowCameras",
    "bounds_of",
    "check_pixels",
    "check_scene",
    "default_camera",
    "is_invertible",
    "orbit",
    "out_of_view",
    "pack_fragments",
    "refined",
]
