"""The side of a surface that each layer shows. By it splatters avoid pairing a front with a back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.compiling.threads import parallel, read_only
from rts.contracts.records import Cells, Fragments, Proxy
from rts.scene.camera import Camera

OTHER_COLUMNS = np.array([[j for j in range(4) if j != i] for i in range(4)])
ALTERNATING = np.array([1, -1, 1, -1])


def facing(
    fragments: Fragments, kept: np.ndarray, proxy: Proxy, pieces: np.ndarray, camera: Camera, listed: bool
) -> np.ndarray:
    """The piece that each fragment shows, and its side: (K, H, W) int16, see `Cells.facing`.

    Splatters compare sides in cells that have hidden layers, and beside such cells; elsewhere they are 0. They are all
    0 if `kept` has no hidden samples. The last layer of fragments is marked by `MORE_BEHIND`.

    Args:
        fragments: the fragments of all layers.
        kept: (K, H, W) bool, the fragments that are samples.
        proxy: the triangles.
        pieces: (T,) int16, the number of each triangle's piece; or (1,), one for all triangles.
        camera: host matrices.
        listed: True for the cells of a list: neighbours in the list may not be neighbours in the image, so that all
            cells get sides if any has a hidden layer.
    """
    return facing_of_views(fragments, kept, proxy, pieces, [camera], kept.shape[1:], listed)


def facing_of_views(
    fragments: Fragments,
    kept: np.ndarray,
    proxy: Proxy,
    pieces: np.ndarray,
    cameras: Sequence[Camera],
    view: tuple[int, ...],
    listed: bool = False,
) -> np.ndarray:
    """The result of `facing` for a grid of views, side by side, line after line.

    Args:
        fragments: the fragments of all layers and views.
        kept: (K, H, W) bool, the fragments that are samples.
        proxy: the triangles.
        pieces: see `facing`.
        cameras: the camera of each view, host matrices.
        view: (height, width) of one view; H and W are multiples of these.
        listed: see `facing`.
    """
    from rts.sampling import facing_loops

    behind = np.count_nonzero(kept[1:])
    if not behind:
        return np.zeros(kept.shape, np.int16)
    sides = np.empty(kept.shape, np.int16)
    marks = (np.ascontiguousarray(x) for x in (kept, fragments.triangle_ids))
    triangles = read_only(proxy.vertices), read_only(proxy.faces, np.int32), read_only(pieces, np.int16)
    eyes = np.stack([eye(camera) for camera in cameras])
    arrays = *marks, *triangles, eyes, *view, listed, Cells.MORE_BEHIND
    parallel(facing_loops.fill, kept.shape[1], *arrays, sides, work=kept[0].size + 100 * behind)
    return sides


def eye(camera: Camera) -> np.ndarray:
    """(4,) the homogeneous point e that all rays come from, with the sign that makes n · (e − v) > 0 on front faces.

    A triangle's normal n is that of counter-clockwise winding, v any point of it. Rays that are parallel come from
    infinity: n · e > 0.
    """
    rows = camera.projection[[0, 1, 3]] @ camera.view
    minors = rows[:, OTHER_COLUMNS].transpose(1, 0, 2)
    *point, handedness = np.linalg.det(np.concatenate([minors, camera.view[None, :3, :3]]))
    p = camera.projection
    winding = handedness * (p[0, 0] * p[1, 1] - p[0, 1] * p[1, 0])
    return np.array(point) * ALTERNATING if winding > 0 else -np.array(point) * ALTERNATING
