"""The tables that `rts plugins` prints."""

from __future__ import annotations

from rich.markup import escape
from rich.table import Column, Table

from rts import registry
from rts.capabilities import in_words
from rts.testing.compatibility import DIFFERING, SHARE, pairs

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
    for info in registry.survey():
        able = escape(in_words(info.capabilities))
        table.add_row(info.group.removeprefix("rts."), info.name, info.distribution, _state(info), able)
    return table


def _state(info: registry.PluginInfo) -> str:
    if info.error is not None:
        return f"[red]{escape(info.error)}[/]"
    if info.install is not None:
        text = f"ready, but without {', '.join(info.missing)}: pip install '{info.install}'"
        return f"[yellow]{escape(text)}[/]"
    return "[green]ready[/]"


def matrix_table() -> Table:
    """A table of every surface with every sampler, tried in every engine."""
    engines = registry.plugins("rts.engines")
    table = Table("surface", "sampler", *engines, Column("why not", overflow="fold"), caption=OK)
    for pair in pairs():
        cells = ["[green]ok[/]" if pair.problems[e] is None else "[red]no[/]" for e in engines]
        reasons = dict.fromkeys(p for p in pair.problems.values() if p is not None)
        table.add_row(pair.surface, pair.sampler, *cells, escape("\n".join(reasons)))
    return table
