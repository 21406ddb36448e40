"""The verdict on a fitted pose: its overlap with the mask, and doubts about the mask."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rts import Part, render
from rts_cli.pose_file import ModelPose, posed

GOOD = 0.9
"""Least intersection over union of a good fit."""
NEITHER = (0.01, 0.9)
"""Range of linear brightness that masks lack: neither outside nor inside, noise of compression allowed for."""
COLORED = 0.1
"""Least difference of linear channels of a coloured pixel; masks have none."""
PHOTO = 0.05
"""Share of pixels unlike those of a mask, above which a picture counts as a photo."""


class Verdict(NamedTuple):
    """The quality of a pose.

    Attributes:
        iou: intersection over union of the model's silhouette and the mask, 0 to 1; pixels are inside from 0.5 on.
        notes: faults and doubts, in sentences.
    """

    iou: float
    notes: list[str]

    @property
    def good(self) -> bool:
        """True if the model covers the mask."""
        return self.iou >= GOOD

    @property
    def word(self) -> str:
        """The fit in two words."""
        return "good fit" if self.good else "poor fit"

    def numbers(self) -> dict[str, Any]:
        """The entries of a verdict in JSON."""
        return {"iou": self.iou, "verdict": self.word, "notes": self.notes}


def judged(
    pose: ModelPose, parts: Sequence[Part], mask: np.ndarray, picture: np.ndarray | None = None, robust: bool = False
) -> Verdict:
    """The verdict on a pose: how well its silhouette fits the mask, and doubts about the mask.

    Args:
        pose: the fitted pose.
        parts: the model as loaded, NumPy arrays.
        mask: (H, W) the silhouette that it was fitted to, in [0, 1].
        picture: (H, W, 4) linear, from which the mask was taken; a note says if it is a photo. None to look at none.
        robust: whether the loss was robust. It changes neither IoU nor verdict: the note on a poor fit then says that
            the pose may be right all the same, with a part of the mask hidden or wrong.
    """
    drawn = render(posed(parts, pose.matrix, "silhouette"), pose.camera, mask.shape, splatter="single", layers=1)
    iou = intersection_over_union(np.asarray(drawn)[..., 3], mask)
    notes = []
    if iou < GOOD:
        hidden = "with a part of the mask hidden or wrong the pose may be right all the same (after.png); if not: "
        notes.append(
            f"the model covers the mask with an IoU of {iou:.3f}; expected {GOOD} or more: "
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
    """Number of pixels inside both silhouettes (H, W) over those inside either; 1 if both are empty."""
    one, other = a >= 0.5, b >= 0.5
    either = np.count_nonzero(one | other)
    return np.count_nonzero(one & other) / either if either else 1.0


def touches_border(mask: np.ndarray) -> bool:
    """True if a silhouette (H, W) has inner pixels in its first or last row or column."""
    return bool(max(mask[0].max(), mask[-1].max(), mask[:, 0].max(), mask[:, -1].max()) >= 0.5)


def unlike_a_mask(picture: np.ndarray) -> float:
    """Share of pixels of an opaque picture (H, W, 4), linear, that no mask has; 0 for a picture with transparency.

    Such pixels are coloured, or gray among gray neighbours, which excludes outlines.
    """
    from scipy.ndimage import minimum_filter

    if (picture[..., 3] < 1).any():
        return 0.0
    darkest, brightest = picture[..., :3].min(axis=-1), picture[..., :3].max(axis=-1)
    gray = minimum_filter((brightest > NEITHER[0]) & (darkest < NEITHER[1]), 3)
    return float((gray | (brightest - darkest > COLORED)).mean())
