"""What is measured of a scene, each once: errors of derivatives, and seconds of a render with its gradient."""

from __future__ import annotations

import random
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rts.camera import Camera
from rts.checks import check_scene, suited_sampler
from rts.diagnostics.comparison.journal import Journal
from rts.diagnostics.comparison.scene import Scene, SceneFunction
from rts.diagnostics.comparison.scores import loss_weights, scores
from rts.diagnostics.comparison.settings import Setting, TooSlow, limited
from rts.diagnostics.comparison.truth import SAMPLES, Truth, truth
from rts.diagnostics.steps import pixel_step
from rts.engines import Engine, is_constant, namespace
from rts.errors import InputError, RtsWarning
from rts.fitting.names import one_line
from rts.interfaces import Part, as_surface
from rts.registry import instance
from rts.rendering import render, sample
from rts.sampling.auto import explain
from rts.trees import Array, Tree, collected, leaves, map_leaves

ROUNDS, CONSECUTIVE = 5, 2
"""Turns that each setting has, and calls timed in a turn."""
SLOW = 2.5
"""Seconds of timed calls after which a setting has had its turns, two at least."""
PATIENCE = 30.0
"""Seconds after which a plugin that has not answered is left out."""
PROBE, SLOWEST = 8, 3.0
"""Side of the first image that samplers are tried on, pixels; the most seconds that one of the scene's size takes."""

TOGETHER = "all"
"""The group of all modes, where they are differentiated at once."""

Done = Callable[[], None]


class Form(NamedTuple):
    """A scene at one rate of its surfaces.

    Attributes:
        at: parameters → (parts, camera).
        work: how much it is, relative to the scene as it is given.
        settings: of each part that differs, its index and its `Rate`.
    """

    at: SceneFunction
    work: float
    rates: Mapping[int, Any]


