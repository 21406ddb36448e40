"""Outlines of several views that were sampled as one picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rts.arrays.engines import engine_of, host_value
from rts.arrays.trees import Array, map_leaves
from rts.compiling.threads import each
from rts.outlines.gaps import Fronts
from rts.outlines.of_scene import real_of
from rts.outlines.points import Points, at_centres, found_in_views
from rts.sampling.entries import inputs_of
from rts.sampling.picture import stencils_side_by_side
from rts.sampling.tables import in_one_table, taken_rows
from rts.views.sampled_views import Sampling, Views, with_counts


def with_outlines_of_views(views: Views, sampling: Sampling) -> Views:
    """The samples of views, none of them traced, with `Sampled.stencil` and the samples beside breaks.

    Outlines are found view by view, on all cores. Samples beside breaks are taken for all views at once, and put behind
    those of their view.
    """
    sampled, picture, scenes = views.sampled, views.picture, sampling.scenes
    assert views.counts is not None
    grids = sampling.grids
    told, none = sampling.settings.told(scenes), [None] * len(scenes[0].parts)
    first = Points.of(scenes[0], grids[0], inputs_of(scenes[0]), told)
    further = [(scene._replace(entries=first.entries), grid) for scene, grid in zip(scenes[1:], grids[1:], strict=True)]
    points = [first, *each(lambda scene_and_grid: Points.of(*scene_and_grid, none, told), further)]
    centres = at_centres(map_leaves(host_value, sampled.cells), sampled.samples)
    layers = [Fronts(*(np.ascontiguousarray(x[:, *place]) for x in centres)) for place in picture.places()]
    found, more = found_in_views(points, layers)
    samples, counts, moved, cells, start = [], [], [], sampled.cells, 0
    rows, starts = [of.rows.copy() for of in found], np.zeros(len(sampled.samples), np.int32)
    for part, (samples_of_part, extra) in enumerate(zip(sampled.samples, more, strict=True)):
        count, here = samples_of_part.ids.shape[0], [(of.parts == part) & (of.rows >= 0) for of in found]
        beside = np.array([np.count_nonzero(x) for x in here])
        order = _view_after_view(views.counts[part], beside)
        place = np.full(count + extra.ids.shape[0], -1, np.int32)
        place[order] = np.arange(len(order), dtype=np.int32)
        at = engine_of(samples_of_part.ids).constant(order.astype(np.int32), samples_of_part.ids)
        samples.append(
            taken_rows(in_one_table([samples_of_part, extra]), at).replace(row=_moved(samples_of_part.row, place))
        )
        counts.append(views.counts[part] + beside)
        moved.append(start + place[:count])
        for at, of, x in zip(rows, found, here, strict=True):
            at[x] = start + place[count + of.rows[x]]
        start += len(order)
    cells = replace(cells, row=_moved(sampled.row, np.concatenate(moved)), triangle=None)
    row, real, nowhere = host_value(cells.row), real_of(scenes[0]), np.zeros((len(found), 1), np.int32)
    stencils = [
        of._replace(rows=at).stencil(starts, np.ascontiguousarray(row[:, *place]), told, real)
        for of, at, place in zip(found, rows, picture.places(), strict=True)
    ]
    joint = stencils_side_by_side(stencils, picture, nowhere, nowhere)
    sampled = replace(sampled, samples=tuple(samples), cells=cells, stencil=joint)
    return with_counts(sampled, picture, tuple(counts))


def _view_after_view(cells: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """The order that puts rows beside breaks behind those of cells of their view, given the number (B,) of both."""
    counts = np.stack([cells, beside])
    ends = np.cumsum(counts).reshape(counts.shape)
    return np.concatenate([np.arange(end - n, end) for end, n in zip(ends.T.flat, counts.T.flat, strict=True)])


def _moved(row: Array, place: np.ndarray) -> Array:
    """The rows of cells, −1 for none, with a new `place` for each."""
    rows = host_value(row)
    return engine_of(row).constant(np.where(rows >= 0, place[rows], np.int32(-1)), row)
