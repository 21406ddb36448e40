"""Real meshes under every shader, one sheet a mesh.

Measures nothing: it writes pictures to be looked at.

    python -m benchmarks.contact_sheets -o out/sheets
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import rts
from benchmarks.meshes import DATA
from rts.errors import InputError
from rts.scene.default_camera import bounds_of, orbit

MODELS = {
    "bunny": "meshes/bunny.obj",
    "teapot": "meshes/teapot.obj",
    "spot": "meshes/spot/spot_triangulated.obj",
    "nefertiti": "meshes/nefertiti.obj",
    "airplane": "ycb_airplane/textured.obj",
}
VIEWS = {"spot": (150, 15), "nefertiti": (30, 5), "airplane": (150, 30)}
Z_UP = ("nefertiti", "airplane")
SIZE = (256, 256)
SPOT_TEXTURE = "spot_texture.png"


def load(name: str) -> list[rts.Part]:
    parts = rts.load(DATA / MODELS[name])
    if name == "spot":
        # Its files do not name the texture, which lies beside them.
        texture = rts.load_image(DATA / "meshes" / "spot" / SPOT_TEXTURE)[..., :3]
        parts = [p.replace(theta={**p.theta, "texture": texture}, shader="textured") for p in parts]
    if name in Z_UP:
        upright = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
        parts = [p.replace(transform=upright) for p in parts]
    return parts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/sheets"))
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    for name in MODELS:
        parts = load(name)
        bounds = bounds_of(parts)
        camera = orbit(bounds, SIZE, *VIEWS.get(name, (20, 15)))
        tiles = []
        for shader in rts.plugins("rts.shaders"):
            shaded = [p.replace(shader=shader) for p in parts]
            if shader == "depth":
                distance = np.linalg.norm(np.linalg.inv(camera.view)[:3, 3] - bounds.center)
                extent = np.array([distance - bounds.radius, distance + bounds.radius])
                shaded = [p.replace(theta={**p.theta, "depth_range": extent}) for p in shaded]
            try:
                image = rts.render(shaded, camera, SIZE, background=(0.08, 0.08, 0.1))
            except InputError as error:  # A mesh without texture has no textured picture.
                image = np.zeros((*SIZE, 3))
                print(f"{name}, {shader}: {error}")
            tile = Image.fromarray((np.clip(image[..., :3], 0, 1) ** (1 / 2.2) * 255).astype(np.uint8))
            ImageDraw.Draw(tile).text((6, 4), f"{name}: {shader}", fill=(255, 255, 255))
            tiles.append(np.asarray(tile))
        tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % 4)
        rows = [np.concatenate(tiles[i : i + 4], axis=1) for i in range(0, len(tiles), 4)]
        Image.fromarray(np.concatenate(rows)).save(args.output / f"{name}.png")
        print(f"wrote {args.output / name}.png")


if __name__ == "__main__":
    main()
