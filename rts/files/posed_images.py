"""Posed images: pictures with the cameras that took them, in Blender's and in LLFF's format (as NeRF's data sets are).

Images are read when they are needed. Cameras, and whether every image is there and can be opened, are checked at once.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.argument_checks import ROTATION_TOLERANCE, check_numbers, quoted
from rts.contracts.checks import is_count, is_real
from rts.errors import FileWarning, InputError, warn
from rts.files.damaged_files import contents, gathered
from rts.files.images import load_image, read_image
from rts.files.paths import as_path, inside
from rts.scene.camera import Camera
from rts.scene.view import View

COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
EXTENSIONS = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")
PLANES = (0.01, 1000.0)
"""Near and far planes of cameras whose file tells no bounds."""
MARGIN = 100.0
"""Factor by which a camera's planes lie nearer, and farther, than the bounds of the scene in its file."""
SCALE_OF_NEAREST = 0.75
"""In NeRF's frame of LLFF scenes the nearest bound is 1 / 0.75."""
OFF_CENTRE = 1e-3
"""Largest difference, in widths of the image, of two statements of a file about one lens."""
HEADER, ROW = 5, 17
"""Columns of the matrix (3, 5) of an LLFF pose, and numbers in a row of poses_bounds.npy."""


def load_views(
    path: Any,
    *,
    split: str = "train",
    downscale: int = 1,
    linear: bool = True,
    background: Any = None,
    pixel_center: float = 0.5,
    frame: str = "file",
    near: float | None = None,
    far: float | None = None,
    cache: bool = False,
) -> list[View]:
    """The posed images of a data set, in the order of its file; the images are read when they are needed.

    - Blender: a file `transforms_….json` with camera_angle_x and frames, each with file_path (with or without its
      extension, beside the file) and transform_matrix, (4, 4) camera-to-world, camera axes as in OpenGL.
    - LLFF: a file `poses_bounds.npy`, a row of 17 numbers for each picture in the folder `images` beside it, in the
      order of names: (3, 5) camera axes down, right, back, position, and (height, width, focal length); near, far.

    Args:
        path: one of these files, or its folder.
        split: which transforms_….json of a folder: "train", "val" or "test".
        downscale: n, for images of 1/n of the size: means of n × n premultiplied pixels, encoded as `linear` says. In
            LLFF the folder `images_n` is used instead, if it exists.
        linear: True if images are to be linear, as `rts.load_image` gives them; False for the numbers of the file, sRGB
            as a rule. NeRF is trained on these, composited and averaged as they are.
        background: "white", "black" or a colour (3,), encoded like the images, to put them on: (H, W, 3); None for
            (H, W, 4) premultiplied.
        pixel_center: place in each returned pixel, in x and in y, through which its ray passes. The centre is 0.5.
            NeRF's rays passed through 0 of the pixels it was trained on; so through (n − 1) / 2n of pixels that are
            means of n × n of those (0.375 for 100² of 400²).
        frame: "file" for the world of the file; "nerf" for that in which NeRF is trained on LLFF scenes: about the mean
            of all cameras, which looks along −z, and so large that the nearest bound is 1 / 0.75. Blender's is the
            same in both.
        near: near plane of the cameras; default 0.01, or a hundredth of the nearest bound.
        far: far plane; default 1000, or a hundred times the farthest bound.
        cache: True to keep each image once it is read.

    Returns:
        A list of views: `camera` (float64 NumPy), `size`, `image` (float32), `name`, and `near` and `far` of the scene
        (LLFF's bounds; None for Blender's, which tells none).

    Raises:
        InputError: a file is missing, damaged or incomplete; a matrix is no rotation and position; an image is missing,
            damaged, or of a size that does not fit; pickles, which are never loaded; or an argument is none of these.
    """
    path = _checked(as_path(path), split, downscale, pixel_center, frame)
    if linear not in (True, False) or cache not in (True, False):
        raise InputError(f"linear is {quoted(linear)} and cache {quoted(cache)}; expected True or False")
    planes = near, far
    for name, plane in zip(("near", "far"), planes, strict=True):
        if plane is not None and not (is_real(plane) and 0 < plane < math.inf):
            raise InputError(f"{name} is {quoted(plane)}; expected a positive number, or None")
    behind = None if background is None else colour_named(background)
    posed = _blender(path, downscale) if path.suffix.lower() == ".json" else _llff(path, downscale, frame)
    reading = functools.partial(_read, linear=bool(linear), behind=behind)
    views = []
    for pose in posed:
        image = functools.partial(reading, pose.path, pose.size, pose.downscale)
        views.append(_view(pose, pixel_center, planes, functools.cache(image) if cache else image))
    return views


