"""Several views of a scene, sampled side by side in one picture.

One pass over the picture packs the samples of all views. So Python's overhead is paid once, and threads run long loops.
Only the triangles are drawn view by view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engines import engine_of, is_traced, namespace, stopped, value_of
from rts.arrays.trees import Array
from rts.compiling.threads import each
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.checks import check_memory
from rts.contracts.records import ArraySpec, Cells, Fragments, Sampled, Samples
from rts.contracts.surface import TriangleSurface
from rts.plugin_base import overrides
from rts.rendering.settings import RenderSettings
from rts.sampling.cache import Entry
from rts.sampling.host_call import HostCall, SampleBounds
from rts.sampling.merging import merge
from rts.sampling.packing import pack_fragments
from rts.sampling.picture import Picture, renumbered, stencils_side_by_side
from rts.sampling.sample_checks import check_fragments
from rts.sampling.scene import Grid, Scene
from rts.sampling.tables import in_one_table
from rts.sampling.triangle_sampler import TriangleSampler
from rts.scene.camera import Camera


class Views(NamedTuple):
    """Samples of several views, side by side.

    Attributes:
        sampled: the samples, on the grid of the picture; the apron is that of each view. In the table of a part the
            samples of one view stand together, in the order of the views.
        picture: the layout of the views.
        view: for each part (N,) int32, the number of each row's view, from 1 on; 0 for unused rows.
        counts: for each part (B,), the number of rows of each view; None if unknown, as in traced programs.
    """

    sampled: Sampled
    picture: Picture
    view: tuple[Array, ...]
    counts: tuple[np.ndarray, ...] | None


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
        factor = self.settings.supersample
        return factor * self.size[0], factor * self.size[1]

    @cached_property
    def grids(self) -> list[Grid]:
        """The cells of each view, and their camera."""
        return [Grid.sampled(scene, scene.camera, self.cells, self.settings.apron) for scene in self.scenes]

    @property
    def possible(self) -> bool:
        """True if views can be sampled as one picture, not only one by one.

        Views of parts whose sampler overrides `sample` must be sampled one by one. So must views of surfaces that
        refine samples, leave them off their rays, intersect rays, or depend on the view.
        """
        return all(_is_plain(sampler, part) for part, sampler, _ in self.parts())

    def parts(self) -> list[tuple[Any, Any, Any]]:
        """Each part, its sampler, and the structure that the sampler has prepared."""
        first = self.scenes[0]
        return list(zip(first.parts, first.samplers, first.entries, strict=True))

    def of_part(self, part: CheckedPart, sampler: TriangleSampler, entry: Entry | None) -> tuple[Samples, Array]:
        """The samples of a part in all views, by one call to the host; at most `settings.capacity` in each view.

        Args:
            part: the part.
            sampler: draws its triangles.
            entry: the structure that the sampler has prepared; None to look it up, or to build it.

        Returns:
            Samples on the grid of the picture, and `view` of `Views`.
        """
        settings = self.settings
        cameras = [stopped(grid.camera.within(part.transform)) for grid in self.grids]
        surface, picture, layers = part.surface, self.picture, settings.most_layers
        assert isinstance(surface, TriangleSurface)
        capacity = None if settings.capacity is None else picture.views * settings.capacity
        bounds = SampleBounds(layers, picture.size, capacity, picture.size)
        specs = {"view": bounds.row_spec(np.int32)}
        if settings.finds_outlines:
            specs["triangle"] = ArraySpec((layers, *picture.size), np.int32)

        def find(view_cameras: Sequence[Camera], inputs: Any) -> tuple[Samples, dict[str, np.ndarray]]:
            def drawn(built: Entry) -> tuple[Entry, Fragments, np.ndarray]:
                return built, *_drawn(sampler, built, view_cameras, picture, layers, part.cull)

            built, fragments, kept = sampler.working_on(surface, inputs, view_cameras[0], picture.view, entry, drawn)
            over = 0
            if settings.capacity is not None:
                over = _leave_out(kept, picture, settings.capacity)
            packed = pack_fragments(fragments, built.proxy, capacity, kept, views=(picture.down, picture.across))
            counts = _counts(packed.row, len(packed.ids) if capacity is None else 0, picture)
            extras = {"view": _numbers(counts, len(packed.ids))}
            if settings.finds_outlines:
                extras["triangle"] = np.where(packed.row >= 0, fragments.triangle_ids, np.int32(-1))
            return replace(packed, overflow=np.asarray(over, np.int32)), extras

        samples, extras = HostCall(part, surface, cameras, bounds, entry).samples(find, specs)
        view = extras.pop("view")
        return samples.replace(**extras), view


def sampled_as_one(sampling: Sampling) -> Views:
    """The views of a scene, sampled as one picture. An InputError if a view needs too much memory."""
    parts, picture, settings = sampling.parts(), sampling.picture, sampling.settings
    gradient = sampling.scenes[0].context.engine.differentiates
    check_memory(*sampling.cells, settings.most_layers, settings.capacity, gradient=gradient)
    results = [sampling.of_part(*part) for part in parts]
    sampled = merge([samples for samples, _ in results], settings.most_layers)
    sampled = replace(sampled, supersample=settings.supersample, apron=settings.apron)
    padded, view = engine_of(sampled.row).padded(sampled.row), tuple(view_of_row for _, view_of_row in results)
    if is_traced(sampled.row) or (padded and len(parts) == 1):
        return Views(sampled, picture, view, None)
    if len(parts) == 1:
        counts = np.bincount(engine_of(view[0]).to_numpy(view[0]), minlength=picture.views + 1)[1:]
        return Views(sampled, picture, view, (counts,))
    if padded:
        return Views(sampled, picture, tuple(_views_of(s, picture) for s in sampled.samples), None)
    counts = tuple(_counts(value_of(s.row), s.ids.shape[0], picture) for s in sampled.samples)
    return with_counts(sampled, picture, counts)


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


def with_counts(sampled: Sampled, picture: Picture, counts: tuple[np.ndarray, ...]) -> Views:
    """`Views` of samples with these numbers of rows; which rows are in use is unknown where they are padded."""
    engine = engine_of(sampled.row)
    view = tuple(engine.constant(_numbers(part_counts, part_counts.sum()), sampled.row) for part_counts in counts)
    return Views(sampled, picture, view, None if engine.padded(sampled.row) else counts)


def _leave_out(kept: np.ndarray, picture: Picture, capacity: int) -> int:
    """Set False what exceeds `capacity` in each view, deepest layers first. Returns the number of these samples in all.

    `kept` (K, height, width) bool is of the whole picture, and is changed in place.
    """
    over = 0
    for lines, columns in picture.places():
        kept_in_view = kept[:, lines, columns]
        count = int(np.count_nonzero(kept_in_view))
        if count > capacity:
            kept_in_view[kept_in_view] = np.arange(count) < capacity
            over += count - capacity
    return over


def laid_side_by_side(views: Sequence[Sampled], picture: Picture) -> Views | None:
    """One picture of views that were sampled one by one; None if it is unknown which of their rows are in use."""
    first, engine = views[0], engine_of(views[0].row)
    # With outlines, all rows pass for used.
    if any(engine.padded(view.row) and view.stencil is None for view in views):
        return None
    counts = np.array([[s.ids.shape[0] for s in view.samples] for view in views], np.int32)
    starts = np.cumsum(counts, axis=0, dtype=np.int32) - counts
    # Rows are numbered part by part, in each view and in the picture.
    first_rows = np.cumsum(counts, axis=1, dtype=np.int32) - counts
    total = counts.sum(axis=0, dtype=np.int32)
    shifts = np.cumsum(total, dtype=np.int32) - total + starts - first_rows
    xp, samples = namespace(first.row), []

    def laid_out(grids: Sequence[Array], empty: int, shift: np.ndarray | None = None) -> Array:
        """One grid from the grids (K, H, W) of all views; `shift` (B, parts) is added to rows of each part."""
        stacked = xp.stack(list(grids))
        return picture.laid_out(stacked if shift is None else renumbered(stacked, first_rows, shift), empty)

    for index in range(len(first.samples)):
        part_samples = [view.samples[index] for view in views]
        row = laid_out([s.row for s in part_samples], -1, starts[:, index, None])
        samples.append(in_one_table(part_samples).replace(row=row, depth=laid_out([s.depth for s in part_samples], 0)))
    row, depth = laid_out([view.row for view in views], -1, shifts), laid_out([view.depth for view in views], 0)
    found = [view.stencil for view in views if view.stencil is not None]
    sampled = replace(
        first,
        samples=tuple(samples),
        cells=Cells(row, depth),
        overflow=sum(view.overflow for view in views),
        stencil=stencils_side_by_side(found, picture, first_rows, shifts) if found else None,
    )
    return with_counts(sampled, picture, tuple(counts.T))


def _is_plain(sampler: Any, part: CheckedPart) -> bool:
    """True if views of a part can be sampled as one picture."""
    surface = part.surface
    if not isinstance(sampler, TriangleSampler) or overrides(sampler, "sample", TriangleSampler):
        return False
    if not isinstance(surface, TriangleSurface):
        return False
    return not surface.refines and not surface.depends_on_view and surface.centered


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
        camera = built.proxy.seen_by(cameras[b])
        view_fragments = sampler.rasterize(built.prepared, camera, picture.view, layers, cull)
        covered[:, *places[b]] = check_fragments(view_fragments, (layers, *picture.view), faces, sampler)
        for to, x in zip(fragments, view_fragments, strict=True):
            to[:, *places[b]] = x

    if sampler.draws_at_once:
        each(draw, range(len(cameras)))
    else:
        for b in range(len(cameras)):
            draw(b)
    return fragments, covered


def _counts(row: np.ndarray | None, rows: int, picture: Picture) -> np.ndarray:
    """The number (B,) of samples of each view, from `row` (K, height, width), in which each has one cell.

    If the table has more rows than these, `rows` in all, the others count as the first view's.
    """
    from rts.sampling import packing_loops

    assert row is not None
    counts = packing_loops.count_in_views(row >= 0, (picture.down, picture.across))[: picture.views]
    counts[0] += max(0, rows - counts.sum())  # The table of an empty picture has one row.
    return counts
