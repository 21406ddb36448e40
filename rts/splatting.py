"""The splatters (paper §3.3), in array-API code: the specification of the method, for any engine and device.

A splat belongs to the cell (y, x) that its sample was cast through; its targets are that cell's 3 × 3 neighbours,
whatever its computed position. With c = (x + 0.5, y + 0.5) the cell's centre, P the splat's differentiable position
and (u, v) ∈ {−1, 0, 1}², the weight is

    w(u, v) = (1 + ε) / W · exp(−‖c + (u, v) − P‖² / 2σ²),    W = Σ exp(−‖(u, v)‖² / 2σ²).

The paper's W depends on P. Where samples lie on pixel centres the value and the first derivative agree; second
derivatives (a Hessian) do not.
"""

from __future__ import annotations

import abc
import functools
import math
import operator
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np

from rts.engines import engine_of, namespace
from rts.errors import InputError
from rts.interfaces import Splatter
from rts.records import Splats
from rts.trees import Array

SIGMA, EPSILON = 0.5, 0.05
CONTINUED = 0.5
"""Share of the error of plain pairing below which `Visible` takes the line of a front layer for its continuation."""
LEAST_SIGMA, LARGEST_SIGMA = 0.1, 1e3
TIE, LEAST_EPSILON = 1e-5, 1e-4
"""Depths so near, relative to the farthest, may be ordered by rounding; and an ε that outweighs rounding of weights."""
OFFSETS = (-1, 0, 1)
NEIGHBOURS = [(u, v) for v in OFFSETS for u in OFFSETS]


