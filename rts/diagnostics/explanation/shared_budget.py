"""Numbers of parameters looked at within a budget of time, each in its turn."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import NamedTuple

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.trees import Tree, leaves
from rts.contracts.checks import is_real
from rts.diagnostics.explanation.slopes import Number, chosen, differenced, measured, unit
from rts.diagnostics.explanation.subject import Subject
from rts.diagnostics.progress import Phase
from rts.errors import InputError
from rts.fitting.parameter_names import named_leaves

FOR_SLOPES = 0.6
"""The share of the budget that differences are planned for, so that reasons can be found in the rest."""
TRIAL = 4
"""The square root of the samples a pixel of an image that tells how long others will take."""
FEW_SAMPLES = 2
"""The square root of the samples a pixel of differences, where there is not time for better ones of all numbers."""


class Clock:
    """A budget of seconds, and what is left of it."""

    def __init__(self, budget: float):
        if not (is_real(budget) and 0 < budget):
            raise InputError(f"budget_s is {quoted(budget)}; expected a positive number of seconds")
        self.budget, self.start = float(budget), perf_counter()

    @property
    def spent(self) -> float:
        """Seconds since it was made."""
        return perf_counter() - self.start

    def going(self, share: float = 1.0) -> bool:
        """Whether that share of the budget is not spent yet."""
        return self.spent < share * self.budget

    def turn(self, count: int) -> Callable[[], bool]:
        """Whether there is time left for the next of so many that share what is left of the budget."""
        end = self.spent + (self.budget - self.spent) / count
        return lambda: self.going() and self.spent < end


class Looked(NamedTuple):
    """What was looked at within the budget.

    Attributes:
        numbers: some of each array.
        planned: how many there were to look at.
        rough: how many of them have fewer samples than were asked for.
    """

    numbers: list[Number]
    planned: int
    rough: int


def looked_at(subject: Subject, entries: int, samples: int, clock: Clock, phase: Phase) -> Looked:
    """Some numbers of each array, the first of all arrays first.

    Where time does not suffice for all, each is looked at with few samples before any is with more.
    """
    engine, parameters = subject.engine, subject.parameters
    gradient = engine.value_and_grad(lambda p: subject.loss(subject.image(p)))(parameters)[1]
    planned = []
    for number, ((name, value), slope) in enumerate(zip(named_leaves(parameters), leaves(gradient), strict=True)):
        flat = engine.to_numpy(slope).reshape(-1)
        for rank, index in enumerate(chosen(flat, entries)):
            place = ", ".join(map(str, np.unravel_index(index, value.shape)))
            label = f"{name}[{place}]" if value.shape else name
            planned.append((rank, number, index, label, float(flat[index])))
    planned.sort()
    first = unit(engine, parameters, *planned[0][1:3])
    pace = _pace(subject, first, clock) if samples > TRIAL else 0.0
    most = _affordable(pace * len(planned), samples, clock)
    few = samples if most == samples else min(FEW_SAMPLES, samples)
    found, done, rough = {}, phase("derivatives", len(planned)), set()
    for rank, number, index, label, slope in planned:
        if found and not clock.going():
            break
        found[number, rank] = measured(subject, label, unit(engine, parameters, number, index), slope, few)
        rough |= {(number, rank)} if few < samples else set()
        done()
    more = _affordable(pace * len(found), samples, clock)
    for key in list(found) if few < more and len(found) == len(planned) else ():
        if not clock.going(FOR_SLOPES):
            break
        found[key] = differenced(subject, found[key], more)
        rough -= {key} if more == samples else set()
    return Looked([found[key] for key in sorted(found)], len(planned), len(rough))


def _pace(subject: Subject, direction: Tree, clock: Clock) -> float:
    """Seconds that one sample of every pixel takes, of an image without splatting."""
    start = clock.spent
    subject.engine.to_numpy(subject.hard(direction, 0.0, TRIAL))
    return (clock.spent - start) / TRIAL**2


def _affordable(pace: float, samples: int, clock: Clock) -> int:
    """The largest square root of samples a pixel, at most `samples`, that there is time for; at least 1.

    Args:
        pace: seconds that one sample of every pixel takes, times the numbers to look at.
        samples: the largest.
        clock: what is left of the budget.
    """
    left = FOR_SLOPES * clock.budget - clock.spent
    return max((n for n in range(1, samples + 1) if pace * (4 * n**2 + 2 * (n + 1) ** 2) <= left), default=1)
