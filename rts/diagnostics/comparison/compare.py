"""`rts.diagnostics.compare`: speed against accuracy, on one chart, for anyone's scene and anyone's plugin."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from rts.arguments import quoted
from rts.checks import is_count
from rts.diagnostics.comparison.environment import environment
from rts.diagnostics.comparison.front import Row, best_within, marked
from rts.diagnostics.comparison.journal import Journal
from rts.diagnostics.comparison.measure import ROUNDS, Measurements
from rts.diagnostics.comparison.progress import Phase, phases
from rts.diagnostics.comparison.scene import Scene
from rts.diagnostics.comparison.scores import scores
from rts.diagnostics.comparison.seen import Peer
from rts.diagnostics.comparison.settings import Setting, engines, near_front, usable, worth_timing
from rts.diagnostics.comparison.sources import checked, scene_of, some_modes
from rts.diagnostics.comparison.truth import scene_key
from rts.engines import Engine
from rts.errors import InputError, PluginError
from rts.files.paths import output_folder, writing
from rts.fitting.names import one_line
from rts.trees import Tree

LAYERS = (1, 2, 4, "auto")
SUPERSAMPLE = (1, 2, 4)
QUICK_CELLS = 40
"""The most settings that are looked at with `quick`."""
SPP = (1, 4, 16)
"""Samples a pixel of Mitsuba."""
PACKAGES = ("rasterize-then-splat", "numpy", "numba", "torch", "jax", "embreex", "moderngl", "deodr", "mitsuba")


@dataclass(frozen=True)
class Comparison:
    """Settings on one scene, with the error of their derivatives and their time.

    Attributes:
        scene: "name", "note" and "size" (height, width).
        environment: date, machine and versions.
        modes: mode → {"truth_error": what the truth itself may be off}.
        rows: one for each mode and setting: "mode", "settings", "error" (relative L2 through a Gaussian of 2 pixels),
            "gain", "loss_error", "ms" (median, quartiles and number of calls, or None where only the error was
            measured) and "front", whether nothing is both faster and more accurate. Rows of other renderers have
            "peer", too.
        left_out: what could not be measured, and why; a line each.
    """

    scene: Mapping[str, Any]
    environment: Mapping[str, Any]
    modes: Mapping[str, Mapping[str, float]]
    rows: Sequence[Row]
    left_out: Sequence[str]

    @property
    def data(self) -> dict[str, Any]:
        """All of it as dicts and lists, as it is written to JSON."""
        return dict(vars(self))

    def best(self, mode: str, error: float) -> Row | None:
        """The fastest of the library's own rows of a mode whose error is at most `error`; None if there is none."""
        return best_within([r for r in self.rows if r["mode"] == mode and "peer" not in r], error)

    def write(self, folder: Path | str) -> list[Path]:
        """Write NAME.json, and NAME.png and NAME.html where the packages of the extra `plots` are installed."""
        from rts.diagnostics.comparison.chart import draw
        from rts.diagnostics.comparison.page import write_page

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
            except PluginError:  # What is missing is seen from what is not there.
                continue
        return written

    def files(self, folder: Path | str) -> list[Path]:
        """The files of the comparison that there are in a folder."""
        return [file for file in self._files(folder) if file.exists()]

    def _files(self, folder: Path | str) -> list[Path]:
        name = file_name(self.scene["name"])
        return [Path(folder) / f"{name}{suffix}" for suffix in (".json", ".png", ".html")]


def file_name(scene: str) -> str:
    """What the files of a scene are called."""
    return re.sub(r"\W+", "_", scene).strip("_") or "scene"


