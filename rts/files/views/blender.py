"""Posed images in Blender's format, transforms_….json, as NeRF, instant-ngp and nerfstudio have it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rts.arrays.argument_checks import quoted
from rts.contracts.checks import is_real
from rts.errors import InputError
from rts.files.views.lenses import COEFFICIENTS, FISHEYE, Lens, check_model, checked_lens
from rts.files.views.pictures import named_picture, picture_size, with_mask
from rts.files.views.poses import PosedPicture, entries, fitted, rigid

CONTRADICTION = 1e-3
"""Largest difference, in widths of the image, of two statements of a file about one focal length."""
AXES = ("x", "w"), ("y", "h")
LEAST_ANGLE = 1e-9
"""The least field of view, radians: pixels per radian stay finite."""


def blender(path: Path, tree: Mapping[str, Any], downscale: int) -> list[PosedPicture]:
    """The entries of a file transforms_….json."""
    _check_angle(str(path), tree)
    poses = []
    for place, frame in entries(path, tree, "frames", "file_path", "transform_matrix"):
        matrix = rigid(place, frame["transform_matrix"], (4, 4), (3, 4))
        picture = named_picture(path, place, frame["file_path"])
        size = picture_size(picture)
        lens, stated = _lens(place, frame, size)
        pose = PosedPicture(picture, picture.name, size, downscale, matrix, fitted(place, lens, stated, picture, size))
        mask = frame.get("mask_path")
        poses.append(with_mask(pose, None if mask is None else named_picture(path, place, mask)))
    return poses


def _check_angle(place: str, lens: Mapping[str, Any]) -> None:
    """Refuse fields of view that are none; without one, focal lengths are needed, of the file or of its frames."""
    for axis, _ in AXES:
        angle: Any = lens.get(f"camera_angle_{axis}")
        if angle is not None and not (is_real(angle) and LEAST_ANGLE < angle < math.pi):
            raise InputError(
                f"{place} has a camera_angle_{axis} of {quoted(angle)}; expected the field of view in radians, "
                "between 0 and π"
            )


def _lens(place: str, frame: Mapping[str, Any], size: tuple[int, int]) -> tuple[Lens, tuple[float, float]]:
    """The lens of a frame, and the size (height, width) of the pictures that it is stated for."""
    _check_angle(place, frame)
    stated = {key: frame[key] for key in ("w", "h") if frame.get(key) is not None}
    parameters = {
        **stated,
        **{key: frame[key] for key in ("fl_x", "fl_y", "cx", "cy", *COEFFICIENTS) if key in frame},
    }
    for key, value in parameters.items():
        if not is_real(value) or not math.isfinite(value) or (key in ("w", "h", "fl_x", "fl_y") and value <= 0):
            kind = "positive number" if key in ("w", "h", "fl_x", "fl_y") else "number"
            raise InputError(f"{place} has {key} = {quoted(value)}; expected a {kind}")
    ratio = size[1] / size[0]
    width = float(stated.get("w", stated.get("h", size[0]) * ratio))
    height = float(stated.get("h", width / ratio))
    fx = _focal(place, frame, "x", width)
    if fx is None:
        raise InputError(f"{place} lacks camera_angle_x and fl_x; expected the horizontal field of view in radians")
    fy = _focal(place, frame, "y", height) or fx
    fisheye = _is_fisheye(place, frame)
    bent = {key: float(parameters.get(key, 0)) for key in COEFFICIENTS}
    unclear = [key for key in ("k4", "k5", "k6") if bent[key]]
    if unclear and not fisheye and frame.get("camera_model") != "FULL_OPENCV":
        raise InputError(
            f"{place} has {' and '.join(unclear)}, which tools take for different things; state camera_model, "
            f"{FISHEYE} or FULL_OPENCV"
        )
    center = float(parameters.get("cx", width / 2)), float(parameters.get("cy", height / 2))
    return checked_lens(place, Lens(fx, fy, *center, **bent, fisheye=fisheye)), (height, width)


def _focal(place: str, frame: Mapping[str, Any], axis: str, extent: float) -> float | None:
    """The focal length along an axis, pixels, stated as fl_x or by camera_angle_x; None if it is not stated."""
    focal, angle = frame.get(f"fl_{axis}"), frame.get(f"camera_angle_{axis}")
    if angle is None:
        return None if focal is None else float(focal)
    expected = 0.5 * extent / math.tan(0.5 * angle)
    if focal is None:
        return expected
    if abs(focal - expected) > CONTRADICTION * extent:
        raise InputError(
            f"{place} has fl_{axis} = {quoted(focal)}, where camera_angle_{axis} makes it {expected:.6g}; remove the "
            "wrong one"
        )
    return float(focal)


def _is_fisheye(place: str, frame: Mapping[str, Any]) -> bool:
    model = frame.get("camera_model")
    if model is not None:
        check_model(place, model)
    stated = frame.get("is_fisheye")
    if stated is not None and not isinstance(stated, bool):
        raise InputError(f"{place} has is_fisheye = {quoted(stated)}; expected true or false")
    return model == FISHEYE or stated is True
