"""Times of iterations on a device, and of their stages, with torch and jax: `python -m benchmarks.gpu.tables FILE`.

Iterations are those of `benchmarks.speed.pose_iteration`: the silhouette or the shaded image of a mesh, the mean
squared difference, its gradient, and a step of Adam. The paper's Table 1 has the same on a V100: rasterize-then-splat
16, 16, 18 and 26 ms at 2.5K to 1.6M faces with gradients of vertices, 16, 16, 16 and 17 with those of the pose alone.

Programs are compiled first, each in a process of its own, at once. Then one row after the other is timed.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
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
COMPILED = "torch, compiled", "jax, compiled", "jax, in one program"
"""`rts.program` of all but sampling, and all of an iteration under `jax.jit`."""

SETTINGS = [
    *(Setting("bunny", side, engine=engine) for side in (512, 256) for engine in COMPILED),
    *(Setting(mesh, 512, engine=engine) for mesh in ("spot", "nefertiti") for engine in COMPILED[:2]),
    *(Setting("bunny", 512, "full", engine=engine) for engine in COMPILED[:2]),
    *(Setting(mesh, side) for side in (512, 256) for mesh in NAMES),
    *(Setting(mesh, 512, "full") for mesh in NAMES),
    *(Setting(mesh, 512, sampler="opengl") for mesh in NAMES[1:]),
]
ON_CPU = [Setting(mesh, 512) for mesh in NAMES]
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


def compiled_torch_step(task: Task, mode: str, device: str, sampler: str = "raster") -> dict[str, Callable[[], Any]]:
    """The stages of an iteration with torch: samples, and a compiled program of all others but the step."""
    import torch

    pose = torch.tensor(START).to(device).requires_grad_()
    vertices = torch.tensor(task.vertices).to(device).requires_grad_(mode == "full")
    target = torch.from_numpy(task.target).to(device)
    optimizer = torch.optim.Adam([{"params": [pose], "lr": RATE}])
    loss = rts.program(_loss_of(task))
    kept: dict[str, Any] = {}

    def sample() -> None:
        pose.grad = vertices.grad = None
        kept["sampled"] = _sampled(task, pose.detach(), vertices.detach(), sampler)

    def others() -> None:
        loss(pose, vertices, kept["sampled"], target).backward()

    return {"sample": sample, "forward, backward": others, "step": optimizer.step}


def compiled_jax_step(task: Task, mode: str, device: str, sampler: str = "raster") -> dict[str, Callable[[], Any]]:
    """The stages of an iteration with jax: samples, and a compiled program of all others."""
    import jax

    variables, target = _on_jax(task, device)
    loss, kept, count = _loss_of(task), {}, 1 if mode == "pose" else 2

    def descended(pose: Any, vertices: Any, sampled: Any, target: Any) -> tuple:
        value, gradient = jax.value_and_grad(loss, tuple(range(count)))(pose, vertices, sampled, target)
        return pose - RATE * gradient[0], value, gradient

    step = rts.program(descended)

    def sample() -> None:
        kept["sampled"] = _sampled(task, variables[0], variables[1], sampler)

    def others() -> None:
        variables[0], *rest = step(*variables, kept["sampled"], target)
        jax.block_until_ready(rest)

    return {"sample": sample, "forward, backward, step": others}


def one_program_step(task: Task, mode: str, device: str, sampler: str = "raster") -> dict[str, Callable[[], Any]]:
    """An iteration with jax, one compiled program that calls the host for samples."""
    import jax

    variables, target = _on_jax(task, device)
    count = 1 if mode == "pose" else 2

    def loss(pose: Any, vertices: Any, target: Any) -> Any:
        return task.loss(pose, vertices, target, sampler)

    @jax.jit
    def step(pose: Any, vertices: Any, target: Any) -> tuple:
        value, gradient = jax.value_and_grad(loss, tuple(range(count)))(pose, vertices, target)
        return pose - RATE * gradient[0], value, gradient

    def iteration() -> None:
        variables[0], *rest = step(*variables, target)
        jax.block_until_ready(rest)

    return {"iteration": iteration}


STEPS: dict[str, Callable[..., dict[str, Callable[[], Any]]]] = {
    "torch": torch_step,
    "torch, compiled": compiled_torch_step,
    "jax, compiled": compiled_jax_step,
    "jax, in one program": one_program_step,
}


def _loss_of(task: Task) -> Callable[..., Any]:
    """The loss of samples: (pose, vertices, samples, target) → ()."""

    def loss(pose: Any, vertices: Any, sampled: Any, target: Any) -> Any:
        image = rts.render_samples(sampled, task.posed(pose, vertices), task.view, splatter=task.splatter)
        return task.reduction(image[..., task.channels] - target)

    return loss


def _sampled(task: Task, pose: Any, vertices: Any, sampler: str) -> Any:
    """The samples of a task's part."""
    options: dict[str, Any] = {"sampler": sampler, "splatter": task.splatter, "layers": task.layers}
    return rts.sample(task.posed(pose, vertices), task.view, task.size, **options)


