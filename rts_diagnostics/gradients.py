"""Derivatives as pictures, and compared with finite differences of images without splatting."""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from rts import Engine, namespace, render
from rts.errors import EmptyImageWarning, InputError, InputWarning, LayersWarning
from rts.plugin_api.arrays import Array, Tree, leaves, map_leaves
from rts.plugin_api.checks import is_count, quoted
from rts.tool_api.parameters import is_real, kind_of
from rts.tool_api.scenes import check_pixels
from rts_diagnostics.gradient_images import check_callable, checked_parameters, traceable
from rts_diagnostics.gradient_reasons.reasons import Reason, legend, marked
from rts_diagnostics.gradient_reasons.second_derivatives import HessianCheck, curvatures, require_second_derivatives
from rts_diagnostics.gradient_reasons.selection import explained
from rts_diagnostics.gradient_reasons.shared_budget import Clock, looked_at
from rts_diagnostics.gradient_reasons.slopes import NEGLIGIBLE, Slope
from rts_diagnostics.gradient_reasons.subject import Scene, Subject
from rts_diagnostics.progress import phases

LOSS_SMOOTHNESS = 4.0
"""Standard deviation of the Gaussian that smooths the weights of the default loss, pixels."""


class GradientCheck(NamedTuple):
    """The result of `check_gradient`; as a string, a table with its reasons.

    Attributes:
        slopes: one for each number that was checked.
        tolerance: the largest error of a derivative, relative to it.
        reasons: why slopes differ or vanish, those that explain most first.
        picture: (H, W, 3) linear RGB for `rts.save_image`: the scene, dark, and the pixels of reasons in their colours.
        note: omissions, for example because the budget was spent; empty if there are none.
        hessian: second derivatives, where they were asked for.
    """

    slopes: list[Slope]
    tolerance: float
    reasons: Sequence[Reason] = ()
    picture: np.ndarray | None = None
    note: str = ""
    hessian: HessianCheck | None = None

    def agrees(self, slope: Slope) -> bool:
        """True if autodiff and the difference agree.

        They may differ by the tolerance, three error bars, and an amount negligible beside the other slopes. The
        tolerance is relative to the derivative or, where contributions of pixels cancel in it, to the size of these.
        Slopes in different units are compared by the effect of a one-pixel step on the loss.
        """
        effects = [abs(s.difference * s.step) for s in self.slopes]
        largest = max((x for x in effects if math.isfinite(x)), default=0.0)
        allowed = self.tolerance * max(abs(slope.difference), slope.contributions)
        allowed += 3 * slope.error + NEGLIGIBLE * largest / slope.step
        return abs(slope.autodiff - slope.difference) <= allowed

    @property
    def ok(self) -> bool:
        """True if all slopes agree; second derivatives have an `ok` of their own."""
        return all(map(self.agrees, self.slopes))

    def __str__(self) -> str:
        width = max(len(s.name) for s in self.slopes)
        lines = [f"{'parameter':{max(width, 9)}}    autodiff  difference      ± error   ratio"]
        for s in self.slopes:
            ratio = f"{s.autodiff / s.difference:7.3f}" if abs(s.difference) > s.error else "      –"
            verdict = "" if self.agrees(s) else "  differs"
            lines.append(
                f"{s.name:{max(width, 9)}} {s.autodiff:11.4g} {s.difference:11.4g} {s.error:12.2g} {ratio}{verdict}"
            )
        lines += [f"- {reason.kind}: {reason.text}" for reason in self.reasons]
        colors = legend(self.reasons)
        lines += [f"In the picture: {colors}."] if colors else []
        return "\n".join([*lines, *map(str, filter(None, [self.hessian, self.note]))])


