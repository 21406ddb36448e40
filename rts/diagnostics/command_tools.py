"""Names for programs that measure scenes, such as `rts compare`: scenes checked, default cameras, files written."""

from rts.arrays.engines import engine_named
from rts.contracts.checks import check_scene
from rts.files.paths import output_folder, writing
from rts.scene.default_camera import default_camera

__all__ = ["check_scene", "default_camera", "engine_named", "output_folder", "writing"]
