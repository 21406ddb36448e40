"""How transforms of parts move positions, normals and tangents: one transform for all samples, or one a view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rts.arrays.engines import Context, engine_of, exemplar, namespace, stopped
from rts.arrays.trees import Array
from rts.operations.by_view import index_of_views
from rts.operations.linear import affine_map, affine_map_of_views
from rts.operations.take import take


@dataclass(frozen=True)
class OneTransform:
    """A transform for all samples.

    Attributes:
        matrix: (4, 4), world from local.
    """

    matrix: Array

    def points(self, points: Array) -> Array:
        """Points (N, 3), moved."""
        return affine_map(self.matrix[:3, :], points)

    @cached_property
    def cofactors(self) -> tuple[Array, Array]:
        """See `_cofactors`."""
        return _cofactors(self.matrix)

    def normals(self, normals: Array, moving: bool = True) -> Array:
        """Normals (N, 3), of any length, moved: times the cofactor matrix; a mirror keeps them outward.

        If they are not `moving`, without the derivative in the transform.
        """
        rows = self.cofactors[0]
        return affine_map(rows if moving else stopped(rows), normals)

    def tangents(self, tangents: Array) -> Array:
        """Tangents with signs (N, 4), of any length, moved; a mirror changes the signs."""
        moved = affine_map(_linear(self.matrix[:3, :3]), tangents[:, :3])
        return namespace(moved).concat([moved, tangents[:, 3:] * self.cofactors[1][:, 0]], axis=1)


@dataclass(frozen=True)
class ViewTransforms:
    """A transform for each of N samples, of parts in several views; methods as of `OneTransform`.

    Attributes:
        matrices: (B, 4, 4), world from local, of each view.
        view: (N,) int32, the view of each sample; see `rts.operations.by_view`.
    """

    matrices: Array
    view: Array

    @classmethod
    def of(cls, transforms: Sequence[Array | None], view: Array) -> ViewTransforms:
        """The transforms of samples, from that of each view; None for the identity."""
        known = [transform for transform in transforms if transform is not None]
        context = Context(engine_of(*known), exemplar(*known))
        matrices = context.constants([np.eye(4) if transform is None else transform for transform in transforms])
        return cls(namespace(*matrices).stack(matrices), view)

    def points(self, points: Array) -> Array:
        """Points (N, 3), moved."""
        return affine_map_of_views(self.matrices[:, :3, :], points, self.view)

    def normals(self, normals: Array, moving: bool = True) -> Array:
        """Normals (N, 3), moved."""
        rows = _cofactors(self.matrices)[0]
        return affine_map_of_views(rows if moving else stopped(rows), normals, self.view)

    def tangents(self, tangents: Array) -> Array:
        """Tangents with signs (N, 4), moved."""
        moved = affine_map_of_views(_linear(self.matrices[:, :3, :3]), tangents[:, :3], self.view)
        sign = _cofactors(self.matrices)[1][..., 0]
        return namespace(moved).concat([moved, tangents[:, 3:] * take(sign, index_of_views(self.view))], axis=1)


def _linear(matrix: Array) -> Array:
    """Linear maps (..., 3, 3) as affine ones (..., 3, 4)."""
    xp = namespace(matrix)
    return xp.concat([matrix, xp.zeros_like(matrix[..., :1])], axis=-1)


def _cofactors(matrix: Array) -> tuple[Array, Array]:
    """Maps (..., 3, 4) that turn normals as affine maps (..., 4, 4) turn surfaces; and their signs (..., 1, 1).

    They are the cofactors of the linear part, times the sign of its determinant, and a column of zeros. The sign is 1,
    or −1 for a mirror.
    """
    xp, rows = namespace(matrix), matrix[..., :3, :3]
    # Each row is the cross product of the next two.
    following = [xp.concat([rows[..., n:, :], rows[..., :n, :]], axis=-2) for n in (1, 2)]
    cofactors = xp.linalg.cross(*following)
    volume = xp.sum(rows[..., :1, :] * cofactors[..., :1, :], axis=-1, keepdims=True)
    sign = xp.where(volume < 0, -xp.ones_like(volume), xp.ones_like(volume))
    return _linear(cofactors * sign), sign