def check_gradient(
    scene: Scene,
    parameters: Tree,
    size: tuple[int, int],
    *,
    loss: Callable[[Array], Array] | None = None,
    entries: int = 6,
    samples: int = 8,
    tolerance: float = 0.1,
    hessian: bool = False,
    budget_s: float = 60.0,
    progress: bool | None = None,
    **options: Any,
) -> GradientCheck:
    """Compare the gradient of a loss of a rendered scene with finite differences, and say why they differ or vanish.

    The differences are of images without splatting, with `samples`² and (`samples` + 1)² samples a pixel. Their step
    moves the fastest point by one pixel; they are repeated over twice that step. If a derivative disagrees or
    vanishes, experiments on the scene tell why: without culling, with one part alone, with more layers or samples,
    from farther away, and so on.

    Args:
        scene: parameters → (parts, camera).
        parameters: a torch or jax array, or nested dicts and lists of them.
        size: (height, width).
        loss: image (H, W, 4) → scalar; None for a smooth random weighting of the image, with a fixed seed.
        entries: the most numbers of each array to check: those of largest gradient, and some at random.
        samples: samples a pixel along each axis.
        tolerance: the largest error of a derivative, relative to it.
        hessian: True to compare second derivatives of the numbers, too: those of autodiff with differences of
            gradients two pixels ahead and behind. See `HessianCheck`.
        budget_s: seconds after which nothing more is begun; the result covers what was checked until then, at least
            one number. If time is short, all numbers are checked with few samples before any is with more.
        progress: True to show a bar on standard error, False for none; None to show it on a terminal.
        **options: splatter, layers, supersample, background, … of `rts.render`.

    Returns:
        The two derivatives of each number that was checked, the reasons, and a picture; see `GradientCheck`.

    Raises:
        InputError: parameters that have no derivative or are traced; nothing that depends on them; an argument out of
            its range; results of another kind from `scene` or `loss`; with `hessian`, a scene that cannot be
            differentiated twice; or what `rts.render` refuses.
        EngineError: arrays of two engines; with `hessian`, an engine without forward mode.
    """
    clock = Clock(budget_s)
    check_callable("scene", scene, "a function: parameters → (parts, camera)")
    if loss is not None:
        check_callable("loss", loss, "a function: image (H, W, 4) → scalar, or None")
    engine, parameters = checked_parameters(parameters, "rts.check_gradient")
    size = check_pixels(size)
    for name, count in (("samples", samples), ("entries", entries)):
        if not is_count(count):
            raise InputError(f"{name} is {quoted(count)}; expected an integer of at least 1")
    if not (is_real(tolerance) and 0 <= tolerance < math.inf):
        raise InputError(f"tolerance is {quoted(tolerance)}; expected a number, at least 0")
    if not isinstance(hessian, (bool, np.bool_)):
        raise InputError(f"hessian is {quoted(hessian)}; expected True or False")
    if not (progress is None or isinstance(progress, bool)):
        raise InputError(f"progress is {quoted(progress)}; expected True, False, or None for where there is a terminal")
    known = [n for n in inspect.signature(render).parameters if n not in ("parts", "camera", "size", "outputs")]
    if unknown := [name for name in options if name not in known]:
        raise InputError(f"there is no option {unknown[0]!r}; expected {', '.join(known)}")
    own_loss = loss is not None
    loss = _scalar(_smooth_weighting(size, engine, parameters) if loss is None else loss, engine)
    subject = Subject(engine, scene, map_leaves(engine.stop_gradient, parameters), size, options, loss)
    with traceable(engine), phases(progress) as phase, warnings.catch_warnings():
        # The check itself tells why nothing is seen.
        warnings.simplefilter("ignore", EmptyImageWarning)
        warnings.simplefilter("ignore", LayersWarning)
        if hessian:
            warnings.filterwarnings("ignore", "second derivatives of an image", InputWarning)
        subject.require_dependence()
        if hessian:
            require_second_derivatives(subject)
        numbers, count, rough = looked_at(subject, entries, samples, clock, phase)
        second = curvatures(subject, numbers, tolerance, clock.going, phase) if hessian else None
        check = GradientCheck([n.slope for n in numbers], tolerance, hessian=second)
        plain = [n for n in numbers if n.forward]
        reasons, left = explained(subject, plain, check.agrees, own_loss, clock.turn, phase)
        picture = marked(subject.rendered, reasons)
    notes = [f"{len(numbers)} of {count} numbers were looked at"] if len(numbers) < count else []
    notes += [f"the differences of {rough} are of fewer samples than asked for"] if rough else []
    if second is not None and len(second.names) < len(numbers):
        notes.append(f"second derivatives are of {len(second.names)} numbers")
    notes += [f"reasons were not looked for, or not all, in {left} of them"] if left else []
    remarks = [f"In {clock.spent:.0f} s of a budget of {clock.budget:g}: {', and '.join(notes)}."] if notes else []
    if len(plain) < len(numbers):
        remarks.append("Reasons were not looked for, since forward mode does not go through the splatter or a shader.")
    return check._replace(reasons=reasons, picture=picture, note=" ".join(remarks))


# --------------------------------------------------------------------------------------------------- parameters


def _scalar(loss: Callable[[Array], Array], engine: Engine) -> Callable[[Array], Array]:
    """The loss, with a check that its result is a scalar of the engine."""

    def call(image: Array) -> Array:
        value = loss(image)
        if not engine.owns(value) or value.shape != ():
            raise InputError(f"loss gave {kind_of(value)}; expected a {engine.name} scalar, of shape ()")
        return value

    return call


def _smooth_weighting(size: tuple[int, int], engine: Engine, parameters: Tree) -> Callable[[Array], Array]:
    """A loss: image (H, W, 4) → the sum of its values with smooth random weights, the same for equal sizes."""
    from scipy.ndimage import gaussian_filter

    weights = np.random.default_rng(0).normal(size=(*size, 4))
    weights = gaussian_filter(weights, (LOSS_SMOOTHNESS, LOSS_SMOOTHNESS, 0))
    weights = engine.constant(weights / weights.std(), next(leaves(parameters)))
    return lambda image: namespace(image).sum(image * weights)
