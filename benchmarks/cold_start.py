"""A newcomer's waiting times: the first call of each kind where nothing has been compiled, the next, and the next day.

Each is a process of its own with an empty folder for compiled loops, and then another that finds them there. Seconds
are the processor's, of all threads, since other programs would lengthen those of a clock:

    python -m benchmarks.cold_start
    python -m benchmarks.cold_start --tree ../other_checkout
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.report import table

SIZE = (256, 256)
SELF = Path(__file__).resolve()


def scene() -> tuple[Any, Any]:
    """A shaded sphere of 1,280 triangles and a camera, in NumPy arrays."""
    import numpy as np
    import trimesh

    import rts

    ball = trimesh.creation.icosphere(3)
    theta = {"vertices": np.asarray(ball.vertices, np.float32)}
    part = rts.Part(rts.plugin("rts.surfaces", "mesh")(np.asarray(ball.faces)), theta, "lambert")
    return part, rts.Camera.look_at((0, 0.5, 3), (0, 0, 0), fov_y=40)


def picture() -> Callable[[], object]:
    """A NumPy render."""
    import rts

    part, camera = scene()
    return lambda: rts.render(part, camera, SIZE)


def torch_gradient() -> Callable[[], object]:
    """A render with torch, and its gradient in the vertices."""
    import torch

    import rts

    part, camera = scene()
    vertices = torch.tensor(part.theta["vertices"], requires_grad=True)
    moved = part.replace(theta={"vertices": vertices})
    return lambda: rts.render(moved, camera, SIZE).square().mean().backward()


def lm_step() -> Callable[[], object]:
    """A step of Levenberg–Marquardt for a pose, with torch."""
    import numpy as np
    import torch

    import rts

    part, camera = scene()
    residuals = rts.ImageResiduals(
        lambda pose: part.replace(transform=rts.rigid(pose)), camera, SIZE, np.zeros((*SIZE, 4), np.float32)
    )
    start = torch.tensor([0.02, 0, 0, 0.01, 0, 0])
    return lambda: rts.fit(residuals, start, method="lm", steps=1, progress=False)


def jax_jit() -> Callable[[], object]:
    """A render and its gradient in the pose, jitted, with jax."""
    import jax

    import rts

    part, camera = scene()
    function = jax.jit(jax.grad(lambda p: rts.render(part.replace(transform=rts.rigid(p)), camera, SIZE).mean()))
    return lambda: function(jax.numpy.zeros(6)).block_until_ready()


TASKS: dict[str, Callable[[], Callable[[], object]]] = {
    "picture, NumPy": picture,
    "gradient, torch": torch_gradient,
    "Levenberg–Marquardt step, torch": lm_step,
    "gradient, jax, jit": jax_jit,
}


def seconds(task: str) -> list[float]:
    """Seconds of the processor of the imports, the first call and the second."""
    times = [time.process_time()]
    call = TASKS[task]()
    times.append(time.process_time())
    for _ in range(2):
        call()
        times.append(time.process_time())
    return [b - a for a, b in zip(times[:-1], times[1:], strict=True)]


def measured(task: str, loops: str, tree: Path) -> list[float]:
    """`seconds` of a process that keeps compiled loops in a folder, by the packages of a tree."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": loops}
    command = f"import runpy; print(__import__('json').dumps(runpy.run_path({str(SELF)!r})['seconds']({task!r})))"
    done = subprocess.run(
        [sys.executable, "-c", command], cwd=tree, env=environment, check=True, stdout=subprocess.PIPE
    )
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tree", type=Path, default=SELF.parents[1], help="a checkout whose packages are measured")
    args = parser.parse_args()
    lines = []
    for task in TASKS:
        with tempfile.TemporaryDirectory() as loops:
            first, later = (measured(task, loops, args.tree.resolve()) for _ in range(2))
        lines.append([task, *(f"{x:.2f}" for x in (first[1], first[2], later[0], later[1]))])
    print(table(["call", "first, s", "second, s", "imports of the next process, s", "its first, s"], lines))


if __name__ == "__main__":
    main()
