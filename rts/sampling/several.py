"""Several views of a scene, sampled side by side in one picture.

What is decided cell by cell is decided for all views by one pass over the picture: which samples splatters need, which
side of a surface is seen, and where each sample stands in the table. So Python's share is paid once, and threads have
long loops. Only the triangles are drawn view by view.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rts.adapting import adapted
from rts.camera import Camera
from rts.checks import check_memory, suited_sampler
from rts.engines import engine_of, is_constant, is_traced, namespace, stopped, suiting, value_of
from rts.interfaces import CheckedPart, Needed, Shader, Splatter, TriangleSurface
from rts.records import ArraySpec, Fragments, Sampled, Samples
from rts.sampling.cache import Entry
from rts.sampling.extremes import largest
from rts.sampling.facing import facing_of_views
from rts.sampling.merging import merge
from rts.sampling.packing import FAR, lift
from rts.sampling.pruning import prune
from rts.sampling.scenes import Scene, apron_of, widened
from rts.sampling.triangle_sampler import TriangleSampler, _attribute_specs, _Shape
from rts.sampling.validation import check_camera, check_fragments, checked_pieces
from rts.splatting.side_by_side import Picture, depth_scales
from rts.threads import each
from rts.trees import Array, leaves, map_leaves


class Views(NamedTuple):
    """Samples of several views, side by side.

    Attributes:
        sampled: the samples; the grid is that of the picture, and the apron that of each view. In the table of a part
            those of one view stand together, in the order of the views.
        picture: where the views are.
        counts: of each part (B,), how many rows are those of a view.
        scales: (B,) factors of depths, by which splatters are to compare them; None where depths are as they are.
    """

    sampled: Sampled
    picture: Picture
    counts: tuple[np.ndarray, ...]
    scales: np.ndarray | None


class Sampling(NamedTuple):
    """How views are to be sampled as one picture.

    Attributes:
        scenes: the scene with the camera of each view, for images of the size.
        picture: where the views are to be.
        size: (height, width) of each view, pixels.
        side: cells along each side of a pixel.
        layers: K.
        splatter: the splatter that samples are for.
        capacity: as in `rts.render`, of each view.
    """

    scenes: Sequence[Scene]
    picture: Picture
    size: tuple[int, int]
    side: int
    layers: int
    splatter: Splatter
    capacity: int | None = None

    @property
    def possible(self) -> bool:
        """Whether views can be sampled so, and not one by one.

        One by one are sampled surfaces that refine their samples, intersect rays or have other triangles for each view,
        parts with exits, and what a sampler with a `sample` of its own samples.
        """
        exits = self.scenes[0].suited[0].differentiates and self.splatter.reads_exits
        return all(_is_plain(sampler, part, exits) for part, sampler, _ in self.parts())

    def parts(self) -> list[tuple[CheckedPart, Any, Any]]:
        """Each part, its sampler, and what that has prepared."""
        first = self.scenes[0]
        chosen = [suited_sampler(s, part, first.camera) for s, part in zip(first.samplers, first.parts, strict=True)]
        return list(zip(first.parts, chosen, first.entries, strict=True))

    def needed(self) -> Needed | None:
        """What says which samples of a view the splatter needs."""
        height, width = (self.side * n for n in self.size)
        first = self.scenes[0]
        check_memory(height, width, self.layers, self.capacity, gradient=first.suited[0].differentiates)
        return first.needed_by(self.splatter, settles=True)

    def of_part(
        self, part: CheckedPart, sampler: TriangleSampler, entry: Entry | None, pruning: _Pruning | None, apart: bool
    ) -> list[Samples]:
        """The samples of a part in all views, or of each `apart`, less what is not needed; by one call to the host."""
        apron, cells = apron_of(self.splatter), (self.side * self.size[0], self.side * self.size[1])
        wides = [widened(scene, scene.camera, cells, apron) for scene in self.scenes]
        cameras = [stopped(wide.camera.within(part.transform)) for wide in wides]
        surface, theta, picture, layers = part.surface, part.theta, self.picture, self.layers
        engine, like = suiting(theta, cameras)
        tells = self.splatter.reads_facing and layers > 1 and part.cull == "none" and surface.tells_pieces
        settles = pruning is not None and pruning.settles
        inputs = surface.proxy_inputs(stopped(theta)) if entry is None else None
        reads = {name: theta[name] for name in surface.reads(theta)}
        host_theta = reads if engine.differentiates and is_constant(reads) else None
        shader = adapted(part.shader, Shader)
        asked = None if shader is None else shader.reads
        grid = picture.view if apart else picture.size
        shape = _Shape(layers, grid, self.capacity, grid)
        attributes = _attribute_specs(surface, asked, host_theta, shape, like)
        transform = [] if part.transform is None else [part.transform]

        def host(*arrays: np.ndarray) -> tuple[Any, ...]:
            it = iter(arrays)
            own = [Camera(*(np.asarray(next(it), np.float64) for _ in range(2))) for _ in cameras]
            moved = [next(it) for _ in transform]
            own = [check_camera(camera, *moved) for camera in own]
            given = map_leaves(lambda _: next(it), inputs) if entry is None else entry.inputs
            with sampler._keeper.lock:
                known = entry or sampler._entry(surface, given, own[0], picture.view)
                alone = sampler.follows or not sampler.concurrent
                fragments = _drawn(sampler, known, own, picture, layers, part.cull) if alone else None
            fragments = fragments or _drawn(sampler, known, own, picture, layers, part.cull)
            covered, settled, sides = fragments.triangle_ids >= 0, None, None
            kept = covered.copy()
            if pruning is not None:
                kept = pruning(kept, fragments.depth, known.size or largest(known.proxy.vertices))
                settled = pruning.settled(covered, kept) if settles else None
            if tells:
                pieces = checked_pieces(surface, known.proxy) if kept[1:].any() else np.zeros(1, np.int16)
                sides = facing_of_views(fragments, kept, known.proxy, pieces, own, picture.view)
            found = lift(fragments, known.proxy, None, kept, 0.0, views=(picture.down, picture.across))
            gbuffer = surface.evaluate(host_theta, found) if host_theta is not None else {}
            grids = [x for x in (sides, settled) if x is not None]
            tables = [found.ids, found.params, *(np.asarray(gbuffer[n], spec.dtype) for n, spec in attributes.items())]
            views = [(tables, found.row, found.depth, found.overflow, grids)]
            if apart:
                views = _cut(tables, found.row, found.depth, grids, picture, self.capacity)
            return tuple(x for rows, *cells, told in views for x in (*rows[:2], *cells, *told, *rows[2:]))

        sides = [ArraySpec((layers, *grid), np.int16)] if tells else []
        amid = [ArraySpec(grid, np.bool_)] if settles else []
        specs = *shape.specs(surface.sample_widths), *sides, *amid, *attributes.values()
        matrices = [m for camera in cameras for m in (camera.view, camera.projection)]
        count = picture.views if apart else 1
        results = engine.call_host(host, specs * count, *matrices, *transform, *leaves(inputs))
        rest = 5 + len(sides) + len(amid)
        return [
            Samples(
                *own[:5],
                gbuffer=dict(zip(attributes, own[rest:], strict=True)) if host_theta is not None else None,
                asked=asked,
                centered=surface.centered,
                facing=own[5] if tells else None,
                settled=own[rest - 1] if settles else None,
            )
            for own in (results[i : i + len(specs)] for i in range(0, len(results), len(specs)))
        ]


def sampled_as_one(given: Sampling) -> Views:
    """The views of a scene, sampled as one picture; values of its arrays are known."""
    needed = given.needed()
    pruning, parts = None if needed is None else _Pruning(needed, given.picture), given.parts()
    found = [given.of_part(*part, pruning if len(parts) == 1 else None, apart=False)[0] for part in parts]
    sampled = merge(found, given.layers)
    if pruning is not None and len(parts) > 1:
        sampled = prune(sampled, pruning)
    scales = _scales_of(sampled.depth, given.picture) if pruning is None else pruning.scales
    counts = tuple(_counts(samples.row, samples.ids.shape[0], given.picture) for samples in sampled.samples)
    sampled = replace(sampled, supersample=given.side, apron=apron_of(given.splatter))
    return Views(sampled, given.picture, counts, scales)


def sampled_at_once(given: Sampling) -> list[Sampled]:
    """The views of a scene, sampled as one picture and taken apart: each in tables of its own, as if sampled alone."""
    needed = given.needed()
    pruning, parts = None if needed is None else _Pruning(needed, given.picture), given.parts()
    found = [given.of_part(*part, pruning if len(parts) == 1 else None, apart=True) for part in parts]
    views = []
    for samples in zip(*found, strict=True):
        sampled = merge(samples, given.layers)
        if needed is not None and len(parts) > 1 and not is_traced(sampled.row):
            sampled = prune(sampled, needed)
        views.append(replace(sampled, supersample=given.side, apron=apron_of(given.splatter)))
    return views


def _cut(
    tables: Sequence[np.ndarray],
    row: np.ndarray,
    depth: np.ndarray,
    grids: Sequence[np.ndarray],
    picture: Picture,
    capacity: int | None,
) -> list[tuple[Any, ...]]:
    """Of each view its tables, `row`, `depth`, what did not fit into the capacity, and further grids.

    Args:
        tables: (N, ·), views one after the other.
        row: (K, height, width) int32.
        depth: (K, height, width) float32.
        grids: (..., height, width).
        picture: where the views are.
        capacity: rows to allot in each table; None for as many as there are, at least one.
    """
    views, first = [], 0
    for (lines, columns), count in zip(picture.places(), _counts(row, len(tables[0]), picture).tolist(), strict=True):
        own, there = row[:, lines, columns] - np.int32(first), depth[:, lines, columns]
        room = max(1, count) if capacity is None else capacity
        taken = min(count, room)
        here = (own >= 0) & (own < room) & (row[:, lines, columns] >= 0)
        cut = []
        for table in tables:
            rows = np.zeros((room, *table.shape[1:]), table.dtype)
            rows[:taken] = table[first : first + taken]
            cut.append(rows)
        over = np.asarray(count - taken, np.int32)
        told = [np.ascontiguousarray(x[..., lines, columns]) for x in grids]
        views.append((cut, np.where(here, own, np.int32(-1)), np.where(here, there, np.float32(0)), over, told))
        first += count
    return views


def laid_side_by_side(views: Sequence[Sampled], picture: Picture) -> Views | None:
    """Views that were sampled one by one, as one picture; None where samples of several cannot stand in one table."""
    first, engine = views[0], engine_of(views[0].row)
    for view in views:
        if engine.padded(view.row) or any(set(s.by_sample) != set(s.tables) for s in view.samples):
            return None
    counts = np.array([[s.ids.shape[0] for s in view.samples] for view in views], np.int32)
    starts = np.cumsum(counts, axis=0, dtype=np.int32) - counts
    # Rows of all parts are counted part by part, in each view and in the picture.
    total = counts.sum(axis=0, dtype=np.int32)
    shifts = np.cumsum(total, dtype=np.int32) - total + starts - (np.cumsum(counts, axis=1, dtype=np.int32) - counts)
    xp, part, samples = namespace(first.row), [view.part for view in views], []

    def laid_out(grids: Sequence[Array | None], empty: int | bool, shift: np.ndarray | None = None) -> Array | None:
        """One grid of those of all views; `shift` (B, parts) is added to rows of each part."""
        if grids[0] is None:
            return None
        several = len(grids[0].shape) == 3
        stacked = xp.stack([x if several else x[None, ...] for x in grids])
        if shift is not None:
            whose = xp.stack([x if several else x[:1, ...] for x in part])
            given = stacked
            for index in range(shift.shape[1]):
                moved = given + engine.constant(shift[:, index, None, None, None], given)
                there = (given >= 0) if shift.shape[1] == 1 else (given >= 0) & (whose == index)
                stacked = xp.where(there, moved, stacked)
        found = picture.laid_out(stacked, empty)
        return found if several else found[0, ...]

    for index in range(len(first.samples)):
        own = [view.samples[index] for view in views]
        row = laid_out([s.row for s in own], -1, starts[:, index, None])
        samples.append(replace(in_one_table(own), row=row, depth=laid_out([s.depth for s in own], 0)))
    sampled = replace(
        first,
        samples=tuple(samples),
        row=laid_out([view.row for view in views], -1, shifts),
        depth=laid_out([view.depth for view in views], 0),
        overflow=sum(view.overflow for view in views),
        settled=laid_out([view.settled for view in views], False),
        facing=laid_out([view.facing for view in views], 0),
        exit=laid_out([view.exit for view in views], -1, shifts),
    )
    return Views(sampled, picture, tuple(counts.T), _scales_of(sampled.depth, picture))


def in_one_table(samples: Sequence[Samples]) -> Samples:
    """The rows of several samples of one part, one after the other; their grids are those of the first."""
    if len(samples) == 1:
        return samples[0]
    first, xp = samples[0], namespace(samples[0].ids)
    tables = {name: xp.concat([s.tables[name] for s in samples]) for name in first.tables}
    known = None
    if first.gbuffer is not None:
        known = {name: xp.concat([(s.gbuffer or {})[name] for s in samples]) for name in first.gbuffer}
    ids, params = xp.concat([s.ids for s in samples]), xp.concat([s.params for s in samples])
    return replace(first, ids=ids, params=params, tables=tables, gbuffer=known)


def _is_plain(sampler: Any, part: CheckedPart, exits: bool) -> bool:
    """Whether views of a part can be sampled as one; with `exits` where somebody reads them."""
    surface = part.surface
    if not isinstance(sampler, TriangleSampler) or type(sampler).sample is not TriangleSampler.sample:
        return False
    if not isinstance(surface, TriangleSurface) or surface.refines or surface.depends_on_view:
        return False
    return not (exits and part.cull == "back" and sampler.tells_exits)


def _drawn(
    sampler: TriangleSampler, known: Entry, cameras: Sequence[Camera], picture: Picture, layers: int, cull: str
) -> Fragments:
    """The fragments (K, height, width) of the picture: views on all cores, if the sampler is `concurrent`."""
    shape, faces, places = (layers, *picture.size), len(known.proxy.faces), picture.places()
    found = Fragments(np.empty(shape, np.int32), np.empty((*shape, 2), np.float32), np.empty(shape, np.float32))
    if not faces or len(places) < picture.down * picture.across:
        for x, nothing in zip(found, (-1, 0, 0), strict=True):
            x[...] = nothing
    if not faces:
        return found

    def draw(b: int) -> None:
        own = sampler.rasterize(known.prepared, cameras[b], picture.view, layers, cull)
        check_fragments(own, (layers, *picture.view), faces, sampler)
        for to, x in zip(found, own, strict=True):
            to[:, *places[b]] = x

    if sampler.concurrent and not sampler.follows:
        each(draw, range(len(cameras)))
    else:
        for b in range(len(cameras)):
            draw(b)
    return found


class _Pruning:
    """Which samples of several views a splatter needs.

    Args:
        needed: says so of one view.
        picture: where the views are.

    Attributes:
        settles: see `Needed`.
        scales: after a call, `depth_scales` of the depths that were given.
    """

    def __init__(self, needed: Needed, picture: Picture):
        self.settles, self.scales = needed.settles, None
        self._size, self._picture = needed.size or 0.0, picture  # Where it is traced, that of the triangles is told.
        self._near = copy.copy(needed)
        self._near.size = 0.0  # Whether numbers are too large is decided here: depths are in other units.
        self._depth: np.ndarray | None = None

    def __call__(self, covered: np.ndarray, depth: np.ndarray, size: float = 0.0) -> np.ndarray:
        """Samples (K, height, width) bool that are needed, of those that are covered; coordinates are of a `size`."""
        far = _largest(depth, self._picture)
        self.scales = depth_scales(far)
        self._depth = depth if self.scales is None else depth * self._factors(self.scales, depth.dtype)
        if max(size, self._size) > FAR * far[far > 0].min(initial=np.inf):
            self._depth = None
            return covered
        return self._near(covered, self._depth)

    def settled(self, covered: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """(height, width) bool as `Needed.settled`, after a call; `kept` is changed in place."""
        if self._depth is None:
            return np.zeros(covered.shape[1:], bool)
        return self._near.settled(covered, self._depth, kept, 0.0)

    def _factors(self, scales: np.ndarray, dtype: Any) -> np.ndarray:
        """(height, width) the factor of each cell."""
        found = np.ones(self._picture.size, dtype)
        for (lines, columns), scale in zip(self._picture.places(), scales, strict=True):
            found[lines, columns] = scale
        return found


def _largest(depth: np.ndarray, picture: Picture) -> np.ndarray:
    """(B,) the largest depth of each view, of depths (K, height, width) of the picture."""
    layers, (height, width) = len(depth), picture.view
    grid = np.abs(depth).reshape(layers, picture.down, height, picture.across, width)
    return grid.max(axis=(0, 2, 4), initial=0).reshape(-1)[: picture.views]


def _scales_of(depth: Array, picture: Picture) -> np.ndarray | None:
    """The `depth_scales` of the depths of views; None where they are not known."""
    known = value_of(depth)
    return None if known is None else depth_scales(_largest(known, picture))


def _counts(row: Array, rows: int, picture: Picture) -> np.ndarray:
    """(B,) how many rows of a table are those of a view, of which each stands in one cell."""
    known = value_of(row)
    assert known is not None
    layers, (height, width) = len(known), picture.view
    grid = (known >= 0).reshape(layers, picture.down, height, picture.across, width)
    counts = grid.sum(axis=(0, 2, 4)).reshape(-1)[: picture.views]
    counts[0] += rows - counts.sum()  # Where nothing is seen there is a row nevertheless.
    return counts
