"""load_views: posed images of any format that is known. Images are read when they are needed.

Cameras, and whether every image is there and can be opened, are checked at once.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rts.arrays.argument_checks import check_numbers, quoted
from rts.contracts.checks import is_count, is_real
from rts.errors import InputError
from rts.files.paths import as_path
from rts.files.views.blender import blender
from rts.files.views.colmap import CAMERAS, cameras_in, colmap
from rts.files.views.llff import llff
from rts.files.views.opencv_json import opencv
from rts.files.views.pictures import read_mask, read_picture
from rts.files.views.poses import PosedPicture, read_json
from rts.rendering.arguments import ColorLike
from rts.scene.camera import Camera
from rts.scene.view import Reading, View

COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
PLANES = (0.01, 1e6)
"""Near and far planes of cameras whose file tells no bounds."""
MARGIN = 100.0
"""Factor by which a camera's planes lie nearer, and farther, than the bounds of depth in its file."""


def load_views(
    path: Any,
    *,
    split: str | None = None,
    downscale: int = 1,
    linear: bool = True,
    background: Literal["white", "black"] | ColorLike | None = None,
    pixel_center: float = 0.5,
    frame: str = "file",
    near: float | None = None,
    far: float | None = None,
    cache: bool = False,
) -> list[View]:
    """The posed images of a data set, in the order of its file; the images are read when they are needed.

    - Blender: a file `transforms_….json` of frames, each with file_path (with or without its extension, beside the
      file) and transform_matrix, (4, 4) camera-to-world, camera axes as in OpenGL. The file, or each frame, states
      camera_angle_x; or, as in instant-ngp and nerfstudio, fl_x, fl_y, cx, cy for pictures of w × h pixels, k1, k2,
      k3, p1, p2, camera_model (one of COLMAP's below) or is_fisheye, and mask_path.
    - LLFF: a file `poses_bounds.npy`, a row of 17 numbers for each picture in the folder `images` beside it, in the
      order of names: (3, 5) camera axes down, right, back, position, and (height, width, focal length); near, far.
    - COLMAP: a sparse model, `cameras.bin`, `images.bin` and, if it is there, `points3D.bin`, or the same as .txt, in
      `sparse/0`, in `sparse` or in the folder itself. Pictures are in the folder `images` (of `sparse`, beside it), in
      the order of names. Camera models: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, OPENCV_FISHEYE and
      FULL_OPENCV.
    - OpenCV: a file `cameras.json` with `views`, a list of {"image": name, "K": (3, 3), "R": (3, 3), "t": (3,)}:
      x = K (R X + t), so world-to-camera, camera axes x right, y down, z forward. If a view has them, also
      "distortion": 4, 5 or 8 coefficients in OpenCV's order (k1, k2, p1, p2, k3, k4, k5, k6), "fisheye": true for
      cv2.fisheye's k1 to k4, "width" and "height" that K is for, and "mask": name. Entries that all views share may
      stand beside `views`.

    Pixels: the centre of the first pixel is (0.5, 0.5) in Blender's cx and cy and in COLMAP, as in `rts`. In OpenCV it
    is (0, 0): cx and cy of K are moved by half a pixel.

    Sizes: pictures of another size than the file states, but of the same shape, have cameras scaled to them.

    Distortion: a picture of a lens that distorts is undistorted when it is read, to the same size, focal lengths and
    principal point, bilinearly. A barrel loses its outer parts. Pixels that the lens would have taken from outside of
    its picture are transparent (or background), and 0 in the mask. Cameras have no distortion.

    Masks: `View.mask` is the product of the pixels that are defined and of a picture, 1 where white: mask_path, "mask",
    or beside the folder `images`, as COLMAP has it, `masks/NAME.png` (`masks/IMG.jpg.png`, else `masks/IMG.png`);
    pictures without one count everywhere. Values are taken as they are encoded. Masks have the size of their pictures,
    and are made smaller with them. Alpha is no mask.

    Args:
        path: one of these files (of COLMAP's: the cameras'), or its folder, if it has one of them alone, a
            COLMAP model aside: the others come before it.
        split: which transforms_….json of a folder: "train", "val" or "test". COLMAP tells none: "test" is every eighth
            picture in the order of names, the first one among them, as in mip-NeRF 360; "train" all others, "all" all.
            LLFF and OpenCV have all. A folder with one transforms.json has no others: leave `split` out. None is
            "train", and a warning says how many of COLMAP's are left out.
        downscale: n, for images of 1/n of the size: means of n × n premultiplied pixels, encoded as `linear` says. In
            LLFF and COLMAP the folder `images_n` is used instead, if it exists, and its masks `masks_n`, or `masks`.
        linear: True if images are to be linear, as `rts.load_image` gives them; False for the numbers of the file, sRGB
            as a rule. NeRF is trained on these, composited and averaged as they are.
        background: "white", "black" or a colour (3,), encoded like the images, to put them on: (H, W, 3); None for
            (H, W, 4) premultiplied.
        pixel_center: place in each returned pixel, in x and in y, through which its ray passes. The centre is 0.5.
            NeRF's rays passed through 0 of the pixels it was trained on; so through (n − 1) / 2n of pixels that are
            means of n × n of those (0.375 for 100² of 400²).
        frame: "file" for the world of the file; "nerf" for that in which NeRF is trained on LLFF data sets: about the
            mean of all cameras, which looks along −z, and so large that the nearest bound is 1 / 0.75. Blender's is the
            same in both; COLMAP and OpenCV have the first alone.
        near: near plane of the cameras; default 0.01, or a hundredth of the nearest bound.
        far: far plane; default 1e6, or a hundred times the farthest bound.
        cache: True to keep each image, and each mask, once it is read.

    Returns:
        A list of views: `camera` (float64 NumPy), `size`, `image` (float32), `mask` (float32, or None), `name`, `path`,
        and `near` and `far`, depths between which what is seen lies: LLFF's bounds; of COLMAP, the percentiles 0.1 and
        99.9 of the depths of the points that the picture sees; None where the file tells none.

    Raises:
        InputError: a file is missing, damaged or incomplete; a matrix is no rotation and position; an image or a mask
            is missing, damaged, or of a size that does not fit; a camera model that is not followed; pickles, which are
            never loaded; or an argument is none of these.

    Warns:
        FileWarning: pictures of a COLMAP model are left out, and no `split` was given; or its folder of masks has none
            of its pictures.
    """
    path = _checked(as_path(path), split, downscale, pixel_center, frame)
    if linear not in (True, False) or cache not in (True, False):
        raise InputError(f"linear is {quoted(linear)} and cache {quoted(cache)}; expected True or False")
    planes = near, far
    for name, plane in zip(("near", "far"), planes, strict=True):
        if plane is not None and not (is_real(plane) and 0 < plane < math.inf):
            raise InputError(f"{name} is {quoted(plane)}; expected a positive number, or None")
    behind = None if background is None else colour_named(background)
    keep = functools.cache if cache else lambda reading: reading
    views = []
    for pose in _poses(path, split, downscale, frame):
        image = keep(functools.partial(read_picture, pose, linear=bool(linear), behind=behind))
        mask = keep(functools.partial(read_mask, pose)) if pose.mask or pose.lens.distorts else None
        views.append(_view(pose, pixel_center, planes, image, mask))
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


