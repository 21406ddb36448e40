"""Rows of several views, and operations on them.

The view of each row is a number, (N,) int32: in ascending order from 1 on, then 0 for unused rows at the end.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import numpy as np

from rts.arrays.engines import namespace
from rts.arrays.trees import Array
from rts.errors import InputError
from rts.operations.operation import Arrays, Operation, Some


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


def operation_of_views(name: str, operation: Operation, specification: Callable[..., Array], placed: bool) -> Operation:
    """An operation on matrices (B, R, 4), points (N, 3) and the view (N,) of each: the points of each by its matrix.

    Unused rows become zero.

    Args:
        name: its name.
        operation: the operation on the matrix (R, 4) and the points (N, 3) of one view.
        specification: the operation in array code.
        placed: True for one more operand (B, 2), what to add to the first two columns of each view.
    """

    def each(operands: Arrays) -> Iterator[tuple[int, slice, Arrays]]:
        """For each view its index, the slice of its points, and its operands of `operation`."""
        rows, points, view, *places = operands
        if rows.shape[2] != 4 or points.shape != (len(view), 3) or any(x.shape != (len(rows), 2) for x in places):
            shapes = ", ".join(str(x.shape) for x in operands)
            expected = f"(B, R, 4), (N, 3), (N,){' and (B, 2)' * placed}"
            raise InputError(f"the operation {name} was given shapes {shapes}; expected {expected}")
        for b, part in ranges_of_views(view, len(rows)):
            yield b, part, (rows[b], points[part])

    def forward(operands: Arrays, out: np.ndarray) -> None:
        out[rows_in_views(operands[2]) :] = 0
        for b, part, of_view in each(operands):
            operation.forward(of_view, out[part])
            if placed:
                out[part, :2] += operands[3][b]

    def push(operands: Arrays, tangents: Some, out: np.ndarray) -> None:
        out[rows_in_views(operands[2]) :] = 0
        for b, part, of_view in each(operands):
            operation.push(of_view, [_of_view(tangents[0], b), _of_view(tangents[1], part)], out[part])

    def pull(operands: Arrays, g: np.ndarray, results: Some) -> None:
        for b, part, of_view in each(operands):
            operation.pull(of_view, g[part], [_of_view(results[0], b), _of_view(results[1], part)])

    return Operation(
        name,
        specification,
        ranks=(3, 2, 1, 2) if placed else (3, 2, 1),
        shape=lambda rows, points, *_: operation.shape(rows[1:], points),
        forward=forward,
        push=push,
        pull=pull,
        differentiable=2,
        packed=(1, 2),
        packed_result=True,
        used=lambda operands: rows_in_views(operands[2]),
    )


def _of_view(x: np.ndarray | None, place: int | slice) -> np.ndarray | None:
    """`x[place]`, the entries at an index or in a slice; None stays None."""
    return None if x is None else x[place]
