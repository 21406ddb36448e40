"""Cameras of views that are held out, once other cameras were fitted."""

from __future__ import annotations

import numpy as np
import torch

import rts
from rts_reconstruct.model import Model, moved_camera
from rts_reconstruct.pictures import Pictures
from rts_reconstruct.stages import Settings

STEPS = 20
"""The most steps of Levenberg–Marquardt."""


def posed(model: Model, pictures: Pictures, settings: Settings) -> Model:
    """The model with poses of the views that are held out, each fitted to its picture while the model stays.

    A mesh and all fitted cameras may move together, which no picture tells. So cameras as they were given do not fit
    the mesh; and they are off as much as the others were.
    """
    first = len(pictures.views)
    residuals = rts.ViewResiduals(
        lambda p: model.part,
        pictures.held_out,
        cameras=moved_camera,
        background=None if pictures.outlined else pictures.background,
    )
    start = torch.tensor(model.poses[first:])
    fit = rts.fit(residuals, {"poses": start}, method="lm", steps=STEPS, progress=settings.progress)
    poses = np.concatenate([model.poses[:first], fit.parameters["poses"].numpy()])
    return model._replace(poses=poses.astype(np.float32))
