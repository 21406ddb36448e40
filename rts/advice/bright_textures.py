"""Textures whose colours go to 255, as bytes of pictures do."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

from rts.advice.what_to_look_at import is_new
from rts.arrays.engines import namespace, value_of
from rts.contracts.checked_parts import CheckedPart
from rts.errors import InputWarning, warn

BYTES = 64.0
"""Colours beyond this are taken for bytes. A texture is a share of light, which is at most 1, or somewhat brighter."""

_looked_at: weakref.WeakSet[Any] = weakref.WeakSet()


def warn_of_bright_textures(parts: Sequence[CheckedPart]) -> None:
    """Warn of textures far brighter than white; once for each surface, while they are not traced.

    Entries of θ that shaders do not read are left out. Later textures of a surface are not looked at, since fits change
    them at each step.
    """
    for index, part in enumerate(parts):
        texture = part.theta.get("texture")
        if texture is None or (part.reads is not None and "texture" not in part.reads):
            continue
        if not is_new(part.surface, _looked_at):
            continue
        most = _largest(texture)
        if most is None:
            _looked_at.discard(part.surface)
        elif most > BYTES:
            warn(
                f"theta['texture'] of part {index} goes up to {most:g}; expected linear colours from 0 to 1, where "
                "white is 1: divide a picture from 0 to 255 by 255 and decode its sRGB, as rts.load_image does",
                InputWarning,
            )


def _largest(texture: Any) -> float | None:
    """The largest number of an array; None if it is traced, or is no array that has one."""
    if not getattr(texture, "shape", ()) or 0 in texture.shape:
        return None
    most = value_of(namespace(texture).max(texture))
    return None if most is None else float(most.max())