def _on_jax(task: Task, device: str) -> tuple[list, Any]:
    """Pose and vertices of a task, and the target; arrays of jax on a device."""
    import jax

    where = jax.devices(device)[0]
    pose = jax.device_put(np.asarray(START, np.float32), where)
    return [pose, jax.device_put(task.vertices, where)], jax.device_put(task.target, where)


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


def row(setting: Setting, device: str, folder: Path, turn: Callable[[], Any] = lambda: None) -> dict[str, Any]:
    """A row of the table: the setting, its times, and counts; `turn` is called before any time is taken."""
    vertices, faces = kept_mesh(setting.mesh, folder)
    task = Task(setting.mesh, vertices, faces, setting.side, "lambert", 1)
    found: dict[str, Any] = {**setting._asdict(), "device": device, "faces": len(faces)}
    stages, start = STEPS[setting.engine](task, setting.mode, device, setting.sampler), time.perf_counter()
    for stage in stages.values():
        stage()
    found["first, s"] = round(time.perf_counter() - start, 1)
    turn()
    if setting.engine.startswith("jax"):
        return found | {"ms": timed(stages, lambda: None)}
    import torch

    wait = torch.cuda.synchronize if device == "cuda" else lambda: None
    return found | {"ms": timed(stages, wait), **counted(stages, device)}


def compiled_rows(settings: list[Setting], device: str, folder: Path, until: float) -> Iterator[dict[str, Any]]:
    """The rows of settings that compile: each by a process of its own, all compiled before the first is timed."""
    variables = {**os.environ, "TORCHINDUCTOR_COMPILE_THREADS": "4", "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    processes = []
    for setting in settings:
        command = [sys.executable, "-m", "benchmarks.gpu.tables", "row", json.dumps(setting), device, str(folder)]
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": variables}
        processes.append(subprocess.Popen(command, **pipes))
    ended = time.monotonic() + (until - time.monotonic()) / 2
    while time.monotonic() < ended and any(
        p.poll() is None and not Path(_flag(folder, p.pid)).exists() for p in processes
    ):
        time.sleep(0.5)
    for setting, process in zip(settings, processes, strict=True):
        there = Path(_flag(folder, process.pid)).exists()
        if not there:
            process.kill()
        printed, _ = process.communicate("go\n" if there else None)
        Path(_flag(folder, process.pid)).unlink(missing_ok=True)
        lines = [line for line in printed.splitlines() if line.startswith("{")]
        yield (
            json.loads(lines[-1]) if lines else {**setting._asdict(), "device": device, "error": "not compiled in time"}
        )


def _flag(folder: Path, pid: int) -> str:
    """The file by which a process says that it has compiled."""
    return f"{folder}/compiled.{pid}"


def one_row(setting: str, device: str, folder: str) -> None:
    """Compile, say so, wait for a line from standard input, and print the row."""

    def turn() -> None:
        Path(_flag(Path(folder), os.getpid())).touch()
        sys.stdin.readline()

    print(json.dumps(row(Setting(*json.loads(setting)), device, Path(folder), turn)), flush=True)


def rows_of(settings: list[Setting], device: str, folder: Path, until: float) -> Iterator[dict[str, Any]]:
    """The rows of settings, until the time is over."""
    yield from compiled_rows([s for s in settings if s.engine != "torch"], device, folder, until)
    for setting in (s for s in settings if s.engine == "torch"):
        if time.monotonic() > until:
            print(f"no time: {device} {setting}")
            continue
        try:
            yield row(setting, device, folder)
        except Exception as error:  # One that fails must not cost the others.
            traceback.print_exc()
            yield {**setting._asdict(), "device": device, "error": f"{type(error).__name__}: {error}"[:500]}


def main(path: str, device: str, seconds: str) -> None:
    """Time all settings, on the device and on the CPU, until the seconds are over; write after each row."""
    until, out = time.monotonic() + float(seconds), Path(path)
    folder, rows = out.parent / "meshes", []
    for mesh in NAMES:
        kept_mesh(mesh, folder)
    for where in dict.fromkeys((device, "cpu")):
        for found in rows_of(SETTINGS if where == device else ON_CPU, where, folder, until):
            rows.append(found)
            print(rows[-1], flush=True)
            out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    one_row(*sys.argv[2:5]) if sys.argv[1] == "row" else main(*sys.argv[1:4])
