"""Stages of a fit: from few vertices and large smoothness to many and little; remeshed in between."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import trimesh

import rts
from rts_reconstruct.isosurface import Values
from rts_reconstruct.job import shared
from rts_reconstruct.model import Model, carried, colored, moved_camera
from rts_reconstruct.pictures import Pictures
from rts_reconstruct.subdivision import FACES, limit_of, tessellated

ROUNDS = 5
"""Rounds of remeshing."""


ROBUST = rts.Loss("cauchy", f_scale=0.1)
"""The loss of colours, 0 to 1, that most views agree on and some do not."""
FOCAL = 0.1
"""The learning rate of focal lengths, as a share of that of poses: a step changes all pictures."""


class Stage(NamedTuple):
    """Steps with one set of rates, on a mesh of about so many faces.

    Attributes:
        faces: the number of faces to remesh to, about.
        share: the share of all steps.
        smoothness: that of `rts.LargeSteps`.
        shape: the learning rate of the shape.
        colors: that of colours.
        poses: that of cameras.
        lattice: points along each axis where an isosurface is fitted; 0 for a mesh there, too, made of the isosurface.
    """

    faces: int
    share: float
    smoothness: float
    shape: float
    colors: float
    poses: float
    lattice: int


STAGES = (
    Stage(5_000, 0.3, 40, 0.1, 0.02, 0.002, 40),
    Stage(20_000, 0.3, 40, 0.05, 0.02, 0.001, 72),
    Stage(30_000, 0.4, 20, 0.01, 0.005, 0.0003, 0),
)


class Settings(NamedTuple):
    """How all stages fit.

    Attributes:
        batch: the number of views in a step.
        seed: of the order of views.
        cameras: True to fit cameras.
        surface: "mesh", "subdivision" or "isosurface".
        progress: True to show progress; None for only on a terminal.
        robust: True if large differences are to count less, as of masks that are inexact.
    """

    batch: int
    seed: int
    cameras: bool
    surface: str
    progress: bool | None
    robust: bool = False


def fitted(
    model: Model, pictures: Pictures, stage: Stage, steps: int, settings: Settings, checkpoint: Path | None, report: Any
) -> tuple[Model, list[float]]:
    """The model after a stage, remeshed before it; and the losses of its steps.

    Args:
        model: the model before.
        pictures: the pictures.
        stage: the rates.
        steps: the number of steps.
        settings: what all stages share.
        checkpoint: the file of the fit's state, or None.
        report: called as (step, loss, vertices, faces, colors); a true result stops the fit.
    """
    shape = _shape(model, pictures, stage, settings)
    start = dict(shape.start)
    rates = {"shape": stage.shape * shape.rate, "colors": stage.colors}
    if settings.cameras:
        start |= model.cameras
        rates |= {"poses": stage.poses, "focal": FOCAL * stage.poses}
    residuals = rts.ViewResiduals(
        shape.part,
        pictures.views,
        batch=min(settings.batch, len(pictures.views)),
        seed=settings.seed,
        cameras=moved_camera if settings.cameras else None,
        background=None if pictures.outlined else pictures.background,
        loss=ROBUST if settings.robust else "linear",
    )
    fit = rts.fit(
        residuals,
        start,
        steps=steps,
        learning_rate=rates,
        validate_every=steps,
        checkpoint=checkpoint,
        callback=lambda step, p, loss: report(step, loss, lambda: shape.mesh(p)),
        progress=settings.progress,
    )
    found = model._replace(**dict(zip(("vertices", "faces", "colors"), shape.mesh(fit.parameters), strict=True)))
    if settings.cameras:
        found = found._replace(**{name: fit.parameters[name].numpy() for name in model.cameras})
    return tessellated(found) if settings.surface == "subdivision" else found, fit.history


def _shape(model: Model, pictures: Pictures, stage: Stage, settings: Settings) -> Vertices | Values:
    """The surface that a stage fits, in the shape of the model."""
    if settings.surface == "isosurface" and stage.lattice:
        # Cameras that are off would cut too much away.
        hull = pictures if pictures.outlined and not settings.cameras else None
        return shared(lambda: Values(model, stage.lattice, hull))
    smooth = settings.surface == "subdivision"
    return Vertices(remeshed(model, stage.faces // FACES if smooth else stage.faces), stage.smoothness, smooth)


class Vertices:
    """The vertices of a mesh, or of the cage of a subdivision surface, and their colours.

    Attributes:
        start: the parameters at first.
        rate: 1, a factor on the learning rate of "shape".
    """

    rate = 1.0

    def __init__(self, model: Model, smoothness: float, smooth: bool):
        self._steps, self._faces = rts.LargeSteps(model.vertices, model.faces, smoothness), model.faces
        self._surface = limit_of(model.faces) if smooth else rts.Mesh(model.faces)
        self.start = {"shape": torch.tensor(self._steps.encode(model.vertices)), "colors": torch.tensor(model.colors)}

    def part(self, p: Any) -> rts.Part:
        """The surface as a part."""
        return colored(self._surface, self._steps.decode(p["shape"]), p["colors"])

    def mesh(self, p: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices, faces and colours of the mesh or cage."""
        return self._steps.decode(p["shape"].detach()).numpy(), self._faces, p["colors"].detach().numpy()


def remeshed(model: Model, faces: int) -> Model:
    """The model on a mesh of about so many faces of like size (Botsch and Kobbelt 2004), its colours carried over.

    A mesh that is no manifold cannot be remeshed: its faces are split, while there are less than half as many.
    """
    return shared(lambda: _remeshed(model, faces))


def _remeshed(model: Model, faces: int) -> Model:
    mesh = trimesh.Trimesh(model.vertices, model.faces, process=False)
    if _is_manifold(mesh):
        length = math.sqrt(4 * mesh.area / (math.sqrt(3) * faces))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # Its import takes old names of SciPy.
            from gpytoolbox import remesh_botsch
        found = remesh_botsch(mesh.vertices.astype(np.float64), mesh.faces.astype(np.int32), ROUNDS, length)
        vertices, corners = (np.asarray(x) for x in found)
    else:
        warnings.warn("the mesh is no manifold; faces are split, not remeshed", rts.errors.RtsWarning, 3)
        vertices, corners = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        while 2 * len(corners) < faces:
            vertices, corners = trimesh.remesh.subdivide(vertices, corners)[:2]
    return carried(model, vertices, corners)


def _is_manifold(mesh: trimesh.Trimesh) -> bool:
    """True if no edge has more than two faces, and faces beside each other have the same sense."""
    counts = np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1]
    return int(counts.max(initial=0)) <= 2 and bool(mesh.is_winding_consistent)