class Plan(NamedTuple):
    """What is to be measured.

    Attributes:
        splatters: names.
        samplers: names of those that suit the scene, the usual one first.
        engines: the one that errors are measured with first.
        layers: K or "auto".
        supersample: samples along each side of a pixel.
        rates: whether the rates that surfaces offer are tried.
        most: how many settings are looked at, at most; None for all.
        peers: other renderers.
    """

    splatters: Sequence[str]
    samplers: Sequence[str]
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
    fresh: bool = False,
    progress: bool | None = None,
) -> Comparison:
    """Measure the error of derivatives, and the time of a render and gradient, of all settings on one scene.

    The error of a setting is that of the derivative image along each of some directions (modes), against differences of
    area-sampled renders. Settings that no cheaper one betters are timed, in turns: a render and the gradient of a loss
    in what moves. Every registered sampler and splatter takes part, and DEODR and Mitsuba where the extra `bench` is
    installed.

    Args:
        scene: the name of a built-in scene, the path of a model or of a Python file ("file.py:function"), or a
            function: parameters → (parts, camera), or () → (parts, camera) in NumPy, whose parts then move in five
            ways.
        parameters: of the function: where derivatives are taken; an array, or nested dicts and lists.
        directions: mode → direction of the parameters; None for one for each number of small arrays, and one at random
            for each larger array.
        size: (height, width); None for the scene's own.
        modes: some of the modes; None for all.
        samplers: names; None for all that suit the scene.
        splatters: names; None for all.
        engines: names; None for all. Errors are measured with the first.
        layers: numbers of layers, or "auto"; None for 1, 2, 4 and "auto".
        supersample: samples along each side of a pixel; None for 1, 2 and 4.
        peers: whether other renderers take part.
        quick: one mode, one engine, one sampler, at most 40 settings, no peers.
        surface: the kind of surface that reads a model.
        output: a folder for the results, and for what a run that is interrupted goes on from; None to write nothing.
        truths: the folder of truths; None for the folder of caches.
        fresh: whether to forget what earlier runs have measured.
        progress: whether to show progress; None for where standard error is a terminal.

    Raises:
        InputError: there is no such scene, or an argument is wrong; before anything is measured.
        PluginError: a plugin that was asked for cannot be loaded.
    """
    found = scene_of(scene, parameters, directions, size, surface=surface)
    folder = None if output is None else output_folder(output)
    kept = None if truths is None else output_folder(truths)
    found = some_modes(found, list(found.directions)[:1] if quick and modes is None else modes)
    used, left_out = _engines(engines, quick)
    checked(found.at(found.moved(next(iter(found.directions)), 0.0, used[0])), found.name)
    names, without = usable("rts.splatters", splatters)
    possible, missing = usable("rts.samplers", samplers)
    journal = _journal(folder, found, used[0], fresh)
    measured = Measurements(found, journal, used, truths=kept)
    measured.left_out += [*left_out, *without, *missing]
    measured.leave_out_what_rests()
    suited = measured.samplers(possible)
    if not suited:
        raise InputError(f"none of the samplers {', '.join(possible)} suits {found.name!r}; {measured.left_out[-1]}")
    others, unsuited = _peers(found, peers and not quick)
    measured.left_out += unsuited
    plan = Plan(
        names,
        suited[:1] if quick else suited,
        used,
        _counts("layers", layers, LAYERS[:2] if quick else LAYERS, ("auto",)),
        _counts("supersample", supersample, SUPERSAMPLE),
        rates=not quick,
        most=QUICK_CELLS if quick else None,
        peers=others,
    )
    with phases(progress) as phase:
        comparison = _compared(measured, plan, phase)
    if folder is not None:
        comparison.write(folder)
    return comparison


def _engines(chosen: Sequence[str] | None, quick: bool) -> tuple[list[Engine], list[str]]:
    found, left_out = engines(chosen)
    return (found[:1], []) if quick else (found, left_out)


def _counts(name: str, given: Any, usual: Sequence, others: tuple[str, ...] = ()) -> list:
    found = list(usual) if given is None else list(given) if isinstance(given, (list, tuple)) else [given]
    if not found or not all(is_count(n) or n in others for n in found):
        expected = " or ".join(["integers of at least 1", *map(repr, others)])
        raise InputError(f"{name} is {quoted(given)}; expected {expected}")
    return found


def _peers(scene: Scene, wanted: bool) -> tuple[list[Peer], list[str]]:
    from rts.diagnostics.comparison.peers import peers

    return peers(scene, SPP) if wanted else ([], [])


def _journal(folder: Path | None, scene: Scene, engine: Engine, fresh: bool) -> Journal:
    """What earlier runs have measured of this very scene."""
    if folder is None:
        return Journal()
    mode, start = next(iter(scene.directions)), None if scene.separate else engine
    path = folder / f".{file_name(scene.name)}-{scene_key(scene, mode, 0.0, 0, start)}.jsonl"
    if fresh:
        path.unlink(missing_ok=True)
    return Journal(path)


def _compared(measured: Measurements, plan: Plan, phase: Phase) -> Comparison:
    scene, rows = measured.scene, []
    modes = list(scene.directions)
    done = phase("truth", 4 * measured.samples**2 * len(modes))
    truth_errors = {mode: {"truth_error": measured.truth(mode, done).error} for mode in modes}
    groups = {mode: measured.group(mode) for mode in modes}
    cells = {g: _cells(measured, plan, g) for g in dict.fromkeys(groups.values())}
    done = phase("errors", sum(len(cells[g]) for g in groups.values()) + len(plan.peers) * len(modes))
    errors: dict[str, dict[Setting, dict[str, float]]] = {}
    for mode in modes:
        errors[mode] = {}
        for setting in cells[groups[mode]]:
            found = measured.scores(mode, setting)
            if found is not None:
                errors[mode][setting] = found
            done()
    of_peers = {mode: [_peer_scores(measured, mode, peer, done) for peer in plan.peers] for mode in modes}
    for group in cells:
        of_group = {mode: errors[mode] for mode in measured.modes(group)}
        timed, times = _timed(measured, plan, group, of_group, phase)
        for mode, found in of_group.items():
            rows += _rows(mode, found, timed, times)
            for peer, score in zip(plan.peers, of_peers[mode], strict=True):
                if score is not None:
                    ms = times.get(_peer_key(peer))
                    rows.append({"mode": mode, "peer": peer.name, "settings": dict(peer.settings), **score, "ms": ms})
    name = {"name": scene.name, "note": scene.note, "size": list(scene.size)}
    rows.sort(key=lambda row: modes.index(row["mode"]))
    found = marked({"scene": name, "environment": environment(PACKAGES), "modes": truth_errors, "rows": rows})
    return Comparison(**found, left_out=measured.left_out)


