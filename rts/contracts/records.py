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
        vertices: (V, 3) float32, local space less `origin`. Surfaces may give float64: such vertices that lie far from
            the origin of local space, as map coordinates do, are rounded to float32 only after an origin near them is
            subtracted.
        faces: (T, 3) int32.
        ids: (T, I) int32, handed on to the samples of the triangle. None means `faces`; or no ids, if I = 0 and the
            surface has no `refine`.
        corner_params: (T, 3, P) float32, interpolated with the barycentrics; None means the barycentrics themselves.
        corners: (T, 3) int32, alike for two triangles at a vertex where these have the same attributes; None means
            `faces`. Where they differ at an edge there is a seam, across which colours may change.
        origin: (3,) float64, what the library has subtracted from the vertices; None for nothing, as surfaces give it.
            Samplers are told nothing of it: their camera is that of `seen_by`.
    """

    vertices: np.ndarray
    faces: np.ndarray
    ids: np.ndarray | None = None
    corner_params: np.ndarray | None = None
    corners: np.ndarray | None = None
    origin: np.ndarray | None = None

    def seen_by(self, camera: Any) -> Any:
        """The camera in the space of `vertices`, from that in local space; host matrices, float64."""
        if self.origin is None:
            return camera
        view = camera.view.copy()
        view[:3, 3] += view[:3, :3] @ self.origin
        return camera.replace(view=view)


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
        entry: the result of `Sampler.prepare_part` for this part; None where nothing was prepared.
    """

    capacity: int | None = None
    points: Array | None = None
    pairs: bool = False
    triangles: bool = False
    entry: Any = None


OF_SAMPLES = ("color_sample", "motion_sample", "motion_colors")
"""The fields of `Stencil` that hold indices of samples, if it has no stacks."""


@record()
class Stencil:
    """An image as a sparse matrix times colours, and its derivative as another one times motions.

        image    of a cell  =  colour of its front sample  +  Σ weight · colour
        d image  of a cell  =  the same of d colours  +  Σ (weight · d position) (colour − other)  −  ∇C · d position

    The sums are over entries, which only cells beside outlines have. ∇C, the slope of colours at the cell, is the mean
    of the differences from and to the next cells that are joined to it; the last term is that of its front sample. What
    is multiplied by d position is constant. The weights of a cell, with the 1 of its front sample, are at least 0, and
    their sum is at most 1.

    Entries are sorted by cell. Those of weight 0 at the end have no effect. An index −1 stands for nothing, whose
    colour is 0.

    Attributes:
        joined: (2, H, W) bool: does the surface in front of each cell go on to the next one's, along x and along y? Of
            several layers, do all that are seen?
        color_cell: (E,) int32, the cell, y · W + x, of each entry of colours.
        color_sample: (E,) int32, the sample whose colour it weighs.
        color_weight: (E,) of θ's dtype.
        motion_cell: (F,) int32, the cell of each entry of motions.
        motion_sample: (F,) int32, the sample that moves.
        motion_weight: (F, 3) of θ's dtype: cells per cell along x and y, and per unit of depth.
        motion_colors: (F, 2) int32, the samples of both colours, or −1.
        stacks: (R, K) int32, where light passes through some part: samples of further stacks, front to back, or −1.
            Then colours are composites, and `color_sample` and `motion_colors` count those of all H · W cells, then
            these. None if all is opaque.
    """

    joined: Array
    color_cell: Array
    color_sample: Array
    color_weight: Array
    motion_cell: Array
    motion_sample: Array
    motion_weight: Array
    motion_colors: Array
    stacks: Array | None = None

    def with_samples(self, f: Callable[[Array], Array]) -> Stencil:
        """The stencil with `f` applied to all indices of samples."""
        names = ("motion_sample", "stacks") if self.stacks is not None else OF_SAMPLES
        return replace(self, **{name: f(getattr(self, name)) for name in names})

    def samples(self) -> list[Array]:
        """All arrays that hold indices of samples."""
        names = ("motion_sample", "stacks") if self.stacks is not None else OF_SAMPLES
        return [getattr(self, name) for name in names]


@record(static=("supersample", "border"))
class Sampled(_OnCells):
    """A sampled scene, the result of `rts.sample` and the input of `rts.render_samples`.

    The grid has a border of cells around the image, so that samples just outside can splat into it. Here H and W are
    the image's, times `supersample`, plus twice the border.

    Attributes:
        samples: one `Samples` for each part. Parts that were sampled at once have no cells of their own.
        cells: the index of the sample in each cell, counted over all parts in order.
        overflow: () int32, number of samples dropped for want of capacity, or beyond the limit of `layers="auto"`.
            Should be 0.
        supersample: s; each pixel has s² cells.
        border: cells at each side of the image; a splatter that reaches r cells needs r + 1.
        stencil: areas and boundary terms beside outlines, for splatters that read them, or None. Its samples are rows
            of each part behind those of cells.
    """

    samples: tuple[Samples, ...]
    cells: Cells
    overflow: Array
    supersample: int = 1
    border: int = 2
    stencil: Stencil | None = None

    @property
    def part(self) -> Array:
        """(K, H, W) int32, the part of the sample in each cell and layer, or −1."""
        xp, first = namespace(self.row), 0
        part_of_cells = xp.clip(self.row, None, 0)
        for samples in self.samples[:-1]:
            first += samples.ids.shape[-2]
            part_of_cells = part_of_cells + xp.astype(self.row >= first, self.row.dtype)
        return part_of_cells


@record(static=("border", "opaque", "supersample"))
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
        stencil: areas and boundary terms beside outlines, if the splatter reads them; arrays of the positions' engine.
        supersample: s; each pixel is the mean of s² cells, which a splatter's `cropped` may take itself.
    """

    positions: Array
    rgba: Array
    cells: Cells
    border: int = 0
    opaque: bool = True
    stencil: Stencil | None = None
    supersample: int = 1
