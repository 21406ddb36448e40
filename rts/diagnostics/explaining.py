"""Which numbers have something to explain, and the experiments that do."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rts.diagnostics.comparison.progress import Phase
from rts.diagnostics.disagreeing import why_off
from rts.diagnostics.reasons import Finding, Reason, merged
from rts.diagnostics.slopes import Number, Setting, Slope
from rts.diagnostics.vanishing import is_quiet, undetermined, why_flat, why_nothing


def explained(
    setting: Setting,
    numbers: Sequence[Number],
    agrees: Callable[[Slope], bool],
    own_loss: bool,
    going: Callable[[], bool],
    phase: Phase,
) -> tuple[list[Reason], int]:
    """Why slopes differ or vanish.

    Args:
        setting: what is looked at.
        numbers: of it.
        agrees: whether a slope's derivatives do.
        own_loss: whether the loss is the user's, and may be flat where images change.
        going: whether there is time for another experiment.
        phase: of a progress bar.

    Returns:
        The reasons, and the number of numbers that there was no time for.
    """
    findings: list[tuple[str, Finding]] = []
    done, left = phase("reasons", len(numbers) + 1), 0
    for number in numbers:
        if going():
            findings += [(number.slope.name, f) for f in _why(setting, number, agrees, own_loss, going)]
        else:
            left += 1
        done()
    if going():
        findings += undetermined(setting, numbers)
    done()
    return merged(findings, setting.size), left


def _why(
    setting: Setting, number: Number, agrees: Callable[[Slope], bool], own_loss: bool, going: Callable[[], bool]
) -> list[Finding]:
    if is_quiet(number.pushed) and is_quiet(number.true):
        return why_nothing(setting, number, setting.touched(number.direction, number.slope.step))
    if not agrees(number.slope):
        return why_off(setting, number, setting.touched(number.direction, number.slope.step), going)
    return why_flat(setting, number) if own_loss else []
