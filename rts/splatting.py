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
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from rts.arrays import constants, engine_of, exemplar, from_numbers, namespace
from rts.errors import InputError
from rts.protocols import Array

SIGMA, EPSILON = 0.5, 0.05
OFFSETS = (-1, 0, 1)


class Plain:
    """No splatting: the layers composited front to back. Has no derivative at occlusion boundaries."""

    def splat(self, positions: Array, rgba: Array, row: Array) -> Array:
        """See `rts.protocols.Splatter`."""
        positions, rgba, row = check_splats(positions, rgba, row)
        if rgba.shape[0] == 0:
            return _nothing(rgba, row)
        xp = namespace(rgba)
        # Nothing, but it keeps the image connected to the positions, whose derivative it is to say is zero.
        image = 0 * xp.sum(positions)
        for k in reversed(range(row.shape[0])):
            layer = xp.where((row[k] >= 0)[..., None], _unpack(rgba, row[k]), 0.0)
            image = _over(layer, image)
        return image


@dataclass(frozen=True)
class Kernel(abc.ABC):
    """What the splatters share: a Gaussian over 3 × 3 cells.

    Attributes:
        sigma: standard deviation, pixels. Below 0.45 little of the kernel reaches the neighbouring cells, and most of
            the derivative at edges is lost.
        epsilon: excess of the weights' sum over one, so that the interior is always normalised.
    """

    sigma: float = SIGMA
    epsilon: float = EPSILON

    def __post_init__(self):
        if not (math.isfinite(self.sigma) and self.sigma > 0):
            raise InputError(f"sigma is {self.sigma}; expected a positive number of pixels")
        if not (math.isfinite(self.epsilon) and self.epsilon >= 0):
            raise InputError(f"epsilon is {self.epsilon}; expected a number of at least 0")

    def splat(self, positions: Array, rgba: Array, row: Array) -> Array:
        """See `rts.protocols.Splatter`."""
        positions, rgba, row = check_splats(positions, rgba, row)
        return _nothing(rgba, row) if rgba.shape[0] == 0 else self.accumulate(positions, rgba, row)

    @abc.abstractmethod
    def accumulate(self, positions: Array, rgba: Array, row: Array) -> Array:
        """`splat` of at least one sample."""

    def weights(self, position: Array) -> tuple[dict[int, Array], dict[int, Array]]:
        """Weights of cells (h, w, ·), the first being cell (−1, −1): by target offset u, and by v; w = x[u] · y[v]."""
        xp = namespace(position)
        height, width = position.shape[:2]
        constant = engine_of(position).constant
        rx = position[..., 0] - constant(np.arange(width) - 0.5, position)
        ry = position[..., 1] - constant(np.arange(height) - 0.5, position)[:, None]
        scale = 1 / (2 * self.sigma**2)
        peak = math.sqrt(1 + self.epsilon) / sum(math.exp(-(u**2) * scale) for u in OFFSETS)
        return (
            {u: peak * xp.exp(-((u - rx) ** 2) * scale) for u in OFFSETS},
            {v: peak * xp.exp(-((v - ry) ** 2) * scale) for v in OFFSETS},
        )


@dataclass(frozen=True)
class Single(Kernel):
    """One layer, occlusion ignored (paper eq. 1–3): only the front layer of `row` is splatted."""

    def accumulate(self, positions: Array, rgba: Array, row: Array) -> Array:
        """See `Kernel`."""
        xp = namespace(positions, rgba, row)
        height, width = row.shape[1:]
        cells = _bordered(row[:1])[0]
        covered = (cells >= 0)[..., None]
        wx, wy = self.weights(_unpack(positions, cells))
        color = _weighted(_unpack(rgba, cells), covered)
        total = None
        for v in OFFSETS:
            for u in OFFSETS:
                splats = _sources(color * (wx[u] * wy[v])[..., None], u, v, height, width)
                total = splats if total is None else total + splats
        return _normalised(total, xp)


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
        layers, height, width = row.shape
        cells = _bordered(row)
        position = [_unpack(positions, cells[k]) for k in range(layers)]
        color = [_weighted(_unpack(rgba, cells[k]), (cells[k] >= 0)[..., None]) for k in range(layers)]
        weights = [self.weights(p) for p in position]
        depth = _depths(position, cells)
        target = [_sources(z, 0, 0, height, width) for z in depth]

        buffers: list[Array | None] = [None, None, None]
        for v in OFFSETS:
            for u in OFFSETS:
                source = [_sources(z, u, v, height, width) for z in depth]
                s = _pairing(source, target, xp)
                for k in range(layers):
                    wx, wy = weights[k]
                    splats = _sources(color[k] * (wx[u] * wy[v])[..., None], u, v, height, width)
                    for i, chosen in enumerate((s > k, s == k, s < k)):
                        share = xp.where(chosen[..., None], splats, 0.0)
                        buffers[i] = share if buffers[i] is None else buffers[i] + share
        front, surface, behind = (_normalised(b, xp) for b in buffers)
        return _over(front, _over(surface, behind))


