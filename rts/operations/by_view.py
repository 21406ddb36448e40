"""Which view each of some rows is of: numbers (N,) int32 in order, from 1 on, and 0 for rows behind that are unused."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from rts.arrays.engines import namespace
from rts.arrays.trees import Array


def ranges_of_views(view: np.ndarray, count: int) -> Iterator[tuple[int, slice]]:
    """Each of so many views, counted from 0 on, and where its rows are."""
    ends = np.searchsorted(view[: rows_in_views(view)], np.arange(1, count + 2))
    return enumerate(itertools.starmap(slice, itertools.pairwise(ends.tolist())))


def rows_in_views(view: np.ndarray) -> int:
    """How many rows are those of a view."""
    return int(np.count_nonzero(view))


def index_of_views(view: Array) -> Array:
    """(N,) the view of each row, counted from 0 on; of rows that are not used, the first."""
    return view - namespace(view).astype(view > 0, view.dtype)


def of_view(x: np.ndarray | None, place: int | slice) -> np.ndarray | None:
    """What is there of an array, if there is one."""
    return None if x is None else x[place]
