"""`rts_compare.compare`: speed against accuracy, on one chart, for anyone's scene and anyone's plugin."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from rts import Engine
from rts.errors import InputError, PluginError
from rts.plugin_api.arrays import Tree
from rts.plugin_api.checks import is_count, quoted
from rts.tool_api.files import output_folder, writing
from rts_compare.chart_style import label, time_label
from rts_compare.compared_settings import Setting, usable, worth_timing
from rts_compare.derivative_scores import scores
from rts_compare.environment import environment
from rts_compare.interleaved_timing import ROUNDS, Calls, InterleavedTiming
from rts_compare.kept_measurements import KeptMeasurements
from rts_compare.measurements import Measurements
from rts_compare.moving_scenes import Scene
from rts_compare.other_renderers.renderer_input import Peer
from rts_compare.pareto_front import Row, best_within, front, marked
from rts_compare.scene_sources import engines_for, scene_of, some_modes
from rts_compare.skip_reasons import one_line
from rts_compare.true_derivatives import SAMPLES
from rts_diagnostics.progress import Phase, phases

LAYERS = (1, 2, 4, "auto")
SUPERSAMPLE = (1, 2, 4)
QUICK_CELLS = 40
"""Largest number of settings that are measured with `quick`."""
PEER_ROUNDS = 2
"""Number of rounds in which other renderers are timed."""
PACKAGES = ("rasterize-then-splat", "numpy", "numba", "torch", "jax", "embreex", "moderngl", "deodr", "mitsuba")


@dataclass(frozen=True)
class Comparison:
    """Results of settings on one scene: the errors of their derivatives, and their times.

    Attributes:
        scene: "name", "note" and "size" (height, width).
        environment: date, machine and versions.
        modes: mode → {"truth_error": estimated error of the reference derivative itself}.
        rows: one for each mode and setting: "mode", "settings", "error" (relative L2, both smoothed by a Gaussian of
            standard deviation 2 pixels), "gain" and "loss_error" (see `derivative_scores.scores`), "ms" (median,
            quartiles and number of calls, or None where only the error was measured) and "front", True if no row is
            both faster and more accurate. Rows of other renderers name theirs in "peer".
        left_out: lines on measurements that failed and options that were left out, with the reasons.
    """

    scene: Mapping[str, Any]
    environment: Mapping[str, Any]
    modes: Mapping[str, Mapping[str, float]]
    rows: Sequence[Row]
    left_out: Sequence[str]

    def __str__(self) -> str:
        """A line for each mode and setting, the most accurate first; "*" marks the front."""
        height, width = self.scene["size"]
        lines = [f"{self.scene['name']}, {height} × {width}: error of the derivative, time of a render and gradient"]
        for mode in self.modes:
            own = sorted((row for row in self.rows if row["mode"] == mode), key=lambda row: row["error"])
            lines += ["", mode]
            for row in own:
                time = "not timed" if row["ms"] is None else time_label(row["ms"]["median"])
                lines.append(f"{'*' if row['front'] else ' '} {100 * row['error']:8.3g} %  {time:>9}  {label(row)}")
        return "\n".join([*lines, *([""] if self.left_out else []), *self.left_out])

    @property
    def data(self) -> dict[str, Any]:
        """The comparison as dicts and lists, in the form of its JSON file."""
        return dict(vars(self))

    def best(self, mode: str, error: float) -> Row | None:
        """The fastest of the library's own rows of a mode whose error is at most `error`; None if there is none."""
        return best_within([r for r in self.rows if r["mode"] == mode and "peer" not in r], error)

    def write(self, folder: Path | str) -> list[Path]:
        """Write NAME.json and, with the extra `plots` installed, NAME.png and NAME.html; return the files written.

        Raises:
            InputError: a file cannot be written.
        """
        from rts_compare.html_page import write_page
        from rts_compare.png_chart import draw

        output_folder(folder)
        files = self._files(folder)
        with writing(files[0]):
            files[0].parent.mkdir(parents=True, exist_ok=True)
            files[0].write_text(json.dumps(self.data, indent=1) + "\n", encoding="utf-8")
        written = files[:1]
        for file, write in ((files[1], lambda f: draw(self.data, f)), (files[2], lambda f: write_page([self.data], f))):
            try:
                write(file)
                written.append(file)
            except PluginError:  # The package is missing: the file is not in the result.
                continue
        return written

    def files(self, folder: Path | str) -> list[Path]:
        """The files of the comparison that exist in a folder."""
        return [file for file in self._files(folder) if file.exists()]

    def _files(self, folder: Path | str) -> list[Path]:
        name = file_name(self.scene["name"])
        return [Path(folder) / f"{name}{suffix}" for suffix in (".json", ".png", ".html")]


