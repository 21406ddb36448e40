"""Progress of long measurements, on standard error."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from rts.plugin_api.checks import shows_bar

Phase = Callable[[str, int], Callable[[], None]]
"""(name of a phase, number of its steps) → a function to call after each step."""


@contextlib.contextmanager
def phases(wanted: bool | None) -> Iterator[Phase]:
    """A context with a `Phase`, a function that shows a bar for each phase, with the time that is left.

    Args:
        wanted: True to show bars, False for none; None to show them on a terminal.
    """
    if not shows_bar(wanted):
        yield lambda what, steps: lambda: None
        return
    from rich import progress as bars
    from rich.console import Console

    left, taken = bars.TimeRemainingColumn(), bars.TimeElapsedColumn()
    texts = [bars.TextColumn(text) for text in ("{task.description}", "left,", "taken")]
    columns = (texts[0], bars.BarColumn(), bars.MofNCompleteColumn(), left, texts[1], taken, texts[2])
    with bars.Progress(*columns, console=Console(stderr=True)) as bar:

        def phase(what: str, steps: int) -> Callable[[], None]:
            task = bar.add_task(what, total=steps)
            return lambda: bar.advance(task)

        yield phase
