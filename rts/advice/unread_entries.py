"""Entries of θ that nobody reads, such as misspelt ones; the image alone does not show the mistake."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from rts.arrays.trees import Array, Tree
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.gbuffer import GBuffer
from rts.contracts.shader import Shader
from rts.errors import InputWarning, warn
from rts.shading.pbr import MAPS
from rts.shading.tangents import TANGENT
from rts.shading.textures import own_uv
from rts.shading.uv_footprints import FOOTPRINT

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


class Observed(Shader):
    """A wrapper of a shader that records the entries of θ that it reads.

    Attributes:
        read: the names of entries read so far.
    """

    def __init__(self, shader: Shader):
        self._shader, self.channels = shader, shader.channels
        self.read: set[str] = set()

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Any) -> Array:
        """The colours of the wrapped shader."""
        return self._shader(_Noting(theta, self.read), gbuffer, camera)


class _Noting(dict):
    """A dict that adds to `read` every name looked up, present or not; iteration adds all names."""

    def __init__(self, entries: Mapping[str, Any], read: set[str]):
        super().__init__(entries)
        self._read = read

    def __getitem__(self, name: str) -> Any:
        self._read.add(name)
        return super().__getitem__(name)

    def __contains__(self, name: object) -> bool:
        self._read.add(str(name))
        return super().__contains__(name)

    def get(self, name: str, default: Any = None) -> Any:
        return self[name] if name in self else default

    def __iter__(self) -> Iterator[str]:
        self._read.update(super().__iter__())
        return super().__iter__()

    def keys(self) -> Any:
        return dict.fromkeys(self).keys()

    def items(self) -> Any:
        return {name: self[name] for name in self}.items()

    def values(self) -> Any:
        return dict(self.items()).values()
