"""The splatters of the paper (§3.3): `Single` for one layer, `Multi` for several; and `Plain`, which does not splat.

A splat belongs to the cell (y, x) that its sample was cast through. Its targets are the 3 × 3 cells in and around that
cell, wherever its position is. With c = (x + 0.5, y + 0.5) the cell's centre, P the splat's differentiable position
and (u, v) ∈ {−1, 0, 1}², the weight is

    w(u, v) = (1 + ε) / W · exp(−‖c + (u, v) − P‖² / 2σ²),    W = Σ exp(−‖(u, v)‖² / 2σ²).

The paper's W depends on P. Where samples lie on pixel centres the value and the first derivative agree; second
derivatives (a Hessian) do not.
"""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass

from rts.arrays.argument_checks import quoted
from rts.arrays.engines import engine_of, namespace, stopped
from rts.arrays.trees import Array
from rts.contracts.checks import is_count, is_real
from rts.contracts.records import Splats
from rts.contracts.splatter import Splatter
from rts.errors import InputError
from rts.splatting.cells import check_rows, nothing, over, unpack

LEAST_SIGMA, LARGEST_SIGMA = 0.1, 1e3
OFFSETS = (-1, 0, 1)

Sources = list[tuple[Array, Array]]
"""For each target (H, W) its nine sources, the target itself amid them: splats (K, 5, H, W) of their layers, which are
weighted colours and the weight, and depths (K, H, W)."""


class Plain(Splatter):
    """No splatting: layers are composited front to back, without derivative at occlusion boundaries."""

    layers = 1
    translucent = True

    def image(self, splats: Splats) -> Array:
        """See `rts.Splatter`."""
        positions, rgba, row = splats.positions, splats.rgba, splats.row[:1, ...] if splats.opaque else splats.row
        if rgba.shape[0] == 0:
            return nothing(rgba, row)
        check_rows(row, rgba.shape[0])
        xp = namespace(rgba)
        # Zero, but connected to the positions, so that their derivative exists and is zero.
        composite = 0 * xp.sum(positions)
        for k in reversed(range(row.shape[0])):
            layer = xp.where((row[k] >= 0)[..., None], unpack(rgba, row[k]), 0.0)
            composite = over(layer, composite)
        return composite


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

    sigma: float = 0.5
    epsilon: float = 0.05
    calibration: float | None = 1.0

    def __post_init__(self):
        if not (is_real(self.sigma) and LEAST_SIGMA <= self.sigma <= LARGEST_SIGMA):
            raise InputError(f"sigma is {quoted(self.sigma)}; expected pixels, from {LEAST_SIGMA} to {LARGEST_SIGMA:g}")
        if not (is_real(self.epsilon) and 0 <= self.epsilon < math.inf):
            raise InputError(f"epsilon is {quoted(self.epsilon)}; expected a number of at least 0")
        if self.calibration is not None and not (is_real(self.calibration) and 0 < self.calibration < math.inf):
            raise InputError(f"calibration is {quoted(self.calibration)}; expected a positive number, or None")

    @property
    def gamma(self) -> float:
        """The calibration as a number."""
        return exact_calibration(self.sigma) if self.calibration is None else self.calibration

    def image(self, splats: Splats) -> Array:
        """See `rts.Splatter`."""
        rgba, row = splats.rgba, splats.row[: self.layers, ...]
        if rgba.shape[0] == 0:
            return nothing(rgba, row)
        check_rows(row, rgba.shape[0])
        xp, (height, width), cells = namespace(rgba), row.shape[1:], _bordered(row)
        position, color = unpack(splats.positions, cells), unpack(rgba, cells)
        color = xp.permute_dims(xp.concat([color, xp.ones_like(color[..., :1])], axis=-1), (0, 3, 1, 2))
        color, depth = xp.where((cells >= 0)[:, None], color, 0.0), _depths(stopped(position[..., 2]), cells >= 0)
        across, down = self._weights(position[..., 0], width), self._weights(position[..., 1], height, down=True)
        sources = []
        for v in OFFSETS:
            for u in OFFSETS:
                place = ..., slice(1 - v, height + 1 - v), slice(1 - u, width + 1 - u)
                sources.append(((color * (across[u] * down[v])[:, None])[place], depth[place]))
        return self.accumulate(sources)

    @abc.abstractmethod
    def accumulate(self, sources: Sources) -> Array:
        """The image (H, W, 4) of the splats of all targets' sources."""

    def _weights(self, position: Array, count: int, down: bool = False) -> dict[int, Array]:
        """Factors of w(u, v) along one axis, by offset, of positions along it."""
        centre = engine_of(position).arange(count + 2, position) - 0.5
        centre = centre[:, None] if down else centre
        offset, scale = self.gamma * (position - centre), 1 / (2 * self.sigma**2)
        peak = math.sqrt(1 + self.epsilon) / sum(math.exp(-(u**2) * scale) for u in OFFSETS)
        return {u: peak * namespace(position).exp(-((u - offset) ** 2) * scale) for u in OFFSETS}


