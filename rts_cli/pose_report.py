"""The report on a fitted pose: numbers, pictures, an animation and the convergence."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rts import Camera, Part, render, save_animation, save_image, show
from rts.errors import PluginError
from rts.results import Fit
from rts.tool_api.files import writing
from rts_cli.pose_file import ModelPose, posed
from rts_cli.pose_fit import LARGEST_SIDE, PoseFit, shrunk
from rts_cli.pose_verdict import Verdict

PICTURE_SIDE, FRAMES = 512, 48
PAPER, MARKED = (0.86, 0.87, 0.9), (0.95, 0.32, 0.05)


def write_report(
    folder: Path,
    result: PoseFit,
    verdict: Verdict,
    parts: Sequence[Part],
    target: np.ndarray,
    scenery: Sequence[Part] = (),
) -> list[Path]:
    """Write pose.json, pictures of the pose before and after, the target, an animation and the convergence.

    convergence.png is only written if matplotlib is installed.

    Args:
        folder: the folder for the files; made if missing.
        result: the result of `fit_pose`.
        verdict: the verdict on the pose.
        parts: the model.
        target: (H, W) silhouette.
        scenery: further parts of the pictures, which do not move.

    Returns:
        The files written.

    Raises:
        InputError: a file cannot be written.
    """
    with writing(folder / "pose.json"):
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(_numbers(result) | verdict.numbers(), indent=2) + "\n"
        (folder / "pose.json").write_text(text, encoding="utf-8")
    large, small = shrunk(target, PICTURE_SIDE), shrunk(target, LARGEST_SIDE)

    def picture(pose: ModelPose, mask: np.ndarray) -> np.ndarray:
        return _outlined([*posed(parts, pose.matrix), *scenery], pose.camera, mask)

    save_image(folder / "before.png", picture(result.start, large))
    save_image(folder / "after.png", picture(result.pose, large))
    save_image(folder / "target.png", large[..., None] * np.array([*MARKED, 1.0]))  # Its alpha is the mask.
    moved = [result.trail[0]] + [b for a, b in zip(result.trail, result.trail[1:], strict=False) if _moved(a, b)]
    shown_poses = moved[:: -(-len(moved) // FRAMES)]
    frames = [picture(p, small) for p in [shown_poses[0]] * 4 + shown_poses + [result.pose] * 10]
    save_animation(folder / "animation.gif", frames, fps=8)
    names = ["pose.json", "before.png", "after.png", "target.png", "animation.gif"]
    return [folder / name for name in names] + _plot(folder / "convergence.png", result.fit)


def _numbers(result: PoseFit) -> dict[str, Any]:
    return {
        "axis_angle": result.rotation.tolist(),
        "translation": result.translation.tolist(),
        "center": result.center.tolist(),
        **result.pose.numbers(),
        "loss": result.fit.loss,
        "iterations": len(result.fit.history),
        "seconds": result.fit.seconds,
        "reason": result.fit.reason,
    }


def _moved(before: ModelPose, after: ModelPose) -> bool:
    """True if a step changes an entry of the pose or of the projection by enough to be seen, 1e-4."""
    changes = after.matrix - before.matrix, after.camera.projection - before.camera.projection
    return max(float(np.abs(c).max()) for c in changes) > 1e-4


def _outlined(parts: Sequence[Part], camera: Camera, mask: np.ndarray) -> np.ndarray:
    """A picture (H, W, 3), linear, of parts, with the outline of the target `mask` (H, W) drawn over it."""
    from scipy.ndimage import maximum_filter, minimum_filter

    paper = np.asarray(PAPER) + 0.6 * mask[..., None] * (np.asarray(MARKED) - PAPER)
    image = render(parts, camera, mask.shape, background=paper)[..., :3]
    inside = (mask > 0.5).astype(np.float64)
    edge = (maximum_filter(inside, 3) - minimum_filter(inside, 3))[..., None]
    return image + 0.85 * edge * (np.asarray(MARKED) - image)


def _plot(path: Path, fit: Fit) -> list[Path]:
    """Plot the loss over the steps. Returns a list of the file, or an empty one if matplotlib is missing."""
    try:
        plot = show(fit).png
    except PluginError:
        return []
    with writing(path):
        path.write_bytes(plot)
    return [path]
