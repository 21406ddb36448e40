"""Detail of a texture that is finer than the pictures that were fitted, from the pictures as they are."""

from __future__ import annotations

import math

import numpy as np
import scipy.ndimage
import trimesh
from PIL import Image

import rts
from rts_reconstruct.model import Model
from rts_reconstruct.pictures import Pictures
from rts_reconstruct.sight import FACING, camera_of, facing
from rts_reconstruct.texturing import flat, spread

LARGEST = 4096
"""The most texels a side."""
SHARP = 4
"""The power of a view's weight: the sharpest one counts for most, so that pictures a pixel apart do not blur."""
VIEWS = 3
"""The most views that a face has detail from."""
FILL = 0.6
"""The share of an atlas that charts fill, about."""
WIDTH = 0.6
"""The width of the Gaussian that parts detail from what was fitted, in pixels of the fit."""
LIKE = 0.1
"""The difference from the fitted colour from which on a picture's detail counts less."""
CLEAR = 0.98
"""The least alpha of pixels that give detail: at outlines, they show what is behind."""


def detailed(model: Model, pictures: Pictures) -> Model:
    """The model whose texture has the detail of the pictures as they are, added to what was fitted to smaller ones.

    What is finer than pixels of the fit is a weighted mean over the views that show a face best. A view's weight is a
    power of the number of its pixels on a piece of the surface, which grows with nearness and falls with slant. Views
    whose colours are off those of the fit count less. Brightness stays that of the fit. A model without
    texture, or whose pictures were fitted as they are, stays as it is.
    """
    atlas = model.atlas
    shrinks = [max(a.size) / max(b.size) for a, b in zip(pictures.given, pictures.views, strict=False)]
    if atlas is None or max(shrinks) < 1.5:
        return model
    size = _size(model, pictures)
    mesh = trimesh.Trimesh(model.vertices, model.faces, process=False)
    best, weights = _best(model, pictures, mesh)
    face, points = _texels(model, size)
    bare = face < 0
    face, points = face[~bare], points[~bare]
    texture = _enlarged(atlas.texture, size)
    base = texture[~bare]
    sums, total = np.zeros((len(points), 3), np.float32), np.full(len(points), 1e-12, np.float32)
    for place, shrink in enumerate(shrinks):
        chosen, rank = np.nonzero((best == place)[face])
        if len(chosen) == 0:
            continue
        view = pictures.given[place]
        camera = camera_of(model, pictures, place, pictures.world.camera(view.camera))
        coarse, fine, whole = _parted(view, pictures, place, shrink)
        x, y = np.moveaxis(np.asarray(camera.project(points[chosen], view.size)), -1, 0)[:2]
        at = np.array([y - 0.5, x - 0.5])
        weight = weights[face[chosen], rank] * (scipy.ndimage.map_coordinates(whole, at, order=1) > CLEAR)
        for channel in range(3):  # What stands before the surface in a picture has other colours.
            off = scipy.ndimage.map_coordinates(coarse[..., channel], at, order=1) - base[chosen, channel]
            weight = weight * np.exp(-((off / LIKE) ** 2) / 2)
        total[chosen] += weight
        for channel in range(3):
            sums[chosen, channel] += weight * scipy.ndimage.map_coordinates(fine[..., channel], at, order=1)
    texture[~bare] += sums / total[:, None]
    return model._replace(atlas=atlas._replace(texture=spread(np.clip(texture, 0, 1), bare)))


def _best(model: Model, pictures: Pictures, mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """The views (T, n) that show each face best, −1 for none, and their weights (T, n) float32."""
    middles, ways = np.asarray(mesh.triangles_center, np.float32), np.asarray(mesh.face_normals)
    part = rts.Part(rts.Mesh(model.faces), {"vertices": model.vertices})
    weights = np.zeros((len(pictures.views), len(middles)))
    for place, view in enumerate(pictures.views):
        whole = pictures.given[place]
        camera = camera_of(model, pictures, place, view.camera)
        there = rts.shadows.visibility(rts.shadows.seen_from(part, camera, view.size), middles)
        cosine = facing(camera, middles, ways)
        density = cosine * (whole.size[0] * camera.projection[1, 1] / np.asarray(camera.depth(middles))) ** 2
        weights[place] = np.where((np.asarray(there) > 0.5) & (cosine > FACING), np.maximum(density, 0), 0)
    best = np.argsort(-weights, axis=0)[:VIEWS].T
    found = np.take_along_axis(weights, best.T, axis=0).T
    shares = (found / np.maximum(found[:, :1], 1e-12)) ** SHARP
    return np.where(found > 0, best, -1), shares.astype(np.float32)


def _texels(model: Model, size: int) -> tuple[np.ndarray, np.ndarray]:
    """The faces (R, R) that texels are on, −1 between charts, and points (R, R, 3)."""
    assert model.atlas is not None
    corners = np.zeros(len(model.atlas.uv), int)
    corners[model.atlas.faces.reshape(-1)] = model.faces.reshape(-1)
    found = flat(model.atlas.uv, model.atlas.faces, model.vertices[corners], size, ("color", "triangle"))
    return found["triangle"][..., 0], found["color"][..., :3]


def _size(model: Model, pictures: Pictures) -> int:
    """Texels a side, a power of two times the atlas's, with about as many texels as most pictures have pixels."""
    assert model.atlas is not None
    area = trimesh.Trimesh(model.vertices, model.faces, process=False).area
    middle = model.vertices.mean(axis=0)[None]
    densities = []
    for place in range(len(pictures.views)):
        view = pictures.given[place]
        camera = pictures.world.camera(view.camera)
        depth = max(float(np.asarray(camera.depth(middle))[0]), 1e-6)
        densities.append(view.size[0] * camera.projection[1, 1] / (2 * depth))
    useful = float(np.median(densities)) * math.sqrt(area / FILL)
    size = len(model.atlas.texture)
    while math.sqrt(2) * size < useful and 2 * size <= LARGEST:
        size *= 2
    return size


def _parted(view: rts.View, pictures: Pictures, place: int, shrink: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture (H, W, 3) without what is finer than pixels of the fit; that; how much of the object (H, W) it has."""
    image, small = np.asarray(view.image)[..., :3], pictures.views[place]
    whole = np.ones(view.size, np.float32) if small.mask is None else _over(small.mask, view.size, shrink)
    if small.image.shape[2] == 4:
        whole = whole * _over(small.image[..., 3], view.size, shrink)
    sigma = WIDTH * shrink
    coarse = scipy.ndimage.gaussian_filter(image, (sigma, sigma, 0))
    return coarse, image - coarse, whole


def _over(small: np.ndarray, size: tuple[int, int], shrink: float) -> np.ndarray:
    """A picture (h, w) of n × n means at the pixels of the one that they are of."""
    rows, columns = (
        np.minimum((np.arange(n) / round(shrink)).astype(int), m - 1) for n, m in zip(size, small.shape, strict=True)
    )
    return small[np.ix_(rows, columns)]


def _enlarged(texture: np.ndarray, size: int) -> np.ndarray:
    """The texture (R, R, 3), as wide, of more texels: bilinear."""
    channels = [
        Image.fromarray(texture[..., i].astype(np.float32)).resize((size, size), Image.Resampling.BILINEAR)
        for i in range(3)
    ]
    return np.stack([np.asarray(channel) for channel in channels], axis=2)
