# %% [markdown]
# # A smooth surface through its control points
#
# Some shapes are smooth: a few *control points* pull a surface into form. Here the eight corners of a cube define a
# smooth blob, its *limit surface*. Three pictures tell where the control points of another blob are. We fit these 24
# numbers, and no triangle.

# %%
import os

import numpy as np
import rts
import torch
from PIL import Image

quick = "RTS_QUICK" in os.environ
size, count = ((32, 32), 4) if quick else ((128, 128), 12)

# %% [markdown]
# ## Cage and surface
#
# The cube's six faces with four corners each are the *cage*. `rts.Subdivision` is its Catmull–Clark limit. It needs
# OpenSubdiv's headers and a C++ compiler: Debian's `libosd-dev g++`.

# %%
cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
surface = rts.Subdivision(quads)

# %% [markdown]
# ## Three pictures of another blob
#
# The shader `"normals"` colours a point by the direction that it faces.

# %%
truth = (cube * [1.3, 0.8, 1.0] + 0.5 * np.random.default_rng(0).normal(size=cube.shape).clip(-1, 1)).astype(np.float32)
cameras = [rts.Camera.look_at(eye, (0, 0, 0)) for eye in ((0, 0.5, 5), (5, 0.5, 0), (0.5, 5, 0))]


def images(control):
    return rts.render_views(rts.Part(surface, {"vertices": control}, "normals"), cameras, size)


pictures = torch.as_tensor(images(truth))

# %% [markdown]
# ## The fit
#
# Few unknowns, so Levenberg–Marquardt. Triangles stand for the surface only while it is sampled. Samples are then moved
# onto the smooth surface itself, so nothing of the triangles is left in the result.

# %%
fit = rts.fit(lambda control: images(control) - pictures, torch.tensor(cube), method="lm", steps=count, progress=False)
off = np.abs(fit.parameters.numpy() - truth).max()
print(f"loss {fit.history[0]:.4f} → {fit.loss:.6f}; control points off by {off:.3f} at most")

# %% [markdown]
# From left to right: the start, the blob that was found, the target.

# %%
shown = [np.asarray(images(control)[0]) for control in (cube, fit.parameters.numpy(), truth)]
rts.save_image("subdivision_fit.png", np.concatenate(shown, axis=1))
Image.open("subdivision_fit.png").copy()

# %% [markdown]
# ## Further
#
# `rts.Bezier`, `rts.BSpline` and `rts.Revolution` are smooth surfaces, too, and need no compiler.
# `rts.load("cage.obj", surface="subdivision")` reads cages. [Surfaces](../reference/surfaces.md) has all of them.
