"""Names for programs that measure scenes, such as `rts compare`: scenes checked, default cameras, options, files."""

from rts.arrays.engines import engine_named
from rts.contracts.checked_parts import check_scene
from rts.errors import InputError
from rts.files.paths import output_folder, writing
from rts.scene.default_camera import default_camera

__all__ = ["check_scene", "default_camera", "engine_named", "output_folder", "supersample_of", "writing"]


def supersample_of(text: str) -> int:
    """The `supersample` of `rts.render` that is written as a text, such as "4".

    Raises:
        InputError: the text is no number.
    """
    if not text.strip().isdecimal():
        raise InputError(
            f"{text!r} is no supersample; expected a number of samples along each side of a pixel, such as 4. Splatter "
            f"'edges', the default, finds outlines with 1"
        )
    return int(text)
