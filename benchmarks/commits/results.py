"""The arrays of one commit: samples, images and gradients of scenes × samplers × splatters × engines × layers.

`rts` is imported by functions only, once a worker knows that it is the right one.
"""

from __future__ import annotations

import importlib
import itertools
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.commits.engines import ENGINES, NumPy, named_arrays
from benchmarks.commits.scenes import CULLED, POSE, SIZE, camera_of_scenes, matrix_of_pose, scenes

LAYERS, USUAL = (1, 2, 4), 2
"""K, and the one that is never left out."""

NAMED = ("none", "single", "multi", "edges")
DEFAULT = "edges"
IN_ARRAY_CODE = ("Single", "Multi")
"""Classes of `rts.splatting`; in older commits the same methods are compiled by name."""

SLOW = ("toy",)
"""Samplers that take a hundred times longer than others."""

JIT_LAYERS = ("mesh", "silhouette", "split uv")
JIT_SPLATTERS = {"mesh": (*NAMED, *IN_ARRAY_CODE), "heightfield": (DEFAULT,)}
"""Scenes that are compiled as a whole for every K, and for more splatters than the default: each takes seconds."""


class Config(NamedTuple):
    """One render. The splatter is a name or a class of `rts.splatting`."""

    engine: NumPy
    scene: str
    sampler: str
    splatter: str
    layers: int

    def key(self, kind: str, leaf: str = "") -> str:
        return "|".join([kind, self.engine.key, self.scene, self.sampler, self.splatter, f"K{self.layers}", leaf])

    @property
    def code(self) -> str:
        return "array code" if self.splatter in ("none", *IN_ARRAY_CODE) else "compiled"


class Recorder:
    """Collects the arrays of one side.

    Attributes:
        arrays: by key, see `Config.key`.
        notes: why something has none, by key.
        camera: of all images.
        scenes: parts by name.
        weights: (H, W, 4) of the image, in the scalar whose gradient is taken.
        matrix: (4, 4) of the pose.
    """

    def __init__(self):
        self.arrays: dict[str, np.ndarray] = {}
        self.notes: dict[str, str] = {}
        self.camera, self.scenes, self.matrix = camera_of_scenes(), scenes(), matrix_of_pose()
        self.weights = np.random.default_rng(0).standard_normal((*SIZE, 4)).astype(np.float32)

    def samplers(self, scene: str) -> list[str]:
        """The registered samplers that take a scene; why the others do not goes to the notes."""
        import rts

        found = []
        for name in rts.plugins("samplers"):
            try:
                rts.sample(self.scenes[scene], self.camera, SIZE, sampler=name, splatter=None, layers=2)
                found.append(name)
            except rts.RtsError as error:
                self.notes[f"{scene}|{name}"] = " ".join(str(error).split())
        return found

    def parts(self, config: Config, variables: dict, pinned: bool = True) -> list[Any]:
        """The scene with arrays for its θ, where they are among the variables, and for its pose.

        Where the pose is pinned, only its derivatives are those of `rts.rigid`: else the last bit of that matrix would
        be in all results.
        """
        import rts

        found = self.scenes[config.scene]
        if "theta" in variables:
            found = [part.replace(theta=theta) for part, theta in zip(found, variables["theta"], strict=True)]
        pose = rts.rigid(variables["pose"])
        pose = config.engine.pinned(pose, self.matrix) if pinned else pose
        return [part.replace(transform=pose) if part.transform is None else part for part in found]

    def variables(self, config: Config, *, theta: bool) -> dict:
        """NumPy arrays: the pose (6,) and, if asked for, θ."""
        found: dict[str, Any] = {"pose": np.array(POSE, np.float32)}
        return found | ({"theta": [dict(part.theta) for part in self.scenes[config.scene]]} if theta else {})

    def take(self, key: str, record: Callable[[], None]) -> None:
        """Record something; what goes wrong is a note."""
        try:
            record()
        except Exception as error:
            self.notes[key] = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"

    def samples(self, config: Config, splatter: str | None) -> None:
        """The samples of `rts.sample`; with a splatter, only those that it needs."""
        import rts

        config = config._replace(splatter=str(splatter))

        def sample(variables: dict) -> Any:
            options = {"sampler": config.sampler, "layers": config.layers, "splatter": splatter}
            return rts.sample(self.parts(config, variables), self.camera, SIZE, **options)

        def record() -> None:
            host = config.engine.host
            sampled = config.engine.sampled(sample, self.variables(config, theta=True))
            tables = {"": sampled, **{f"{n}.": samples for n, samples in enumerate(sampled.samples)}}
            for (of, table), name in itertools.product(tables.items(), ("row", "depth", "overflow")):
                if getattr(table, name) is not None:  # The cells of a single part may have no depth.
                    self.arrays[config.key("samples", of + name)] = host(getattr(table, name))
            for n, samples in enumerate(sampled.samples):
                row = host(samples.row)
                used = np.unique(row[row >= 0])  # Other rows may hold anything.
                for name in ("ids", "params"):
                    self.arrays[config.key("samples", f"{n}.{name}")] = host(getattr(samples, name))[used]

        self.take(config.key("samples"), record)

    def rigid(self, engine: NumPy) -> None:
        """The results that are left out where poses are pinned."""
        import rts

        def record() -> None:
            pose, weights = np.array(POSE, np.float32), self.weights[:4, :4, 0]
            matrix, gradient = engine.image_and_gradient(rts.rigid, pose, weights)
            self.arrays[f"rigid|{engine.key}|matrix"] = engine.host(matrix)
            if gradient is not None:
                self.arrays[f"rigid|{engine.key}|gradient"] = engine.host(gradient)

        self.take(f"rigid|{engine.key}", record)

    def image(self, config: Config, *, theta: bool, pinned: bool = True) -> None:
        """Image and gradients, in θ and the pose or in the pose alone with NumPy θ."""
        import rts

        splatter = config.splatter
        if splatter in IN_ARRAY_CODE:
            splatter = getattr(importlib.import_module("rts.splatting"), splatter)()
        suffix, kind = "" if theta else "θ constant: ", config.code if pinned else "not pinned"

        def render(variables: dict) -> Any:
            options = {"sampler": config.sampler, "layers": config.layers, "splatter": splatter}
            return rts.render(self.parts(config, variables, pinned), self.camera, SIZE, **options)

        def record() -> None:
            variables = self.variables(config, theta=theta)
            image, gradient = config.engine.image_and_gradient(render, variables, self.weights)
            self.arrays[config.key(f"images, {kind}", f"{suffix}image")] = config.engine.host(image)
            for name, x in named_arrays(gradient) if gradient is not None else ():
                self.arrays[config.key(f"gradients, {kind}", f"{suffix}{name}")] = config.engine.host(x)

        self.take(config.key(f"images, {kind}", suffix), record)

    def scene(self, engine: NumPy, scene: str, samplers: Sequence[str]) -> None:
        """All of a scene by an engine: every combination in NumPy and torch; see `_has_time`."""
        for config in (Config(engine, scene, sampler, DEFAULT, k) for sampler in samplers for k in LAYERS):
            default, usual = config.sampler == "auto", config.layers == USUAL
            jit, jax = engine.key == "jax jit", engine.name == "jax"
            if usual or not (jit or config.sampler in SLOW):
                self.samples(config, DEFAULT)
                if default or not jit:
                    self.samples(config, None)
                if engine.name != "numpy" and (not jax or (default and usual)):
                    self.image(config, theta=False)
                    if default and usual:
                        self.image(config, theta=False, pinned=False)
            for other in (config._replace(splatter=splatter) for splatter in (*NAMED, *IN_ARRAY_CODE)):
                if _has_time(other):
                    self.image(other, theta=True)


