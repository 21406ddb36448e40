"""Entries of θ that nobody reads, such as a misspelt one: what an image lacks is not seen in it."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from rts.errors import InputWarning, warn
from rts.parts import CheckedPart

SURFACE_ENTRIES = ("vertices", "points", "normals", "colors", "uv")
SHADER_ENTRIES = ("color", "texture", "light", "specular", "shininess", "depth_range", "weights")
"""Names that built-in surfaces and shaders give a meaning: files bring them, and not every shader reads them."""

ALIKE = 0.8
"""The least ratio of `difflib` of two names that one may be meant by the other: "lights" and "light" have 0.9."""


def unread(part: CheckedPart) -> tuple[str, ...]:
    """The entries of θ that neither surface nor shader reads; none where the shader does not say what it reads."""
    shaded = part.shader.reads_theta
    if shaded is None:
        return ()
    shaped = part.surface.reads(part.theta)
    return tuple(name for name in part.theta if name not in shaped and name not in shaded)


def likely_name(part: CheckedPart, name: str) -> str | None:
    """The name that was likely to be meant by that of an entry that is not read, or None."""
    rest = dict(part.theta)
    value = rest.pop(name)
    shaped = (n for n in SURFACE_ENTRIES if n in part.surface.reads({**rest, n: value}))
    # Who gives both means two things.
    known = {*(part.shader.reads_theta or ()), *shaped} - rest.keys()
    return next(iter(difflib.get_close_matches(name.lower(), sorted(known), n=1, cutoff=ALIKE)), None)


def warn_of_unread(parts: Sequence[CheckedPart]) -> None:
    """Warn of entries of θ that are not read, and whose names are almost those of others that would be."""
    for index, part in enumerate(parts):
        for name in unread(part):
            if name in SURFACE_ENTRIES or name in SHADER_ENTRIES:
                continue
            meant = likely_name(part, name)
            if meant is not None:
                warn(
                    f"theta[{name!r}] of part {index} is not read; did you mean {meant!r}? rts.explain lists all such "
                    f"entries",
                    InputWarning,
                )
