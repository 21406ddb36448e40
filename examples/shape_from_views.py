"""Shape: pull a ball into the shape of six shaded pictures. Writes shape_from_views.png: start, result, target."""

import sys

import numpy as np
import torch
import trimesh

import rts

QUICK = "--quick" in sys.argv
SIZE, STEPS, DETAIL = ((32, 32), 12, 2) if QUICK else ((128, 128), 200, 3)

ball = trimesh.creation.icosphere(DETAIL)
start = np.asarray(ball.vertices, np.float32)
x, y, z = start.T
truth = start * (1 + 0.25 * np.sin(3 * x + 1) * np.cos(3 * y) + 0.15 * z)[:, None]
surface = rts.Mesh(ball.faces)
eyes = np.concatenate([np.eye(3), -np.eye(3)]) * 3 + 0.3
cameras = [rts.Camera.look_at(eye, (0, 0, 0)) for eye in eyes]
light = {"direction": np.array([0.3, 0.8, 0.5], np.float32)}
smoothness = rts.regularizers.Laplacian(start, ball.faces, relative=True)


def images(vertices):
    part = rts.Part(surface, {"vertices": vertices, "light": light}, "lambert")
    return [rts.render(part, camera, SIZE) for camera in cameras]


pictures = [torch.as_tensor(image) for image in images(truth)]


def loss(vertices):
    pairs = zip(images(vertices), pictures, strict=True)
    difference = sum((image - picture).square().mean() for image, picture in pairs) / len(pictures)
    return difference + 0.5 * smoothness(vertices) / smoothness.terms


vertices = torch.tensor(start, requires_grad=True)
optimizer = torch.optim.Adam([vertices], lr=0.01)
for step in range(STEPS):
    optimizer.zero_grad()
    value = loss(vertices)
    value.backward()
    optimizer.step()
    if step in (0, STEPS - 1):
        off = np.linalg.norm(vertices.detach().numpy() - truth, axis=1).mean()
        print(f"step {step}: loss {value:.5f}, vertices off by {off:.4f} on average")

shown = [np.asarray(images(v)[2]) for v in (start, vertices.detach().numpy(), truth)]
rts.save_image("shape_from_views.png", np.concatenate(shown, axis=1))
