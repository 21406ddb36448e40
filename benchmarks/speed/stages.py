"""The time of each stage of a pose iteration with torch: real sampler, splatter and shader with clocks around them."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any
from unittest import mock

import numpy as np

import rts
from benchmarks.speed.pose_iteration import Task
from benchmarks.timing import CONSECUTIVE, RATE, START, WARM_UP
from rts.plugin_api.records import Splats
from rts.sampling import packing, triangle_search

STAGES = (
    "pose matrix",
    "rasterize",
    "pack",
    "rest of sample",
    "evaluate, project",
    "shade",
    "splat",
    "loss",
    "backward: splat",
    "backward: rest",
    "Adam",
)
"""In their order; "backward: splat" begins at the loss and ends when the gradient reaches the splats."""

KINDS = (("pose", "raster"), ("pose", "embree"), ("full", "raster"))
"""Modes and samplers."""


class Clock:
    """Seconds by stage of one iteration, and the moment at which the backward pass had left the splatter."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.left_splat = 0.0

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what is inside."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def timed(self, name: str, function: Callable) -> Callable:
        """A function that does what another does, and is timed."""

        def call(*args: Any, **kwargs: Any) -> Any:
            with self.stage(name):
                return function(*args, **kwargs)

        return call


class TimedSplatter(rts.Splatter):
    """A splatter that is timed, forwards and backwards."""

    def __init__(self, splatter: Any, clock: Clock):
        self._splatter, self._clock = splatter, clock
        self.reach, self.reads, self.layers = splatter.reach, splatter.reads, splatter.layers

    def image(self, splats: Splats) -> Any:
        """See `rts.Splatter`."""
        return self._splatter.image(splats)

    def cropped(self, splats: Splats) -> Any:
        """See `rts.Splatter`."""
        positions = splats.positions + 0  # Whose gradient arrives when the splatter's is done.
        positions.register_hook(self._leave)
        with self._clock.stage("splat"):
            return self._splatter.cropped(splats.replace(positions=positions))

    def _leave(self, _: Any) -> None:
        self._clock.left_splat = time.perf_counter()


class TimedShader(rts.Shader):
    """A shader that is timed."""

    def __init__(self, shader: Any, clock: Clock):
        self.opaque, self.uniform, self.reads = shader.opaque, shader.uniform, shader.reads
        self._shader, self._clock = shader, clock

    def __call__(self, theta: Any, gbuffer: Any, camera: Any) -> Any:
        """See `rts.Shader`."""
        with self._clock.stage("shade"):
            return self._shader(theta, gbuffer, camera)


def timed_sampler(name: str, clock: Clock) -> Any:
    """A sampler of triangles that is timed."""
    base = rts.plugin("rts.samplers", name)
    return type(f"Timed{base.__name__}", (base,), {"rasterize": clock.timed("rasterize", base.rasterize)})()


def stages(task: Task, mode: str, sampler: str, rounds: int) -> dict[str, float]:
    """Medians in milliseconds; "total" is that of whole iterations, "prepare" is done once before."""
    import torch

    clock = Clock()
    timed = timed_sampler(sampler, clock)
    splatter = TimedSplatter(rts.plugin("rts.splatters", task.splatter)(), clock)
    shader = TimedShader(rts.plugin("rts.shaders", task.part.shader)(), clock)
    pose = torch.tensor(START, requires_grad=True)
    vertices = torch.tensor(task.vertices, requires_grad=mode == "full")
    theta = {"vertices": vertices if mode == "full" else task.vertices}
    part = task.part.replace(theta=theta, shader=shader)
    start = time.perf_counter()
    prepared = rts.prepare(part, timed)
    prepare = 1e3 * (time.perf_counter() - start)
    optimizer = torch.optim.Adam([pose], lr=RATE)
    target = torch.from_numpy(task.target)

    def iteration() -> None:
        pose.grad = vertices.grad = None
        with clock.stage("pose matrix"):
            transform = rts.rigid(pose)
        posed = part.replace(transform=transform) if mode == "full" else prepared.replace(transform=transform)
        options: dict[str, Any] = {"sampler": timed} if mode == "full" else {}
        with clock.stage("rest of sample"):
            options |= {"splatter": splatter, "layers": task.layers}
            sampled = rts.sample(posed, task.view, task.size, **options)
        with clock.stage("evaluate, project"):
            image = rts.render_samples(sampled, posed, task.view, splatter=splatter)
        with clock.stage("loss"):
            loss = ((image[..., task.channels] - target) ** 2).mean()
        with clock.stage("backward: rest"):
            begin = time.perf_counter()
            loss.backward()
        clock.seconds["backward: splat"] = clock.left_splat - begin
        with clock.stage("Adam"):
            optimizer.step()

    with mock.patch.object(triangle_search, "pack_fragments", clock.timed("pack", packing.pack_fragments)):
        found = [_one(clock, iteration) for _ in range(rounds * CONSECUTIVE + WARM_UP)][WARM_UP:]
    medians = {name: 1e3 * float(np.median([f.get(name, 0.0) for f in found])) for name in (*STAGES, "total")}
    return {"prepare": prepare, **medians}


def _one(clock: Clock, iteration: Callable[[], None]) -> dict[str, float]:
    """Seconds by stage of one iteration, none of them counted twice."""
    clock.seconds.clear()
    start = time.perf_counter()
    iteration()
    found = {**clock.seconds, "total": time.perf_counter() - start}
    for outer, inner in (
        ("rest of sample", ("rasterize", "pack")),
        ("evaluate, project", ("shade", "splat")),
        ("backward: rest", ("backward: splat",)),
    ):
        found[outer] -= sum(found.get(name, 0.0) for name in inner)
    return found


def measure(tasks: Iterable[Task], rounds: int, done: Callable[[], None]) -> list[dict]:
    """Rows of the results: both modes, both samplers for a mesh that stays."""
    rows = []
    for task in tasks:
        for mode, sampler in KINDS:
            row = {"mesh": task.name, "faces": len(task.faces), "side": task.side, "mode": mode, "sampler": sampler}
            rows.append(row | {"ms": stages(task, mode, sampler, rounds)})
            done()
    return rows
