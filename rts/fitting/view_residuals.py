"""Residuals of pictures from many views, which are read when they are needed."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, Literal

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.engines import namespace
from rts.arrays.trees import Array, Tree
from rts.contracts.checks import is_real
from rts.contracts.residuals import Residuals
from rts.errors import FileWarning, InputError, InputWarning, warn
from rts.fitting.exposure import exposed
from rts.fitting.image_residuals import ImageResiduals
from rts.fitting.losses import Loss
from rts.fitting.schedule import Stage
from rts.fitting.view_arguments import check_functions, checked_draws, checked_views, checked_weights
from rts.operations.linear import matmul
from rts.rendering.arguments import BackgroundLike, Layers, SamplerLike, SplatterLike
from rts.scene.camera import Camera
from rts.scene.view import View

Key = tuple[int, tuple[int, int] | None]
"""A view's number; and top and left of its window, pixels, or None for the whole picture."""

MEMORY = 2**31
"""Bytes of pictures that are kept, unless told otherwise."""
INVERTED, HOLE = 0.95, 0.005
"""An alpha that is 1 in this share of the border, and 0 in this share of the picture, is probably inverted."""


class ViewResiduals(Residuals):
    """The differences between renders of a scene and pictures of it, for `rts.fit`.

    Each picture is a term of its own; the loss is the mean of the pictures' mean losses. Pictures are read when they
    are needed, and kept within a bound of memory. With jax, pictures of one size share a compiled program.

    Args:
        scene: parameters → part or parts, in the world of the views' cameras. See `per_view`.
        views: the views, such as `rts.load_views` gives; at least one.
        batch: the number of views that count at a step: all are shuffled, taken one batch after the other, and
            shuffled again. None for all views at every step, as Levenberg–Marquardt needs them.
        window: (height, width) of the part of each picture that counts at a step, at random places; None for all of it.
        seed: of the shuffles and places. The same seed and step give the same.
        per_view: True where each view shows a scene of its own, such as a robot with other joints: it is
            `scene(parameters, view)`, of the view's number, an integer array that may be traced.
        cameras: `cameras(parameters, camera, view)` → camera, to fit cameras: from the view's own `camera` and the
            view's number, an integer array that may be traced. None for the views' own cameras. For example
            `lambda p, camera, i: camera.within(rts.rigid(p["poses"][i]))`, where the world moves before the camera.
        exposure: `exposure(parameters)` → gain and offset, each (B,) or (B, 3) for the B views, or None. Colours are
            multiplied by the gain, and the offset times alpha is added. The background stays as it is.
        weights: (B,) factors on the differences of each view; None for ones. A view's own mask is a factor, too.
        target: view → (H, W), (H, W, 3) or (H, W, 4), the picture to compare with, as in `ImageResiduals`; None for
            `view.image`. For silhouettes `lambda view: view.image[..., 3]`.
        unreadable: "error" to refuse a picture that cannot be read, when it is read; "skip" to read every picture once
            at the start, and leave out, with a warning, the views whose picture cannot be read.
        memory: bytes of pictures that are kept; each is dropped when it was not used for longest.
        background: as in `rts.render`: a colour, the same for every view.
        sampler: as in `rts.render`.
        splatter: as in `rts.render`.
        layers: as in `rts.render`.
        supersample: as in `rts.render`.
        capacity: as in `rts.render`.
        channels: as in `ImageResiduals`.
        loss: as in `ImageResiduals`.
        f_scale: as in `ImageResiduals`.

    Attributes:
        views: the views, without those that were left out.

    Raises:
        InputError: an argument of the wrong kind; or at reading, a picture that is missing, damaged, or of another size
            than its view. It names the view.

    Warns:
        FileWarning: a view was left out.
        InputWarning: an alpha that looks inverted.
    """

    def __init__(
        self,
        scene: Callable[..., Any],
        views: Sequence[View],
        *,
        batch: int | None = None,
        window: tuple[int, int] | None = None,
        seed: int = 0,
        per_view: bool = False,
        cameras: Callable[[Tree, Camera, Array], Camera] | None = None,
        exposure: Callable[[Tree], Any] | None = None,
        weights: Any = None,
        target: Callable[[View], Any] | None = None,
        unreadable: Literal["error", "skip"] = "error",
        memory: int = MEMORY,
        background: BackgroundLike = None,
        sampler: SamplerLike = "auto",
        splatter: SplatterLike = "auto",
        layers: Layers = "auto",
        supersample: int = 1,
        capacity: int | None = None,
        channels: int = 3,
        loss: str | Loss = "linear",
        f_scale: float | None = None,
    ):
        self.views = checked_views(views)
        check_functions(scene, cameras, exposure, target)
        self._scene, self._cameras, self._exposure, self._target = scene, cameras, exposure, target
        if not isinstance(per_view, bool):
            raise InputError(f"per_view is {quoted(per_view)}; expected True or False")
        self._weights, self._per_view = checked_weights(weights, len(self.views)), per_view
        self._batch, self._window = checked_draws(batch, window, self.views)
        if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
            raise InputError(f"seed is {quoted(seed)}; expected a whole number, at least 0")
        if not isinstance(unreadable, str) or unreadable not in ("error", "skip"):
            raise InputError(f"unreadable is {quoted(unreadable)}; expected 'error' or 'skip'")
        if not (is_real(memory) and memory >= 0):
            raise InputError(f"memory is {quoted(memory)}; expected a number of bytes")
        self._seed, self._memory = int(seed), float(memory)
        self._kept: OrderedDict[int, tuple[np.ndarray, np.ndarray | None]] = OrderedDict()
        self._warned = False
        self._options: dict[str, Any] = {
            "background": background,
            "sampler": sampler,
            "splatter": splatter,
            "layers": layers,
            "supersample": supersample,
            "capacity": capacity,
            "channels": channels,
            "loss": loss,
            "f_scale": f_scale,
        }
        # Other options are refused now, not at the first step.
        self._like = ImageResiduals(scene, None, (1, 1), np.zeros((1, 1), np.float32), **self._options)
        self._stage: Stage | None = None
        if unreadable == "skip":
            self._leave_out_unreadable()

    @property
    def loss(self) -> Loss:  # pyright: ignore[reportIncompatibleVariableOverride]  # Never None, nor set.
        """The loss of each number of the differences."""
        return self._like.loss

    @property
    def supersample(self) -> int:
        """Samples a pixel along each axis."""
        of_stage = None if self._stage is None else self._stage.supersample
        return self._like.supersample if of_stage is None else of_stage

    def __repr__(self) -> str:
        return f"ViewResiduals({len(self.views)} views)"

    def __call__(self, parameters: Tree) -> Array:
        """The differences of all views, one after the other, as one vector."""
        terms = [self.of(self.load(key))(parameters) for key in self.draw(None)]
        xp = namespace(*terms)
        return xp.concat([xp.reshape(x, (-1,)) for x in terms])

    def at_stage(self, stage: Stage) -> ViewResiduals:
        """The residuals at the resolution of a stage; see `ImageResiduals.at_stage`."""
        other = copy(self)
        other._stage = stage
        return other

    # --------------------------------------------------------------------------------------------------- terms

    def draw(self, step: int | None) -> list[Key]:
        """Keys of the views that count at a step; see `rts.Residuals`."""
        count = len(self.views)
        if step is None or (self._batch is None and self._window is None):
            return [(i, None) for i in range(count)]
        batch = self._batch or count
        numbers = [self._shuffled(place // count)[place % count] for place in range(step * batch, (step + 1) * batch)]
        return [(i, self._corner(i, step)) for i in numbers]

    def _shuffled(self, epoch: int) -> list[int]:
        return np.random.default_rng((self._seed, 0, epoch)).permutation(len(self.views)).tolist()

    def _corner(self, number: int, step: int) -> tuple[int, int] | None:
        """Top and left of a view's window at a step."""
        if self._window is None:
            return None
        rng = np.random.default_rng((self._seed, 1, step, number))
        top, left = (rng.integers(n - m + 1) for n, m in zip(self.views[number].size, self._window, strict=True))
        return int(top), int(left)

    def load(self, key: Key) -> dict[str, Any]:
        """Arrays of a view, or of a window of it; see `rts.Residuals`.

        Returns:
            "camera", the view's own; "target", "weights" (or None); "view", the view's number; and for a window, (4, 4)
            "window": its clip space from that of the whole picture.
        """
        number, corner = key
        view = self.views[number]
        target, weights = self._picture(number)
        data: dict[str, Any] = {"camera": view.camera, "target": target, "weights": weights}
        if corner is not None and self._window is not None:
            (top, left), (height, width) = corner, self._window
            band = slice(top, top + height), slice(left, left + width)
            data |= {name: None if (x := data[name]) is None else x[band] for name in ("target", "weights")}
            data["window"] = Camera(np.eye(4), np.eye(4)).window(view.size, corner, self._window).projection
        return data | {"view": np.asarray(number, np.int32)}

    def of(self, data: dict[str, Any]) -> ImageResiduals:
        """The residuals of one view; see `rts.Residuals`."""

        def scene(parameters: Tree) -> tuple[Any, Camera]:
            camera = data["camera"]
            if self._cameras is not None:
                camera = self._cameras(parameters, camera, data["view"])
                if not isinstance(camera, Camera):
                    raise InputError(f"cameras gave {quoted(camera)}; expected an rts.Camera")
            if "window" in data:
                camera = camera.replace(projection=matmul(data["window"], camera.projection), aspect=None)
            parts = self._scene(parameters, data["view"]) if self._per_view else self._scene(parameters)
            if self._exposure is not None:
                parts = exposed(parts, self._exposure(parameters), data["view"], len(self.views))
            return parts, camera

        target = data["target"]
        residuals = ImageResiduals(scene, None, target.shape[:2], target, weights=data["weights"], **self._options)
        return residuals if self._stage is None else residuals.at_stage(self._stage)

    def normal_equations(self, parameters: Tree) -> tuple[Array, Array, Array]:
        """See `rts.Residuals`; of all views."""
        equations = [self.of(self.load(key)).normal_equations(parameters) for key in self.draw(None)]
        value, matrix, gradient = (sum(x[1:], x[0]) / len(x) for x in zip(*equations, strict=True))
        return value, matrix, gradient

    # ------------------------------------------------------------------------------------------------ pictures

    def _picture(self, number: int) -> tuple[np.ndarray, np.ndarray | None]:
        """The picture to compare a view with, (H, W, ·) float32; and weights (H, W) of differences, None for ones."""
        if number in self._kept:
            self._kept.move_to_end(number)
            return self._kept[number]
        view = self.views[number]
        try:
            picture = np.asarray(view.image if self._target is None else self._target(view))
            mask = view.mask
        except InputError as error:
            raise InputError(f"view {number}: {error}") from error
        if picture.shape[:2] != tuple(view.size) or picture.ndim > 3 or picture.dtype.kind != "f":
            height, width = view.size
            hint = "; divide one from 0 to 255 by 255" if picture.dtype == np.uint8 else ""
            raise InputError(
                f"view {number} ({view.name}) has a picture of shape {picture.shape} and dtype {picture.dtype}; "
                f"expected floats of shape ({height}, {width}, ·), as its camera is for{hint}"
            )
        self._warn_if_inverted(number, picture)
        known = picture.astype(np.float32, copy=False), self._factors(number, mask)
        self._kept[number] = known
        while (
            self._kept and sum(x.nbytes for pair in self._kept.values() for x in pair if x is not None) > self._memory
        ):
            self._kept.popitem(last=False)
        return known

    def _warn_if_inverted(self, number: int, picture: np.ndarray) -> None:
        alpha = picture if picture.ndim == 2 else picture[..., -1] if picture.shape[2] in (1, 4) else None
        if alpha is None or self._warned or min(alpha.shape) < 3:
            return
        rim = np.concatenate([alpha[0], alpha[-1], alpha[1:-1, 0], alpha[1:-1, -1]])
        if rim.mean() > INVERTED and (alpha < 0.5).mean() > HOLE:
            self._warned = True
            warn(
                f"view {number} ({self.views[number].name}) has an alpha of 1 along its border, and of 0 within; is "
                f"the mask inverted? The object has 1, its background 0",
                InputWarning,
            )

    def _factors(self, number: int, mask: np.ndarray | None) -> np.ndarray | None:
        """A view's mask times its weight, (H, W) float32; None for ones."""
        factor, size = self._weights[number], tuple(self.views[number].size)
        if mask is None:
            return None if factor == 1 else np.full(size, factor, np.float32)
        if np.shape(mask) != size:
            raise InputError(
                f"view {number} ({self.views[number].name}) has a mask of shape {np.shape(mask)}, not {size}"
            )
        return factor * np.asarray(mask, np.float32)

    def _leave_out_unreadable(self) -> None:
        kept = []
        for number, view in enumerate(self.views):
            try:
                self._picture(number)
                kept.append(number)
            except InputError as error:
                warn(f"{error}; the view {view.name} is left out", FileWarning)
        if not kept:
            raise InputError("no view has a picture that can be read")
        self.views, self._weights = [self.views[i] for i in kept], self._weights[kept]
        self._kept.clear()
