"""Data sets of posed pictures in COLMAP's format, written independently of its reader, and lenses by their formulas."""

import struct

import numpy as np
from PIL import Image

MODELS = {
    "SIMPLE_PINHOLE": (0, [90.0, 63.0, 49.5]),
    "PINHOLE": (1, [90.0, 84.0, 63.0, 49.5]),
    "SIMPLE_RADIAL": (2, [90.0, 63.0, 49.5, 0.1]),
    "RADIAL": (3, [90.0, 63.0, 49.5, -0.12, 0.03]),
    "OPENCV": (4, [90.0, 84.0, 63.0, 49.5, 0.12, 0.03, 0.004, -0.006]),
    "OPENCV_FISHEYE": (5, [90.0, 84.0, 63.0, 49.5, 0.03, -0.01, 0.004, -0.001]),
    "FULL_OPENCV": (6, [90.0, 84.0, 63.0, 49.5, 0.2, 0.05, 0.004, -0.006, 0.01, 0.3, 0.04, 0.002]),
}
"""COLMAP's numbers of models, and parameters for pictures of SIZE."""
SIZE = (96, 128)


def bent(model, parameters, x, y):
    """Pixels, by COLMAP's formulas, of camera coordinates over depth."""
    r2 = x * x + y * y
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        f, cx, cy, *k = parameters
        k1, k2 = (*k, 0.0, 0.0)[:2]
        d = 1 + k1 * r2 + k2 * r2**2
        return f * x * d + cx, f * y * d + cy
    fx, fy, cx, cy, *k = parameters
    if model == "OPENCV_FISHEYE":
        r = np.sqrt(r2)
        t = np.arctan2(r, 1)
        bend = (t + k[0] * t**3 + k[1] * t**5 + k[2] * t**7 + k[3] * t**9) / np.maximum(r, 1e-12)
        return fx * x * bend + cx, fy * y * bend + cy
    k1, k2, p1, p2, k3, k4, k5, k6 = (*k, *[0.0] * 8)[:8]
    d = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = x * d + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * d + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    return fx * u + cx, fy * v + cy


def straight(model, parameters, u, v):
    """Camera coordinates over depth of pixels: `bent` inverted by repetition."""
    fx, fy, cx, cy = (parameters[0], *parameters[:3]) if "SIMPLE" in model or model == "RADIAL" else parameters[:4]
    x, y = (u - cx) / fx, (v - cy) / fy
    for _ in range(200):
        a, b = bent(model, parameters, x, y)
        x, y = x - (a - u) / fx, y - (b - v) / fy
    return x, y


def quaternion(matrix):
    """(w, x, y, z) of a rotation by less than half a turn."""
    w = 0.5 * np.sqrt(1 + np.trace(matrix))
    return [
        w,
        *(np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / (4 * w)),
    ]


def binary_model(folder, cameras, images, points=()):
    """A binary model: cameras {number: (model, (height, width), parameters)}, images [(number, R, t, camera, name,
    keypoints (K, 2))], points [(xyz, [numbers of images that see it])]."""
    folder.mkdir(parents=True, exist_ok=True)
    data = struct.pack("<Q", len(cameras))
    for number, (model, (height, width), parameters) in cameras.items():
        kind = model if isinstance(model, int) else MODELS[model][0]
        data += struct.pack("<I", number) + struct.pack("<i", kind) + struct.pack("<QQ", width, height)
        data += np.array(parameters, "<f8").tobytes()
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(images))
    for number, rotation, translation, camera, name, keypoints in images:
        data += struct.pack("<I", number) + np.array([*quaternion(rotation), *translation], "<f8").tobytes()
        data += struct.pack("<I", camera) + name.encode() + b"\0" + struct.pack("<Q", len(keypoints))
        for x, y in keypoints:
            data += struct.pack("<ddq", x, y, -1)
    (folder / "images.bin").write_bytes(data)
    pieces = [struct.pack("<Q", len(points))]
    for i, (position, seen) in enumerate(points):
        pieces.append(struct.pack("<Q3d3BdQ", 7 * i + 1, *position, 10, 20, 30, 0.5, len(seen)))
        pieces += [struct.pack("<II", image, 3) for image in seen]
    (folder / "points3D.bin").write_bytes(b"".join(pieces))


def text_model(folder, cameras, images, points=()):
    """The model of `binary_model` as text."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, (model, (height, width), parameters) in cameras.items():
        rows.append(f"{number} {model} {width} {height} {' '.join(map(repr, parameters))}")
    (folder / "cameras.txt").write_text("\n".join(rows) + "\n")
    rows = ["# Image list with two lines of data per image:"]
    for number, rotation, translation, camera, name, keypoints in images:
        pose = " ".join(repr(float(x)) for x in [*quaternion(rotation), *translation])
        rows += [f"{number} {pose} {camera} {name}", " ".join(f"{x} {y} -1" for x, y in keypoints)]
    (folder / "images.txt").write_text("\n".join(rows) + "\n")
    rows = ["# 3D point list"]
    for i, (position, seen) in enumerate(points):
        track = "".join(f" {image} 3" for image in seen)
        rows.append(f"{7 * i + 1} {' '.join(repr(float(x)) for x in position)} 10 20 30 0.5{track}")
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")


def save(path, picture):
    """Write a picture: numbers in [0, 1] in 16 bits if (H, W), bytes as they are."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if picture.dtype != np.uint8:
        picture = np.round(65535 * picture).astype(np.uint16)
    Image.fromarray(picture).save(path)
