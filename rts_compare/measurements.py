"""Measurements of a scene, each made once: errors of derivatives, and seconds of a render with its gradient."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rts import Camera, Engine, Part, explain, namespace, render, sample
from rts.errors import InputError, RtsWarning
from rts.plugin_api.arrays import Array, Tree, leaves, map_leaves
from rts_compare.compared_settings import Setting
from rts_compare.derivative_scores import loss_weights, relative_l2, scores
from rts_compare.interleaved_timing import LONGEST, Calls, InterleavedTiming
from rts_compare.kept_measurements import KeptMeasurements
from rts_compare.measurement_keys import library_key, plugin_key, state_key
from rts_compare.moving_scenes import Scene, is_constant, parts_of
from rts_compare.skip_reasons import TooSlow, limited, one_line
from rts_compare.surface_rates import SceneAtRate, scenes_at_rates
from rts_compare.true_derivatives import SAMPLES, STEP, Truth, truth, truth_key
from rts_diagnostics.finite_difference_steps import pixel_step
from rts_diagnostics.smoothing import low_pass

PATIENCE = 8.0
"""Seconds that a sampler may take for a small image, after one of a single pixel that compiles its loops; a slower one
is left out."""
PROBE, SLOWEST = 8, 3.0
"""Side of that small image, pixels; and the usual limit for an image of the scene's size, seconds."""
ALIKE = 0.002
"""A sampler whose derivatives differ from the usual one's by at most this, relative L2, shares its errors."""

UNKNOWN, HARDLY = 0.2, 0.05
"""The image hardly changes along a mode whose true derivative is this uncertain, and this small beside the largest of
all modes: such as a turn of a vase about its axis. No setting has small errors relative to it."""

TOGETHER = "all"
"""The name of the group of all modes, where all are differentiated at once."""

Done = Callable[[], None]


