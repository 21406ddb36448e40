"""Functions of many rows, called on some rows at a time so that memory stays bounded; and a progress bar."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from rts import Engine, engine_of
from rts.plugin_api.arrays import Array
from rts.plugin_api.checks import shows_bar

CHUNK = 8192
"""Rows at a time: activations of a network of 128 units are then some 20 MB."""


def in_chunks(f: Callable[..., Array], rows: int, *arrays: Array) -> Array:
    """The result of `f(*arrays)`, computed from at most `rows` rows at a time, and once more for its gradient.

    Args:
        f: arrays (M, ·) → (M, ·); each row of the result depends on the same row of the arrays alone.
        rows: the largest number of rows at a time.
        *arrays: (N, ·) each, of one engine.

    Returns:
        (N, ·). From value to gradient only results stay in memory, if the engine supports that (`Engine.checkpoint`).
        For N ≤ `rows` this is a plain call of `f`.
    """
    count = arrays[0].shape[0]
    if count <= rows:
        return f(*arrays)
    engine, results = engine_of(arrays), []
    for start in range(0, count, rows):
        some = [x[start : start + rows, ...] for x in arrays]
        results.append(engine.checkpoint(lambda: None, lambda _, some=some: f(*some)))
    return engine.namespace.concat(results)


def fast_engine() -> Engine:
    """The engine for networks whose arrays are NumPy's: torch, which uses all cores, if installed; else NumPy."""
    try:
        import torch
    except ImportError:
        return engine_of()
    return engine_of(torch.empty(0))


@contextlib.contextmanager
def progress_bar(wanted: bool | None, what: str, total: int) -> Iterator[Callable[[int], None]]:
    """A progress bar on standard error; the context's value is a function that advances the bar by a number.

    Args:
        wanted: True to show the bar, None to show it in a terminal only, False for none: the function then does
            nothing.
        what: the work's name, for the bar.
        total: the number at which the bar is full.
    """
    if not shows_bar(wanted):
        yield lambda count: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(what, total=total)
        yield lambda count: bar.update(task, advance=count)
