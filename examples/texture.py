"""Texture: a bent sheet is painted as in four pictures. Writes texture.png: texture found, true texture, a view."""

import sys

import numpy as np
import torch

import rts

QUICK = "--quick" in sys.argv
SIZE, STEPS = ((40, 40), 15) if QUICK else ((128, 128), 150)

# A grid of vertices with uv, bent; two triangles a square.
v, u = np.mgrid[0:1:17j, 0:1:17j].astype(np.float32)
vertices = np.stack([2 * u - 1, 2 * v - 1, 0.4 * np.sin(4 * u)], axis=-1).reshape(-1, 3)
index = np.arange(17 * 17).reshape(17, 17)
a, b, c, d = (x.reshape(-1) for x in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
uv = np.stack([u, v], axis=-1).reshape(-1, 2)
cameras = [rts.Camera.look_at((x, y, 3), (0, 0, 0)) for x, y in ((-1, -1), (1, -1), (-1, 1), (1, 1))]

rows, columns = np.indices((32, 32)) // 8
truth = np.where(((rows + columns) % 2)[..., None], (0.9, 0.6, 0.1), (0.1, 0.2, 0.5)).astype(np.float32)


def scene(texture):
    return rts.Part(rts.Mesh(faces), {"vertices": vertices, "uv": uv, "texture": texture}, "textured")


pictures = [torch.as_tensor(rts.render(scene(truth), camera, SIZE)) for camera in cameras]


def residuals(texture):
    images = [rts.render(scene(texture), camera, SIZE) for camera in cameras]
    return torch.stack([image - picture for image, picture in zip(images, pictures, strict=True)])


fit = rts.fit(residuals, torch.full((32, 32, 3), 0.5), method="adam", steps=STEPS, learning_rate=0.05, progress=False)
print(f"loss {fit.history[0]:.4f} → {fit.loss:.6f}")
view = np.asarray(rts.render(scene(fit.parameters), cameras[0], (128, 128), background=(0, 0, 0)))[..., :3]
large = [np.kron(np.clip(x, 0, 1), np.ones((4, 4, 1))) for x in (fit.parameters.numpy(), truth)]
rts.save_image("texture.png", np.concatenate([*large, view], axis=1))
