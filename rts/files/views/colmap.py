"""Posed images in COLMAP's format: a sparse model, text or binary, and the folder `images`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.errors import FileWarning, InputError, warn
from rts.files.paths import inside
from rts.files.views.colmap_tables import ColmapImage, ColmapPoints, read_cameras, read_entries, read_points
from rts.files.views.pictures import Folder, picture_folder, picture_size, with_mask
from rts.files.views.poses import PosedPicture, fitted, from_opencv

CAMERAS = ("cameras.bin", "cameras.txt")
"""Files of cameras; like COLMAP, of both forms the binary one is read."""
EVERY = 8
"""One picture of so many is for tests, in the order of names, the first one among them."""
NEAREST, FARTHEST = 0.1, 99.9
"""Percentiles of depths that bound a scene, as in LLFF: a few points are wrong."""


def cameras_in(folder: Path) -> Path | None:
    """The file of cameras of a COLMAP model: in `sparse/0` of the folder, in `sparse`, or in the folder itself."""
    for place in (folder / "sparse" / "0", folder / "sparse", folder):
        for name in CAMERAS:
            if (place / name).is_file():
                return place / name
    return None


def colmap(path: Path, split: str | None, downscale: int) -> list[PosedPicture]:
    """The pictures of a COLMAP model, in the order of their names, given its file of cameras; None warns of "train"."""
    if split not in (None, "train", "test", "all"):
        raise InputError(f"split is {quoted(split)}; expected 'train', 'test' or 'all' for COLMAP, which has no others")
    file = _beside(path, "images")
    cameras, entries = read_cameras(path), sorted(read_entries(file), key=lambda entry: entry.name)
    points_file = path.with_name(f"points3D{path.suffix}")
    points = read_points(points_file) if points_file.is_file() else None
    chosen = [e for i, e in enumerate(entries) if split == "all" or (i % EVERY == 0) == (split == "test")]
    if not chosen:
        raise InputError(
            f"{file} has no pictures of the split {split or 'train'!r}; expected some, or ask for split='all'"
        )
    folder = picture_folder(_root(path.parent), downscale, path)
    pictures = _pictures(file, folder, chosen)
    poses = []
    for entry, picture in zip(chosen, pictures, strict=True):
        place = f"{file}, image {entry.image}"
        if entry.camera not in cameras:
            raise InputError(f"{place} refers to camera {entry.camera}, which {path} lacks; export the model again")
        lens, stated = cameras[entry.camera]
        size = picture_size(picture)
        lens = fitted(f"{path}, camera {entry.camera}", lens, stated, picture, size)
        matrix, bounds = from_opencv(entry.rotation, entry.translation), _bounds(entry, points)
        pose = PosedPicture(picture, entry.name, size, folder.downscale, matrix, lens, *bounds)
        poses.append(with_mask(pose, folder.mask(entry.name), folder.reduced))
    if not any(pose.mask for pose in poses):
        _warn_of_other_masks(folder.masks, chosen[0].name)
    if split is None:
        warn(
            f"{len(chosen)} of the {len(entries)} pictures of {file} are taken; every eighth is kept for tests: say "
            f"split='train' if that is right, else 'all' or 'test'",
            FileWarning,
        )
    return poses


def _beside(path: Path, table: str) -> Path:
    """Another table of the model, of the same form."""
    file = path.with_name(table + path.suffix)
    if not file.is_file():
        raise InputError(f"{path} has no {file.name} beside it; expected a whole model of COLMAP")
    return file


def _root(model: Path) -> Path:
    """The folder of the data set whose model is in its folder `sparse/0`, in `sparse`, or in itself."""
    model = model.absolute()
    if model.parent.name == "sparse" and model.name.isdecimal():
        return model.parent.parent
    return model.parent if model.name == "sparse" else model


def _pictures(file: Path, folder: Folder, entries: list[ColmapImage]) -> list[Path]:
    """The pictures that are named; all that are missing make one error."""
    pictures = [inside(folder.pictures, entry.name, file, folder.pictures) for entry in entries]
    missing = [entry.name for entry, picture in zip(entries, pictures, strict=True) if not picture.is_file()]
    if missing:
        named = ", ".join(name[:40] for name in missing[:3]) + (", …" if len(missing) > 3 else "")
        raise InputError(
            f"{file} names {len(missing)} of {len(entries)} pictures that {folder.pictures} lacks: {named}; put them "
            "there, or export the model without them"
        )
    return pictures


def _warn_of_other_masks(folder: Path, name: str) -> None:
    """Warn of a folder of masks in which no picture of the model has one."""
    files = [x.name for x in sorted(folder.iterdir()) if x.is_file() and x.name[0] != "."] if folder.is_dir() else []
    if files:
        warn(
            f"none of {len(files)} files of {folder} ({files[0][:40]} …) is the mask of a picture; expected names such "
            f"as {name[:40]}.png: rename them, or no masks are used",
            FileWarning,
        )


def _bounds(entry: ColmapImage, points: ColmapPoints | None) -> tuple[float | None, float | None]:
    """Depths between which what is seen lies, by the points that the picture sees; None where it sees none."""
    if points is None:
        return None, None
    seen = points.positions[points.rows[points.images == entry.image]]
    depths = seen @ entry.rotation[2] + entry.translation[2]
    depths = depths[depths > 0]
    if not len(depths):
        return None, None
    near, far = np.percentile(depths, (NEAREST, FARTHEST))
    return float(near), float(far)
