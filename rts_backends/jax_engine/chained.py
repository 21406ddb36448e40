"""Two operations as one: what the first hands to the second is no array of the program."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rts.plugin_api.arrays import Array
from rts.plugin_api.operations import Operation
from rts.plugin_api.threads import read_only


class _Kept(NamedTuple):
    """What the value leaves to the derivatives: the first result, and what the second operation keeps."""

    between: np.ndarray
    kept: Any


def may_chain(first: Operation, second: Operation) -> bool:
    """Whether `second` can take what `first` gives as its first operand inside of one operation."""
    rows = first.packed_result and 0 in second.packed and len(first.packed) > 0
    told = second.used is None or second.takes_cheap  # The rows in use are counted before the first is computed.
    return first.cheap and rows and told and not first.keeps and first.differentiable == len(first.ranks)


@functools.cache
def chained(first: Operation, second: Operation) -> Operation:
    """`second` of what `first`, which has no parameters, gives as its first operand, and of its other operands."""
    count = len(first.ranks)
    used = second.used

    def specification(*operands: Array, **params: Any) -> Array:
        return second.specification(first.specification(*operands[:count]), *operands[count:], **params)

    def shape(*shapes: tuple[int, ...], **params: Any) -> tuple[int, ...]:
        return second.shape(first.shape(*shapes[:count]), *shapes[count:], **params)

    def between(operands: Sequence[np.ndarray]) -> np.ndarray:
        return read_only(first.value_on_host(operands[:count], {})[0])

    def forward(operands: Sequence[np.ndarray], out: np.ndarray, **params: Any) -> _Kept:
        made = between(operands)
        return _Kept(made, second.forward((made, *operands[count:]), out, **params))

    def push(
        operands: Sequence[np.ndarray],
        tangents: Sequence[np.ndarray | None],
        out: np.ndarray,
        *,
        kept: _Kept | None,
        **params: Any,
    ) -> None:
        made, own = kept or (between(operands), None)
        moved = None
        if any(t is not None for t in tangents[:count]):
            moved = np.empty((len(out), *made.shape), made.dtype)
            first.push_on_host(operands[:count], tangents[:count], moved, None, {})
        second.push_on_host((made, *operands[count:]), [moved, *tangents[count:]], out, own, params)

    def pull(
        operands: Sequence[np.ndarray],
        g: np.ndarray,
        results: Sequence[np.ndarray | None],
        *,
        kept: _Kept | None,
        **params: Any,
    ) -> None:
        made, own = kept or (between(operands), None)
        wanted = any(x is not None for x in results[:count])
        g_made = np.zeros_like(made) if wanted else None
        second.pull_on_host((made, *operands[count:]), g, [g_made, *results[count:]], own, params)
        if g_made is not None:
            first.pull_on_host(operands[:count], g_made, results[:count], None, {})

    return Operation(
        f"{second.name} of {first.name}",
        specification,
        (*first.ranks, *second.ranks[1:]),
        shape,
        forward,
        push,
        pull,
        differentiable=count + second.differentiable - 1,
        packed=_shifted(first.packed, second.packed, count),
        packed_result=second.packed_result,
        used=None if used is None else lambda operands: used((operands[first.packed[0]], *operands[count:])),
        even=_shifted(first.even, second.even, count),
        keeps=True,
        sweeps=True,
    )


def _shifted(first: tuple[int, ...], second: tuple[int, ...], count: int) -> tuple[int, ...]:
    """Indices of operands of both operations; the first has so many, and gives that of index 0 of the second."""
    return *first, *(i + count - 1 for i in second if i > 0)
