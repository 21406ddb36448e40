"""A report of a pose that was fitted: numbers, pictures, an animation and the convergence."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rts.cli.pose_file import Pose, posed
from rts.cli.pose_fit import LARGEST_SIDE, PoseFit, shrunk
from rts.cli.pose_verdict import Verdict
from rts.files.images import save_animation, save_image
from rts.files.paths import writing
from rts.rendering.image import render
from rts.scene.camera import Camera
from rts.scene.parts import Part

PICTURE_SIDE, FRAMES = 512, 48
PAPER, MARKED = (0.86, 0.87, 0.9), (0.95, 0.32, 0.05)


def write_report(
    folder: Path,
    found: PoseFit,
    verdict: Verdict,
    parts: Sequence[Part],
    target: np.ndarray,
    scenery: Sequence[Part] = (),
) -> list[Path]:
    """Write pose.json, pictures of the pose before and after, the target, an animation and the convergence.

    The last, convergence.png, is only written where matplotlib is installed.

    Args:
        folder: where to; made if need be.
        found: what `fit_pose` gave.
        verdict: what to think of it.
        parts: the model.
        target: (H, W) silhouette.
        scenery: parts that stand still, for the pictures.

    Returns:
        The files written.

    Raises:
        InputError: a file cannot be written.
    """
    with writing(folder / "pose.json"):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "pose.json").write_text(json.dumps(_numbers(found) | verdict.numbers(), indent=2) + "\n")
    large, small = shrunk(target, PICTURE_SIDE), shrunk(target, LARGEST_SIDE)

    def picture(pose: Pose, mask: np.ndarray) -> np.ndarray:
        return _outlined([*posed(parts, pose.matrix), *scenery], pose.camera, mask)

    save_image(folder / "before.png", picture(found.start, large))
    save_image(folder / "after.png", picture(found.pose, large))
    save_image(folder / "target.png", large)
    moved = [found.trail[0]] + [b for a, b in zip(found.trail, found.trail[1:], strict=False) if _moved(a, b)]
    chosen = moved[:: -(-len(moved) // FRAMES)]
    frames = [picture(p, small) for p in [chosen[0]] * 4 + chosen + [found.pose] * 10]
    save_animation(folder / "animation.gif", frames, fps=8)
    names = ["pose.json", "before.png", "after.png", "target.png", "animation.gif"]
    return [folder / name for name in names] + _plot(folder / "convergence.png", found.history)


def _numbers(found: PoseFit) -> dict[str, Any]:
    return {
        "axis_angle": found.rotation.tolist(),
        "translation": found.translation.tolist(),
        "center": found.center.tolist(),
        **found.pose.numbers(),
        "loss": found.loss,
        "iterations": len(found.history),
        "seconds": found.seconds,
        "reason": found.reason,
    }


def _moved(before: Pose, after: Pose) -> bool:
    """Whether a step can be seen."""
    changes = after.matrix - before.matrix, after.camera.projection - before.camera.projection
    return max(float(np.abs(c).max()) for c in changes) > 1e-4


def _outlined(parts: Sequence[Part], camera: Camera, mask: np.ndarray) -> np.ndarray:
    """The model in the scene, the outline of the target drawn over it."""
    from scipy.ndimage import maximum_filter, minimum_filter

    paper = np.asarray(PAPER) + 0.6 * mask[..., None] * (np.asarray(MARKED) - PAPER)
    image = render(parts, camera, mask.shape, background=paper)[..., :3]
    inside = (mask > 0.5).astype(np.float64)
    edge = (maximum_filter(inside, 3) - minimum_filter(inside, 3))[..., None]
    return image + 0.85 * edge * (np.asarray(MARKED) - image)


def _plot(path: Path, history: list[float]) -> list[Path]:
    """The loss over the steps; nothing where matplotlib is not installed."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        return []
    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.subplots()
    axes.semilogy(np.maximum(history, 1e-12), ".-", color="#c2410c", linewidth=1, markersize=4)
    axes.set(xlabel="step", ylabel="loss", title="Silhouette, from coarse pixels to fine")
    axes.grid(alpha=0.3)
    with writing(path):
        figure.savefig(path, dpi=120)
    return [path]
