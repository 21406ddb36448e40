"""A texture for a mesh whose shape is known: an atlas, the colours of vertices baked into it, and a fit to pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
import torch
import trimesh
import xatlas

import rts
from rts_reconstruct import light
from rts_reconstruct.job import shared
from rts_reconstruct.model import Atlas, Model, moved_camera, surface_of, textured
from rts_reconstruct.pictures import Pictures
from rts_reconstruct.stages import Settings

FAINT = 0.02
"""Texels with less than this share of the median weight in pictures follow them more slowly."""
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
    picture = flat(uv, faces, model.colors[rows], size)
    texture = spread(picture[..., :3], picture[..., 3] < 0.5)
    corners = model.faces[np.arange(len(faces))]  # Faces keep their order; their corners have rows of the map.
    assert np.array_equal(rows[faces], corners), "the atlas has another order of faces"
    return model._replace(atlas=Atlas(uv, faces, texture.astype(np.float32)))


def in_even_light(model: Model) -> Model:
    """The model whose light is apart from its colours, which then are as in even light; see `light.fitted`."""
    normals = np.asarray(trimesh.Trimesh(model.vertices, model.faces, process=False).vertex_normals)
    known = light.fitted(model.vertices, normals, model.colors)
    colors, atlas = light.even(model.colors, normals, known), model.atlas
    if atlas is not None:
        rows = np.zeros(len(atlas.uv), int)
        rows[atlas.faces.reshape(-1)] = model.faces.reshape(-1)
        picture = flat(atlas.uv, atlas.faces, normals[rows].astype(np.float32), len(atlas.texture))
        ways = spread(picture[..., :3], picture[..., 3] < 0.5).reshape(-1, 3)
        ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-6)
        texture = light.even(atlas.texture.reshape(-1, 3), ways, known)
        atlas = atlas._replace(texture=texture.reshape(atlas.texture.shape))
    return model._replace(colors=colors, atlas=atlas, light=known.astype(np.float32))


def flat(uv: np.ndarray, faces: np.ndarray, colors: np.ndarray, size: int, outputs: Any = None) -> Any:
    """The picture (R, R, 4) of an atlas, which is a flat mesh, with colours (U, 3); or `outputs` as of `rts.render`."""
    flat = np.concatenate([uv, np.zeros_like(uv[:, :1])], axis=1)
    part = rts.Part(rts.Mesh(faces), {"vertices": flat, "colors": colors}, "unlit")
    camera = rts.Camera.orthographic((0.5, 0.5, 1), (0.5, 0.5, 0), height=1.0, aspect=1.0, far=2.0)
    options = {} if outputs is None else {"outputs": outputs}
    return rts.render(part, camera, (size, size), splatter="none", **options)


def seen_texels(model: Model, known: np.ndarray, size: int) -> np.ndarray:
    """A picture (R, R, 4) of the model's atlas, whose colours are 1 where a vertex of `known` (V,) is near, else 0."""
    assert model.atlas is not None
    rows = np.zeros(len(model.atlas.uv), int)
    rows[model.atlas.faces.reshape(-1)] = model.faces.reshape(-1)
    colors = np.repeat(known[rows, None], 3, axis=1).astype(np.float32)
    return flat(model.atlas.uv, model.atlas.faces, colors, size)


def spread(texture: np.ndarray, bare: np.ndarray) -> np.ndarray:
    """The texture with colours of the nearest others at bare texels, so that averages at seams are of such colours."""
    nearest: Any = scipy.ndimage.distance_transform_edt(bare, return_distances=False, return_indices=True)
    return texture[tuple(nearest)]


def _options(size: int) -> Any:
    options = xatlas.PackOptions()
    options.resolution, options.padding, options.bilinear = size, PADDING, True
    return options