class Measurements:
    """A scene, and what has been measured of it.

    Args:
        scene: the scene.
        journal: where measurements are kept.
        engines: those that have derivatives; errors are measured with the first.
        truths: the folder of truths; None for that of caches.
        samples: of the truth, the square root of their number a pixel.
        together: whether the parameters of all modes are differentiated at once.

    Attributes:
        left_out: what could not be measured, a line each.
    """

    def __init__(
        self,
        scene: Scene,
        journal: Journal,
        engines: Sequence[Engine],
        *,
        truths: Path | None = None,
        samples: int = SAMPLES,
        together: bool = False,
    ):
        self.scene, self.journal, self.engines, self.truths, self.samples = scene, journal, engines, truths, samples
        self.engine = engines[0]
        self.left_out: list[str] = []
        self._truths: dict[str, Truth] = {}
        self._forms: dict[str, dict[str, Form]] = {}
        self._pixels: dict[str, float] = {}
        self._groups = {m: TOGETHER if together else self._group(m) for m in scene.directions}

    # ------------------------------------------------------------------------------------------------- the scene

    def _group(self, mode: str) -> str:
        parts = _parts(self.scene.at(self.scene.moved(mode, 0.0, self.engine)))
        read = [part.theta[name] for part in parts for name in as_surface(part.surface).reads(part.theta)]
        return "surfaces rest" if is_constant(read) else "surfaces change"

    def group(self, mode: str) -> str:
        """The modes that are timed together: those that leave surfaces alone, and those that change them."""
        return self._groups[mode]

    def modes(self, group: str) -> list[str]:
        """The modes of a group."""
        return [mode for mode in self.scene.directions if self.group(mode) == group]

    def pixel(self, mode: str) -> float:
        """How far along a mode what moves fastest moves by a pixel.

        Raises:
            InputError: nothing changes with it.
        """
        if mode not in self._pixels:
            engine, scene = self.engine, self.scene

            def image(t: Array, **options: Any) -> Array:
                found = scene.at(scene.moved(mode, t, engine))
                options = {"layers": 1, "sampler": "auto", **options}
                return render(*found, scene.size, **options)

            start = self._number(0.0)
            step = _quietly(lambda: pixel_step(engine, image, start, namespace(start).ones_like(start)))
            if step is None:
                raise InputError(
                    f"nothing in the image of {scene.name!r} changes with {mode!r}; expected parameters that the scene "
                    f"depends on, and parts that are in view"
                )
            self._pixels[mode] = step
        return self._pixels[mode]

    def leave_out_what_rests(self) -> None:
        """Go on with those modes that change something.

        Raises:
            InputError: there are none.
        """
        changing, why = [], []
        for mode in self.scene.directions:
            try:
                self.pixel(mode)
                changing.append(mode)
            except InputError as error:
                why.append(error)
                self._leave_out(str(error))
        if not changing:
            raise why[0]
        self.scene = self.scene.with_modes(changing)

    def _number(self, value: float) -> Array:
        like = next((x for x in leaves(self.scene.parameters) if self.engine.owns(x)), None)
        return self.engine.constant(np.asarray(value, np.float32), like)

    def truth(self, mode: str, done: Done = lambda: None) -> Truth:
        """How the image truly changes along a mode; see `truth`."""
        if mode not in self._truths:
            engine = None if self.scene.separate else self.engine
            options: dict[str, Any] = dict(samples=self.samples, engine=engine, folder=self.truths, done=done)
            self._truths[mode] = truth(self.scene, mode, self.pixel(mode), **options)
        return self._truths[mode]

    def forms(self, group: str) -> dict[str, Form]:
        """The scene at the rates that its surfaces offer; "" as it is given."""
        if group not in self._forms:
            given = self.scene.at(self.start(group))
            offered: dict[str, dict[int, Any]] = {}
            for index, part in enumerate(_parts(given)):
                for rate in as_surface(part.surface).rates(part.theta):
                    offered.setdefault(rate.setting, {})[index] = rate
            found = {name: Form(_changed(self.scene.at, rates), _work(rates), rates) for name, rates in offered.items()}
            self._forms[group] = {"": Form(self.scene.at, 1.0, {}), **found}
        return self._forms[group]

    def samplers(self, names: Iterable[str]) -> list[str]:
        """Those that can sample all parts, the one that "auto" takes first; "auto" itself where it takes several."""
        mode = next(iter(self.scene.directions))
        parts, camera = self.scene.at(self.start(self.group(mode)))
        auto = {choice.sampler for choice in explain(_as_list(parts), camera)}
        found = ["auto"] if len(auto) > 1 else []
        for name in names:
            kept = self.journal.get("sampler", name)
            if kept is None:
                kept = self.journal.put(self._tried(name, _as_list(parts), camera), "sampler", name)
            if kept["why"]:
                self._leave_out(f"sampler {name!r}: {kept['why']}")
            if kept["suits"]:
                found.append(name)
        return sorted(found, key=lambda name: (name not in auto, name != "auto"))

    def _tried(self, name: str, parts: list[Part], camera: Camera) -> dict[str, Any]:
        """Whether a sampler suits the scene, and why not."""
        side = PROBE
        try:
            checked, seen = check_scene(parts, camera)
            chosen = instance("rts.samplers", name)
            for part in checked:
                suited_sampler(chosen, part, seen)
            for size, patience in (((PROBE, PROBE), PATIENCE), (self.scene.size, SLOWEST)):
                side = size[0]
                with limited(patience):
                    _quietly(lambda size=size: sample(parts, camera, size, sampler=name, layers=1))
        except InputError as error:
            return {"suits": False, "why": one_line(str(error))}
        except TooSlow as error:
            return {"suits": False, "why": f"{error} for an image {side} pixels high"}
        except Exception as error:
            return {"suits": False, "why": one_line(f"{type(error).__name__}: {error}")}
        return {"suits": True, "why": ""}

    def _leave_out(self, line: str) -> None:
        if line not in self.left_out:
            self.left_out.append(line)

    # ---------------------------------------------------------------------------------------------------- errors

    def settings(
        self, group: str, splatters: Iterable[str], layers: Iterable[int | str], samples: Iterable[int], rates: bool
    ) -> list[Setting]:
        """All that differ in their error; of numbers of layers beyond those that count the least one that suffices."""
        found = []
        for rate in self.forms(group) if rates else [""]:
            for supersample in samples:
                for splatter in splatters:
                    for count in layers:
                        setting = Setting(splatter, count, supersample, rate)
                        if self.counting(group, setting) is not None:
                            found.append(setting)
        return found

    def counting(self, group: str, setting: Setting) -> int | None:
        """How many layers count in a setting, None where it cannot be had."""
        most = self._layers(group, setting._replace(layers="auto"))
        if most is None:
            return None if setting.layers == "auto" else int(setting.layers)
        return most if setting.layers == "auto" else min(int(setting.layers), most)

    def _layers(self, group: str, setting: Setting) -> int | None:
        """How many layers "auto" takes, None where it takes none."""
        kept = self.journal.get("layers", group, *setting)
        if kept is None:
            parts, camera = self.forms(group)[setting.rate].at(self.start(group))
            options: dict[str, Any] = dict(splatter=setting.splatter, layers="auto", supersample=setting.supersample)
            try:
                found = _quietly(lambda: sample(parts, camera, self.scene.size, **options))
                kept = {"count": int(found.row.shape[0])}
            except Exception as error:
                kept = {"count": None, "why": one_line(f"{type(error).__name__}: {error}")}
            self.journal.put(kept, "layers", group, *setting)
        if kept["count"] is None:
            self._leave_out(f'splatter {setting.splatter!r}, layers="auto": {kept["why"]}')
        return kept["count"]

    def scores(self, mode: str, setting: Setting) -> dict[str, float] | None:
        """How far the derivative along a mode is off; see `rts.diagnostics.comparison.scores`. None where it fails."""
        count = self.counting(self.group(mode), setting)
        if count is None:
            return None
        same = setting._replace(layers=count, sampler="", engine="")
        kept = self.journal.get("error", self.samples, mode, *same)
        if kept is None:
            kept = self.journal.put(self._measured(mode, same), "error", self.samples, mode, *same)
        if "why" in kept:
            self._leave_out(f"splatter {same.splatter!r}, {mode}: {kept['why']}")
            return None
        return kept

    def _measured(self, mode: str, setting: Setting) -> dict[str, Any]:
        at, pixel = self.forms(self.group(mode))[setting.rate].at, self.pixel(mode)

        def image(t: Array) -> Array:
            return render(*at(self.scene.moved(mode, t, self.engine)), self.scene.size, **setting.options)[..., :3]

        try:
            derivative = _quietly(lambda: self.engine.jvp(image, self._number(0.0), self._number(pixel))[1])
        except Exception as error:
            return {"why": one_line(f"{type(error).__name__}: {error}")}
        found = self.engine.to_numpy(derivative).astype(np.float64)
        if not np.isfinite(found).all():
            return {"why": "its derivative is not finite"}
        return scores(found, self.truth(mode).derivative)

    # ----------------------------------------------------------------------------------------------------- times

    def work(self, group: str, setting: Setting) -> tuple[float, ...]:
        """What a setting costs, in respects that are known beforehand: layers, samples, rate."""
        layers = self.counting(group, setting) or 0
        return (
            layers + (0.5 if setting.layers == "auto" else 0.0),
            setting.supersample,
            self.forms(group)[setting.rate].work,
        )

    def call(self, group: str, setting: Setting) -> Callable[[], Any]:
        """A function that renders the scene and takes the gradient of a loss in the parameters of a group's modes."""
        engine = next(e for e in self.engines if e.name == setting.engine)
        at, size = self.forms(group)[setting.rate].at, self.scene.size
        live, rebuilt = self._live(group, engine)
        weights = engine.constant(np.asarray(loss_weights(*size)[0], np.float32), live[0])

        def loss(values: list[Array]) -> Array:
            image = render(*at(rebuilt(values)), size, **setting.options)
            return namespace(image).sum(image[..., :3] * weights)

        gradient = engine.jit(engine.value_and_grad(loss))
        return lambda: engine.block(gradient(live))

    def start(self, group: str) -> Tree:
        """The parameters, those that a group's modes change in arrays of the first engine."""
        live, rebuilt = self._live(group, self.engine)
        return rebuilt(live)

    def _live(self, group: str, engine: Engine) -> tuple[list[Array], Callable[[list[Array]], Tree]]:
        """The parameters that a group's modes change, and the tree of all parameters with others in their place."""
        scene = self.scene
        changing = [
            not scene.separate or any(np.any(np.asarray(d)) for d in of_modes)
            for of_modes in zip(*(collected(scene.directions[mode]) for mode in self.modes(group)), strict=True)
        ]
        given = collected(scene.parameters)
        live = [x if engine.owns(x) else engine.constant(x) for x, c in zip(given, changing, strict=True) if c]

        def rebuilt(values: list[Array]) -> Tree:
            which, new = iter(changing), iter(values)
            return map_leaves(lambda x: next(new) if next(which) else x, scene.parameters)

        return live, rebuilt

    def time(
        self,
        group: str,
        calls: Mapping[tuple, Callable[[], Callable[[], Any]]],
        done: Done = lambda: None,
        rounds: int = ROUNDS,
    ) -> dict[tuple, dict[str, float]]:
        """Milliseconds of each of some functions, which take turns in shuffled order after a call to warm up.

        Args:
            group: of modes.
            calls: what to keep a time under → a function that makes the function to be timed.
            done: called for each turn.
            rounds: turns of each.

        Returns:
            Under each key that could be timed the median, quartiles and number of calls.
        """
        times: dict[tuple, list[float]] = {}
        made: dict[tuple, Callable[[], Any]] = {}
        failed = {key: self.journal.get("fails", group, *key) for key in calls}
        order, shuffle = list(calls), random.Random(0).shuffle
        for n in range(rounds):
            shuffle(order)
            for key in order:
                done()
                kept = self.journal.get("time", group, *key, n)
                if failed[key] is None and kept is None and _goes_on(times.get(key, [])):
                    try:
                        kept = self._turn(key, calls, made)
                        self.journal.put(kept, "time", group, *key, n)
                    except Exception as error:
                        failed[key] = one_line(f"{type(error).__name__}: {error}")
                        self.journal.put(failed[key], "fails", group, *key)
                times.setdefault(key, []).extend(kept or [])
        for key, why in failed.items():
            if why is not None:
                self._leave_out(f"{_told(key)}: {why}")
        return {key: _milliseconds(found) for key, found in times.items() if found}

    def _turn(self, key: tuple, calls: Mapping[tuple, Callable], made: dict[tuple, Callable[[], Any]]) -> list[float]:
        """Seconds of a few consecutive calls, after one that is not timed."""
        if key not in made:
            with limited(4 * PATIENCE):  # Some compile.
                made[key] = calls[key]()
                _quietly(made[key])
        with limited(4 * PATIENCE):
            start = time.perf_counter()
            _quietly(made[key])
            found = [time.perf_counter() - start]
            if found[0] < SLOW / 2:
                for _ in range(CONSECUTIVE):
                    start = time.perf_counter()
                    made[key]()
                    found.append(time.perf_counter() - start)
                del found[0]
        return found


