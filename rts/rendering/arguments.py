"""Types of the arguments that choose how a scene is rendered, one for each argument."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, Protocol, TypeAlias

from rts.contracts.sampler import Sampler
from rts.contracts.splatter import Splatter
from rts.errors import warn_deprecated


class ArrayLike(Protocol):
    """An array of NumPy, torch, jax or another engine, as type checkers know it without these packages."""

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of elements along each axis."""
        ...

    @property
    def dtype(self) -> Any:
        """The kind of the elements."""
        ...


# Editors offer the names; `str` admits those of other plugins.
SamplerLike: TypeAlias = (
    Literal["auto", "raster", "embree", "opengl", "rays", "reference"] | str | Sampler | type[Sampler]
)
"""A name of a sampler, built in or another plugin's; a sampler; or its class."""

SplatterLike: TypeAlias = Literal["auto", "edges", "multi", "single", "none"] | str | Splatter | type[Splatter]
"""A name of a splatter, built in or another plugin's; a splatter; or its class."""

Layers: TypeAlias = int | Literal["auto"]
"""A number of surface layers at each pixel, or "auto"."""

ColorLike: TypeAlias = ArrayLike | Sequence[float]
"""A colour as an array (C,), or numbers."""

BackgroundLike: TypeAlias = ColorLike | Sequence[Sequence[Sequence[float]]] | None
"""A colour, an image (H, W, C) as an array or nested lists, or None for transparent."""


def Adaptive(samples: int, *_: Any, **__: Any) -> int:  # noqa: N802  # It was a class.
    """The number of samples along each side of a pixel itself; kept for scripts until 0.4.

    More samples were taken only where outlines are; `splatter="edges"` finds outlines without.
    """
    warn_deprecated("rts.Adaptive(n)", "supersample=1, or an integer n for n² samples in every pixel,", until="0.4")
    return samples
