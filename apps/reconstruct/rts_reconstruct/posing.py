"""Cameras fitted to a mesh that stays: those of views that are held out, and of views that are tried."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial.transform import Rotation

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
    return anchored(model, pictures)


def anchored(model: Model, pictures: Pictures) -> Model:
    """The model and the fitted cameras, moved and scaled together so that cameras are where they were, on the whole.

    Pictures do not tell where in the world all of this is, nor how large: each camera sees the same as before.
    """
    views = np.array([np.asarray(view.camera.view, np.float64) for view in pictures.views])
    poses = np.array([np.asarray(rts.rigid(pose.astype(np.float64))) for pose in model.poses])
    before, after = (np.linalg.inv(matrices)[:, :3, 3] for matrices in (views, views @ poses[: len(views)]))
    if np.linalg.matrix_rank(before - before.mean(axis=0), tol=1e-6) < 2:
        return model  # Cameras on a line may turn about it.
    turn = Rotation.align_vectors(before - before.mean(axis=0), after - after.mean(axis=0))[0].as_matrix()
    unit = float(np.linalg.norm(before - before.mean(axis=0)) / np.linalg.norm(after - after.mean(axis=0)))
    move = before.mean(axis=0) - unit * turn @ after.mean(axis=0)
    found = []
    for view, pose in zip([v.camera.view for v in pictures.views + pictures.held_out], poses, strict=True):
        # A point x is now at unit · turn x + move; depths grow by the unit.
        eye = np.asarray(view, np.float64)
        rotation = pose[:3, :3] @ turn.T
        shift = unit * pose[:3, 3] + (unit - 1) * eye[:3, :3].T @ eye[:3, 3] - rotation @ move
        found.append(np.concatenate([Rotation.from_matrix(rotation).as_rotvec(), shift]))
    fitted = np.where((np.arange(len(found)) < len(views))[:, None], found, model.poses)
    vertices = unit * model.vertices @ turn.T + move
    return model._replace(vertices=vertices.astype(np.float32), poses=fitted.astype(np.float32))