def file_name(scene: str) -> str:
    """The name of a scene's files, without suffix."""
    return re.sub(r"\W+", "_", scene).strip("_") or "scene"


class Plan(NamedTuple):
    """The settings to measure.

    Attributes:
        splatters: names.
        samplers: sampler that suits the scene, the usual one first → the sampler whose errors it shares, as
            `Measurements.kinds`.
        engines: engines with derivatives; the first measures errors.
        layers: numbers K, or "auto".
        supersample: samples along each side of a pixel.
        rates: whether the rates that surfaces offer are tried.
        most: the most settings to measure; None for all.
        peers: other renderers.
    """

    splatters: Sequence[str]
    samplers: Mapping[str, str]
    engines: Sequence[Engine]
    layers: Sequence[int | str]
    supersample: Sequence[int]
    rates: bool
    most: int | None
    peers: Sequence[Peer]


def compare(
    scene: Any,
    parameters: Tree = None,
    *,
    directions: Mapping[str, Tree] | None = None,
    size: tuple[int, int] | None = None,
    modes: Sequence[str] | None = None,
    samplers: Sequence[str] | None = None,
    splatters: Sequence[str] | None = None,
    engines: Sequence[str] | None = None,
    layers: Sequence[int | str] | None = None,
    supersample: Sequence[int] | None = None,
    peers: bool = True,
    quick: bool = False,
    surface: str = "mesh",
    output: Path | str | None = None,
    truths: Path | str | None = None,
    truth_samples: int = SAMPLES,
    fresh: bool = False,
    progress: bool | None = None,
) -> Comparison:
    """Measure the error of derivatives, and the time of a render and gradient, of all settings on one scene.

    The error of a setting is that of the derivative image along each of some directions (modes), against differences of
    area-sampled renders. Settings are timed, in turns, unless a cheaper one is as accurate: a render, and the gradient
    of a loss by the parameters that move. By default every sampler and splatter that is installed takes part; and, with
    the extra `bench`, DEODR and Mitsuba, if they can render the scene.

    Args:
        scene: the name of a built-in scene, the path of a model or of a Python file ("file.py:function"), or a
            function: parameters → (parts, camera), or () → (parts, camera) in NumPy, whose parts then move in the
            modes of `moving_scenes.moving`.
        parameters: of the function: where derivatives are taken; an array, or nested dicts and lists of arrays.
        directions: mode → direction of the parameters; None for one mode for each number of small arrays, and one
            random direction for each larger array.
        size: (height, width); None for the scene's own.
        modes: names of modes; None for all.
        samplers: names; None for all that suit the scene.
        splatters: names; None for all.
        engines: names; None for all. Errors are measured with the first.
        layers: numbers of layers, or "auto"; None for 1, 2, 4 and "auto".
        supersample: samples along each side of a pixel; None for 1, 2 and 4.
        peers: whether other renderers take part.
        quick: one mode, engine and sampler, and 1 and 2 layers, unless named; at most 40 settings, with surfaces as
            they are given; no other renderers.
        surface: the name of the surface that reads a model, such as "mesh" or "bezier".
        output: a folder for the results and measurements, from which an interrupted run goes on; None to write nothing.
        truths: the folder of true derivatives; None for the folder of caches.
        truth_samples: the square root of the number of samples a pixel, on each of two grids, of true derivatives;
            fewer are faster and less exact.
        fresh: whether to delete the measurements of earlier runs.
        progress: whether to show progress; None for where standard error is a terminal.

    Raises:
        InputError: there is no such scene, or an argument is wrong; before anything is measured. Or no sampler suits
            the scene, or nothing in the image changes.
        PluginError: a named plugin cannot be loaded, or no engine with derivatives is installed.
    """
    found = scene_of(scene, parameters, directions, size, surface=surface)
    folder = None if output is None else output_folder(output)
    kept = None if truths is None else output_folder(truths)
    found = some_modes(found, list(found.directions)[:1] if quick and modes is None else modes)
    layers = _counts("layers", layers, LAYERS[:2] if quick else LAYERS, ("auto",))
    samples_a_pixel = _counts("supersample", supersample, SUPERSAMPLE)
    if not is_count(truth_samples):
        raise InputError(f"truth_samples is {quoted(truth_samples)}; expected an integer of at least 1")
    names, without = usable("rts.splatters", splatters)
    possible, missing = usable("rts.samplers", samplers)
    used, failing = engines_for(found, engines)
    earlier = _earlier(folder, found, fresh)
    used = used[:1] if quick and engines is None else used
    measured = Measurements(found, earlier, used, truths=kept, samples=int(truth_samples))
    measured.left_out += [*failing, *without, *missing, *_unthinned()]
    measured.leave_out_what_rests()
    suited = measured.samplers(possible)
    if not suited:
        raise InputError(f"none of the samplers {', '.join(possible)} suits {found.name!r}; {measured.left_out[-1]}")
    others, unsuited = _peers(measured, peers and not quick)
    measured.left_out += unsuited
    most = QUICK_CELLS if quick else None
    kinds = measured.kinds(suited[:1] if quick and samplers is None else suited)
    plan = Plan(names, kinds, used, layers, samples_a_pixel, rates=not quick, most=most, peers=others)
    with phases(progress) as phase:
        comparison = _compared(measured, plan, phase)
    if folder is not None:
        comparison.write(folder)
    return comparison


