"""COLMAP's sparse models, the tables cameras, images and points3D, read from text and from binary files.

Source: COLMAP's documentation, "Output Format". Binary numbers are little-endian; counts have 64 bits. What images list
of their keypoints is passed over: each point lists the images that see it.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rts.errors import InputError
from rts.files.damaged_files import contents, lines_of, unreadable
from rts.files.views.lenses import MODELS, Lens, check_model, lens_of

IDS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
)
"""Camera models by their numbers in binary files."""
KEYPOINT, SEEN = 24, 8
"""Bytes of a keypoint, and of an image that sees a point."""


class Entry(NamedTuple):
    """A picture: its name, the camera's number, its own, and the pose (R (3, 3), t (3,)) of world-to-camera."""

    image: int
    camera: int
    name: str
    rotation: np.ndarray
    translation: np.ndarray


class Points(NamedTuple):
    """Points (N, 3), world, and which image sees which: numbers of images (M,), and rows of the points (M,)."""

    positions: np.ndarray
    images: np.ndarray
    rows: np.ndarray


def read_cameras(path: Path) -> dict[int, tuple[Lens, tuple[int, int]]]:
    """Lens and size (height, width) of each camera, by its number.

    Raises:
        InputError: the file is damaged, or a model is not followed.
    """
    cameras = {}
    for number, model, width, height, parameters in (_binary_cameras if _is_binary(path) else _text_cameras)(path):
        place = f"{path}, camera {number}"
        lens = lens_of(place, model, parameters)
        if not (0 < width < 2**31 and 0 < height < 2**31):
            raise InputError(f"{place} has {width} × {height} pixels; expected positive numbers")
        cameras[number] = lens, (height, width)
    return cameras


def read_entries(path: Path) -> list[Entry]:
    """The pictures, in the file's order.

    Raises:
        InputError: the file is damaged.
    """
    entries = []
    for number, pose, camera, name in (_binary_images if _is_binary(path) else _text_images)(path):
        quaternion, translation = np.array(pose[:4]), np.array(pose[4:])
        length = float(np.linalg.norm(quaternion))
        if not (math.isfinite(length) and length > 1e-8 and np.isfinite(translation).all()):
            raise InputError(f"{path}, image {number} has the pose {list(pose)}; expected a quaternion and a position")
        entries.append(Entry(number, camera, name, _rotation(quaternion / length), translation))
    return entries


def read_points(path: Path) -> Points:
    """The points, and the images that see them.

    Raises:
        InputError: the file is damaged.
    """
    positions, seen = [], []
    for position, images in (_binary_points if _is_binary(path) else _text_points)(path):
        positions.append(position)
        seen.append(images)
    rows = np.repeat(np.arange(len(seen)), [len(images) for images in seen])
    images = np.concatenate(seen) if seen else np.zeros(0, np.int64)
    return Points(np.array(positions, np.float64).reshape(-1, 3), images, rows)


def _is_binary(path: Path) -> bool:
    return path.suffix.lower() == ".bin"


def _rotation(q: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) of a unit quaternion (w, x, y, z), Hamilton's."""
    w, v = q[0], q[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


# ------------------------------------------------------------------------------------------------------------- binary


class _Bytes:
    """The bytes of a file, and the place in them; files that end early, or do not end, are refused."""

    def __init__(self, path: Path):
        self.path, self.data, self.place = path, contents(path), 0

    def take(self, layout: str) -> tuple:
        try:
            values = struct.unpack_from(f"<{layout}", self.data, self.place)
        except struct.error:
            raise self.damaged("it ends early") from None
        self.place += struct.calcsize(f"<{layout}")
        return values

    def skip(self, count: int) -> bytes:
        start, self.place = self.place, self.place + count
        if self.place > len(self.data):
            raise self.damaged("it ends early")
        return self.data[start : self.place]

    def entries(self) -> Iterator[int]:
        (count,) = self.take("Q")
        yield from range(count)
        if self.place < len(self.data):
            raise self.damaged(f"{len(self.data) - self.place} bytes follow its {count} entries")

    def damaged(self, what: str) -> InputError:
        return unreadable(self.path, "COLMAP's binary", what)


def _binary_cameras(path: Path) -> Iterator[tuple[int, str, int, int, list[float]]]:
    data = _Bytes(path)
    for _ in data.entries():
        number, kind, width, height = data.take("IiQQ")
        model = IDS[kind] if 0 <= kind < len(IDS) else f"number {kind}"
        check_model(f"{path}, camera {number}", model)  # Whose number of parameters is not known.
        yield number, model, width, height, list(data.take(f"{len(MODELS[model].split())}d"))


def _binary_images(path: Path) -> Iterator[tuple[int, tuple, int, str]]:
    data = _Bytes(path)
    for _ in data.entries():
        number, *pose, camera = data.take("I7dI")
        end = data.data.find(b"\0", data.place)
        if end < 0:
            raise data.damaged("it ends early")
        name = data.skip(end + 1 - data.place)[:-1].decode("utf-8", "replace")
        data.skip(KEYPOINT * data.take("Q")[0])
        yield number, tuple(pose), camera, name


def _binary_points(path: Path) -> Iterator[tuple[tuple, np.ndarray]]:
    data = _Bytes(path)
    for _ in data.entries():
        _, *position, _, _, _, _, count = data.take("Q3d3BdQ")
        seen = np.frombuffer(data.skip(SEEN * count), "<u4")
        yield tuple(position), seen[::2].astype(np.int64)


# --------------------------------------------------------------------------------------------------------------- text


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines that are not comments, with their numbers; empty ones are passed over."""
    for number, line in enumerate(lines_of(contents(path)), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line


def _damaged(path: Path, number: int, expected: str) -> InputError:
    return unreadable(path, "COLMAP's text", f"line {number} is not {expected}")


def _text_cameras(path: Path) -> Iterator[tuple[int, str, int, int, list[float]]]:
    for number, line in _lines(path):
        words = line.split()
        try:
            yield int(words[0]), words[1], int(words[2]), int(words[3]), [float(word) for word in words[4:]]
        except (ValueError, IndexError):
            raise _damaged(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from None


def _text_images(path: Path) -> Iterator[tuple[int, tuple, int, str]]:
    lines = enumerate(lines_of(contents(path)), start=1)
    for number, line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        words = line.split(maxsplit=9)
        try:
            pose, name = tuple(float(word) for word in words[1:8]), words[9].strip()
            entry = int(words[0]), pose, int(words[8]), name
        except (ValueError, IndexError):
            raise _damaged(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME") from None
        following = next(lines, None)  # Of keypoints, and empty if there are none.
        if following is not None and len(following[1].split()) % 3:
            raise _damaged(path, following[0], "X Y POINT3D_ID of keypoints")
        yield entry


def _text_points(path: Path) -> Iterator[tuple[tuple, np.ndarray]]:
    for number, line in _lines(path):
        words = line.split()
        try:
            position, seen = tuple(float(word) for word in words[1:4]), [int(word) for word in words[8::2]]
            if len(words) < 8 or len(words) % 2:
                raise ValueError
        except ValueError:
            raise _damaged(path, number, "POINT3D_ID X Y Z R G B ERROR and pairs of a track") from None
        yield position, np.array(seen, np.int64)
