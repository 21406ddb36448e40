"""The picture of the guide "Robots": the Panda in four poses, and its masks with the robot over them, calibrated.

python docs/figures/robots.py, with the packages rts-robot and example-robot-data
"""

import sys
from pathlib import Path

import numpy as np
import rts
from rts_robot import calibrate
from rts_robot.report import overlay

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
from benchmarks.robots import mask_of, panda, spoilt  # noqa: E402

SIZE = (192, 256)
VALUES = np.array(
    [
        [0.3, -0.5, 0.2, -2.0, 0.3, 1.8, 0.6, 0.03],
        [-0.6, 0.2, 0.5, -1.5, -0.4, 2.2, 0.0, 0.0],
        [0.9, 0.4, -0.6, -1.9, 0.8, 1.6, 1.2, 0.02],
        [-0.1, -0.9, -0.3, -2.4, 0.2, 2.6, -0.5, 0.04],
    ]
)


def main() -> None:
    """Write robots.png to docs/images."""
    robot, rng = panda(), np.random.default_rng(0)
    camera = rts.Camera.look_at((1.5, 0.9, 0.9), (0.1, 0, 0.45), (0, 0, 1), fov_y=42, aspect=SIZE[1] / SIZE[0])
    light = {"direction": np.float32([0.5, -0.2, 1]), "color": np.full(3, 0.8, np.float32), "ambient": np.full(3, 0.35)}
    drawn = []
    for q in VALUES:
        parts = [part.replace(theta={**part.theta, "light": light}) for part in robot.parts(q, "lambert")]
        drawn.append(rts.render(parts, camera, SIZE, background=(1, 1, 1), supersample=2)[..., :3])
    masks = np.array([spoilt((mask_of(robot, q, camera, SIZE, 3) > 0.5) * 1.0, rng, 3) for q in VALUES])
    found = calibrate(robot, masks, VALUES, camera.to_opencv(SIZE)[0], progress=False)
    print(found)
    over = [overlay(robot, found, mask, number) for number, mask in enumerate(masks)]
    rows = [np.concatenate(row, axis=1) for row in (drawn, over)]
    rts.save_image(ROOT / "docs" / "images" / "robots.png", np.concatenate(rows))


if __name__ == "__main__":
    main()
