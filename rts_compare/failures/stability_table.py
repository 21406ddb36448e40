"""A table of methods and ways to fail, by experiment."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rts.errors import InputError
from rts.plugin_api.checks import is_count, quoted
from rts.tool_api.files import output_folder, writing
from rts_compare.environment import environment
from rts_compare.failures.table_cells import Context, Outcome, Row, cannot
from rts_compare.failures.table_columns import METHODS, Method
from rts_compare.failures.table_rows import ROWS
from rts_compare.kept_measurements import KeptMeasurements
from rts_diagnostics.progress import phases

MARKS = {"ok": "", "degraded": "~ ", "failed": "✗ ", "cannot": "–"}
PACKAGES = ("rasterize-then-splat", "numpy", "torch", "deodr", "mitsuba")


class Stability(NamedTuple):
    """The table of ways to fail against methods.

    Attributes:
        methods: the names of the columns.
        rows: each row, and its cells in the order of `methods`.
        environment: when and where it was measured.

    Printed, it is a table in Markdown.
    """

    methods: list[str]
    rows: list[tuple[Row, list[Outcome]]]
    environment: dict[str, Any]

    def __repr__(self) -> str:
        return self.markdown()

    def cell(self, row: str, method: str) -> Outcome:
        """One cell, by the names of its row and column."""
        cells = next(cells for found, cells in self.rows if found.name == row)
        return cells[self.methods.index(method)]

    def markdown(self) -> str:
        """The table in Markdown; ~ is degraded, ✗ failed, – cannot."""
        lines = [["", *self.methods], ["---"] * (len(self.methods) + 1)]
        lines += [[row.name, *(in_words(cell) for cell in cells)] for row, cells in self.rows]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"

    def data(self) -> dict[str, Any]:
        """The environment, the methods and the rows with their cells, in types that JSON has."""
        rows = [
            {"name": row.name, "note": row.note, "why": row.why, "cells": [_plain(cell._asdict()) for cell in cells]}
            for row, cells in self.rows
        ]
        return {"environment": self.environment, "methods": self.methods, "rows": rows}

    def write(self, folder: Any) -> None:
        """Write stability.md and stability.json to a folder.

        Raises:
            InputError: it cannot be written to.
        """
        path = output_folder(folder)
        texts = {"stability.md": self.markdown(), "stability.json": json.dumps(self.data(), indent=1) + "\n"}
        for name, text in texts.items():
            with writing(path / name):
                path.mkdir(parents=True, exist_ok=True)
                (path / name).write_text(text, encoding="utf-8")


def in_words(cell: Outcome) -> str:
    """The text of a cell in Markdown, after the mark of its verdict."""
    return MARKS["cannot"] if cell.verdict == "cannot" else MARKS[cell.verdict] + cell.text


def stability(
    rows: Sequence[str] | None = None,
    methods: Sequence[str] | None = None,
    *,
    seeds: int = 20,
    steps: int = 50,
    truth_samples: int = 8,
    output: Any = None,
    fresh: bool = False,
    more: Sequence[Row] = (),
    progress: bool | None = None,
) -> Stability:
    """Try methods on ways to fail, with the library on torch.

    Rows are scenes and fits that are hard, columns the library's splatters and two other renderers, which the extra
    `bench` brings. Each cell says how it went, by a figure; a row's `note` says which figure, and from where on it
    counts as a failure, and its `why` explains the failures of the library itself.

    Args:
        rows: names; None for all.
        methods: names; None for all.
        seeds: how many starts fits have; Mitsuba has at most 5.
        steps: of each fit.
        truth_samples: the square root of the number of points a pixel on each grid of true derivatives.
        output: a folder for the table and its measurements, from which an interrupted run goes on; None for neither.
        fresh: whether to measure all cells anew. Otherwise cells in `output` are taken, even if the code has changed.
        more: further rows, before the others.
        progress: whether to show progress; None for where standard error is a terminal.

    Raises:
        InputError: there is no such row or method, or an argument is wrong; before anything is measured.
        PluginError: torch is not installed.
    """
    if not isinstance(more, (list, tuple)) or not all(isinstance(row, Row) for row in more):
        raise InputError(f"more is {quoted(more)}; expected a list of rows")
    taken = [*more, *_named("rows", rows, {row.name: row for row in ROWS})]
    columns: list[Method] = _named("methods", methods, {method.name: method for method in METHODS})
    for name, value in {"seeds": seeds, "steps": steps, "truth_samples": truth_samples}.items():
        if not is_count(value):
            raise InputError(f"{name} is {quoted(value)}; expected a whole number, at least 1")
    folder = None if output is None else output_folder(output)
    kept = None if folder is None else folder / ".stability.jsonl"
    if fresh and kept is not None:
        kept.unlink(missing_ok=True)
    measured = KeptMeasurements(kept)
    context = Context(seeds, truth_samples, folder, steps)
    found: list[tuple[Row, list[Outcome]]] = []
    with phases(progress) as phase:
        for row in taken:
            done, cells = phase(row.name, len(columns)), []
            for method in columns:
                cells.append(_measured(row, method, context, measured))
                done()
            found.append((row, cells))
    table = Stability(
        [m.name for m in columns], found, {**environment(PACKAGES), "date": measured.since, "seeds": seeds}
    )
    if folder is not None:
        table.write(folder)
    return table


def _named(what: str, wanted: Sequence[str] | None, known: Mapping[str, Any]) -> list[Any]:
    """The values of `known` under the names `wanted`, or under one name; all for None.

    Raises:
        InputError: a name is unknown, or `wanted` is no list of names; the message calls `wanted` by `what`.
    """
    if wanted is None:
        return list(known.values())
    wanted = [wanted] if isinstance(wanted, str) else wanted
    if not isinstance(wanted, (list, tuple)) or not all(isinstance(name, str) for name in wanted):
        raise InputError(f"{what} is {quoted(wanted)}; expected a list of names, or None for all")
    for name in wanted:
        if name not in known:
            close = difflib.get_close_matches(str(name), known, n=1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            names = ", ".join(known)
            names = names if len(names) <= 200 else f"{names[:197]}..."
            raise InputError(f"{what} has {quoted(name)}; there are {names}{hint}")
    return [known[name] for name in wanted]


def _measured(row: Row, method: Method, context: Context, measured: KeptMeasurements) -> Outcome:
    """A cell, measured now, or by an earlier run that kept it; "cannot" where a data file is missing."""
    key = (row.name, method.name, context.seeds, context.steps, context.samples)
    kept = measured.get(*key)
    if kept is None:
        try:
            cell = row.measure(method, context)
        except InputError as error:
            if "is missing" not in str(error):
                raise
            cell = cannot(str(error))
        kept = measured.put(_plain(cell._asdict()), *key)
    return Outcome(**kept)


def _plain(value: Any) -> Any:
    """A value in types that JSON has: reals to four digits, NaN and infinity as words, arrays as lists."""
    if isinstance(value, Mapping):
        return {key: _plain(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.4g}") if math.isfinite(value) else str(value)
    return value
