"""A search for the cheapest settings within a tolerance: errors of cheap ones first, then the fastest that suffices."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from rts.errors import InputError, ToleranceWarning, warn
from rts_compare.compared_settings import Setting
from rts_compare.interleaved_timing import Calls
from rts_compare.measurements import TOGETHER, Measurements
from rts_diagnostics.progress import Phase

LAYERS = (1, 2, 4, 8)
SUPERSAMPLE = (1, 2, 4)
HOPELESS = 2.0
"""A splatter is tried further if its error is within the tolerance, or at most this many times the best one's."""
ALIKE = 0.9
"""The share of another setting's time below which a setting counts as faster."""
TURNS = 6
"""The most timed turns of a setting; settings that are only compared with the chosen one have one."""
MORE_WORK = 2.0
"""A setting of more than this many times the estimated cost of an accurate one is not tried, whatever its splatter."""
SLOWER = 3.0
"""A setting whose first call takes more than this many times the fastest one's time is called only once in a turn."""
ENOUGH = 3
"""The fewest timed turns of the chosen setting."""
NEARLY = 1.2
"""A setting is skipped if even the most layers and finest surface, with its samples, err by more than this many
times the tolerance."""


class Found(NamedTuple):
    """The setting that a search chose.

    Attributes:
        setting: sampler, splatter, layers, samples, rate and engine.
        reasons: a line for each of these, but the engine, for which another choice was looked at; and on failures.
        error: the largest error of the derivative along any mode, see `derivative_scores.scores`.
        seconds: median time of a render and gradient.
    """

    setting: Setting
    reasons: list[str]
    error: float
    seconds: float


