"""Rows of a comparison that are worth their time: the Pareto front, and the fastest row within an error.

A row is plain data: `mode`, `settings`, `error`, and `ms`, the quartiles of its time, or None where only the error was
measured. Rows without time, or whose error is not finite, are never chosen.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import Any

Row = Mapping[str, Any]

LEVELS = (0.1, 0.03, 0.01)
"""Bounds on the error; summaries name the fastest row within each."""


def timed(row: Row) -> bool:
    """True if a row has a time, and both its median and the error are finite."""
    return row["ms"] is not None and math.isfinite(row["ms"]["median"]) and math.isfinite(row["error"])


def milliseconds(row: Row) -> float:
    """The median time of a row that is `timed`."""
    return row["ms"]["median"]


def front(rows: Sequence[Row]) -> list[bool]:
    """Find the rows on the Pareto front of error and time of their mode.

    A row is on the front unless another row of its mode has no more error and no more time, and less of either. Equal
    rows are both on the front.

    Args:
        rows: of any modes.

    Returns:
        For each row, True if it is on the front.
    """
    found = [False] * len(rows)
    order = [(row["mode"], milliseconds(row), row["error"], index) for index, row in enumerate(rows) if timed(row)]
    for _, of_mode in groupby(sorted(order), key=lambda entry: entry[0]):
        least = math.inf
        for _, at_once in groupby(of_mode, key=lambda entry: entry[1]):
            entries = list(at_once)
            error = entries[0][2]
            if error < least:
                least = error
                for entry in entries:
                    found[entry[3]] = entry[2] == error
    return found


def marked(comparison: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a comparison in which "front" of each row is True on the Pareto front."""
    rows = comparison["rows"]
    return {**comparison, "rows": [{**row, "front": on} for row, on in zip(rows, front(rows), strict=True)]}


def best_within(rows: Iterable[Row], error: float) -> Row | None:
    """The fastest row whose error is at most `error`; of equally fast rows the one with the least error.

    Args:
        rows: the rows to choose from, usually of one mode.
        error: relative, such as 0.03.

    Returns:
        One of the rows; None if no timed row is accurate enough.
    """
    within = [row for row in rows if timed(row) and row["error"] <= error]
    return min(within, key=lambda row: (milliseconds(row), row["error"]), default=None)
