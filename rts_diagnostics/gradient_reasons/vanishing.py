"""Reasons why a number changes nothing, why a loss is flat, and which numbers an image does not determine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from rts.plugin_api.arrays import leaves, map_leaves
from rts.tool_api.parameters import directions_in_words
from rts.tool_api.scenes import check_scene, out_of_view
from rts_diagnostics.gradient_reasons import variants
from rts_diagnostics.gradient_reasons.reasons import Finding
from rts_diagnostics.gradient_reasons.shader_steps import why_stepped
from rts_diagnostics.gradient_reasons.slopes import Number
from rts_diagnostics.gradient_reasons.subject import DEEP, Change, Subject, Touched, listed_parts

QUIET = 1e-4
"""The largest change of a pixel by a step that counts as none."""
DISTANCES = (4.0, 16.0, 64.0, -4.0, -16.0)
"""Distances by which a camera is moved back, in units of its near plane's."""
FLAT, FAR = 1e-3, 0.05
"""A loss is flat if moves of up to two pixels change it by at most FLAT of a far move's change. That change must be
more than FAR of the loss."""
STEEP = 0.1
"""The largest change by moves of up to two pixels that counts as flat, as a share of a parabola's; with more the loss
is at its minimum."""
OPEN = 1e-3
"""The largest singular value of an undetermined combination, as a share of its numbers' own."""
OPEN_TRUE = 0.1
"""The largest change of the image by an undetermined combination, as a share of the change by one of its numbers."""


def is_quiet(derivative: np.ndarray) -> bool:
    """True if no pixel changes by `QUIET` or more, from the change (H, W, 4) of an image by a step."""
    return bool(np.abs(derivative).max(initial=0.0) < QUIET)


def why_not_finite(number: Number) -> list[Finding]:
    """The reason, one, why a number's derivative, or its finite difference, is NaN or infinite."""
    if not np.isfinite(number.true).all():
        mask = ~np.all(np.isfinite(number.true), axis=-1)
        return [Finding("infinite", "the image itself is not finite when it moves", "Look for NaN in the scene.", mask)]
    if not np.isfinite(number.slope.difference):
        return [Finding("infinite", "the loss is not finite when it moves", "Look for NaN in the loss.")]
    advice = "Look for a square root, a norm or a quotient at 0; where it is selected away, NaN comes through, too."
    if np.isfinite(number.pushed).all():
        because = "the image has a derivative, but that of the loss is not finite"
        return [Finding("infinite", because, advice)]
    mask = ~np.all(np.isfinite(number.pushed), axis=-1)
    return [Finding("infinite", "the derivative of the image is not finite", advice, mask)]


def why_nothing(subject: Subject, number: Number, touched: Touched, going: Callable[[], bool]) -> list[Finding]:
    """Reasons why both derivatives of a number vanish; none if time runs out."""
    if not touched.all:
        return [Finding("unused", "nothing in the scene changes with it", "Use it, or leave it out.")]
    constants = why_constant(subject, touched)
    if constants and len(touched.all) == len(touched.constant) + len(touched.cut):
        return constants
    indices = list(range(len(subject.parts))) if touched.parts is None else touched.parts
    what, trial = variants.names(indices), _Trial(subject, number)
    for experiment in (_culled, _hidden, _hidden_by_itself, _outside):
        if not going():
            return []
        finding = experiment(subject, trial, indices, what)
        if finding is not None:
            return [finding]
    steps = why_stepped(subject, number, far=True) if going() else None
    return [
        steps
        or Finding(
            "undetermined",
            f"no experiment shows it: it changes something of {what}, but no pixel, in the view, around it or beneath",
            "No image like this one determines it; fix it, or take another view or shader.",
        )
    ]


def _culled(subject: Subject, trial: _Trial, indices: list[int], what: str) -> Finding | None:
    if all(subject.parts[i].cull != "back" for i in indices):
        return None
    for change, hidden in (
        (variants.unculled, ""),
        (variants.all_of(variants.alone(indices), variants.unculled), "also hidden, and "),
    ):
        mask = trial.shown(change)
        if mask.any():
            because = f"what it changes of {what} is {hidden}seen from behind, which cull='back' leaves out"
            return Finding("culled", because, "Say cull='none', or turn its triangles around.", mask)
    return None


