"""Scenes as one: the triangles of several views in the space of one camera, which sees the views side by side.

The parts of all views are drawn at once, as joint parts of one scene are. Nothing cuts triangles off where a view ends,
so views have to show their scenes whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rts.contracts.records import Proxy
from rts.sampling.cache import Entry
from rts.sampling.camera_checks import check_camera
from rts.sampling.host_scenes import on_the_host
from rts.sampling.joint import MOST, Joint, is_suited, joins
from rts.sampling.picture import Picture
from rts.sampling.points import pixel_widths
from rts.sampling.scene import Grid, Scene
from rts.scene.camera import Camera

MARGIN = 1
"""Cells along the border of a view in which there may be no vertex: what is seen there might join the next view."""


class DrawnView(NamedTuple):
    """A view that can be drawn along with others: its scene, and where its triangles are seen. Host arrays.

    Attributes:
        scene: the scene.
        grid: its cells.
        camera: the camera of the grid, float64.
        proxies: the triangles of each part.
        seen: for each part (V, 3) float64, its vertices: x and y of clip space, z of the camera's space.
        kind: views of one kind can be drawn at once.
    """

    scene: Scene
    grid: Grid
    camera: Camera
    proxies: list[Proxy]
    seen: list[np.ndarray]
    kind: tuple

    @classmethod
    def of(cls, scene: Scene, grid: Grid) -> DrawnView | None:
        """A view that can be drawn along with others; None for one that has to be drawn by itself.

        Its parts must be such as can be `Joint`, of few triangles, alike in their tables, all of one sampler. All
        vertices must lie in it.
        """
        sampler, cull = scene.samplers[0], scene.parts[0].cull
        for part, chosen_sampler in zip(scene.parts, scene.samplers, strict=True):
            if chosen_sampler is not sampler or part.cull != cull or not (is_suited(part, sampler) and joins(sampler)):
                return None
        here, cells = on_the_host(scene, grid)
        if not here.cameras:
            return None
        camera = check_camera(cells.camera)
        p = camera.projection
        if p[2, :2].any() or p[3, :2].any() or not (p[0, 0] and p[1, 1]):
            return None
        proxies, seen, sign = [], [], Camera(np.eye(4), p).kept_sign(cull)
        for local, entry in zip(here.cameras, here.entries, strict=True):
            if not 0 < len(entry.proxy.faces) <= MOST or local.kept_sign(cull) != sign:
                return None
            view = entry.proxy.seen_by(local).view
            rows = np.concatenate([p[:2] @ view, view[2:3]])
            vertices = entry.proxy.vertices @ rows[:, :3].T + rows[:, 3]
            if not _is_inside(vertices, camera, grid.size):
                return None
            seen.append(vertices)
            proxies.append(entry.proxy)
        tables = {
            tuple(None if x is None else x.shape[1:] for x in (proxy.ids, proxy.corner_params)) for proxy in proxies
        }
        if len(tables) > 1:
            return None
        widths = tuple(f"{x:.5g}" for x in pixel_widths(camera, grid.size))
        kind = id(sampler), cull, sign, widths, p[3].tobytes(), grid.size, *tables
        return cls(scene, grid, camera, proxies, seen, kind)


def _is_inside(seen: np.ndarray, camera: Camera, size: tuple[int, int]) -> bool:
    """True if vertices, as in `DrawnView.seen`, lie between the near and the far plane, and within `size`."""
    z, w = (seen[:, 2] * row[2] + row[3] for row in camera.projection[2:])
    limits = 1 - 2 * MARGIN / np.array(size[::-1])
    whole = (w > 0).all() and (np.abs(z) <= w).all()
    return bool(whole and (np.abs(seen[:, :2]) <= limits * w[:, None]).all())


def joined(views: Sequence[DrawnView], picture: Picture) -> tuple[Scene, Grid, Joint]:
    """One scene of all parts, view after view; the cells of the picture; and where parts are, which have no transforms.

    Args:
        views: views of one kind.
        picture: where they lie.
    """
    first, identity = views[0].camera.projection, Camera(np.eye(4), np.eye(4))
    # From the clip space of each view to that of the picture.
    windows = [identity.window(picture.view, (-int(y), -int(x)), picture.size).projection for x, y in picture.corners()]
    scale = np.array([windows[0][axis, axis] * first[axis, axis] for axis in (0, 1)])
    # Views may differ in near and far planes. Nothing lies beyond these, so that the picture has none.
    camera = Camera(np.eye(4), np.stack([scale[0] * np.eye(4)[0], scale[1] * np.eye(4)[1], np.zeros(4), first[3]]))
    vertices = []
    for view, window in zip(views, windows, strict=True):
        for seen in view.seen:
            w = seen[:, 2:] * first[3, 2] + first[3, 3]
            vertices.append(
                np.column_stack([(seen[:, :2] * np.diag(window)[:2] + w * window[:2, 3]) / scale, seen[:, 2]])
            )
    scenes, proxies = [view.scene for view in views], [proxy for view in views for proxy in view.proxies]
    whole = Scene(
        [replace(part, transform=None) for scene in scenes for part in scene.parts],
        camera,
        [sampler for scene in scenes for sampler in scene.samplers],
        [Entry(proxy, None) for proxy in proxies],
        scenes[0].context,
    )
    joint = Joint.seen_from(camera, whole, proxies, vertices, [camera] * len(proxies))
    return whole, Grid(camera, picture.size), joint
