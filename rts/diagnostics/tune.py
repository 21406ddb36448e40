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
from rts.diagnostics.comparison.progress import Phase, phases
from rts.diagnostics.comparison.scene import SceneFunction, parts_of
from rts.diagnostics.comparison.settings import Setting, usable
from rts.diagnostics.comparison.sources import engines_for, scene_of, some_modes
from rts.diagnostics.comparison.truth import SAMPLES
from rts.diagnostics.comparison.turns import Calls
from rts.engines import stopped
from rts.errors import InputError, ToleranceWarning, warn
from rts.files.paths import output_folder
from rts.interfaces import Part
from rts.trees import Tree

LAYERS = (1, 2, 4, 8)
SUPERSAMPLE = (1, 2, 3, 4)
HOPELESS = 2.0
"""How many times the error of the best splatter another one may have, to be looked at further."""
ALIKE = 0.9
"""A setting is faster than another one if it takes less than this share of its time."""
TURNS = 6
"""Turns of the fastest settings; those that are told of beside the chosen one have a sixth."""
ENOUGH = 3
"""Turns of the chosen one, at least."""
FAR = 1.5
"""A setting is passed over if by what fewer samples did its error will be so many times the tolerance."""


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
    measured = Measurements(found, Journal(), used[:1], truths=kept, samples=truth_samples, together=True)
    measured.leave_out_what_rests()
    with phases(progress) as phase:
        measured.truths(phase("truth", 4 * measured.samples**2 * len(measured.scene.directions)))
        deadline = time.perf_counter() + budget_s
        suited = measured.samplers(possible)
        if not suited:
            raise InputError(f"no sampler suits {found.name!r}: {'; '.join(measured.left_out)}")
        return _Search(measured, tolerance, deadline, phase).run(named, measured.kinds(suited))


