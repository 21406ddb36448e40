"""Several views of a scene, sampled side by side in one picture.

One pass over the picture decides for all views which samples splatters need, which side of a surface is seen, and in
which row of the table each sample is. So Python's overhead is paid once, and threads run long loops. Only the
triangles are drawn view by view.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engines import engine_of, is_traced, namespace, stopped, value_of
from rts.arrays.extremes import largest
from rts.arrays.trees import Array
from rts.compiling.threads import each
from rts.contracts.checks import CheckedPart, check_memory
from rts.contracts.records import ArraySpec, Cells, Decision, Fragments, Question, Sampled, Samples
from rts.contracts.surface import TriangleSurface
from rts.plugin_base import overrides
from rts.rendering.scene import Grid, Scene
from rts.rendering.settings import RenderSettings
from rts.sampling.cache import Entry
from rts.sampling.facing import facing_of_views
from rts.sampling.hidden import HiddenRule, without_hidden
from rts.sampling.host_call import HostCall, Shape
from rts.sampling.merging import merge
from rts.sampling.packing import FAR, lift, triangles_of
from rts.sampling.sample_checks import check_fragments, checked_pieces
from rts.sampling.triangle_sampler import TriangleSampler
from rts.scene.camera import Camera
from rts.splatting.side_by_side import Picture, depth_scales, outlines_side_by_side, renumbered


class Views(NamedTuple):
    """Samples of several views, side by side.

    Attributes:
        sampled: the samples, on the grid of the picture; the apron is that of each view. In the table of a part the
            samples of one view stand together, in the order of the views.
        picture: the layout of the views.
        view: for each part (N,) int32, the number of each row's view, from 1 on; 0 for unused rows.
        counts: for each part (B,), the number of rows of each view; None if unknown, as in traced programs.
        scales: (B,) for each view the factor on its depths, with which splatters compare depths.
    """

    sampled: Sampled
    picture: Picture
    view: tuple[Array, ...]
    counts: tuple[np.ndarray, ...] | None
    scales: Array


@dataclass(frozen=True)
class Sampling:
    """Arguments for sampling views as one picture.

    Attributes:
        scenes: the scene with the camera of each view, for images of the size.
        picture: the layout of the views.
        size: (height, width) of each view, pixels.
        settings: those of each view; `layers` and `supersample` are numbers.
    """

    scenes: Sequence[Scene]
    picture: Picture
    size: tuple[int, int]
    settings: RenderSettings

    @property
    def cells(self) -> tuple[int, int]:
        """(height, width) of each view in cells, without its apron."""
        side = self.settings.side or 1
        return side * self.size[0], side * self.size[1]

    @cached_property
    def grids(self) -> list[Grid]:
        """The cells of each view, and their camera."""
        return [Grid.sampled(scene, scene.camera, self.cells, self.settings.apron) for scene in self.scenes]

    @property
    def possible(self) -> bool:
        """True if views can be sampled as one picture, not only one by one.

        Views of some parts must be sampled one by one: parts with exits, and parts whose sampler overrides `sample`. So
        must views of surfaces that refine samples, leave them off their rays, intersect rays, or depend on the view.
        """
        exits = self.scenes[0].context.engine.differentiates and "exit" in self.settings.reader.reads
        return all(_is_plain(sampler, part, exits) for part, sampler, _ in self.parts())

    def parts(self) -> list[tuple[Any, Any, Any]]:
        """Each part, its sampler, and the structure that the sampler has prepared."""
        first = self.scenes[0]
        return list(zip(first.parts, first.chosen(), first.entries, strict=True))

    def hidden(self) -> HiddenRule | None:
        """The rule for hidden samples of a view; None to keep all. An InputError if a view needs too much memory."""
        first, settings = self.scenes[0], self.settings
        gradient = first.context.engine.differentiates
        check_memory(*self.cells, settings.most_layers, settings.capacity, gradient=gradient)
        return first.hidden_by(settings.splatter, settles=True)

    def of_part(
        self, part: CheckedPart, sampler: TriangleSampler, entry: Entry | None, hidden: HiddenRule | None
    ) -> tuple[Samples, Array, Array]:
        """The needed samples of a part in all views, by one call to the host; at most `settings.capacity` in each view.

        Args:
            part: the part.
            sampler: draws its triangles.
            entry: the structure that the sampler has prepared; None to look it up, or to build it.
            hidden: the rule that tells which samples to keep; None to keep all.

        Returns:
            Samples on the grid of the picture, and `view` and `scales` of `Views`.
        """
        settings = self.settings
        cameras = [stopped(grid.camera.within(part.transform)) for grid in self.grids]
        surface, picture, layers = part.surface, self.picture, settings.most_layers
        assert isinstance(surface, TriangleSurface)
        tells = "facing" in settings.reader.reads and layers > 1 and part.cull == "none"
        tells = tells and overrides(surface, "pieces", TriangleSurface)
        capacity = None if settings.capacity is None else picture.views * settings.capacity
        shape = Shape(layers, picture.size, capacity, picture.size)
        specs = {
            "view": shape.row_spec(np.int32),
            "scales": ArraySpec((picture.views,), np.float32),
            **({"facing": ArraySpec((layers, *picture.size), np.int16)} if tells else {}),
            **({"settled": ArraySpec(picture.size, np.int8)} if hidden and hidden.settles else {}),
            **({"triangle": shape.row_spec(np.int32)} if settings.finds_outlines else {}),
        }

        def find(own: Sequence[Camera], inputs: Any) -> tuple[Samples, dict[str, np.ndarray]]:
            def drawn(built: Entry) -> tuple[Entry, Fragments, np.ndarray]:
                return built, *_drawn(sampler, built, own, picture, layers, part.cull)

            built, fragments, covered = sampler.working_on(surface, inputs, own[0], picture.view, entry, drawn)
            size = built.size or largest(built.proxy.vertices)
            (kept, settled, _), scales = decided_in_views(hidden, picture, Question(covered, fragments.depth, size))
            extras: dict[str, np.ndarray] = {"scales": scales}
            if settled is not None:
                extras["settled"] = settled
            if tells:
                pieces = checked_pieces(surface, built.proxy) if kept[1:].any() else np.zeros(1, np.int16)
                extras["facing"] = facing_of_views(fragments, kept, built.proxy, pieces, own, picture.view)
            over = 0
            if settings.capacity is not None:
                kept = kept.copy()
                over = _leave_out(kept, picture, settings.capacity)
            lifted = lift(fragments, built.proxy, capacity, kept, views=(picture.down, picture.across))
            counts = _counts(lifted.row, len(lifted.ids) if capacity is None else 0, picture)
            extras["view"] = _numbers(counts, len(lifted.ids))
            if settings.finds_outlines:
                extras["triangle"] = triangles_of(fragments, lifted)
            return replace(lifted, overflow=np.asarray(over, np.int32)), extras

        samples, extras = HostCall(part, surface, cameras, shape, entry).samples(find, specs)
        view, scales = extras.pop("view"), extras.pop("scales")
        return samples.replace(**extras), view, scales


def sampled_as_one(sampling: Sampling) -> Views:
    """The views of a scene, sampled as one picture."""
    hidden, parts, picture = sampling.hidden(), sampling.parts(), sampling.picture
    results = [sampling.of_part(*part, hidden if len(parts) == 1 else None) for part in parts]
    sampled, scales = merge([samples for samples, _, _ in results], sampling.settings.most_layers), results[0][2]
    if len(parts) > 1:
        scales = _scales_of(sampled.depth, picture)
        if hidden is not None and not is_traced(sampled.row):
            sampled = without_hidden(sampled, lambda question: decided_in_views(hidden, picture, question)[0])
    sampled = replace(sampled, supersample=sampling.settings.side, apron=sampling.settings.apron)
    padded, view = engine_of(sampled.row).padded(sampled.row), tuple(own for _, own, _ in results)
    if is_traced(sampled.row) or (padded and len(parts) == 1):
        return Views(sampled, picture, view, None, scales)
    if len(parts) == 1:
        counts = np.bincount(engine_of(view[0]).to_numpy(view[0]), minlength=picture.views + 1)[1:]
        return Views(sampled, picture, view, (counts,), scales)
    if padded:
        return Views(sampled, picture, tuple(_views_of(s, picture) for s in sampled.samples), None, scales)
    counts = tuple(_counts(value_of(s.row), s.ids.shape[0], picture) for s in sampled.samples)
    return with_counts(sampled, picture, scales, counts)


def _views_of(samples: Samples, picture: Picture) -> Array:
    """The view (N,) of each row in the table of a part whose samples have one cell each; 0 for unused rows."""
    size = samples.ids.shape[0]

    def host(row: np.ndarray) -> tuple[np.ndarray]:
        return (_numbers(_counts(row, 0, picture), size),)

    return engine_of(samples.row).call_host(host, [ArraySpec((size,), np.int32)], samples.row)[0]


def _numbers(counts: np.ndarray, size: int) -> np.ndarray:
    """The view (size,) int32 of each row, from 1 on, given the number of rows of each view; 0 for unused rows."""
    numbers = np.zeros(size, np.int32)
    numbers[: counts.sum()] = np.repeat(np.arange(1, len(counts) + 1), counts)
    return numbers


def with_counts(sampled: Sampled, picture: Picture, scales: Array, counts: tuple[np.ndarray, ...]) -> Views:
    """`Views` of samples with these numbers of rows; which rows are in use is unknown where they are padded."""
    engine = engine_of(sampled.row)
    view = tuple(engine.constant(_numbers(own, own.sum()), sampled.row) for own in counts)
    return Views(sampled, picture, view, None if engine.padded(sampled.row) else counts, scales)


def _leave_out(kept: np.ndarray, picture: Picture, capacity: int) -> int:
    """Set False what exceeds `capacity` in each view, deepest layers first. Returns the number of these samples in all.

    `kept` (K, height, width) bool is of the whole picture, and is changed in place.
    """
    over = 0
    for lines, columns in picture.places():
        own = kept[:, lines, columns]
        count = int(np.count_nonzero(own))
        if count > capacity:
            own[own] = np.arange(count) < capacity
            over += count - capacity
    return over


def laid_side_by_side(views: Sequence[Sampled], picture: Picture) -> Views | None:
    """One picture of views that were sampled one by one; None if it is unknown which of their rows are in use."""
    first, engine = views[0], engine_of(views[0].row)
    # With outlines, all rows pass for used.
    if any(engine.padded(view.row) and view.outlines is None for view in views):
        return None
    counts = np.array([[s.ids.shape[0] for s in view.samples] for view in views], np.int32)
    starts = np.cumsum(counts, axis=0, dtype=np.int32) - counts
    # Rows are numbered part by part, in each view and in the picture.
    own_starts = np.cumsum(counts, axis=1, dtype=np.int32) - counts
    total = counts.sum(axis=0, dtype=np.int32)
    shifts = np.cumsum(total, dtype=np.int32) - total + starts - own_starts
    xp, samples = namespace(first.row), []

    def laid_out(grids: Sequence[Array | None], empty: int, shift: np.ndarray | None = None) -> Array | None:
        """One grid from the grids of all views; `shift` (B, parts) is added to rows of each part."""
        recorded = [grid for grid in grids if grid is not None]
        if not recorded:
            return None
        several = len(recorded[0].shape) == 3
        stacked = xp.stack([x if several else x[None, ...] for x in recorded])
        if shift is not None:
            stacked = renumbered(stacked, own_starts, shift)
        whole = picture.laid_out(stacked, empty)
        return whole if several else whole[0, ...]

    for index in range(len(first.samples)):
        own = [view.samples[index] for view in views]
        row = laid_out([s.row for s in own], -1, starts[:, index, None])
        samples.append(in_one_table(own).replace(row=row, depth=laid_out([s.depth for s in own], 0)))
    cells = Cells(
        laid_out([view.row for view in views], -1, shifts),
        laid_out([view.depth for view in views], 0),
        facing=laid_out([view.facing for view in views], 0),
        exit=laid_out([view.exit for view in views], -1, shifts),
        settled=laid_out([view.settled for view in views], -1),
    )
    assert cells.depth is not None
    scales = _scales_of(cells.depth, picture)
    found = [view.outlines for view in views if view.outlines is not None]
    sampled = replace(
        first,
        samples=tuple(samples),
        cells=cells,
        overflow=sum(view.overflow for view in views),
        outlines=outlines_side_by_side(found, picture, own_starts, shifts, scales) if found else None,
    )
    return with_counts(sampled, picture, scales, tuple(counts.T))


def in_one_table(samples: Sequence[Samples]) -> Samples:
    """Several samples of one part as one, with the cells of the first alone; `ids` become rows of a shared table."""
    if len(samples) == 1:
        return samples[0]
    first, xp = samples[0], namespace(samples[0].ids)
    shared = [name for name in first.tables if name not in first.by_sample]
    tables = {name: xp.concat([s.tables[name] for s in samples]) for name in first.tables}
    gbuffer = None
    if first.gbuffer is not None:
        gbuffer = {name: xp.concat([(s.gbuffer or {})[name] for s in samples]) for name in first.gbuffer}
    ids, start = [first.ids], 0
    for before, own in itertools.pairwise(samples):
        start += before.tables[shared[0]].shape[0] if shared else 0
        ids.append(own.ids + start)
    ids, params = xp.concat(ids), xp.concat([s.params for s in samples])
    return replace(first, ids=ids, params=params, tables=tables, gbuffer=gbuffer)


def _is_plain(sampler: Any, part: CheckedPart, exits: bool) -> bool:
    """True if views of a part can be sampled as one picture; `exits` says if the splatter reads exits."""
    surface = part.surface
    if not isinstance(sampler, TriangleSampler) or overrides(sampler, "sample", TriangleSampler):
        return False
    if not isinstance(surface, TriangleSurface) or surface.refines or surface.depends_on_view or not surface.centered:
        return False
    return not (exits and part.cull == "back")


def _drawn(
    sampler: TriangleSampler, built: Entry, cameras: Sequence[Camera], picture: Picture, layers: int, cull: str
) -> tuple[Fragments, np.ndarray]:
    """The fragments (K, height, width) of the picture, and a bool mask of the covered cells.

    Views are drawn on all cores if the sampler `draws_at_once`.
    """
    shape, faces, places = (layers, *picture.size), len(built.proxy.faces), picture.places()
    # One array for all fields: fewer pages are allotted in each call.
    numbers = np.empty((4, *shape), np.float32)
    fragments = Fragments(numbers[0].view(np.int32), numbers[1:3].reshape(*shape, 2), numbers[3])
    covered = np.zeros(shape, np.bool_)
    if not faces or len(places) < picture.down * picture.across:
        for x, nothing in zip(fragments, (-1, 0, 0), strict=True):
            x[...] = nothing
    if not faces:
        return fragments, covered

    def draw(b: int) -> None:
        own = sampler.rasterize(built.prepared, cameras[b], picture.view, layers, cull)
        covered[:, *places[b]] = check_fragments(own, (layers, *picture.view), faces, sampler)
        for to, x in zip(fragments, own, strict=True):
            to[:, *places[b]] = x

    if sampler.draws_at_once:
        each(draw, range(len(cameras)))
    else:
        for b in range(len(cameras)):
            draw(b)
    return fragments, covered


def decided_in_views(hidden: HiddenRule | None, picture: Picture, question: Question) -> tuple[Decision, np.ndarray]:
    """The decision on the samples (K, height, width) of all views, and the scales (B,) to compare depths with.

    Args:
        hidden: the rule for one view; None to keep all.
        picture: the layout of the views.
        question: the samples of the picture.
    """
    covered, depth, size = question
    far = _largest(depth, picture)
    scales = depth_scales(far)
    if hidden is None:
        return Decision(covered, None, covered), scales
    # The check for too large numbers comes first: below, depths are in other units.
    if max(size, hidden.size) > FAR * far[far > 0].min(initial=np.inf):
        settled = np.full(covered.shape[1:], -1, np.int8) if hidden.settles else None
        return Decision(covered, settled, covered), scales
    if (scales != 1).any():
        depth = depth * _factors(scales, picture, depth.dtype)
    return hidden.unsized().decide(question._replace(depth=depth, size=0.0)), scales


def _factors(scales: np.ndarray, picture: Picture, dtype: Any) -> np.ndarray:
    """Factors (height, width) on the depth of each cell, from those of the views (B,); 1 in places without a view."""
    factors = np.ones(picture.size, dtype)
    for (lines, columns), scale in zip(picture.places(), scales, strict=True):
        factors[lines, columns] = scale
    return factors


def _largest(depth: np.ndarray, picture: Picture) -> np.ndarray:
    """The largest absolute depth (B,) of each view, from depths (K, height, width) of the picture."""
    layers, (height, width) = len(depth), picture.view
    lines = depth.reshape(-1, width)
    sizes = np.maximum(lines.max(axis=1, initial=0), -lines.min(axis=1, initial=0))
    return sizes.reshape(layers, picture.down, height, -1).max(axis=(0, 2)).reshape(-1)[: picture.views]


def _scales_of(depth: Array, picture: Picture) -> Array:
    """The `depth_scales` (B,) of the views, from depths (K, height, width) of the picture."""

    def host(depth: np.ndarray) -> tuple[np.ndarray]:
        return (depth_scales(_largest(depth, picture)),)

    return engine_of(depth).call_host(host, [ArraySpec((picture.views,), np.float32)], depth)[0]


def _counts(row: np.ndarray | None, rows: int, picture: Picture) -> np.ndarray:
    """The number (B,) of samples of each view, from `row` (K, height, width), in which each has one cell.

    If the table has more rows than these, `rows` in all, the others count as the first view's.
    """
    from rts.sampling import packing_loops

    assert row is not None
    counts = packing_loops.count_in_views(row >= 0, (picture.down, picture.across))[: picture.views]
    counts[0] += max(0, rows - counts.sum())  # The table of an empty picture has one row.
    return counts