class Measurements:
    """A scene and its measurements.

    Args:
        scene: the scene.
        kept: the store of measurements.
        engines: engines with derivatives; errors are measured with the first.
        truths: the folder of true derivatives; None for the folder of caches.
        samples: the square root of the number of points a pixel on each grid of true derivatives; `refine_truths` may
            take another number.
        together: whether the parameters of all modes are differentiated at once.
        count_at: the `supersample` with which layers are counted, once for each splatter and sampler; None to count
            them for each setting with its own.
        slowest: the most seconds that a sampler may take for an image of the scene's size.

    Attributes:
        left_out: a line for each measurement that failed.
    """

    def __init__(
        self,
        scene: Scene,
        kept: KeptMeasurements,
        engines: Sequence[Engine],
        *,
        truths: Path | None = None,
        samples: int = SAMPLES,
        together: bool = False,
        count_at: int | None = None,
        slowest: float = SLOWEST,
    ):
        self.scene, self.kept, self.engines, self.folder, self.samples = scene, kept, engines, truths, samples
        self.engine, self.count_at, self.slowest = engines[0], count_at, slowest
        self.left_out: list[str] = []
        self._truths: dict[str, Truth] = {}
        self._truth_samples: dict[str, int] = {}
        self._at_rates: dict[str, dict[str, SceneAtRate]] = {}
        self._pixels: dict[str, float] = {}
        self._states: dict[str, tuple[str, ...]] = {}
        self._failed: dict[tuple, str] = {}
        self._groups = {m: TOGETHER if together else self._group(m) for m in scene.directions}

    # ------------------------------------------------------------------------------------------------- the scene

    def _group(self, mode: str) -> str:
        parts = parts_of(self.scene.at(self.scene.moved(mode, 0.0, self.engine)))
        read = [part.theta[name] for part in parts for name in part.surface.reads(part.theta)]
        return "surfaces rest" if is_constant(read) else "surfaces change"

    def group(self, mode: str) -> str:
        """The name of the group that a mode is timed in: `TOGETHER`, or "surfaces change" or "surfaces rest"."""
        return self._groups[mode]

    def modes(self, group: str) -> list[str]:
        """The modes of a group."""
        return [mode for mode in self.scene.directions if self.group(mode) == group]

    def pixel(self, mode: str) -> float:
        """The step along a mode that moves the fastest point by a pixel or, if none moves, changes a colour by 0.05.

        Raises:
            InputError: the mode changes nothing.
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
                raise self._rests(mode)
            self._pixels[mode] = step
        return self._pixels[mode]

    def leave_out_what_rests(self) -> None:
        """Drop the modes along which no point and no colour of the image changes, each with a line in `left_out`.

        Raises:
            InputError: no mode is left.
        """
        self._keep(self.pixel)

    def truths(self, done: Done) -> None:
        """Make the true derivatives, and drop the modes along which the image does not change.

        Args:
            done: called 4 `samples`² times for each mode.

        Raises:
            InputError: no mode is left.
        """

        def changes(mode: str) -> None:
            if not np.linalg.norm(self.truth(mode, done).derivative) > 0:
                raise self._rests(mode)

        self._keep(changes)

    def leave_out_what_hardly_changes(self) -> None:
        """Drop the modes along which the image hardly changes, see `HARDLY`, each with a line in `left_out`."""
        truths = {mode: self.truth(mode) for mode in self.scene.directions}
        norms = {mode: np.linalg.norm(low_pass(truth.derivative)) for mode, truth in truths.items()}

        def changes(mode: str) -> None:
            share = float(norms[mode] / max(norms.values()))
            if truths[mode].error > UNKNOWN and share < HARDLY:
                raise InputError(f"the image hardly changes with {mode!r}: {share:.1g} of what it does otherwise")

        self._keep(changes)

    def rough(self, error: float) -> list[str]:
        """The modes whose true derivative has an estimated error larger than `error`."""
        return [mode for mode in self.scene.directions if self.truth(mode).error > error]

    def refine_truths(self, modes: Sequence[str], samples: int, done: Done) -> None:
        """Make the true derivatives of some modes anew, of `samples`² points a pixel on each of two grids.

        Args:
            modes: of the scene.
            samples: the square root of the number of points.
            done: called 4 `samples`² times for each mode.
        """
        for mode in modes:
            self._truth_samples[mode] = samples
            self._truths.pop(mode, None)
            self._states.pop(mode, None)
            self.truth(mode, done)

    def _keep(self, check: Callable[[str], Any]) -> None:
        """Keep the modes for which `check` raises no InputError; if none is left, raise the first of these errors."""
        kept, why = [], []
        for mode in self.scene.directions:
            try:
                check(mode)
                kept.append(mode)
            except InputError as error:
                why.append(error)
                self._leave_out(str(error))
        if not kept:
            raise why[0]
        self.scene = self.scene.with_modes(kept)

    def _rests(self, mode: str) -> InputError:
        return InputError(
            f"nothing in the image of {self.scene.name!r} changes with {mode!r}; expected parameters that the scene "
            f"depends on, and parts that are in view"
        )

    def _number(self, value: float) -> Array:
        like = next((x for x in leaves(self.scene.parameters) if self.engine.owns(x)), None)
        return self.engine.constant(np.asarray(value, np.float32), like)

    def truth(self, mode: str, done: Done = lambda: None) -> Truth:
        """The true derivative of the image along a mode; see `true_derivatives.truth`."""
        if mode not in self._truths:
            samples = self._truth_samples.get(mode, self.samples)
            options: dict[str, Any] = dict(samples=samples, engine=self._still, folder=self.folder, done=done)
            self._truths[mode] = truth(self.scene, mode, self.pixel(mode), **options)
        return self._truths[mode]

    @property
    def _still(self) -> Engine | None:
        """The engine that computes the scene without derivatives; None for NumPy, if the scene is `separate`."""
        return None if self.scene.separate else self.engine

    def state(self, mode: str) -> tuple[str, ...]:
        """The key of a mode's measurements: hashes of the scene at both ends of `STEP`, `truth_key`, `library_key`."""
        if mode not in self._states:
            step = STEP * self.pixel(mode)
            moved = [self.scene.at(self.scene.moved(mode, by, self._still)) for by in (-step / 2, step / 2)]
            own = [state_key(parts_of(found), found[1], self.scene.size) for found in moved]
            samples = self._truth_samples.get(mode, self.samples)
            true = truth_key(self.scene, mode, step, samples, self._still)
            self._states[mode] = (*own, true, library_key())
        return self._states[mode]

    def at_rates(self, group: str) -> dict[str, SceneAtRate]:
        """Name of a rate that surfaces offer → the scene at this rate; "" → the scene as it is given."""
        if group not in self._at_rates:
            self._at_rates[group] = scenes_at_rates(self.scene.at, parts_of(self.scene.at(self.start(group))))
        return self._at_rates[group]

    # -------------------------------------------------------------------------------------------------- samplers

    def samplers(self, names: Iterable[str]) -> list[str]:
        """Samplers that can sample all parts: choices of "auto", then "auto" if it chose several, then others.

        Choices and others are taken from `names`; each that does not suit is a line of `left_out`.
        """
        found = self.scene.at(self.start(self.group(next(iter(self.scene.directions)))))
        parts = parts_of(found)
        auto = {choice.sampler for choice in explain(parts, found[1])}
        suited = ["auto"] if len(auto) > 1 else []
        for name in names:
            key = "sampler", name, plugin_key("rts.samplers", name), *self.state(next(iter(self.scene.directions)))
            kept = self.kept.get(*key)
            if kept is None:
                kept = self._tried(name, parts, found[1])
                if kept["suits"]:
                    self.kept.put(kept, *key)
            if kept["suits"]:
                suited.append(name)
            else:
                self._leave_out(f"sampler {name!r}: {kept['why']}")
        return sorted(suited, key=lambda name: (name not in auto, name != "auto"))

    def kinds(self, samplers: Sequence[str]) -> dict[str, str]:
        """Sampler → the sampler whose errors it shares: "" for the usual (first) one, or itself if they differ."""
        group = self.group(next(iter(self.scene.directions)))
        found = {}
        for name in samplers:
            key = "kind", name, plugin_key("rts.samplers", name), samplers[0], *self.state(self.modes(group)[0])
            kept = self.kept.get(*key)
            if kept is None:
                kept = self.kept.put(name == samplers[0] or self._agrees(name, samplers[0], group), *key)
            found[name] = "" if kept else name
        return found

    def _agrees(self, name: str, usual: str, group: str) -> bool:
        """True if a sampler's derivatives along a group's modes agree with the usual one's, up to `ALIKE`.

        False if either fails.
        """
        for mode in self.modes(group):
            setting = Setting("auto", 2, 1)
            try:
                a, b = (low_pass(self._derivative(mode, setting._replace(sampler=n))) for n in (usual, name))
            except Exception:
                return False
            if not relative_l2(a, b, a) <= ALIKE:
                return False
        return True

    def _tried(self, name: str, parts: list[Part], camera: Camera) -> dict[str, Any]:
        """Try a sampler on the scene. Returns {"suits": True or False, "why": the reason if False}."""
        side = 1
        try:
            for size, patience in (((1, 1), LONGEST), ((PROBE, PROBE), PATIENCE), (self.scene.size, self.slowest)):
                side = size[0]
                with limited(patience):
                    _quietly(lambda size=size: sample(parts, camera, size, sampler=name, splatter=None, layers=1))
        except InputError as error:
            return {"suits": False, "why": one_line(str(error))}
        except TooSlow as error:
            return {"suits": False, "why": f"{error} for an image {side} pixel{'s' * (side > 1)} high"}
        except Exception as error:
            return {"suits": False, "why": one_line(f"{type(error).__name__}: {error}")}
        return {"suits": True, "why": ""}

    def _leave_out(self, line: str) -> None:
        if line not in self.left_out:
            self.left_out.append(line)

    # ---------------------------------------------------------------------------------------------------- errors

    def settings(
        self,
        group: str,
        splatters: Iterable[str],
        layers: Iterable[int | str],
        samples: Iterable[int],
        kinds: Iterable[str] = ("",),
        rates: bool = True,
    ) -> list[Setting]:
        """All combinations of these options, without layers "auto" where "auto" fails.

        Args:
            group: the name of a group of modes; the rates depend on the parameters that these change.
            splatters: names.
            layers: numbers, or "auto".
            samples: numbers of samples along each side of a pixel.
            kinds: samplers whose errors differ from the usual one's, and "" for all others.
            rates: whether settings include the rates that surfaces offer.
        """
        all_of = (
            Setting(splatter, count, supersample, rate, kind)
            for kind in kinds
            for rate in (self.at_rates(group) if rates else [""])
            for supersample in samples
            for splatter in splatters
            for count in layers
        )
        return [setting for setting in all_of if self.counting(group, setting) is not None]

    def counting(self, group: str, setting: Setting) -> int | None:
        """The number of layers that a setting uses, at most that of "auto"; None if it has "auto", and that fails."""
        counted = setting._replace(layers="auto", engine="")
        if self.count_at is not None:
            counted = counted._replace(supersample=self.count_at, rate="")
        most = self._layers(group, counted)
        if most is None:
            return None if setting.layers == "auto" else int(setting.layers)
        return most if setting.layers == "auto" else min(int(setting.layers), most)

    def _layers(self, group: str, setting: Setting) -> int | None:
        """The number of layers that a setting with layers "auto" takes; None if it fails."""
        key = "layers", group, *setting, *self._identity(self.modes(group)[0], setting)
        if key in self._failed:
            return None
        kept = self.kept.get(*key)
        if kept is None:
            parts, camera = self.at_rates(group)[setting.rate].at(self.start(group))
            try:
                with limited(LONGEST):
                    sampled = _quietly(lambda: sample(parts, camera, self.scene.size, **setting.options))
                kept = self.kept.put(int(sampled.row.shape[0]), *key)
            except Exception as error:
                self._failed[key] = one_line(f"{type(error).__name__}: {error}")
                self._leave_out(f'splatter {setting.splatter!r}, layers="auto": {self._failed[key]}')
        return kept

    def scores(self, mode: str, setting: Setting) -> dict[str, float] | None:
        """Scores of a setting's derivative along a mode, see `derivative_scores.scores`; None if it fails.

        Args:
            mode: of the scene.
            setting: its `sampler` is a value of the method `kinds`.
        """
        count = self.counting(self.group(mode), setting)
        if count is None:
            return None
        same = setting._replace(layers=count, engine="")
        key = "error", mode, *same, *self._identity(mode, same)
        if key in self._failed:
            return None
        kept = self.kept.get(*key)
        if kept is None:
            try:
                kept = self.kept.put(self._measured(mode, same), *key)
            except Exception as error:
                self._failed[key] = one_line(f"{type(error).__name__}: {error}")
                self._leave_out(f"splatter {same.splatter!r}, {mode}: {self._failed[key]}")
        return kept

    def _identity(self, mode: str, setting: Setting) -> tuple[str, ...]:
        """The rest of a measurement's key, beside its setting: hashes of its plugins, and the mode's state."""
        plugins = ("rts.splatters", setting.splatter), ("rts.samplers", setting.sampler)
        return *(plugin_key(*p) for p in plugins), *self.state(mode)

    def _measured(self, mode: str, setting: Setting) -> dict[str, float]:
        derivative = self._derivative(mode, setting)
        if not np.isfinite(derivative).all():
            raise InputError("its derivative is not finite")
        return scores(derivative, self.truth(mode).derivative)

    def _derivative(self, mode: str, setting: Setting) -> np.ndarray:
        """The derivative image (H, W, 3) along a mode, per pixel of motion."""
        at, pixel = self.at_rates(self.group(mode))[setting.rate].at, self.pixel(mode)

        def image(t: Array) -> Array:
            return render(*at(self.scene.moved(mode, t, self.engine)), self.scene.size, **setting.options)[..., :3]

        with limited(LONGEST):
            derivative = _quietly(lambda: self.engine.jvp(image, self._number(0.0), self._number(pixel))[1])
        return self.engine.to_numpy(derivative).astype(np.float64)

    # ----------------------------------------------------------------------------------------------------- times

    def work(self, group: str, setting: Setting) -> tuple[float, ...]:
        """Costs of a setting, known before it is timed: layers, samples along a pixel's side, work of its rate.

        "auto" counts as half a layer more than it takes.
        """
        layers = self.counting(group, setting) or 0
        layers += 0.5 if setting.layers == "auto" else 0.0
        return layers, setting.supersample, self.at_rates(group)[setting.rate].work

    def call(self, group: str, setting: Setting) -> Callable[[], Any]:
        """A function that computes an image of the scene and a loss's gradient by the parameters of a group's modes.

        `setting` names its engine, one of `engines`. The function waits until the engine is done.
        """
        engine = next(e for e in self.engines if e.name == setting.engine)
        at, size = self.at_rates(group)[setting.rate].at, self.scene.size
        live, rebuilt = self._live(group, engine)
        weights = engine.constant(np.asarray(loss_weights(*size, 1)[0], np.float32), live[0])

        def loss(values: list[Array]) -> Array:
            image = render(*at(rebuilt(values)), size, **setting.options)
            return namespace(image).sum(image[..., :3] * weights)

        gradient = engine.jit(engine.value_and_grad(loss))
        return lambda: _quietly(lambda: engine.block(gradient(live)))

    def start(self, group: str) -> Tree:
        """The parameters before any motion; those that a group's modes change are arrays of the first engine."""
        live, rebuilt = self._live(group, self.engine)
        return rebuilt(live)

    def _live(self, group: str, engine: Engine) -> tuple[list[Array], Callable[[list[Array]], Tree]]:
        """The parameters that a group's modes change, arrays of `engine`; and a function: values for these → all."""
        scene = self.scene
        changing = [
            not scene.separate or any(np.any(np.asarray(d)) for d in of_modes)
            for of_modes in zip(*(leaves(scene.directions[mode]) for mode in self.modes(group)), strict=True)
        ]
        given = list(leaves(scene.parameters))
        live = [x if engine.owns(x) else engine.constant(x) for x, c in zip(given, changing, strict=True) if c]

        def rebuilt(values: list[Array]) -> Tree:
            which, new = iter(changing), iter(values)
            return map_leaves(lambda x: next(new) if next(which) else x, scene.parameters)

        return live, rebuilt

    def timing(self, group: str, calls: Calls) -> InterleavedTiming:
        """The timer of functions, such as those of `call`, with the store of their times.

        Args:
            group: the name of the group of modes whose parameters the functions differentiate by.
            calls: `Setting`, or a tuple that names another renderer → function that makes the function to be timed.
        """
        modes = self.modes(group)
        states = [state for mode in modes for state in self.state(mode)]

        def key(name: tuple) -> tuple:
            own = self._identity(modes[0], name) if isinstance(name, Setting) else ()
            return group, *name, *own, *states

        return InterleavedTiming(self.kept, calls, key)


def _quietly(f: Callable[[], Any]) -> Any:
    """The result of `f()`, with warnings of the library silenced."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RtsWarning)
        return f()
