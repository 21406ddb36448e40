"""The splatters of `rts.splatting`, compiled for the CPU.

Compiled loops take float32 or float64 arrays in the host's memory; the specification takes all others, and gives second
derivatives.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from rts import Loss, SummingSplatter, engine_of
from rts.plugin_api import splats as specified
from rts.plugin_api.arrays import Array
from rts.plugin_api.records import Splats
from rts_backends.fused.cells import Settings
from rts_backends.fused.image import IMAGE


@dataclass(frozen=True)
class _Fused(SummingSplatter):
    """Base of the compiled splatters; each has the settings of its `specification`, a splatter in array code.

    Attributes:
        sigma: see `rts.splatting.Single`.
        epsilon: see `rts.splatting.Single`.
        calibration: see `rts.splatting.Single`.
    """

    kind: ClassVar[str]
    specification: ClassVar[type]
    sigma: float = specified.Single.sigma
    epsilon: float = specified.Single.epsilon
    calibration: float | None = specified.Single.calibration

    def __post_init__(self):
        _ = self.array_code  # It refuses settings that make no sense.

    @functools.cached_property
    def array_code(self) -> Any:
        """The specification with these settings, for arrays that the compiled loops do not take."""
        return self.specification(**{field.name: getattr(self, field.name) for field in fields(self)})

    @functools.cached_property
    def reads(self) -> frozenset[str]:  # pyright: ignore[reportIncompatibleVariableOverride]  # Assigned nowhere.
        """See `rts.Splatter`."""
        return self.array_code.reads

    @functools.cached_property
    def fills_interiors(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]  # Assigned nowhere.
        """See `rts.Splatter`."""
        return self.array_code.fills_interiors

    def image(self, splats: Splats) -> Array:
        """See `rts.Splatter`."""
        if splats.rgba.shape[0] == 0:
            return self.array_code.image(splats)
        return self._of(splats.replace(border=0))

    def cropped(self, splats: Splats) -> Array:
        """See `rts.Splatter`."""
        if not self._own_image or splats.rgba.shape[0] == 0:
            return super().cropped(splats)
        return self._of(splats)

    def _of(self, splats: Splats) -> Array:
        """The image that all cells splat into, those of the border too, with the border cut off."""
        return IMAGE(*self._operands(splats), settings=self._settings_of(splats))

    def _operands(self, splats: Splats) -> tuple[Array, ...]:
        """Operands of `IMAGE`; absent fields of the splats become arrays without rows."""
        part = splats.row[:0, :, :] if splats.part is None else splats.part
        facing = self._facing(splats)
        facing = splats.row[:0, :, :] if facing is None else facing
        none, exits = splats.row[0, :0, :], self._exits(splats)
        exits = splats.row[:0, :, :] if exits is None else exits
        known = *(none if x is None else x for x in (splats.wanted, splats.settled)), exits
        return splats.positions, splats.rgba, splats.row, part, facing, *known

    def _facing(self, splats: Splats) -> Array | None:
        return splats.facing if "facing" in self.reads else None

    def _exits(self, splats: Splats) -> Array | None:
        return splats.exit if "exit" in self.reads else None

    @property
    def _own_image(self) -> bool:
        """True unless a subclass overrides `image`."""
        return type(self).image is _Fused.image

    @property
    def _sweeps(self) -> bool:
        """True if compiled loops may compute the normal equations: no subclass overrides `image` or `cropped`."""
        return self._own_image and type(self).cropped is _Fused.cropped

    def _settings(self, border: int, one_part: bool = False) -> Settings:
        return Settings(self.kind, self.sigma, self.epsilon, self.array_code.gamma, border, one_part, *self._motions)

    def _settings_of(self, splats: Splats) -> Settings:
        # `part` has the last word over `one_part`, as in `Splats.parts`.
        settings = self._settings(splats.border, splats.one_part and splats.part is None)
        return settings._replace(opaque=splats.opaque)

    @property
    def _motions(self) -> tuple[bool, ...]:
        """The settings `rims` and `crossings`; none for a splatter without them."""
        return ()

    def normal_equations(
        self,
        splats: Splats,
        t_positions: Array,
        t_rgba: Array | None,
        target: Array,
        weights: Array | None = None,
        background: Array | None = None,
        loss: Loss | None = None,
    ) -> tuple[Array, Array, Array] | None:
        """See `rts.Splatter`. None also for translucent `Visible`, and in subclasses that draw in their own way."""
        if not self._sweeps or (self.kind == "visible" and not splats.opaque):
            return None
        from rts_backends.fused import normal_equations

        own = splats.positions, splats.rgba, splats.row, splats.part, self._facing(splats)
        own += splats.wanted, splats.settled, self._exits(splats)
        given = *own, t_positions, t_rgba, target, weights, background
        return normal_equations.equations(self._settings_of(splats), engine_of(given), loss or Loss(), *given)

    def needed(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """See `rts.Splatter`."""
        if self.kind == "single" or depth.dtype not in (np.float32, np.float64):
            return self.array_code.needed(covered, depth)
        from rts_backends.fused import pruning

        return pruning.needed(covered, depth, self._settings(0))


@dataclass(frozen=True)
class Single(_Fused):
    """`rts.splatting.Single`, compiled."""

    kind = "single"
    specification = specified.Single
    layers = specified.Single.layers


@dataclass(frozen=True)
class Multi(_Fused):
    """`rts.splatting.Multi`, compiled."""

    kind = "multi"
    specification = specified.Multi


@dataclass(frozen=True)
class Visible(_Fused):
    """`rts.splatting.Visible`, compiled; see there for the settings.

    Attributes:
        rims: True to have coverage move as outlines do.
        crossings: True to have lines of crossing move as depths say.
        facing: True to keep opposite sides of one sheet from pairing.
        exits: True to have outlines of culled parts move as the middles of their chords.
    """

    kind = "visible"
    specification = specified.Visible
    translucent = specified.Visible.translucent
    reach = specified.Visible.reach
    epsilon: float = specified.Visible.epsilon
    calibration: float | None = specified.Visible.calibration
    rims: bool = specified.Visible.rims
    crossings: bool = specified.Visible.crossings
    facing: bool = specified.Visible.facing
    exits: bool = specified.Visible.exits

    @property
    def _motions(self) -> tuple[bool, ...]:
        return self.rims, self.crossings
