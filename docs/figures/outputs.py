"""The picture of docs/guides/outputs.md: a knot's colours, depth and normals. Run `python docs/figures/outputs.py`."""

from pathlib import Path

import numpy as np
import rts

IMAGE = Path(__file__).parents[1] / "images/outputs.png"


def knot(along=240, around=24, radius=0.55):
    """A tube around a trefoil: vertices and faces."""
    t = np.linspace(0, 2 * np.pi, along, endpoint=False)
    path = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=1)
    way = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    first = np.cross(way, path)
    second = np.cross(way, first)
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)[:, None]
    sides = [x[:, None] / np.linalg.norm(x, axis=1)[:, None, None] for x in (first, second)]
    vertices = path[:, None] + radius * (np.cos(angle) * sides[0] + np.sin(angle) * sides[1])
    i, j = (x.reshape(-1) for x in np.mgrid[:along, :around])
    corners = [(i + a) % along * around + (j + b) % around for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
    faces = np.concatenate([np.stack([corners[k] for k in order], axis=1) for order in ((0, 2, 1), (0, 3, 2))])
    return vertices.reshape(-1, 3), faces


def main():
    """Write the picture."""
    vertices, faces = knot()
    theta = {"vertices": vertices.astype(np.float32), "color": np.array([0.2, 0.45, 0.7], np.float32)}
    part = rts.Part(rts.Mesh(faces), theta, "lambert")
    camera = rts.Camera.look_at((3, 4, 9), (0, 0, 0), fov_y=40)
    found = rts.render(part, camera, (200, 220), outputs=("color", "depth", "normal", "alpha"), background=(1, 1, 1))
    alpha, depth = found["alpha"], found["depth"]
    near, far = depth[alpha > 0.5].min(), depth.max()
    grey = np.where(alpha > 0, 0.9 - 0.8 * (depth - near) / (far - near), 1.0) ** 2.2
    normal = np.where(alpha > 0, 0.5 * found["normal"] + 0.5, 1.0)
    color = found["color"][..., :3]
    rts.save_image(IMAGE, np.clip(np.concatenate([color, np.repeat(grey, 3, axis=-1), normal], axis=1), 0, 1))


if __name__ == "__main__":
    main()
