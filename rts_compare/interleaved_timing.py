"""Times of functions that are called in turns; the times of each turn are kept on disk at once."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from rts_compare.kept_measurements import KeptMeasurements
from rts_compare.skip_reasons import limited, one_line

ROUNDS, CONSECUTIVE = 3, 2
"""Turns that each function has by default, and calls timed in a turn."""
SLOW = 1.5
"""Seconds of timed calls, at least two, after which a function has no further turn."""
LONGEST = 120.0
"""Seconds that a turn may take, with making and compiling the function; a slower function is left out."""

WARM = 0.5
"""Seconds that a first call, which also loads and compiles, may take without being `hopeless`."""

Calls = Mapping[tuple, Callable[[], Callable[[], Any]]]
"""The name of a function to be timed → a function without arguments that makes it."""


class InterleavedTiming:
    """A timer of several functions, which take turns.

    Args:
        kept: the store of times.
        calls: the functions, see `Calls`.
        key: name in `calls` → the rest of the key in the store.

    Attributes:
        failed: name in `calls` → the reason why the function could not be timed, one line.
    """

    def __init__(self, kept: KeptMeasurements, calls: Calls, key: Callable[[tuple], tuple]):
        self.kept, self.calls, self.key = kept, calls, key
        self.failed: dict[tuple, str] = {}
        self._times: dict[tuple, list[float]] = {name: [] for name in calls}
        self._made: dict[tuple, Callable[[], Any]] = {}
        self._hopeless = math.inf

    def run(
        self,
        rounds: int = ROUNDS,
        done: Callable[[], None] = lambda: None,
        late: Callable[[], bool] = lambda: False,
        hopeless: float = math.inf,
    ) -> dict[tuple, dict[str, float]]:
        """Time all functions in turns, in shuffled order, each after a call to warm up.

        Args:
            rounds: turns of each function, kept turns of earlier runs included.
            done: called for each turn, also a skipped one.
            late: returns True to skip all further turns; ignored until one function has a time.
            hopeless: a function whose first call takes longer than `WARM`, and than this many times the fastest one's
                median, is called only once in that turn.

        Returns:
            Name in `calls` that could be timed → "median", quartiles "low" and "high" (ms); number of "calls".
        """
        self._hopeless = hopeless
        order, shuffle = list(self.calls), random.Random(0).shuffle
        for number in range(rounds):
            shuffle(order)
            for name in order:
                done()
                if not (late() and any(self._times.values())):
                    self._turn(name, number)
        return {name: _milliseconds(found) for name, found in self._times.items() if found}

    def _turn(self, name: tuple, number: int) -> None:
        times, key = self._times[name], ("time", *self.key(name), number)
        if name in self.failed or (len(times) >= 2 and sum(times) > SLOW):
            return
        kept = self.kept.get(*key)
        if kept is None:
            try:
                kept = self.kept.put(self.timed(name), *key)
            except Exception as error:
                self.failed[name] = one_line(f"{type(error).__name__}: {error}")
                return
        times.extend(kept)

    def timed(self, name: tuple) -> list[float]:
        """Seconds of `CONSECUTIVE` calls after one to warm up; of one if it is slow or the first `hopeless` (`run`)."""
        with limited(LONGEST):
            if name not in self._made:
                self._made[name] = self.calls[name]()
                first = _seconds(self._made[name])
                if first > self._most():
                    return [first]
            found = [_seconds(self._made[name])]
            if found[0] < SLOW / 2:
                found = [_seconds(self._made[name]) for _ in range(CONSECUTIVE)]
        return found

    def _most(self) -> float:
        """The most seconds of a first call that other calls follow at once; infinity before any function has a time."""
        known = [float(np.median(times)) for times in self._times.values() if times]
        return max(WARM, self._hopeless * min(known)) if known else math.inf


def _seconds(f: Callable[[], Any]) -> float:
    start = time.perf_counter()
    f()
    return time.perf_counter() - start


def _milliseconds(times: list[float]) -> dict[str, float]:
    low, median, high = 1e3 * np.percentile(times, [25, 50, 75])
    return {"median": float(median), "low": float(low), "high": float(high), "calls": len(times)}
