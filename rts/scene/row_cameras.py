"""Cameras of samples of several views, for shaders that colour all views in one call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rts.arrays.engines import namespace
from rts.arrays.trees import Array, record
from rts.operations.by_view import index_of_views
from rts.operations.linear import affine_map_of_views
from rts.operations.take import take
from rts.scene.camera import Camera, toward_rows, world_vectors


@record()
class RowCameras:
    """A camera for each of N samples, for shaders that promise `takes_views`.

    Methods named as in `Camera` return a row for each sample. Row n of `points` is seen by camera n.

    Attributes:
        views: (B, 4, 4) camera-from-world, of each view.
        projections: (B, 4, 4) OpenGL clip space from camera space.
        number: (N,) int32, the view of each sample, from 1 on; 0 for rows that are not used.
    """

    views: Array
    projections: Array
    number: Array

    @classmethod
    def of(cls, cameras: Sequence[Camera], number: Array) -> RowCameras:
        """Cameras of samples (N,), from the cameras of all views and each sample's view `number`."""
        stacked = Camera.stack(cameras)
        return cls(stacked.view, stacked.projection, number)

    def of_rows(self, number: Array) -> RowCameras:
        """The cameras of other samples in these views; `number` (N,) is the view of each."""
        return RowCameras(self.views, self.projections, number)

    def toward(self, points: Array) -> Array:
        """(N, 3) world vectors from points (N, 3) towards the viewer, not normalised; parallel where orthographic."""
        return affine_map_of_views(toward_rows(self.views, self.projections), points, self.number)

    def depth(self, points: Array) -> Array:
        """(N,) linear depth of world points (N, 3)."""
        return -affine_map_of_views(self.views[:, 2:3, :], points, self.number)[:, 0]

    def to_world(self, direction: Sequence[float]) -> Array:
        """(N, 3) the unit vector, in the world, of a direction (3,) in the space of each sample's camera."""
        return take(world_vectors(self.views, direction), index_of_views(self.number))

    def depth_range(self) -> tuple[Array, Array]:
        """Linear depths (N,) of each sample's near plane, and (N,) of its far plane; infinity for a missing plane."""
        views = [Camera(self.views[b, ...], self.projections[b, ...]).depth_range() for b in range(self.views.shape[0])]
        xp, index = namespace(self.views), index_of_views(self.number)
        near, far = (take(xp.stack(depths)[:, None], index)[:, 0] for depths in zip(*views, strict=True))
        return near, far

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(
            f"{name} of a camera was asked for by a shader that takes_views: there is one for each sample then, with "
            f"toward, to_world, depth and depth_range alone; a shader that needs more says takes_views = False"
        )
