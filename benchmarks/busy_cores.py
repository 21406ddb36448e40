"""Steps of a pose's fit where other processes compute on every core, by the threads that torch may use.

For each core a process that multiplies numbers is started, and ended afterwards. Medians, in turn:

    python -m benchmarks.busy_cores
    GOMP_SPINCOUNT=300000 python -m benchmarks.busy_cores

The package `benchmarks` sets how idle threads of torch wait, as `import rts` does where it comes before torch. The
second command has them spin, as they do where torch comes first.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import torch

import rts
from benchmarks.meshes import mesh
from benchmarks.report import table
from benchmarks.timing import in_turn

CASES = (("ball", 48, "silhouette"), ("ball", 128, "lambert"), ("bunny", 256, "silhouette"), ("bunny", 256, "lambert"))
OTHER = "x = 1.0\nwhile True:\n    x *= 1.0000001"
"""The program of other processes."""


def step_of(name: str, side: int, shader: str) -> Callable[[], None]:
    """A function that renders a mesh in a pose of torch, and takes the gradient of a sum in the pose."""
    if name == "ball":
        import trimesh

        ball = trimesh.creation.icosphere(4)
        vertices, faces = np.asarray(ball.vertices, np.float32), np.asarray(ball.faces)
    else:
        vertices, faces = mesh(name)
    surface, camera = rts.Mesh(faces), rts.Camera.look_at((0, 0.5, 3), (0, 0, 0), fov_y=40)
    theta = {"vertices": torch.as_tensor(np.asarray(vertices, np.float32))}

    def step() -> None:
        pose = torch.zeros(6, requires_grad=True)
        part = rts.Part(surface, theta, shader, transform=rts.rigid(pose))
        rts.render(part, camera, (side, side)).sum().backward()

    return step


def timed(steps: dict[str, Callable[[], None]], rounds: int) -> dict[str, dict]:
    """The times of the steps with all threads that torch takes by itself, and with one."""
    several = torch.get_num_threads()

    def with_threads(step: Callable[[], None], count: int) -> Callable[[], None]:
        def call() -> None:
            torch.set_num_threads(count)
            step()

        return call

    counts = {"": several, " one": 1}
    found = in_turn({k + n: with_threads(f, c) for k, f in steps.items() for n, c in counts.items()}, rounds)
    torch.set_num_threads(several)
    return found


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=10, help="turns of each, of three steps")
    options = parser.parse_args()
    steps = {f"{name}, {shader}, {side}²": step_of(name, side, shader) for name, side, shader in CASES}
    idle = timed(steps, options.rounds)
    others = [subprocess.Popen([sys.executable, "-c", OTHER]) for _ in range(os.cpu_count() or 1)]
    try:
        time.sleep(1)
        busy = timed(steps, options.rounds)
    finally:
        for other in others:
            other.kill()
    rows = []
    for name in steps:
        cells = [f"{found[name + n]['ms']:.3g}" for found in (idle, busy) for n in ("", " one")]
        ratios = [f"{busy[name + n]['ms'] / idle[name + n]['ms']:.1f}" for n in ("", " one")]
        rows.append([name, *cells, *ratios])
    several = torch.get_num_threads()
    head = [
        f"idle, {several} threads, ms",
        "idle, one",
        f"busy, {several}",
        "busy, one",
        f"ratio, {several}",
        "ratio, one",
    ]
    print(table(["step", *head], rows))


if __name__ == "__main__":
    main()
