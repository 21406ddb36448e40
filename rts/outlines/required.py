"""The tasks of samples beside crossings, set by the shaders of scenes and by derivatives in their values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rts.sampling.entries import is_still
from rts.sampling.scene import Scene


class Required(NamedTuple):
    """The tasks of samples beside a crossing. Of one layer two samples tell colours or motions, and four tell both.

    Attributes:
        colors: False if each part has one colour, which any of its samples tells.
        motions: False if nothing moves (`is_still`) and colours are to be told.
        centers: True if samples at centres tell the colours of surfaces that reach these: see `colored_at_centers`.
    """

    colors: bool = True
    motions: bool = True
    centers: bool = False

    @classmethod
    def of(cls, scenes: Sequence[Scene], centers: bool) -> Required:
        """The tasks that the shaders of scenes, and derivatives in their values, set."""
        # Of one colour any two samples tell all, those of motions too.
        uniform = all(part.uniform for scene in scenes for part in scene.parts)
        return cls(not uniform, uniform or not all(map(is_still, scenes)), centers and not uniform)

    def samples(self, layers: int) -> int:
        """The largest number of samples of a crossing, but for a pair."""
        if layers > 1:
            return layers + 3
        return 4 if self.colors and self.motions and not self.centers else 2
