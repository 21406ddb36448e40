"""The JSON files of benchmarks/results."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from benchmarks.pages import measured

RESULTS = Path(__file__).parents[1] / "results"
PAGES = Path(__file__).parents[2] / "docs/results"


@cache
def kept(name: str) -> Any:
    """What a JSON file of benchmarks/results holds."""
    return json.loads((RESULTS / f"{name}.json").read_text())


def outcome(row: str, method: str) -> Mapping:
    """A cell of the table of stability: its verdict, text and numbers."""
    table = kept("stability")
    cells = next(found["cells"] for found in table["rows"] if found["name"] == row)
    return cells[table["methods"].index(method)]


def written(page: str, *head: str, keys: int = 1) -> tuple[list[str], dict[str, list[str]]]:
    """A table of `measured`, by the texts of its first columns.

    Args:
        page: name of the page, without ".md".
        head: names of the table's first columns, such as "256², ms".
        keys: how many cells name a line.

    Returns:
        The names of its other columns; and the name of each line, cells joined by " | " → its other cells, as text.
    """
    found = next(t for t in measured.kept(page) if tuple(t.header[: len(head)]) == head)
    return found.header[keys:], {" | ".join(row[:keys]): row[keys:] for row in found.rows}


def number(text: str) -> float:
    """The number that a cell begins with, such as 4.35 of "4.35 (4.21–4.53)" and 2464 of "2,464"."""
    return float(text.strip("*").split(" ")[0].replace(",", ""))
