"""One body becomes two that are seen by their shadows alone: values on a lattice over a floor, in two lights.

The picture, `shadow_topology.png`, has three columns: start, result and target; above the floor with its shadows, which
is all that the fit sees, and below the shape.

    python -m benchmarks.shadow_topology -o out/shadows
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from rich.progress import track

import rts

SIZE, CELLS, POINTS = (80, 80), 96, 24
FLOOR = np.array([[-2.2, -1.3, -2.2], [-2.2, -1.3, 2.2], [2.2, -1.3, 2.2], [2.2, -1.3, -2.2]], np.float32)
CAMERA = rts.Camera.look_at((0.0, 2.5, 0.01), (0.0, -1.3, 0.0), fov_y=60)
SHOWN = rts.Camera.look_at((1.2, 2.6, 2.2), (0.0, 0.0, 0.0), fov_y=45)
LIGHT = {"direction": np.array([[0.0, 1.0, 0.05], [0.6, 1.0, -0.4]], np.float32), "color": np.array([0.4, 0.4, 0.4])}
SURFACE = rts.Isosurface(((-1.2, -1.2, -1.2), (1.2, 1.2, 1.2)))
AXES = np.linspace(-1.2, 1.2, POINTS, dtype=np.float32)


def shapes() -> tuple[np.ndarray, np.ndarray]:
    """Values of a level capsule, and of two balls."""
    p = np.stack(np.meshgrid(AXES, AXES, AXES, indexing="ij"), axis=-1)
    capsule = np.linalg.norm(p - np.clip(p, [-0.5, 0, 0], [0.5, 0, 0]), axis=-1) - 0.45
    balls = [np.linalg.norm(p - np.array([x, 0, z]), axis=-1) - r for x, z, r in ((-0.6, 0.1, 0.35), (0.5, -0.1, 0.45))]
    return capsule.astype(np.float32), np.minimum(*balls).astype(np.float32)


def floor_of(values: Any) -> Any:
    """The picture (H, W, 4) of the floor, with the shadows of a shape that is not in it."""
    floor = rts.Part(rts.Mesh([[0, 1, 2], [0, 2, 3]]), {"vertices": FLOOR}, "lambert")
    shape = rts.Part(SURFACE, {"values": values}, "lambert")
    light = {**LIGHT, "color": LIGHT["color"].astype(np.float32), "ambient": np.array(0.2, np.float32)}
    lit = rts.shadows.with_shadows([floor, shape], light, size=CELLS, bounds=((0, 0, 0), 3.4))
    return rts.render(lit[0], CAMERA, SIZE)


def fitted(start: np.ndarray, target: torch.Tensor, steps: int) -> tuple[np.ndarray, list[float]]:
    """The values that were found, and losses."""
    values, losses = torch.tensor(start, requires_grad=True), []
    optimizer = torch.optim.Adam([values], lr=0.02)
    for _ in track(range(steps), description="fit"):
        optimizer.zero_grad()
        loss = (floor_of(values)[..., :3] - target).square().mean()
        smooth = sum(torch.diff(values, n=2, dim=axis).square().mean() for axis in range(3))
        (loss + 2 * smooth).backward()
        optimizer.step()
        losses.append(loss.item())
    return values.detach().numpy(), losses


def bodies(values: np.ndarray) -> int:
    """The number of separate closed surfaces."""
    return trimesh.Trimesh(*SURFACE.tessellate({"values": values}, 1)).body_count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/shadows"))
    parser.add_argument("--steps", type=int, default=150)
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    start, true = shapes()
    target = torch.as_tensor(floor_of(true)[..., :3])
    began = time.perf_counter()
    found, losses = fitted(start, target, args.steps)
    seconds = time.perf_counter() - began
    columns = []
    for values in (start, found, true):
        shape = rts.render(rts.Part(SURFACE, {"values": values}, "lambert"), SHOWN, SIZE, background=(1, 1, 1))
        columns.append(np.concatenate([np.asarray(x)[..., :3] for x in (floor_of(values), shape)]))
    picture = np.kron(np.concatenate(columns, axis=1), np.ones((2, 2, 1)))
    rts.save_image(args.output / "shadow_topology.png", picture.clip(0, 1).astype(np.float32))
    counts = ", ".join(str(bodies(values)) for values in (start, found, true))
    print(f"loss {losses[0]:.5f} to {losses[-1]:.6f} in {seconds:.0f} s; bodies: {counts}")


if __name__ == "__main__":
    main()
