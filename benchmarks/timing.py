"""Timing: the pose that iterations start from, their steps, and calls that take turns."""

from __future__ import annotations

import random
import statistics
import time
from collections.abc import Callable

START = (0.12, -0.15, 0.10, 0.05, -0.04, 0.06)
"""The pose at first: a rotation vector and a translation; it is to become zero."""
RATE = 0.01
"""The learning rate of Adam."""

WARM_UP, ROUNDS = 2, 7
CONSECUTIVE = 3
"""Calls timed in a turn, after one that is not: in a loop a method finds its own data in the caches, not others'."""


def milliseconds(times: list[float], processor: list[float]) -> dict:
    """Median and quartiles of some times in seconds; and the median of those of the processor, all threads together."""
    low, _, high = statistics.quantiles(times, n=4, method="inclusive") if len(times) > 1 else times * 3
    found = {"ms": 1e3 * statistics.median(times), "low": 1e3 * low, "high": 1e3 * high, "calls": len(times)}
    return found | {"cpu": 1e3 * statistics.median(processor)}


def in_turn(
    functions: dict[str, Callable[[], object]],
    rounds: int,
    done: Callable[[], None] = lambda: None,
    budget: float = float("inf"),
) -> dict[str, dict]:
    """Times of each function, a few consecutive calls each in turn, after two turns to warm up.

    The turns are shuffled every round, so that noise of the machine hits all alike.

    Args:
        functions: by name.
        rounds: turns of each.
        done: called after each round.
        budget: seconds after which a function, once it had two turns, has no more.
    """
    times: dict[str, list[float]] = {name: [] for name in functions}
    processor: dict[str, list[float]] = {name: [] for name in functions}
    order, shuffle = list(functions), random.Random(0).shuffle
    for n in range(rounds + WARM_UP):
        shuffle(order)
        for name in order:
            if len(times[name]) >= 2 * CONSECUTIVE and sum(times[name]) > budget:
                continue
            functions[name]()
            if n < WARM_UP:
                continue
            for _ in range(CONSECUTIVE):
                start, begun = time.perf_counter(), time.process_time()
                functions[name]()
                times[name].append(time.perf_counter() - start)
                processor[name].append(time.process_time() - begun)
        done()
    return {name: milliseconds(t, processor[name]) for name, t in times.items()}
