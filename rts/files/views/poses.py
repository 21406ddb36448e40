"""Entries of files of posed images, and the checks that all formats share."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.argument_checks import ROTATION_TOLERANCE, check_numbers
from rts.errors import InputError
from rts.files.damaged_files import contents
from rts.files.views.lenses import Lens

LARGEST = 1e18
"""Largest entry of a matrix in a file: float32 holds the squares of such numbers."""
MOST_PIXELS = 2**31
"""Pictures are less wide, and less high."""
DIGITS = 18
"""Integers of so many digits fit into 64 bits."""


class PosedPicture(NamedTuple):
    """A picture's entry in a file.

    Attributes:
        path: the picture.
        name: its name in the file.
        size: (height, width) of the picture, pixels.
        downscale: reduction that is still to be made.
        camera_to_world: (4, 4) rigid; camera axes as in OpenGL.
        lens: the lens, for pictures of that size.
        near: depth at which what is seen begins, or None.
        far: depth at which it ends, or None.
        mask: the mask's picture, or None.
        mask_size: (height, width) of it, pixels.
    """

    path: Path
    name: str
    size: tuple[int, int]
    downscale: int
    camera_to_world: np.ndarray
    lens: Lens
    near: float | None = None
    far: float | None = None
    mask: Path | None = None
    mask_size: tuple[int, int] = (0, 0)


def read_json(path: Path) -> Mapping[str, Any]:
    """The object that a JSON file holds.

    Raises:
        InputError: it is no JSON, or no object.
    """
    try:
        tree = json.loads(contents(path), parse_int=_integer)
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError.
        said = " ".join(str(error).split())[:80]
        raise InputError(f"{path} is no JSON ({said}); the file may be cut short: export it again") from error
    if not isinstance(tree, Mapping):
        raise InputError(f"{path} holds a {type(tree).__name__}; expected an object with frames, or with views")
    return tree


def _integer(digits: str) -> int | float:
    """An integer of JSON; one of more than 64 bits as a floating number, which may be infinite."""
    return int(digits) if len(digits) <= DIGITS else float(digits)


def entries(path: Path, tree: Mapping[str, Any], key: str, *needed: str) -> list[tuple[str, Mapping[str, Any]]]:
    """The entries of a list in a JSON file, each with the name of its place; what an entry lacks is the file's.

    Raises:
        InputError: there is no such list, it is empty, or an entry lacks something that it needs.
    """
    frames = tree.get(key)
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path} has {f'{key} that are no list' if frames else f'no {key}'}; expected at least one")
    shared = {name: value for name, value in tree.items() if name != key}
    whole = []
    for i, entry in enumerate(frames):
        place = f"{path}, {key.removesuffix('s')} {i}"
        entry = {**shared, **entry} if isinstance(entry, Mapping) else {}
        if not set(needed) <= set(entry):
            raise InputError(f"{place} lacks {' or '.join(needed)}; export the file again")
        whole.append((place, entry))
    return whole


def numbers(place: str, what: str, value: Any, *shapes: tuple[int, ...]) -> np.ndarray:
    """Numbers of one of these shapes, float64, from a file; none beyond `LARGEST`."""
    try:
        known = check_numbers(what, value, *shapes)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
    if known is None:
        raise InputError(f"{place}: {what} is not known; expected numbers")
    known = known.astype(np.float64)
    if np.abs(known).max(initial=0) > LARGEST:
        raise InputError(f"{place}: {what} holds {np.abs(known).max():.6g}; expected numbers up to {LARGEST:g}")
    return known


def rigid(place: str, matrix: Any, *shapes: tuple[int, ...]) -> np.ndarray:
    """A rigid matrix (4, 4) float64, refused where it is more than a rotation and a position.

    `matrix` has one of the `shapes`: of (3, 3) and (3, 4), what is missing is taken from the identity.
    """
    known = numbers(place, "the matrix", matrix, *shapes)
    whole = np.eye(4)
    whole[: known.shape[0], : known.shape[1]] = known
    rotation = whole[:3, :3]
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0 or np.abs(whole[3] - [0, 0, 0, 1]).max() > 1e-5:
        raise InputError(
            f"{place}: the matrix is no rotation and position, but scales, shears or mirrors; export it again"
        )
    return whole


def from_opencv(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """The camera-to-world matrix (4, 4), camera axes as in OpenGL, of a pose of world-to-camera as OpenCV's."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return np.linalg.inv(np.diag([1.0, -1, -1, 1]) @ matrix)


def fitted(place: str, lens: Lens, stated: tuple[float, float], path: Path, size: tuple[int, int]) -> Lens:
    """The lens for pictures of another size (height, width) than the file states.

    Raises:
        InputError: the file states no size of a picture; or the picture has another shape: it is neither larger nor
            smaller, but for whole pixels.
    """
    height, width = stated
    if not (1 <= height < MOST_PIXELS and 1 <= width < MOST_PIXELS):
        raise InputError(f"{place} has {width:g} × {height:g} pixels; expected positive numbers, less than 2³¹")
    # Pictures that were made smaller are rounded to whole pixels.
    if abs(size[0] * width / height - size[1]) > 1 + size[1] / size[0]:
        raise InputError(
            f"{path} has {size[1]} × {size[0]} pixels, and {place} says {width:g} × {height:g}: another shape"
        )
    return lens.scaled(size[1] / width, size[0] / height)
