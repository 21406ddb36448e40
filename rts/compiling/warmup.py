"""Loops compiled ahead: ordinary calls on a small scene, each in a process of its own, several at a time."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from rts import registry
from rts.arguments import quoted
from rts.camera import Camera
from rts.engines import Engine, engine_named
from rts.errors import InputError, RtsError
from rts.fitting.fit import fit
from rts.fitting.image_residuals import ImageResiduals
from rts.operations.rigid import rigid
from rts.parts import Part
from rts.rendering.image import render
from rts.sampling.adaptive import Adaptive
from rts.threads import thread_count

SIZE = (40, 48)
"""Size of the pictures, pixels."""

ENGINES = ("torch", "torch"), ("optax", "jax")
"""Packages and the engines whose optimisers they have."""


def warmup(processes: int | None = None) -> float:
    """Compile ahead what ordinary renders and fits of meshes use, and keep it on disk.

    Loops are otherwise compiled when they are first called, once for each installation: the first render takes long.
    Where all is compiled it takes seconds. Loops are for float32, and for derivatives where torch or jax is installed.

    Args:
        processes: how many to use at once; None for as many as there are cores for this process.

    Returns:
        Seconds that it took.

    Raises:
        InputError: `processes` is no positive integer.
        RtsError: a process failed; what it said last is in the message.
    """
    count = thread_count() if processes is None else processes
    if not isinstance(count, (int, np.integer)) or isinstance(count, bool) or count < 1:
        raise InputError(f"processes is {quoted(processes)}; expected a positive integer, or None")
    start = time.perf_counter()
    first, *others = calls()
    _run(first)  # Its loops are those that the others share.
    with ThreadPoolExecutor(count) as pool:
        list(pool.map(_run, others))
    return time.perf_counter() - start


def calls() -> list[str]:
    """Names of the calls for which loops are compiled; the first needs the most."""
    return [name for name, (_, differentiates) in CALLS.items() if _engine() or not differentiates]


def call(name: str) -> None:
    """Make one of the calls, with one part, and with two that cross."""
    function, _ = CALLS[name]
    for count in (1, 2):
        function(_parts()[:count])


def _run(name: str) -> None:
    # An empty entry of the path is the working directory.
    path = os.pathsep.join(p or os.getcwd() for p in sys.path if isinstance(p, str))
    done = subprocess.run(
        [sys.executable, "-P", "-c", f"from rts.compiling.warmup import call; call({name!r})"],
        env=os.environ | {"PYTHONPATH": path, "RTS_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
    )
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip() or f"exit code {done.returncode}"
        raise RtsError(f"could not compile loops: {said.splitlines()[-1]}")


# -------------------------------------------------------------------------------------------------------- the calls


POSE = np.full(6, 0.01, np.float32)
"""Where fits of a pose start."""


def _camera() -> Camera:
    return Camera.look_at((0.3, 0.8, 3), (0, 0, 0), fov_y=40)


def _parts() -> list[Part]:
    """Two balls that pass through one another, so that all that splatters distinguish is there."""
    v, u = np.mgrid[:7, :12]
    up, around = np.pi * v.ravel() / 6, np.pi * u.ravel() / 6
    ball = np.stack([np.sin(up) * np.cos(around), np.cos(up), np.sin(up) * np.sin(around)], 1).astype(np.float32)
    a, b = (12 * v[:-1] + u[:-1]).ravel(), (12 * v[:-1] + (u[:-1] + 1) % 12).ravel()
    faces = np.concatenate([np.stack([a, b, a + 12], 1), np.stack([b, b + 12, a + 12], 1)])
    surface, color = registry.plugin("rts.surfaces", "mesh")(faces), np.array([0.2, 0.5, 0.8], np.float32)
    return [
        Part(surface, {"vertices": ball, "color": color}, "lambert"),
        Part(surface, {"vertices": ball * np.float32(0.7) + np.float32(0.5), "color": color}, "silhouette"),
    ]


def _engine() -> Engine | None:
    """An engine that differentiates, and has optimisers; None if none is installed."""
    name = next((name for package, name in ENGINES if importlib.util.find_spec(package)), None)
    return engine_named(name) if name else None


def _fitted(scene: Callable[[Any], Any], start: np.ndarray, method: str, channels: int = 4, **options: Any) -> None:
    """A step of a fit, from parameters in NumPy."""
    engine: Any = _engine()
    residuals = ImageResiduals(scene, _camera(), SIZE, np.zeros((*SIZE, channels), np.float32), **options)
    fit(residuals, engine.constant(start), method=method, steps=1, progress=False)


def _picture(parts: list[Part]) -> None:
    render(parts, _camera(), SIZE)


def _adaptive(parts: list[Part]) -> None:
    render(parts, _camera(), SIZE, supersample=Adaptive(2))


def _vertices(parts: list[Part]) -> None:
    front, *others = parts
    start = front.theta["vertices"]
    _fitted(lambda x: [front.replace(theta={**front.theta, "vertices": x}), *others], start, "adam")


def _posed(parts: list[Part], shader: str | None = None) -> Callable[[Any], list[Part]]:
    parts = [part.replace(shader=shader or part.shader) for part in parts]
    return lambda pose: [part.replace(transform=rigid(pose)) for part in parts]


def _pose(parts: list[Part]) -> None:
    _fitted(_posed(parts), POSE, "adam")
    _fitted(_posed(parts, "silhouette"), POSE, "adam", channels=1)


def _least_squares(parts: list[Part]) -> None:
    _fitted(_posed(parts), POSE, "lm")


def _least_squares_of_masks(parts: list[Part]) -> None:
    _fitted(_posed(parts, "silhouette"), POSE, "lm", channels=1)
    _fitted(_posed(parts, "silhouette"), POSE, "lm", channels=1, splatter="single", layers=1)


CALLS: dict[str, tuple[Callable[[list[Part]], None], bool]] = {
    "picture": (_picture, False),
    "least squares": (_least_squares, True),
    "least squares of masks": (_least_squares_of_masks, True),
    "gradient in vertices": (_vertices, True),
    "gradient in a pose": (_pose, True),
    "adaptive picture": (_adaptive, False),
}
"""Calls, and whether each needs an engine that differentiates; the longest of those that share little first."""
