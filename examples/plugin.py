"""A surface of your own: an ellipsoid, met by rays, whose radii are fitted. Writes plugin.png: start, result, target.

`rts new surface NAME` writes such a class as a distribution, with a test; then it has a name, too.
"""

import sys

import numpy as np
import torch

import rts
from rts.plugin_api.records import RayHits

SIZE = (32, 32) if "--quick" in sys.argv else (160, 160)


class Ellipsoid(rts.RaySurface):
    """θ["radii"] (3,) are its half axes. A sample is a point (3,) of the unit sphere, stretched by them."""

    sample_widths = (0, 3)

    def evaluate(self, theta, samples):  # What is differentiated.
        gbuffer = rts.GBuffer(position=theta["radii"] * samples.params)
        gbuffer.defer("normal", lambda: samples.params / theta["radii"])
        return gbuffer

    def intersect(self, theta, origins, directions, layers):  # What is not.
        xp, radii = rts.namespace(origins), theta["radii"]
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


camera = rts.Camera.look_at((1.5, 1, 3), (0, 0, 0))


def scene(radii):
    return rts.Part(Ellipsoid(), {"radii": radii}, "normals")


start, truth = np.array([0.7, 0.7, 0.7], np.float32), np.array([1.2, 0.5, 0.8], np.float32)
pictures = {name: np.asarray(rts.render(scene(radii), camera, SIZE)) for name, radii in (("a", start), ("b", truth))}
fit = rts.fit(rts.ImageResiduals(scene, camera, SIZE, pictures["b"]), torch.tensor(start), method="lm", progress=False)
print("found", fit.parameters.numpy().round(3), "true", truth, "loss", fit.loss)
found = np.asarray(rts.render(scene(fit.parameters.numpy()), camera, SIZE))
rts.save_image("plugin.png", np.concatenate([pictures["a"], found, pictures["b"]], axis=1))
