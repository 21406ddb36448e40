"""Entries of θ that nobody reads, such as misspelt ones; the image alone does not show the mistake."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Sequence

from rts.contracts.checked_parts import CheckedPart
from rts.contracts.gbuffer import FOOTPRINT
from rts.errors import InputWarning, warn
from rts.shading.tangents import TANGENT
from rts.shading.textures import MAPS, own_uv

SURFACE_ENTRIES = ("vertices", "points", "normals", "colors", "uv")
SHADER_ENTRIES = (
    *("color", "texture", "light", "shininess", "depth_range", "weights"),
    *MAPS,
)
"""Names that built-in surfaces and shaders read. They cause no warning: files hold them for any shader."""

OF_MAPS = frozenset(map(own_uv, MAPS))
"""Attributes that are coordinates of single maps."""

ATTRIBUTES = ("position", "normal", "face_normal", "uv", TANGENT, FOOTPRINT, *OF_MAPS)
"""Names that are attributes of the G-buffer only; "color" may be an entry of θ, too."""

ALIKE = 0.8
"""Similarity, by `difflib`, from which one name may be a misspelling of another: 0.9 for "lights" and "light"."""


def shaded_by(part: CheckedPart) -> set[str] | None:
    """The names that a part's shader declares to read and that may be entries of θ; None if it declares nothing."""
    return None if part.reads is None else set(part.reads).difference(ATTRIBUTES)


def unread(part: CheckedPart, shaded: Collection[str] | None) -> tuple[str, ...]:
    """The entries of θ that neither surface nor shader reads.

    Args:
        part: the part.
        shaded: the entries that its shader reads; None if unknown, for which the result is empty.
    """
    if shaded is None:
        return ()
    return tuple([name for name in part.theta if name not in part.read and name not in shaded])


def likely_name(part: CheckedPart, name: str, shaded: Collection[str]) -> str | None:
    """The name that the unread entry `name` of θ was probably meant to have, or None; `shaded` is as in `unread`."""
    rest = dict(part.theta)
    value = rest.pop(name)
    shaped = (n for n in SURFACE_ENTRIES if n in part.surface.reads({**rest, n: value}))
    # A name that θ has already is no candidate: the user means two things.
    candidates = {*shaded, *shaped} - rest.keys()
    return next(iter(difflib.get_close_matches(name.lower(), sorted(candidates), n=1, cutoff=ALIKE)), None)


def warn_of_unread(parts: Sequence[CheckedPart]) -> None:
    """Warn of unread entries of θ whose names almost match one that would be read; built-in names cause no warning."""
    for index, part in enumerate(parts):
        if len(part.read) == len(part.theta):
            continue
        shaded = shaded_by(part)
        for name in unread(part, None if shaded is None else shaded - OF_MAPS):
            if name in SURFACE_ENTRIES or name in SHADER_ENTRIES:
                continue
            if name in OF_MAPS:
                warn(
                    f"theta[{name!r}] of part {index} is not read; the surface must declare it, such as by "
                    f"rts.Mesh(faces, {{{name!r}: None}})",
                    InputWarning,
                )
                continue
            meant = likely_name(part, name, shaded or ())
            if meant is not None:
                warn(
                    f"theta[{name!r}] of part {index} is not read; did you mean {meant!r}? rts.explain lists all such "
                    f"entries",
                    InputWarning,
                )
