"""Topology: a ball on a lattice becomes a ring, as in four pictures. Writes topology.png: start, result, target."""

import sys

import numpy as np
import torch

import rts

QUICK = "--quick" in sys.argv
SIZE, STEPS, POINTS = ((24, 24), 15, 12) if QUICK else ((96, 96), 300, 24)

axes = np.linspace(-1.2, 1.2, POINTS, dtype=np.float32)
x, y, z = np.meshgrid(axes, axes, axes, indexing="ij")
ball = np.sqrt(x * x + y * y + z * z) - 0.85  # Inside is below zero.
ring = np.sqrt((np.sqrt(x * x + y * y) - 0.75) ** 2 + z * z) - 0.3
surface = rts.Isosurface(((-1.2, -1.2, -1.2), (1.2, 1.2, 1.2)))
cameras = [rts.Camera.look_at(eye, (0, 0, 0)) for eye in ((0, 0, 3.5), (0.3, 0, -3.5), (2, 2, 2.5), (-2, 1, -2.5))]


def images(values):
    part = rts.Part(surface, {"values": values}, "normals")
    return [rts.render(part, camera, SIZE) for camera in cameras]


pictures = [torch.as_tensor(image) for image in images(ring)]
values = torch.tensor(ball, requires_grad=True)
optimizer = torch.optim.Adam([values], lr=0.02)
for step in range(STEPS):
    optimizer.zero_grad()
    pairs = zip(images(values), pictures, strict=True)
    loss = sum((image - picture).square().mean() for image, picture in pairs)
    smooth = sum(torch.diff(values, n=2, dim=axis).square().mean() for axis in range(3))
    (loss + 20 * smooth).backward()
    optimizer.step()
    if step in (0, STEPS - 1):
        print(f"step {step}: loss {loss:.5f}")

shown = [np.asarray(images(v)[0]) for v in (ball, values.detach().numpy(), ring)]
rts.save_image("topology.png", np.concatenate(shown, axis=1))
