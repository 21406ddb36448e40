"""Why a number changes nothing: experiments that make it change something."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rts.checks import check_scene
from rts.diagnostics import variants
from rts.diagnostics.reasons import Finding
from rts.diagnostics.slopes import DEEP, Number, Setting, Touched, listed_parts
from rts.fitting.dependence import directions_in_words
from rts.sampling.emptiness import out_of_view
from rts.trees import leaves, map_leaves

QUIET = 1e-4
"""The largest change of a pixel by a step that counts as none."""
DISTANCES = (4.0, 16.0, 64.0, -4.0, -16.0)
"""How far a camera is moved back, in distances of its near plane."""
FLAT, FAR = 1e-3, 0.05
"""A loss is flat where moves of up to two pixels change it by no more than the one, as a share of what a far move does;
which has to be more than the other, as a share of the loss."""
OPEN = 1e-3
"""The singular value of a combination that is not determined, as a share of those of its numbers."""
OPEN_TRUE = 0.1
"""How much such a combination may change the image when it is tried, as a share of what one of its numbers does."""


def is_quiet(derivative: np.ndarray) -> bool:
    """Whether the change of an image by a step is none."""
    return bool(np.abs(derivative).max(initial=0.0) < QUIET)


def why_nothing(setting: Setting, number: Number, touched: Touched) -> list[Finding]:
    """Why neither derivative sees a number."""
    if not touched.all:
        return [Finding("unused", "nothing in the scene changes with it", "Use it, or leave it out.")]
    indices = list(range(len(setting.parts))) if touched.parts is None else touched.parts
    what = variants.names(indices)
    trial = _Trial(setting, number)
    constants = why_constant(setting, touched)
    if len(constants) and len(touched.all) == len(touched.constant) + len(touched.cut):
        return constants
    only = variants.alone(indices)
    if any(setting.parts[i].cull == "back" for i in indices):
        for change, hidden in (
            (variants.unculled, ""),
            (variants.all_of(only, variants.unculled), "also hidden, and "),
        ):
            mask = trial.changed(change)
            if mask.any():
                because = f"what it changes of {what} is {hidden}seen from behind, which cull='back' leaves out"
                return [Finding("culled", because, "Say cull='none', or turn its triangles around.", mask)]
    mask = trial.changed(only)
    if mask.any():
        others = variants.names([i for i in range(len(setting.parts)) if i not in indices])
        because = f"what it changes of {what} is hidden behind {others}; alone it is seen"
        advice = "Move what hides it, take a view that shows it, or leave it out until it is seen."
        return [Finding("hidden", because, advice, mask)]
    mask = trial.changed(variants.transparent, layers=DEEP, splatter="multi")
    if mask.any():
        because = f"what it changes of {what} is hidden behind other parts of it; looked through, it is seen"
        return [Finding("hidden", because, "Take a view that shows it.", mask)]
    if trial.seen_outside() or trial.seen_outside(only, variants.unculled):
        return [_outside(setting, indices, what)]
    return [
        Finding(
            "undetermined",
            f"no experiment shows it: {what} changes with it, but no pixel does, in the view, around it or beneath",
            "No image like this one determines it; fix it, or take another view or shader.",
        )
    ]


def why_constant(setting: Setting, touched: Touched) -> list[Finding]:
    """Arrays that a number changes, to which no derivative leads."""
    engine, found = setting.engine.name, []
    for places, why, advice in (
        (touched.constant, "NumPy, and therefore constant", f"Make it of {engine} arrays throughout."),
        (
            touched.cut,
            f"an array of {engine} that no derivative leads to",
            "Compute it without detach, no_grad, stop_gradient or rounding.",
        ),
    ):
        if places:
            told = " and ".join(map(str, places[:2])) + (" and others" if places[2:] else "")
            found.append(Finding("constant", f"{told} changes with it, but is {why}", advice))
    return found


class _Trial:
    """Tries whether a number is seen in a changed scene."""

    def __init__(self, setting: Setting, number: Number):
        self.setting, self.number = setting, number

    def changed(self, change: Any, **options: Any) -> np.ndarray:
        """(H, W) bool, the pixels that the number changes."""
        given = {"splatter": "auto", "background": None, "capacity": None, "supersample": 1, **options}
        direction = self.number.direction
        step = self.setting.step(direction, change, deep=True, **given) or self.number.slope.step
        pushed = self.setting.push(direction, change, **given) * step
        return np.abs(pushed).max(axis=-1) > QUIET

    def seen_outside(self, *changes: Any) -> bool:
        """Whether a larger window, or a camera that is moved back, sees what changes."""
        height, width = self.setting.size
        apron = max(height, width)
        larger = height + 2 * apron, width + 2 * apron
        wide = variants.all_of(*changes, variants.wider(self.setting.size, apron))
        inside = slice(apron, apron + height), slice(apron, apron + width)
        mask = self.changed(wide, size=larger)
        mask[inside] = False
        if mask.any():
            return True
        near = self._near()
        return any(self.changed(variants.all_of(*changes, variants.farther(d * near))).any() for d in DISTANCES)

    def _near(self) -> float:
        near = self.setting.shown(self.setting.parameters)[1].for_size(self.setting.size).depth_range()[0]
        return abs(float(near)) or 1.0


def _outside(setting: Setting, indices: Sequence[int], what: str) -> Finding:
    found = setting.shown(setting.parameters)
    parts, camera = check_scene(listed_parts(found[0]), found[1])
    told = {out_of_view(parts[i], camera.for_size(setting.size)) for i in indices}
    cause = told.pop() if len(told) == 1 else None
    because = f"{what} {cause}" if cause else f"what it changes of {what} lies outside of the view"
    return Finding("outside", because, "Move it into the view, or turn the camera.")


# --------------------------------------------------------------------------------------------------- flat losses


def why_flat(setting: Setting, number: Number) -> list[Finding]:
    """Whether the loss is flat around a number that is seen, though a larger move changes it."""
    engine, step = setting.engine, number.slope.step
    samples = 2

    def at(pixels: float) -> float:
        return float(engine.to_numpy(setting.loss(setting.hard(number.direction, pixels * step, samples))))

    here = at(0)
    near = max(abs(at(sign * by) - here) for sign in (1, -1) for by in (1, 2))
    by, far = 4, 0.0
    while by <= max(setting.size) and not far:
        change = max(abs(at(sign * by) - here) for sign in (1, -1))
        if change > FAR * abs(here) and near <= FLAT * change:
            far = change
        else:
            by *= 2
    if not far:
        return []
    mask = np.abs(number.true).max(axis=-1) > QUIET
    share = far / abs(here) if here else 1.0
    because = (
        f"the loss is flat here: moves of two pixels do not change it, one of {by} pixels does, by {share:.0%}; a "
        f"derivative reaches one pixel"
    )
    sigma = _seen_by_blur(setting, number)
    look = f" (a Gaussian of {sigma} pixels sees it)" if sigma else ""
    advice = f"Start nearer, or compare coarser or blurred images first{look}."
    return [Finding("reach", because, advice, mask)]


def _seen_by_blur(setting: Setting, number: Number) -> int | None:
    """Standard deviation of the Gaussian, pixels, through which the loss of images has a slope."""
    from scipy.ndimage import gaussian_filter

    engine, like = setting.engine, next(leaves(setting.parameters))
    ends = [engine.to_numpy(setting.hard(number.direction, by * number.slope.step, 2)) for by in (-0.5, 0, 0.5)]
    sigma = 2
    while sigma <= max(setting.size) / 2:
        blurred = [engine.constant(gaussian_filter(x, (sigma, sigma, 0), mode="constant"), like) for x in ends]
        before, here, after = (float(engine.to_numpy(setting.loss(x))) for x in blurred)
        if abs(after - before) > FLAT * abs(here):
            return sigma
        sigma *= 2
    return None


# -------------------------------------------------------------------------------------------------- combinations


def undetermined(setting: Setting, numbers: Sequence[Number]) -> list[tuple[str, Finding]]:
    """Combinations of numbers along which the image stays as it is, though each of them changes it."""
    numbers = [n for n in numbers if not is_quiet(n.pushed)]
    if len(numbers) < 2:
        return []
    columns = np.stack([n.pushed.reshape(-1) for n in numbers], axis=1)
    lengths = np.linalg.norm(columns, axis=0)
    _, values, vectors = np.linalg.svd((columns / lengths).T @ (columns / lengths))
    units = lengths / np.array([n.slope.step for n in numbers])  # Of the image, for a unit of the number.
    found = []
    for value, vector in zip(values, vectors, strict=True):
        if np.sqrt(max(value, 0)) > OPEN or not _stays(setting, numbers, vector / lengths):
            continue
        found.append(vector / units)
    if not found:
        return []
    basis = np.stack(found, axis=1)
    told = directions_in_words(basis, units, [n.slope.name for n in numbers], [()] * len(numbers))
    because = f"the image does not determine {told}: along it each number changes the image, and all together do not"
    advice = "Fix one of them, add a term that prefers one, or fit the combination that the image shows."
    return [("", Finding("undetermined", because, advice))]


def _stays(setting: Setting, numbers: Sequence[Number], weights: np.ndarray) -> bool:
    """Whether the image stays when numbers are moved together, by a step of the one that moves most."""
    weights = weights / np.abs(weights).max()
    largest = numbers[int(np.argmax(np.abs(weights)))]

    def image(sign: float) -> np.ndarray:
        parts = [sign / 2 * w * n.slope.step for w, n in zip(weights, numbers, strict=True)]
        directions = [list(leaves(n.direction)) for n in numbers]
        total = iter([sum(b * d for b, d in zip(parts, ds, strict=True)) for ds in zip(*directions, strict=True)])
        direction = map_leaves(lambda _: next(total), numbers[0].direction)
        return setting.engine.to_numpy(setting.hard(direction, 1.0, 4))

    change = np.linalg.norm(image(1) - image(-1))
    return bool(change <= OPEN_TRUE * np.linalg.norm(largest.true))
