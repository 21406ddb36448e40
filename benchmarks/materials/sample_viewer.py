"""Models of glTF beside the pictures that Khronos' sample viewer makes of them, where the test data has these.

Cameras are those of the pictures, by eye. The viewer's light is another: compare shapes, maps, sides and reliefs, not
brightness. Pictures go to `out/materials/viewer`: ours, the viewer's, and Mitsuba's where `compare` has the model.

    python -m benchmarks.materials.sample_viewer
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np

import rts
from benchmarks.materials.compare import DATA, sky
from rts.shading import prefiltered, tonemap


class Picture(NamedTuple):
    """A model, the viewer's picture of it, and where its camera stands.

    Attributes:
        file: of the model.
        picture: of the viewer; "" where there is none.
        toward: the direction in which the camera is seen from the model.
        distance: of the camera, in radii of the model's ball.
        size: width and height of ours, pixels.
    """

    file: str
    picture: str
    toward: tuple[float, float, float]
    distance: float
    size: tuple[int, int]


PICTURES = (
    Picture("DamagedHelmet.glb", "DamagedHelmet.screenshot.png", (0.72, 0.12, 0.7), 1.85, (467, 451)),
    Picture("NormalTangentTest.glb", "NormalTangentTest.screenshot.png", (0, 0, 1), 1.73, (436, 424)),
    Picture("TextureSettingsTest.glb", "TextureSettingsTest.screenshot.png", (0, 0, 1), 1.7, (332, 325)),
    Picture("WaterBottle/WaterBottle.gltf", "WaterBottle.screenshot.jpg", (-0.5, 0.3, 0.85), 2.5, (260, 260)),
    Picture("BoxVertexColors.glb", "", (0.6, 0.5, 1), 2.6, (260, 260)),
)


def ours(one: Picture) -> np.ndarray:
    """Our picture (H, W, 3) of a model, in the light of a smooth sky, over grey, for a display."""
    parts = rts.load(DATA / "gltf" / one.file, cull="file")
    light = {"environment": prefiltered(2 * sky())}
    parts = [part.replace(theta={**part.theta, "light": light}) for part in parts]
    corners = np.concatenate([_placed(part) for part in parts])
    low, high = corners.min(axis=0), corners.max(axis=0)
    center, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
    away = np.array(one.toward) / np.linalg.norm(one.toward) * one.distance * radius
    camera = rts.Camera.look_at(center + away, center, fov_y=45, aspect=one.size[0] / one.size[1])
    image = rts.render(parts, camera, (one.size[1], one.size[0]), background=np.full(3, 0.04), supersample=2)
    return np.asarray(tonemap(image[..., :3]))


def _placed(part: rts.Part) -> np.ndarray:
    vertices = np.asarray(part.theta["vertices"], float)
    return vertices if part.transform is None else vertices @ part.transform[:3, :3].T + part.transform[:3, 3]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/materials/viewer"))
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    for one in PICTURES:
        images = [ours(one)]
        if one.picture:
            images.append(_stretched(rts.load_image(DATA / "gltf" / one.picture)[..., :3], one.size))
        path = args.output / f"{Path(one.file).stem}.png"
        rts.save_image(path, np.concatenate(images, axis=1).astype(np.float32))
        print(path, flush=True)


def _stretched(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The image (H, W, 3) in the size (width, height), texels repeated."""
    rows, columns = ((np.arange(n) * m // n) for n, m in zip(size[::-1], image.shape, strict=False))
    return np.asarray(image)[rows][:, columns]


if __name__ == "__main__":
    main()