def _cells(measured: Measurements, plan: Plan, group: str) -> list[Setting]:
    found = measured.settings(group, plan.splatters, plan.layers, plan.supersample, plan.rates)
    if plan.most is not None and len(found) > plan.most:
        measured.left_out.append(f"{len(found) - plan.most} settings beyond the {plan.most} that are quick to measure")
        found = found[: plan.most]
    return found


def _timed(
    measured: Measurements, plan: Plan, group: str, errors: Mapping[str, Mapping[Setting, dict]], phase: Phase
) -> tuple[list[Setting], dict[tuple, dict[str, float]]]:
    """What was timed, and the times of that and of the peers.

    Of each splatter that is the front of errors, with the usual sampler and engine; and what is then near the front of
    errors and times, with all other samplers, and with all other engines.
    """
    sampler, engine = plan.samplers[0], plan.engines[0].name
    plain = {mode: {s: found["error"] for s, found in of_mode.items()} for mode, of_mode in errors.items()}
    usual: dict[Setting, None] = {}
    for of_mode in plain.values():
        for splatter in plan.splatters:
            own = {s: error for s, error in of_mode.items() if s.splatter == splatter}
            usual.update(dict.fromkeys(worth_timing(own, lambda s: measured.work(group, s))))

    def taken(settings: Iterable[Setting], what: str, others: Mapping[tuple, Callable] = MappingProxyType({})) -> dict:
        calls = {tuple(s): lambda s=s: measured.call(group, s) for s in settings} | dict(others)
        return measured.time(group, calls, phase(f"times, {what}", ROUNDS * len(calls)))

    first = [s._replace(sampler=sampler, engine=engine) for s in usual]
    mode = measured.modes(group)[0]
    times = taken(first, group, {_peer_key(p): lambda p=p: p.gradient(mode) for p in plan.peers})
    known = {s._replace(sampler="", engine=""): times[tuple(s)]["median"] for s in first if tuple(s) in times}
    near: dict[Setting, None] = {}
    for of_mode in plain.values():
        near.update(dict.fromkeys(near_front(of_mode, {s: t for s, t in known.items() if s in of_mode})))
    more = [s._replace(sampler=name, engine=engine) for s in near for name in plan.samplers[1:]]
    # Compiled programs have to know how many layers there are.
    other = [s._replace(sampler=sampler, engine=e.name) for s in near for e in plan.engines[1:] if s.layers != "auto"]
    return first + more + other, times | taken([*more, *other], "other samplers and engines")


def _peer_key(peer: Peer) -> tuple:
    return peer.name, *(f"{name}={value}" for name, value in peer.settings.items())


def _peer_scores(measured: Measurements, mode: str, peer: Peer, done: Any) -> dict[str, float] | None:
    key = ("peer", measured.samples, mode, *_peer_key(peer))
    kept: Any = measured.journal.get(*key)
    if kept is None:
        try:
            derivative = peer.derivative(mode) * measured.pixel(mode)
            kept = scores(derivative, measured.truth(mode).derivative)
        except Exception as error:
            kept = {"why": one_line(f"{type(error).__name__}: {error}")}
        measured.journal.put(kept, *key)
    done()
    if "why" in kept:
        measured.left_out.append(f"{' '.join(_peer_key(peer))}, {mode}: {kept['why']}")
        return None
    return kept


def _rows(mode: str, errors: Mapping[Setting, dict], settings: Sequence[Setting], times: Mapping) -> list[dict]:
    """A row for each setting that was timed, and one without time for each that was not."""
    timed: dict[Setting, list[Setting]] = {}
    for setting in settings:
        if tuple(setting) in times:
            timed.setdefault(setting._replace(sampler="", engine=""), []).append(setting)
    return [
        {"mode": mode, "settings": s._asdict(), **found, "ms": times.get(tuple(s)) if s.sampler else None}
        for setting, found in errors.items()
        for s in timed.get(setting, [setting])
    ]
