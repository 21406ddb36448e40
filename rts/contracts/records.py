"""The records that pass from one stage of rendering to the next.

Shapes use these letters: N packed samples, K layers front to back, H × W pixels (row 0 on top), V vertices,
T triangles, I integers and P reals a sample, C channels. Conventions of space are in `rts.scene.camera`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from operator import attrgetter
from typing import Any, ClassVar, NamedTuple, Protocol, Self

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
        ids: (T, I) int32, handed on to the samples of the triangle; None means `faces`, or none where I = 0 and
            the surface has no `refine`.
        corner_params: (T, 3, P) float32, interpolated with the barycentrics; None means the barycentrics themselves.
    """

    vertices: np.ndarray
    faces: np.ndarray
    ids: np.ndarray | None = None
    corner_params: np.ndarray | None = None


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
    """Where R rays meet a surface that intersects them itself, nearest first, K for each.

    Attributes:
        hit: (K, R) bool, whether there is such a hit; those of a ray come first.
        distance: (K, R) float: the hit is at `origin + distance * direction`; any finite number where there is none.
        params: (K, R, P) float, what `evaluate` finds in `Samples.params`; finite where there is no hit, too.
        ids: (K, R, I) int32, or None for I = 0.
    """

    hit: Array
    distance: Array
    params: Array
    ids: Array | None = None


ON_RAYS = "points on rays"
"""The table (N, 3) float32 of samples that are not centred: the points of cells' rays at their depth, local space."""


@record()
class Cells:
    """What the cells of a grid hold: samples, by number, front to back.

    Attributes:
        row: (K, H, W) int32, the sample in each cell, or −1.
        depth: (K, H, W) float32, linear camera depth; 0 where `row` is −1. None where positions tell it.
        facing: (K, H, W) int16, the number of the piece of surface that is seen in each cell, from 1 on, negative where
            it is seen from behind; 0 where that is not known or not of interest. Pieces are consistently oriented: what
            is seen from opposite sides in two neighbouring cells is not one sheet. Numbers are larger by `MORE_BEHIND`
            in the last layer of cells whose K layers are all covered. None where no sides are told.
        exit: (H, W) int32, the sample where the ray leaves the closed part behind its front, or −1: a row of its own,
            which `row` does not name, in cells at outlines and beside them. None where no exits are told.
        settled: (H, W) integers, the sample whose colour the cell shows, whatever moves; −1 where it may change.
            Settled cells may have no sample, as cells around them that affect no others. Where they or the eight
            around them have some, these have that colour. None where no samples were left out for it.
    """

    MORE_BEHIND: ClassVar[int] = 1 << 14

    row: Array
    depth: Array | None = None
    facing: Array | None = None
    exit: Array | None = None
    settled: Array | None = None

    def map(self, f: Callable[[Array], Array]) -> Cells:
        """The cells with a function applied to each array that is there; `f` sees axes (..., H, W)."""
        arrays = (self.row, self.depth, self.facing, self.exit, self.settled)
        return Cells(*(None if x is None else f(x) for x in arrays))  # pyright: ignore[reportArgumentType]

    def first(self, layers: int) -> Cells:
        """The cells with the first layers alone."""
        own = (None if x is None else x[:layers, ...] for x in (self.row, self.depth, self.facing))
        return Cells(*own, exit=self.exit, settled=self.settled)  # pyright: ignore[reportArgumentType]


class _OnCells:
    """Records with `cells`, whose arrays can be read and replaced as if they were the record's own."""

    cells: Cells

    row = property(attrgetter("cells.row"), doc="See `Cells`.")
    depth = property(attrgetter("cells.depth"), doc="See `Cells`.")
    facing = property(attrgetter("cells.facing"), doc="See `Cells`.")
    exit = property(attrgetter("cells.exit"), doc="See `Cells`.")
    settled = property(attrgetter("cells.settled"), doc="See `Cells`.")

    def replace(self, **changes: Any) -> Self:
        """A copy with some fields changed, those of `cells` among them."""
        own: dict[str, Any] = {name: changes.pop(name) for name in _OF_CELLS & changes.keys()}
        if own:
            changes["cells"] = replace(changes.get("cells", self.cells), **own)
        return replace(self, **changes)  # pyright: ignore[reportArgumentType, reportReturnType, reportCallIssue]


