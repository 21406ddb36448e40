"""Arguments of a reconstruction, refused where they are wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import rts


def checked_masks(masks: Any) -> str:
    """A kind of masks, or a folder of them; anything else is refused."""
    if not isinstance(masks, (str, Path)) or (masks not in ("object", "ignore") and not Path(masks).is_dir()):
        raise rts.InputError(
            f"masks is {str(masks)!r:.60}; expected 'object' (white where it is), 'ignore' (black does not count), or "
            "a folder of masks that an earlier run wrote"
        )
    return str(masks)


def checked_region(region: Any) -> list[float] | None:
    """Center and radius of a ball; anything else is refused."""
    if region is None:
        return None
    found = np.asarray(region)
    if found.shape != (4,) or found.dtype.kind not in "fiu" or not np.isfinite(found).all() or found[3] <= 0:
        raise rts.InputError(f"region is {region!r:.60}; expected four numbers: x, y, z and a radius above 0")
    return [float(x) for x in found]


def check_counts(**counts: tuple[Any, int]) -> None:
    """Refuse numbers that are no whole ones, or below the least one that stands beside them."""
    for name, (value, least) in counts.items():
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
            raise rts.InputError(f"{name} is {value!r:.60}; expected a whole number, at least {least}")


def check_other_folder(folder: Path, views: Any) -> None:
    """Refuse to write into the folder of the data set, or of its pictures, which results would be mixed with."""
    if not isinstance(views, (str, Path)):
        return
    data = (Path(views) if Path(views).is_dir() else Path(views).parent).resolve()
    while data.name in ("0", "sparse", "images"):  # Of a folder of COLMAP.
        data = data.parent
    parts, target = [data / name for name in ("images", "masks", "sparse")], folder.resolve()
    if target == data or any(target.is_relative_to(part) for part in parts):
        raise rts.InputError(
            f"the folder to write into, {folder}, is that of the pictures; expected another one, such as "
            f"{data / 'reconstruction'}"
        )
