"""The kernel of the splatters (paper §3.3): the target cells of a sample, and its weights there.

A splat belongs to the cell (y, x) that its sample was cast through. Its targets are the 3 × 3 cells in and around that
cell, wherever its position is. With c = (x + 0.5, y + 0.5) the cell's centre, P the splat's differentiable position
and (u, v) ∈ {−1, 0, 1}², the weight is

    w(u, v) = (1 + ε) / W · exp(−‖c + (u, v) − P‖² / 2σ²),    W = Σ exp(−‖(u, v)‖² / 2σ²).

The paper's W depends on P. Where samples lie on pixel centres the value and the first derivative agree; second
derivatives (a Hessian) do not.
"""

from __future__ import annotations

import abc
import functools
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.contracts.checks import is_count, is_real
from rts.contracts.records import Splats
from rts.contracts.splatter import Splatter
from rts.errors import InputError
from rts.splatting.layers import NEIGHBOURS, OFFSETS, Depths, bordered, check_rows, check_settled, nothing, unpack

SIGMA, EPSILON = 0.5, 0.05
LEAST_SIGMA, LARGEST_SIGMA = 0.1, 1e3
TIE, LEAST_EPSILON = 1.5e-4, 1e-4
"""TIE is the difference of depths, relative to the farthest, below which rounding may decide their order. It holds for
coordinates up to `rts.sampling.packing.FAR`. LEAST_EPSILON is the least ε that outweighs the rounding of weights."""