_OF_CELLS = {f.name for f in fields(Cells)}


ON_RAYS = "points on rays"
"""The table (N, 3) float32 of samples that are not centred: the points of cells' rays at their depth, local space."""


@record(static=("asked", "centered", "by_sample", "followed"))
class Samples(_OnCells):
    """Where the rays of one part meet its surface: the paper's U, packed.

    Attributes:
        ids: (N, I) int32, such as the vertices of a triangle.
        params: (N, P) float32, such as barycentrics; in θ's own dtype if they were found on the device.
        cells: which of the N samples is in each cell.
        overflow: () int32, samples that did not fit into the capacity and were dropped, deepest layers first.
        tables: further arrays of the surface by name, filled by its `refine`.
        gbuffer: the evaluated G-buffer if the surface's θ is constant, else None.
        asked: the names of the entries that were wanted when `gbuffer` was evaluated; None for all.
        centered: whether the samples reproject to the centres of their cells. Others have a table `ON_RAYS`.
        by_sample: the names of the tables that have a row for each sample; other tables are shared by all.
        followed: of the fields "cells" and "hidden" of a `Request` those that were followed.
        ran_out: () int32, cells where triangles ran out before K samples of a refined surface were found; None where
            none was refined.
    """

    ids: Array
    params: Array
    cells: Cells
    overflow: Array
    tables: Mapping[str, Array] = field(default_factory=dict)
    gbuffer: Mapping[str, Array] | None = None
    asked: tuple[str, ...] | None = None
    centered: bool = True
    by_sample: tuple[str, ...] = ()
    followed: tuple[str, ...] = ()
    ran_out: Array | None = None


class Question(NamedTuple):
    """Which of these samples can reach the image? Host arrays.

    Attributes:
        covered: (K, H, W) bool, where there are samples.
        depth: (K, H, W) float, their depths; anything where nothing is covered.
        size: the largest coordinate that depths were computed from, which bounds rounding; 0 where that is not known.
    """

    covered: np.ndarray
    depth: np.ndarray
    size: float = 0.0


class Decision(NamedTuple):
    """The samples that can reach the image. Host arrays.

    Attributes:
        kept: (K, H, W) bool, the samples to make: those of `needed` but for what only settled cells need.
        settled: (H, W) int8, `Cells.settled` of a scene of one part; None where that was not asked.
        needed: (K, H, W) bool, the samples that the splatter needs.
    """

    kept: np.ndarray
    settled: np.ndarray | None
    needed: np.ndarray


class Hidden(Protocol):
    """How hidden samples are decided: by depths alone, and without memory.

    Attributes:
        settles: whether decisions tell which cells are settled.
        size: the largest number that surfaces read, which bounds rounding; 0 where that is not known.
    """

    @property
    def settles(self) -> bool:
        """See above."""
        ...

    @property
    def size(self) -> float:
        """See above."""
        ...

    def decide(self, question: Question) -> Decision:
        """The samples that can reach the image."""
        ...


@dataclass(frozen=True)
class Request:
    """What is asked of a sampler beside the nearest samples. A sampler may follow it or not, and says so in `Samples`.

    Attributes:
        capacity: number of packed rows to allot, or None for as many as there are. Every sampler follows it.
        cells: (L, C) int32, the only cells of the grid to sample, as flat indices, none twice, or −1 for none; an array
            of the part's engine, perhaps traced. Cells of the samples are then (K, L, C). None for all.
        hidden: decides which samples to keep, once depths are known; None to keep all.
        facing: whether to find `Cells.facing`, which is of interest in cells with hidden samples, and beside them.
        exits: whether to find `Cells.exit` of a part that is culled, at outlines and beside them.
        entry: what `Sampler.hold` gave for this part; None where nothing was prepared.
    """

    capacity: int | None = None
    cells: Array | None = None
    hidden: Hidden | None = None
    facing: bool = False
    exits: bool = False
    entry: Any = None


