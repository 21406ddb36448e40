"""What a path holds: pictures with cameras, photographs alone, or neither, which is said in one line."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import Any

import rts

PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
"""Endings of the files that are taken for photographs."""
UNREAD = (".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
"""Endings of photographs that are not read: those of some phones, and raw ones."""
FILMS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
TABLES = (".json", ".npy")
"""Endings of files that have cameras. A folder of pictures that has one of these is no folder of photographs alone."""
MODEL = ("cameras", "images", "points3D")
"""Files of COLMAP with cameras, as .bin or .txt."""
PLACES = ("images", "input", "photos")
"""Folders that are looked into first where a folder has no photographs itself."""


def photographs_in(folder: Path) -> list[Path]:
    """The photographs in a folder, by name, without hidden files.

    Raises:
        InputError: there is no such folder.
    """
    if not folder.is_dir():
        raise rts.InputError(f"{folder} is no folder; expected one with photographs")
    return [file for file in _files(folder) if file.suffix.lower() in PICTURES]


def left_out(folder: Path) -> str:
    """The number of files in a folder by ending, such as "3 .heic", of photographs and films that are not read."""
    endings = Counter(file.suffix.lower() for file in _files(folder))
    return ", ".join(f"{count} {kind}" for kind, count in endings.items() if kind in (*UNREAD, *FILMS))


def has_photographs_alone(views: Any) -> bool:
    """True for a folder of photographs without cameras; False for what `rts.load_views` is to read, or refuse.

    Raises:
        InputError: a picture, a film, or a folder that has neither photographs nor cameras.
    """
    if not isinstance(views, (str, os.PathLike)) or not Path(views).exists():
        return False
    path = Path(views)
    if not path.is_dir():
        _refuse_file(path)
        return False
    names = {file.name for file in _files(path)}
    tables = {f"{table}{ending}" for table in MODEL for ending in (".bin", ".txt")}
    if (path / "sparse").exists() or names & tables or any(name.endswith(TABLES) for name in names):
        return False
    if not photographs_in(path):
        raise _neither(path)
    return True


def _files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.is_file() and not file.name.startswith("."))


def _refuse_file(path: Path) -> None:
    kind = path.suffix.lower()
    if kind in (*PICTURES, *UNREAD):
        raise rts.InputError(f"{path} is one picture; expected a folder of them: give {path.parent}")
    if kind in FILMS:
        raise rts.InputError(
            f"{path} is a film; expected a folder of photographs: ffmpeg -i {path.name} -vf fps=2 photos/%04d.jpg "
            "makes some"
        )


def _neither(folder: Path) -> rts.InputError:
    """The error of a folder with neither photographs nor cameras, and where some may be."""
    within = [folder / name for name in PLACES] + sorted(folder.iterdir())
    for place in within:
        if place.is_dir() and (found := photographs_in(place)):
            return rts.InputError(
                f"{folder} has neither cameras nor photographs, but its folder {place.name} has {len(found)}: give "
                f"{place}"
            )
    if other := left_out(folder):
        return rts.InputError(
            f"{folder} has {other}, which are not read; expected photographs as JPEG or PNG: export them as such"
        )
    return rts.InputError(
        f"{folder} has neither photographs ({', '.join(PICTURES)}) nor cameras; expected some thirty photographs of "
        "one thing, or a data set: transforms.json, sparse/0 of COLMAP, poses_bounds.npy or cameras.json"
    )
