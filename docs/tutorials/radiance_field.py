# %% [markdown]
# # A radiance field as a surface
#
# A *radiance field* (NeRF) is a network that gives each place a density, and each place and direction a colour. A
# volume asks it hundreds of times along each ray. On a surface one question a sample is enough. We train the colours of
# such a network on a shiny ball, whose highlight moves as you do.

# %%
import os

import numpy as np
import rts
import torch
import trimesh
from PIL import Image

quick = "RTS_QUICK" in os.environ
size, count, width = ((24, 24), 15, 16) if quick else ((64, 64), 120, 32)

# %% [markdown]
# ## A shiny ball from eight sides

# %%
ball = trimesh.creation.icosphere(3)
surface, vertices = rts.Mesh(ball.faces), np.asarray(ball.vertices, np.float32)
angles = np.arange(9) * 0.35 - 1.4
eyes = np.stack([3 * np.sin(angles), 0.8 * np.cos(3 * angles), 3 * np.cos(angles)], axis=1)
cameras = [rts.Camera.look_at(eye, (0, 0, 0)) for eye in eyes]
shiny = {
    "vertices": vertices,
    "colors": (0.5 + 0.4 * np.sin(4 * vertices)).astype(np.float32),
    "light": {"direction": np.float32([0.2, 0.5, 1.0])},
    "specular": np.float32(0.5),
}
pictures = torch.as_tensor(rts.render_views(rts.Part(surface, shiny, "blinn_phong"), cameras, size))

# %% [markdown]
# ## A network of NeRF's form
#
# `rts.load_radiance_field("weights.npz")` reads trained ones. Here the weights are random. Places are described by
# three octaves of waves, directions by one.

# %%
rng = np.random.default_rng(0)


def layer(outputs, inputs):
    weight = rng.standard_normal((outputs, inputs)) * (2 / inputs) ** 0.5
    return {
        "weight": torch.tensor(weight, dtype=torch.float32, requires_grad=True),
        "bias": torch.zeros(outputs, requires_grad=True),
    }


weights = {
    "layer1": layer(width, 3 + 6 * 3),
    "layers_xyz": [layer(width, width)],
    "fc_alpha": layer(1, width),  # The density, which a surface does not ask for.
    "fc_feat": layer(width, width),
    "layers_dir": [layer(width, width + 3 + 6 * 1)],
    "fc_rgb": layer(3, width),
}
shader = rts.plugin("shaders", "radiance")()

# %% [markdown]
# ## Training
#
# The middle camera is held out: no picture of its highlight is seen. The other eight are the loss.


# %%
def images(cameras):
    return rts.render_views(rts.Part(surface, {"vertices": vertices, "weights": weights}, shader), cameras, size)


held_out, seen = 4, [0, 1, 2, 3, 5, 6, 7, 8]
several = [cameras[i] for i in seen]
layers = [x for entry in weights.values() for x in (entry if isinstance(entry, list) else [entry])]
optimizer = torch.optim.Adam([x for each in layers for x in each.values()], lr=0.005)
start = images([cameras[held_out]])[0].detach().numpy()
for step in range(count):
    optimizer.zero_grad()
    loss = (images(several) - pictures[seen]).square().mean()
    loss.backward()
    optimizer.step()
    if step in (0, count - 1):
        print(f"step {step}: loss {loss:.5f}")

# %% [markdown]
# The view that was held out: before training, after, and the truth. The colours are there. Of the highlight, which
# depends on the direction, there is little yet.

# %%
shown = [start, images([cameras[held_out]])[0].detach().numpy(), pictures[held_out].numpy()]
rts.save_image("radiance_field.png", np.concatenate(shown, axis=1))
Image.open("radiance_field.png").copy()

# %% [markdown]
# ## From a trained field
#
# Density on a lattice is an isosurface, and the shader asks the same network for colours:
#
# ```py
# field = rts.load_radiance_field("lego.npz")
# bounds, shape = ((-0.705, -1.18, -0.53), (0.705, 1.18, 1.07)), (77, 128, 87)
# theta = {"values": field.lattice(bounds, shape), "weights": field.weights["fine"]}  # The lattice is kept on disk.
# surface = rts.plugin("surfaces", "isosurface")(bounds, 50.0, inside="above")
# image = rts.render(rts.Part(surface, theta, rts.plugin("shaders", "radiance")()), camera, (400, 400))
# ```
#
# `field.volume_render` draws it as a volume, to compare with.
# `benchmarks/paper/snerf.py` refines lattice and network together ([measured](../results/radiance-field.md)).
