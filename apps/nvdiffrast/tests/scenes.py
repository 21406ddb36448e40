"""Geometry for tests, in clip space and before it."""

import numpy as np
import torch

CUBE = torch.tensor([(x, y, z) for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
CUBE_FACES = torch.tensor([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))], dtype=torch.int32)
TRIANGLE = torch.tensor([[[-0.8, -0.7, 0.1, 1.0], [0.9, -0.6, 0.3, 1.5], [-0.2, 1.6, 0.2, 2.0]]])
"""One triangle whose corners have different w, but no z that is affine in it."""
ONE = torch.tensor([[0, 1, 2]], dtype=torch.int32)


def projection(x=0.4, near=1.0, far=50.0):
    """A perspective matrix of OpenGL, for square images."""
    a, b = -(far + near) / (far - near), -2 * far * near / (far - near)
    return torch.tensor([[near / x, 0, 0, 0], [0, near / x, 0, 0], [0, 0, a, b], [0, 0, -1, 0]])


def rotation(vector):
    """(3, 3) of a rotation vector, differentiable."""
    x, y, z = vector
    zero = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3))


def clip(vertices, vector=(0.4, 0.6, 0.1), shift=(0.0, 0.0, -3.5), matrix=None):
    """Clip space (1, V, 4) of turned and shifted vertices (V, 3)."""
    vector = torch.as_tensor(vector, dtype=vertices.dtype)
    placed = vertices @ rotation(vector).T + torch.as_tensor(shift, dtype=vertices.dtype)
    matrix = (projection() if matrix is None else matrix).to(vertices.dtype)
    return (torch.cat([placed, torch.ones_like(placed[:, :1])], dim=1) @ matrix.T)[None]


def sphere(rows=12, columns=24):
    """Vertices, faces and uv of a sphere of radius 0.9 whose seam has corners of its own."""
    v, u = torch.meshgrid(torch.linspace(0, 1, rows + 1), torch.linspace(0, 1, columns + 1), indexing="ij")
    up, around = np.pi * (v - 0.5), 2 * np.pi * u
    points = 0.9 * torch.stack([up.cos() * around.sin(), up.sin(), up.cos() * around.cos()], dim=-1)
    corner = torch.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    faces = torch.stack([a, b, c, a, c, d], dim=-1).reshape(-1, 3)
    return points.reshape(-1, 3), faces.to(torch.int32), torch.stack([u, v], dim=-1).reshape(-1, 2)


def closed_form(corners, size):
    """u, v, z/w and the two derivatives of each per pixel, (H, W, 3) and (H, W, 4), of a triangle's plane; float64."""
    height, width = size
    corners = np.asarray(corners, np.float64)
    inverse = np.linalg.inv(corners[:, [0, 1, 3]].T)  # Weights times w, of a point in the image.

    def at(x, y):
        weights = np.stack([x, y, np.ones_like(x)], axis=-1) @ inverse.T
        weights /= weights.sum(axis=-1, keepdims=True)
        return weights, (weights @ corners[:, 2]) / (weights @ corners[:, 3])

    x, y = np.meshgrid((np.arange(width) + 0.5) * 2 / width - 1, (np.arange(height) + 0.5) * 2 / height - 1)
    weights, depth = at(x, y)
    h = 1e-5
    across = (at(x + h, y)[0] - at(x - h, y)[0])[..., :2] / (2 * h) * 2 / width
    along = (at(x, y + h)[0] - at(x, y - h)[0])[..., :2] / (2 * h) * 2 / height
    inside = (weights > 0).all(axis=-1)
    db = np.stack([across[..., 0], along[..., 0], across[..., 1], along[..., 1]], axis=-1)
    return inside, np.concatenate([weights[..., :2], depth[..., None]], axis=-1), db
