"""The splatter of found edges; `specification` is its rule."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields
from typing import Any, Literal

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import without_border
from rts.arrays.engines import engine_of, floating_bits
from rts.arrays.trees import Array, collected, map_leaves
from rts.contracts.records import ArraySpec, Outlines, Splats
from rts.contracts.splatter import SummingSplatter
from rts.errors import InputError
from rts.operations.operation import Operation
from rts.plugin_base import overrides
from rts.splatting.cells import check_rows, nothing
from rts.splatting.edges import weights as edges_weights
from rts.splatting.edges.specification import all_joined, specification
from rts.splatting.edges.stacks import Operands, in_cells

FIELDS = tuple(field.name for field in fields(Outlines) if field.default is MISSING)
"""The fields of outlines that the operation takes: those of one layer."""


def _fields_of(outlines: Outlines) -> list[Array]:
    return [getattr(outlines, name) for name in FIELDS]


@dataclass(unsafe_hash=True)
class Edges(SummingSplatter):
    """Found edges: sharp inside, area averages at outlines. One layer suffices where all is opaque.

    Where light passes through, layers are composited, and each outline that is seen moves with its own layer; see
    `rts.splatting.edges.stacks`.

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
        """See `rts.Splatter`; without `Splats.outlines`, an image without edges."""
        return self._image(splats, 0)

    def cropped(self, splats: Splats) -> Array:
        """See `rts.Splatter`; drawn without the border, unless it has an `image` of its own."""
        own = "image" in vars(self) or overrides(self, "image", Edges)
        return super().cropped(splats) if own else self._image(splats, splats.border)

    def _image(self, splats: Splats, border: int) -> Array:
        """The image without `border` cells at each side."""
        positions, rgba, row = splats.positions, splats.rgba, splats.row
        if rgba.shape[0] == 0:
            return without_border(nothing(rgba, row), border)
        check_rows(row, rgba.shape[0])
        outlines = splats.outlines
        if outlines is None:
            return without_border(_without_outlines(splats), border)
        check_rows(outlines.rows, rgba.shape[0], "outlines.rows")
        check_rows(outlines.inner, rgba.shape[0], "outlines.inner")
        check_rows(outlines.pair, rgba.shape[0], "outlines.pair")
        if outlines.stack is None:
            return EDGES(positions, rgba, row[0, ...], *_fields_of(outlines), border=border)
        check_rows(outlines.stack, rgba.shape[0], "outlines.stack")
        whole = Operands.of(splats, outlines)
        image = EDGES(whole.positions, whole.rgba, whole.row, *_fields_of(whole.outlines), border=border)
        return image + without_border(whole.motion, border)

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
        """See `SummingSplatter`; None without outlines, and where light passes through."""
        outlines, engine = splats.outlines, engine_of(splats.positions)
        tree = (
            splats.positions,
            splats.rgba,
            splats.row[0, ...],
            outlines,
            t_positions,
            t_rgba,
            target,
            weights,
            background,
        )
        operands = collected(tree)
        if outlines is None or outlines.stack is not None or splats.rgba.shape[0] == 0:
            return None

        def host(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
            it = iter(arrays)
            positions, rgba, row, found, *tangents_and_fields = map_leaves(lambda _: next(it), tree)
            known = positions, rgba, row, *_fields_of(found)
            return edges_weights.normal_equations(known, tuple(tangents_and_fields), splats.border, loss)

        count, dtype = t_positions.shape[0], np.float64 if floating_bits(splats.positions) == 64 else np.float32
        specs = ArraySpec((), dtype), ArraySpec((count, count), dtype), ArraySpec((count,), dtype)
        return engine.call_host(host, specs, *operands)


def _without_outlines(splats: Splats) -> Array:
    """The image (H, W, C) as if all cells showed one surface, or stacks of the same layers."""
    row = splats.row[:1, ...] if splats.opaque else splats.row
    colors, motion = in_cells(splats.positions, splats.rgba, row, all_joined(row[0, ...] >= 0))
    return colors + motion


def _shape(
    positions: tuple[int, ...], rgba: tuple[int, ...], row: tuple[int, ...], *_: Any, border: int
) -> tuple[int, ...]:
    return *(max(0, n - 2 * border) for n in row), rgba[1]


EDGES = Operation(
    "rts.edges",
    specification,
    ranks=(2, 2, 2, 1, 2, 2, 2, 2, 2, 1, 3, 2, 2, 2, 2, 1, 2, 2, 2, 3),
    shape=_shape,
    forward=edges_weights.forward,
    push=edges_weights.push,
    pull=edges_weights.pull,
    differentiable=2,
    keeps=True,
    crosses=True,
)
"""The image (h, w, C) of positions (N, 3), colours (N, C), `row` (H, W), and the fields of `Outlines`, without a
`border` of so many cells."""
