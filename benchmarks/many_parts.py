"""Scenes of many parts beside one merged mesh: the time of an image and the gradient of a step of all parts.

    python -m benchmarks.many_parts
    python -m benchmarks.many_parts --parts 10 100 --links 11
    python -m benchmarks.many_parts --parts --scenes 16
    python -m benchmarks.many_parts --parts --poses 64
    python -m benchmarks.many_parts --parts --programs 1 10 30

A part is a closed cylinder of 512 faces, with a matrix of its own, seen as a silhouette. Both ways take turns in one
run; memory is the most that one step takes. With `--links`, a chain of so many parts is fitted by Levenberg–Marquardt.
With `--scenes`, so many meshes of 320 to 2,700 faces are rendered, each by a camera of its own: by one call of
`rts.render_views`, and by a loop of `rts.render`. With `--poses`, the losses and gradients of so many poses of a mesh
of 320 faces are computed with jax, by a loop over `jit` and by `jit(vmap)`. With `--programs`, images and gradients of
parts are computed by programs of jax, with `--capacity` rows a part.
"""

from __future__ import annotations

import argparse
import time
import tracemalloc
from collections.abc import Callable, Sequence

import numpy as np
import torch
import trimesh

import rts
from benchmarks.timing import in_turn

CAMERA = rts.Camera.look_at((0.3, 0.8, 4), (0, 0, 0), fov_y=40)
PARTS, SIDE, ROUNDS = (1, 3, 10, 30, 100), 256, 7


def link() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a part."""
    cylinder = trimesh.creation.cylinder(radius=0.08, height=0.3, sections=128)
    return np.asarray(cylinder.vertices, np.float32), np.asarray(cylinder.faces, np.int32)


def rigid_each(poses: torch.Tensor) -> list[torch.Tensor]:
    """The matrix of each pose (count, 6)."""
    return [rts.rigid(pose) for pose in poses]


def ways(
    count: int, shader: str, matrices: Callable[[torch.Tensor], list[torch.Tensor]] = rigid_each
) -> dict[str, Callable[[torch.Tensor], rts.Part | list[rts.Part]]]:
    """Two scenes of one picture, as functions of parameters, which `matrices` turns into a matrix a part."""
    vertices, faces = link()
    one, table = rts.Mesh(faces), torch.from_numpy(vertices)
    every = rts.Mesh(np.concatenate([faces + i * len(vertices) for i in range(count)]))

    def parts(parameters: torch.Tensor) -> list[rts.Part]:
        return [rts.Part(one, {"vertices": vertices}, shader, transform=m) for m in matrices(parameters)]

    def merged(parameters: torch.Tensor) -> rts.Part:
        moved = [table @ m[:3, :3].T + m[:3, 3] for m in matrices(parameters)]
        return rts.Part(every, {"vertices": torch.cat(moved)}, shader)

    return {"parts": parts, "merged": merged}


def poses_of(count: int) -> torch.Tensor:
    """Poses (count, 6) at random."""
    random = np.random.default_rng(0)
    poses = np.concatenate([random.normal(size=(count, 3)), random.uniform(-1, 1, (count, 3))], axis=1)
    return torch.tensor(poses, dtype=torch.float32)


def steps(count: int, shader: str) -> dict[str, Callable[[], object]]:
    """An image and its gradient in all poses, both ways."""

    def step(scene: Callable) -> Callable[[], object]:
        def run() -> None:
            poses = poses_of(count).requires_grad_(True)
            rts.render(scene(poses), CAMERA, (SIDE, SIDE)).square().mean().backward()

        return run

    return {name: step(scene) for name, scene in ways(count, shader).items()}


def most_memory(step: Callable[[], object]) -> float:
    """The most memory of NumPy's arrays in a step, MB."""
    step()
    tracemalloc.start()
    step()
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return most / 1e6


