"""The splatters of `rts.splatting`, compiled for the CPU; what does not fit is left to the specification.

What fits is float32 or float64 in the memory of the host. Second derivatives are those of the specification.
"""

from __future__ import annotations

from functools import partial
from typing import ClassVar

import numpy as np

from rts import splatting
from rts.arrays import engine_of
from rts.protocols import Array
from rts_backends.fused_kernels import Settings, Splats


class _Fused(splatting.Kernel):
    """`image` by compiled kernels, before a class of `rts.splatting` in the order of bases."""

    kind: ClassVar[str]

    def image(self, positions: Array, rgba: Array, row: Array, border: int) -> Array:
        """See `rts.splatting.Kernel`."""
        specification = partial(super().image, border=border)
        settings = Settings(self.kind, self.sigma, self.epsilon, self.gamma, border)
        engine = engine_of(positions, rgba, row).name
        if engine == "torch":
            from rts_backends import fused_torch

            if fused_torch.fits(positions, rgba, row):
                return fused_torch.splat(settings, specification, positions, rgba, row)
        elif engine == "jax":
            from rts_backends import fused_jax

            if fused_jax.fits(positions, rgba):
                return fused_jax.splat(settings, positions, rgba, row)
        elif engine == "numpy" and positions.dtype == rgba.dtype and positions.dtype in (np.float32, np.float64):
            return Splats(settings, positions, rgba, row).image()
        return specification(positions, rgba, row)

    def normal_equations(
        self,
        positions: Array,
        rgba: Array,
        row: Array,
        t_positions: Array,
        t_rgba: Array | None,
        target: Array,
        weights: Array | None = None,
        background: Array | None = None,
        border: int = 0,
    ) -> tuple[Array, Array, Array] | None:
        """See `rts.protocols.Splatter`."""
        from rts_backends import fused_normal

        settings = Settings(self.kind, self.sigma, self.epsilon, self.gamma, border)
        given = positions, rgba, row, t_positions, t_rgba, target, weights, background
        return fused_normal.equations(settings, engine_of(given), *given)

    def needed(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """See `rts.protocols.Splatter`."""
        if self.kind == "single" or depth.dtype not in (np.float32, np.float64):
            return super().needed(covered, depth)
        from rts_backends import fused_pruning

        return fused_pruning.needed(covered, depth, self.kind == "visible", self.epsilon)


class Single(_Fused, splatting.Single):
    """`rts.splatting.Single`."""

    kind = "single"


class Multi(_Fused, splatting.Multi):
    """`rts.splatting.Multi`."""

    kind = "multi"


class Visible(_Fused, splatting.Visible):
    """`rts.splatting.Visible`."""

    kind = "visible"
