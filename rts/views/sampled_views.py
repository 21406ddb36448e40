"""Several views, sampled one by one, and laid side by side in one picture, so that one splat serves all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array
from rts.contracts.records import Cells, Sampled
from rts.sampling.picture import Picture, renumbered, stencils_side_by_side
from rts.sampling.tables import in_one_table


class Views(NamedTuple):
    """Samples of several views, side by side.

    Attributes:
        sampled: the samples, on the grid of the picture; the border is that of each view. In the table of a part the
            samples of one view stand together, in the order of the views. Parts have a cell for each row.
        picture: the layout of the views.
        view: for each part (N,) int32, the number of each row's view, from 1 on.
        counts: for each part (B,), the number of rows of each view; None if unknown, as in traced programs.
    """

    sampled: Sampled
    picture: Picture
    view: tuple[Array, ...]
    counts: tuple[np.ndarray, ...] | None


def with_counts(sampled: Sampled, picture: Picture, counts: tuple[np.ndarray, ...]) -> Views:
    """`Views` of samples with these numbers of rows; which rows are in use is unknown where they are padded."""
    engine, numbers = engine_of(sampled.row), np.arange(1, picture.views + 1, dtype=np.int32)
    view = tuple(engine.constant(np.repeat(numbers, of_part), sampled.row) for of_part in counts)
    return Views(sampled, picture, view, None if engine.padded(sampled.row) else counts)


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
    for index in range(len(first.samples)):
        tables, rows = [view.samples[index] for view in views], []
        for table, start, count in zip(tables, starts[:, index], counts[:, index], strict=True):
            every = engine.constant(np.arange(start, start + count, dtype=np.int32), table.row)
            rows.append(xp.where(xp.any(table.row >= 0), every, -1))
        samples.append(replace(in_one_table(tables), cells=Cells(xp.concat(rows)[None, None, :])))
    row = picture.laid_out(renumbered(xp.stack([view.row for view in views]), first_rows, shifts), -1)
    found = [view.stencil for view in views if view.stencil is not None]
    sampled = replace(
        first,
        samples=tuple(samples),
        cells=Cells(row),
        overflow=sum(view.overflow for view in views),
        stencil=stencils_side_by_side(found, picture, first_rows, shifts) if found else None,
    )
    return with_counts(sampled, picture, tuple(counts.T))