def _checked(path: Path, split: Any, downscale: Any, pixel_center: Any, frame: Any) -> Path:
    """The file of cameras that the path names, or that its folder holds. Other arguments are checked, too."""
    if not is_count(downscale):
        raise InputError(f"downscale is {quoted(downscale)}; expected an integer of at least 1")
    if not (is_real(pixel_center) and -1 <= pixel_center <= 2):
        raise InputError(f"pixel_center is {quoted(pixel_center)}; expected a number such as 0.5, in pixels")
    if not isinstance(frame, str) or frame not in ("file", "nerf"):
        raise InputError(f"frame is {quoted(frame)}; expected 'file' or 'nerf'")
    if not (split is None or isinstance(split, str)):
        raise InputError(f"split is {quoted(split)}; expected a name such as 'train'")
    if path.is_dir():
        found = _cameras_of_folder(path, split or "train")
        if found.name == "transforms.json" and split not in (None, "all"):
            raise InputError(
                f"the folder {path} has no transforms_{split}.json; leave split out for all views of transforms.json"
            )
        if found.name == "cameras.json" and split not in (None, "train", "val", "test", "all"):
            raise InputError(f"split is {quoted(split)}; expected 'train', 'val', 'test' or 'all'")
        return found
    if not path.is_file():
        raise InputError(f"there is no file {path}; check the path (relative paths start at {Path.cwd()})")
    if path.suffix.lower() not in (".json", ".npy") and path.name not in CAMERAS:
        raise InputError(
            f"{path} is no file of cameras; expected transforms_….json, poses_bounds.npy, cameras.json, or COLMAP's "
            f"{' or '.join(CAMERAS)}"
        )
    return path


