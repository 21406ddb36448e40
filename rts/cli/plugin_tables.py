"""The tables that `rts plugins` prints."""

from __future__ import annotations

from rich.markup import escape
from rich.table import Column, Table

from rts import registry
from rts.testing.compatibility import DIFFERING, SHARE, pairs

OK = (
    f"ok: a small image of the surface's example is finite and not empty; of triangles, at most {SHARE:.0%} of "
    f"its pixels are more than {DIFFERING:g} off those of the sampler 'reference'; and its gradient in theta, "
    f"where the engine has derivatives, is finite and not zero"
)
"""What the matrix says of a pair that works, and all that it says."""


def plugin_table() -> Table:
    """Every plugin, and whether it loads."""
    table = Table("group", "name", "from", Column("state", overflow="fold"))
    for group, name, distribution, error in registry.survey():
        state = "[green]ready[/]" if error is None else f"[red]{escape(error)}[/]"
        table.add_row(group.removeprefix("rts."), name, distribution, state)
    return table


def matrix_table() -> Table:
    """Every surface with every sampler, tried in every engine."""
    engines = registry.plugins("rts.engines")
    table = Table("surface", "sampler", *engines, Column("why not", overflow="fold"), caption=OK)
    for pair in pairs():
        cells = ["[green]ok[/]" if pair.problems[e] is None else "[red]no[/]" for e in engines]
        reasons = dict.fromkeys(p for p in pair.problems.values() if p is not None)
        table.add_row(pair.surface, pair.sampler, *cells, escape("\n".join(reasons)))
    return table
