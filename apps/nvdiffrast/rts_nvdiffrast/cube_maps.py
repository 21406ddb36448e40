"""Cube maps: directions on their faces, and texels across their edges.

Faces are in the order +x, −x, +y, −y, +z, −z, and lie as in table 3.23 of the OpenGL 4.2 specification: a direction has
the coordinates s_c (by columns) and t_c (by rows) on the face of its longest component, m_a.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

FACES = (
    ((0, 0, -1), (0, -1, 0), (1, 0, 0)),
    ((0, 0, 1), (0, -1, 0), (-1, 0, 0)),
    ((1, 0, 0), (0, 0, 1), (0, 1, 0)),
    ((1, 0, 0), (0, 0, -1), (0, -1, 0)),
    ((1, 0, 0), (0, -1, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, -1, 0), (0, 0, -1)),
)
"""For each face s_c, t_c and |m_a|, as rows of weights of x, y and z."""


def faces_of(directions: Tensor) -> Tensor:
    """The faces (…), int64, that directions (…, 3) meet."""
    axis = directions.abs().argmax(-1, keepdim=True)
    return (2 * axis + (directions.gather(-1, axis) < 0)).squeeze(-1)


def on_faces(directions: Tensor, directions_da: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
    """Project directions on the faces of a cube map.

    Args:
        directions: (…, 3) float of any length but 0.
        directions_da: (…, 3, 2) float, their derivatives by X and Y, or None.

    Returns:
        Faces (…) int64; coordinates (…, 2) float on them, from 0 to 1; their derivatives (…, 2, 2), or None.
    """
    faces = faces_of(directions.detach())
    turns = torch.tensor(FACES, dtype=directions.dtype).to(directions.device)[faces]
    turned = (turns * directions[..., None, :]).sum(-1)
    flat, depth = turned[..., :2] / turned[..., 2:], turned[..., 2:]
    if directions_da is None:
        return faces, (flat + 1) / 2, None
    turned_da = turns @ directions_da
    flat_da = (turned_da[..., :2, :] - flat[..., None] * turned_da[..., 2:, :]) / depth[..., None]
    return faces, (flat + 1) / 2, flat_da / 2


@lru_cache(maxsize=32)
def neighbours(size: int) -> tuple[Tensor, Tensor]:
    """Texels of a cube map with a border of one texel around each face.

    Returns:
        Indices (6, size + 2, size + 2), int64, of a table: first the texels of the cube map, face by face and row by
        row, then a mean for each of the cube's eight corners. And the three texels of each mean, (8, 3) int64.
    """
    turns = torch.tensor(FACES)
    # Integers: a face reaches from -size to size, and lies at the depth `size`. Centres of texels have odd distances.
    line = 2 * torch.arange(-1, size + 1) + 1 - size
    t, s = torch.meshgrid(line, line, indexing="ij")
    beyond_s, beyond_t = s.abs() > size, t.abs() > size
    # A texel beyond an edge folds over it, on to the first row of the next face.
    depth = torch.where(beyond_s | beyond_t, size - 1, size)
    folded = torch.stack([s.clamp(-size, size), t.clamp(-size, size), depth], dim=-1)
    points = torch.einsum("rck,fka->frca", folded, turns)
    faces = faces_of(points)
    columns, rows = ((turns[faces][..., :2, :] * points[..., None, :]).sum(-1) + size - 1).unbind(-1)
    indices = (faces * size + rows // 2) * size + columns // 2
    flat = torch.stack([s, t, torch.full_like(s, size)], dim=-1)
    corners = ((torch.einsum("rck,fka->frca", flat, turns) > 0) * torch.tensor([1, 2, 4])).sum(-1)
    first, last = [1, size], [0, -1]
    nearest = indices[:, first][:, :, first].flatten()[corners[:, last][:, :, last].flatten().argsort(stable=True)]
    return torch.where(beyond_s & beyond_t, 6 * size * size + corners, indices), nearest.reshape(8, 3)