def colour_named(colour: Any) -> np.ndarray:
    """(3,) float32 of "white", "black" or three numbers in [0, 1].

    Raises:
        InputError: it is something else.
    """
    value = COLOURS.get(colour) if isinstance(colour, str) else colour
    if isinstance(colour, str) and value is None:
        raise InputError(f"background is {quoted(colour)}; expected 'white', 'black' or a colour (3,)")
    known = check_numbers("background", value, (3,))
    if known is None or known.min() < 0 or known.max() > 1:
        raise InputError(f"background is {quoted(colour)}; expected a colour (3,) of numbers from 0 to 1")
    return known.astype(np.float32)


class _Pose(NamedTuple):
    """A picture's entry in a file: full size, reduction still to be made, focal length over width, bounds."""

    path: Path
    size: tuple[int, int]
    downscale: int
    camera_to_world: np.ndarray
    focal: float
    near: float | None = None
    far: float | None = None


def _checked(path: Path, split: Any, downscale: Any, pixel_center: Any, frame: Any) -> Path:
    """The file of cameras that the path names, or that its folder holds. Other arguments are checked, too."""
    if not is_count(downscale):
        raise InputError(f"downscale is {quoted(downscale)}; expected an integer of at least 1")
    if not (is_real(pixel_center) and -1 <= pixel_center <= 2):
        raise InputError(f"pixel_center is {quoted(pixel_center)}; expected a number such as 0.5, in pixels")
    if not isinstance(frame, str) or frame not in ("file", "nerf"):
        raise InputError(f"frame is {quoted(frame)}; expected 'file' or 'nerf'")
    if not isinstance(split, str):
        raise InputError(f"split is {quoted(split)}; expected a name such as 'train'")
    if path.is_dir():
        candidates = [path / "poses_bounds.npy", as_path(path / f"transforms_{split}.json"), path / "transforms.json"]
        existing = [p for p in candidates if p.is_file()]
        if not existing:
            names = ", ".join(p.name for p in candidates)
            raise InputError(f"the folder {path} has none of {names}; expected a data set of Blender's or LLFF's form")
        if len(existing) > 1:
            raise InputError(f"the folder {path} has {' and '.join(p.name for p in existing)}; give the path of one")
        return existing[0]
    if not path.is_file():
        raise InputError(f"there is no file {path}; check the path (relative paths start at {Path.cwd()})")
    if path.suffix.lower() not in (".json", ".npy"):
        raise InputError(f"{path} is no file of cameras; expected transforms_….json or poses_bounds.npy")
    return path


def _view(
    pose: _Pose,
    pixel_center: float,
    planes: tuple[float | None, float | None],
    image: Callable[[], np.ndarray],
) -> View:
    (height, width), n = pose.size, pose.downscale
    if height % n or width % n:
        raise InputError(f"{pose.path} has {width} × {height} pixels, which are no multiples of downscale = {n}")
    size = height // n, width // n
    near, far = planes
    near = near or (PLANES[0] if pose.near is None else pose.near / MARGIN)
    far = far or (PLANES[1] if pose.far is None else pose.far * MARGIN)
    camera = Camera.from_blender(pose.camera_to_world, size, focal=pose.focal * size[1], near=near, far=far)
    if pixel_center != 0.5:
        shift: Any = pixel_center - 0.5  # A window may lie between pixels.
        camera = camera.window(size, (shift, shift), size)
    return View(camera, image, size, name=pose.path.name, near=pose.near, far=pose.far)


