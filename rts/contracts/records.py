"""The records that pass from one stage of rendering to the next.

Shapes use these letters: N packed samples, K layers front to back, H × W pixels (row 0 on top), V vertices,
T triangles, I integers and P reals a sample, C channels. Conventions of space are in `rts.scene.camera`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple, Self

import numpy as np

from rts.arrays.engines import namespace
from rts.arrays.trees import Array, record


class ArraySpec(NamedTuple):
    """The shape and dtype of one array that a host function returns.

    Attributes:
        shape: the shape, or the largest one where `packed`.
        dtype: a NumPy dtype.
        packed: whether the first axis counts samples and may come back shorter; an engine that needs fixed shapes pads
            it with zeros.
        by_sample: for tables of a surface: whether the table has a row for each sample, which moves with the sample.
    """

    shape: tuple[int, ...]
    dtype: Any
    packed: bool = False
    by_sample: bool = False


class Proxy(NamedTuple):
    """Triangles that stand for a surface while it is sampled. Host arrays.

    Attributes:
        vertices: (V, 3) float32, local space.
        faces: (T, 3) int32.
        ids: (T, I) int32, handed on to the samples of the triangle. None means `faces`; or no ids, if I = 0 and the
            surface has no `refine`.
        corner_params: (T, 3, P) float32, interpolated with the barycentrics; None means the barycentrics themselves.
        corners: (T, 3) int32, alike for two triangles at a vertex where these have the same attributes; None means
            `faces`. Where they differ at an edge there is a seam, across which colours may change.
    """

    vertices: np.ndarray
    faces: np.ndarray
    ids: np.ndarray | None = None
    corner_params: np.ndarray | None = None
    corners: np.ndarray | None = None


class Fragments(NamedTuple):
    """The triangles that rays through cells' centres meet, as a triangle sampler finds them. Host arrays.

    Attributes:
        triangle_ids: (K, H, W) int32 front to back, −1 where a cell has no such layer.
        barycentrics: (K, H, W, 2) float32, the weights of the triangle's first two corners, perspective-correct.
        depth: (K, H, W) float32, linear distance along the camera's axis; 0 where empty.
    """

    triangle_ids: np.ndarray
    barycentrics: np.ndarray
    depth: np.ndarray


class RayHits(NamedTuple):
    """The K nearest hits of R rays with a surface that intersects rays itself.

    Attributes:
        hit: (K, R) bool, true where hit k exists; the hits of a ray come before its empty layers.
        distance: (K, R) float: the hit is at `origin + distance * direction`; any finite number where there is none.
        params: (K, R, P) float, the `Samples.params` of each hit, for `evaluate`; finite where there is no hit, too.
        ids: (K, R, I) int32, or None for I = 0.
        entering: (K, R) bool, true where the ray enters the inside of a solid at the hit; None for surfaces without an
            inside. Outlines then move as `RaySurface.deepest` tells.
    """

    hit: Array
    distance: Array
    params: Array
    ids: Array | None = None
    entering: Array | None = None


ON_RAYS = "points on rays"
"""Name of a table (N, 3) float32, for samples that are not centred: points of the cells' rays at the samples' depths,
local space."""


@record()
class Cells:
    """The samples in the cells of a grid, front to back, as indices of packed rows.

    Attributes:
        row: (K, H, W) int32, the index of the sample in each cell, or −1 for none.
        depth: (K, H, W) float32, linear camera depth; 0 where `row` is −1. None where positions hold it.
        triangle: (K, H, W) int32, the triangle of the proxy that the sample lies on; −1 where `row` is. None if it was
            not requested, or if samples left their triangles.
    """

    row: Array
    depth: Array | None = None
    triangle: Array | None = None

    def map(self, f: Callable[[Array], Array]) -> Cells:
        """The cells with `f` applied to each array; `f` sees axes (..., H, W), and None stays None."""
        return Cells(f(self.row), *(None if x is None else f(x) for x in (self.depth, self.triangle)))

    def first(self, layers: int) -> Cells:
        """The cells with only their first layers."""
        return self.map(lambda x: x[:layers, ...])


class _OnCells:
    """Base of records with a field `cells`, whose arrays read and replace as if they were the record's own."""

    cells: Cells

    # `torch.compile` traces functions, not `operator.attrgetter`.
    row = property(lambda self: self.cells.row, doc="See `Cells`.")
    depth = property(lambda self: self.cells.depth, doc="See `Cells`.")
    triangle = property(lambda self: self.cells.triangle, doc="See `Cells`.")

    def replace(self, **changes: Any) -> Self:
        """A copy with some fields changed; fields of `cells` may be named directly."""
        cell_changes: dict[str, Any] = {name: changes.pop(name) for name in _OF_CELLS & changes.keys()}
        if cell_changes:
            changes["cells"] = replace(changes.get("cells", self.cells), **cell_changes)
        return replace(self, **changes)  # pyright: ignore[reportArgumentType, reportReturnType, reportCallIssue]


