"""Pictures of an ellipsoid from all around, which tests reconstruct."""

from functools import cache

import numpy as np
import trimesh

import rts

SIZE, DISTANCE, CENTER = 32, 4.0, np.array([3.0, -1.0, 2.0])
RADII = np.array([1.0, 0.75, 0.6])


def cameras(count=8):
    """Cameras all around CENTER."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    ways = np.stack([np.cos(angle) * np.sqrt(1 - z * z), z, np.sin(angle) * np.sqrt(1 - z * z)], axis=1)
    return [rts.Camera.look_at(CENTER + DISTANCE * way, CENTER, fov_y=40, aspect=1.0) for way in ways]


@cache
def ellipsoid():
    """An ellipsoid about CENTER, red at one end and blue at the other."""
    mesh = trimesh.creation.icosphere(4)
    colors = np.stack(
        [0.5 + 0.5 * mesh.vertices[:, 0], np.full(len(mesh.vertices), 0.3), 0.5 - 0.5 * mesh.vertices[:, 0]]
    )
    theta = {"vertices": (CENTER + RADII * mesh.vertices).astype(np.float32), "colors": colors.T.astype(np.float32)}
    return rts.Part(rts.Mesh(mesh.faces), theta, "unlit")


@cache
def images():
    """Pictures of the ellipsoid, (H, W, 4)."""
    return [np.asarray(rts.render(ellipsoid(), c, (SIZE, SIZE), supersample=2)).clip(0, 1) for c in cameras()]


def views(change=lambda image: image):
    """Views of the ellipsoid, whose images `change` makes."""
    both = zip(cameras(), images(), strict=True)
    return [rts.View(camera, change(image), name=f"{i}.png") for i, (camera, image) in enumerate(both)]


def written(folder):
    """A new folder of these pictures, as Blender has it."""
    folder.mkdir()
    for i, image in enumerate(images()):
        rts.save_image(folder / f"{i}.png", image)
    rts.save_views(folder / "transforms.json", views())
    return folder


def on_white(image):
    return image[..., :3] + 1 - image[..., 3:]
