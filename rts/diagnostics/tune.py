"""`rts.tune`: the cheapest settings that are accurate enough, on one scene, for its parameters, on this machine."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rts.arguments import check_positive, quoted
from rts.checks import is_count, is_real
from rts.diagnostics.comparison.journal import Journal
from rts.diagnostics.comparison.measure import TOGETHER, Measurements
from rts.diagnostics.comparison.progress import phases
from rts.diagnostics.comparison.scene import SceneFunction, parts_of
from rts.diagnostics.comparison.search import SUPERSAMPLE, Search
from rts.diagnostics.comparison.settings import usable
from rts.diagnostics.comparison.sources import engines_for, scene_of, some_modes
from rts.diagnostics.comparison.truth import SAMPLES
from rts.engines import stopped
from rts.errors import InputError
from rts.files.paths import output_folder
from rts.interfaces import Part
from rts.trees import Tree

SAMPLED = 1.0
"""Seconds that a sampler may take, for 512² pixels or fewer."""


class Tuned(NamedTuple):
    """Settings, and what is to be rendered with them.

    Attributes:
        parts: the scene's parts at the parameters, without derivatives, their surfaces at the rates that were chosen.
        settings: keyword arguments of `rts.render`: sampler, splatter, layers and supersample.
        rate: what is other about the surfaces, such as "tolerance=0.4"; "" for nothing.
        reasons: a line for each choice: what the cheaper one lacks, and what the next costs.
        scene: parameters → (parts, camera), with the same rates: what a fit renders.
        error: the largest error of the derivatives along the modes, relative L2 through a Gaussian of 2 pixels.
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
    scene: Any,
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
    truth_samples: int = SAMPLES,
    progress: bool | None = None,
) -> Tuned:
    """Find the cheapest settings whose derivatives are accurate enough.

    They are for `rts.render(tuned.parts, camera, size, **tuned.settings)`.

    Sampler, splatter, layers, samples a pixel, and the rates that surfaces offer: tolerances, lattices, meshes of fewer
    faces where no derivative is taken of their vertices. Errors are measured as in `rts.diagnostics.compare`, of cheap
    settings first; dearer ones are not looked at. Those that are accurate enough are timed in turns, and the slower
    half is left out each time.

    Args:
        scene: as in `rts.diagnostics.compare`.
        parameters: of the scene's function: where derivatives are taken.
        tolerance: the largest error of the derivatives along any mode, such as 0.05.
        budget_s: seconds of measuring, after which the best so far is taken; the truth, which is made once and kept,
            does not count.
        directions: as in `compare`.
        size: (height, width); None for the scene's own. Errors and times are those of this size.
        modes: as in `compare`.
        engine: its name; None for that of the parameters, or for the first that is installed.
        samplers: names; None for all that suit the scene.
        splatters: names; None for all.
        surface: the kind of surface that reads a model.
        truths: the folder of truths; None for the folder of caches.
        truth_samples: of the truth, along each side of a pixel; fewer are faster, and leave a larger error of its own.
        progress: whether to show progress; None for where standard error is a terminal.

    Raises:
        InputError: there is no such scene, or an argument is wrong; before anything is measured.

    Warns:
        ToleranceWarning: nothing is accurate enough; the most accurate is given.
    """
    if not (is_real(tolerance) and 0 < tolerance < math.inf):
        raise InputError(f"tolerance is {quoted(tolerance)}; expected a share of the derivative, such as 0.05")
    check_positive("budget_s", budget_s)
    if not is_count(truth_samples):
        raise InputError(f"truth_samples is {quoted(truth_samples)}; expected an integer of at least 1")
    found = some_modes(scene_of(scene, parameters, directions, size, surface=surface), modes)
    kept = None if truths is None else output_folder(truths)
    named = usable("rts.splatters", splatters)[0]
    possible = usable("rts.samplers", samplers)[0]
    used, _ = engines_for(found, None if engine is None else [engine])
    measured = Measurements(
        found,
        Journal(),
        used[:1],
        truths=kept,
        samples=truth_samples,
        together=True,
        count_at=SUPERSAMPLE[-1],
        slowest=SAMPLED * max(1.0, math.prod(found.size) / 512**2),
    )
    measured.leave_out_what_rests()
    with phases(progress) as phase:
        measured.truths(phase("truth", 4 * measured.samples**2 * len(measured.scene.directions)))
        deadline = time.perf_counter() + budget_s
        suited = measured.samplers(possible)
        if not suited:
            raise InputError(f"no sampler suits {found.name!r}: {'; '.join(measured.left_out)}")
        search = Search(measured, measured.kinds(suited), tolerance, deadline, phase)
        chosen, reasons, error, seconds = search.run(named)
    at = measured.forms(TOGETHER)[chosen.rate].at
    own = None if measured.scene.separate else measured.engine
    parts = stopped(parts_of(at(measured.scene.moved(next(iter(measured.scene.directions)), 0.0, own))))
    return Tuned(parts, chosen.options, chosen.rate, reasons, at, error, seconds)
