"""Selection of the numbers to explain, and of the experiments for each."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rts_diagnostics.gradient_reasons.disagreeing import why_off
from rts_diagnostics.gradient_reasons.reasons import Finding, Reason, merged
from rts_diagnostics.gradient_reasons.shader_steps import why_stepped
from rts_diagnostics.gradient_reasons.slopes import Number, Slope
from rts_diagnostics.gradient_reasons.subject import Subject, Touched
from rts_diagnostics.gradient_reasons.vanishing import (
    is_quiet,
    undetermined,
    why_constant,
    why_flat,
    why_not_finite,
    why_nothing,
)
from rts_diagnostics.progress import Phase


def explained(
    subject: Subject,
    numbers: Sequence[Number],
    agrees: Callable[[Slope], bool],
    own_loss: bool,
    turn: Callable[[int], Callable[[], bool]],
    phase: Phase,
) -> tuple[list[Reason], int]:
    """Reasons why slopes differ or vanish.

    Args:
        subject: the scene under test.
        numbers: the numbers of its parameters that were measured.
        agrees: slope → True if its two derivatives agree.
        own_loss: True if the loss is the user's, which may be flat where images change.
        turn: count → a function that is true while time is left for one of `count` numbers, which share the rest
            of the budget.
        phase: shows a progress bar.

    Returns:
        The reasons, and how many numbers were left for want of time.
    """
    findings_of: dict[int, list[Finding]] = {}
    done, left = phase("reasons", len(numbers) + 1), list(range(len(numbers)))
    for first in (True, False):  # Numbers that ran out of their share get the time that others leave.
        waiting, left = left, []
        for i, k in enumerate(waiting):
            watch = _Watch(turn(len(waiting) - i if first else 1))
            if watch():
                findings_of[k] = _why(subject, numbers[k], agrees, own_loss, watch)
            left += [k] if watch.refused else []
            if first:
                done()
    findings = [(numbers[k].slope.name, f) for k in sorted(findings_of) for f in findings_of[k]]
    if turn(1)():
        findings += undetermined(subject, numbers)
    done()
    return merged(findings, subject.size), len(left)


class _Watch:
    """A function that is true while there is time; `refused` records that time ran out."""

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
    if is_quiet(number.pushed):  # The truth is too noisy to tell, but the scene does.
        if constants := why_constant(subject, touched()):
            return constants
        if going() and (steps := why_stepped(subject, number, far=True)):
            return [steps]
    return why_flat(subject, number, going) if own_loss else []
