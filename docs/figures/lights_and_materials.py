"""The picture of the guide "Lights and materials": spheres, metallic × roughness, in a lamp's light and in a room's.

python docs/figures/lights_and_materials.py
"""

from pathlib import Path

import numpy as np
import rts
import trimesh
from rts.shading import prefiltered

IMAGES = Path(__file__).parents[1] / "images"
COLUMNS = (0.1, 0.25, 0.4, 0.6, 0.8, 1.0)
"""Roughnesses; rows are metallic 0 and 1."""


def room(height: int = 64) -> np.ndarray:
    """An image of a room (64, 128, 3): walls, floor, two windows and a lamp."""
    image = np.full((height, 2 * height, 3), 0.25)
    image[: height // 2] = (0.35, 0.4, 0.45)
    image[44:] = (0.3, 0.2, 0.12)
    image[14:32, 24:44] = (2.4, 2.2, 1.8)
    image[10:28, 82:100] = (1.0, 1.6, 2.4)
    image[4:9, 50:78] = 2.2
    return image.astype(np.float32)


def spheres(light: dict) -> np.ndarray:
    """The rows of spheres in a light (256, 720, 4)."""
    ball = trimesh.creation.icosphere(5, radius=0.44)
    surface, vertices = rts.Mesh(ball.faces), np.asarray(ball.vertices, np.float32)
    parts = [
        rts.Part(
            surface,
            {
                "vertices": vertices + np.array([i - 2.5, 0.5 - metallic, 0], np.float32),
                "normals": np.asarray(ball.vertex_normals, np.float32),
                "color": np.array([0.95, 0.6, 0.35], np.float32),
                "metallic": np.array(metallic, np.float32),
                "roughness": np.array(roughness, np.float32),
                "light": light,
            },
            "pbr",
        )
        for metallic in (0, 1)
        for i, roughness in enumerate(COLUMNS)
    ]
    camera = rts.Camera.look_at((0, 0, 9), (0, 0, 0), fov_y=2 * np.degrees(np.arctan(1.1 / 9)))
    return rts.render(parts, camera, (256, 720), background=(0.02, 0.02, 0.03))


def main() -> None:
    """Write lights_and_materials.png to docs/images."""
    lamp = {"direction": np.array([-0.5, 0.7, 0.6], np.float32), "color": np.full(3, 1.0, np.float32)}
    pictures = [spheres(lamp), spheres({"environment": prefiltered(room())})]
    rts.save_image(IMAGES / "lights_and_materials.png", np.concatenate(pictures), exposure=0.3)


if __name__ == "__main__":
    main()