def _read(path: Path, size: tuple[int, int], n: int, *, linear: bool, behind: np.ndarray | None) -> np.ndarray:
    """(h, w, 4) premultiplied of a picture, or (h, w, 3) on a colour; means of n × n pixels."""
    if linear:
        image = load_image(path)
    else:
        if not path.is_file():
            raise InputError(f"there is no picture {path}; it was there when the views were loaded")
        with gathered(path) as notes:
            encoded = read_image(path)
        for note in notes:
            warn(note, FileWarning)
        alpha = encoded[..., 3:] if encoded.shape[2] == 4 else np.ones_like(encoded[..., :1])
        image = np.concatenate([encoded[..., :3] * alpha, alpha], axis=2)
    if image.shape[:2] != size:
        raise InputError(f"{path} has {image.shape[1]} × {image.shape[0]} pixels, and had {size[1]} × {size[0]} before")
    if n > 1:
        height, width = size
        image = image.reshape(height // n, n, width // n, n, 4).mean(axis=(1, 3))
    return image if behind is None else image[..., :3] + (1 - image[..., 3:]) * behind


def _picture_size(path: Path) -> tuple[int, int]:
    """(height, width) of a picture, from its header alone."""
    from PIL import Image

    try:
        with gathered(path), Image.open(path) as image:
            return image.height, image.width
    except Exception as error:  # Pillow raises many kinds.
        said = " ".join(str(error).split())
        raise InputError(f"{path} cannot be read as an image ({said}); export it again, as PNG for example") from error


# ------------------------------------------------------------------------------------------------------------ Blender


def _blender(path: Path, downscale: int) -> list[_Pose]:
    try:
        tree = json.loads(contents(path))
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError.
        said = " ".join(str(error).split())[:80]
        raise InputError(f"{path} is no JSON ({said}); the file may be cut short: export it again") from error
    if not isinstance(tree, Mapping):
        raise InputError(f"{path} holds a {type(tree).__name__}; expected an object with camera_angle_x and frames")
    angle: Any = tree.get("camera_angle_x")
    frames = tree.get("frames")
    if not is_real(angle) or not 0 < angle < math.pi:
        what = "lacks camera_angle_x" if angle is None else f"has a camera_angle_x of {quoted(angle)}"
        raise InputError(f"{path} {what}; expected the horizontal field of view in radians, between 0 and π")
    if not isinstance(frames, list) or not frames:
        what = "frames that are no list" if frames else "no frames"
        raise InputError(f"{path} has {what}; expected at least one")
    focal = 0.5 / math.tan(0.5 * angle)
    poses = []
    for i, frame in enumerate(frames):
        place = f"{path}, frame {i}"
        if not isinstance(frame, Mapping) or not {"file_path", "transform_matrix"} <= set(frame):
            raise InputError(f"{place} lacks file_path or transform_matrix; export the file again")
        if not isinstance(frame["file_path"], str):
            raise InputError(f"{place} has a file_path that is {quoted(frame['file_path'])}; expected a name")
        matrix = _rigid(place, frame["transform_matrix"], (4, 4), (3, 4))
        picture = _named(path, place, frame["file_path"])
        size = _picture_size(picture)
        _check_lens(place, {**tree, **frame}, focal, size)
        poses.append(_Pose(picture, size, downscale, matrix, focal))
    return poses


def _check_lens(place: str, lens: Mapping[str, Any], focal: float, size: tuple[int, int]) -> None:
    """Refuse lenses that other tools write and that are not supported: distortion, and axes off the centre."""
    bent = [k for k in ("k1", "k2", "k3", "k4", "p1", "p2") if lens.get(k)]
    if bent:
        raise InputError(f"{place} has a lens that distorts ({', '.join(bent)}), which is not followed; undistort it")
    width = lens["w"] if is_real(lens.get("w")) and lens["w"] > 0 else size[1]
    height = width * size[0] / size[1]
    for key, expected in (("fl_x", focal * width), ("fl_y", focal * width), ("cx", width / 2), ("cy", height / 2)):
        value = lens.get(key, expected)
        if not is_real(value) or not abs(value - expected) <= OFF_CENTRE * width:
            raise InputError(
                f"{place} has {key} = {quoted(value)}, where camera_angle_x makes it {expected:.6g}; expected a camera "
                "of square pixels that looks through the middle of its image"
            )


def _named(path: Path, place: str, name: str) -> Path:
    """The picture that a frame names, with or without its extension."""
    for extension in ("", *EXTENSIONS):
        candidate = inside(path.parent, name + extension, path)
        if candidate.is_file():
            return candidate
    raise InputError(f"{place} refers to the picture {name[:60]!r}, but there is no such file, nor {name[:60]}.png")


def _rigid(place: str, matrix: Any, *shapes: tuple[int, ...]) -> np.ndarray:
    """A camera-to-world matrix (4, 4), refused where it is more than a rotation and a position."""
    try:
        known = check_numbers("the matrix", matrix, *shapes)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
    if known is None:
        raise InputError(f"{place}: the matrix is not known; expected numbers")
    whole = np.eye(4)
    whole[: known.shape[0]] = known
    rotation = whole[:3, :3]
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0 or np.abs(whole[3] - [0, 0, 0, 1]).max() > 1e-5:
        raise InputError(
            f"{place}: the matrix is no rotation and position, but scales, shears or mirrors; export it again"
        )
    return whole


# --------------------------------------------------------------------------------------------------------------- LLFF


def _llff(path: Path, downscale: int, frame: str) -> list[_Pose]:
    try:
        rows = np.load(path, allow_pickle=False)
        if not isinstance(rows, np.ndarray):
            raise ValueError("it holds several arrays")
    except Exception as error:  # NumPy raises many kinds.
        said = " ".join(str(error).split())[:80]
        raise InputError(f"{path} is no array of numbers ({said}); expected numpy.save's, without pickles") from error
    if rows.ndim != 2 or rows.shape[1] != ROW or not len(rows) or rows.dtype.kind not in "fiu":
        raise InputError(f"{path} has shape {rows.shape} and dtype {rows.dtype}; expected (N, {ROW}) numbers")
    rows = rows.astype(np.float64)
    if not np.isfinite(rows).all():
        raise InputError(f"{path} holds NaN or infinity; make the file again")
    left = downscale
    folder = path.parent / f"images_{downscale}"
    if downscale > 1 and folder.is_dir():
        left = 1
    else:
        folder = path.parent / "images"
    if not folder.is_dir():
        raise InputError(f"{path} has no folder {folder.name} beside it; expected its pictures there")
    pictures = sorted(p for p in folder.iterdir() if p.suffix.lower() in EXTENSIONS)
    if len(pictures) != len(rows):
        raise InputError(f"{path} has {len(rows)} poses, but {folder} {len(pictures)} pictures; expected as many")
    matrices, bounds = rows[:, :-2].reshape(-1, 3, HEADER), rows[:, -2:]
    poses = []
    for i, (picture, matrix, (near, far)) in enumerate(zip(pictures, matrices, bounds, strict=True)):
        place = f"{path}, row {i}"
        down, right, back, position, (height, width, focal) = matrix.T
        pose = _rigid(place, np.stack([right, -down, back, position], axis=1), (3, 4))
        if min(height, width, focal) <= 0 or not 0 < near < far:
            raise InputError(
                f"{place} has height {height:g}, width {width:g}, focal length {focal:g}, bounds {near:g} and {far:g}; "
                "expected positive numbers, bounds in order"
            )
        size = _picture_size(picture)
        # Pictures that were made smaller are rounded to whole pixels.
        if abs(size[0] * width / height - size[1]) > 1 + size[1] / size[0]:
            raise InputError(
                f"{picture} has {size[1]} × {size[0]} pixels, and {place} says {width:g} × {height:g}: another shape"
            )
        poses.append(_Pose(picture, size, left, pose, focal / width, float(near), float(far)))
    return _nerf_frame(poses) if frame == "nerf" else poses


def _nerf_frame(poses: list[_Pose]) -> list[_Pose]:
    """The poses relative to their mean, scaled so that the nearest bound is 1 / 0.75."""
    scale = 1 / (SCALE_OF_NEAREST * min(pose.near or math.inf for pose in poses))
    matrices = np.stack([pose.camera_to_world for pose in poses])
    matrices[:, :3, 3] *= scale
    _, up, back, position = matrices.mean(axis=0)[:3].T
    right = np.cross(up, back)
    axes = [right, np.cross(back, right), back]
    if min(np.linalg.norm(axis) for axis in axes) < 1e-6:
        raise InputError("the cameras look all ways, so that they have no mean; expected a scene that faces forward")
    mean = np.eye(4)
    mean[:3, :3] = np.stack([axis / np.linalg.norm(axis) for axis in axes], axis=1)
    mean[:3, 3] = position
    recentred = np.linalg.inv(mean) @ matrices
    return [
        pose._replace(camera_to_world=m, near=(pose.near or 0) * scale, far=(pose.far or 0) * scale)
        for pose, m in zip(poses, recentred, strict=True)
    ]
