"""What users give in files: masks, values of joints, intrinsics, poses."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

import rts
from rts.plugin_api.checks import check_numbers, quoted

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


def read_masks(folder: Path) -> tuple[list[str], list[np.ndarray]]:
    """Names and masks (H, W), 0 to 1, of the pictures of a folder, by name: their alpha, or else their brightness.

    Raises:
        rts.InputError: there is no such folder, it has no pictures, one cannot be read, or sizes differ.
    """
    if not folder.is_dir():
        raise rts.InputError(f"there is no folder {folder}; expected a folder of masks, one picture for each view")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)
    if not paths:
        raise rts.InputError(f"{folder} has no pictures; expected masks: {', '.join(PICTURES)}")
    masks = [_mask(path) for path in paths]
    for path, mask in zip(paths, masks, strict=True):
        (height, width), (first, second) = mask.shape, masks[0].shape
        if mask.shape != masks[0].shape:
            raise rts.InputError(
                f"{path.name} has {width} x {height} pixels, and {paths[0].name} {second} x {first}; expected masks of "
                f"one camera, all of one size"
            )
        if not 0 < np.count_nonzero(mask >= 0.5) < mask.size:
            raise rts.InputError(
                f"{path.name} is {'black' if mask.max() < 0.5 else 'white'} all over (from {255 * mask.min():.0f} to "
                f"{255 * mask.max():.0f} of 255); expected white where the robot is, on black"
            )
    return [path.name for path in paths], masks


def _mask(path: Path) -> np.ndarray:
    try:
        with Image.open(path) as picture:
            pixels = np.asarray(picture.convert("RGBA"), np.float64) / 255
    except (OSError, UnidentifiedImageError) as error:
        raise rts.InputError(f"{path} cannot be read as a picture ({' '.join(str(error).split()):.80})") from error
    return pixels[..., 3] if (pixels[..., 3] < 1).any() else pixels[..., :3].mean(axis=-1)


def read_joints(path: Path, names: Sequence[str]) -> list[dict[str, float]]:
    """The values of joints in each view, from JSON or CSV.

    JSON is a list of objects {joint: value}, in the order of the masks' names, or an object of these by the masks'
    names. CSV has a row of joints' names, and a row of numbers for each mask.

    Args:
        path: the file.
        names: the masks' names.

    Raises:
        rts.InputError: there is no such file, it is neither, or it has not a value for each mask.
    """
    if not path.is_file():
        raise rts.InputError(f"there is no file {path}; expected the values of joints, .json or .csv")
    try:
        text = path.read_text(encoding="utf-8")
        rows: Any = list(csv.DictReader(text.splitlines())) if path.suffix.lower() == ".csv" else json.loads(text)
    except (OSError, ValueError, csv.Error) as error:
        raise rts.InputError(f"{path} cannot be read ({' '.join(str(error).split()):.80})") from error
    if isinstance(rows, dict):
        missing = [name for name in names if name not in rows]
        if missing:
            raise rts.InputError(f"{path} has no entry {missing[0]}; expected one for each mask")
        rows = [rows[name] for name in names]
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise rts.InputError(f"{path} holds {quoted(rows)}; expected a list of objects {{joint: value}}")
    if len(rows) != len(names):
        raise rts.InputError(f"{path} has {len(rows)} rows for {len(names)} masks; expected one for each mask")
    try:
        return [{name: float(value) for name, value in row.items()} for row in rows]
    except (TypeError, ValueError):
        raise rts.InputError(f"{path} holds a value that is no number; expected radians and metres") from None


def read_intrinsics(text: str | None, fov: float | None, size: tuple[int, int]) -> np.ndarray:
    """The matrix (3, 3) of intrinsics, as OpenCV's, from "fx,fy,cx,cy" or from a vertical field of view in degrees.

    Raises:
        rts.InputError: neither or both are given, or one is wrong.
    """
    if (text is None) == (fov is None):
        raise rts.InputError("give the camera's --intrinsics fx,fy,cx,cy in pixels, or its --fov, the vertical one")
    height, width = size
    if fov is not None:
        if not 0 < fov < 180:
            raise rts.InputError(f"--fov is {fov:g}; expected degrees between 0 and 180")
        focal = height / 2 / np.tan(np.radians(fov) / 2)
        return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    try:
        fx, fy, cx, cy = (float(part) for part in str(text).split(","))
    except ValueError:
        raise rts.InputError(
            f"--intrinsics is {text!r:.60}; expected four numbers, such as 600,600,319.5,239.5"
        ) from None
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def read_start(path: Path) -> np.ndarray:
    """The matrix `camera_to_base` (4, 4) of a JSON file, such as a calibration's.

    Raises:
        rts.InputError: there is no such file, or it holds no such matrix.
    """
    if not path.is_file():
        raise rts.InputError(f"there is no file {path}; expected JSON with a matrix camera_to_base")
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        matrix = check_numbers("camera_to_base", entries["camera_to_base"], (4, 4))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise rts.InputError(f"{path} holds no matrix camera_to_base, (4, 4) ({error!r:.60})") from error
    return np.asarray(matrix, np.float64)
