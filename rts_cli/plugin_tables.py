"""The tables that `rts plugins` prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.box import SQUARE
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from rts import plugins
from rts.results import PluginInfo
from rts.tool_api.plugins import survey
from rts_testing.compatibility import DIFFERING, SHARE, pairs

OK = (
    f"ok: a small image of the surface's example is finite and not empty; of triangles, at most {SHARE:.0%} of "
    f"its pixels are more than {DIFFERING:g} off those of the sampler 'reference'; and its gradient in theta, "
    f"where the engine has derivatives, is finite and not zero"
)
"""Caption of the matrix: the exact meaning of "ok"."""


def plugin_table() -> Table:
    """A table of all plugins, with their state and capabilities."""
    columns = (Column(name, no_wrap=True) for name in ("group", "name"))
    table = Table(*columns, "from", Column("state", overflow="fold"), Column("can", overflow="fold"))
    for info in survey():
        able = escape(_in_words(info.capabilities))
        table.add_row(info.group.removeprefix("rts."), info.name, info.distribution, _state(info), able)
    return table


def _in_words(values: Mapping[str, Any]) -> str:
    """Capabilities in a line: names of those that are True, names and values of others; False and None are left out."""
    words = []
    for name, value in values.items():
        shown = name.replace("_", " ")
        if value is True:
            words.append(shown)
        elif isinstance(value, (tuple, list, frozenset)):
            members = sorted(value) if isinstance(value, frozenset) else value
            words.append(f"{shown} {' '.join(map(str, members)) or 'nothing'}")
        elif value is not False and value is not None:
            words.append(f"{shown} {value}")
    return ", ".join(words)


def _state(info: PluginInfo) -> str:
    if info.error is not None:
        return f"[red]{escape(info.error)}[/]"
    if info.install is not None:
        text = f"ready, but without {', '.join(info.missing)}: pip install '{info.install}'"
        return f"[yellow]{escape(text)}[/]"
    return "[green]ready[/]"


def print_matrix(console: Console, only: Sequence[str] = ()) -> None:
    """Print every surface with every sampler, tried in every engine: a row as soon as it is known.

    Args:
        console: the console to print to; it is flushed after each row.
        only: names of surfaces, samplers and engines to try; empty for all.
    """
    engines = plugins("rts.engines")
    engines, rows = [e for e in engines if e in only] or engines, pairs(only)
    first = [("surface", *plugins("rts.surfaces")), ("sampler", *plugins("rts.samplers"))]
    widths = [max(map(len, names)) for names in first] + [max(len(e), 2) for e in engines]

    def show(*cells: str) -> None:
        columns = (Column(width=width, no_wrap=True) for width in widths)
        row = Table(*columns, Column(overflow="fold"), show_header=False, show_edge=False, box=SQUARE)
        row.add_row(*cells)
        console.print(row)
        console.file.flush()  # What is piped waits for its buffer to be full.

    show("surface", "sampler", *engines, "why not")
    for pair in rows:
        marks = ["[green]ok[/]" if pair.problems[e] is None else "[red]no[/]" for e in engines]
        reasons = dict.fromkeys(p for p in pair.problems.values() if p is not None)
        show(pair.surface, pair.sampler, *marks, escape("\n".join(reasons)))
    console.print(OK)
