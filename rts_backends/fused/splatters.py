"""The splatters of `rts.splatting`, compiled for the CPU; what does not fit is left to the specification.

What fits is float32 or float64 in the memory of the host. Second derivatives are those of the specification.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from rts import splatting
from rts.arrays import without_border
from rts.engines import engine_of
from rts.operations.operation import Arrays, Operation, Some
from rts.records import Splats
from rts.trees import Array
from rts_backends.fused.cells import Cells, Choices, Settings


class _Fused(splatting.Kernel):
    """Base that makes `image` by compiled kernels; it stands before a class of `rts.splatting`, which it extends."""

    kind: ClassVar[str]
    averages = True
    _knows_settled = True

    def image(self, splats: Splats) -> Array:
        """See `rts.splatting.Kernel`."""
        if splats.rgba.shape[0] == 0:
            return super().image(splats)
        return self._of(splats, 0)

    def cropped(self, splats: Splats) -> Array:
        """See `rts.Splatter`."""
        if type(self).image is not _Fused.image:  # A subclass has an `image` of its own.
            return super().cropped(splats)
        if splats.rgba.shape[0] == 0:
            return without_border(super().image(splats), splats.border)
        return self._of(splats, splats.border)

    def _of(self, splats: Splats, border: int) -> Array:
        """The image without a border."""
        return IMAGE(*self._operands(splats), settings=self._settings(border))

    def _operands(self, splats: Splats) -> tuple[Array, ...]:
        """Those of `IMAGE`."""
        part = splats.row[:0, :, :] if splats.part is None else splats.part
        facing = self._facing(splats)
        facing = splats.row[:0, :, :] if facing is None else facing
        none = splats.row[0, :0, :]
        known = splats.wanted, splats.settled, self._exits(splats)
        return splats.positions, splats.rgba, splats.row, part, facing, *(none if x is None else x for x in known)

    def _facing(self, splats: Splats) -> Array | None:
        return splats.facing if self.reads_facing else None

    def _exits(self, splats: Splats) -> Array | None:
        return splats.exit if self.reads_exits else None

    def _settings(self, border: int) -> Settings:
        return Settings(self.kind, self.sigma, self.epsilon, self.gamma, border)

    def normal_equations(
        self,
        splats: Splats,
        t_positions: Array,
        t_rgba: Array | None,
        target: Array,
        weights: Array | None = None,
        background: Array | None = None,
    ) -> tuple[Array, Array, Array] | None:
        """See `rts.Splatter`."""
        if type(self).image is not _Fused.image:
            return None
        from rts_backends.fused import normal_equations

        own = splats.positions, splats.rgba, splats.row, splats.part, self._facing(splats)
        own += splats.wanted, splats.settled, self._exits(splats)
        given = *own, t_positions, t_rgba, target, weights, background
        return normal_equations.equations(self._settings(splats.border), engine_of(given), *given)

    def mean_square(
        self, splats: Splats, target: Array, weights: Array | None = None, background: Array | None = None
    ) -> Array | None:
        """See `rts.Splatter`."""
        if type(self).image is not _Fused.image or splats.rgba.shape[0] == 0:
            return None
        from rts_backends.fused import mean_square

        given = self._operands(splats), target, weights, background
        return mean_square.mean_square(self._settings(splats.border), *given)

    def needed(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """See `rts.Splatter`."""
        if self.kind == "single" or depth.dtype not in (np.float32, np.float64):
            return super().needed(covered, depth)
        from rts_backends.fused import pruning

        return pruning.needed(covered, depth, self._settings(0))


class Single(_Fused, splatting.Single):
    """`rts.splatting.Single`, compiled."""

    kind = "single"
    follows_outlines = True


class Multi(_Fused, splatting.Multi):
    """`rts.splatting.Multi`, compiled."""

    kind = "multi"


class Visible(_Fused, splatting.Visible):
    """`rts.splatting.Visible`, compiled."""

    kind = "visible"
    follows_outlines = True

    def _settings(self, border: int) -> Settings:
        return super()._settings(border)._replace(rims=self.rims, crossings=self.crossings)


# ---------------------------------------------------------------------------------------------------- the operation

_SPECIFICATIONS = {"single": splatting.Single, "multi": splatting.Multi, "visible": splatting.Visible}


def specification(
    positions: Array,
    rgba: Array,
    row: Array,
    part: Array,
    facing: Array,
    wanted: Array,
    settled: Array,
    exits: Array,
    *,
    settings: Settings,
) -> Array:
    """The image in array code."""
    given = settings.sigma, settings.epsilon, settings.gamma
    options = {"rims": settings.rims, "crossings": settings.crossings} if settings.kind == "visible" else {}
    part, facing, settled, exits = (x if x.shape[0] else None for x in (part, facing, settled, exits))
    splats = Splats(positions, rgba, row, part, facing, settled, exit=exits)
    return without_border(_SPECIFICATIONS[settings.kind](*given, **options).image(splats), settings.border)


def _shape(
    positions: tuple,
    rgba: tuple,
    row: tuple,
    part: tuple,
    facing: tuple,
    wanted: tuple,
    settled: tuple,
    exits: tuple,
    *,
    settings: Settings,
) -> tuple[int, ...]:
    return *(max(0, n - 2 * settings.border) for n in row[1:]), 4


def _cells(settings: Settings, operands: Arrays, kept: Choices | None) -> Cells:
    positions, rgba, row, *known = operands
    return Cells(settings, positions, rgba, row, kept, *known)


def _forward(operands: Arrays, out: np.ndarray, *, settings: Settings) -> Choices | None:
    cells = _cells(settings, operands, None)
    cells.image(out)
    return cells.choices if out.size else None


def _push(operands: Arrays, tangents: Some, out: np.ndarray, *, settings: Settings, kept: Choices | None) -> None:
    t_positions, t_rgba = tangents
    _cells(settings, operands, kept).jvp(t_positions, t_rgba, out)


def _pull(operands: Arrays, g: np.ndarray, results: Some, *, settings: Settings, kept: Choices | None) -> None:
    g_positions, g_rgba = results
    _cells(settings, operands, kept).vjp(g, g_positions, g_rgba)


def used(operands: Arrays) -> int:
    """How many rows cells refer to."""
    return max(1, int(operands[2].max(initial=0)) + 1, int(operands[7].max(initial=0)) + 1)


_OPTIONS: dict[str, Any] = {"differentiable": 2, "packed": (0, 1), "used": used, "even": (1,)}
IMAGE = Operation(
    "rts.image",
    specification,
    (2, 2, 3, 3, 3, 2, 2, 2),
    _shape,
    _forward,
    _push,
    _pull,
    keeps=True,
    sweeps=True,
    **_OPTIONS,
)
"""The image (H, W, 4) of positions (N, 3), rgba (N, 4), row (K, H, W), part, facing, wanted, settled and exit, without
a border.

The last five are those of `rts.Splats`; (0, H, W) and (0, W) where they are not known."""
