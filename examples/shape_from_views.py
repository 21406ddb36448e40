"""Shape: a ball becomes an animal, or that of a mesh file. Writes shape_from_views.png: start, result, target."""

import sys

import numpy as np
import torch
import trimesh

import rts

QUICK, FILES = "--quick" in sys.argv, [x for x in sys.argv[1:] if x != "--quick"]
SIZE, STEPS, DETAIL = ((32, 32), 12, 2) if QUICK else ((128, 128), 200, 4)
LEGS = ("1:4, 1:2, 1:2", "1:4, 1:2, 3:4", "1:4, 6:7, 1:2", "1:4, 6:7, 3:4")
BLOCKS = ("3:6, 1:7, 1:4", *LEGS, "6:9, 6:7, 2:3", "7:9, 6:9, 1:4", "9:10, 6:7, 1:2", "9:10, 6:7, 3:4", "5:8, 1:2, 2:3")


def animal():
    """Vertices and faces of a body, legs, a neck, a head, ears and a tail: blocks (up, along, across), made round."""
    solid, quads = np.zeros((11, 10, 5), bool), []
    for block in BLOCKS:
        solid[tuple(slice(*map(int, x.split(":"))) for x in block.split(","))] = True
    for axis, side in np.ndindex(3, 2):  # The faces between a full cell and an empty one.
        cells = np.argwhere(solid & ~np.roll(solid, 1 - 2 * side, axis))
        unit = np.roll(np.eye(3, dtype=int), -axis, axis=0)
        square = np.array([0 * unit[1], unit[1], unit[1] + unit[2], unit[2]])[:: 2 * side - 1]
        quads.append((cells + side * unit[0])[:, None] + square)
    points, corners = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    triangles = corners.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return trimesh.remesh.subdivide_loop(points[:, [1, 0, 2]], triangles[:, ::-1], 2)


model = rts.load(FILES[0])[0] if FILES else None
truth, faces = (model.theta["vertices"], model.surface.faces) if model else animal()
truth = truth - (truth.min(axis=0) + truth.max(axis=0)) / 2
truth = (truth / np.linalg.norm(truth, axis=1).max()).astype(np.float32)
ball = trimesh.creation.icosphere(DETAIL, 0.5)
start = np.asarray(ball.vertices, np.float32)
eyes = np.concatenate([np.eye(3), -np.eye(3)]) * 3 + 0.3
cameras = [rts.Camera.look_at(eye, (0, 0, 0), fov_y=45) for eye in eyes]


def images(vertices, faces):
    theta = {"vertices": vertices, "light": {"direction": np.array([0.3, 0.8, 0.5], np.float32)}}
    return rts.render_views(rts.Part(rts.Mesh(faces), theta, "lambert"), cameras, SIZE)


pictures, steps = torch.as_tensor(images(truth, faces)), rts.LargeSteps(ball.faces, len(start))
u = torch.tensor(steps.encode(start), requires_grad=True)  # Vertices that move along with their neighbours.
optimizer = torch.optim.Adam([u], lr=0.03)
for step in range(STEPS):
    optimizer.zero_grad()
    loss = (images(steps.decode(u), ball.faces) - pictures).square().mean()
    loss.backward()
    optimizer.step()
    if step in (0, STEPS - 1):
        print(f"step {step}: loss {loss:.5f}")

shown = [images(start, ball.faces), images(steps.decode(u).detach().numpy(), ball.faces), pictures.numpy()]
rts.save_image("shape_from_views.png", np.concatenate([x[2] for x in shown], axis=1))
