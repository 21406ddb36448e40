"""The picture of the guide "From photographs to a mesh": photographs of spot on a table, and the mesh made of them.

python docs/figures/photographs.py, with the variable RTS_DATA as for tests, and the extra `photos` of apps/reconstruct.
The photographs are renders, of which the command gets no camera and no mask.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import rts
from scipy.ndimage import zoom

IMAGES = Path(__file__).parents[1] / "images"
SPOT = Path(os.environ.get("RTS_DATA", Path(__file__).parents[3] / "shared" / "data")) / "meshes" / "spot"
COUNT, SIZE, SHOWN = 32, (540, 720), (2, 7, 18, 29)


def patches(seed: int, *cells: int) -> np.ndarray:
    """A texture of random patches, in several numbers along each side: what cameras can be found by."""
    random, texture = np.random.default_rng(seed), np.zeros((1024, 1024, 3), np.float32)
    for count in cells:
        texture += zoom(random.random((count, count, 3)), (1024 / count, 1024 / count, 1), order=1) / len(cells)
    return np.clip(3 * (texture - 0.5) + 0.5, 0, 1)


def photograph(folder: Path) -> None:
    """Write the photographs: two turns around a painted spot on a table, at two heights."""
    corners = np.float32([(-1.5, -0.74, -1.5), (1.5, -0.74, -1.5), (1.5, -0.74, 1.5), (-1.5, -0.74, 1.5)])
    uv, faces = np.float32([(0, 0), (1, 0), (1, 1), (0, 1)]), np.int32([(0, 2, 1), (0, 3, 2)])
    wood = np.float32([0.45, 0.3, 0.2]) * (0.5 + 0.5 * patches(1, 16, 64)[..., :1])
    table = rts.Part(rts.Mesh(faces), {"vertices": corners, "uv": uv, "texture": wood}, "textured")
    (spot,) = rts.load(SPOT / "spot_triangulated.obj")
    paint = rts.load_image(SPOT / "spot_texture.png")[..., :3] * (0.25 + 0.75 * patches(0, 32, 128, 256))
    scene = [table, spot.replace(theta={**spot.theta, "texture": paint})]
    for index in range(COUNT):
        angle, height = 4 * np.pi * index / COUNT, 0.7 if 2 * index < COUNT else 1.9
        eye = (3.2 * np.sin(angle), height, 3.2 * np.cos(angle))
        camera = rts.Camera.look_at(eye, (0, 0, 0), fov_y=45, aspect=SIZE[1] / SIZE[0])
        image = rts.render(scene, camera, SIZE, background=(0.5, 0.6, 0.7), supersample=2)
        rts.save_image(folder / f"{index:02}.png", image[..., :3])


def main() -> None:
    """Write photographs.png to docs/images."""
    with tempfile.TemporaryDirectory() as temporary:
        folder, out = Path(temporary, "photos"), Path(temporary, "out")
        folder.mkdir()
        photograph(folder)
        subprocess.run([sys.executable, "-m", "rts", "reconstruct", folder, "-o", out, "--quick"], check=True)
        views = {Path(view.name).stem: view for view in rts.load_views(out / "photographs", split="all")}
        mesh, rows = rts.load(out / "mesh.glb"), [[], []]
        for index in SHOWN:
            view = views[f"{index:02}"]
            rows[0].append(view.image[..., :3])
            rows[1].append(rts.render(mesh, view.camera, view.size, background=(1.0, 1.0, 1.0))[..., :3])
        height, width = min(x.shape[:2] for row in rows for x in row)
        inside = slice(9, height - 9), slice(9, width - 9)  # Undistorted pictures have a black rim.
        picture = np.concatenate([np.concatenate([x[inside] for x in row], axis=1) for row in rows])
        rts.save_image(IMAGES / "photographs.png", picture[::2, ::2])


if __name__ == "__main__":
    main()
