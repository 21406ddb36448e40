# %% [markdown]
# # Topology that changes
#
# Vertices can move, but a ball of triangles never gets a hole. Values on a lattice can: the surface is where they are
# zero. Here a ball becomes a ring, as four pictures ask.

# %%
import os

import numpy as np
import rts
import torch
from PIL import Image

quick = "RTS_QUICK" in os.environ
size, count, points = ((24, 24), 15, 12) if quick else ((64, 64), 200, 24)

# %% [markdown]
# ## Ball and ring, as values
#
# Each lattice point holds its distance to the surface: below zero inside, above zero outside. `rts.Isosurface` draws
# the zero level of such values.

# %%
axes = np.linspace(-1.2, 1.2, points, dtype=np.float32)
x, y, z = np.meshgrid(axes, axes, axes, indexing="ij")
ball = np.sqrt(x * x + y * y + z * z) - 0.85
ring = np.sqrt((np.sqrt(x * x + y * y) - 0.75) ** 2 + z * z) - 0.3
surface = rts.Isosurface(((-1.2, -1.2, -1.2), (1.2, 1.2, 1.2)))
cameras = [rts.Camera.look_at(eye, (0, 0, 0)) for eye in ((0, 0, 3.5), (0.3, 0, -3.5), (2, 2, 2.5), (-2, 1, -2.5))]


def images(values):
    return rts.render_views(rts.Part(surface, {"values": values}, "normals"), cameras, size)


pictures = torch.as_tensor(images(ring))

# %% [markdown]
# ## The fit
#
# The loss is the difference of the pictures, and a little for values that are not smooth: most lattice points are on no
# surface, and no picture tells about them.

# %%
values = torch.tensor(ball, requires_grad=True)
optimizer = torch.optim.Adam([values], lr=0.02)
for step in range(count):
    optimizer.zero_grad()
    loss = 4 * (images(values) - pictures).square().mean()
    smooth = sum(torch.diff(values, n=2, dim=axis).square().mean() for axis in range(3))
    (loss + 20 * smooth).backward()
    optimizer.step()
    if step in (0, count - 1):
        print(f"step {step}: loss {loss:.5f}")

# %% [markdown]
# From left to right: the ball, the shape that was found, the ring.

# %%
shown = [np.asarray(images(v)[0]) for v in (ball, values.detach().numpy(), ring)]
rts.save_image("topology.png", np.concatenate(shown, axis=1))
Image.open("topology.png").copy()

# %% [markdown]
# ## How a hole begins
#
# The middle of the ball looks wrong from the front: its normals face you, where the target has nothing. The gradient
# pushes the surface in, from both sides, until front and back meet. Then there is a hole, and no step was special.
