# %% [markdown]
# # Materials and light
#
# Four pictures show a vase in a room. Its shape is known, and so is the light. How rough is it, and what colour? Then
# the vase goes to another light, which the pictures never showed.

# %%
import os
import tempfile
from pathlib import Path

import numpy as np
import rts
import torch
import trimesh
from PIL import Image
from rts.shading import prefiltered, turned_environment

quick = "RTS_QUICK" in os.environ
size, shown = ((32, 32), (64, 64)) if quick else ((96, 96), (224, 224))

# %% [markdown]
# ## A model from a file
#
# A profile turned about an axis is a vase. Written as glTF it has a material: a base colour, *metallic* and
# *roughness*. `rts.load` reads them, and gives the part the shader `pbr`.

# %%
heights = np.linspace(-1, 1, 60)
profile = np.stack([0.42 + 0.2 * np.sin(2.6 * heights + 0.6) - 0.12 * heights, heights], axis=1)
vase = trimesh.creation.revolve(profile, sections=96)
vase.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
material = trimesh.visual.material.PBRMaterial(
    baseColorFactor=(0.8, 0.35, 0.2, 1.0), metallicFactor=0.0, roughnessFactor=0.3, doubleSided=True
)
vase.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(vase.vertices), 2)), material=material)
with tempfile.TemporaryDirectory() as folder:
    vase.export(Path(folder) / "vase.glb")
    [part] = rts.load(Path(folder) / "vase.glb")
print(part.shader, *(f"{name} {part.theta[name]}" for name in ("color", "metallic", "roughness")))

# %% [markdown]
# ## The light of a room
#
# An *environment* is an image of all that surrounds a scene: walls, a floor, two windows. Numbers above 1 are brighter
# than white paper. `prefiltered` blurs it once for each roughness, since this light stays.

# %%
room = np.full((64, 128, 3), 0.25, np.float32)
room[:32], room[44:] = (0.35, 0.4, 0.45), (0.3, 0.2, 0.12)
room[14:32, 24:44], room[10:28, 82:100] = (6.0, 5.4, 4.4), (2.0, 3.2, 5.0)
light = {"environment": prefiltered(room)}
eyes = ((0, 0.6, 3.4), (3.2, 1, 0.6), (0, 1.6, -3), (-3, 0, 1))
cameras = [rts.Camera.look_at(eye, (0, 0, 0), fov_y=40) for eye in eyes]


def scene(looks, light):
    return part.replace(theta={**part.theta, **looks, "light": light})


pictures = torch.as_tensor(rts.render_views(scene({}, light), cameras, size))

# %% [markdown]
# ## The fit
#
# Four numbers are unknown: red, green, blue, and roughness. Levenberg–Marquardt takes few steps for so few. Roughness
# shows in how sharp the windows are on the vase, so the start should not be a mirror, nor quite dull.

# %%
start = {"color": torch.tensor([0.5, 0.5, 0.5]), "roughness": torch.tensor(0.6)}


def residuals(looks):
    return rts.render_views(scene(looks, light), cameras, size) - pictures


fit = rts.fit(residuals, start, method="lm", steps=15, progress=False)
found = {name: value.detach() for name, value in fit.parameters.items()}
print("found:", found["color"].numpy().round(3), f"roughness {found['roughness'].item():.3f}")
print("true: ", part.theta["color"].round(3), f"roughness {part.theta['roughness']:.3f}")

# %% [markdown]
# ## Another light
#
# `turned_environment` turns the room. A lamp and its shadow on a floor are one line more: `rts.shadows.with_shadows`.

# %%
turn = np.array([[-1, 0, 0], [0, 1, 0], [0, 0, -1]], np.float32)
corners = np.float32([[-3, -1, -3], [-3, -1, 3], [3, -1, 3], [3, -1, -3]])
floor = rts.Part(rts.Mesh([[0, 1, 2], [0, 2, 3]]), {"vertices": corners}, "pbr")
other = {
    "environment": 0.5 * turned_environment(room, turn),
    "direction": np.float32([0.8, 1.0, 0.7]),
    "color": np.float32([0.9, 0.8, 0.6]),
}


def relit(looks):
    looks = {name: np.asarray(value) for name, value in looks.items()}
    parts = rts.shadows.with_shadows([scene(looks, {}), floor], other)
    return rts.render(parts, cameras[0], shown, background=(1, 1, 1))


# %% [markdown]
# From left to right: the start, what was found, the truth. Above is the room, and below the other light.

# %%
looks = (start, found, {})
rows = [
    np.concatenate([np.asarray(image)[..., :3] for image in images], axis=1)
    for images in (
        [rts.render(scene(x, light), cameras[0], shown, background=(1, 1, 1)) for x in looks],
        [relit(x) for x in looks],
    )
]
rts.save_image("materials.png", np.concatenate(rows).clip(0, 1))
Image.open("materials.png").copy()

# %% [markdown]
# ## What pictures cannot tell
#
# Light and colour are a product: twice the light on half the colour is the same picture. So one of them must be known,
# or both are found up to a factor. *Metallic* is told from highlights: a metal's have its colour, others are white.
# In smooth light a fit may end at the wrong one, so begin with both: [measured](../results/materials.md).
