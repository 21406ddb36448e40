# %% [markdown]
# # A pose from a mask
#
# Given: a model, and a picture that shows only where it is, its *mask*. Wanted: how the model is turned and shifted.
# A mask is all edge, so this needs the derivatives of silhouettes.

# %%
import os

import numpy as np
import rts
import torch
import trimesh
from PIL import Image

size = (48, 48) if "RTS_QUICK" in os.environ else (192, 192)

# %% [markdown]
# ## The model and its camera
#
# The model is a crooked block, so that no two turns of it look alike. A part without a shader is a silhouette: white
# where something is.

# %%
block = trimesh.creation.box((2, 1.2, 0.8))
vertices = block.vertices * (1 + np.random.default_rng(3).uniform(-0.3, 0.3, block.vertices.shape))
part = rts.Part(rts.Mesh(block.faces), {"vertices": vertices.astype(np.float32)})
camera = rts.Camera.look_at((1, 2, 4), (0, 0, 0))

# %% [markdown]
# ## The mask
#
# Here we make the mask ourselves, so that we know the answer. A file that is white on black is read without a change
# of its grey: `np.asarray(PIL.Image.open("mask.png").convert("L"), np.float32) / 255`, where 128 means that half of a
# pixel is covered. Of a cut-out that is transparent around take `rts.load_image("cut.png")[..., 3]`, its alpha. Do not
# take all four channels of an ordinary picture: its alpha is 1 everywhere, as if the shape filled it.
#
# A pose is six numbers: a rotation vector in radians, then a translation. `rts.rigid` makes a matrix of them.


# %%
def posed(pose):
    return part.replace(transform=rts.rigid(pose))


def picture(pose):
    return np.asarray(rts.render(posed(pose), camera, size))


truth = np.array([0.5, -0.3, 0.2, 0.2, 0.1, -0.3], np.float32)
target = picture(truth)

# %% [markdown]
# ## The fit
#
# `rts.ImageResiduals` is the difference of the render and the mask. Levenberg–Marquardt, `"lm"`, takes few, large
# steps. The schedule begins with few, blurred pixels: from them the direction is clear even when edges are far apart.

# %%
residuals = rts.ImageResiduals(posed, camera, size, target)
fit = rts.fit(residuals, torch.zeros(6), method="lm", schedule=rts.pyramid(size), progress=False)
print(fit)
print("found", fit.parameters.numpy().round(3), "true", truth)

# %% [markdown]
# From left to right: the start, the pose that was found, the mask; dark on white.

# %%
shown = [picture(np.zeros(6, np.float32)), picture(fit.parameters.numpy()), target]
rts.save_image("pose.png", 1 - np.concatenate(shown, axis=1)[..., 3])
Image.open("pose.png").copy()

# %% [markdown]
# ## If yours fails
#
# - The command does all of this for a file: `rts fit-pose model.obj mask.png`. It says whether the fit is good.
# - Something hides part of the model? Give `rts.ImageResiduals` a [robust
#   loss](../guides/fitting.md#targets-that-are-wrong-in-part).
# - The start is upside down? A fit goes downhill from where it starts: try several starts, and keep the least loss.