_OF_CELLS = {f.name for f in fields(Cells)}


@record(static=("gbuffer_names", "centered", "by_sample", "at_points"))
class Samples(_OnCells):
    """The points where rays meet the surface of one part: the paper's U, packed.

    Attributes:
        ids: (N, I) int32, such as the vertices of a triangle.
        params: (N, P) float32, such as barycentrics; in θ's own dtype if they were computed on the device.
        cells: the index of the sample in each cell.
        overflow: () int32, samples that did not fit into the capacity and were dropped, deepest layers first.
        tables: further arrays of the surface by name, filled by its `refine`. If samples share one (see `by_sample`),
            all `ids` are rows of it, so that samples can be joined.
        gbuffer: the evaluated G-buffer if the surface's θ is constant, else None.
        gbuffer_names: names of the entries requested when `gbuffer` was evaluated; None for all.
        centered: whether the samples reproject to the centres of their cells. Others have a table `ON_RAYS`.
        by_sample: names of the tables that have a row for each sample; other tables are shared by all.
        at_points: whether the samples lie at `Request.points`, as requested, not at the centres of cells.
        incomplete_cells: () int32, number of cells where triangles ran out before K samples of a refined surface were
            found; None for a surface that is not refined.
        pair: (2, M) int32, of M points: the indices of two further samples, not in `row`, beside the deepest point of
            the point's ray, where the field that it crosses is least; −1 for none. The mean of their motions is that
            of the outline. None if not requested, or not known.
    """

    ids: Array
    params: Array
    cells: Cells
    overflow: Array
    tables: Mapping[str, Array] = field(default_factory=dict)
    gbuffer: Mapping[str, Array] | None = None
    gbuffer_names: tuple[str, ...] | None = None
    centered: bool = True
    by_sample: tuple[str, ...] = ()
    at_points: bool = False
    incomplete_cells: Array | None = None
    pair: Array | None = None


@dataclass(frozen=True)
class Request:
    """Options of a call of a sampler, which may ignore all but `capacity`.

    Attributes:
        capacity: number of packed rows to allot, or None for as many as there are samples.
        points: (M, 2) float64, M > 0, x and y in cells from the grid's upper left corner: the only points to sample, in
            place of the centres of cells. Cells of the samples are then (K, 1, M), and `Samples.at_points` is true.
            None for centres.
        pairs: whether to compute `Samples.pair` of `points`, just inside of outlines, of surfaces that tell how these
            move.
        triangles: whether to record `Cells.triangle`.
        uniform: whether all samples of the part look alike, so that one row may stand for all cells.
        entry: the result of `Sampler.prepare_part` for this part; None where nothing was prepared.
    """

    capacity: int | None = None
    points: Array | None = None
    pairs: bool = False
    triangles: bool = False
    uniform: bool = False
    entry: Any = None


REACH = 6
"""The most rows from a segment to the one in `Outlines.hub`."""

OF_SEGMENTS = frozenset({"square", "ties", "square_sides", "hub", "beyond", "corner", "pull"})
"""The fields of `Outlines` that have a row for each segment."""

OF_SAMPLES = ("rows", "inner", "pair", "stack")
"""The fields of `Outlines` that hold indices of samples."""


