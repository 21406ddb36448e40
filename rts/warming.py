"""warmup: what ordinary renders and fits have compiled, compiled ahead.

numba's compiler has one lock a process, so several processes share the work. Each does a small task by ordinary calls:
what a call uses is compiled, and nothing else. Later tasks find on disk what earlier ones have compiled.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np

from rts import registry
from rts.arguments import quoted
from rts.camera import Camera
from rts.errors import InputError, PluginError, RtsError
from rts.fitting.fit import fit
from rts.fitting.image_residuals import ImageResiduals
from rts.interfaces import Part
from rts.operations.rigid import rigid
from rts.rendering import render
from rts.sampling.adaptive import Adaptive
from rts.sampling.scenes import sample
from rts.threads import thread_count

SIZE = (24, 32)


def warmup(processes: int | None = None) -> float:
    """Compile ahead what ordinary renders and fits of meshes use, and keep it on disk.

    Kernels are otherwise compiled when they are first called, once for each installation: the first render takes long.
    Where all is compiled it takes seconds. Kernels are for float32 and, if torch is installed, for derivatives
    as well.

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
    with ThreadPoolExecutor(count) as pool:
        for _ in pool.map(_in_process, TASKS):
            pass
    return time.perf_counter() - start


def _in_process(task: str) -> None:
    """Do a task in a process of its own."""
    command = [sys.executable, "-c", f"from rts.warming import TASKS; TASKS[{task!r}]()"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p), "RTS_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise RtsError(f"could not compile what {task} needs: {said[-1]}")


def _camera() -> Camera:
    return Camera.look_at((0.3, 0.8, 3), (0, 0, 0), fov_y=40)


def _parts() -> list[Part]:
    """Two octahedra that pass through one another, so that all that splatters distinguish is there."""
    corners = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
    faces = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
    surface = registry.plugin("rts.surfaces", "mesh")(np.array(faces))
    color = np.array([0.2, 0.5, 0.8], np.float32)
    theta = [{"vertices": corners * 0.9, "color": color}, {"vertices": corners[:, ::-1] * 0.7 + 0.3, "color": color}]
    return [Part(surface, each, shader) for each, shader in zip(theta, ("lambert", "silhouette"), strict=True)]


def _samplers() -> list[Any]:
    found = []
    for name in ("raster", "auto"):
        try:
            found.append(registry.plugin("rts.samplers", name)())
        except PluginError:
            continue
    return found


def _has_torch() -> bool:
    try:
        registry.plugin("rts.engines", "torch")
    except PluginError:
        return False
    return True


def _sampling() -> None:
    for sampler in _samplers():
        for parts in (_parts()[:1], _parts()):
            sample(parts, _camera(), SIZE, sampler=sampler)
    render(_parts(), _camera(), SIZE, supersample=Adaptive(2))


def _splatting() -> None:
    rng = np.random.default_rng(0)
    layers, (height, width) = 2, SIZE
    y, x = np.indices(SIZE)
    depth = np.sort(rng.integers(4, 16, (layers, height, width)) / 4, axis=0)
    row = np.arange(depth.size, dtype=np.int32).reshape(depth.shape)
    row[:, :3], row[1, 8:] = -1, -1
    positions = np.stack([np.broadcast_to(a, depth.shape) for a in (x + 0.5, y + 0.5, depth)], axis=-1)
    positions, rgba = positions.reshape(-1, 3).astype(np.float32), rng.random((depth.size, 4)).astype(np.float32)
    splatter = registry.plugin("rts.splatters", "visible")()
    splatter.splat(positions, rgba, row)
    if _has_torch():
        _differentiate(lambda p, c: splatter.splat(p, c, _torch().as_tensor(row)), positions, rgba)


def _rendering() -> None:
    parts = _parts()
    render(parts[0], _camera(), SIZE)
    if not _has_torch():
        return

    def image(vertices: Any, pose: Any) -> Any:
        moved = parts[0].replace(theta={**parts[0].theta, "vertices": vertices}, transform=rigid(pose))
        return render([moved, parts[1]], _camera(), SIZE)

    _differentiate(image, parts[0].theta["vertices"], np.zeros(6, np.float32))


def _fitting() -> None:
    if not _has_torch():
        return
    part = _parts()[0].replace(shader="silhouette")
    target = render(part, _camera(), SIZE)
    for splatter in ("visible", "single"):
        residuals = ImageResiduals(
            lambda pose: part.replace(transform=rigid(pose)), _camera(), SIZE, target, splatter=splatter
        )
        fit(residuals, _torch().full((6,), 0.02), method="lm", steps=2)


def _differentiate(function: Callable[..., Any], *operands: np.ndarray) -> None:
    """Take a function's gradient and its derivative along a direction."""
    torch = _torch()
    given = tuple(torch.tensor(x, requires_grad=True) for x in operands)
    function(*given).square().sum().backward()
    given = tuple(x.detach() for x in given)
    torch.func.jvp(function, given, given)


@cache
def _torch() -> Any:
    import torch

    return torch


TASKS = {"sampling": _sampling, "splatting": _splatting, "rendering": _rendering, "fitting": _fitting}
