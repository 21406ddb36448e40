"""Cameras of somebody's own photographs, by COLMAP (Schönberger and Frahm 2016) as pycolmap ships it."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image, ImageOps, UnidentifiedImageError

import rts
from rts_reconstruct.folders import has_photographs_alone, left_out, photographs_in

EXHAUSTIVE = 80
"""The most photographs of which all pairs are compared; of more, each is compared with the next ones by name."""
FEWEST = 3
"""Photographs, and registered ones, that a reconstruction needs at least."""
ORIENTATION = 274
"""The tag of EXIF that says how a camera was held."""


@dataclass(frozen=True)
class FoundCameras:
    """Cameras of photographs, as `find_cameras` gives them. Printed, they are a line on how good they are.

    Attributes:
        folder: a data set of COLMAP: `images`, and the model `sparse/0`. `rts.load_views` reads it.
        photographs: the number of photographs.
        registered: the number of those whose cameras were found.
        points: the number of points of the scene.
        error: the mean distance of points from where pictures show them, in pixels.
        missing: names of photographs without a camera.
        turned: names of photographs that were turned upright, as their EXIF says.
    """

    folder: Path
    photographs: int
    registered: int
    points: int
    error: float
    missing: tuple[str, ...]
    turned: tuple[str, ...]

    def __str__(self) -> str:
        missing = f"; no camera for {_some(self.missing)}" if self.missing else ""
        turned = f"; {len(self.turned)} turned upright, as their EXIF says" if self.turned else ""
        return (
            f"{self.registered} of {self.photographs} cameras found, {self.points:,} points, {self.error:.2f} pixels "
            f"off in the mean{turned}{missing}"
        )


def find_cameras(photos: Any, out: Any, *, size: int = 1600) -> FoundCameras:
    """Find the cameras of photographs of one thing that stands still.

    Photographs are turned upright once, as their EXIF says. Focal lengths start from EXIF. Those of one size and focal
    length share a lens. Of up to 80 photographs all pairs are compared; of more, each with the ten that follow by name,
    as of a film.

    Args:
        photos: a folder of photographs.
        out: a folder for the data set, which may not exist yet: `images`, and `sparse/0`.
        size: pixels of the longer side in which features are looked for; photographs themselves stay as large as they
            are.

    Raises:
        InputError: no folder, fewer than three photographs, one that cannot be read, a size that is no count, or no
            cameras found: photographs overlap too little, or show too little texture.
        PluginError: pycolmap is missing (extra `photos`).
    """
    for name, value in (("photos", photos), ("out", out)):
        if not isinstance(value, (str, os.PathLike)):
            raise rts.InputError(f"{name} is {value!r:.60}; expected a folder")
    photos, out = Path(photos), Path(out)
    if out.exists() and not out.is_dir():
        raise rts.InputError(f"{out} is a file; expected a folder")
    if isinstance(size, bool) or not isinstance(size, int) or size < 64:
        raise rts.InputError(f"size is {size!r:.40}; expected a number of pixels, at least 64")
    files = _checked(photos)
    pycolmap = _pycolmap()
    if (out / "sparse").exists() or (out / "images").exists():
        raise rts.InputError(f"{out} has a data set already; choose another folder, or delete it")
    with _whole(out) as folder:
        turned, groups = _upright(files, folder / "images")
        with _quiet(pycolmap):
            model = _model(pycolmap, folder, groups, size)
            if model is None:
                raise rts.InputError(
                    f"no cameras were found for the {len(files)} photographs of {photos}; expected ones that overlap "
                    "by two thirds, of a thing with texture that stands still"
                )
            sparse = folder / "sparse" / "0"
            sparse.mkdir(parents=True)
            model.write(sparse)
        names = {image.name for image in model.images.values() if image.has_pose}
        missing = tuple(name for group in groups.values() for name in group if name not in names)
        return FoundCameras(
            out, len(files), len(names), model.num_points3D(), model.compute_mean_reprojection_error(), missing, turned
        )


def with_cameras(views: Any, out: Path) -> Any:
    """The data set of photographs that come alone, made in `out` unless it is there; any other views as they are.

    Raises:
        InputError: a path that has neither photographs nor cameras; or as `find_cameras`.
        PluginError: as `find_cameras`.
    """
    if not has_photographs_alone(views):
        return views
    folder = Path(views)
    if not (out / "sparse").exists():
        _checked(folder)
        _pycolmap()  # Where it is missing, that is all there is to say.
        print(f"{folder} has photographs without cameras: looking for them, which takes minutes", file=sys.stderr)
        if other := left_out(folder):
            print(f"{folder} has {other}, too, which are not read: export them as JPEG", file=sys.stderr)
        print(f"{find_cameras(folder, out)}; {out} is a data set of COLMAP", file=sys.stderr)
    return out


def _checked(photos: Path) -> list[Path]:
    """The photographs of a folder; too few, and files that are no pictures, are refused."""
    files = photographs_in(photos)
    if len(files) < FEWEST:
        raise rts.InputError(
            f"{photos} has {len(files)} photograph{'s'[: len(files) != 1]}; expected at least {FEWEST}, "
            f"and thirty around a thing for all of its surface"
        )
    for file in files:
        with _read(file):
            pass
    return files


@contextlib.contextmanager
def _read(file: Path) -> Iterator[Image.Image]:
    """A photograph; an InputError where it cannot be read."""
    try:
        with Image.open(file) as picture:
            yield picture
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        said = str(error).split(repr(str(file)))[0].strip()
        raise rts.InputError(f"{file} cannot be read as a picture ({said}); take it out of {file.parent}") from None


def _pycolmap() -> Any:
    try:
        import pycolmap
    except ImportError:
        raise rts.errors.PluginError(
            "cameras of photographs need pycolmap: pip install -c constraints.txt './apps/reconstruct[photos]'"
        ) from None
    return pycolmap


@contextlib.contextmanager
def _whole(out: Path) -> Iterator[Path]:
    """A folder in `out` whose files become those of `out` where nothing fails, and vanish where something does."""
    missing = [folder for folder in (out, *out.parents) if not folder.exists()]
    out.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(prefix=".new-", dir=out) as name:
            yield Path(name)
            for made in ("images", "sparse"):
                os.replace(Path(name) / made, out / made)
    except BaseException:
        for folder in missing:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def _upright(files: list[Path], to: Path) -> tuple[tuple[str, ...], dict[Any, list[str]]]:
    """Copy photographs, upright; names of those turned, and names by size and focal length."""
    to.mkdir()
    turned: list[str] = []
    groups: dict[Any, list[str]] = {}
    for file in files:
        with _read(file) as picture:
            exif = picture.getexif()
            lens = exif.get_ifd(0x8769)
            upright = ImageOps.exif_transpose(picture) if exif.get(ORIENTATION) in range(2, 9) else None
            if upright is None:
                picture.load()
                shutil.copy2(file, to / file.name)
            else:
                upright.save(to / file.name, exif=upright.getexif(), quality=95)
                turned.append(file.name)
            found = (upright or picture).size
        groups.setdefault((found, str(lens.get(37386)), exif.get(272)), []).append(file.name)
    return tuple(turned), groups


def _model(pycolmap: Any, folder: Path, groups: dict[Any, list[str]], size: int) -> Any:
    """The model with the most registered photographs; None if there is none with `FEWEST`."""
    database, images = folder / "database.db", folder / "images"
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = size
    for names in groups.values():
        pycolmap.extract_features(
            database, images, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=options
        )
    if sum(map(len, groups.values())) <= EXHAUSTIVE:
        pycolmap.match_exhaustive(database)
    else:
        pycolmap.match_sequential(database)
    models = pycolmap.incremental_mapping(database, images, folder / "models")
    largest = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    return None if largest is None or largest.num_reg_images() < FEWEST else largest


@contextlib.contextmanager
def _quiet(pycolmap: Any) -> Iterator[None]:
    """COLMAP's own lines, of which there are thousands, are left out."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


def _some(names: tuple[str, ...], most: int = 5) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
