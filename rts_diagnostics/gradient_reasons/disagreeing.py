"""Reasons why the derivative of an image disagrees with the truth, finite differences: experiments that mend it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rts_diagnostics.gradient_reasons import variants
from rts_diagnostics.gradient_reasons.reasons import Finding
from rts_diagnostics.gradient_reasons.shader_steps import why_stepped
from rts_diagnostics.gradient_reasons.slopes import Number
from rts_diagnostics.gradient_reasons.subject import DEEP, Change, Subject, Touched
from rts_diagnostics.gradient_reasons.vanishing import is_quiet, why_constant
from rts_diagnostics.smoothing import low_pass

HALVED = 0.5
"""An experiment names a reason if it leaves less than this share of the error."""
NOISY, BETTER = 1.5, 0.8
"""An error below this many times the truth's noise is as good as none; an experiment that leaves no more, and less than
this share of the error before, names a reason, too."""
LEFT = 0.3
"""The share of the error below which no more reasons are sought."""
LARGE_SHARE = 0.3
"""The share of the disagreement that pixels of a kind must hold to name a reason."""
STRONG = 0.1
"""The share of the largest error of a pixel from which a pixel counts as disagreeing."""
WIDER = 2
"""Pixels count as near a mask up to this many steps from it, along rows and columns."""
AGAIN = 4
"""Samples a pixel, along each axis, that experiments take instead of one."""


class _Error(NamedTuple):
    """The difference between a derivative image and the truth.

    Attributes:
        image: (H, W, 4), the difference through the low-pass of `smoothing.py`.
        norm: norm of `image`.
        sharp: (H, W), energy of the difference without the low-pass: squares, summed over channels.
    """

    image: np.ndarray
    norm: float
    sharp: np.ndarray

    @classmethod
    def of(cls, pushed: np.ndarray, true: np.ndarray) -> _Error:
        """The error of a derivative image (H, W, 4) against the true one."""
        image = low_pass(pushed - true)
        return cls(image, float(np.linalg.norm(image)), ((pushed - true) ** 2).sum(axis=-1))

    def within(self, mask: np.ndarray) -> _Error:
        """The error of the pixels of a mask (H, W) bool."""
        image = self.image * mask[..., None]
        return _Error(image, float(np.linalg.norm(image)), self.sharp * mask)

    @property
    def energy(self) -> np.ndarray:
        """(H, W), squares of `image`, summed over channels."""
        return (self.image**2).sum(axis=-1)


class _Case:
    """A number whose derivatives disagree, and the explanation so far.

    Attributes:
        subject: the scene under test.
        number: the number.
        options: options of `rts.render`, from the experiments that helped.
        connected: True if arrays that no derivative reaches are differentiated, too.
        pushed: the derivative image with `options` and `connected`.
        error: the error of `pushed` in the pixels `left`.
        left: (H, W) bool, the pixels that are not explained.
        noise: the noise of the truth, in the unit of `error.norm`.
        whole: the error before any experiment.
        findings: the findings so far.
    """

    def __init__(self, subject: Subject, number: Number):
        self.subject, self.number = subject, number
        self.options: dict[str, Any] = {"capacity": None}
        self.connected = False
        self.pushed = number.pushed
        self.whole = self.error = _Error.of(number.pushed, number.true)
        self.noise = number.noise
        self.left = np.ones(subject.size, bool)
        self.findings: list[Finding] = []

    @property
    def open(self) -> bool:
        """True if much of the error is unexplained."""
        return self.error.norm > max(NOISY * self.noise, LEFT * self.whole.norm)

    def strong(self, error: _Error) -> np.ndarray:
        """Mask (H, W) bool of the pixels that disagree most, both in `error` and before any experiment."""
        size = np.abs(self.number.pushed - self.number.true).max(axis=-1)
        energy = error.energy
        return (size > STRONG * size.max()) & (energy > STRONG**2 * energy.max())

    def push(self, change: Change | None = None, **options: Any) -> np.ndarray:
        """The derivative image (H, W, 4), for a step of the slope's length, as `Number.pushed` is.

        The scene is drawn with the options that helped so far, a change, and further options, none of which are kept.
        """
        options = {**self.options, **options}
        derivative = self.subject.push(self.number.direction, change, connect=self.connected, **options)
        return derivative * self.number.slope.step

    def try_connected(self) -> _Error | None:
        """The result of `try_out` if arrays that no derivative reaches are differentiated; kept only if this helps."""
        self.connected = True
        before = self.try_out()
        self.connected = before is not None
        return before

    def try_out(self, **options: Any) -> _Error | None:
        """Try options; if they make the error in the pixels `left` much smaller, keep them.

        Returns:
            The error before; None if the options are not kept.
        """
        changed = {**self.options, **options}
        pushed = self.push(**options)
        error, before = _Error.of(pushed, self.number.true).within(self.left), self.error
        least = NOISY * self.noise
        if error.norm > HALVED * before.norm and not (error.norm < least and error.norm < BETTER * before.norm):
            return None
        self.options, self.pushed, self.error = changed, pushed, error
        return before

    def gained(self, before: _Error) -> float:
        """The share of the whole error, squared, that the last experiment removed; `before` is the error before it."""
        return (before.norm**2 - self.error.norm**2) / self.whole.norm**2


def _constants(case: _Case, touched: Touched) -> None:
    """Add findings on arrays that no derivative reaches, if derivatives would agree with these differentiated.

    Also if all that the number changes is such arrays, and the derivative image is zero.
    """
    constants = why_constant(case.subject, touched)
    if not constants:
        return
    if len(touched.all) == len(touched.constant) + len(touched.cut) and not case.number.pushed.any():
        mask = case.strong(case.whole)
        case.findings += [f._replace(mask=mask, share=1.0) for f in constants]
        return
    before = case.try_connected()
    if before is not None:
        mask, share = case.strong(before), case.gained(before)
        case.findings += [f._replace(mask=mask, share=share) for f in constants]


def _splatter(case: _Case, touched: Touched) -> None:
    """Add a finding on the splatter if the one that suits the scene, in its place, makes the error much smaller."""
    splatter = case.subject.options.get("splatter", "auto")
    if case.subject.splats_as("auto"):
        return
    before = case.try_out(splatter="auto")
    if before is None:
        return
    if case.subject.opaque:
        current = f"splatter={splatter!r}" if isinstance(splatter, str) else f"the splatter {type(splatter).__name__}"
        kind, because = "outlines", f"{current} lacks derivatives of outlines that 'auto' has"
    else:
        kind, because = "transparent", "shaders are not opaque, but the splatter loses what shines through layers"
    case.findings.append(Finding(kind, because, "Leave out splatter=.", case.strong(before), case.gained(before)))


def _layers(case: _Case, touched: Touched) -> None:
    layers = case.subject.options.get("layers", "auto")
    if isinstance(layers, str) or layers >= DEEP:
        return
    before = case.try_out(layers=DEEP)
    if before is None:
        return
    mask, share, enough = case.strong(before), case.gained(before), DEEP
    for count in range(layers + 1, DEEP):
        if _Error.of(case.push(layers=count), case.number.true).within(case.left).norm <= max(
            1.1 * case.error.norm, HALVED * before.norm
        ):
            enough = count
            break
    because = f"what it changes, or uncovers, lies deeper than the K = {layers} layers that are kept"
    advice = f"Raise layers to {enough}, or say layers='auto'." if case.subject.opaque else f"Raise layers to {enough}."
    case.findings.append(Finding("layers", because, advice, mask, share))


def _bounded(case: _Case, touched: Touched) -> None:
    """Add a finding on surfaces that bound near-singular derivatives, if much of the error is where bounds matter.

    Pixels near these places are then explained.
    """
    from scipy.ndimage import binary_dilation

    if all(part.surface.unbounded() is None for part in case.subject.parts):
        return
    change = np.nan_to_num(np.abs(case.push(variants.unbounded) - case.pushed), nan=np.inf, posinf=np.inf).max(axis=-1)
    mask = change > STRONG * max(np.abs(case.number.true).max(), np.abs(case.pushed).max())
    if not mask.any():
        return
    near: Any = binary_dilation(mask, iterations=WIDER)
    energy = case.error.energy
    held = float(energy[near].sum() / max(energy.sum(), 1e-30))
    if held < LARGE_SHARE:
        return
    because = (
        "field values at the ends of lattice edges are so nearly alike there that crossings move without bound; the "
        "surface bounds their derivative"
    )
    advice = "Smooth the field, or take motion='normal' or near_singular='drop'."
    share = held * case.error.norm**2 / case.whole.norm**2
    case.findings.append(Finding("bounded", because, advice, near & case.strong(case.error), share))
    case.left &= ~near
    case.error = case.error.within(case.left)


def _steps(case: _Case, touched: Touched) -> None:
    """Add a finding on shaders that step, if much of the error is beside pixels that do.

    These are then explained.
    """
    from scipy.ndimage import binary_dilation

    steps = why_stepped(case.subject, case.number, case.connected, far=is_quiet(case.number.pushed))
    if steps is None:
        return
    near: Any = binary_dilation(steps.mask, iterations=WIDER)
    energy = case.error.energy
    held = float(energy[near].sum() / max(energy.sum(), 1e-30))
    if held < LARGE_SHARE:
        return
    share = held * case.error.norm**2 / case.whole.norm**2
    case.findings.append(steps._replace(mask=near & case.strong(case.error), share=share))
    case.left &= ~near
    case.error = case.error.within(case.left)


def _samples(case: _Case, touched: Touched) -> None:
    """Add a finding on too few samples, if more make the error much smaller."""
    taken = case.subject.supersample
    before = case.try_out(supersample=_more(taken))
    if before is None:
        return
    times = before.norm / max(case.error.norm, 1e-30)
    because = f"{_each(taken)} is too little for these outlines and colours"
    advice = f"With supersample={_more(taken)} it is {times:.2g} times better."
    case.findings.append(Finding("samples", because, advice, case.strong(before), case.gained(before)))


def _more(taken: int) -> int:
    """Samples along each axis of a pixel, for an experiment with more of them."""
    return AGAIN if taken == 1 else 2 * taken


def _each(count: int) -> str:
    return "one sample a pixel" if count == 1 else f"{count} × {count} samples a pixel"


def _unknown(case: _Case, touched: Touched) -> None:
    """Add a finding of the kind "unknown", unless others leave less than half of the error."""
    if not case.findings or case.error.norm >= HALVED * case.whole.norm:
        mask, share = case.strong(case.error), case.error.norm**2 / case.whole.norm**2
        case.findings.append(Finding("unknown", "no experiment makes it agree", "", mask, share))


EXPERIMENTS: tuple[Callable[[_Case, Touched], None], ...] = (
    _constants,
    _splatter,
    _layers,
    _bounded,
    _steps,
    _samples,
    _unknown,
)
"""Experiments, from the cheap and certain to the expensive; each adds findings to the case."""


def why_off(subject: Subject, number: Number, touched: Touched, going: Callable[[], bool]) -> list[Finding]:
    """Reasons why the derivatives of a number disagree.

    Args:
        subject: the scene under test.
        number: the number.
        touched: the arrays of the scene that the number changes.
        going: a function that is true while there is time for another experiment.

    Returns:
        Findings; none only if time ran out.
    """
    case = _Case(subject, number)
    for experiment in EXPERIMENTS:
        if not going():
            break
        if experiment is _constants or (case.open and not _all_constant(case)):
            experiment(case, touched)
    if going() and not case.findings:
        because = "the derivative images agree as well as the truth is known, and only the loss does not"
        return [Finding("unknown", because, "Take more samples a pixel for the truth, samples=16 say.")]
    return case.findings


def _all_constant(case: _Case) -> bool:
    return any(f.kind == "constant" and f.share == 1 for f in case.findings)
