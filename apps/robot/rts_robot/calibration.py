"""Where a camera stands that looks at a robot: its pose from masks and joint values."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

import rts
from rts.errors import InputWarning, warn
from rts.plugin_api.checks import check_numbers, quoted
from rts_robot.robot import Robot
from rts_robot.starts import find_starts
from rts_robot.uncertainty import covariance_of

COARSE, MIDDLE, FULL = rts.Stage(1 / 8, 2, 2.0), rts.Stage(1 / 4), rts.Stage()
"""Stages of a fit: that of each start, and those of the best."""
TRIES, FOUND = 4, 0.55
"""The most searches for a start, each with a seed of its own; and the mean IoU above which none follows."""
LIMITS = {COARSE: (3e-3, 20), MIDDLE: (1e-3, 20), FULL: (1e-5, 40)}
"""For each stage, the least gain of a step, as a share of the loss, which is mostly that of wrong pixels; and the most
steps. Further ones moved the camera by less than a tenth of its standard deviation."""
AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes of OpenCV from those of `rts`, and back."""


class Calibration(NamedTuple):
    """A calibrated camera.

    Attributes:
        camera_to_base: (4, 4) base-from-camera, metres. Camera axes are OpenCV's: x right, y down, z forward.
        covariance: (6, 6) of a small rotation (a vector in the frame of the base, radians) that follows the rotation
            of `camera_to_base`, and of the camera's position (3,), frame of the base, metres.
        offsets: what is added to the value of each joint that was asked for, radians or metres, by name.
        offset_deviations: their standard deviations, by name.
        ious: (B,) intersection over union of robot and mask in each view; pixels are inside from 0.5 on, in the
            median of 3 × 3, which takes lone wrong pixels out of the mask.
        loss: the mean loss of a pixel at the end.
        reason: why the fit stopped.
        seconds: wall time.
        camera: the camera, for `rts.render`.
        values: (B, J) the values of joints, offsets added.
    """

    camera_to_base: np.ndarray
    covariance: np.ndarray
    offsets: dict[str, float]
    offset_deviations: dict[str, float]
    ious: np.ndarray
    loss: float
    reason: str
    seconds: float
    camera: rts.Camera
    values: np.ndarray

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations (6,): three of the rotation, radians, three of the position, metres."""
        return np.sqrt(np.diag(self.covariance))

    def __repr__(self) -> str:
        x, y, z = self.camera_to_base[:3, 3]
        turn, shift = np.degrees(self.deviations[:3]).max(), 1e3 * self.deviations[3:].max()
        return (
            f"camera at ({x:.4f}, {y:.4f}, {z:.4f}) m; standard deviations up to {shift:.2g} mm and {turn:.2g} degrees"
            f"; IoU {self.ious.min():.3f} to {self.ious.max():.3f} in {len(self.ious)} views"
        )


def calibrate(
    robot: Robot,
    masks: Any,
    values: Any,
    intrinsics: Any,
    *,
    start: Any = None,
    offsets: Sequence[str] = (),
    loss: str = "cauchy",
    f_scale: float | None = None,
    seed: int = 0,
    progress: bool | None = None,
) -> Calibration:
    """Find the camera that took masks of a robot, by Levenberg–Marquardt over all views, and how sure that is.

    The camera and the base stand still, the robot moves from view to view. Lenses must not distort: undistort masks
    before.

    Args:
        robot: the robot.
        masks: (B, H, W) in [0, 1], the share of each pixel that the robot covers, or whether it does.
        values: (B, J), the values of joints in each view, in the order of `robot.names`; or a list of dicts by name.
        intrinsics: (3, 3) pixels, as OpenCV's: the centre of the first pixel is (0, 0).
        start: (4, 4), roughly `camera_to_base`; None to look for it.
        offsets: names of joints to whose values an unknown number is added, the same in all views.
        loss: of each pixel, as in `rts.ImageResiduals`: a robust one where something may hide the robot.
        f_scale: the difference beyond which a robust loss counts less; by default 0.5.
        seed: of the search for a start. Where the robot fits the masks badly after it, up to three more follow.
        progress: as in `rts.fit`.

    Raises:
        rts.InputError: an argument of another shape, a mask in which nothing is inside or that holds other numbers, a
            robot whose joints do not move, or an offset that the masks do not tell.

    Warns:
        rts.errors.InputWarning: the robot fits the masks badly.
    """
    begun = time.perf_counter()
    masks, values = _checked(robot, masks, values)
    size = masks.shape[1:]
    offsets = _checked_names(robot, offsets)
    robust = rts.Loss(loss) if loss == "linear" else rts.Loss(loss, 0.5 if f_scale is None else f_scale)
    rts.Camera.from_opencv(intrinsics, np.eye(3), np.zeros(3), size)  # Refused before any work.
    intrinsics = np.asarray(intrinsics, np.float64)
    if start is not None:
        check_numbers("start", start, (4, 4))
    view = _roughly(robot, masks, values, intrinsics, start, robust, seed, progress)
    problem = _Problem(robot, masks, values, intrinsics, view, offsets, robust)
    fit = problem.fitted(FULL, progress, problem.fitted(MIDDLE, progress).parameters)
    view = problem.view_at(fit.parameters)
    found = fit.parameters["offsets"].numpy().astype(np.float64) if offsets else np.zeros(0)
    moved = values + found @ problem.chosen
    final = _Problem(robot, masks, moved, intrinsics, view, offsets, robust)
    covariance, camera = final.covariance(), final.camera
    deviations = np.sqrt(np.diag(covariance)[6:])
    ious = _ious(robot, moved, camera, masks)
    if ious.mean() <= FOUND:
        warn(
            f"the robot and its masks have a mean IoU of {ious.mean():.2f}: the camera may be a wrong one; compare the "
            f"masks, the joint values and the intrinsics with the robot, or give a start",
            InputWarning,
        )
    return Calibration(
        np.linalg.inv(view),
        covariance[:6, :6],
        dict(zip(offsets, found.tolist(), strict=True)),
        dict(zip(offsets, deviations.tolist(), strict=True)),
        ious,
        fit.loss,
        fit.reason,
        time.perf_counter() - begun,
        camera,
        moved,
    )


def _roughly(
    robot: Robot,
    masks: np.ndarray,
    values: np.ndarray,
    intrinsics: np.ndarray,
    start: Any,
    loss: rts.Loss,
    seed: int,
    progress: bool | None,
) -> np.ndarray:
    """Camera-from-base (4, 4) after the coarse stage, from a start or from the best of those that are searched for."""
    fits: list[tuple[float, _Problem, Any]] = []
    for number in range(TRIES):
        if start is None:
            starts = find_starts(robot, values, masks, intrinsics, seed=seed + number)
        else:
            starts = [np.linalg.inv(np.asarray(start, np.float64))]
        for view in starts:
            problem = _Problem(robot, masks, values, intrinsics, view, (), loss, apart=True)
            fit = problem.fitted(COARSE, progress)
            fits.append((fit.loss, problem, fit.parameters))
        _, problem, parameters = min(fits, key=lambda fit: fit[0])
        camera = problem.scene(parameters, 0)[1]
        if start is not None or _ious(robot, values, camera, masks).mean() > FOUND:
            return problem.view_at(parameters)
    _, problem, parameters = min(fits, key=lambda fit: fit[0])
    return problem.view_at(parameters)


class _Problem:
    """The residuals of all views as a function of a small motion of the base, and of offsets.

    Parameters are `turn` (3,), a rotation vector about the robot's middle, radians, `shift` (3,), metres, and perhaps
    `offsets`: numbers of one array ought to be of like units.

    The robot is one part, which takes less time, or its links are parts: `apart`. The coarse stage keeps them apart,
    since a start far off was lost with one part.

    Attributes:
        camera: the camera at `view`.
        chosen: (k, J), 1 where an offset is added to a value.
    """

    def __init__(
        self,
        robot: Robot,
        masks: np.ndarray,
        values: np.ndarray,
        intrinsics: np.ndarray,
        view: np.ndarray,
        offsets: Sequence[str],
        loss: rts.Loss,
        apart: bool = False,
    ):
        self.size = masks.shape[1:]
        turn = Rotation.from_matrix(view[:3, :3]).as_matrix()  # The nearest one: matrices of files are rounded.
        self.camera = rts.Camera.from_opencv(intrinsics, turn, view[:3, 3], self.size)
        placed = np.stack([np.stack([np.asarray(x) for x in robot.transforms(q)]) for q in values])
        self.middle = placed[:, [mesh.link for mesh in robot.meshes], :3, 3].mean(axis=(0, 1))
        self.chosen = np.array([[name == other for other in robot.names] for name in offsets], np.float64)
        self.chosen = self.chosen.reshape(len(offsets), len(robot.names))
        self._values, self._masks = values, np.asarray(masks, np.float32)
        self._offsets, self._loss = offsets, loss
        self._parts = robot.parts if apart else lambda q: [robot.silhouette(q)]
        self._still = [self._parts(q) for q in values]
        self._start = {"turn": torch.zeros(3), "shift": torch.zeros(3)}
        if len(offsets):
            self._start["offsets"] = torch.zeros(len(offsets))

    def scene(self, parameters: Any, number: int) -> tuple[list[rts.Part], rts.Camera]:
        """The parts of a view, and its camera, which moves against the base."""
        moved = self.camera.within(rts.rigid(torch.cat([parameters["turn"], parameters["shift"]]), self.middle))
        if "offsets" not in parameters:
            return self._still[number], moved
        offsets = parameters["offsets"]
        values = torch.as_tensor(self._values[number], dtype=offsets.dtype)
        return self._parts(values + offsets @ torch.as_tensor(self.chosen, dtype=offsets.dtype)), moved

    def fitted(self, stage: rts.Stage, progress: bool | None, start: Any = None) -> Any:
        """The fit of the parameters, from `start` or zero on."""

        def scenes(parameters: Any) -> tuple[list[list[rts.Part]], list[rts.Camera]]:
            views = [self.scene(parameters, number) for number in range(len(self._masks))]
            return [parts for parts, _ in views], [camera for _, camera in views]

        cameras = [self.camera] * len(self._masks)
        residuals = rts.ImageResiduals(scenes, cameras, self.size, self._masks, layers=1, loss=self._loss)
        tolerance, steps = LIMITS[stage]
        options: Any = {"schedule": [stage], "steps": steps, "tolerance": tolerance, "progress": progress}
        return rts.fit(residuals, start or self._start, method="lm", **options)

    def view_at(self, parameters: Any) -> np.ndarray:
        """Camera-from-base (4, 4), camera axes of OpenCV."""
        pose = np.concatenate([parameters[name].numpy().astype(np.float64) for name in ("turn", "shift")])
        return AXES @ self.camera.view @ np.asarray(rts.rigid(pose, self.middle))

    def covariance(self) -> np.ndarray:
        """The covariance (6 + k, 6 + k), at `view`, of the camera's rotation and position, and of offsets."""
        sizes = [len(x) for x in self._start.values()]

        def residuals(vector: torch.Tensor, number: int) -> torch.Tensor:
            parameters = dict(zip(self._start, torch.split(vector, sizes), strict=True))
            image = rts.render(*self.scene(parameters, number), self.size, layers=1)
            return image[..., 3] - torch.as_tensor(self._masks[number])

        unknowns = ["the camera"] * 6 + [f"the offset of {name}" for name in self._offsets]
        covariance = covariance_of(residuals, torch.zeros(sum(sizes)), len(self._masks), self._loss, unknowns)
        # As the base moves by (turn, shift) in the camera's eyes, the camera moves the other way in the base's.
        x, y, z = np.linalg.inv(self.camera.view)[:3, 3] - self.middle
        change = np.eye(len(covariance))
        change[:6, :6] = -np.eye(6)
        change[3:6, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
        return change @ covariance @ change.T


def _ious(robot: Robot, values: np.ndarray, camera: rts.Camera, masks: np.ndarray) -> np.ndarray:
    """The intersection over union (B,) of the robot and the mask of each view."""
    return np.array([_iou(robot.silhouette(q), camera, mask) for q, mask in zip(values, masks, strict=True)])


def _iou(part: rts.Part, camera: rts.Camera, mask: np.ndarray) -> float:
    drawn = np.asarray(rts.render(part, camera, mask.shape, layers=1))[..., 3] >= 0.5
    inside = median_filter(mask, 3) >= 0.5  # Without lone wrong pixels.
    return float(np.count_nonzero(drawn & inside) / max(np.count_nonzero(drawn | inside), 1))


def _checked(robot: Robot, masks: Any, values: Any) -> tuple[np.ndarray, np.ndarray]:
    """Masks (B, H, W) and values (B, J), float64, refused where they are wrong."""
    if not robot.names:
        raise rts.InputError("no joint of the robot moves; expected at least one: one pose does not tell enough")
    shapes = {np.shape(mask) for mask in masks}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        raise rts.InputError(f"masks have the shapes {sorted(shapes)}; expected (H, W), the same for all")
    masks = np.asarray(masks, np.float64)
    if len(values) != len(masks):
        raise rts.InputError(f"there are {len(masks)} masks and {len(values)} rows of joint values; expected as many")
    for number, mask in enumerate(masks):
        if not (mask.min() >= 0 and mask.max() <= 1):
            raise rts.InputError(f"mask {number} goes from {mask.min():g} to {mask.max():g}; expected 0 to 1")
        if not 0 < np.count_nonzero(mask >= 0.5) < mask.size:
            colour = "black" if mask.max() < 0.5 else "white"
            raise rts.InputError(
                f"mask {number} is {colour} all over: its brightest pixel is {mask.max():.3g}; expected 1 where the "
                f"robot is, and 0 elsewhere"
            )
    rows = np.stack([np.asarray(robot.values(row), np.float64) for row in values])
    if not np.isfinite(rows).all():
        raise rts.InputError("values of joints hold NaN or infinity; expected finite numbers")
    return masks, rows


def _checked_names(robot: Robot, names: Sequence[str]) -> list[str]:
    unknown = [name for name in names if name not in robot.names]
    if isinstance(names, str) or unknown:
        raise rts.InputError(f"offsets is {quoted(names)}; expected names of joints: {', '.join(robot.names)}")
    return list(dict.fromkeys(names))
