# %% [markdown]
# # Texture
#
# Four pictures show a bent sheet with a pattern. The shape is known; the pattern is wanted. A *texture* is an image
# that lies on a surface, and *uv* says which place of it each vertex has.

# %%
import os

import numpy as np
import rts
import torch
from PIL import Image

quick = "RTS_QUICK" in os.environ
size, count = ((40, 40), 15) if quick else ((96, 96), 100)

# %% [markdown]
# ## The sheet
#
# A grid of vertices, two triangles a square.

# %%
v, u = np.mgrid[0:1:17j, 0:1:17j].astype(np.float32)
vertices = np.stack([2 * u - 1, 2 * v - 1, 0.4 * np.sin(4 * u)], axis=-1).reshape(-1, 3)
index = np.arange(17 * 17).reshape(17, 17)
a, b, c, d = (x.reshape(-1) for x in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
uv = np.stack([u, v], axis=-1).reshape(-1, 2)


def scene(texture):
    return rts.Part(rts.Mesh(faces), {"vertices": vertices, "uv": uv, "texture": texture}, "textured")


# %% [markdown]
# ## Four pictures

# %%
rows, columns = np.indices((32, 32)) // 8
truth = np.where(((rows + columns) % 2)[..., None], (0.9, 0.6, 0.1), (0.1, 0.2, 0.5)).astype(np.float32)
cameras = [rts.Camera.look_at((x, y, 3), (0, 0, 0)) for x, y in ((-1, -1), (1, -1), (-1, 1), (1, 1))]
pictures = torch.as_tensor(rts.render_views(scene(truth), cameras, size))

# %% [markdown]
# ## The fit
#
# The texture has 32 × 32 × 3 numbers. Adam takes many cheap steps, which suits so many unknowns. The start is grey.


# %%
def residuals(texture):
    return rts.render_views(scene(texture), cameras, size) - pictures


grey = torch.full((32, 32, 3), 0.5)
fit = rts.fit(residuals, grey, method="adam", steps=count, learning_rate=0.05, progress=False)
print(f"loss {fit.history[0]:.4f} → {fit.loss:.6f}")

# %% [markdown]
# From left to right: the texture that was found, the true one, the sheet from the first camera.

# %%
view = np.asarray(rts.render(scene(fit.parameters), cameras[0], (128, 128), background=(0, 0, 0)))[..., :3]
large = [np.kron(np.clip(x, 0, 1), np.ones((4, 4, 1))) for x in (fit.parameters.numpy(), truth)]
rts.save_image("texture.png", np.concatenate([*large, view], axis=1))
Image.open("texture.png").copy()

# %% [markdown]
# ## If texels stay grey
#
# A texel that no picture shows has no gradient. Where texels are smaller than pixels, single samples miss most of them:
# the shader `rts.plugin("shaders", "textured")(mip=True)` averages them, and each then has a gradient.
