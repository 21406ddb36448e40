"""Posed images in LLFF's format, poses_bounds.npy."""

from __future__ import annotations

import io
import math
from pathlib import Path

import numpy as np

from rts.errors import InputError
from rts.files.damaged_files import contents
from rts.files.views.lenses import Lens, checked_lens
from rts.files.views.pictures import EXTENSIONS, picture_folder, picture_size, with_mask
from rts.files.views.poses import LARGEST, PosedPicture, fitted, rigid

SCALE_OF_NEAREST = 0.75
"""In NeRF's frame of LLFF data sets the nearest bound is 1 / 0.75."""
HEADER, ROW = 5, 17
"""Columns of the matrix (3, 5) of an LLFF pose, and numbers in a row of poses_bounds.npy."""


def llff(path: Path, downscale: int, frame: str) -> list[PosedPicture]:
    """The entries of a file poses_bounds.npy, in the world of the file or in NeRF's."""
    rows = _rows(path)
    folder = picture_folder(path.parent, downscale, path)
    pictures = sorted(p for p in folder.pictures.iterdir() if p.suffix.lower() in EXTENSIONS)
    if len(pictures) != len(rows):
        raise InputError(
            f"{path} has {len(rows)} poses, but {folder.pictures} {len(pictures)} pictures; expected as many"
        )
    matrices, bounds = rows[:, :-2].reshape(-1, 3, HEADER), rows[:, -2:]
    poses = []
    for i, (picture, matrix, (near, far)) in enumerate(zip(pictures, matrices, bounds, strict=True)):
        place = f"{path}, row {i}"
        down, right, back, position, (height, width, focal) = matrix.T
        c2w = rigid(place, np.stack([right, -down, back, position], axis=1), (3, 4))
        if min(height, width, focal) <= 0 or not 1 / LARGEST < near < far < LARGEST:
            raise InputError(
                f"{place} has height {height:g}, width {width:g}, focal length {focal:g}, bounds {near:g} and {far:g}; "
                "expected positive numbers, bounds in order"
            )
        size = picture_size(picture)
        fitted(place, checked_lens(place, Lens(focal, focal, 0, 0)), (height, width), picture, size)
        # Pixels stay square where sizes are rounded.
        focal *= size[1] / width
        lens = Lens(focal, focal, size[1] / 2, size[0] / 2)
        pose = PosedPicture(picture, picture.name, size, folder.downscale, c2w, lens, float(near), float(far))
        poses.append(with_mask(pose, folder.mask(picture.name), folder.reduced))
    return _nerf_frame(poses) if frame == "nerf" else poses


def _rows(path: Path) -> np.ndarray:
    """(N, 17) finite numbers."""
    data = contents(path)
    try:
        rows = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception:  # NumPy raises many kinds, some with the advice to load pickles.
        rows = None
    if not isinstance(rows, np.ndarray):
        raise InputError(f"{path} is no array of numbers; expected numpy.save's, whole and without pickles")
    if rows.ndim != 2 or rows.shape[1] != ROW or not len(rows) or rows.dtype.kind not in "fiu":
        raise InputError(f"{path} has shape {rows.shape} and dtype {rows.dtype}; expected (N, {ROW}) numbers")
    rows = rows.astype(np.float64)
    if not np.isfinite(rows).all():
        raise InputError(f"{path} holds NaN or infinity; make the file again")
    return rows


def _nerf_frame(poses: list[PosedPicture]) -> list[PosedPicture]:
    """The poses relative to their mean, scaled so that the nearest bound is 1 / 0.75."""
    scale = 1 / (SCALE_OF_NEAREST * min(pose.near or math.inf for pose in poses))
    matrices = np.stack([pose.camera_to_world for pose in poses])
    matrices[:, :3, 3] *= scale
    _, up, back, position = matrices.mean(axis=0)[:3].T
    right = np.cross(up, back)
    axes = [right, np.cross(back, right), back]
    if min(np.linalg.norm(axis) for axis in axes) < 1e-6:
        raise InputError("the cameras look all ways, so that they have no mean; expected cameras that face forward")
    mean = np.eye(4)
    mean[:3, :3] = np.stack([axis / np.linalg.norm(axis) for axis in axes], axis=1)
    mean[:3, 3] = position
    recentred = np.linalg.inv(mean) @ matrices
    return [
        pose._replace(camera_to_world=m, near=(pose.near or 0) * scale, far=(pose.far or 0) * scale)
        for pose, m in zip(poses, recentred, strict=True)
    ]