def chain(count: int) -> None:
    """Print the time of Levenberg–Marquardt on the angles of a chain, as parts and merged."""
    truth = torch.tensor(np.random.default_rng(1).uniform(-0.1, 0.1, count), dtype=torch.float32)
    upright = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)).astype(np.float32)

    def matrices(angles: torch.Tensor) -> list[torch.Tensor]:
        # Each link turns about the end of the last one; the axis of a cylinder is laid along it.
        turn, at, found = torch.zeros(()), torch.tensor([-0.15 * count, 0.0]), []
        for angle in angles:
            turn = turn + angle
            ahead = torch.stack([torch.cos(turn), torch.sin(turn)])
            middle, at = at + 0.15 * ahead, at + 0.3 * ahead
            zero = 0 * turn
            pose = torch.stack([zero, zero, turn, middle[0], middle[1], zero])
            found.append(rts.rigid(pose) @ torch.from_numpy(upright))
        return found

    for name, scene in ways(count, "silhouette", matrices).items():
        target = rts.render(scene(truth), CAMERA, (SIDE, SIDE)).detach()
        residuals = rts.ImageResiduals(scene, CAMERA, (SIDE, SIDE), target)
        rts.fit(residuals, torch.zeros(count), method="lm", steps=2, progress=False)  # What is imported at first.
        before = time.process_time()
        result = rts.fit(residuals, torch.zeros(count), method="lm", steps=20, progress=False)
        off = float((result.parameters - truth).abs().max())
        seconds, number = time.process_time() - before, len(result.history)
        print(f"| {name} | {seconds:.1f} | {number} | {off:.1e} |", flush=True)


def batch(count: int, side: int, shader: str, what: str) -> dict[str, Callable[[], object]]:
    """Images of meshes with a scene and a camera each, and with their gradient in `what`, "pose" or "vertices"."""
    meshes, cameras = [], []
    for b in range(count):
        mesh = trimesh.creation.icosphere(2 + b % 2)
        if b % 4 > 1:
            mesh = trimesh.creation.torus(0.8, 0.3, major_sections=24 + 4 * b % 64, minor_sections=16)
        vertices = np.asarray(mesh.vertices, np.float32)
        vertices = 0.6 * vertices * (1 + 0.2 * np.sin(3 * vertices[:, :1] + b))
        meshes.append((rts.Mesh(mesh.faces), vertices))
        cameras.append(rts.Camera.look_at((3 * np.sin(b), 1, 3 * np.cos(b)), (0, 0, 0)))

    def scenes() -> list[list[rts.Part]]:
        poses = torch.zeros((count, 6), requires_grad=True)
        if what == "pose":
            moves = [rts.rigid(pose) for pose in poses]
            own = [rts.Part(m, {"vertices": v}, shader, transform=t) for (m, v), t in zip(meshes, moves, strict=True)]
        else:
            own = [rts.Part(m, {"vertices": torch.tensor(v, requires_grad=True)}, shader) for m, v in meshes]
        return [[part] for part in own]

    def step(together: bool, gradient: bool) -> Callable[[], object]:
        def run() -> None:
            every = scenes()
            if together:
                images = rts.render_views(every, cameras, (side, side))
            else:
                views = zip(every, cameras, strict=True)
                images = torch.stack([rts.render(own, camera, (side, side)) for own, camera in views])
            loss = images.square().mean()
            if gradient:
                loss.backward()

        return run

    kinds = [(way, name) for way in ("loop", "batch") for name in ("value", "gradient")]
    return {f"{way}, {name}": step(way == "batch", name == "gradient") for way, name in kinds}


def batches(count: int) -> None:
    """Print the times of batches of meshes beside a loop."""
    columns = "shader, side, in", "loop, ms", "batch, ms", "ratio", "values alone", "loop, MB", "batch, MB"
    print(f"\n| {' | '.join(columns)} |\n{'| --- ' * len(columns)}|")
    for shader in ("silhouette", "lambert"):
        for side in (64, 128):
            for what in ("pose", "vertices"):
                functions = batch(count, side, shader, what)
                t = {name: found["ms"] for name, found in in_turn(functions, ROUNDS).items()}
                loop, once, ratio = t["loop, gradient"], t["batch, gradient"], t["loop, value"] / t["batch, value"]
                memory = [most_memory(functions[f"{way}, gradient"]) for way in ("loop", "batch")]
                times = f"{loop:.0f} | {once:.0f} | {loop / once:.2f} | {ratio:.2f}"
                print(f"| {shader}, {side}², {what} | {times} | {memory[0]:.1f} | {memory[1]:.1f} |", flush=True)