class Plain(Splatter):
    """No splatting: the layers composited front to back. Has no derivative at occlusion boundaries."""

    def image(self, splats: Splats) -> Array:
        """See `rts.Splatter`."""
        positions, rgba, row = splats.positions, splats.rgba, splats.row
        if rgba.shape[0] == 0:
            return _nothing(rgba, row)
        xp = namespace(rgba)
        # Nothing, but it keeps the image connected to the positions, whose derivative it is to say is zero.
        image = 0 * xp.sum(positions)
        for k in reversed(range(row.shape[0])):
            layer = xp.where((row[k] >= 0)[..., None], _unpack(rgba, row[k]), 0.0)
            image = _over(layer, image)
        return image

    def needed(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """See `rts.Splatter`: what is opaque hides all that is behind it."""
        return _fronts(covered)


@dataclass(frozen=True)
class Kernel(Splatter):
    """What the splatters share: a Gaussian over 3 × 3 cells.

    Attributes:
        sigma: standard deviation, pixels. Below 0.45 little of the kernel reaches the neighbouring cells, and most of
            the derivative at edges is lost.
        epsilon: excess of the weights' sum over one, so that the interior is always normalised.
        calibration: factor γ on a splat's offset from its cell's centre, P' = c + γ (P − c): nothing to the image of
            samples on pixel centres, but a factor on its derivative. None for the γ of `exact_calibration`.
    """

    sigma: float = SIGMA
    epsilon: float = EPSILON
    calibration: float | None = 1.0

    def __post_init__(self):
        if not (_is_real(self.sigma) and LEAST_SIGMA <= self.sigma <= LARGEST_SIGMA):
            raise InputError(f"sigma is {self.sigma}; expected pixels, from {LEAST_SIGMA} to {LARGEST_SIGMA:g}")
        if not (_is_real(self.epsilon) and self.epsilon >= 0):
            raise InputError(f"epsilon is {self.epsilon}; expected a number of at least 0")
        if self.calibration is not None and not (_is_real(self.calibration) and self.calibration > 0):
            raise InputError(f"calibration is {self.calibration}; expected a positive number, or None for the exact")

    def image(self, splats: Splats) -> Array:
        """See `rts.Splatter`."""
        if splats.rgba.shape[0] == 0:
            return _nothing(splats.rgba, splats.row)
        return self.accumulate(splats.positions, splats.rgba, splats.row)

    @abc.abstractmethod
    def accumulate(self, positions: Array, rgba: Array, row: Array) -> Array:
        """The image of all cells, of at least one sample."""

    def needed(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """See `rts.Splatter`: fronts, and the hidden layers around targets that are not `plain`."""
        if len(covered) == 1 or not covered.any():
            return covered
        cells = _bordered(np.where(covered, 0, -1)) >= 0
        depths = _Depths(list(np.where(cells, _bordered(depth), 0)), cells)
        margin = TIE * float(np.abs(depth[covered]).max())
        mixed = np.pad(~self.plain(depths, margin), 1)
        shows = np.logical_or.reduce([depths.at(mixed, u, v) for u, v in NEIGHBOURS])
        return covered & np.where(np.arange(len(covered))[:, None, None] > 0, shows, True)

    @abc.abstractmethod
    def plain(self, depths: _Depths, margin: float) -> Array:
        """Targets (H, W) at which only front layers count, however depths are rounded within a margin."""

    @functools.cached_property
    def gamma(self) -> float:
        """The calibration as a number."""
        return exact_calibration(self.sigma) if self.calibration is None else self.calibration

    def weights(self, position: Array) -> tuple[dict[int, Array], dict[int, Array]]:
        """Weights of cells (h, w, ·), the first being cell (−1, −1): by target offset u, and by v; w = x[u] · y[v]."""
        xp = namespace(position)
        height, width = position.shape[:2]
        constant = engine_of(position).constant
        rx = self.gamma * (position[..., 0] - constant(np.arange(width) - 0.5, position))
        ry = self.gamma * (position[..., 1] - constant(np.arange(height) - 0.5, position)[:, None])
        scale = 1 / (2 * self.sigma**2)
        peak = math.sqrt(1 + self.epsilon) / sum(math.exp(-(u**2) * scale) for u in OFFSETS)
        return (
            {u: peak * xp.exp(-((u - rx) ** 2) * scale) for u in OFFSETS},
            {v: peak * xp.exp(-((v - ry) ** 2) * scale) for v in OFFSETS},
        )


def _is_real(value: Any) -> bool:
    return isinstance(value, Real) and math.isfinite(value)


def exact_calibration(sigma: float, reach: int = 1) -> float:
    """The factor γ on splats' offsets with which a linear ramp of colour that moves has its true derivative.

    For weights exp(−‖c + (u, v) − P‖² / 2σ²), normalised for samples on centres, of a splat at P in the cell with the
    centre c, whose offset is to be multiplied: P' = c + γ (P − c). Without γ the first moment of the kernel's
    derivative, 1/γ (0.852 for σ = 0.5), is the share that is delivered.

    Args:
        sigma: σ, pixels.
        reach: cells on each side that the kernel covers: 1 for 3 × 3, 2 for 5 × 5.

    Returns:
        γ = σ² Σ e / Σ u² e, e = exp(−u² / 2σ²) over −reach ≤ u ≤ reach.
    """
    if not (_is_real(sigma) and sigma > 0) or not (isinstance(reach, int) and reach >= 1):
        raise InputError(
            f"sigma is {sigma!r} and reach {reach!r}; expected a positive number and an integer of at least 1"
        )
    e = [math.exp(-(u**2) / (2 * sigma**2)) for u in range(1, reach + 1)]
    return sigma**2 * (1 + 2 * sum(e)) / (2 * sum(u**2 * x for u, x in enumerate(e, start=1)))


@dataclass(frozen=True)
class Single(Kernel):
    """One layer, occlusion ignored (paper eq. 1–3): only the front layer of `row` is splatted."""

    def accumulate(self, positions: Array, rgba: Array, row: Array) -> Array:
        """See `Kernel`."""
        layers = _Layers(self, positions, rgba, row[:1])
        total = sum(layers.splats(u, v)[0] for u, v in NEIGHBOURS)
        return _normalised(total, namespace(rgba))

    def plain(self, depths: _Depths, margin: float) -> Array:
        """See `Kernel`: everywhere."""
        return depths.covers(0, 0) | True


@dataclass(frozen=True)
class Multi(Kernel):
    """Three accumulation buffers (paper §3.3.2): in front of the target, at its surface, and behind it.

    Layers of the source p and the target q are paired on linear depth z: with A_l = |z_p[l] − z_q[0]| and
    B_l = |z_q[l] − z_p[0]|, s = −argmin B where min B < min A, else argmin A. Layer l of p is in front where l < s, at
    the surface where l = s, behind where l > s. The B test catches a source whose front layer continues a hidden layer
    of the target. Back faces of a closed surface pair with what lies behind them: cull them (`Part.cull`).
    """

    def accumulate(self, positions: Array, rgba: Array, row: Array) -> Array:
        """See `Kernel`."""
        xp = namespace(positions, rgba, row)
        layers = _Layers(self, positions, rgba, row)
        buffers = [0.0, 0.0, 0.0]
        for u, v in NEIGHBOURS:
            s, _ = layers.pairing(u, v)
            for k, splats in enumerate(layers.splats(u, v)):
                for i, chosen in enumerate((s > k, s == k, s < k)):
                    buffers[i] = buffers[i] + xp.where(chosen[..., None], splats, 0.0)
        front, surface, behind = (_normalised(b, xp) for b in buffers)
        return _over(front, _over(surface, behind))

    def plain(self, depths: _Depths, margin: float) -> Array:
        """See `Kernel`: where the surface fills the target, all that is behind it is covered."""
        full = self.epsilon >= LEAST_EPSILON
        return full & _all([depths.covers(*n) & depths.fronts_pair(*n, margin)[0] for n in NEIGHBOURS])


@dataclass(frozen=True)
class Visible(Kernel):
    """`Multi` with a calibrated derivative, where opaque layers of one source hide each other.

    Pairing is that of `Multi`, save that front layers pair (s = 0) also where one lies on the line through the other
    and its next cell, to half of what the best of A and B is off: depth that changes fast, as on the sides of a box
    near its outline, is nearer to a back face than to itself.

    Each buffer gets at most one layer of a source. An empty target takes the source's front layer, at the surface. A
    covered target takes the source's front layer in front where s > 0, and layer s at the surface where s ≥ 0. Behind
    is only what shows next door: with m the least −s over the covered sources of s < 0, those give their front layer
    and the others the layer l > s whose depth is nearest to z_q[m]; where there is no m, nothing.

    Closed surfaces need no culling, if K reaches through their back faces to what lies behind.
    """

    epsilon: float = 1e-3
    calibration: float | None = None

    def accumulate(self, positions: Array, rgba: Array, row: Array) -> Array:
        """See `Kernel`."""
        xp = namespace(positions, rgba, row)
        layers = _Layers(self, positions, rgba, row)
        shift = {}
        for n in NEIGHBOURS:
            s, off = layers.pairing(*n)
            shift[n] = xp.where((row[0] < 0) | layers.continues(*n, CONTINUED * off), 0, s)
        shown = {n: (s < 0) & layers.covers(*n) for n, s in shift.items()}
        none = row.shape[0]
        m = xp.full_like(row[0], none)
        for n, s in shift.items():
            m = xp.where(shown[n] & (-s < m), -s, m)
        revealed = sum(xp.where(m == k, z, 0.0) for k, z in enumerate(layers.target))

        front, surface, behind = 0.0, 0.0, 0.0
        for n, s in shift.items():
            hidden = xp.where(s < 0, 0, _nearest(layers.source(*n), revealed, s, xp))
            hidden = xp.where(m < none, hidden, none)
            for k, splats in enumerate(layers.splats(*n)):
                if k == 0:
                    front = front + xp.where((s > 0)[..., None], splats, 0.0)
                surface = surface + xp.where((s == k)[..., None], splats, 0.0)
                behind = behind + xp.where((hidden == k)[..., None], splats, 0.0)
        front, surface, behind = (_normalised(b, xp) for b in (front, surface, behind))
        return _over(front, _over(surface, behind))

    def plain(self, depths: _Depths, margin: float) -> Array:
        """See `Kernel`: where no source has a hidden layer in play."""
        found = []
        for n in NEIGHBOURS:
            pair, off = depths.fronts_pair(*n, margin)
            found.append(~depths.covers(*n) | pair | depths.continues(*n, CONTINUED * off - margin))
        return ~depths.covers(0, 0) | _all(found)


class _Depths:
    """Depths of an image with a border of one empty cell, as seen from targets; (u, v) leads from source to target."""

    def __init__(self, depth: list[Array], covered: Array):
        """Depths of each layer (h, w), finite, and where they are covered (K, h, w), both with the border."""
        self.xp = namespace(covered, depth[0])
        self.size = covered.shape[1] - 2, covered.shape[2] - 2
        self._covered = covered[0]
        self._depth = _beyond(depth, covered)
        front = self._depth[0][None], self.xp.where(self._covered, 0, -1)[None]
        self._front = _bordered(front[0])[0], _bordered(front[1])[0] >= 0
        self.target = self.source(0, 0)

    def source(self, u: int, v: int) -> list[Array]:
        """Depths of the sources' layers, K times (H, W)."""
        return [self.at(z, u, v) for z in self._depth]

    def covers(self, u: int, v: int) -> Array:
        """Whether the sources have any layer."""
        return self.at(self._covered, u, v)

    def pairing(self, u: int, v: int) -> tuple[Array, Array]:
        """The number s of `Multi`, and what the depths that it pairs are off, (H, W) both."""
        source = self.source(u, v)
        a, best_a = _first_minimum([self.xp.abs(z - self.target[0]) for z in source], self.xp)
        b, best_b = _first_minimum([self.xp.abs(z - source[0]) for z in self.target], self.xp)
        return self.xp.where(best_b < best_a, -b, a), self.xp.minimum(best_a, best_b)

    def fronts_pair(self, u: int, v: int, margin: float) -> tuple[Array, Array]:
        """Whether fronts are nearer, by a margin, than any pair with a hidden layer; and the smallest distance."""
        source, xp = self.source(u, v), self.xp
        front, hidden = xp.abs(source[0] - self.target[0]), xp.full_like(source[0], xp.inf)
        for p, q in zip(source[1:], self.target[1:], strict=True):
            hidden = xp.minimum(hidden, xp.minimum(xp.abs(p - self.target[0]), xp.abs(q - source[0])))
        return front + margin < hidden, xp.minimum(front, hidden)

    def continues(self, u: int, v: int, limit: Array) -> Array:
        """Whether the front of the source or of the target is nearer than a limit to where the other's line leads."""
        xp = self.xp
        source, target = self.at(self._depth[0], u, v), self.target[0]
        found = xp.zeros_like(target, dtype=xp.bool)
        for end, start, steps in ((source, target, -1), (target, source, 2)):
            before, covered = (self.at(x, steps * u, steps * v, border=2) for x in self._front)
            found = found | (covered & (xp.abs(end - (2 * start - before)) < limit))
        return found

    def at(self, cells: Array, u: int, v: int, border: int = 1) -> Array:
        """For each target, the cell from which (u, v) leads to it; (u, v) reaches as far as the border is wide."""
        top, left = border - v, border - u
        return cells[top : top + self.size[0], left : left + self.size[1], ...]


class _Layers(_Depths):
    """The same with weights and colours."""

    def __init__(self, kernel: Kernel, positions: Array, rgba: Array, row: Array):
        cells = _bordered(row)
        position = [_unpack(positions, cells[k]) for k in range(row.shape[0])]
        super().__init__([p[..., 2] for p in position], cells >= 0)
        self._color = [
            _weighted(_unpack(rgba, c), (c >= 0)[..., None]) for c in (cells[k] for k in range(row.shape[0]))
        ]
        self._weights = [kernel.weights(p) for p in position]

    def splats(self, u: int, v: int) -> list[Array]:
        """What the sources' layers give, K times (H, W, 5): weighted colours and the weight."""
        return [
            self.at(color * (wx[u] * wy[v])[..., None], u, v)
            for color, (wx, wy) in zip(self._color, self._weights, strict=True)
        ]


def _nothing(rgba: Array, row: Array) -> Array:
    xp = namespace(rgba, row)
    return xp.stack([xp.zeros_like(row[0], dtype=rgba.dtype)] * 4, axis=-1)


def _unpack(values: Array, cells: Array) -> Array:
    """(h, w, C) of packed values (N, C); an empty cell gets those of row 0, to be masked."""
    xp = namespace(values, cells)
    index = xp.reshape(xp.where(cells >= 0, cells, 0), (-1,))
    return xp.reshape(xp.take(values, index, axis=0), (*cells.shape, values.shape[1]))


def _bordered(row: Array) -> Array:
    """`row` with a border of one cell of −1."""
    xp = namespace(row)
    side = xp.full_like(row[:, :, :1], -1)
    row = xp.concat([side, row, side], axis=2)
    end = xp.full_like(row[:, :1, :], -1)
    return xp.concat([end, row, end], axis=1)


def _weighted(rgba: Array, covered: Array) -> Array:
    """(h, w, 5): colour, and 1 to count the weights; zero where not covered."""
    xp = namespace(rgba)
    return xp.where(covered, xp.concat([rgba, xp.ones_like(rgba[..., :1])], axis=-1), 0.0)


def _normalised(total: Array, xp: Any) -> Array:
    """Accumulated colours over their weights, which are taken as at least one (paper eq. 3)."""
    return total[..., :4] / xp.clip(total[..., 4:], 1.0, None)


def _beyond(depth: list[Array], covered: Array) -> list[Array]:
    """Depths of each layer; an empty cell lies beyond everything, at a distance of the scene's own scale."""
    xp = namespace(covered, depth[0])
    depth = [xp.where(covered[k], z, 0.0) for k, z in enumerate(depth)]
    farthest = 2 * xp.max(xp.abs(xp.stack(depth)))
    return [xp.where(covered[k], z, xp.where(farthest > 0, farthest, 1.0)) for k, z in enumerate(depth)]


def _all(conditions: list[Array]) -> Array:
    return functools.reduce(operator.and_, conditions)


def _fronts(covered: np.ndarray) -> np.ndarray:
    """(K, H, W) bool: the first layer."""
    return covered & (np.arange(len(covered)) == 0)[:, None, None]


def _first_minimum(values: list[Array], xp: Any) -> tuple[Array, Array]:
    """Index and value of the first smallest of some images."""
    best, index = values[0], xp.zeros_like(values[0], dtype=xp.int32)
    for k, value in enumerate(values[1:], start=1):
        smaller = value < best
        best, index = xp.where(smaller, value, best), xp.where(smaller, k, index)
    return index, best


def _nearest(source: list[Array], depth: Array, s: Array, xp: Any) -> Array:
    """Index of each source's layer beyond s that is nearest to a depth; K where it has none."""
    best, index = xp.full_like(depth, xp.inf), xp.full_like(s, len(source))
    for k, z in enumerate(source[1:], start=1):
        distance = xp.abs(z - depth)
        nearer = (k > s) & (distance < best)
        best, index = xp.where(nearer, distance, best), xp.where(nearer, k, index)
    return index


def _over(front: Array, back: Array) -> Array:
    """Premultiplied compositing (Porter and Duff 1984)."""
    return front + (1 - front[..., 3:]) * back
