"""Records of the table of failures: its cells and its rows, each a way to fail."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rts_compare.failures.table_columns import Method

VERDICTS = ("ok", "degraded", "failed", "cannot")


class Outcome(NamedTuple):
    """A cell of the table: how a method did on a way to fail.

    Attributes:
        verdict: "ok", "degraded", "failed", or "cannot" where the method does not apply.
        text: the row's figure, a few characters; for "cannot" the reason, a clause.
        numbers: what was measured, by name; `nan` counts values that are not finite.
    """

    verdict: str
    text: str
    numbers: Mapping[str, Any] = {}


class Context(NamedTuple):
    """The effort with which cells are measured.

    Attributes:
        seeds: how many starts fits have.
        samples: the square root of the number of points a pixel on each grid of true derivatives.
        folder: where true derivatives are kept; None for the folder of caches.
        steps: of fits.
    """

    seeds: int = 20
    samples: int = 8
    folder: Path | None = None
    steps: int = 50


class Row(NamedTuple):
    """A way to fail.

    Attributes:
        name: of the row.
        note: what is done, what the figure is, and from where on it counts as degraded and as failed.
        measure: (method, context) → the cell.
        why: why our own cells fail or are degraded, and what helps; "" where none are.
    """

    name: str
    note: str
    measure: Callable[[Method, Context], Outcome]
    why: str = ""


def cannot(reason: str) -> Outcome:
    """The cell of a method that does not apply."""
    return Outcome("cannot", reason)


def graded(value: float, ok: float, degraded: float, nan: int = 0) -> str:
    """The verdict on a figure that should be small: "ok" and "degraded" up to these limits, else "failed".

    Also "failed" if the figure is not finite, or `nan` is not zero.
    """
    if nan or not np.isfinite(value) or value > degraded:
        return "failed"
    return "ok" if value <= ok else "degraded"