def _hidden(subject: Subject, trial: _Trial, indices: list[int], what: str) -> Finding | None:
    others = [i for i in range(len(subject.parts)) if i not in indices]
    mask = trial.shown(variants.alone(indices)) if others else np.zeros(subject.size, bool)
    if not mask.any():
        return None
    because = f"what it changes of {what} is hidden behind {variants.names(others, 'or')}; alone it is seen"
    advice = "Move what hides it, take a view that shows it, or leave it out until it is seen."
    return Finding("hidden", because, advice, mask)


def _hidden_by_itself(subject: Subject, trial: _Trial, indices: list[int], what: str) -> Finding | None:
    mask = trial.shown(variants.transparent, layers=DEEP, splatter="multi")
    if not mask.any():
        return None
    because = f"what it changes of {what} is hidden, at least in part behind {what}; looked through, it is seen"
    return Finding("hidden", because, "Take a view that shows it.", mask)


def _outside(subject: Subject, trial: _Trial, indices: list[int], what: str) -> Finding | None:
    scene = subject.shown(subject.parameters)
    parts, camera = check_scene(listed_parts(scene[0]), scene[1])
    causes = {out_of_view(parts[i], camera.for_size(subject.size)) for i in indices}
    if len(causes) == 1 and (cause := causes.pop()):
        because = f"{what if len(indices) == 1 else f'each of {what}'} {cause}"
    elif trial.seen_outside() or trial.seen_outside(variants.all_of(variants.alone(indices), variants.unculled)):
        because = f"what it changes of {what} lies outside of the view"
    else:
        return None
    return Finding("outside", because, "Move it into the view, or turn the camera.")


def why_constant(subject: Subject, touched: Touched) -> list[Finding]:
    """Findings on arrays that a number changes, but that no derivative reaches."""
    engine, findings = subject.engine.name, []
    for places, why, advice in (
        (touched.constant, "NumPy, and therefore constant", f"Make it of {engine} arrays throughout."),
        (
            touched.cut,
            f"{engine} and no derivative leads there",
            "Compute it without detach, no_grad, stop_gradient or rounding.",
        ),
    ):
        if places:
            named = " and ".join(map(str, places[:2])) + (" and others" if places[2:] else "")
            verbs = ("changes", "is") if len(places) == 1 else ("change", "are")
            findings.append(Finding("constant", f"{named} {verbs[0]} with it, but {verbs[1]} {why}", advice))
    return findings


class _Trial:
    """Test whether a number changes the images of changed scenes."""

    def __init__(self, subject: Subject, number: Number):
        self.subject, self.number = subject, number

    def shown(self, change: Change, **options: Any) -> np.ndarray:
        """Mask (H, W) bool of pixels that the number changes in a changed scene, but not in the scene itself."""
        return self._changed(change, **options) & ~self._anyway

    def seen_outside(self, change: Change | None = None) -> bool:
        """True if a larger window, or a camera moved back or ahead, sees the number's effect, after `change` if any."""
        height, width = self.subject.size
        border = max(height, width)
        larger = height + 2 * border, width + 2 * border
        changes = [] if change is None else [change]
        mask = self._changed(variants.all_of(*changes, variants.wider(self.subject.size, border)), size=larger)
        mask[border : border + height, border : border + width] = False
        if mask.any():
            return True
        near = abs(float(self.subject.shown(self.subject.parameters)[1].for_size(self.subject.size).depth_range()[0]))
        moved = (variants.all_of(*changes, variants.farther(d * (near or 1.0))) for d in DISTANCES)
        return any(self.shown(m).any() for m in moved)

    @cached_property
    def _anyway(self) -> np.ndarray:
        return self._changed(None)

    def _changed(self, change: Change | None, **options: Any) -> np.ndarray:
        all_options = {"splatter": "auto", "background": None, "capacity": None, "supersample": 1, **options}
        direction = self.number.direction
        step = self.subject.step(direction, change, deep=True, **all_options) or self.number.slope.step
        pushed = self.subject.push(direction, change, **all_options) * step
        return np.abs(pushed).max(axis=-1) > QUIET


# --------------------------------------------------------------------------------------------------- flat losses