def check_splats(positions: Array, rgba: Array, row: Array) -> tuple[Array, Array, Array]:
    """The three as arrays of one engine; wrong shapes and dtypes are refused."""
    given = tuple(from_numbers(x) for x in (positions, rgba))
    row = np.asarray(row, np.int32) if isinstance(row, (list, tuple)) else row
    shapes = [tuple(getattr(x, "shape", ())) for x in (*given, row)]
    ok = len(shapes[0]) == 2 and shapes[0][1] == 3 and shapes[1] == (shapes[0][0], 4) and len(shapes[2]) == 3
    if not ok or shapes[2][0] < 1:
        raise InputError(
            f"positions, rgba and row have shapes {shapes[0]}, {shapes[1]}, {shapes[2]}; "
            f"expected (N, 3), (N, 4), (K, H, W)"
        )
    if not namespace(row).isdtype(row.dtype, "signed integer"):
        raise InputError(f"row has dtype {row.dtype}; expected signed integers, -1 where a cell is empty")
    positions, rgba, row = constants((*given, row), engine_of(given, row), exemplar(given))
    return positions, rgba, row


def _nothing(rgba: Array, row: Array) -> Array:
    xp = namespace(rgba, row)
    return xp.stack([xp.zeros_like(row[0], dtype=rgba.dtype)] * 4, axis=-1)


def _unpack(values: Array, cells: Array) -> Array:
    """(h, w, C) of packed values (N, C); an empty cell gets those of row 0, to be masked."""
    xp = namespace(values, cells)
    index = xp.reshape(xp.where(cells >= 0, cells, 0), (-1,))
    return xp.reshape(xp.take(values, index, axis=0), (*cells.shape, values.shape[1]))


def _bordered(row: Array) -> Array:
    """`row` with a border of one empty cell."""
    xp = namespace(row)
    side = xp.full_like(row[:, :, :1], -1)
    row = xp.concat([side, row, side], axis=2)
    end = xp.full_like(row[:, :1, :], -1)
    return xp.concat([end, row, end], axis=1)


def _sources(cells: Array, u: int, v: int, height: int, width: int) -> Array:
    """For each target of the image, the bordered cell whose splat reaches it with offset (u, v)."""
    return cells[1 - v : 1 - v + height, 1 - u : 1 - u + width, ...]


def _weighted(rgba: Array, covered: Array) -> Array:
    """(h, w, 5): colour, and 1 to count the weights; zero where not covered."""
    xp = namespace(rgba)
    return xp.where(covered, xp.concat([rgba, xp.ones_like(rgba[..., :1])], axis=-1), 0.0)


def _normalised(total: Array, xp: Any) -> Array:
    """Accumulated colours over their weights, which are taken as at least one (paper eq. 3)."""
    return total[..., :4] / xp.clip(total[..., 4:], 1.0, None)


def _depths(position: list[Array], cells: Array) -> list[Array]:
    """Depths of each layer; an empty cell lies beyond everything, at a distance of the scene's own scale."""
    xp = namespace(cells)
    covered = [cells[k] >= 0 for k in range(len(position))]
    depth = [xp.where(c, p[..., 2], 0.0) for c, p in zip(covered, position, strict=True)]
    farthest = 2 * xp.max(xp.abs(xp.stack(depth)))
    return [xp.where(c, z, xp.where(farthest > 0, farthest, 1.0)) for c, z in zip(covered, depth, strict=True)]


def _pairing(source: list[Array], target: list[Array], xp: Any) -> Array:
    """S of each target for one of its sources."""
    a, best_a = _first_minimum([xp.abs(z - target[0]) for z in source], xp)
    b, best_b = _first_minimum([xp.abs(z - source[0]) for z in target], xp)
    return xp.where(best_b < best_a, -b, a)


def _first_minimum(values: list[Array], xp: Any) -> tuple[Array, Array]:
    """Index and value of the first smallest of some images."""
    best, index = values[0], xp.zeros_like(values[0], dtype=xp.int32)
    for k, value in enumerate(values[1:], start=1):
        smaller = value < best
        best, index = xp.where(smaller, value, best), xp.where(smaller, k, index)
    return index, best


def _over(front: Array, back: Array) -> Array:
    """Premultiplied compositing (Porter and Duff 1984)."""
    return front + (1 - front[..., 3:]) * back