def poses(count: int, side: int = 64, rounds: int = 15) -> None:
    """Print the times of losses of many poses, and of their gradients, with jax."""
    import jax

    ball = trimesh.creation.icosphere(2)
    surface, vertices = rts.Mesh(ball.faces), np.asarray(ball.vertices, np.float32)
    camera = rts.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=40)

    def loss(pose: jax.Array) -> jax.Array:
        part = rts.Part(surface, {"vertices": vertices}, "silhouette", transform=rts.rigid(pose))
        return (rts.render(part, camera, (side, side)) ** 2).mean()

    every = jax.numpy.asarray(0.1 * np.random.default_rng(0).normal(size=(count, 6)), "float32")
    one, together = jax.jit(jax.value_and_grad(loss)), jax.jit(jax.vmap(jax.value_and_grad(loss)))
    times: dict[str, list[tuple[float, float]]] = {"loop over jit": [], "jit(vmap)": []}
    for number in range(rounds + 2):
        for name, run in zip(times, (lambda: [one(pose) for pose in every], lambda: together(every)), strict=True):
            start = time.perf_counter(), time.process_time()
            jax.block_until_ready(run())
            if number > 1:
                times[name].append((time.perf_counter() - start[0], time.process_time() - start[1]))
    print("\n| poses | ms | CPU ms |\n| --- | --- | --- |")
    for name, found in times.items():
        wall, cpu = 1e3 * np.median(found, axis=0)
        print(f"| {name} | {wall:.0f} | {cpu:.0f} |", flush=True)


def programs(counts: Sequence[int], capacity: int | None, rounds: int = 12) -> None:
    """Print the times of programs of jax that render parts, and take the gradient in their poses."""
    import jax

    vertices, faces = link()
    surface = rts.Mesh(faces)
    print("\n| parts | silhouettes, ms | lambert, ms |\n| --- | --- | --- |")
    for count in counts:
        row, known = [], jax.numpy.asarray(poses_of(count).numpy())
        for shader in ("silhouette", "lambert"):

            def loss(poses: jax.Array, shader: str = shader) -> jax.Array:
                parts = [rts.Part(surface, {"vertices": vertices}, shader, transform=rts.rigid(pose)) for pose in poses]
                return (rts.render(parts, CAMERA, (SIDE, SIDE), capacity=capacity) ** 2).mean()

            step, times = jax.jit(jax.value_and_grad(loss)), []
            for _ in range(rounds + 2):
                start = time.perf_counter()
                jax.block_until_ready(step(known))
                times.append(time.perf_counter() - start)
            row.append(f"{1e3 * np.median(times[2:]):.1f}")
        print(f"| {count} | {' | '.join(row)} |", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="*", type=int, default=PARTS)
    parser.add_argument("--shader", default="silhouette")
    parser.add_argument("--links", type=int, default=0)
    parser.add_argument("--scenes", type=int, default=0)
    parser.add_argument("--poses", type=int, default=0)
    parser.add_argument("--programs", nargs="*", type=int, default=())
    parser.add_argument("--capacity", type=int)
    args = parser.parse_args(arguments)
    print(f"| parts | each, ms | merged, ms | ratio | each, MB | merged, MB |\n{'| --- ' * 6}|")
    for count in args.parts:
        functions = steps(count, args.shader)
        times = {name: t["ms"] for name, t in in_turn(functions, ROUNDS).items()}
        memory = {name: most_memory(step) for name, step in functions.items()}
        row = times["parts"], times["merged"], times["parts"] / times["merged"], memory["parts"], memory["merged"]
        print(f"| {count} | {row[0]:.1f} | {row[1]:.1f} | {row[2]:.2f} | {row[3]:.1f} | {row[4]:.1f} |", flush=True)
    if args.links:
        print("\n| chain | CPU s | steps | error of angles |\n| --- | --- | --- | --- |")
        chain(args.links)
    if args.scenes:
        batches(args.scenes)
    if args.poses:
        poses(args.poses)
    if args.programs:
        programs(args.programs, args.capacity)


if __name__ == "__main__":
    main()
