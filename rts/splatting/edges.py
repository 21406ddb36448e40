"""The splatter of found edges: a sparse matrix times colours, which comes with the samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import averaged, without_border
from rts.arrays.engines import engine_of, floating_bits, namespace
from rts.arrays.trees import Array, collected, map_leaves
from rts.contracts.records import ArraySpec, Splats, Stencil
from rts.contracts.splatter import SummingSplatter
from rts.errors import InputError
from rts.plugin_base import overrides
from rts.splatting.cells import check_rows, nothing
from rts.splatting.layers import composites
from rts.splatting.stencil import splat


@dataclass(unsafe_hash=True)
class Edges(SummingSplatter):
    """Found edges: sharp inside, area averages at outlines. One layer suffices where all is opaque.

    An image is `Splats.stencil` times the colours of samples. Where light passes through, layers are composited first,
    and each outline that is seen moves with its own layer.

    Attributes:
        colors: "outlines" takes colours beside outlines from samples there. "centers" takes them from the centres of
            pixels beside, on surfaces that reach these, so that an expensive shader is given fewer samples; where light
            passes through it has no effect.
    """

    colors: Literal["outlines", "centers"] = "outlines"

    layers = 1
    reads = frozenset({"outlines"})
    translucent = True
    any_channels = True

    def __post_init__(self):
        if self.colors not in ("outlines", "centers"):
            raise InputError(f"colors is {quoted(self.colors)}; expected 'outlines' or 'centers'")
        if self.colors == "centers":
            self.reads = frozenset({"outlines", "colors at centers"})

    def image(self, splats: Splats) -> Array:
        """See `rts.Splatter`; without `Splats.stencil`, an image without edges."""
        return self._image(splats, 0, 1)

    def cropped(self, splats: Splats) -> Array:
        """See `rts.Splatter`; drawn without the border, of pixels, unless it has an `image` of its own."""
        own = "image" in vars(self) or overrides(self, "image", Edges)
        return super().cropped(splats) if own else self._image(splats, splats.border, splats.supersample)

    def _image(self, splats: Splats, border: int, side: int) -> Array:
        """The image without `border` cells at each side, of pixels of `side`² cells."""
        positions, rgba, row, stencil = splats.positions, splats.rgba, splats.row, splats.stencil
        if rgba.shape[0] == 0:
            return averaged(without_border(nothing(rgba, row), border), side)
        if stencil is None:
            row = row[:1, ...] if splats.opaque else row
            stencil = _without_outlines(row, rgba)
        if stencil.stacks is None:
            return splat(positions, rgba, row[0, ...], stencil, border, side)
        check_rows(row, rgba.shape[0])
        check_rows(stencil.stacks, rgba.shape[0], "stencil.stacks")
        colors, front, motion = composites(positions, rgba, row, stencil)
        still = engine_of(row).constant(np.zeros((2, *row.shape[1:]), bool), row)
        image = splat(positions, colors, front, stencil, border, side, joined=still)
        return image + averaged(without_border(motion, border), side)

    def normal_equations(
        self,
        splats: Splats,
        t_positions: Array,
        t_rgba: Array | None,
        target: Array,
        weights: Array | None = None,
        background: Array | None = None,
        loss: Any = None,
    ) -> tuple[Array, Array, Array] | None:
        """See `SummingSplatter`; None without a stencil, and where light passes through."""
        stencil, row, engine = splats.stencil, splats.row, engine_of(splats.positions)
        if stencil is None or stencil.stacks is not None or splats.rgba.shape[0] == 0:
            return None
        tree = splats.positions, splats.rgba, row[0, ...], stencil, t_positions, t_rgba, target, weights, background
        operands = collected(tree)

        def host(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
            from rts.splatting.normal_equations import normal_equations

            it = iter(arrays)
            return normal_equations(*map_leaves(lambda _: next(it), tree), border=splats.border, loss=loss)

        count, dtype = t_positions.shape[0], np.float64 if floating_bits(splats.positions) == 64 else np.float32
        specs = ArraySpec((), dtype), ArraySpec((count, count), dtype), ArraySpec((count,), dtype)
        return engine.call_host(host, specs, *operands)


def _without_outlines(row: Array, like: Array) -> Stencil:
    """A stencil without entries, as if all cells of `row` (K, H, W) showed one surface, or the same layers."""
    engine, covered = engine_of(row), row[0, ...] >= 0
    none, pair = np.zeros(0, np.int32), np.zeros((0, 2), np.int32)
    none, pair, stacks = (engine.constant(x, row) for x in (none, pair, np.zeros((0, row.shape[0]), np.int32)))
    real, rates = (engine_of(like).constant(np.zeros(shape, np.float32), like) for shape in ((0,), (0, 3)))
    several = row.shape[0] > 1
    return Stencil(_all_joined(covered), none, none, real, none, none, rates, pair, stacks if several else None)


def _all_joined(covered: Array) -> Array:
    """`Stencil.joined` as if all covered cells (H, W) showed one surface."""
    xp = namespace(covered)
    right, below = (xp.roll(covered, -1, axis=axis) & covered for axis in (1, 0))
    inside = np.ones((2, *covered.shape), bool)
    inside[0, :, -1], inside[1, -1] = False, False  # Nothing follows the last cells.
    return xp.stack([right, below]) & engine_of(covered).constant(inside, covered)
