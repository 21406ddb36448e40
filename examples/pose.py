"""Pose: a block is turned and shifted until its silhouette is a picture's. Writes pose.png: start, result, target."""

import sys

import numpy as np
import torch
import trimesh

import rts

QUICK = "--quick" in sys.argv
SIZE = (48, 48) if QUICK else (192, 192)

block = trimesh.creation.box((2, 1.2, 0.8))
vertices = block.vertices * (1 + np.random.default_rng(3).uniform(-0.3, 0.3, block.vertices.shape))
part = rts.Part(rts.Mesh(block.faces), {"vertices": vertices.astype(np.float32)})  # The default shader: a silhouette.
camera = rts.Camera.look_at((1, 2, 4), (0, 0, 0))


def posed(pose):  # A rotation vector and a translation.
    return part.replace(transform=rts.rigid(pose))


def picture(pose):
    return np.asarray(rts.render(posed(pose), camera, SIZE))


true, start = np.array([0.5, -0.3, 0.2, 0.2, 0.1, -0.3], np.float32), torch.zeros(6)
target = picture(true)
residuals = rts.ImageResiduals(posed, camera, SIZE, target)
fit = rts.fit(residuals, start, method="lm", schedule=rts.pyramid(SIZE), progress=False)

print("found", fit.parameters.numpy().round(3), "true", true, "loss", fit.loss)
rts.save_image("pose.png", np.concatenate([picture(start.numpy()), picture(fit.parameters.numpy()), target], axis=1))
