# %% [markdown]
# # Shape from views
#
# Six shaded pictures show an animal. We start from a ball and move every vertex, until the ball looks the same from all
# six sides.

# %%
import os

import numpy as np
import rts
import torch
import trimesh
from PIL import Image

quick = "RTS_QUICK" in os.environ
size, count, detail = ((32, 32), 12, 2) if quick else ((96, 96), 150, 4)

# %% [markdown]
# ## An animal
#
# The truth is built of blocks (up, along, across), whose outer squares are made round by subdivision. For a model of
# yours, take `rts.load("model.obj")[0]` and its `theta["vertices"]` and `surface.faces` instead.

# %%
LEGS = ("1:4, 1:2, 1:2", "1:4, 1:2, 3:4", "1:4, 6:7, 1:2", "1:4, 6:7, 3:4")
BLOCKS = ("3:6, 1:7, 1:4", *LEGS, "6:9, 6:7, 2:3", "7:9, 6:9, 1:4", "9:10, 6:7, 1:2", "9:10, 6:7, 3:4", "5:8, 1:2, 2:3")


def animal():
    """Vertices and faces of a body, legs, a neck, a head, ears and a tail."""
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


truth, faces = animal()
truth = truth - (truth.min(axis=0) + truth.max(axis=0)) / 2
truth = (truth / np.linalg.norm(truth, axis=1).max()).astype(np.float32)

# %% [markdown]
# ## Six cameras, one call
#
# `rts.render_views` renders a scene from several cameras at once. Shading by `"lambert"` tells which way the surface
# faces, so pictures say more than masks.

# %%
eyes = np.concatenate([np.eye(3), -np.eye(3)]) * 3 + 0.3
cameras = [rts.Camera.look_at(eye, (0, 0, 0), fov_y=45) for eye in eyes]


def images(vertices, faces):
    theta = {"vertices": vertices, "light": {"direction": np.array([0.3, 0.8, 0.5], np.float32)}}
    return rts.render_views(rts.Part(rts.Mesh(faces), theta, "lambert"), cameras, size)


pictures = torch.as_tensor(images(truth, faces))

# %% [markdown]
# ## Steps that keep the mesh smooth
#
# A step that moves each vertex by itself crumples the mesh. `rts.LargeSteps` describes vertices by other numbers, u: a
# step of these moves a vertex along with its neighbours. Any optimiser may take such steps; here it is Adam.

# %%
ball = trimesh.creation.icosphere(detail, 0.5)
start = np.asarray(ball.vertices, np.float32)
steps = rts.LargeSteps(start, ball.faces)
u = torch.tensor(steps.encode(start), requires_grad=True)
optimizer = torch.optim.Adam([u], lr=0.03)
for step in range(count):
    optimizer.zero_grad()
    loss = (images(steps.decode(u), ball.faces) - pictures).square().mean()
    loss.backward()
    optimizer.step()
    if step in (0, count - 1):
        print(f"step {step}: loss {loss:.5f}")

# %% [markdown]
# From left to right: the ball, the shape that was found, the animal.

# %%
shown = [images(start, ball.faces), images(steps.decode(u).detach().numpy(), ball.faces), pictures.numpy()]
rts.save_image("shape_from_views.png", np.concatenate([x[2] for x in shown], axis=1))
Image.open("shape_from_views.png").copy()

# %% [markdown]
# ## Further
#
# With dozens of photographs, take batches and hold some out: [fits over many views](../guides/many_views.md). The
# command `rts reconstruct` does the whole way, with a texture: [a mesh from
# photographs](../guides/command_line.md#a-mesh-from-photographs).
