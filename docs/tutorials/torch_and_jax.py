# %% [markdown]
# # torch beside jax
#
# The arrays say which framework computes. Nothing else of a scene changes, and there is no switch to set. Here one loss
# has its gradient twice: by torch and by jax.

# %%
import os

import jax
import numpy as np
import rts
import torch
import trimesh
from PIL import Image

size = (24, 24) if "RTS_QUICK" in os.environ else (192, 192)
ring = trimesh.creation.torus(0.8, 0.35, major_sections=24, minor_sections=12)
surface, vertices = rts.Mesh(ring.faces), np.asarray(ring.vertices, np.float32)
camera = rts.Camera.look_at((1, 1, 3), (0, 0, 0))

# %% [markdown]
# ## One scene
#
# The function does not name a framework.


# %%
def ring_of(vertices):
    return rts.Part(surface, {"vertices": vertices}, "silhouette")


def loss(vertices):
    return (rts.render(ring_of(vertices), camera, size)[..., 3] ** 2).mean()


# %% [markdown]
# ## Twice its gradient
#
# torch keeps a graph and walks back. jax turns the function into another one that gives value and gradient; with
# `jax.jit` around it, many steps share one compiled program.

# %%
by_torch = torch.tensor(vertices, requires_grad=True)
value = loss(by_torch)
value.backward()
other, by_jax = jax.value_and_grad(loss)(jax.numpy.asarray(vertices))

by_torch, by_jax = by_torch.grad.numpy(), np.asarray(by_jax)
apart = np.abs(by_torch - by_jax).max() / np.abs(by_jax).max()
print(f"loss {value.item():.6f} by torch, {float(other):.6f} by jax; gradients differ by {apart:.1e} of the largest")

# %% [markdown]
# Left: the picture. Right: how vertices are pushed, as colours. Grey is where nothing pulls, which is everywhere but at
# outlines.

# %%
colors = 0.5 + 0.5 * by_torch / np.abs(by_torch).max()
pushed = rts.Part(surface, {"vertices": vertices, "colors": colors.astype(np.float32)}, "unlit")
shown = [rts.render(part, camera, size, background=(0, 0, 0)) for part in (ring_of(vertices), pushed)]
rts.save_image("torch_and_jax.png", np.concatenate(shown, axis=1))
Image.open("torch_and_jax.png").copy()

# %% [markdown]
# Arrays of torch and jax in one scene are an error. NumPy arrays may stand beside either, as constants.
