"""What to think of a pose that was fitted: how well it covers the mask, and what about the mask is doubtful."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rts.cli.pose_file import Pose, posed
from rts.rendering.image import render
from rts.scene.parts import Part

GOOD = 0.9
"""Intersection over union from which on a fit is called good."""
NEITHER = (0.01, 0.9)
"""Linear brightness between that of a mask's outside and inside, noise of compression included."""
COLORED = 0.1
"""Difference of linear channels from which on a pixel is coloured, as those of a mask are not."""
PHOTO = 0.05
"""Share of a picture's pixels that are as those of no mask, from which on it is taken for a photo."""


class Verdict(NamedTuple):
    """How good a pose is.

    Attributes:
        iou: intersection over union of the model's silhouette and the mask, 0 to 1; pixels count as inside from 0.5 on.
        notes: what is wrong, or doubtful, in sentences.
    """

    iou: float
    notes: list[str]

    @property
    def word(self) -> str:
        """The fit in two words."""
        return "good fit" if self.iou >= GOOD else "poor fit"

    def numbers(self) -> dict[str, Any]:
        """What a verdict is in JSON."""
        return {"iou": self.iou, "verdict": self.word, "notes": self.notes}


def judged(
    pose: Pose, parts: Sequence[Part], mask: np.ndarray, picture: np.ndarray | None = None, robust: bool = False
) -> Verdict:
    """The verdict on a pose.

    Args:
        pose: the pose that was found.
        parts: the model as loaded, NumPy arrays.
        mask: (H, W) the silhouette that it was fitted to, in [0, 1].
        picture: (H, W, 4) linear; the picture of which the mask was made.
        robust: whether the loss was a robust one: a part of the mask may be missing, which the pose is right without.
    """
    drawn = render(posed(parts, pose.matrix, "silhouette"), pose.camera, mask.shape, splatter="single", layers=1)
    iou = intersection_over_union(np.asarray(drawn)[..., 3], mask)
    notes = []
    if iou < GOOD:
        hidden = "with a part of the mask hidden or wrong the pose may be right all the same (after.png); if not: "
        notes.append(
            f"poor fit: the model covers the mask with an IoU of {iou:.2f}; expected {GOOD} or more: "
            f"{hidden if robust else ''}is it this model, "
            f"is its start (before.png) roughly right (--camera), and is the field of view (--fov, or --fit-fov)?"
        )
    if touches_border(mask):
        notes.append("the mask touches the border of the picture: what is cut off cannot be compared")
    share = 0.0 if picture is None else unlike_a_mask(picture)
    if share > PHOTO:
        notes.append(
            f"this is a photo, not a mask: {share:.0%} of its pixels are coloured or neither black nor white, and its "
            f"brightness was taken for the silhouette; expected white on black, or a transparent background"
        )
    return Verdict(iou, notes)


def intersection_over_union(a: np.ndarray, b: np.ndarray) -> float:
    """Pixels inside both silhouettes (H, W) over those inside either; 1 where both are empty."""
    one, other = a >= 0.5, b >= 0.5
    either = np.count_nonzero(one | other)
    return np.count_nonzero(one & other) / either if either else 1.0


def touches_border(mask: np.ndarray) -> bool:
    """Whether a silhouette (H, W) has inner pixels in its first or last row or column."""
    return bool(max(mask[0].max(), mask[-1].max(), mask[:, 0].max(), mask[:, -1].max()) >= 0.5)


def unlike_a_mask(picture: np.ndarray) -> float:
    """Share of the pixels of an opaque picture (H, W, 4), linear, that no mask has; 0 where there is transparency.

    Such are coloured, or neither black nor white with all their neighbours, and so not an outline's.
    """
    from scipy.ndimage import minimum_filter

    if (picture[..., 3] < 1).any():
        return 0.0
    darkest, brightest = picture[..., :3].min(axis=-1), picture[..., :3].max(axis=-1)
    gray = minimum_filter((brightest > NEITHER[0]) & (darkest < NEITHER[1]), 3)
    return float((gray | (brightest - darkest > COLORED)).mean())
