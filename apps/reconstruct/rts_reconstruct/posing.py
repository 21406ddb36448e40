"""Cameras fitted to a mesh that stays: those of views that are held out, and of views that are tried."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

import rts
from rts_reconstruct.model import Model, moved_camera
from rts_reconstruct.pictures import Pictures
from rts_reconstruct.stages import Settings

STEPS, FEW = 20, 5
"""The most steps of Levenberg–Marquardt, and those of a trial."""


def posed(model: Model, pictures: Pictures, settings: Settings, places: Sequence[int], steps: int = STEPS) -> Model:
    """The model with poses of some views, each fitted to its picture while the model stays.

    A mesh and all fitted cameras may move together, which no picture tells. So cameras of views held out, as they were
    given, do not fit the mesh; and they are off as much as the others were.

    Args:
        model: the model.
        pictures: the pictures.
        settings: of the fit.
        places: numbers of views, of those to fit and then of those held out.
        steps: the most steps.
    """
    views = pictures.views + pictures.held_out
    chosen = np.asarray(places)
    residuals = rts.ViewResiduals(
        lambda p: model.part,
        [views[place] for place in places],
        cameras=lambda p, camera, view: moved_camera({**p, "focal": model.cameras["focal"]}, camera, view),
        background=None if pictures.outlined else pictures.background,
    )
    fit = rts.fit(
        residuals, {"poses": torch.tensor(model.poses[chosen])}, method="lm", steps=steps, progress=settings.progress
    )
    poses = model.poses.copy()
    poses[chosen] = fit.parameters["poses"].numpy()
    return model._replace(poses=poses)


def refined(model: Model, pictures: Pictures, settings: Settings) -> Model:
    """The model with the pose of each view to fit, one after the other, fitted by Levenberg–Marquardt.

    Adam, which fits poses along with the shape, is slow where each step shows a few views of many.
    """
    quiet = settings._replace(progress=False)
    for place in range(len(pictures.views)):
        model = posed(model, pictures, quiet, [place], FEW)
    return model