def fitted(
    model: Model,
    known: np.ndarray,
    pictures: Pictures,
    steps: int,
    settings: Settings,
    checkpoint: Path | None,
    report: Any,
) -> tuple[Model, list[float]]:
    """The model with its texture fitted to the pictures, and the losses of the steps; see `stages.fitted`.

    A step moves each texel by the weighted mean of differences at the pixels that show it, as in SIRT (Gilbert 1972,
    *Iterative Methods for the Three-dimensional Reconstruction of an Object from Projections*). Adam would move texels
    that pictures hardly show as far as all others, and fill the texture with specks. Texels that no picture shows stay
    as they are: `known` (V,) tells the vertices that one shows. Averages over a footprint would move them, too.
    """
    assert model.atlas is not None
    atlas: Atlas = model.atlas
    surface = surface_of(model)
    known_cameras = model.cameras
    shown = seen_texels(model, known, len(atlas.texture))
    bare = shown[..., 3] < 0.5  # Between charts nothing is fitted.
    scale = torch.tensor(np.where(shown[..., :1] < 0.5, 0, _scales(model, pictures)))
    start = torch.tensor(atlas.texture)
    batch = min(settings.batch, len(pictures.views))

    def texture_of(p: Any) -> Any:
        return start + scale * p["changes"]

    residuals = rts.ViewResiduals(
        lambda p: textured(surface, model.vertices, atlas.uv, texture_of(p)),
        pictures.views,
        batch=batch,
        seed=settings.seed,
        cameras=(lambda p, camera, view: moved_camera(known_cameras, camera, view)) if settings.cameras else None,
        background=None if pictures.outlined else pictures.background,
    )

    def colors_of(p: Any) -> np.ndarray:
        shown = atlas._replace(texture=texture_of(p).detach().numpy())
        return shown.colors(model.faces, len(model.vertices))

    fit = rts.fit(
        residuals,
        {"changes": torch.zeros_like(start)},
        method="sgd",
        steps=steps,
        # The derivative of a square has a factor 2. A texel that one picture shows must not overshoot in its turn.
        learning_rate=0.5 * batch / len(pictures.views),
        validate_every=steps,
        checkpoint=checkpoint,
        callback=lambda step, p, loss: report(step, loss, lambda: (model.vertices, model.faces, colors_of(p))),
        progress=settings.progress,
    )
    changes, scale = (scale * fit.parameters["changes"]).numpy(), scale.numpy()
    weights = np.divide(1, scale**2, out=np.zeros_like(scale), where=scale > 0)
    changes = without_specks(changes, weights, _footprint(weights, pictures))
    texture = spread(np.clip(atlas.texture + changes, 0, 1), bare)
    atlas = atlas._replace(texture=texture)
    return model._replace(atlas=atlas, colors=atlas.colors(model.faces, len(model.vertices))), fit.history


def without_specks(changes: np.ndarray, weights: np.ndarray, footprint: float) -> np.ndarray:
    """Changes (R, R, 3) of texels, averaged with those beside, by their weights (R, R, 1), over half a footprint.

    Pictures that contradict one another, as where the shape is off, leave specks: texels below one pixel of any picture
    that differ, though none tells them apart. Those that pictures hardly show get the mean of those beside.

    Args:
        changes: of the texels.
        weights: of the texels in pictures; 0 for those that stay.
        footprint: the side of a pixel of the pictures on the surface, in texels.
    """
    width = (min(footprint / 2, PADDING / 3),) * 2 + (0,)
    total = scipy.ndimage.gaussian_filter(weights, width)
    mean = scipy.ndimage.gaussian_filter(weights * changes, width) / np.maximum(total, 1e-30)
    return np.where(weights > 0, mean, changes)


def _footprint(weights: np.ndarray, pictures: Pictures) -> float:
    """The side of a pixel of the pictures on the surface, in texels: its mean shadow is a fourth of it (Cauchy)."""
    views = pictures.views
    covered = [view.image[..., 3].sum() if view.image.shape[2] > 3 else np.prod(view.size) for view in views]
    return float(np.sqrt((weights > 0).sum() / max(4 * np.mean(covered), 1.0)))


def _scales(model: Model, pictures: Pictures) -> np.ndarray:
    """Factors (R, R, 1) on changes of texels: one over the root of their weight in the mean over pixels and pictures.

    Gradient descent by changes is then descent by texels, where each has one over its weight as its rate.
    """
    assert model.atlas is not None
    surface, cameras = surface_of(model), model.cameras
    texture = torch.tensor(model.atlas.texture, requires_grad=True)
    for number, view in enumerate(pictures.views):
        part = textured(surface, model.vertices, model.atlas.uv, texture)
        image = rts.render(part, moved_camera(cameras, view.camera, number), view.size)
        image[..., : view.image.shape[2]].mean().backward()  # Linear in the texture: the gradient is the weight.
    assert texture.grad is not None
    weights = texture.grad[..., :1].numpy() / len(pictures.views)
    faint = FAINT * float(np.median(weights[weights > 0])) if (weights > 0).any() else 1.0
    return np.where(weights > 0, 1 / np.sqrt(np.maximum(weights, 0) + faint), 0).astype(np.float32)