@record()
class Outlines:
    """Outlines between the centres of cells: places where a front ends, joined into segments. They have no derivative.

    A gap lies between two neighbouring centres, along a row or a column. Each place in a gap where the front changes to
    another surface, or across a seam, is a break. Four neighbouring centres are the corners of a square; breaks on its
    sides are joined into segments.

    Attributes:
        place: (B,) float64, the place of each break along its gap: 0 at the first centre, 1 at the second.
        gap: (B, 3) int32: the cell (y, x) of the gap's first centre, and 1 for a gap along a row, 0 along a column.
        rows: (B, 2) int32, indices of the last samples before and behind each break, along its gap, or −1. Breaks move
            as they do.
        points: (B, 2) float64, the places of these samples along the gap.
        inner: (B, 2) int32, indices of samples of the same surfaces a little farther from the break, or −1. They tell
            colours: in the last hair before an outline normals may turn away, and colours with them. All are −1 where
            each part has one colour; and where nothing moves, since `rows` and `points` are then those of colours.
        pair: (B, 2) int32, indices of two samples on the ray of the last sample of the surface that ends, beside its
            deepest point, or −1: the break moves as their mean (`RaySurface.deepest`). A single sample does not tell
            how a kink of a field moves.
        near: (B,) int32, 0 if the surface before the break ends there, 1 if the one behind it does, 2 where two
            surfaces pass through one another; at seams 0, where a surface goes on and its colours may change.
        slope: (B, 2, 2) float64, slopes of depth along x and y of both samples, where `near` is 2; else 0.
        ends: (B, 2) bool: is this the gap's first break, and its last?
        square: (S, 2) int32, the first corner (y, x) of each segment's square.
        ties: (S, 2) int32, the two breaks of each segment; the near surface lies to the right of the way from one to
            the other. −1 in second place if a break is alone. A segment from a break to itself has no effect.
        square_sides: (S, 2) int32, the sides of the square that these lie on: 0 top, 1 right, 2 bottom, 3 left; or −1.
        hub: (S,) int32, how many rows farther on there is the segment, of the same square, that the outline of a lone
            break ends at, or that this one crosses; 0 for none. It does so at its `corner`. Then `beyond` has the
            breaks of that segment, and `pull` weights of their motions, first and last, whose sum is about the motion
            of that segment's corner. Lone breaks with no segment beside them have the first of them as their hub.
        beyond: (S, 2) int32, the breaks along the same outline before and after these two; −1 for none.
        corner: (S, 2) float64, a point between the two where the outline turns: x and y from the square's first centre.
        pull: (S, 4) float64, weights of the motions of the break before, of these two, and of the one after, whose sum
            is the motion of the corner.
        joined: (2, H, W) bool: does the front of each cell go on to the next one's, along x and along y? Of several
            layers, do all that are seen?
        stack: (B, 2, K) int32, indices of samples of the K layers before and behind each break, front to back, or −1.
            Then `near` is about the layer that ends there, `rows` has a sample only where it is, or two where layers
            cross, and `inner` has no meaning. None for one layer.
        stack_points: (B, 2, K) float64, the places of these samples along the gap; None for one layer.
    """

    place: Array
    gap: Array
    rows: Array
    points: Array
    inner: Array
    pair: Array
    near: Array
    slope: Array
    ends: Array
    square: Array
    ties: Array
    square_sides: Array
    hub: Array
    beyond: Array
    corner: Array
    pull: Array
    joined: Array
    stack: Array | None = None
    stack_points: Array | None = None

    def with_rows(self, f: Callable[[Array], Array]) -> Outlines:
        """The outlines with `f` applied to all indices of samples: (B, 2), and (B, 2, K) of stacks."""
        indices = {name: getattr(self, name) for name in OF_SAMPLES}
        return replace(self, **{name: f(x) for name, x in indices.items() if x is not None})


@record(static=("supersample", "apron"))
class Sampled(_OnCells):
    """A sampled scene, the result of `rts.sample` and the input of `rts.render_samples`.

    The grid has an apron of cells around the image, so that samples just outside can splat into it. Here H and W are
    the image's, times `supersample`, plus twice the apron.

    Attributes:
        samples: one `Samples` for each part. Parts that were sampled at once have no cells of their own.
        cells: the index of the sample in each cell, counted over all parts in order.
        overflow: () int32, number of samples dropped for want of capacity, or beyond the limit of `layers="auto"`.
            Should be 0.
        supersample: s; each pixel has s² cells.
        apron: cells at each side of the image; a splatter that reaches r cells needs r + 1.
        outlines: outlines between centres, for splatters that read them, or None. Their samples are rows of each part
            behind those of cells.
    """

    samples: tuple[Samples, ...]
    cells: Cells
    overflow: Array
    supersample: int = 1
    apron: int = 2
    outlines: Outlines | None = None

    @property
    def one_part(self) -> bool:
        """True for a scene of one part."""
        return len(self.samples) == 1

    @property
    def part(self) -> Array:
        """(K, H, W) int32, the part of the sample in each cell and layer, or −1."""
        xp, first = namespace(self.row), 0
        part_of_cells = xp.clip(self.row, None, 0)
        for samples in self.samples[:-1]:
            first += samples.ids.shape[-2]
            part_of_cells = part_of_cells + xp.astype(self.row >= first, self.row.dtype)
        return part_of_cells


@record(static=("border", "opaque"))
class Splats(_OnCells):
    """Shaded samples in their cells, the input of a splatter.

    Optional fields carry more about the scene, where it is known. A splatter may ignore them.

    Attributes:
        positions: (N, 3) x and y in cells from the corner of the grid, border included, and linear depth;
            differentiable.
        rgba: (N, 4) premultiplied, of the engine of the positions; differentiable. Where shaders give other numbers of
            channels, (N, C + 1): splatters are given three of them at a time, and alpha, or all (`any_channels`).
        cells: the index of the sample in each cell, without depth; arrays of the positions' engine.
        border: cells at each side that splat into the image but are no part of it.
        opaque: a promise that alpha is 1 at all samples.
        outlines: outlines between centres, if the splatter reads them; arrays of the positions' engine.
    """

    positions: Array
    rgba: Array
    cells: Cells
    border: int = 0
    opaque: bool = True
    outlines: Outlines | None = None
