# %% [markdown]
# # A neural shader
#
# A shader is a function, so it may be a network. Here a small one learns the colours of a ball from three pictures.

# %%
import os

import numpy as np
import rts
import torch
import trimesh
from PIL import Image

quick = "RTS_QUICK" in os.environ
size, count = ((32, 32), 30) if quick else ((96, 96), 400)
ball = trimesh.creation.icosphere(3)
surface, vertices = rts.Mesh(ball.faces), np.asarray(ball.vertices, np.float32)
cameras = [rts.Camera.look_at(eye, (0, 0, 0)) for eye in ((0, 0, 3), (3, 0, 0), (0, 3, 0.1))]

# %% [markdown]
# ## The colours to be learned
#
# A shader takes three arguments: θ, the dict of the part's numbers; the *G-buffer*, attributes of the surface at N
# points; and the camera. It gives colours (N, 4). `rts.namespace` finds the framework of an array, so that this one
# works with NumPy, torch and jax.


# %%
def stripes(theta, gbuffer, camera):
    xp = rts.namespace(gbuffer["position"])
    bright = 0.5 + 0.5 * xp.sin(5 * gbuffer["position"])
    return xp.concat([bright, xp.ones_like(bright[:, :1])], axis=-1)


pictures = torch.as_tensor(rts.render_views(rts.Part(surface, {"vertices": vertices}, stripes), cameras, size))

# %% [markdown]
# ## The network
#
# Its weights are numbers of the part, like vertices. So they belong into θ, and have derivatives from there.

# %%
torch.manual_seed(0)
network = torch.nn.Sequential(torch.nn.Linear(3, 48), torch.nn.SiLU(), torch.nn.Linear(48, 3), torch.nn.Sigmoid())


def learned(theta, gbuffer, camera):
    color = torch.func.functional_call(network, theta["weights"], (gbuffer["position"],))
    return torch.cat([color, torch.ones_like(color[:, :1])], dim=-1)


learned.opaque = True  # A promise that alpha is 1, which saves half of the time.


def images():
    theta = {"vertices": vertices, "weights": dict(network.named_parameters())}
    return rts.render_views(rts.Part(surface, theta, learned), cameras, size)


# %% [markdown]
# ## Training
#
# The network is asked once for each sample of the surface, not once for each pixel of a volume.

# %%
start, optimizer = images()[0].detach().numpy(), torch.optim.Adam(network.parameters(), lr=0.02)
for step in range(count):
    optimizer.zero_grad()
    loss = (images() - pictures).square().mean()
    loss.backward()
    optimizer.step()
    if step in (0, count - 1):
        print(f"step {step}: loss {loss:.5f}")

# %% [markdown]
# From left to right: before training, after, the target.

# %%
shown = [start, images()[0].detach().numpy(), pictures[0].numpy()]
rts.save_image("network_shader.png", np.concatenate(shown, axis=1))
Image.open("network_shader.png").copy()

# %% [markdown]
# More on such functions, and on images of any number of channels: [shaders of your own](../guides/shaders.md).
