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
from rts.engines import engine_of, is_constant, namespace, stopped, suiting, value_of
from rts.interfaces import CheckedPart, Needed, Shader, Splatter, TriangleSurface
from rts.records import ArraySpec, Fragments, Sampled, Samples
from rts.sampling.cache import Entry
from rts.sampling.extremes import largest
from rts.sampling.facing import facing_of_views
from rts.sampling.merging import merge
from rts.sampling.packing import FAR, lift
from rts.sampling.pruning import prune
from rts.sampling.scenes import Scene, Wide, apron_of, widened
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


def sampled_as_one(
    scenes: Sequence[Scene], picture: Picture, size: tuple[int, int], side: int, layers: int, splatter: Splatter
) -> Views | None:
    """The views of a scene, sampled as one picture; None where they have to be sampled one by one.

    One by one are sampled surfaces that refine their samples, intersect rays or have other triangles for each view,
    parts with exits, and what a sampler with a `sample` of its own samples.

    Args:
        scenes: the scene with the camera of each view, for images of the size; values of its arrays are known.
        picture: where the views are to be.
        size: (height, width) of each view, pixels.
        side: cells along each side of a pixel.
        layers: K.
        splatter: the splatter that samples are for.
    """
    first, height, width = scenes[0], side * size[0], side * size[1]
    samplers = [suited_sampler(s, part, first.camera) for s, part in zip(first.samplers, first.parts, strict=True)]
    derives = first.suited[0].differentiates
    if not all(
        _is_plain(*given, derives and splatter.reads_exits) for given in zip(samplers, first.parts, strict=True)
    ):
        return None
    needed = first.needed_by(splatter, settles=True)
    if needed is not None and needed.size is None:
        return None
    check_memory(height, width, layers, None, gradient=derives)
    apron = apron_of(splatter)
    wides = [widened(scene, scene.camera, (height, width), apron) for scene in scenes]
    pruning = None if needed is None else _Pruning(needed, picture)
    found = []
    for part, sampler, entry in zip(first.parts, samplers, first.entries, strict=True):
        here = pruning if len(first.parts) == 1 else None
        found.append(_of_part(part, sampler, entry, wides, picture, layers, here, splatter.reads_facing))
    sampled = merge(found, layers)
    if pruning is not None and len(first.parts) > 1:
        sampled = prune(sampled, pruning)
    scales = _scales_of(sampled.depth, picture) if pruning is None else pruning.scales
    counts = tuple(_counts(samples.row, samples.ids.shape[0], picture) for samples in sampled.samples)
    return Views(replace(sampled, supersample=side, apron=apron), picture, counts, scales)


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


def _of_part(
    part: CheckedPart,
    sampler: TriangleSampler,
    entry: Entry | None,
    wides: Sequence[Wide],
    picture: Picture,
    layers: int,
    pruning: _Pruning | None,
    facing: bool,
) -> Samples:
    """The samples of a part in all views, less those that are not needed; by one call to the host."""
    surface, theta = part.surface, part.theta
    cameras = [stopped(wide.camera.within(part.transform)) for wide in wides]
    engine, like = suiting(theta, cameras)
    tells = facing and layers > 1 and part.cull == "none" and surface.tells_pieces
    settles = pruning is not None and pruning.settles
    inputs = surface.proxy_inputs(stopped(theta)) if entry is None else None
    reads = {name: theta[name] for name in surface.reads(theta)}
    host_theta = reads if engine.differentiates and is_constant(reads) else None
    shader = adapted(part.shader, Shader)
    asked = None if shader is None else shader.reads
    shape = _Shape(layers, picture.size, None, picture.size)
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
        return (
            *(found.ids, found.params, found.row, found.depth, found.overflow),
            *(x for x in (sides, settled) if x is not None),
            *(np.asarray(gbuffer[name], spec.dtype) for name, spec in attributes.items()),
        )

    sides = [ArraySpec((layers, *picture.size), np.int16)] if tells else []
    amid = [ArraySpec(picture.size, np.bool_)] if settles else []
    specs = *shape.specs(surface.sample_widths), *sides, *amid, *attributes.values()
    matrices = [m for camera in cameras for m in (camera.view, camera.projection)]
    results = engine.call_host(host, specs, *matrices, *transform, *leaves(inputs))
    rest = 5 + len(sides) + len(amid)
    return Samples(
        *results[:5],
        gbuffer=dict(zip(attributes, results[rest:], strict=True)) if host_theta is not None else None,
        asked=asked,
        centered=surface.centered,
        facing=results[5] if tells else None,
        settled=results[rest - 1] if settles else None,
    )


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
        self._size, self._picture = needed.size or 0.0, picture
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
