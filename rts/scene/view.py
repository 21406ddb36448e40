"""A view: a picture, the camera that took it, and where the picture counts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rts.arrays.argument_checks import check_pixels, quoted
from rts.errors import InputError
from rts.scene.camera import Camera

Reading = Callable[[], np.ndarray]


class View:
    """A picture, and the camera that took it.

    `camera` may be set to another one, such as one that was fitted: see `rts.save_views`.

    Args:
        camera: the camera, float64 NumPy.
        image: (H, W, 4) float32 premultiplied, or (H, W, 3) on a background; or a function that returns it, called at
            each use.
        size: (height, width) of the image, pixels; needed where `image` is a function.
        name: the picture's name in its file.
        mask: (H, W) float32 from 0 to 1, 1 where the picture counts; or a function that returns it; None for all of it.
        near: the depth at which what is seen begins, in the units of the camera; None where that is not known.
        far: the depth at which it ends, or None.
        path: the file of the picture, or None.
        lens: the lens that took the picture in `path`, for images of this size; None for one that does not distort.

    Raises:
        InputError: no camera of one view, or an image or mask of another size.
    """

    def __init__(
        self,
        camera: Camera,
        image: np.ndarray | Reading,
        size: tuple[int, int] | None = None,
        *,
        name: str = "",
        mask: np.ndarray | Reading | None = None,
        near: float | None = None,
        far: float | None = None,
        path: Path | None = None,
        lens: Any = None,
    ):
        if not isinstance(camera, Camera) or camera.is_stacked:
            raise InputError(f"camera is {quoted(camera)}; expected an rts.Camera of one view")
        for what, value in (("image", image), ("mask", mask)):
            if not (callable(value) or hasattr(value, "shape") or (what == "mask" and value is None)):
                raise InputError(f"{what} is {quoted(value)}; expected an array, or a function that gives one")
        if size is None:
            if callable(image):
                raise InputError("size is None, and image is a function; expected its (height, width), pixels")
            size = np.shape(image)[:2]
        self.camera, self.size, self.name, self.near, self.far = camera, check_pixels(size), name, near, far
        self.path, self.lens = path, lens
        self._image, self._mask = image, mask
        for what, value in (("image", image), ("mask", mask)):
            if value is not None and not callable(value):
                self._check(what, np.shape(value))

    def _check(self, what: str, shape: tuple[int, ...]) -> None:
        if shape[:2] != self.size or not (shape[2:] in ((3,), (4,)) if what == "image" else shape[2:] == ()):
            channels = ", 3 or 4" if what == "image" else ""
            height, width = self.size
            raise InputError(f"{what} has shape {shape}; expected ({height}, {width}{channels})")

    def __repr__(self) -> str:
        return f"View({self.name!r}, {self.size[1]} × {self.size[0]})"

    @property
    def image(self) -> np.ndarray:
        """(H, W, 4) float32 premultiplied, or (H, W, 3) on the background; read now, if it is not kept.

        Where the picture is not defined (`mask`) it is transparent, or the background.

        Raises:
            InputError: the picture is gone, damaged, or was exchanged for one of another size.
        """
        return self._image() if callable(self._image) else self._image

    @property
    def mask(self) -> np.ndarray | None:
        """(H, W) float32 in [0, 1]: 1 where the picture is defined and counts; None where it does everywhere.

        Of `rts.load_views`, the product of the mask's picture, if there is one, and of the part that is defined once a
        lens's distortion is undone. A picture's own alpha is no part of it.

        Raises:
            InputError: the mask is gone, damaged, or was exchanged for one of another size.
        """
        return self._mask() if callable(self._mask) else self._mask
