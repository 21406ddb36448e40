"""Rows of a comparison that are worth their time: the Pareto front, and the fastest row within an error.

A row is plain data: `mode`, `settings`, `error`, and `ms`, the quartiles of its time, or None where only the error was
measured. Rows without time, or with an error that is no number, take no part.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import Any

Row = Mapping[str, Any]

LEVELS = (0.1, 0.03, 0.01)
"""Errors that summaries name the fastest row for."""


def timed(row: Row) -> bool:
    """True where both the time and the error of a row are known."""
    return row["ms"] is not None and math.isfinite(row["ms"]["median"]) and math.isfinite(row["error"])


def milliseconds(row: Row) -> float:
    """The median time of a row that is `timed`."""
    return row["ms"]["median"]


def front(rows: Sequence[Row]) -> list[bool]:
    """Find the rows on the Pareto front of error and time of their mode.

    A row is on it unless another of its mode has neither more error nor more time, and less of one of them. Equal rows
    are on it together.

    Args:
        rows: of any modes.

    Returns:
        For each row, whether it is on the front.
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
    """A comparison whose rows say whether they are on the front; the one given is left as it is."""
    rows = comparison["rows"]
    return {**comparison, "rows": [{**row, "front": on} for row, on in zip(rows, front(rows), strict=True)]}


def best_within(rows: Iterable[Row], error: float) -> Row | None:
    """The fastest row whose error is at most `error`; of equally fast ones that with the least error.

    Args:
        rows: of one mode, or of those that are to be compared.
        error: relative, such as 0.03.

    Returns:
        One of the rows, or None where none is as accurate.
    """
    within = [row for row in rows if timed(row) and row["error"] <= error]
    return min(within, key=lambda row: (milliseconds(row), row["error"]), default=None)
