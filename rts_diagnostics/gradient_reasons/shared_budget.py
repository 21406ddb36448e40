"""Derivatives of numbers of the parameters within a budget of time, each in turn."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import NamedTuple

import numpy as np

from rts.errors import InputError
from rts.plugin_api.arrays import Tree, leaves
from rts.plugin_api.checks import quoted
from rts.tool_api.parameters import is_real, named_leaves
from rts_diagnostics.gradient_reasons.slopes import Number, differenced, largest_and_random, measured, unit
from rts_diagnostics.gradient_reasons.subject import Subject
from rts_diagnostics.progress import Phase

FOR_SLOPES = 0.6
"""The share of the budget planned for differences; the rest is for reasons."""
TRIAL = 4
"""Samples a pixel along each axis, for a trial image that is timed."""
FEW_SAMPLES = 2
"""Samples a pixel along each axis for differences, if time does not suffice for more of all numbers."""


class Clock:
    """A budget of seconds, which begins when the clock is made; an InputError unless it is positive."""

    def __init__(self, budget: float):
        if not (is_real(budget) and 0 < budget):
            raise InputError(f"budget_s is {quoted(budget)}; expected a positive number of seconds")
        self.budget, self.start = float(budget), perf_counter()

    @property
    def spent(self) -> float:
        """Seconds since the clock was made."""
        return perf_counter() - self.start

    def going(self, share: float = 1.0) -> bool:
        """True until this share of the budget is spent."""
        return self.spent < share * self.budget

    def turn(self, count: int) -> Callable[[], bool]:
        """A function that is true while the next turn lasts: 1 / `count` of what is left of the budget now."""
        end = self.spent + (self.budget - self.spent) / count
        return lambda: self.going() and self.spent < end


class Looked(NamedTuple):
    """Numbers measured within the budget.

    Attributes:
        numbers: some numbers of each array, measured.
        planned: count of the numbers that were to be measured.
        rough: count of the `numbers` that have fewer samples than asked for.
    """

    numbers: list[Number]
    planned: int
    rough: int


def looked_at(subject: Subject, entries: int, samples: int, clock: Clock, phase: Phase) -> Looked:
    """Measure at most `entries` numbers of each array, at least one in all: a first of each array, then second ones, ….

    If time does not suffice for all with `samples`, all are measured with few samples before any is with more.
    """
    engine, parameters = subject.engine, subject.parameters
    gradient = engine.value_and_grad(lambda p: subject.loss(subject.image(p)))(parameters)[1]
    planned = []
    for number, ((name, value), slope) in enumerate(zip(named_leaves(parameters), leaves(gradient), strict=True)):
        flat = engine.to_numpy(slope).reshape(-1)
        for rank, index in enumerate(largest_and_random(flat, entries)):
            place = ", ".join(map(str, np.unravel_index(index, value.shape)))
            label = f"{name}[{place}]" if value.shape else name
            planned.append((rank, number, index, label, float(flat[index])))
    planned.sort()
    first = unit(engine, parameters, *planned[0][1:3])
    pace = _pace(subject, first, clock) if samples > TRIAL else 0.0
    most = _affordable(pace * len(planned), samples, clock)
    few = samples if most == samples else min(FEW_SAMPLES, samples)
    numbers, done, rough = {}, phase("derivatives", len(planned)), set()
    for rank, number, index, label, slope in planned:
        if numbers and not clock.going():
            break
        numbers[number, rank] = measured(subject, label, unit(engine, parameters, number, index), slope, few)
        rough |= {(number, rank)} if few < samples else set()
        done()
    more = _affordable(pace * len(numbers), samples, clock)
    for key in list(numbers) if few < more and len(numbers) == len(planned) else ():
        if not clock.going(FOR_SLOPES):
            break
        numbers[key] = differenced(subject, numbers[key], more)
        rough -= {key} if more == samples else set()
    return Looked([numbers[key] for key in sorted(numbers)], len(planned), len(rough))


def _pace(subject: Subject, direction: Tree, clock: Clock) -> float:
    """Seconds of an image without splatting, for each sample a pixel."""
    start = clock.spent
    subject.engine.to_numpy(subject.hard(direction, 0.0, TRIAL))
    return (clock.spent - start) / TRIAL**2


def _affordable(pace: float, samples: int, clock: Clock) -> int:
    """The most samples a pixel along each axis that there is time for: 1 to `samples`.

    Args:
        pace: seconds for each sample a pixel, times the numbers to measure.
        samples: the most.
        clock: the budget.
    """
    left = FOR_SLOPES * clock.budget - clock.spent
    return max((n for n in range(1, samples + 1) if pace * (4 * n**2 + 2 * (n + 1) ** 2) <= left), default=1)
