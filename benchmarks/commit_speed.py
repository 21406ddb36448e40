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
from commit_installs import environment, worker

MESHES = {
    "teapot_2464": ("teapot_2464", 0),
    "teapot": ("teapot", 0),
    "bunny": ("bunny", 0),
    "spot": ("spot/spot_triangulated", 3),
    "nefertiti": ("nefertiti", 2),
}
"""File and number of midpoint subdivisions: 2.5K, 6K, 69K, 375K and 1.6M faces."""

START = (0.12, -0.15, 0.10, 0.05, -0.04, 0.06)
RATE = 0.01
"""First pose, and the steps of Adam."""

WARM_UP, ROUNDS, CONSECUTIVE = 2, 7, 3
"""Iterations before any is counted; turns of each side; iterations timed in a turn, after one that is not."""

PROCESSES = 3
"""Of each side, one after the other: what one is given of memory and cores makes it faster or slower for life."""


def subdivided(name: str, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32 and faces (T, 3) int32 of one of MESHES, one vertex a place; kept in the folder."""
    path = folder / f"{name}.npz"
    if not path.exists():
        import trimesh
        from scenes import mesh

        file, times = MESHES[name]
        vertices, faces = mesh(file)
        vertices, inverse = np.unique(vertices, axis=0, return_inverse=True)
        faces = inverse.reshape(-1)[faces]
        for _ in range(times):
            vertices, faces = trimesh.remesh.subdivide(vertices, faces)
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(path, vertices=np.asarray(vertices, np.float32), faces=np.asarray(faces, np.int32))
    kept = np.load(path)
    return kept["vertices"], kept["faces"]


class PoseTask:
    """Find the pose of a mesh from its hard silhouette of 4 × 4 samples a pixel, `side` pixels wide, at the zero pose.

    Args:
        vertices: (V, 3).
        faces: (T, 3).
        side: of the image, pixels.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, side: int):
        import rts

        self.size, self.count = (side, side), len(faces)
        self.camera = rts.Camera.look_at((0, 0, 3.2), (0, 0, 0), fov_y=40, near=0.5, far=10)
        self.part = rts.Part(rts.plugin("surfaces", "mesh")(faces), {"vertices": vertices}, "silhouette")
        steps = (np.arange(4) + 0.5) / 4 - 0.5
        self.target = sum(self._hard(x, y) for x in steps for y in steps).astype(np.float32) / 16

    def _hard(self, x: float, y: float) -> np.ndarray:
        """Alpha (H, W, 1) at a point of each pixel, from its centre, pixels right and down."""
        import rts

        shift = np.eye(4)
        shift[0, 3], shift[1, 3] = -2 * x / self.size[1], 2 * y / self.size[0]
        moved = self.camera._replace(projection=shift @ np.asarray(self.camera.projection))
        return rts.render(self.part, moved, self.size, splatter="none", layers=1)[..., 3:]

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
        return PoseTask(*subdivided(mesh, meshes), side)

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
    """Of one mesh, size and engine.

    Attributes:
        seconds: of iterations, by pair of processes, then by side.
        faces: of the mesh.
    """

    def __init__(self):
        self.seconds: list[list[list[float]]] = []
        self.faces = 0

    def side(self, n: int) -> list[float]:
        """Of all processes of a side."""
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
