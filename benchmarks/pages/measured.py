"""Tables as scripts print them, kept as JSON: a list for each page, in benchmarks/results/tables."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

from benchmarks.report import table

FOLDER = Path(__file__).parents[1] / "results/tables"
CELLS = re.compile(r"(?<!\\)\|")


class Measured(NamedTuple):
    """A table: texts of its cells.

    Attributes:
        header: names of the columns.
        rows: lines of as many cells.
    """

    header: list[str]
    rows: list[list[str]]

    def __str__(self) -> str:
        return table(self.header, self.rows)


def in_markdown(text: str) -> Iterator[Measured]:
    """The tables of a text in Markdown, in order."""
    lines: list[list[str]] = []
    for line in [*text.splitlines(), ""]:
        if line.startswith("|"):
            lines.append([cell.strip() for cell in CELLS.split(line.strip().strip("|"))])
        elif lines:
            yield Measured(lines[0], lines[2:])
            lines = []


def kept(page: str) -> list[Measured]:
    """The tables of a page, named without ".md"; none if nothing is kept of it."""
    path = FOLDER / f"{page}.json"
    return [Measured(**found) for found in json.loads(path.read_text())] if path.exists() else []


def keep(page: str, tables: list[Measured]) -> None:
    """Write the tables of a page, a row a line."""
    lines = []
    for found in tables:
        header, rows = (json.dumps(x, ensure_ascii=False) for x in found)
        rows = rows.replace("], [", "],\n  [").replace("[[", "[\n  [").replace("]]", "]\n ]")
        lines.append(f' {{"header": {header},\n "rows": {rows}}}')
    (FOLDER / f"{page}.json").write_text("[\n" + ",\n".join(lines) + "\n]\n")


def take(text: str, page: str) -> int:
    """Replace kept tables of a page by those of a text that have the same columns, in order, and write the file.

    Returns:
        How many tables were replaced.

    Raises:
        ValueError: a table of the text has columns of no kept table.
    """
    tables, free = kept(page), list(range(len(kept(page))))
    new = list(in_markdown(text))
    for found in new:
        place = next((n for n in free if tables[n].header == found.header), None)
        if place is None:
            raise ValueError(f"no table of {page} has the columns {found.header}")
        free.remove(place)
        tables[place] = found
    keep(page, tables)
    return len(new)


def marks() -> dict[str, Callable[[], str]]:
    """Names of marks, "page/1" for the first table of a page → functions that make their tables."""
    found = {}
    for path in sorted(FOLDER.glob("*.json")):
        for number, own in enumerate(kept(path.stem), 1):
            found[f"{path.stem}/{number}"] = partial(str, own)
    return found