@dataclass(frozen=True)
class Single(Kernel):
    """Splatting of one layer (paper eq. 1–3): only the front layer of `row`, as if nothing hid anything."""

    layers = 1

    def accumulate(self, sources: Sources) -> Array:
        """See `Kernel`."""
        return _normalised(sum(splat[0, ...] for splat, _ in sources))


@dataclass(frozen=True)
class Multi(Kernel):
    """Three accumulation buffers (paper §3.3.2): in front of the target, at its surface, and behind it.

    Layers of the source p and the target q are paired on linear depth z: with A_l = |z_p[l] − z_q[0]| and
    B_l = |z_q[l] − z_p[0]|, s = −argmin B where min B < min A, else argmin A. Layer l of p is in front where l < s, at
    the surface where l = s, behind where l > s. B finds sources whose front layer continues a hidden layer of the
    target. Back faces of a closed surface pair with layers behind them: cull them (`Part.cull`).
    """

    def accumulate(self, sources: Sources) -> Array:
        """See `Kernel`."""
        xp, target, buffers = namespace(sources[0][0]), sources[len(sources) // 2][1], [0.0, 0.0, 0.0]
        for splat, depth in sources:
            s = _pairing(depth, target)
            for k in range(depth.shape[0]):
                for i, mask in enumerate((k < s, k == s, k > s)):
                    buffers[i] = buffers[i] + xp.where(mask, splat[k, ...], 0.0)
        front, surface, behind = map(_normalised, buffers)
        return over(front, over(surface, behind))


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


def _bordered(cells: Array) -> Array:
    """Cells (K, H, W) with a border of empty ones, one cell wide."""
    xp = namespace(cells)
    margin = xp.full_like(cells[:, :, :1], -1)
    cells = xp.concat([margin, cells, margin], axis=2)
    end = xp.full_like(cells[:, :1, :], -1)
    return xp.concat([end, cells, end], axis=1)


def _depths(depth: Array, covered: Array) -> Array:
    """Depths (K, h, w), with one depth for all empty places.

    It lies beyond all layers, at a distance of the scene's own scale: at least as far from any layer as two layers, or
    a layer and the camera, are from each other, so that no layer pairs with an empty place.
    """
    xp = namespace(depth)
    known = xp.where(covered, depth, 0.0)
    extent = xp.clip(xp.max(known), 0.0, None) - xp.clip(xp.min(known), None, 0.0)
    return xp.where(covered, depth, xp.where(extent > 0, 2 * extent, 1.0))


def _pairing(source: Array, target: Array) -> Array:
    """The number s (H, W) of `Multi`, of depths (K, H, W) of sources and targets; of equal distances the first."""
    xp = namespace(source)
    ahead, below = xp.abs(source - target[:1, ...]), xp.abs(target - source[:1, ...])
    (a, least_a), (b, least_b) = _first_minimum(ahead), _first_minimum(below)
    return xp.where(least_b < least_a, -b, a)


def _first_minimum(values: Array) -> tuple[Array, Array]:
    """Index and value (H, W) of the smallest of values (K, H, W); the first of equal ones."""
    xp, best = namespace(values), values[0, ...]
    index = xp.zeros_like(best, dtype=xp.int32)
    for k in range(1, values.shape[0]):
        smaller = values[k, ...] < best
        best, index = xp.where(smaller, values[k, ...], best), xp.where(smaller, k, index)
    return index, best


def _normalised(total: Array) -> Array:
    """Colours (H, W, 4) of sums (5, H, W): over the sum of weights, the last, or over 1 if less (paper eq. 3)."""
    xp = namespace(total)
    return xp.permute_dims(total[:4, ...] / xp.clip(total[4:, ...], 1.0, None), (1, 2, 0))
