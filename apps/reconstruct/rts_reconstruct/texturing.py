"""A texture for a mesh whose shape is known: an atlas, the colours of vertices baked into it, and a fit to pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
import torch
import xatlas

import rts
from rts_reconstruct.job import shared
from rts_reconstruct.model import Atlas, Model, moved_camera, surface_of, textured
from rts_reconstruct.pictures import Pictures
from rts_reconstruct.stages import Settings

RATE = 0.02
"""Adam's rate for texels."""
PADDING = 4
"""Texels between the charts of an atlas."""


def baked(model: Model, size: int) -> Model:
    """The model with a texture of `size` × `size` texels, which shows the colours of its vertices."""
    return shared(lambda: _baked(model, size))


def _baked(model: Model, size: int) -> Model:
    atlas = xatlas.Atlas()
    atlas.add_mesh(model.vertices, model.faces.astype(np.uint32))
    atlas.generate(pack_options=_options(size))
    rows, faces, uv = atlas[0]
    faces, uv = faces.astype(np.int32), uv.astype(np.float32)
    # The atlas is a flat mesh, whose picture is the texture.
    flat = np.concatenate([uv, np.zeros_like(uv[:, :1])], axis=1)
    part = rts.Part(rts.Mesh(faces), {"vertices": flat, "colors": model.colors[rows]}, "unlit")
    camera = rts.Camera.orthographic((0.5, 0.5, 1), (0.5, 0.5, 0), height=1.0, aspect=1.0, far=2.0)
    picture = np.asarray(rts.render(part, camera, (size, size), splatter="none"))
    nearest = scipy.ndimage.distance_transform_edt(picture[..., 3] < 0.5, return_distances=False, return_indices=True)
    texture = picture[..., :3][tuple(nearest)]
    corners = model.faces[np.arange(len(faces))]  # Faces keep their order; their corners have rows of the map.
    assert np.array_equal(rows[faces], corners), "the atlas has another order of faces"
    return model._replace(atlas=Atlas(uv, faces, texture.astype(np.float32)))


def _options(size: int) -> Any:
    options = xatlas.PackOptions()
    options.resolution, options.padding, options.bilinear = size, PADDING, True
    return options


def fitted(
    model: Model, pictures: Pictures, steps: int, settings: Settings, checkpoint: Path | None, report: Any
) -> tuple[Model, list[float]]:
    """The model with its texture fitted to the pictures, and the losses of the steps; see `stages.fitted`.

    Texels that no picture shows stay as they are.
    """
    atlas = model.atlas
    assert atlas is not None
    surface = surface_of(model)
    poses = {"poses": torch.tensor(model.poses)}
    residuals = rts.ViewResiduals(
        lambda p: textured(surface, model.vertices, atlas.uv, p["texture"]),
        pictures.views,
        batch=min(settings.batch, len(pictures.views)),
        seed=settings.seed,
        cameras=(lambda p, camera, view: moved_camera(poses, camera, view)) if settings.cameras else None,
        background=None if pictures.outlined else pictures.background,
    )

    def colors_of(p: Any) -> np.ndarray:
        shown = atlas._replace(texture=p["texture"].detach().numpy())
        return shown.colors(model.faces, len(model.vertices))

    fit = rts.fit(
        residuals,
        {"texture": torch.tensor(atlas.texture)},
        steps=steps,
        learning_rate=RATE,
        validate_every=steps,
        checkpoint=checkpoint,
        callback=lambda step, p, loss: report(step, loss, lambda: (model.vertices, model.faces, colors_of(p))),
        progress=settings.progress,
    )
    texture = np.clip(fit.parameters["texture"].numpy(), 0, 1)
    atlas = atlas._replace(texture=texture)
    return model._replace(atlas=atlas, colors=atlas.colors(model.faces, len(model.vertices))), fit.history
