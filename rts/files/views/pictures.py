"""Pictures and masks of posed images: found, measured, and read when they are needed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rts.errors import InputError
from rts.files.damaged_files import gathered, warn_once
from rts.files.images import load_image, read_image
from rts.files.paths import inside
from rts.files.views.lenses import undistorted
from rts.files.views.poses import PosedPicture

EXTENSIONS = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")


class Folder(NamedTuple):
    """The folders of a data set's pictures and masks.

    Attributes:
        pictures: the folder of pictures.
        downscale: the reduction that is still to be made of pictures.
        masks: the folder of masks, which may not exist.
        reduced: how many times as large as the pictures masks are.
    """

    pictures: Path
    downscale: int
    masks: Path
    reduced: int

    def mask(self, name: str) -> Path | None:
        """The mask of a picture: NAME.png as COLMAP calls it, or the name with .png in place of its ending; or None."""
        same = name if name.lower().endswith(".png") else os.path.splitext(name)[0] + ".png"
        for mask in (name + ".png", same):
            if os.path.isfile(self.masks / mask):  # False, too, for a name that is too long.
                return inside(self.masks, mask, self.masks, self.masks)
        return None


def picture_folder(root: Path, downscale: int, cameras: Path) -> Folder:
    """The folder `images_n` for pictures that are n times smaller, if there is one; else `images`.

    Raises:
        InputError: there is no such folder.
    """
    if downscale > 1 and (root / f"images_{downscale}").is_dir():
        masks = root / f"masks_{downscale}"
        if masks.is_dir():
            return Folder(root / f"images_{downscale}", 1, masks, 1)
        return Folder(root / f"images_{downscale}", 1, root / "masks", downscale)
    if not (root / "images").is_dir():
        raise InputError(f"{cameras} has no folder images in {root}; expected its pictures there")
    return Folder(root / "images", downscale, root / "masks", 1)


def picture_size(path: Path) -> tuple[int, int]:
    """(height, width) of a picture, from its header alone.

    Raises:
        InputError: it cannot be read.
    """
    from PIL import Image

    try:
        with gathered(path), Image.open(path) as image:
            return image.height, image.width
    except Exception as error:  # Pillow raises many kinds.
        said = " ".join(str(error).split())
        raise InputError(f"{path} cannot be read as an image ({said}); export it again, as PNG for example") from error


def named_picture(path: Path, place: str, name: object) -> Path:
    """The picture that an entry of a file names, with or without its extension.

    Raises:
        InputError: the name is none, leads out of the file's folder, or there is no such file.
    """
    if not isinstance(name, str):
        raise InputError(f"{place} has a name of a picture that is {name!r:.60}; expected a string")
    for extension in ("", *EXTENSIONS):
        candidate = inside(path.parent, name + extension, path)
        if candidate.is_file():
            return candidate
    raise InputError(f"{place} refers to the picture {name[:60]!r}, but there is no such file, nor {name[:60]}.png")


def with_mask(pose: PosedPicture, mask: Path | None, reduced: int = 1) -> PosedPicture:
    """The pose with a mask, which has the picture's size, or is `reduced` times as large; as it is if that is None.

    Raises:
        InputError: it has another size, or cannot be read.
    """
    if mask is None:
        return pose
    size = picture_size(mask)
    if size != pose.size and not all(abs(a - reduced * b) < reduced for a, b in zip(size, pose.size, strict=True)):
        raise InputError(
            f"the mask {mask} has {size[1]} × {size[0]} pixels, and {pose.path} {pose.size[1]} × {pose.size[0]}; "
            "expected masks of the size of the pictures" + (": this one is turned" if size == pose.size[::-1] else "")
        )
    return pose._replace(mask=mask, mask_size=size)


def read_picture(pose: PosedPicture, *, linear: bool, behind: np.ndarray | None) -> np.ndarray:
    """(h, w, 4) float32 premultiplied of a picture, undistorted, then means of n × n pixels.

    Args:
        pose: the picture, its lens and its reduction n.
        linear: True for linear colours, False for the file's own.
        behind: (3,) colour to put the picture on, for (h, w, 3); None for none.

    Raises:
        InputError: the picture cannot be read, or has another size than before.
    """
    path = pose.path
    if linear:
        image = load_image(path)
    else:
        encoded = _encoded(path)
        alpha = encoded[..., 3:] if encoded.shape[2] == 4 else np.ones_like(encoded[..., :1])
        image = np.concatenate([encoded[..., :3] * alpha, alpha], axis=2)
    _check_unchanged(path, image.shape[:2], pose.size)
    if pose.lens.distorts:
        image, _ = undistorted(image, pose.lens)
    image = _means(image, pose.downscale)
    return image if behind is None else image[..., :3] + (1 - image[..., 3:]) * behind


def read_mask(pose: PosedPicture) -> np.ndarray:
    """(h, w) float32 in [0, 1]: the mask's picture, as encoded, or ones; times 0 where the lens leaves no picture."""
    from PIL import Image

    mask = np.ones(pose.size, np.float32)
    if pose.mask is not None:
        mask = _encoded(pose.mask)[..., :3].mean(axis=2)
        _check_unchanged(pose.mask, mask.shape, pose.mask_size)
        if mask.shape != pose.size:
            height, width = pose.size
            mask = np.asarray(Image.fromarray(mask).resize((width, height), Image.Resampling.BOX))
    if pose.lens.distorts:
        mask = undistorted(mask[..., None], pose.lens)[0][..., 0]  # It is 0 where nothing is defined.
    return _means(mask[..., None], pose.downscale)[..., 0]


def _encoded(path: Path) -> np.ndarray:
    """(H, W, 3 or 4) float32 of a picture, as it is encoded."""
    if not path.is_file():
        raise InputError(f"there is no picture {path}; it was there when the views were loaded")
    with gathered(path) as notes:
        encoded = read_image(path)
    warn_once(path, notes)
    return encoded


def _check_unchanged(path: Path, size: tuple[int, ...], before: tuple[int, int]) -> None:
    if size != before:
        raise InputError(
            f"{path} has {size[1]} × {size[0]} pixels, and had {before[1]} × {before[0]} before; load the views again"
        )


def _means(image: np.ndarray, n: int) -> np.ndarray:
    """(h, w, C) means of n × n pixels."""
    if n == 1:
        return image
    height, width, channels = image.shape
    return image.reshape(height // n, n, width // n, n, channels).mean(axis=(1, 3))