@record(static=("supersample", "apron", "flat"))
class Fine(_OnCells):
    """The fine samples of an adaptively sampled scene: cells of active pixels and an apron around them, in strips.

    Runs of strips lie side by side in one layout of h × w cells, which splatters take as they take any picture. What
    lies outside of active pixels there is no part of the image.

    Attributes:
        samples: one `Samples` for each part; their cells are those of a list.
        index: (M,) int32, the sample that each splat shows, counted over all parts in order.
        shift: (M, 3) float32, from pixel positions in the grid of fine cells to those in the layout.
        cells: which of the M splats is in each place of the layout; without depth.
        part: (K, h, w) int32, the part seen there, or −1.
        wanted: (h, w) bool, the cells of active pixels.
        pixel: (H, W) int32, for each pixel of the image which pixel of the layout it is, counted along its lines
            without the apron; −1 where it is not active.
        coarse: (h', w') bool, the cells of the coarse grid, with its apron, whose pixels are not active.
        overflow: () int32, pixels that there was no room for, which stay coarse, and samples that were dropped.
        supersample: s; each active pixel has s² cells.
        apron: cells around active pixels, and around the layout.
        flat: whether all pixels that are not active show the one colour of all samples where anything is, whatever
            moves, so that nothing has to be splatted there.
    """

    samples: tuple[Samples, ...]
    index: Array
    shift: Array
    cells: Cells
    part: Array
    wanted: Array
    pixel: Array
    coarse: Array
    overflow: Array
    supersample: int
    apron: int
    flat: bool = False


@record(static=("supersample", "apron"))
class Sampled(_OnCells):
    """A whole scene, sampled: what `rts.sample` returns and `rts.render_samples` takes.

    The grid has an apron of cells around the image, so that what lies just outside can splat into it: here H and W are
    the image's, times `supersample`, plus twice the apron.

    Attributes:
        samples: one `Samples` for each part.
        cells: which sample is in each cell, counted over all parts in order. Pieces of different parts have different
            numbers; exits are of the part that is seen.
        overflow: () int32, samples dropped for want of capacity, or beyond the limit of `layers="auto"`; with those of
            `fine`. Should be 0.
        supersample: s; each pixel has s² cells.
        apron: cells at each side of the image; a splatter that reaches r cells needs r + 1.
        fine: further samples where outlines are (`rts.Adaptive`), or None.
    """

    samples: tuple[Samples, ...]
    cells: Cells
    overflow: Array
    supersample: int = 1
    apron: int = 2
    fine: Fine | None = None

    @property
    def one_part(self) -> bool:
        """Whether it is the scene of one part."""
        return len(self.samples) == 1

    @property
    def part(self) -> Array:
        """(K, H, W) int32, the part seen in each cell, or −1."""
        if self.one_part:
            return _first_part(self.row)
        xp, first = namespace(self.row), 0
        part = xp.astype(self.row >= 0, self.row.dtype) - 1
        for samples in self.samples[:-1]:
            first += samples.ids.shape[-2]
            part = part + xp.astype(self.row >= first, self.row.dtype)
        return part


def _first_part(row: Array) -> Array:
    """The part of samples (K, H, W) that are all of the first."""
    return namespace(row).clip(row, None, 0)


@record(static=("border", "one_part"))
class Splats(_OnCells):
    """Shaded samples in their cells: what a splatter takes.

    A splatter ignores what it does not read. The optional fields say more about the scene, where whoever made the
    splats knows it.

    Attributes:
        positions: (N, 3) pixel x, pixel y, linear depth; differentiable.
        rgba: (N, 4) premultiplied, of the engine of the positions; differentiable. Where shaders give other numbers of
            channels, (N, C + 1): splatters are given three of them at a time, and alpha.
        cells: which sample is in each cell, without depth; arrays of the positions' engine.
        part: (K, H, W) int32, the part of each sample, or −1; None if that is not known, or where all samples are of
            `one_part`. See `parts`.
        sentinel: () float, the depth that stands for empty layers, beyond all samples; None for one of the scene's
            scale.
        wanted: (H, W) bool, the targets that are looked at; others may have any finite colour. None for all.
        border: cells at each side that splat into the image but are no part of it.
        one_part: whether all samples are of one part.
    """

    positions: Array
    rgba: Array
    cells: Cells
    part: Array | None = None
    sentinel: Array | None = None
    wanted: Array | None = None
    border: int = 0
    one_part: bool = False

    @property
    def parts(self) -> Array | None:
        """`part` of any scene: made of `row` where all samples are of one part. None if parts are not known."""
        return _first_part(self.row) if self.part is None and self.one_part else self.part