def _counts(name: str, given: Any, usual: Sequence, others: tuple[str, ...] = ()) -> list:
    numbers = list(usual) if given is None else list(given) if isinstance(given, (list, tuple)) else [given]
    if not numbers or not all(is_count(n) or (isinstance(n, str) and n in others) for n in numbers):
        expected = " or ".join(["integers of at least 1", *map(repr, others)])
        raise InputError(f"{name} is {quoted(given)}; expected {expected}")
    return [n if isinstance(n, str) else int(n) for n in numbers]


def _unthinned() -> list[str]:
    if find_spec("fast_simplification") is None:
        return ["meshes of fewer faces: pip install 'rasterize-then-splat[decimation]'"]
    return []


def _earlier(folder: Path | None, scene: Scene, fresh: bool) -> KeptMeasurements:
    """The store of measurements that earlier runs made of scenes of this name; empty without a folder.

    `fresh` deletes these measurements.
    """
    if folder is None:
        return KeptMeasurements()
    path = folder / f".{file_name(scene.name)}.jsonl"
    if fresh:
        path.unlink(missing_ok=True)
    return KeptMeasurements(path)


def _peers(measured: Measurements, wanted: bool) -> tuple[list[Peer], list[str]]:
    if not wanted:
        return [], []
    from rts_compare.other_renderers.installed_renderers import peers

    return peers(measured.scene, engine=None if measured.scene.separate else measured.engine)


def _compared(measured: Measurements, plan: Plan, phase: Phase) -> Comparison:
    done = phase("truth", 4 * measured.samples**2 * len(measured.scene.directions))
    measured.truths(done)
    measured.leave_out_what_hardly_changes()
    scene, rows = measured.scene, []
    modes = list(scene.directions)
    cells = {g: _cells(measured, plan, g) for g in dict.fromkeys(map(measured.group, modes))}
    done = phase("errors", sum(len(cells[measured.group(m)]) + len(plan.peers) for m in modes))
    errors: dict[str, dict[Setting, dict[str, float]]] = {}
    for mode in modes:
        found = {s: _counted(measured.scores, mode, s, done=done) for s in cells[measured.group(mode)]}
        errors[mode] = {setting: score for setting, score in found.items() if score is not None}
    of_peers = {(m, p): _counted(_peer_scores, measured, m, p, done=done) for m in modes for p in plan.peers}
    for group in cells:
        of_group = {mode: errors[mode] for mode in measured.modes(group)}
        times = _timed(measured, plan, group, of_group, phase)
        for mode, found in of_group.items():
            rows += _rows(mode, found, plan.samplers, times)
            peer_times = _peer_times(measured, mode, plan.peers, phase)
            for peer in plan.peers:
                score, ms = of_peers[mode, peer], peer_times.get(_peer_key(peer))
                if score is not None:
                    rows.append({"mode": mode, "peer": peer.name, "settings": dict(peer.settings), **score, "ms": ms})
    rows.sort(key=lambda row: modes.index(row["mode"]))
    found = marked({"rows": rows})
    return Comparison(
        {"name": scene.name, "note": scene.note, "size": list(scene.size)},
        {**environment(PACKAGES), "date": measured.kept.since},
        {mode: {"truth_error": measured.truth(mode).error} for mode in modes},
        found["rows"],
        measured.left_out,
    )


def _counted(f: Callable, *args: Any, done: Callable[[], None]) -> Any:
    """The result of `f`; `done` is called afterwards, to move a progress bar on."""
    result = f(*args)
    done()
    return result


def _cells(measured: Measurements, plan: Plan, group: str) -> list[Setting]:
    kinds = dict.fromkeys(plan.samplers.values())
    settings = measured.settings(group, plan.splatters, plan.layers, plan.supersample, kinds, plan.rates)
    if plan.most is not None and len(settings) > plan.most:
        measured.left_out.append(
            f"{len(settings) - plan.most} settings beyond the {plan.most} that are quick to measure"
        )
        settings = settings[: plan.most]
    return settings


