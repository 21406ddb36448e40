"""Which numbers have something to explain, and the experiments that do."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rts.diagnostics.explanation.disagreeing import why_off
from rts.diagnostics.explanation.reasons import Finding, Reason, merged
from rts.diagnostics.explanation.slopes import Number, Slope
from rts.diagnostics.explanation.subject import Subject, Touched
from rts.diagnostics.explanation.vanishing import (
    is_quiet,
    undetermined,
    why_constant,
    why_flat,
    why_not_finite,
    why_nothing,
)
from rts.diagnostics.progress import Phase


def explained(
    subject: Subject,
    numbers: Sequence[Number],
    agrees: Callable[[Slope], bool],
    own_loss: bool,
    turn: Callable[[int], Callable[[], bool]],
    phase: Phase,
) -> tuple[list[Reason], int]:
    """Why slopes differ or vanish.

    Args:
        subject: what is looked at.
        numbers: of it.
        agrees: whether a slope's derivatives do.
        own_loss: whether the loss is the user's, and may be flat where images change.
        turn: count → whether there is time for another experiment, of the next of so many that share what is left.
        phase: of a progress bar.

    Returns:
        The reasons, and the number of numbers that there was no time for.
    """
    found: dict[int, list[Finding]] = {}
    done, left = phase("reasons", len(numbers) + 1), list(range(len(numbers)))
    for first in (True, False):  # Who was cut short by the others' turns gets what time they leave.
        waiting, left = left, []
        for i, k in enumerate(waiting):
            watch = _Watch(turn(len(waiting) - i if first else 1))
            if watch():
                found[k] = _why(subject, numbers[k], agrees, own_loss, watch)
            left += [k] if watch.refused else []
            if first:
                done()
    findings = [(numbers[k].slope.name, f) for k in sorted(found) for f in found[k]]
    if turn(1)():
        findings += undetermined(subject, numbers)
    done()
    return merged(findings, subject.size), len(left)


class _Watch:
    """Whether there is time, and whether that was refused."""

    def __init__(self, going: Callable[[], bool]):
        self.going, self.refused = going, False

    def __call__(self) -> bool:
        self.refused |= not self.going()
        return not self.refused


def _why(
    subject: Subject, number: Number, agrees: Callable[[Slope], bool], own_loss: bool, going: Callable[[], bool]
) -> list[Finding]:
    def touched() -> Touched:
        return subject.touched(number.direction, number.slope.step)

    if not (np.isfinite(number.pushed).all() and np.isfinite([number.slope.autodiff, number.slope.difference]).all()):
        # Beside a NaN of another number, forward mode may be NaN where reverse mode is not.
        return [] if agrees(number.slope) else why_not_finite(number)
    if is_quiet(number.pushed) and is_quiet(number.true):
        return why_nothing(subject, number, touched(), going)
    if not agrees(number.slope):
        return why_off(subject, number, touched(), going)
    if is_quiet(number.pushed) and (constants := why_constant(subject, touched())):
        return constants  # The truth is too noisy to tell, but the scene does.
    return why_flat(subject, number, going) if own_loss else []
