"""Subdivision: a smooth surface's cage is fitted to pictures. Writes subdivision_fit.png: start, result, target."""

import sys

import numpy as np
import torch

import rts

QUICK = "--quick" in sys.argv
SIZE, STEPS = ((32, 32), 4) if QUICK else ((128, 128), 15)

# A cube of eight control points; its Catmull–Clark limit is a smooth blob.
cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
surface = rts.Subdivision(quads)
truth = cube * [1.3, 0.8, 1.0] + 0.5 * np.random.default_rng(0).normal(size=cube.shape).clip(-1, 1)
cameras = [rts.Camera.look_at(eye, (0, 0, 0)) for eye in ((0, 0.5, 5), (5, 0.5, 0), (0.5, 5, 0))]


def images(control):
    part = rts.Part(surface, {"vertices": control}, "normals")
    return [rts.render(part, camera, SIZE) for camera in cameras]


pictures = [torch.as_tensor(image) for image in images(truth.astype(np.float32))]


def residuals(control):
    return torch.stack([image - picture for image, picture in zip(images(control), pictures, strict=True)])


fit = rts.fit(residuals, torch.tensor(cube), method="lm", steps=STEPS, progress=False)
off = np.abs(fit.parameters.numpy() - truth).max()
print(f"loss {fit.history[0]:.4f} → {fit.loss:.6f}; control points off by {off:.3f} at most")
shown = [np.asarray(images(control)[0]) for control in (cube, fit.parameters.numpy(), truth.astype(np.float32))]
rts.save_image("subdivision_fit.png", np.concatenate(shown, axis=1))
