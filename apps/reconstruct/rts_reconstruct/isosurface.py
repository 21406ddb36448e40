"""An isosurface in place of a mesh: values on a lattice, so that holes open, and parts meet and come apart."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import scipy.ndimage
import torch
import trimesh

import rts
from rts_reconstruct.model import Model
from rts_reconstruct.pictures import Pictures
from rts_reconstruct.starts import REACH, lattice_points, least_alpha, nothing_in_common

WIDTH, RADIUS = 1.5, 4
"""Width and reach of the Gaussian by which a value's change moves its neighbours, in cells."""
SPECK = 0.001
"""Pieces of less than this share of the largest one's volume are dropped: specks, and hollows that nobody sees."""


class Values:
    """The distance to a model's surface at the points of a lattice, changed by steps that are smooth.

    A step moves each value along with its neighbours, as `rts.LargeSteps` moves vertices. Where alpha or masks tell
    the object, values stay positive beyond its visual hull and a cell around it: no picture's derivative would open a
    hole in a sheet that faces the camera.

    Args:
        model: the model to start from; its distances are signed by the winding number.
        count: points along each axis.
        hull: the pictures whose masks bound the surface, or None.

    Attributes:
        start: the parameters at first.
        rate: the learning rate of "shape", as a share of a mesh's.
    """

    rate = 0.1

    def __init__(self, model: Model, count: int, hull: Pictures | None):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # Its import takes old names of SciPy.
            from gpytoolbox import signed_distance
        points, shape = lattice_points(count), (count,) * 3
        away, face, weights = signed_distance(points, model.vertices.astype(np.float64), model.faces)
        colors = np.einsum("pk,pkc->pc", weights, model.colors[model.faces[face]])
        self._start = torch.tensor(away.reshape(shape), dtype=torch.float32)
        self._least = torch.tensor(_outside(hull, count) if hull else np.full(shape, -np.inf), dtype=torch.float32)
        across = torch.arange(-RADIUS, RADIUS + 1) / WIDTH
        self._kernel = torch.softmax(-(across**2) / 2, 0)
        self._surface = rts.Isosurface(((-REACH,) * 3, (REACH,) * 3), attributes={"color": _color})
        self.start = {"shape": torch.zeros(shape), "colors": torch.tensor(colors, dtype=torch.float32)}
        self.start["colors"] = self.start["colors"].reshape(*shape, 3)

    def part(self, p: Any) -> rts.Part:
        """The isosurface as a part."""
        return rts.Part(self._surface, {"values": self._values(p), "colors": p["colors"]}, "unlit")

    def mesh(self, p: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices, faces and colours of its triangles, by marching cubes."""
        found = self._surface.extract({"values": self._values(p).detach()})
        mesh = trimesh.Trimesh(found.vertices, found.faces, process=False)
        pieces = mesh.split(only_watertight=False)
        if len(pieces) > 1:
            largest = max(piece.volume for piece in pieces)
            mesh: Any = trimesh.util.concatenate([piece for piece in pieces if piece.volume > SPECK * largest])
        vertices = np.asarray(mesh.vertices, np.float32)
        colors = _color({"colors": p["colors"].detach()}, torch.tensor(vertices))
        return vertices, np.asarray(mesh.faces, np.int32), colors.numpy()

    def _values(self, p: Any) -> Any:
        change = p["shape"][None, None]
        for axis in range(3):
            weights = self._kernel.reshape([-1 if i == axis + 2 else 1 for i in range(5)])
            change = torch.nn.functional.conv3d(change, weights, padding="same")
        return torch.maximum(self._start + change[0, 0], self._least)


def _color(theta: Any, points: Any) -> Any:
    """Colours (N, 3) at points (N, 3), from those of lattice points, linear along each axis."""
    places = (points / REACH).flip(-1)[None, None, None]  # The last axis comes first.
    table = theta["colors"].movedim(-1, 0)[None]
    return torch.nn.functional.grid_sample(table, places, align_corners=True, padding_mode="border")[0, :, 0, 0].T


def _outside(pictures: Pictures, count: int) -> np.ndarray:
    """Distances (count, count, count) beyond the visual hull and a cell around it; −∞ within."""
    hull: Any = scipy.ndimage.binary_dilation(least_alpha(pictures, count) > 0.5, np.ones((3, 3, 3)))
    if not hull.any():
        raise nothing_in_common()
    away = scipy.ndimage.distance_transform_edt(~hull, sampling=2 * REACH / (count - 1))
    return np.where(hull, -np.inf, np.asarray(away))
