# %% [markdown]
# # A surface of your own
#
# rts knows surfaces only by a few methods. A class that has them is a surface, and goes with every shader, splatter and
# engine. Here it is an ellipsoid, and its three radii are fitted to one picture.

# %%
import os

import numpy as np
import rts
import torch
from PIL import Image
from rts.plugin_api.arrays import namespace
from rts.plugin_api.bases import GBuffer, RaySurface
from rts.plugin_api.records import RayHits

size = (32, 32) if "RTS_QUICK" in os.environ else (160, 160)

# %% [markdown]
# ## Two methods
#
# `intersect` finds where rays meet the surface. It is not differentiated, so it may do what it likes. It gives K hits a
# ray, nearest first, and *parameters* that tell each point from all others: here a point of the unit sphere.
#
# `evaluate` says where these points are, from θ. It is what is differentiated. The parameters stay, the radii change:
# so the derivative is that of a point which sticks to the surface.


# %%
class Ellipsoid(RaySurface):
    """θ["radii"] (3,) are its half axes. A sample is a point (3,) of the unit sphere, stretched by them."""

    sample_widths = (0, 3)  # No integers, three reals a sample.

    def evaluate(self, theta, samples):
        gbuffer = GBuffer(position=theta["radii"] * samples.params)
        gbuffer.defer("normal", lambda: samples.params / theta["radii"])
        return gbuffer

    def intersect(self, theta, origins, directions, layers):
        xp, radii = namespace(origins), theta["radii"]
        start, along = origins / radii, directions / radii
        square = xp.sum(along * along, axis=-1)
        middle = -xp.sum(start * along, axis=-1) / square
        nearest = start + middle[:, None] * along
        inside = 1 - xp.sum(nearest * nearest, axis=-1)
        half = xp.sqrt(xp.where(inside > 0, inside, 0.0) / square)
        # The camera is outside: the first hit enters, the second leaves, and there are no more.
        distance = xp.stack([middle - half, middle + half, *[middle] * (layers - 2)][:layers])
        hit = xp.stack([inside > 0, inside > 0, *[inside > 2] * (layers - 2)][:layers])
        return RayHits(hit=hit, distance=distance, params=start + distance[..., None] * along)


# %% [markdown]
# ## A picture, and a fit to it

# %%
camera = rts.Camera.look_at((1.5, 1, 3), (0, 0, 0))


def scene(radii):
    return rts.Part(Ellipsoid(), {"radii": radii}, "normals")


start, truth = np.array([0.7, 0.7, 0.7], np.float32), np.array([1.2, 0.5, 0.8], np.float32)
before, target = (np.asarray(rts.render(scene(radii), camera, size)) for radii in (start, truth))
fit = rts.fit(rts.ImageResiduals(scene, camera, size, target), torch.tensor(start), method="lm", progress=False)
print("found", fit.parameters.numpy().round(3), "true", truth, "loss", fit.loss)

# %% [markdown]
# From left to right: the start, the ellipsoid that was found, the target.

# %%
found = np.asarray(rts.render(scene(fit.parameters.numpy()), camera, size))
rts.save_image("plugin.png", np.concatenate([before, found, target], axis=1))
Image.open("plugin.png").copy()

# %% [markdown]
# ## A name for it
#
# `rts new surface blob` writes such a class as a package, with a test that checks its derivatives. Then
# `rts.plugin("surfaces", "blob")` finds it, and so does the command line. [Writing a plugin](../plugins.md) goes on
# from here.
