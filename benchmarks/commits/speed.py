"""The iterations of a pose fit by two commits in turn: workers that take one when they are asked to, and their times.

`rts` is imported by functions only, once a worker knows that it is the right one.
"""

from __future__ import annotations

import functools
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.commits.installs import environment, worker
from benchmarks.meshes import kept_mesh
from benchmarks.timing import CONSECUTIVE, RATE, START, WARM_UP

PROCESSES = 3
"""Processes of each side, in turn: the memory and cores that one is given make it faster or slower for life."""


def sorted_and_welded(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with one vertex a place, in the order of their coordinates."""
    vertices, inverse = np.unique(vertices, axis=0, return_inverse=True)
    return vertices, inverse.reshape(-1)[faces]


class PoseTask:
    """Find the pose of a mesh from its hard silhouette of 4 × 4 samples a pixel, `side` pixels wide, at the zero pose.

    Args:
        vertices: (V, 3).
        faces: (T, 3).
        side: of the image, pixels.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, side: int):
        import rts
        from benchmarks.camera import camera, supersampled

        self.size, self.count, self.camera = (side, side), len(faces), camera()
        self.part = rts.Part(rts.plugin("surfaces", "mesh")(faces), {"vertices": vertices}, "silhouette")
        self.target = supersampled(self.part, self.camera, self.size, 4)[..., 3:].astype(np.float32)

    def loss(self, pose: Any, target: Any) -> Any:
        """Mean squared difference, of a pose (6,) and the target (H, W, 1)."""
        import rts

        image = rts.render(self.part.replace(transform=rts.rigid(pose)), self.camera, self.size)
        return ((image[..., 3:] - target) ** 2).mean()

    def torch(self) -> Callable[[], object]:
        """One eager iteration a call."""
        import torch

        pose, target = torch.tensor(START, requires_grad=True), torch.from_numpy(self.target)
        optimizer = torch.optim.Adam([pose], lr=RATE)

        def step() -> float:
            optimizer.zero_grad()
            loss = self.loss(pose, target)
            loss.backward()
            optimizer.step()
            return loss.item()

        return step

    def jax(self) -> Callable[[], object]:
        """One iteration a call, all of it compiled."""
        import jax
        import jax.numpy as jnp
        import optax

        pose, target, rule = jnp.asarray(START, jnp.float32), jnp.asarray(self.target), optax.adam(RATE)
        state = rule.init(pose)

        @jax.jit
        def iteration(pose: Any, state: Any) -> tuple:
            loss, gradient = jax.value_and_grad(self.loss)(pose, target)
            updates, state = rule.update(gradient, state)
            return optax.apply_updates(pose, updates), state, loss

        def step() -> float:
            nonlocal pose, state
            pose, state, loss = jax.block_until_ready(iteration(pose, state))
            return loss.item()

        return step


def serve(meshes: Path) -> None:
    """Answer requests, a line of JSON each: a mesh, a side, an engine and a number of iterations; their seconds.

    Args:
        meshes: the folder in which they are kept.
    """
    answers, sys.stdout = sys.stdout, sys.stderr  # What others print is no answer.

    @functools.lru_cache(1)
    def task(mesh: str, side: int) -> PoseTask:
        return PoseTask(*kept_mesh(mesh, meshes, sorted_and_welded), side)

    @functools.lru_cache(1)
    def iteration(mesh: str, side: int, engine: str) -> Callable[[], object]:
        return getattr(task(mesh, side), engine)()

    for line in sys.stdin:
        mesh, side, engine, count = json.loads(line)
        answer: dict[str, Any] = {"seconds": []}
        try:
            step = iteration(mesh, side, engine)
            answer["faces"] = task(mesh, side).count
            for _ in range(count):
                start = time.perf_counter()
                step()
                answer["seconds"].append(time.perf_counter() - start)
        except (ImportError, SystemExit) as error:  # No such engine, or no such mesh.
            answer = {"missing": str(error)}
        print(json.dumps(answer), file=answers, flush=True)


class Server:
    """A process of one side that lives as long as the comparison.

    Args:
        site: of the install.
        meshes: folder of meshes.
    """

    def __init__(self, site: Path, meshes: Path):
        self.process = subprocess.Popen(
            worker(site, "speed", meshes),
            env=environment(site),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, *request: Any) -> dict:
        """The answer to a request; see `serve`."""
        assert self.process.stdin and self.process.stdout
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"a worker has died, with exit code {self.process.wait()}, when asked for {request}")
        return json.loads(line)

    def close(self) -> None:
        self.process.communicate()


class Times:
    """The times of one mesh, size and engine.

    Attributes:
        seconds: of iterations, by pair of processes, then by side.
        faces: of the mesh.
    """

    def __init__(self):
        self.seconds: list[list[list[float]]] = []
        self.faces = 0

    def side(self, n: int) -> list[float]:
        """The times of all processes of a side."""
        return [t for pair in self.seconds for t in pair[n]]

    def ratios(self) -> str:
        """The second side's median over that of the first; of all processes, and of each pair."""
        ratios = [statistics.median(b) / statistics.median(a) for a, b in self.seconds]
        whole = statistics.median(self.side(1)) / statistics.median(self.side(0))
        return f"{whole:.2f} ({', '.join(f'{r:.2f}' for r in ratios)})"


def in_turn(servers: Sequence[Server], request: tuple, rounds: int, found: Times) -> str | None:
    """Add the seconds of iterations of each side; why there are none."""
    for server in servers:
        answer = server.ask(*request, WARM_UP)
        if "missing" in answer:
            return answer["missing"]
        found.faces = answer["faces"]
    order = list(range(len(servers)))
    if len(found.seconds) % 2:
        order.reverse()
    found.seconds.append([[] for _ in servers])
    for _ in range(rounds):
        for n in order:
            found.seconds[-1][n] += servers[n].ask(*request, 1 + CONSECUTIVE)["seconds"][1:]
        order.reverse()
    return None