def _timed(
    measured: Measurements, plan: Plan, group: str, errors: Mapping[str, Mapping[Setting, dict]], phase: Phase
) -> dict[Setting, dict[str, float]]:
    """Setting → its time, as `InterleavedTiming.run` returns it.

    For each splatter and each set of samplers with equal errors, settings that are `worth_timing` are timed first, with
    one sampler of the set and the first engine. Settings on the Pareto front are then timed with the other samplers of
    the set, and with all other engines.
    """
    engine = plan.engines[0].name
    usual = {kind: next(name for name, k in plan.samplers.items() if k == kind) for kind in plan.samplers.values()}
    plain = {mode: {s: found["error"] for s, found in of_mode.items()} for mode, of_mode in errors.items()}
    first: dict[Setting, Setting] = {}
    for of_mode in plain.values():
        for splatter, kind in product(plan.splatters, usual):
            own = {s: error for s, error in of_mode.items() if (s.splatter, s.sampler) == (splatter, kind)}
            for setting in worth_timing(own, lambda s: measured.work(group, s)):
                first[setting] = setting._replace(sampler=usual[kind], engine=engine)
    times = _taken(measured, group, list(first.values()), phase, f"times, {group}")
    known = {s: times[timed]["median"] for s, timed in first.items() if timed in times}
    best: dict[Setting, None] = {}
    for mode, of_mode in plain.items():
        tried = [s for s in of_mode if s in known]
        on = front([{"mode": mode, "error": of_mode[s], "ms": {"median": known[s]}} for s in tried])
        best.update(dict.fromkeys(s for s, wanted in zip(tried, on, strict=True) if wanted))
    more = [
        s._replace(sampler=name, engine=engine)
        for s in best
        for name, kind in plan.samplers.items()
        if kind == s.sampler and name != usual[kind]
    ]
    # Compiled programs have to know the number of layers.
    more += [first[s]._replace(engine=e.name) for s in best for e in plan.engines[1:] if s.layers != "auto"]
    return times | _taken(measured, group, more, phase, "times, other samplers and engines")


def _taken(
    measured: Measurements, group: str, settings: Sequence[Setting], phase: Phase, what: str
) -> dict[Setting, dict[str, float]]:
    timing = measured.timing(group, {s: lambda s=s: measured.call(group, s) for s in settings})
    times = timing.run(done=phase(what, ROUNDS * len(settings)))
    measured.left_out += [f"{', '.join(str(v) for v in s if v != '')}: {why}" for s, why in timing.failed.items()]
    return {Setting(*s): ms for s, ms in times.items()}


def _peer_key(peer: Peer) -> tuple:
    return peer.name, *(f"{name}={value}" for name, value in peer.settings.items())


def _peer_scores(measured: Measurements, mode: str, peer: Peer) -> dict[str, float] | None:
    key = "peer", mode, *_peer_key(peer), *measured.state(mode)
    kept: Any = measured.kept.get(*key)
    if kept is None:
        try:
            derivative = peer.derivative(mode) * measured.pixel(mode)
            kept = measured.kept.put(scores(derivative, measured.truth(mode).derivative), *key)
        except Exception as error:
            why = one_line(f"{type(error).__name__}: {error}")
            measured.left_out.append(f"{' '.join(_peer_key(peer))}, {mode}: {why}")
    return kept


def _peer_times(
    measured: Measurements, mode: str, peers: Sequence[Peer], phase: Phase
) -> dict[tuple, dict[str, float]]:
    """Times of other renderers' gradients in a mode, by `_peer_key`; each mode has times of its own."""
    if not peers:
        return {}
    calls: Calls = {_peer_key(p): lambda p=p: p.gradient(mode) for p in peers}
    timing = InterleavedTiming(measured.kept, calls, lambda name: ("peer", mode, *name, *measured.state(mode)))
    return timing.run(PEER_ROUNDS, phase(f"times of peers, {mode}", PEER_ROUNDS * len(peers)))


def _rows(
    mode: str,
    errors: Mapping[Setting, dict],
    samplers: Mapping[str, str],
    times: Mapping[Setting, dict[str, float]],
) -> list[dict]:
    """Rows of a mode: one for each timed setting, and one with "ms" None for each setting without a time.

    Args:
        mode: the mode.
        errors: setting without engine, its sampler a value of `samplers` → scores.
        samplers: as in `Plan`.
        times: setting with its own sampler and engine → time.
    """
    timed: dict[Setting, list[Setting]] = {}
    for setting in times:
        timed.setdefault(setting._replace(sampler=samplers[setting.sampler], engine=""), []).append(setting)
    return [
        {"mode": mode, "settings": s._asdict(), **found, "ms": times.get(s) if s.engine else None}
        for setting, found in errors.items()
        for s in timed.get(setting, [setting])
    ]