def _parts(found: tuple[Any, Camera]) -> list[Part]:
    return _as_list(found[0])


def _as_list(parts: Any) -> list[Part]:
    return [parts] if isinstance(parts, Part) else list(parts)


def _changed(at: SceneFunction, rates: Mapping[int, Any]) -> SceneFunction:
    """A scene some of whose parts have other surfaces."""

    def changed(parameters: Tree) -> tuple[list[Part], Camera]:
        parts, camera = at(parameters)
        parts = _as_list(parts)
        for index, rate in rates.items():
            theta = parts[index].theta if rate.theta is None else rate.theta(parts[index].theta)
            parts[index] = parts[index].replace(surface=rate.surface, theta=theta)
        return parts, camera

    return changed


def _work(rates: Mapping[int, Any]) -> float:
    return float(np.mean([rate.work for rate in rates.values()]))


def _goes_on(times: list[float]) -> bool:
    return len(times) < 2 or sum(times) < SLOW


def _quietly(f: Callable[[], Any]) -> Any:
    """The result of a call; what the library warns of is known from the first look at the scene."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RtsWarning)
        return f()


def _told(key: tuple) -> str:
    return ", ".join(str(k) for k in key if k != "")


def _milliseconds(times: list[float]) -> dict[str, float]:
    low, median, high = 1e3 * np.percentile(times, [25, 50, 75])
    return {"median": float(median), "low": float(low), "high": float(high), "calls": len(times)}