def _cameras_of_folder(path: Path, split: str) -> Path:
    """The one file of cameras in a folder."""
    candidates = [
        path / "poses_bounds.npy",
        as_path(path / f"transforms_{split}.json"),
        path / "transforms.json",
        path / "cameras.json",
    ]
    # The files of other formats were made from a COLMAP model, which often stays beside them.
    existing = [p for p in candidates if p.is_file()] or [p for p in [cameras_in(path)] if p is not None]
    if not existing:
        names = ", ".join(p.name for p in candidates)
        raise InputError(
            f"the folder {path} has none of {names}, sparse/0/cameras.bin, cameras.bin or .txt; expected a data set of "
            "Blender's, LLFF's, OpenCV's or COLMAP's form"
        )
    if len(existing) > 1:
        names = " and ".join(str(p.relative_to(path)) for p in existing)
        raise InputError(f"the folder {path} has {names}; give the path of one")
    return existing[0]


def _poses(path: Path, split: str | None, downscale: int, frame: str) -> list[PosedPicture]:
    """The entries of a file of cameras."""
    kind = path.suffix.lower()
    if kind == ".npy":
        return llff(path, downscale, frame)
    tree = read_json(path) if kind == ".json" else {}
    if kind == ".json" and "views" not in tree:
        return blender(path, tree, downscale)
    if frame == "nerf":
        raise InputError(f"frame is 'nerf', which is for data sets of LLFF's format; expected 'file' for {path}")
    return opencv(path, tree, downscale) if kind == ".json" else colmap(path, split, downscale)


def _view(
    pose: PosedPicture,
    pixel_center: float,
    planes: tuple[float | None, float | None],
    image: Reading,
    mask: Reading | None,
) -> View:
    (height, width), n = pose.size, pose.downscale
    if height % n or width % n:
        raise InputError(f"{pose.path} has {width} × {height} pixels, which are no multiples of downscale = {n}")
    size, lens = (height // n, width // n), pose.lens.scaled(1 / n, 1 / n)
    near, far = planes
    near = near or (PLANES[0] if pose.near is None else pose.near / MARGIN)
    far = far or (PLANES[1] if pose.far is None else pose.far * MARGIN)
    camera = Camera.from_opencv(lens.matrix, np.eye(3), np.zeros(3), size, near=near, far=far, pixel_center=0.5)
    # The inverse, not the transpose, of a rotation that is written with few digits.
    camera = camera.replace(view=np.linalg.inv(pose.camera_to_world))
    if pixel_center != 0.5:
        shift: Any = pixel_center - 0.5  # A window may lie between pixels.
        camera = camera.window(size, (shift, shift), size)
    lens = lens if lens.distorts else None
    depths: Any = {"near": pose.near, "far": pose.far}
    return View(camera, image, size, name=pose.name, mask=mask, path=pose.path, lens=lens, **depths)