def _has_time(config: Config) -> bool:
    """True if an image and its gradients are computed: in jax they take seconds, and not all is new there."""
    default, usual = config.splatter == DEFAULT, config.layers == USUAL
    if config.sampler in SLOW:
        return default and usual and config.engine.name != "jax"
    if config.engine.name != "jax":
        return True
    if config.sampler != "auto" or config.scene.endswith(CULLED):
        return default and usual and config.engine.key != "jax jit"
    if config.engine.key == "jax jit":
        wanted = config.splatter in JIT_SPLATTERS.get(config.scene, (DEFAULT,))
        return wanted and usual or default and config.scene in JIT_LAYERS
    return usual or config.scene in JIT_LAYERS or config.code == "compiled"


def record_results(output: Path, engines: Sequence[str] = (), scenes: Sequence[str] = ()) -> None:
    """Write the arrays of this side into a folder.

    Args:
        output: the folder.
        engines: keys of those to take; all, if none is named.
        scenes: names, as engines.
    """
    recorder = Recorder()
    if unknown := set(scenes) - set(recorder.scenes):
        raise SystemExit(f"no scene named {', '.join(sorted(unknown))}; there are {'; '.join(recorder.scenes)}")
    chosen = [scene for scene in recorder.scenes if not scenes or scene in scenes]
    samplers = {scene: recorder.samplers(scene) for scene in chosen}
    for engine in (engine for engine in ENGINES if not engines or engine.key in engines):
        try:
            importlib.import_module(engine.name)
        except ImportError:
            recorder.notes[engine.key] = f"{engine.name} is not installed"
            continue
        start, before = time.perf_counter(), len(recorder.arrays)
        recorder.rigid(engine)
        for scene, names in samplers.items():
            recorder.scene(engine, scene, names)
            if engine.key == "jax jit":  # A compiled program takes some ten megabytes.
                sys.modules["jax"].clear_caches()
        count = len(recorder.arrays) - before
        print(f"  {engine.key}: {count:,} arrays, {time.perf_counter() - start:.0f} s", flush=True)
    output.mkdir(parents=True, exist_ok=True)
    np.savez(output / "arrays.npz", **recorder.arrays)
    (output / "notes.json").write_text(json.dumps(recorder.notes))