class Search:
    """A search for the cheapest settings within a tolerance.

    Args:
        measured: the scene and its measurements.
        samplers: sampler → the sampler whose errors it shares, as `Measurements.kinds`.
        tolerance: the largest error allowed along any mode, relative L2.
        deadline: when to stop measuring, on the clock of `time.perf_counter`.
        phase: shows progress.
    """

    def __init__(
        self,
        measured: Measurements,
        samplers: Mapping[str, str],
        tolerance: float,
        deadline: float,
        phase: Phase,
    ):
        self.measured, self.samplers, self.phase = measured, samplers, phase
        self.tolerance, self.deadline = tolerance, deadline
        self.modes = list(measured.scene.directions)
        self.bounds: dict[Setting, float] = {}
        self.engine = measured.engine.name
        self.late = False

    def run(self, splatters: Sequence[str]) -> Found:
        """The fastest setting within the tolerance that is found in time; if there is none, the most accurate one.

        Raises:
            InputError: nothing could be measured or timed.

        Warns:
            ToleranceWarning: no setting within the tolerance was found.
        """
        cells: list[Setting] = []
        within: list[Setting] = []
        for kind in dict.fromkeys(self.samplers.values()):
            if not within:
                cells = self._cells(self._promising(splatters, kind), kind)
                within = self._within(cells)
        within = [s for s in within if not self._needless(s, [other for other in within if other != s])]
        chosen = self._fastest(self._sampled(within or [self._best(cells)]))
        reasons, faster = self._reasons(chosen, cells, splatters)
        if faster is not None:  # A setting of more work may take less time.
            chosen = faster
            reasons, _ = self._reasons(chosen, cells, splatters)
        error, seconds = self._error(chosen), self._timed([chosen], ENOUGH)[chosen]
        if error > self.tolerance:
            reasons.insert(0, self._told_of_failure(error))
        if self.late:
            reasons.append("the budget was spent before all settings were looked at")
        return Found(chosen, reasons, error, seconds)

    def _told_of_failure(self, error: float) -> str:
        """Warn that no setting is within the tolerance; return a line that says so."""
        wanted = _percent(self.tolerance)
        sentence = f"nothing within {wanted} was found in time" if self.late else f"nothing is within {wanted}"
        sentence = f"{sentence}: the least error that was found is {_percent(error)}"
        advice = "give a larger budget_s" if self.late else "give a larger tolerance, or look at more pixels"
        warn(f"{sentence}; {advice}", ToleranceWarning)
        return sentence

    # -------------------------------------------------------------------------------------------------- accuracy

    def _cells(
        self,
        splatters: Sequence[str],
        kind: str,
        layers: Sequence[int] = LAYERS,
        supersample: Sequence[int] = SUPERSAMPLE,
        rates: bool = True,
    ) -> list[Setting]:
        """All settings whose sampler has errors of one kind, a value of `samplers`; the least work first."""
        settings = self.measured.settings(TOGETHER, splatters, layers, supersample, [kind], rates)
        return sorted(settings, key=lambda s: math.prod(self._work(s)))

    def _promising(self, splatters: Sequence[str], kind: str) -> list[str]:
        """Splatters that `HOPELESS` allows, by errors with one or two layers and one sample; and untried ones."""
        known: dict[str, float] = {}
        for setting in self._cells(splatters, kind, LAYERS[:2], SUPERSAMPLE[:1], rates=False):
            if not self._over():
                known[setting.splatter] = min(self._error(setting), known.get(setting.splatter, math.inf))
        allowed = max(self.tolerance, HOPELESS * min(known.values(), default=math.inf))
        return [name for name in splatters if known.get(name, 0.0) <= allowed]

    def _sampled(self, settings: Sequence[Setting]) -> list[Setting]:
        """Each setting with all samplers that share its errors, and with others that are accurate enough."""
        sampled = []
        for setting in settings:
            for name, kind in self.samplers.items():
                other = setting._replace(sampler=name, engine=self.engine)
                if kind == setting.sampler or (not self._over() and self._bound(other) <= self.tolerance):
                    sampled.append(other)
        return sampled

    def _cell(self, setting: Setting) -> Setting:
        """The setting that the error is kept under: with the sampler whose errors are shared, without engine."""
        return setting._replace(sampler=self.samplers.get(setting.sampler, setting.sampler), engine="")

    def _work(self, setting: Setting) -> tuple[float, ...]:
        layers, supersample, rate = self.measured.work(TOGETHER, self._cell(setting))
        return layers, supersample**2, rate

    def _within(self, cells: Sequence[Setting]) -> list[Setting]:
        """Settings whose error is within the tolerance, without settings that are `_needless` beside a cheaper one.

        Of a splatter, sampler and samples the cheapest is tried first, then that of the most layers and finest surface:
        the others are not, if this one is too inaccurate.
        """
        levels: dict[tuple, list[Setting]] = {}
        for setting in cells:
            levels.setdefault((setting.splatter, setting.sampler, setting.supersample), []).append(setting)
        done, accurate = self.phase("errors", len(levels)), []
        for level in levels.values():
            done()
            best = max(level, key=lambda s: self._work(s)[::-1])
            for setting in dict.fromkeys([level[0], best, *level]):
                if self._over():
                    return accurate
                if self._needless(setting, accurate):
                    continue
                error = self._bound(setting)
                if error <= self.tolerance:
                    accurate.append(setting)
                elif setting == best and error > NEARLY * self.tolerance:
                    break
        return accurate

    def _needless(self, setting: Setting, accurate: Sequence[Setting]) -> bool:
        """True if an accurate setting costs far less, or no more in any respect with the same splatter and sampler."""
        mine = self._work(setting)
        if any(self._cost(setting) > MORE_WORK * self._cost(s) for s in accurate):
            return True
        return any(
            (s.splatter, s.sampler) == (setting.splatter, setting.sampler)
            and all(a <= b for a, b in zip(self._work(s), mine, strict=True))
            for s in accurate
        )

    def _cost(self, setting: Setting) -> float:
        """The approximate cost of a setting: hidden layers have few samples, and faces cost less than pixels."""
        layers, samples, rate = self._work(setting)
        return math.sqrt(layers * rate) * samples

    def _best(self, cells: Sequence[Setting]) -> Setting:
        """The setting with the least error of all that the search tried; without any error, the first of `cells`.

        Raises:
            InputError: there are no `cells` either.
        """
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
        """The largest of a setting's errors along the modes, or the first beyond the tolerance, a lower bound.

        Infinite if a measurement fails. Always looked up anew; written to `bounds` under `_cell(setting)`. A mode
        beyond the tolerance is tried first from then on.
        """
        worst = 0.0
        for mode in self.modes:
            error = self._along(mode, setting)
            if error > self.tolerance:
                # A mode that was beyond the tolerance once is tried first.
                self.modes = [mode, *(m for m in self.modes if m != mode)]
                worst = error
                break
            worst = max(worst, error)
        self.bounds[self._cell(setting)] = worst
        return worst

    def _error(self, setting: Setting) -> float:
        """The largest of a setting's errors along all modes; kept in `bounds`."""
        worst = max(self._along(mode, setting) for mode in self.modes)
        self.bounds[self._cell(setting)] = worst
        return worst

    def _along(self, mode: str, setting: Setting) -> float:
        scores = self.measured.scores(mode, self._cell(setting))
        return math.inf if scores is None else scores["error"]

    # ------------------------------------------------------------------------------------------------------ time

    def _over(self) -> bool:
        self.late = self.late or time.perf_counter() > self.deadline
        return self.late

    def _timed(self, settings: Sequence[Setting], turns: int = 1) -> dict[Setting, float]:
        """Setting → median seconds; without settings that fail, or whose turn comes after the deadline."""
        calls: Calls = {s: lambda s=s: self.measured.call(TOGETHER, s) for s in settings}
        timing = self.measured.timing(TOGETHER, calls)
        timed = timing.run(turns, late=self._over, hopeless=SLOWER)
        lines = [f"{', '.join(str(v) for v in s if v != '')}: {why}" for s, why in timing.failed.items()]
        self.measured.left_out += [line for line in lines if line not in self.measured.left_out]
        return {Setting(*s): ms["median"] / 1e3 for s, ms in timed.items()}

    def _fastest(self, settings: Sequence[Setting]) -> Setting:
        """The fastest setting, by successive halving: all have a turn, the faster half another, and so on.

        Raises:
            InputError: none could be timed.
        """
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
        """Lines on each choice: the cheaper one's error, the dearer one's time; and a setting to prefer, or None.

        That is the fastest accurate one of those compared, if it takes less than `ALIKE` of the chosen one's time.
        """
        options: dict[str, list] = {
            "layers": list(dict.fromkeys(s.layers for s in cells)),
            "supersample": list(SUPERSAMPLE),
            "rate": list(self.measured.at_rates(TOGETHER)),
            "splatter": list(splatters),
            "sampler": list(self.samplers),
        }
        others = {name: self._others(chosen, name, values) for name, values in options.items()}
        shown = dict.fromkeys(s for pair in others.values() for s in pair if s is not None)
        times = self._timed([chosen, *shown]) if not self._over() else {}
        faster = [s for s in times if times[s] < ALIKE * times[chosen] and self._error(s) <= self.tolerance]
        lines = [self._reason(chosen, name, *pair, times) for name, pair in others.items() if any(pair)]
        return lines, min(faster, key=lambda s: times[s], default=None)

    def _others(self, chosen: Setting, name: str, values: Sequence) -> tuple[Setting | None, Setting | None]:
        """The next cheaper and next dearer setting in one field; for plugins, None and the most accurate other one."""
        alternatives = [chosen._replace(**{name: value}) for value in values if value != getattr(chosen, name)]
        if name in ("splatter", "sampler"):
            known = [s for s in alternatives if self._cell(s) in self.bounds]
            return None, min(known, key=lambda s: self.bounds[self._cell(s)], default=None)
        mine = math.prod(self._work(chosen))
        work = {s: math.prod(self._work(s)) for s in alternatives}
        below, above = [s for s in alternatives if work[s] < mine], [s for s in alternatives if work[s] > mine]
        return max(below, key=lambda s: work[s], default=None), min(above, key=lambda s: work[s], default=None)

    def _reason(
        self, chosen: Setting, name: str, below: Setting | None, above: Setting | None, times: Mapping[Setting, float]
    ) -> str:
        """The line on one field of the chosen setting: the error of `below`; the time and the error of `above`.

        Args:
            chosen: the chosen setting.
            name: the field.
            below: the next cheaper setting in this field, see `_others`; None for none. Left out after the deadline.
            above: the next dearer one, or for plugins the most accurate other one, which may be faster; None for none.
                For samplers without its error.
            times: setting → seconds. The time of `above` is told as a multiple of the chosen one's. `above` is left out
                where one of the two has none.
        """
        parts = []
        if below is not None and not self._over():
            parts.append(f"{_value(below, name)} is off by {_percent(self._error(below))}")
        if above is not None and chosen in times and above in times:
            ratio = times[above] / times[chosen]
            error = f", off by {_percent(self._error(above))}" if name != "sampler" else ""
            parts.append(f"{_value(above, name)} takes {ratio:.2g} times as long{error}")
        return f"{_value(chosen, name)}: {'; '.join(parts)}" if parts else f"{_value(chosen, name)}"


def _value(setting: Setting, name: str) -> str:
    """The value of a field of a setting, in the form that a user would write."""
    value = getattr(setting, name)
    if name == "rate":
        return value or "the surfaces as they are given"
    return f"{name}={value!r}"


def _percent(error: float) -> str:
    return f"{100 * error:.3g} %"
