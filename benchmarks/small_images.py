"""A cube fitted to images of few pixels: how many samples a pixel it takes.

Corners and their colours are unknown; each step compares one image with the truth's from a direction at random, sampled
8 × 8 a pixel and not splatted. Adam, its rate falling. What counts is the mean distance of the corners from where they
should be, in edges of the cube.

    python -m benchmarks.small_images
    python -m benchmarks.small_images --sizes 4 --steps 600 --seeds 2
"""

from __future__ import annotations

import argparse
from itertools import product
from typing import Any

import numpy as np
import torch
from rich.progress import track
from scipy.spatial.transform import Rotation

import rts
from benchmarks.report import table

SIZES, SEEDS, STEPS = (4, 8, 16), 4, 3000
SAMPLES = {"1": 1, "2 x 2": 2, "4 x 4": 4}
RATE, DECAY, OFF = 0.01, 10**-1.5, 0.25
"""Adam's rate at the start; its factor at the end; how far corners are off at most along each axis, in edges."""
CAMERA = rts.Camera.look_at((0, 0, 2.8), (0, 0, 0), fov_y=45)
CORNERS = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float32)
QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
MESH = rts.Mesh([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])


def image(
    corners: torch.Tensor, colors: torch.Tensor, turn: torch.Tensor, size: int, camera: rts.Camera, **options: Any
) -> torch.Tensor:
    """The turned cube in size² pixels."""
    part = rts.Part(MESH, {"vertices": corners, "colors": colors}, "unlit", transform=turn)
    return rts.render(part, camera, (size, size), **options)


def fitted(size: int, samples: Any, seed: int, steps: int, camera: rts.Camera = CAMERA) -> tuple[float, float]:
    """The mean distance of corners before and after a fit."""
    rng = np.random.default_rng(seed)
    true, colors = torch.tensor(CORNERS - 0.5), torch.tensor(CORNERS)
    found = true + torch.tensor(rng.uniform(-OFF, OFF, CORNERS.shape).astype(np.float32))
    guess = torch.tensor(rng.random(CORNERS.shape).astype(np.float32))
    start = float((found - true).norm(dim=1).mean())
    optimizer = torch.optim.Adam([found.requires_grad_(), guess.requires_grad_()], lr=RATE)
    falling = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: DECAY ** (step / steps))
    for vector in Rotation.random(steps, rng).as_rotvec():
        turn = rts.rigid(torch.tensor([*vector, 0, 0, 0], dtype=torch.float32))
        target = image(true, colors, turn, size, camera, supersample=8, splatter="none")
        loss = (image(found, guess, turn, size, camera, supersample=samples) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        falling.step()
    return start, float((found - true).detach().norm(dim=1).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    given = parser.parse_args()
    ends: dict[tuple[int, str], list[float]] = {}
    starts: list[float] = []
    runs: list[tuple[int, str, int]] = list(product(given.sizes, SAMPLES, range(given.seeds)))
    for size, name, seed in track(runs):
        start, end = fitted(size, SAMPLES[name], seed, given.steps)
        starts.append(start)
        ends.setdefault((size, name), []).append(end)
    print(f"corners off at the start: {min(starts):.3f} to {max(starts):.3f}")
    rows = [
        [f"{size}²", *(f"{min(e):.3f} to {max(e):.3f}" for e in (ends[size, name] for name in SAMPLES))]
        for size in given.sizes
    ]
    print(table(["image", *SAMPLES], rows))


if __name__ == "__main__":
    main()
