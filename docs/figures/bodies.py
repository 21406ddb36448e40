"""The picture of the guide "Bodies": a bar that a joint bends, and CesiumMan at times of its clip.

python docs/figures/bodies.py, with the variable RTS_DATA as for tests
"""

import os
from pathlib import Path

import numpy as np
import rts

IMAGES = Path(__file__).parents[1] / "images"
MODELS = Path(os.environ.get("RTS_DATA", Path(__file__).parents[3] / "shared" / "data")) / "gltf"
SIZE = (240, 180)
BACKGROUND = (1.0, 1.0, 1.0)


def bar(degrees: float, weight: float) -> np.ndarray:
    """The bar of `rts.Skinned.example`, bent, and widened by its morph target."""
    part = rts.Skinned.example()
    transforms = part.theta["joint_transforms"].copy()
    transforms[1] = rts.rigid([0, 0, np.radians(degrees), 0, 0, 0])
    theta = {**part.theta, "joint_transforms": transforms, "morph_weights": np.array([weight], np.float32)}
    camera = rts.Camera.look_at((0.6, 1, 5), (-0.2, 0, 0), fov_y=38, aspect=SIZE[1] / SIZE[0])
    return rts.render(part.replace(theta=theta), camera, SIZE, background=BACKGROUND, supersample=2)


def man(times: list[float]) -> list[np.ndarray]:
    """CesiumMan at some times of its clip, in seconds."""
    model = rts.load_model(MODELS / "CesiumMan.glb")
    camera = rts.Camera.look_at((2.2, 1.2, 2.4), (0, 0.75, 0), fov_y=32, aspect=SIZE[1] / SIZE[0])
    poses = [model.posed(model.pose(0, time)) for time in times]
    return [rts.render(parts, camera, SIZE, background=BACKGROUND, supersample=2) for parts in poses]


def main() -> None:
    """Write bodies.png to docs/images."""
    bars = [bar(degrees, weight) for degrees, weight in ((0, 0), (30, 0), (60, 0), (90, 0), (60, 1))]
    rows = [np.concatenate(row, axis=1) for row in (bars, man([0.0, 0.4, 0.8, 1.2, 1.6]))]
    rts.save_image(IMAGES / "bodies.png", np.concatenate(rows))


if __name__ == "__main__":
    main()
