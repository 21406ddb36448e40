"""A view: a picture, the camera that took it, and where the picture counts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from rts.files.views.lenses import Lens
from rts.scene.camera import Camera

Reading = Callable[[], np.ndarray]


class View:
    """A picture, and the camera that took it.

    `camera` may be set to another one, such as one that was fitted: see `rts.save_views`.

    Args:
        camera: the camera, float64 NumPy.
        size: (height, width) of the image, pixels.
        image: (H, W, 3 or 4) float32, or a function that returns the image, called at each use.
        name: the picture's name in its file.
        near: the depth at which the scene begins, in the units of the camera; None where that is not known.
        far: the depth at which it ends, or None.
        mask: (H, W) float32, a function that returns it, or None.
        path: the picture, or None.
        lens: the lens that took the picture in `path`, for images of this size; None for one that does not distort.
    """

    def __init__(
        self,
        camera: Camera,
        size: tuple[int, int],
        image: np.ndarray | Reading,
        name: str = "",
        near: float | None = None,
        far: float | None = None,
        *,
        mask: np.ndarray | Reading | None = None,
        path: Path | None = None,
        lens: Lens | None = None,
    ):
        self.camera, self.size, self.name, self.near, self.far = camera, size, name, near, far
        self.path, self.lens = path, lens
        self._image, self._mask = image, mask

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

        The product of the mask's picture, if there is one, and of the part that is defined once a lens's distortion is
        undone. A picture's own alpha is no part of it.

        Raises:
            InputError: the mask is gone, damaged, or was exchanged for one of another size.
        """
        return self._mask() if callable(self._mask) else self._mask
