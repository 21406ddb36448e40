"""`rts.tune`: the cheapest settings that are accurate enough, on one scene, for its parameters, on this machine."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rts import Camera, Part, engine_of
from rts.errors import InputError
from rts.plugin_api.arrays import Tree, map_leaves
from rts.plugin_api.checks import check_positive, is_count, quoted
from rts.tool_api.files import output_folder
from rts_compare.compared_settings import usable
from rts_compare.kept_measurements import KeptMeasurements
from rts_compare.measurements import TOGETHER, Measurements
from rts_compare.moving_scenes import Scene, SceneFunction, parts_of
from rts_compare.scene_sources import engines_for, scene_of, some_modes
from rts_compare.settings_search import SUPERSAMPLE, Search
from rts_compare.true_derivatives import SAMPLES
from rts_diagnostics.progress import Phase, phases

TRUTH_SAMPLES = (4, 8, SAMPLES)
"""`truth_samples` to choose from: the next number where the error of the true derivative itself is too large."""
TRUE = 0.3
"""The largest error of a true derivative, a share of the tolerance: errors at it seem 5 % larger."""
SAMPLED = 1.0
"""Seconds that a sampler may take for an image of at most 512² pixels; in proportion for more."""


class Tuned(NamedTuple):
    """The settings that `tune` chose, and the scene to render with them.

    Attributes:
        parts: the scene's parts at the parameters, without derivatives, their surfaces at the rates that were chosen.
        settings: keyword arguments of `rts.render`: sampler, splatter, layers and supersample.
        rate: how the surfaces differ from the given ones, such as "tolerance=0.4"; "" if they do not.
        reasons: a line for each choice: the error of a cheaper one, and the time of a dearer one; and lines on
            failures: nothing accurate enough, too little time, a rough truth.
        scene: the function parameters → (parts, camera) with these rates, for a fit to render.
        error: the largest error of the derivatives along any mode: relative L2, smoothed by a Gaussian of standard
            deviation 2 pixels.
        seconds: median time of a render and gradient.
    """

    parts: list[Part]
    settings: dict[str, Any]
    rate: str
    reasons: list[str]
    scene: SceneFunction
    error: float
    seconds: float


def tune(
    scene: str | Path | Scene | SceneFunction | Callable[[], tuple[Part | Sequence[Part], Camera]],
    parameters: Tree = None,
    *,
    tolerance: float = 0.05,
    budget_s: float = 60.0,
    directions: Mapping[str, Tree] | None = None,
    size: tuple[int, int] | None = None,
    modes: Sequence[str] | None = None,
    engine: str | None = None,
    samplers: Sequence[str] | None = None,
    splatters: Sequence[str] | None = None,
    surface: str = "mesh",
    truths: Path | str | None = None,
    truth_samples: int | None = None,
    progress: bool | None = None,
) -> Tuned:
    """Find the cheapest settings whose derivatives are accurate enough.

    Render with them by `rts.render(tuned.parts, camera, size, **tuned.settings)`.

    The choices are sampler, splatter, layers, samples a pixel, and the rates that surfaces offer: tolerances, lattices,
    and meshes of fewer faces where no derivative is taken of their vertices. Errors are measured as in
    `rts_compare.compare`, of cheap settings first, until dearer ones are not needed. Settings that are accurate enough
    are timed in turns, and the slower half is left out each time.

    Args:
        scene: as in `rts_compare.compare`.
        parameters: of the scene's function: where derivatives are taken.
        tolerance: the largest error of the derivatives along any mode, see `Tuned.error`; such as 0.05.
        budget_s: seconds of measuring, after which the best so far is taken. The truth, which is made before and kept,
            is not refined when that would take longer than half the budget.
        directions: as in `compare`.
        size: (height, width); None for the scene's own. Errors and times are those of this size.
        modes: as in `compare`.
        engine: the engine's name; None for the engine of the parameters, or the first that is installed.
        samplers: names; None for all that suit the scene.
        splatters: names; None for all.
        surface: the name of the surface that reads a model, such as "mesh" or "bezier".
        truths: the folder of true derivatives; None for the folder of caches.
        truth_samples: the square root of the number of samples a pixel, on each of two grids, of true derivatives;
            fewer are faster and less exact. None for 4, 8 or 16: for each mode the fewest that make the true
            derivative's estimated error at most 0.3 of the tolerance. Where that takes too long, or 16 do not suffice,
            a reason says so.
        progress: whether to show progress; None for where standard error is a terminal.

    Raises:
        InputError: there is no such scene, or an argument is wrong; before anything is measured. Or no sampler suits
            the scene, nothing in the image changes, or nothing can be measured.
        PluginError: a named plugin cannot be loaded, or no engine with derivatives is installed.

    Warns:
        ToleranceWarning: nothing is accurate enough; the most accurate is given.
    """
    check_positive("tolerance", tolerance)
    check_positive("budget_s", budget_s)
    if truth_samples is not None and not is_count(truth_samples):
        raise InputError(f"truth_samples is {quoted(truth_samples)}; expected an integer of at least 1")
    if engine is not None and not isinstance(engine, str):
        raise InputError(f"engine is {quoted(engine)}; expected a name, such as 'torch', or None")
    found = some_modes(scene_of(scene, parameters, directions, size, surface=surface), modes)
    kept = None if truths is None else output_folder(truths)
    named = usable("rts.splatters", splatters)[0]
    possible = usable("rts.samplers", samplers)[0]
    used, _ = engines_for(found, None if engine is None else [engine])
    measured = Measurements(
        found,
        KeptMeasurements(),
        used[:1],
        truths=kept,
        samples=truth_samples or TRUTH_SAMPLES[0],
        together=True,
        count_at=SUPERSAMPLE[-1],
        slowest=SAMPLED * max(1.0, math.prod(found.size) / 512**2),
    )
    measured.leave_out_what_rests()
    with phases(progress) as phase:
        _make_truths(measured, tolerance, budget_s / 2, phase, TRUTH_SAMPLES[1:] if truth_samples is None else ())
        measured.leave_out_what_hardly_changes()
        deadline = time.perf_counter() + budget_s
        suited = measured.samplers(possible)
        if not suited:
            raise InputError(f"no sampler suits {found.name!r}: {'; '.join(measured.left_out)}")
        search = Search(measured, measured.kinds(suited), tolerance, deadline, phase)
        chosen, reasons, error, seconds = search.run(named)
    reasons += _told_of_truths(measured, tolerance)
    if resting := [mode for mode in found.directions if mode not in measured.scene.directions]:
        reasons.append(f"the image hardly changes along {', '.join(resting)}: no errors are measured there")
    at = measured.at_rates(TOGETHER)[chosen.rate].at
    own = None if measured.scene.separate else measured.engine
    parts = parts_of(at(measured.scene.moved(next(iter(measured.scene.directions)), 0.0, own)))
    parts = map_leaves(lambda x: engine_of(x).stop_gradient(x), parts)
    return Tuned(parts, chosen.options, chosen.rate, reasons, at, error, seconds)


def _make_truths(measured: Measurements, tolerance: float, seconds: float, phase: Phase, finer: Sequence[int]) -> None:
    """Make true derivatives; then rough ones anew with `finer` samples, while a pass should take at most `seconds`."""

    def told(modes: Sequence[str], samples: int) -> Callable[[], None]:
        return phase(f"truth, {samples} × {samples}", 4 * samples**2 * len(modes))

    start = time.perf_counter()
    measured.truths(told(list(measured.scene.directions), measured.samples))
    made, count = measured.samples, len(measured.scene.directions)
    for samples in finer:
        rough, now = measured.rough(TRUE * tolerance), time.perf_counter()
        each = (now - start) / (count * made**2)
        if not rough or each * len(rough) * samples**2 > seconds:
            return
        start, made, count = now, samples, len(rough)
        measured.refine_truths(rough, samples, told(rough, samples))


def _told_of_truths(measured: Measurements, tolerance: float) -> list[str]:
    """A list of one line on the modes whose true derivative is too rough for the tolerance; empty if there are none."""
    rough = measured.rough(TRUE * tolerance)
    if not rough:
        return []
    most = max(measured.truth(mode).error for mode in rough)
    return [f"the truth itself is known to {100 * most:.2g} % along {', '.join(rough)}"]
