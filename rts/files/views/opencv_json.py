"""Posed images in a plain JSON of OpenCV's numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.contracts.checks import is_count
from rts.errors import InputError
from rts.files.views.lenses import COEFFICIENTS, Lens, checked_lens
from rts.files.views.pictures import named_picture, picture_size, with_mask
from rts.files.views.poses import PosedPicture, entries, fitted, from_opencv, numbers, rigid

LENGTHS = (0,), (4,), (5,), (8,)
"""Numbers of OpenCV's coefficients that are followed; 12 and 14 are of thin prisms and tilted sensors."""
FISHEYE = ("k1", "k2", "k3", "k4")
HALF = 0.5
"""The centre of the first pixel, which is (0, 0) in OpenCV, in pixels."""


def opencv(path: Path, tree: Mapping[str, Any], downscale: int) -> list[PosedPicture]:
    """The entries of a JSON with views, each {image, K, R, t, distortion, fisheye, width, height, mask}."""
    poses = []
    for place, view in entries(path, tree, "views", "image", "K", "R", "t"):
        rotation = rigid(place, view["R"], (3, 3))[:3, :3]
        translation = numbers(place, "t", view["t"], (3,), (3, 1)).reshape(3)
        picture = named_picture(path, place, view["image"])
        size = picture_size(picture)
        lens = fitted(place, _lens(place, view), _stated(place, view, size), picture, size)
        pose = PosedPicture(picture, picture.name, size, downscale, from_opencv(rotation, translation), lens)
        mask = view.get("mask")
        poses.append(with_mask(pose, None if mask is None else named_picture(path, place, mask)))
    return poses


def _lens(place: str, view: Mapping[str, Any]) -> Lens:
    K = numbers(place, "K", view["K"], (3, 3))
    if np.abs(K - [[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]]).max() > 1e-6:
        raise InputError(f"{place} has K = {K.tolist()}; expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels")
    fisheye = view.get("fisheye", False)
    if not isinstance(fisheye, bool):
        raise InputError(f"{place} has fisheye = {quoted(fisheye)}; expected true or false")
    names = FISHEYE if fisheye else COEFFICIENTS
    coefficients = view.get("distortion") or []
    lengths = [(0,), (4,)] if fisheye else LENGTHS
    values = numbers(place, "distortion", coefficients, *lengths) if coefficients != [] else np.zeros(0)
    bent = dict(zip(names, map(float, values), strict=False))
    return checked_lens(
        place, Lens(float(K[0, 0]), float(K[1, 1]), K[0, 2] + HALF, K[1, 2] + HALF, **bent, fisheye=fisheye)
    )


def _stated(place: str, view: Mapping[str, Any], size: tuple[int, int]) -> tuple[int, int]:
    """The size (height, width) that K is stated for; the picture's, if it is not stated."""
    stated = view.get("height", size[0]), view.get("width", size[1])
    if not all(is_count(number) for number in stated):
        raise InputError(f"{place} has height = {quoted(stated[0])}, width = {quoted(stated[1])}; expected pixels")
    return stated
