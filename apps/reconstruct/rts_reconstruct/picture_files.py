"""Files of pictures that are turned by their EXIF, or that are there twice."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

import rts
from rts_reconstruct.cameras import ORIENTATION

MOST = 3
"""The most names in a line."""


def turned(views: Sequence[rts.View]) -> list[str]:
    """A line on pictures of a data set whose EXIF turns them, which nothing here does; none without."""
    names = [file.name for file in map(_file, views) if file is not None and _orientation(file) in range(2, 9)]
    if not names:
        return []
    return [
        f"EXIF turns {len(names)} of {len(views)} pictures ({_some(names)}); they are taken as they are stored: "
        "masks and cameras are to be of these"
    ]


def repeated(views: Sequence[rts.View]) -> list[str]:
    """A line on pictures of a data set that are the same file with different cameras; none without."""
    sizes: dict[int, list[tuple[rts.View, Path]]] = defaultdict(list)
    for view in views:
        if (file := _file(view)) is not None:
            sizes[file.stat().st_size].append((view, file))
    alike: dict[bytes, list[rts.View]] = defaultdict(list)
    for candidates in sizes.values():
        if len(candidates) > 1:
            for view, file in candidates:
                alike[hashlib.sha256(file.read_bytes()).digest()].append(view)
    pairs = []
    for first, *others in alike.values():
        pairs += [f"{v.name} is {first.name}" for v in others if not np.allclose(v.camera.view, first.camera.view)]
    if not pairs:
        return []
    return [
        f"{len(pairs)} of {len(views)} pictures are the same as others that have another camera ({_some(pairs)}): one "
        "of the two is wrong; leave it out"
    ]


def _file(view: rts.View) -> Path | None:
    """The file of a view's picture, if it is there."""
    file = None if view.path is None else Path(view.path)
    return file if file is not None and file.is_file() else None


def _orientation(file: Path) -> int:
    """The EXIF's; 1, not turned, for a file that Pillow does not know."""
    try:
        with Image.open(file) as picture:
            return int(picture.getexif().get(ORIENTATION) or 1)
    except (OSError, ValueError):
        return 1


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:MOST]) + (f" and {len(names) - MOST} more" if len(names) > MOST else "")