@dataclass(frozen=True)
class Kernel(Splatter):
    """Base class of the splatters with a Gaussian kernel over 3 × 3 cells.

    Attributes:
        sigma: standard deviation, cells (pixels without supersampling). Below 0.45 little of the kernel reaches the
            neighbouring cells, and most of the derivative at outlines is lost.
        epsilon: excess of the weights' sum over one, so that the interior is always normalised.
        calibration: factor γ on a splat's offset from its cell's centre, P' = c + γ (P − c). It leaves the image of
            samples on pixel centres unchanged, and multiplies its derivative. None for the γ of `exact_calibration`.
    """

    sigma: float = SIGMA
    epsilon: float = EPSILON
    calibration: float | None = 1.0
    TIE: ClassVar[float] = TIE
    LEAST_EPSILON: ClassVar[float] = LEAST_EPSILON

    def __post_init__(self):
        if not (is_real(self.sigma) and LEAST_SIGMA <= self.sigma <= LARGEST_SIGMA):
            raise InputError(f"sigma is {quoted(self.sigma)}; expected pixels, from {LEAST_SIGMA} to {LARGEST_SIGMA:g}")
        if not (is_real(self.epsilon) and 0 <= self.epsilon < math.inf):
            raise InputError(f"epsilon is {quoted(self.epsilon)}; expected a number of at least 0")
        if self.calibration is not None and not (is_real(self.calibration) and 0 < self.calibration < math.inf):
            raise InputError(f"calibration is {quoted(self.calibration)}; expected a positive number, or None")

    def image(self, splats: Splats) -> Array:
        """See `rts.Splatter`."""
        if splats.rgba.shape[0] == 0:
            return nothing(splats.rgba, splats.row)
        return settled(self.accumulate(splats), splats)

    @staticmethod
    def check(row: Array, count: int, settled: Array | None = None, exits: Array | None = None) -> None:
        """Raise an InputError if fields of `Splats` name a sample not below `count`, before compiled loops read it."""
        check_rows(row, count)
        if exits is not None:
            check_rows(exits, count)
        if settled is not None:
            check_settled(settled, row.shape[1:], count)

    @abc.abstractmethod
    def accumulate(self, splats: Splats) -> Array:
        """The image (H, W, 4) of all cells, those of the border too; there is at least one sample."""

    def needed(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """See `rts.Splatter`: fronts, and the hidden layers around targets that are not `plain`."""
        if len(covered) == 1 or not covered.any():
            return covered
        cells = bordered(np.where(covered, 0, -1)) >= 0
        depths = Depths(list(np.where(cells, bordered(depth), 0)), cells)
        margin = TIE * float(np.abs(depth[covered]).max())
        mixed = np.pad(~self.plain(depths, margin), 1)
        shows = np.logical_or.reduce([depths.at(mixed, u, v) for u, v in NEIGHBOURS])
        return covered & np.where(np.arange(len(covered))[:, None, None] > 0, shows, True)

    @abc.abstractmethod
    def plain(self, depths: Depths, margin: float) -> Array:
        """Targets (H, W) bool that only fronts affect, even if rounding changes differences of depth by `margin`."""

    @functools.cached_property
    def gamma(self) -> float:
        """The calibration as a number."""
        return exact_calibration(self.sigma) if self.calibration is None else self.calibration

    def offsets(self, position: Array) -> tuple[Array, Array]:
        """Calibrated offsets (x, y) of samples from the centres of cells (h, w); the first cell is (−1, −1)."""
        height, width = position.shape[:2]
        constant = engine_of(position).constant
        return (
            self.gamma * (position[..., 0] - constant(np.arange(width) - 0.5, position)),
            self.gamma * (position[..., 1] - constant(np.arange(height) - 0.5, position)[:, None]),
        )

    def weights(self, position: Array) -> tuple[dict[int, Array], dict[int, Array]]:
        """Factors x and y (h, w) by offset, of the weights w(u, v) = x[u] · y[v]; the first cell is (−1, −1)."""
        rx, ry = self.offsets(position)
        return {u: self._factor(u - rx) for u in OFFSETS}, {v: self._factor(v - ry) for v in OFFSETS}

    def weight(self, offset: Array, u: int, v: int) -> Array:
        """The weight w(u, v) of samples with calibrated offsets (…, 2)."""
        return self._factor(u - offset[..., 0]) * self._factor(v - offset[..., 1])

    def _factor(self, distance: Array) -> Array:
        """The factor of a weight along one axis, for a distance."""
        scale = 1 / (2 * self.sigma**2)
        peak = math.sqrt(1 + self.epsilon) / sum(math.exp(-(u**2) * scale) for u in OFFSETS)
        return peak * namespace(distance).exp(-(distance**2) * scale)


def settled(image: Array, splats: Splats) -> Array:
    """The image (H, W, 4), in which cells of `Splats.settled` show the colours of their samples."""
    if splats.settled is None:
        return image
    check_settled(splats.settled, image.shape[:2], splats.rgba.shape[0])
    xp = namespace(image)
    row = xp.astype(splats.settled, splats.row.dtype)
    return xp.where((row >= 0)[..., None], unpack(splats.rgba, row), image)


def exact_calibration(sigma: float, reach: int = 1) -> float:
    """The factor γ on splats' offsets with which a moving linear ramp of colour has its true derivative.

    Weights are exp(−‖c + (u, v) − P‖² / 2σ²), normalised for samples on centres, for a splat at P in the cell with the
    centre c. The calibrated offset is P' = c + γ (P − c). Without γ only a share of the derivative arrives: the first
    moment of the kernel's derivative, 1/γ (0.852 for σ = 0.5).

    Args:
        sigma: σ, pixels.
        reach: cells on each side that the kernel covers: 1 for 3 × 3, 2 for 5 × 5.

    Returns:
        γ = σ² Σ e / Σ u² e, e = exp(−u² / 2σ²) over −reach ≤ u ≤ reach.

    Raises:
        InputError: sigma is no positive finite number, or reach no integer of at least 1.
    """
    if not (is_real(sigma) and 0 < sigma < math.inf) or not is_count(reach):
        raise InputError(
            f"sigma is {quoted(sigma)} and reach {quoted(reach)}; expected a positive number and an integer of at "
            f"least 1"
        )
    e = [math.exp(-(u**2) / (2 * sigma**2)) for u in range(1, reach + 1)]
    return sigma**2 * (1 + 2 * sum(e)) / (2 * sum(u**2 * x for u, x in enumerate(e, start=1)))
