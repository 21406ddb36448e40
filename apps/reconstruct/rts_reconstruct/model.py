"""The model that is fitted: a mesh, its colours or its texture, and cameras."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree

import rts
from rts_reconstruct.light import Lit

NEAREST = 3
"""The old vertices from which a new one has its colour."""


class Atlas(NamedTuple):
    """A texture (R, R, 3), row 0 on top, and its map: uv (U, 2), and (T, 3) rows of it for each face."""

    uv: np.ndarray
    faces: np.ndarray
    texture: np.ndarray

    def colors(self, faces: np.ndarray, count: int) -> np.ndarray:
        """Colours (V, 3) of vertices, by the texels at their places."""
        size = len(self.texture)
        uv = np.zeros((count, 2), np.float32)
        uv[faces.reshape(-1)] = self.uv[self.faces.reshape(-1)]
        column, row = (np.clip((x * size).astype(int), 0, size - 1) for x in (uv[:, 0], 1 - uv[:, 1]))
        return self.texture[row, column]


class Model(NamedTuple):
    """A mesh (V, 3), (T, 3) with colours (V, 3) or an atlas; poses (B, 6) of the world before each camera.

    Vertices are in the world of `Pictures`, colours sRGB-encoded, poses in the order of `Pictures.numbers`. `light`
    (9, 3) is that of `light.irradiance`; None where colours have it in them. `focal` (1,) is the logarithm of a factor
    on the focal lengths of all cameras.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    poses: np.ndarray
    atlas: Atlas | None = None
    light: np.ndarray | None = None
    focal: np.ndarray = np.zeros(1, np.float32)

    @property
    def cameras(self) -> dict[str, Any]:
        """The parameters of `moved_camera`."""
        return {"poses": torch.tensor(self.poses), "focal": torch.tensor(self.focal)}

    @property
    def part(self) -> rts.Part:
        """The mesh as a part, in its colours and its light."""
        if self.atlas is None:
            part = colored(rts.Mesh(self.faces), self.vertices, self.colors)
        else:
            part = textured(surface_of(self), self.vertices, self.atlas.uv, self.atlas.texture)
        if self.light is None:
            return part
        return part.replace(theta={**part.theta, "irradiance": self.light}, shader=Lit(part.shader))


def carried(model: Model, vertices: np.ndarray, faces: np.ndarray) -> Model:
    """The model on another mesh (V, 3), (T, 3) of its surface, with colours of the nearest vertices."""
    away, near = KDTree(model.vertices).query(vertices, k=NEAREST)
    weights = 1 / (away + 1e-6)
    colors = np.einsum("vk,vkc->vc", weights / weights.sum(axis=1, keepdims=True), model.colors[near])
    return model._replace(
        vertices=vertices.astype(np.float32), faces=faces.astype(np.int32), colors=colors.astype(np.float32)
    )


def colored(surface: Any, vertices: Any, colors: Any) -> rts.Part:
    """A mesh with colours (V, 3), which need no light."""
    return rts.Part(surface, {"vertices": vertices, "colors": colors}, rts.plugin("shaders", "unlit")())


def textured(surface: Any, vertices: Any, uv: Any, texture: Any) -> rts.Part:
    """A mesh with a texture, which needs no light.

    Pixels average the texture over their footprint, as viewers do. So in a fit all texels below a pixel follow it, and
    pixels that see the surface at a grazing angle count little for each of their many texels.
    """
    shader = rts.plugin("shaders", "textured")(mip=True)
    return rts.Part(surface, {"vertices": vertices, "uv": uv, "texture": texture}, shader)


def surface_of(model: Model) -> Any:
    """The faces of a model with an atlas, and those of its map."""
    assert model.atlas is not None
    return rts.Mesh(model.faces, {"uv": model.atlas.faces})


def moved_camera(p: Any, camera: rts.Camera, view: Any) -> rts.Camera:
    """The camera of a view, with the world before it moved by the view's pose, and its focal length as it is fitted.

    Args:
        p: "poses" (B, 6), and "focal" (1,), the logarithm of a factor.
        camera: the camera as it was given.
        view: the view's number.
    """
    moved = camera.within(rts.rigid(p["poses"][view]))
    grown = torch.diag(torch.tensor([1.0, 1.0, 0.0, 0.0])) * (torch.exp(p["focal"]) - 1)
    return moved.replace(projection=torch.as_tensor(moved.projection, dtype=grown.dtype) * (1 + grown), aspect=None)
