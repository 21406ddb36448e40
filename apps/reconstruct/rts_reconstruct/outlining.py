"""Outlines of pictures that come without: those of a solid, written as masks to be looked at and mended."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
import scipy.ndimage
import trimesh
from PIL import Image

import rts
from rts_reconstruct.masks import shown
from rts_reconstruct.solid import CELL
from rts_reconstruct.world import World

BLACK, GREY, WHITE = 0, 128, 255
"""Background, pixels that do not count, and the object, in masks that are written and read again."""
LARGEST = 1024
"""Longer sides of pictures in which masks are drawn, at most."""


def cut_out(view: rts.View, solid: trimesh.Trimesh, world: World) -> rts.View:
    """A view of a data set with alpha where it sees a solid of another world.

    Pixels nearer to the outline than a cell of the solid's lattice do not count.
    """

    @functools.cache
    def both() -> tuple[np.ndarray, np.ndarray]:
        return _silhouette(solid, world.camera(view.camera), view.size)

    def image() -> np.ndarray:
        alpha = both()[0][..., None]
        return np.concatenate([view.image[..., :3] * alpha, alpha], axis=2)

    def mask() -> np.ndarray:
        return both()[1] if view.mask is None else both()[1] * view.mask

    return rts.View(
        view.camera, functools.cache(image), view.size, name=view.name, mask=functools.cache(mask), path=view.path
    )


def _silhouette(solid: trimesh.Trimesh, camera: rts.Camera, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Alpha (H, W) of a solid, and 1 at pixels farther from its outline than a cell at its middle, else 0."""
    theta = {
        "vertices": np.asarray(solid.vertices, np.float32),
        "colors": np.ones((len(solid.vertices), 3), np.float32),
    }
    part = rts.Part(rts.Mesh(np.asarray(solid.faces, np.int32)), theta, "unlit")
    alpha = np.asarray(rts.render(part, camera, size, splatter="none"))[..., 3]
    solid_seen = alpha > 0.5
    if solid_seen.all() or not solid_seen.any():
        return alpha, np.ones(size, np.float32)
    depth = max(float(np.asarray(camera.depth(np.zeros((1, 3))))[0]), CELL)
    band = max(1.0, CELL * camera.projection[1, 1] * size[0] / (2 * depth))
    inside, outside = (np.asarray(scipy.ndimage.distance_transform_edt(kind)) for kind in (solid_seen, ~solid_seen))
    away = np.where(solid_seen, inside, outside)
    return alpha, (away > band).astype(np.float32)


def write_masks(
    folder: Path, views: Sequence[rts.View], numbers: Sequence[int], solid: trimesh.Trimesh, world: World
) -> None:
    """Write a mask for each view of a data set: white for the object, black behind it, grey where it is not known.

    Args:
        folder: where to write; masks are called as pictures are, with .png appended, in folders as these.
        views: the views.
        numbers: their numbers in the data set.
        solid: the object.
        world: its world.
    """
    for file, view in zip(_files(views, numbers), views, strict=True):
        height, width = view.size
        shrink = max(1.0, max(view.size) / LARGEST)
        size = (max(1, round(height / shrink)), max(1, round(width / shrink)))
        alpha, counts = _silhouette(solid, world.camera(view.camera), size)
        if view.mask is not None:
            own = Image.fromarray(np.asarray(view.mask, np.float32)).resize((size[1], size[0]), Image.Resampling.BOX)
            counts = counts * (np.asarray(own) > 0.5)
        levels = np.where(counts < 0.5, GREY, np.where(alpha > 0.5, WHITE, BLACK)).astype(np.uint8)
        _write(folder / file, Image.fromarray(levels).resize((width, height), Image.Resampling.NEAREST))


def write_alphas(folder: Path, views: Sequence[rts.View], numbers: Sequence[int]) -> None:
    """Write a mask for each view of a data set, as `write_masks`: white where its alpha tells the object."""
    for file, view in zip(_files(views, numbers), views, strict=True):
        _write(folder / file, Image.fromarray(np.where(view.image[..., 3] > 0.5, WHITE, BLACK).astype(np.uint8)))


def _write(path: Path, mask: Image.Image) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    mask.save(path)


def mended(views: Sequence[rts.View], folder: Path) -> list[rts.View]:
    """Views of a data set with alpha by masks as `write_masks` writes them, in place of their own.

    Raises:
        InputError: masks are missing, of another size, or cannot be read.
    """
    names = _files(views, range(len(views)))
    files = [_found(folder, name) for name in names]
    missing = [name for name, file in zip(names, files, strict=True) if file is None]
    if missing:
        named = ", ".join(missing[:3]) + (", …" if len(missing) > 3 else "")
        raise rts.InputError(f"{folder} lacks {len(missing)} of {len(views)} masks: {named}")
    return [_masked(view, file) for view, file in zip(views, files, strict=True) if file is not None]


def _found(folder: Path, name: str) -> Path | None:
    """The mask called NAME.png, or with .png in place of the picture's ending; None if there is neither."""
    files = folder / name, (folder / name).with_suffix("").with_suffix(".png")
    return next((file for file in files if file.is_file()), None)


def _masked(view: rts.View, file: Path) -> rts.View:
    def levels() -> np.ndarray:
        with Image.open(file) as picture:
            return np.asarray(picture.convert("L"))

    try:
        with Image.open(file) as picture:
            width, height = picture.size
    except OSError as error:
        raise rts.InputError(f"the mask {file} cannot be read as a picture ({error})") from None
    if (height, width) != view.size:
        raise rts.InputError(
            f"the mask {file} has {width} × {height} pixels, and its picture {view.size[1]} × {view.size[0]}; expected "
            "masks of the size of the pictures" + (": this one is turned" if (width, height) == view.size else "")
        )

    def image() -> np.ndarray:
        alpha = (levels() > GREY)[..., None].astype(np.float32)
        return np.concatenate([view.image[..., :3] * alpha, alpha], axis=2)

    def mask() -> np.ndarray:
        level = levels()
        counts = ((level < GREY / 2) | (level > (GREY + WHITE) / 2)).astype(np.float32)
        return counts if view.lens is None else counts * shown(view)

    return rts.View(view.camera, image, view.size, name=view.name, mask=mask, path=view.path, lens=view.lens)


def _files(views: Sequence[rts.View], numbers: Sequence[int]) -> list[str]:
    """The names of masks, in their folder: NAME.png; by number where pictures have no names, or equal ones."""
    names = [PurePosixPath(view.name) for view in views]
    told = all(name.name and not name.is_absolute() and ".." not in name.parts for name in names)
    if not told or len(set(names)) < len(names):
        return [f"{number}.png" for number in numbers]
    return [f"{name}.png" for name in names]