def why_flat(subject: Subject, number: Number, going: Callable[[], bool]) -> list[Finding]:
    """A finding if the loss is flat around a number that changes the image, though larger moves change the loss.

    An empty list if the loss is not flat, or if time runs out: then `going()` is false.
    """
    engine, step = subject.engine, number.slope.step
    samples = 2

    def at(pixels: float) -> float:
        return float(engine.to_numpy(subject.loss(subject.hard(number.direction, pixels * step, samples))))

    if not going():
        return []
    here = at(0)
    near = max(abs(at(sign * by) - here) for sign in (1, -1) for by in (1, 2))
    by, far = 4, 0.0
    while by <= max(subject.size) and not far:
        if not going():
            return []
        change = max(abs(at(sign * by) - here) for sign in (1, -1))
        if change > FAR * abs(here) and near <= min(FLAT, STEEP * (2 / by) ** 2) * change:
            far = change
        else:
            by *= 2
    if not far:
        return []
    mask = np.abs(number.true).max(axis=-1) > QUIET
    share = f", by {far / abs(here):.0%}" if here else ""
    because = (
        f"the loss is flat here: moves of two pixels do not change it, one of {by} pixels does{share}; a derivative "
        f"reaches one pixel"
    )
    sigma = _seen_by_blur(subject, number)
    look = f" (a Gaussian of {sigma} pixels sees it)" if sigma else ""
    advice = f"Start nearer, or compare coarser or blurred images first{look}."
    return [Finding("reach", because, advice, mask)]


def _seen_by_blur(subject: Subject, number: Number) -> int | None:
    """Standard deviation, pixels, of a Gaussian that makes the loss of blurred images change; None if none does."""
    from scipy.ndimage import gaussian_filter

    engine, like = subject.engine, next(leaves(subject.parameters))
    ends = [engine.to_numpy(subject.hard(number.direction, by * number.slope.step, 2)) for by in (-0.5, 0, 0.5)]
    sigma = 2
    while sigma <= max(subject.size) / 2:
        blurred = [engine.constant(gaussian_filter(x, (sigma, sigma, 0), mode="constant"), like) for x in ends]
        before, here, after = (float(engine.to_numpy(subject.loss(x))) for x in blurred)
        if abs(after - before) > FLAT * abs(here):
            return sigma
        sigma *= 2
    return None


# -------------------------------------------------------------------------------------------------- combinations


def undetermined(subject: Subject, numbers: Sequence[Number]) -> list[tuple[str, Finding]]:
    """Combinations of numbers that leave the image as it is, though each number changes it: one finding, named ""."""
    numbers = [n for n in numbers if np.isfinite(n.pushed).all() and not is_quiet(n.pushed)]
    if len(numbers) < 2:
        return []
    gram = np.zeros((len(numbers), len(numbers)))
    for row in range(subject.size[0]):  # Row by row, without a copy of all images.
        columns = np.stack([n.pushed[row].reshape(-1) for n in numbers]).astype(np.float64)
        gram += columns @ columns.T
    lengths = np.sqrt(np.diag(gram))
    _, values, vectors = np.linalg.svd(gram / np.outer(lengths, lengths))
    units = lengths / np.array([n.slope.step for n in numbers])  # Of the image, for a unit of the number.
    combinations = []
    for value, vector in zip(values, vectors, strict=True):
        if np.sqrt(max(value, 0)) > OPEN or not _stays(subject, numbers, vector / lengths):
            continue
        combinations.append(vector / units)
    if not combinations:
        return []
    basis = np.stack(combinations, axis=1)
    combination = directions_in_words(basis, units, [n.slope.name for n in numbers], [()] * len(numbers))
    because = (
        f"the image does not determine {combination}: along it each number changes the image, and all together do not"
    )
    advice = "Fix one of them, add a term that prefers one, or fit the combination that the image shows."
    return [("", Finding("undetermined", because, advice))]


def _stays(subject: Subject, numbers: Sequence[Number], weights: np.ndarray) -> bool:
    """True if the image stays the same while numbers move together, by finite differences without splatting.

    Args:
        subject: the scene under test.
        numbers: N numbers.
        weights: (N,), the motion of each, in its own step; scaled so that the largest moves by one step.
    """
    weights = weights / np.abs(weights).max()
    largest = numbers[int(np.argmax(np.abs(weights)))]

    def image(sign: float) -> np.ndarray:
        parts = [sign / 2 * w * n.slope.step for w, n in zip(weights, numbers, strict=True)]
        directions = [list(leaves(n.direction)) for n in numbers]
        total = iter([sum(b * d for b, d in zip(parts, ds, strict=True)) for ds in zip(*directions, strict=True)])
        direction = map_leaves(lambda _: next(total), numbers[0].direction)
        return subject.engine.to_numpy(subject.hard(direction, 1.0, 4))

    change = np.linalg.norm(image(1) - image(-1))
    return bool(change <= OPEN_TRUE * np.linalg.norm(largest.true))
