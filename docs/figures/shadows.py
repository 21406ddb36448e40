"""The picture of the guide "Shadows": a distant light, an area light, and how shadows change with its direction.

python docs/figures/shadows.py
"""

from pathlib import Path

import numpy as np
import rts
import torch
import trimesh

IMAGES = Path(__file__).parents[1] / "images"
CAMERA = rts.Camera.look_at((1.6, 3.2, 5.2), (0, 0.1, 0), fov_y=36)
SIZE, PIXELS = (280, 330), 1024


def scene() -> list[rts.Part]:
    """A knot, a ball of glass and a field, over a floor."""
    floor = np.array([[-3, -0.8, -3], [-3, -0.8, 3], [3, -0.8, 3], [3, -0.8, -3]], np.float32)
    turn, across = np.meshgrid(np.linspace(0, 2 * np.pi, 240), np.linspace(0, 2 * np.pi, 24), indexing="ij")
    way = np.stack([np.cos(3 * turn), np.sin(3 * turn), 0 * turn], axis=-1)
    around = (0.5 + 0.2 * np.cos(2 * turn))[..., None] * way + 0.2 * np.sin(2 * turn)[..., None] * np.array([0, 0, 1.0])
    knot = around + 0.09 * (np.cos(across)[..., None] * way + np.sin(across)[..., None] * np.array([0, 0, 1.0]))
    i, j = np.meshgrid(np.arange(239), np.arange(23), indexing="ij")
    quads = [(24 * (i + a) + j + b).ravel() for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
    faces = np.concatenate([np.stack([quads[k] for k in order], axis=1) for order in ((0, 1, 2), (0, 2, 3))])
    ball = trimesh.creation.icosphere(4, radius=0.4)
    glass = rts.plugin("rts.shaders", "blinn_phong")(opaque=False)

    def part(faces, vertices, color, shader="lambert"):
        theta = {"vertices": np.asarray(vertices, np.float32), "color": np.asarray(color, np.float32)}
        return rts.Part(rts.Mesh(faces), theta, shader)

    return [
        part([[0, 1, 2], [0, 2, 3]], floor, (0.85, 0.85, 0.85)),
        part(faces, knot.reshape(-1, 3) + np.array([-0.7, 0, 0]), (0.9, 0.45, 0.3)),
        part(ball.faces, ball.vertices + np.array([0.9, -0.35, 0.5]), (0.4, 0.7, 0.9, 0.45), glass),
    ]


def drawn(light: dict) -> np.ndarray:
    """The scene in a light (280, 330, 4)."""
    return rts.render(rts.shadows.with_shadows(scene(), light, size=PIXELS), CAMERA, SIZE, background=(1, 1, 1))


def area() -> np.ndarray:
    """The scene in the light of 16 places: their shadows are averaged."""
    places = np.array([2.4, 3.6, 1.2]) + 0.35 * np.array([(i, 0, j) for i in range(-2, 2) for j in range(-2, 2)])
    near = {"position": places.mean(0), "intensity": np.full(3, 16.0)}
    records = [
        rts.shadows.with_shadows(scene(), {"position": p}, size=PIXELS)[0].theta["light"]["shadow"][0] for p in places
    ]
    light = {**near, "ambient": np.array(0.25), "shadow": [records]}
    parts = [part.replace(theta={**part.theta, "light": light}) for part in scene()]
    return rts.render(parts, CAMERA, SIZE, background=(1, 1, 1))


def changed(direction: np.ndarray) -> np.ndarray:
    """The derivative in the light's x: red where the image brightens, blue where it darkens."""

    def brightness(x: torch.Tensor) -> torch.Tensor:
        light = {"direction": torch.stack([x, *torch.tensor(direction[1:])]), "ambient": 0.25}
        return rts.render(rts.shadows.with_shadows(scene(), light, size=PIXELS), CAMERA, SIZE)[..., :3].mean(-1)

    x = torch.tensor(float(direction[0]))
    slope = torch.func.jvp(brightness, (x,), (torch.ones_like(x),))[1].numpy()
    strength = np.clip(slope / 6, -1, 1)[..., None]
    return np.where(strength > 0, 1 - strength * np.array([0.1, 0.8, 0.8]), 1 + strength * np.array([0.8, 0.6, 0.1]))


def main() -> None:
    """Write shadows.png to docs/images."""
    direction = np.array([0.7, 1.0, 0.35], np.float32)
    first = drawn({"direction": direction, "ambient": np.array(0.25, np.float32)})
    pictures = [np.asarray(image)[..., :3] for image in (first, area(), changed(direction))]
    rts.save_image(IMAGES / "shadows.png", np.concatenate(pictures, axis=1))


if __name__ == "__main__":
    main()
