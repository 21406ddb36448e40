"""The view of each row: numbers (N,) int32 in ascending order from 1 on, then 0 for unused rows at the end."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from rts.arrays.engines import namespace
from rts.arrays.trees import Array


def ranges_of_views(view: np.ndarray, count: int) -> Iterator[tuple[int, slice]]:
    """Pairs for `count` views: the index, from 0 on, and the slice of rows whose `view` it is."""
    ends = np.searchsorted(view[: rows_in_views(view)], np.arange(1, count + 2))
    return enumerate(itertools.starmap(slice, itertools.pairwise(ends.tolist())))


def rows_in_views(view: np.ndarray) -> int:
    """Number of rows that belong to a view."""
    return int(np.count_nonzero(view))


def index_of_views(view: Array) -> Array:
    """The view (N,) of each row, counted from 0 on; unused rows get 0 as well."""
    return view - namespace(view).astype(view > 0, view.dtype)


def of_view(x: np.ndarray | None, place: int | slice) -> np.ndarray | None:
    """`x[place]`, the entries at an index or in a slice; None stays None."""
    return None if x is None else x[place]
