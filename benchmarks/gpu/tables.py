"""Times of iterations on a device, and of their stages, with torch and jax: `python -m benchmarks.gpu.tables FILE`.

Iterations are those of `benchmarks.speed.pose_iteration`: the silhouette or the shaded image of a mesh, the mean
squared difference, its gradient, and a step of Adam. The paper's Table 1 has the same on a V100: rasterize-then-splat
16, 16, 18 and 26 ms at 2.5K to 1.6M faces with gradients of vertices, 16, 16, 16 and 17 with those of the pose alone.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rts
from benchmarks.meshes import kept_mesh
from benchmarks.speed.pose_iteration import Task
from benchmarks.timing import RATE, START

WARM_UP, CALLS = 3, 9


class Setting(NamedTuple):
    """An iteration to be timed: the shaded image of a mesh, one layer."""

    mesh: str
    side: int
    mode: str = "pose"
    engine: str = "torch"
    sampler: str = "raster"


NAMES = ("teapot_2464", "bunny", "spot", "nefertiti")
SETTINGS = [
    *(Setting(mesh, side) for side in (512, 256) for mesh in NAMES),
    *(Setting(mesh, 512, sampler="opengl") for mesh in NAMES[1:]),
    *(Setting(mesh, 512, "full") for mesh in NAMES),
    *(Setting("bunny", side, engine="jax") for side in (512, 256)),
    *(Setting("bunny", side, engine="jax, samples given") for side in (512, 256)),
    Setting("bunny", 512, "full", engine="jax, samples given"),
]
ON_CPU = SETTINGS[:8]
"""Those that are timed on the CPU, too."""


def torch_step(task: Task, mode: str, device: str, sampler: str = "raster") -> dict[str, Callable[[], Any]]:
    """The stages of an iteration with torch, in their order; each works on what the one before left."""
    import torch

    pose = torch.tensor(START).to(device).requires_grad_()
    vertices = torch.tensor(task.vertices).to(device).requires_grad_(mode == "full")
    target = torch.from_numpy(task.target).to(device)
    optimizer = torch.optim.Adam([{"params": [pose], "lr": RATE}])
    options: dict[str, Any] = {"sampler": sampler, "splatter": task.splatter, "layers": task.layers}
    still = rts.prepare(task.part.replace(theta={"vertices": vertices})) if mode == "pose" else None
    kept: dict[str, Any] = {}

    def part() -> Any:
        transform = rts.rigid(pose)
        if still is not None:
            return still.replace(transform=transform)
        return task.part.replace(theta={"vertices": vertices}, transform=transform)

    def sample() -> None:
        pose.grad = vertices.grad = None
        kept["part"] = part()
        kept["sampled"] = rts.sample(kept["part"], task.view, task.size, **options)

    def forward() -> None:
        image = rts.render_samples(kept["sampled"], kept["part"], task.view, splatter=task.splatter)
        kept["loss"] = task.reduction(image[..., task.channels] - target)

    def backward() -> None:
        kept["loss"].backward()

    return {"sample": sample, "forward": forward, "backward": backward, "step": optimizer.step}


def jax_step(task: Task, mode: str, device: str, sampler: str = "raster") -> dict[str, Callable[[], Any]]:
    """An iteration with jax, one compiled program."""
    import jax

    variables, others, target = _on_jax(task, mode, device)

    def loss(variables: dict) -> Any:
        known = others | variables
        return task.loss(known["pose"], known["vertices"], target, sampler)

    step = jax.jit(_step_of(loss))

    def iteration() -> None:
        variables["pose"], *rest = step(variables)
        jax.block_until_ready(rest)

    return {"iteration": iteration}


def jax_stages(task: Task, mode: str, device: str, sampler: str = "raster") -> dict[str, Callable[[], Any]]:
    """The stages of an iteration with jax: samples, found outside of programs, and a compiled program of all others."""
    import jax

    variables, others, target = _on_jax(task, mode, device)
    kept: dict[str, Any] = {}

    def part(known: dict) -> rts.Part:
        return task.part.replace(theta={"vertices": known["vertices"]}, transform=rts.rigid(known["pose"]))

    def sample() -> None:
        options: dict[str, Any] = {"sampler": sampler, "splatter": task.splatter, "layers": task.layers}
        kept["sampled"] = rts.sample(part(others | variables), task.view, task.size, **options)

    def loss(variables: dict, sampled: Any) -> Any:
        image = rts.render_samples(sampled, part(others | variables), task.view, splatter=task.splatter)
        return task.reduction(image[..., task.channels] - target)

    step = jax.jit(_step_of(loss))

    def others_stages() -> None:
        variables["pose"], *rest = step(variables, kept["sampled"])
        jax.block_until_ready(rest)

    return {"sample": sample, "shade, splat, backward, step": others_stages}


def _on_jax(task: Task, mode: str, device: str) -> tuple[dict, dict, Any]:
    """Variables of a task, all that a variable might be, and the target; arrays of jax on a device."""
    import jax

    where = jax.devices(device)[0]
    pose = jax.device_put(np.asarray(START, np.float32), where)
    known = {"pose": pose, "vertices": jax.device_put(task.vertices, where)}
    return dict(known) if mode == "full" else {"pose": pose}, known, jax.device_put(task.target, where)


def _step_of(loss: Callable) -> Callable:
    """A step down the gradient in the pose: (variables, ·) → pose, loss, gradient."""
    import jax

    def step(variables: dict, *others: Any) -> tuple:
        value, gradient = jax.value_and_grad(loss)(variables, *others)
        return variables["pose"] - RATE * gradient["pose"], value, gradient

    return step


def timed(stages: dict[str, Callable[[], Any]], wait: Callable[[], None]) -> dict[str, float]:
    """Medians in milliseconds: of each stage, waited for, and of the whole without waits but at its end."""
    times: dict[str, list[float]] = {name: [] for name in (*stages, "whole")}
    for number in range(WARM_UP + CALLS):
        for name, stage in stages.items():
            start = time.perf_counter()
            stage()
            wait()
            if number >= WARM_UP:
                times[name].append(time.perf_counter() - start)
    for _ in range(CALLS):
        start = time.perf_counter()
        for stage in stages.values():
            stage()
        wait()
        times["whole"].append(time.perf_counter() - start)
    return {name: round(1e3 * statistics.median(found), 3) for name, found in times.items()}


def counted(stages: dict[str, Callable[[], Any]], device: str) -> dict[str, Any]:
    """Counts of one iteration on a GPU: kernels launched, copies, waits by line, and the largest memory in MiB."""
    import torch

    if device != "cuda":
        return {}
    torch.cuda.reset_peak_memory_stats()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        for stage in stages.values():
            stage()
        torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for stage in stages.values():
                stage()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    waits: dict[str, int] = {}
    for warning in caught:
        if "synchron" in str(warning.message):
            line = f"{Path(warning.filename).name}:{warning.lineno}"
            waits[line] = waits.get(line, 0) + 1
    names = [event.name for event in profile.events() or () if "cuda" in str(event.device_type).lower()]
    return {
        "kernels": len([n for n in names if not n.startswith("Mem")]),
        "copies": len([n for n in names if n.startswith("Memcpy")]),
        "waits": waits,
        "MiB": round(torch.cuda.max_memory_allocated() / 2**20),
    }


def row(setting: Setting, device: str, folder: Path) -> dict[str, Any]:
    """A row of the table: the setting, its times, and counts."""
    vertices, faces = kept_mesh(setting.mesh, folder)
    task = Task(setting.mesh, vertices, faces, setting.side, "lambert", 1)
    found: dict[str, Any] = {**setting._asdict(), "device": device, "faces": len(faces)}
    if setting.engine != "torch":
        stages = (jax_step if setting.engine == "jax" else jax_stages)(task, setting.mode, device, setting.sampler)
        return found | {"ms": timed(stages, lambda: None)}
    import torch

    stages = torch_step(task, setting.mode, device, setting.sampler)
    wait = torch.cuda.synchronize if device == "cuda" else lambda: None
    return found | {"ms": timed(stages, wait), **counted(stages, device)}


def main(path: str, device: str, seconds: str) -> None:
    """Time all settings, on the device and on the CPU, until the seconds are over; write after each row."""
    until, out = time.monotonic() + float(seconds), Path(path)
    rows: list[dict[str, Any]] = []
    for where in dict.fromkeys((device, "cpu")):
        for setting in SETTINGS if where == device else ON_CPU:
            if time.monotonic() > until:
                print(f"no time: {where} {setting}")
                continue
            try:
                rows.append(row(setting, where, out.parent / "meshes"))
            except Exception as error:  # One that fails must not cost the others.
                traceback.print_exc()
                rows.append({**setting._asdict(), "device": where, "error": f"{type(error).__name__}: {error}"[:500]})
            print(rows[-1], flush=True)
            out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:4])
