"""COLMAP's sparse models, the tables cameras, images and points3D, read from text and from binary files.

Source: COLMAP's documentation, "Output Format". Binary numbers are little-endian; counts have 64 bits. What images list
of their keypoints is passed over: each point lists the images that see it.
"""

from __future__ import annotations

import struct
from collections.abc import Container, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rts.errors import InputError
from rts.files.damaged_files import COUNT, contents, is_plain, lines_of, unreadable
from rts.files.views.lenses import MODELS, Lens, check_model, lens_of
from rts.files.views.poses import DIGITS, LARGEST

IDS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
)
"""Camera models by their numbers in binary files."""
KEYPOINT, SEEN = 24, 8
"""Bytes of a keypoint, and of an image that sees a point."""


class ColmapImage(NamedTuple):
    """A picture: its name, the camera's number, its own, and the pose (R (3, 3), t (3,)) of world-to-camera."""

    image: int
    camera: int
    name: str
    rotation: np.ndarray
    translation: np.ndarray


class ColmapPoints(NamedTuple):
    """Points (N, 3), world, and which image sees which: numbers of images (M,), and rows of the points (M,)."""

    positions: np.ndarray
    images: np.ndarray
    rows: np.ndarray


def read_cameras(path: Path) -> dict[int, tuple[Lens, tuple[int, int]]]:
    """Lens and size (height, width) of each camera, by its number.

    Raises:
        InputError: the file is damaged, a number stands for two cameras, or a model is not followed.
    """
    cameras: dict[int, tuple[Lens, tuple[int, int]]] = {}
    for number, model, width, height, parameters in (_binary_cameras if _is_binary(path) else _text_cameras)(path):
        place = f"{path}, camera {number}"
        _refuse_repeated(place, number, cameras)
        cameras[number] = lens_of(place, model, parameters), (height, width)
    return cameras


def read_entries(path: Path) -> list[ColmapImage]:
    """The pictures, in the file's order.

    Raises:
        InputError: the file is damaged, or a number or a name stands for two pictures.
    """
    entries: dict[int, ColmapImage] = {}
    names: dict[str, int] = {}
    for number, pose, camera, name in (_binary_images if _is_binary(path) else _text_images)(path):
        place = f"{path}, image {number}"
        _refuse_repeated(place, number, entries)
        if name in names:
            raise InputError(
                f"{place} is of the picture {name[:60]!r}, as image {names[name]} is; expected one of them"
            )
        names[name] = number
        known = np.array(pose)
        length = float(np.linalg.norm(known[:4])) if (np.abs(known) <= LARGEST).all() else 0.0  # NaN is not.
        if length <= 1e-8:
            raise InputError(f"{place} has the pose {list(pose)}; expected a quaternion and a position")
        entries[number] = ColmapImage(number, camera, name, _rotation(known[:4] / length), known[4:])
    return list(entries.values())


def read_points(path: Path) -> ColmapPoints:
    """The points, and the images that see them.

    Raises:
        InputError: the file is damaged, or a number stands for two points.
    """
    known: dict[int, tuple] = {}
    seen = []
    for number, position, images in (_binary_points if _is_binary(path) else _text_points)(path):
        _refuse_repeated(f"{path}, point {number}", number, known)
        known[number] = position
        seen.append(images)
    positions = np.array(list(known.values()), np.float64).reshape(-1, 3)
    wrong = np.flatnonzero(~(np.abs(positions) <= LARGEST).all(axis=1))
    if len(wrong):
        raise InputError(
            f"{path}, point {list(known)[wrong[0]]} is at {positions[wrong[0]].tolist()}; expected numbers up to "
            f"{LARGEST:g}"
        )
    rows = np.repeat(np.arange(len(seen)), [len(images) for images in seen])
    images = np.concatenate(seen) if seen else np.zeros(0, np.int64)
    return ColmapPoints(positions, images, rows)


def _refuse_repeated(place: str, number: int, known: Container[int]) -> None:
    if number in known:
        raise InputError(f"{place} is there twice; expected each number once: export the model again")


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


def _binary_points(path: Path) -> Iterator[tuple[int, tuple, np.ndarray]]:
    data = _Bytes(path)
    for _ in data.entries():
        number, *position, _, _, _, _, count = data.take("Q3d3BdQ")
        seen = np.frombuffer(data.skip(SEEN * count), "<u4")
        yield number, tuple(position), seen[::2].astype(np.int64)


# --------------------------------------------------------------------------------------------------------------- text


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines that are not comments, with their numbers; empty ones are passed over."""
    for number, line in enumerate(lines_of(contents(path)), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line


def _number(word: str, bits: int = 32) -> int:
    """The number of a camera, an image or a point; a ValueError where COLMAP can have none of that kind."""
    number = int(word) if COUNT.fullmatch(word) and len(word) <= DIGITS + 2 else -1
    if not 0 <= number < 2**bits - 1:  # The last one is COLMAP's for none.
        raise ValueError(f"{word} is no number of {bits} bits")
    return number


def _real(word: str) -> float:
    """A number in ASCII; else a ValueError. Python's own rules take underscores, and digits of any script."""
    if "_" in word or not is_plain(word):
        raise ValueError(f"{word} is no number")
    return float(word)


def _damaged(path: Path, number: int, expected: str) -> InputError:
    return unreadable(path, "COLMAP's text", f"line {number} is not {expected}")


def _text_cameras(path: Path) -> Iterator[tuple[int, str, int, int, list[float]]]:
    for number, line in _lines(path):
        words = line.split()
        try:
            size = _number(words[2], 64), _number(words[3], 64)
            yield _number(words[0]), words[1], *size, [_real(word) for word in words[4:]]
        except (ValueError, IndexError):
            raise _damaged(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from None


def _text_images(path: Path) -> Iterator[tuple[int, tuple, int, str]]:
    lines = enumerate(lines_of(contents(path)), start=1)
    for number, line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        words = line.split(maxsplit=9)
        try:
            pose, name = tuple(_real(word) for word in words[1:8]), words[9].strip()
            entry = _number(words[0]), pose, _number(words[8]), name
        except (ValueError, IndexError):
            raise _damaged(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME") from None
        following = next(lines, None)  # Of keypoints, and empty if there are none.
        if following is not None and len(following[1].split()) % 3:
            raise _damaged(path, following[0], "X Y POINT3D_ID of keypoints")
        yield entry


def _text_points(path: Path) -> Iterator[tuple[int, tuple, np.ndarray]]:
    for number, line in _lines(path):
        words = line.split()
        try:
            point, position = _number(words[0], 64), tuple(_real(word) for word in words[1:4])
            seen = [_number(word) for word in words[8::2]]
            if len(words) < 8 or len(words) % 2:
                raise ValueError
        except ValueError:
            raise _damaged(path, number, "POINT3D_ID X Y Z R G B ERROR and pairs of a track") from None
        yield point, position, np.array(seen, np.int64)