class _Search:
    """A search for the cheapest settings within a tolerance.

    Args:
        measured: the scene, and what is known of it.
        tolerance: of the error.
        deadline: when to stop measuring, on the clock of `time.perf_counter`.
        phase: shows progress.
    """

    def __init__(self, measured: Measurements, tolerance: float, deadline: float, phase: Phase):
        self.measured, self.tolerance, self.deadline, self.phase = measured, tolerance, deadline, phase
        self.modes = list(measured.scene.directions)
        self.bounds: dict[Setting, float] = {}
        self.engine = measured.engine.name
        self.late = False

    def run(self, splatters: Sequence[str], samplers: Mapping[str, str]) -> Tuned:
        """The best that is found in time.

        Args:
            splatters: names.
            samplers: names, each with the one whose errors it shares; "" for the usual one.
        """
        self.samplers = samplers
        cells = self._cells(self._promising(splatters))
        within = self._within(cells)
        chosen = self._fastest(self._sampled(within or [self._best(cells)]))
        reasons, faster = self._reasons(chosen, cells, splatters)
        if faster is not None:  # More work need not take longer.
            chosen = faster
            reasons, _ = self._reasons(chosen, cells, splatters)
        error, seconds = self._error(chosen), self._timed([chosen], ENOUGH)[chosen]
        if error > self.tolerance:
            reasons.insert(0, self._told_of_failure(error))
        if self.late:
            reasons.append("the budget was spent before all settings were looked at")
        at = self.measured.forms(TOGETHER)[chosen.rate].at
        own = None if self.measured.scene.separate else self.measured.engine
        parts = stopped(parts_of(at(self.measured.scene.moved(self.modes[0], 0.0, own))))
        return Tuned(parts, chosen.options, chosen.rate, reasons, at, error, seconds)

    def _told_of_failure(self, error: float) -> str:
        """What to say where nothing is within the tolerance; a warning, too."""
        wanted = _percent(self.tolerance)
        told = f"nothing within {wanted} was found in time" if self.late else f"nothing is within {wanted}"
        told = f"{told}: the least error that was found is {_percent(error)}"
        advice = "give a larger budget_s" if self.late else "give a larger tolerance, or look at more pixels"
        warn(f"{told}; {advice}", ToleranceWarning)
        return told

    # -------------------------------------------------------------------------------------------------- accuracy

    def _cells(
        self,
        splatters: Sequence[str],
        layers: Sequence[int] = LAYERS,
        supersample: Sequence[int] = SUPERSAMPLE,
        rates: bool = True,
    ) -> list[Setting]:
        """All settings that may differ in their error, the cheapest first."""
        kinds = dict.fromkeys(self.samplers.values())
        found = self.measured.settings(TOGETHER, splatters, layers, supersample, kinds, rates)
        return sorted(found, key=lambda s: math.prod(self._work(s)))

    def _promising(self, splatters: Sequence[str]) -> list[str]:
        """The splatters that are accurate enough, or nearly as accurate as the best, with two layers and one sample."""
        known: dict[str, float] = {}
        for setting in self._cells(splatters, LAYERS[:2], SUPERSAMPLE[:1], rates=False):
            if not self._over():
                known[setting.splatter] = min(self._error(setting), known.get(setting.splatter, math.inf))
        allowed = max(self.tolerance, HOPELESS * min(known.values(), default=math.inf))
        return [name for name in splatters if known.get(name, 0.0) <= allowed]

    def _sampled(self, settings: Sequence[Setting]) -> list[Setting]:
        """Settings with each sampler that shares their errors."""
        return [
            s._replace(sampler=name, engine=self.engine)
            for s in settings
            for name, kind in self.samplers.items()
            if kind == s.sampler
        ]

    def _cell(self, setting: Setting) -> Setting:
        """What the error of a setting is kept under."""
        return setting._replace(sampler=self.samplers.get(setting.sampler, setting.sampler), engine="")

    def _work(self, setting: Setting) -> tuple[float, ...]:
        layers, supersample, rate = self.measured.work(TOGETHER, self._cell(setting))
        return layers, supersample**2, rate

    def _within(self, cells: Sequence[Setting]) -> list[Setting]:
        """The settings within the tolerance that no cheaper one of their splatter makes needless."""
        done = self.phase("errors", len(cells))
        found: list[Setting] = []
        passed: list[Setting] = []
        for setting in cells:
            done()
            if self._needless(setting, found):
                continue
            if self._far(setting):
                passed.append(setting)
            elif not self._looked_at(setting, found):
                break
        for setting in passed if not found else ():
            if not self._looked_at(setting, found):
                break
        return found

    def _looked_at(self, setting: Setting, found: list[Setting]) -> bool:
        """Whether there was time to look at a setting, which joins those found if it is accurate enough."""
        if self._over():
            return False
        if self._bound(setting) <= self.tolerance:
            found.append(setting)
        return True

    def _needless(self, setting: Setting, found: Sequence[Setting]) -> bool:
        """Whether a setting costs no less, in any respect, than one of its kind that is accurate enough."""
        mine = self._work(setting)
        return any(
            (s.splatter, s.sampler) == (setting.splatter, setting.sampler)
            and all(a <= b for a, b in zip(self._work(s), mine, strict=True))
            for s in found
        )

    def _far(self, setting: Setting) -> bool:
        """Whether the errors with fewer samples, as a power of their number, tell of one that is much too large."""
        fewer = [setting._replace(supersample=n) for n in SUPERSAMPLE if n < setting.supersample]
        known = [(s.supersample, self.bounds[self._cell(s)]) for s in fewer if self._cell(s) in self.bounds]
        if len(known) < 2:
            return False
        (coarse, larger), (fine, smaller) = known[-2:]
        if not 0 < smaller < math.inf or not 0 < larger < math.inf:
            return False
        power = math.log(smaller / larger) / math.log(fine / coarse)
        return smaller * (setting.supersample / fine) ** power > FAR * self.tolerance

    def _best(self, cells: Sequence[Setting]) -> Setting:
        """The setting of the least error among those that were looked at; the first of all where none was."""
        least, best = math.inf, cells[0] if cells else None
        for setting in sorted(self.bounds, key=lambda s: self.bounds[s]):
            if self.bounds[setting] >= least:
                break
            error = self._error(setting)
            if error < least:
                least, best = error, setting
        if best is None:
            raise InputError(f"nothing could be measured: {'; '.join(self.measured.left_out)}")
        return best

    def _bound(self, setting: Setting) -> float:
        """The largest error along a mode, or that along the first mode where it is beyond the tolerance."""
        worst = 0.0
        for mode in self.modes:
            error = self._along(mode, setting)
            if error > self.tolerance:
                # What was too much once is looked at first.
                self.modes = [mode, *(m for m in self.modes if m != mode)]
                worst = error
                break
            worst = max(worst, error)
        self.bounds[self._cell(setting)] = worst
        return worst

    def _error(self, setting: Setting) -> float:
        """The largest error along a mode."""
        worst = max(self._along(mode, setting) for mode in self.modes)
        self.bounds[self._cell(setting)] = worst
        return worst

    def _along(self, mode: str, setting: Setting) -> float:
        found = self.measured.scores(mode, self._cell(setting))
        return math.inf if found is None else found["error"]

    # ------------------------------------------------------------------------------------------------------ time

    def _over(self) -> bool:
        self.late = self.late or time.perf_counter() > self.deadline
        return self.late

    def _timed(self, settings: Sequence[Setting], turns: int = 1) -> dict[Setting, float]:
        """Seconds of settings, those that fail or come too late left out."""
        calls: Calls = {s: lambda s=s: self.measured.call(TOGETHER, s) for s in settings}
        found = self.measured.turns(TOGETHER, calls).run(turns, late=self._over)
        return {Setting(*s): ms["median"] / 1e3 for s, ms in found.items()}

    def _fastest(self, settings: Sequence[Setting]) -> Setting:
        """The fastest, by successive halving: all have a turn, the faster half another, and so on."""
        turns, left = 1, list(settings)
        while True:
            times = self._timed(left, turns)
            if not times:
                raise InputError(f"nothing could be timed: {'; '.join(self.measured.left_out)}")
            left = sorted(times, key=lambda s: times[s])[: max(1, (len(times) + 1) // 2)]
            if len(times) <= 1 or turns >= TURNS or self._over():
                return left[0]
            turns += 1

    # --------------------------------------------------------------------------------------------------- reasons

    def _reasons(
        self, chosen: Setting, cells: Sequence[Setting], splatters: Sequence[str]
    ) -> tuple[list[str], Setting | None]:
        """For each choice what the cheaper one lacks, and what the next one costs; and what is better after all."""
        options: dict[str, list] = {
            "layers": list(dict.fromkeys(s.layers for s in cells)),
            "supersample": list(SUPERSAMPLE),
            "rate": list(self.measured.forms(TOGETHER)),
            "splatter": list(splatters),
            "sampler": list(self.samplers),
        }
        others = {name: self._others(chosen, name, values) for name, values in options.items()}
        told = dict.fromkeys(s for found in others.values() for s in found if s is not None)
        times = self._timed([chosen, *told]) if not self._over() else {}
        faster = [s for s in times if times[s] < ALIKE * times[chosen] and self._error(s) <= self.tolerance]
        lines = [self._reason(chosen, name, *found, times) for name, found in others.items() if any(found)]
        return lines, min(faster, key=lambda s: times[s], default=None)

    def _others(self, chosen: Setting, name: str, values: Sequence) -> tuple[Setting | None, Setting | None]:
        """The next cheaper and the next dearer setting in one respect; for names, one that is another."""
        found = [chosen._replace(**{name: value}) for value in values if value != getattr(chosen, name)]
        if name in ("splatter", "sampler"):
            known = [s for s in found if self._cell(s) in self.bounds]
            return None, min(known, key=lambda s: self.bounds[self._cell(s)], default=None)
        mine = math.prod(self._work(chosen))
        work = {s: math.prod(self._work(s)) for s in found}
        below, above = [s for s in found if work[s] < mine], [s for s in found if work[s] > mine]
        return max(below, key=lambda s: work[s], default=None), min(above, key=lambda s: work[s], default=None)

    def _reason(
        self, chosen: Setting, name: str, below: Setting | None, above: Setting | None, times: Mapping[Setting, float]
    ) -> str:
        """One line on one choice."""
        parts = []
        if below is not None and not self._over():
            parts.append(f"{_value(below, name)} is off by {_percent(self._error(below))}")
        if above is not None and chosen in times and above in times:
            ratio = times[above] / times[chosen]
            error = f", off by {_percent(self._error(above))}" if name != "sampler" else ""
            parts.append(f"{_value(above, name)} takes {ratio:.2g} times as long{error}")
        return f"{_value(chosen, name)}: {'; '.join(parts)}" if parts else f"{_value(chosen, name)}"


def _value(setting: Setting, name: str) -> str:
    """A choice as a user would write it."""
    value = getattr(setting, name)
    if name == "rate":
        return value or "the surfaces as they are given"
    return f"{name}={value!r}"


def _percent(error: float) -> str:
    return f"{100 * error:.3g} %"
