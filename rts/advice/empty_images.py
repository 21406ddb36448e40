"""Reasons why nothing is seen in an image, in words for a warning."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rts.advice.what_to_look_at import known_tree
from rts.arrays.engines import stopped
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.records import Proxy
from rts.contracts.surface import TriangleSurface
from rts.scene.camera import Camera


def why_empty(parts: Sequence[CheckedPart], camera: Camera) -> str:
    """The likely cause, for each of the first four parts, of an image without samples, or with transparent ones."""
    causes = [_cause(part, camera) for part in parts]
    if len(parts) == 1:
        return causes[0].format("the part")
    return "; ".join(cause.format(f"part {i}") for i, cause in enumerate(causes[:4])) + (
        "; …" if len(parts) > 4 else ""
    )


def _cause(part: CheckedPart, camera: Camera) -> str:
    """The likely cause for one part, a text with {} in place of the part's name."""
    if not isinstance(part.surface, TriangleSurface):
        return "no ray meets {}, or its shader gives an alpha of 0"
    known = known_tree((part.surface.proxy_inputs(stopped(part.theta)), camera.within(part.transform)))
    if known is None:
        return "{} is not in sight, or its shader gives an alpha of 0"
    inputs, local = known
    proxy = part.surface.proxy(inputs, local, (1, 1))
    if not len(proxy.faces):
        return "{} " + part.surface.why_no_triangles(inputs).replace("{", "{{").replace("}", "}}")
    outside = _outside(proxy, local)
    if outside is not None:
        return f"{{}} {outside}"
    a, b, c = (proxy.vertices[proxy.faces[:, i]].astype(np.float64) for i in range(3))
    if not np.cross(b - a, c - a).any():
        return "the triangles of {} have no area"
    if part.cull == "back":
        return "all that is in sight of {} is seen from behind, which cull='back' leaves out"
    if part.shader.opaque:
        return "{} lies between the centres of pixels, or beside the view"
    return "the shader of {} gives an alpha of 0, or it lies between the centres of pixels"


def out_of_view(part: CheckedPart, camera: Camera) -> str | None:
    """The place of a part outside of the view, such as "lies behind …".

    None if the part may be seen, has no triangles, or is traced.
    """
    if not isinstance(part.surface, TriangleSurface):
        return None
    known = known_tree((part.surface.proxy_inputs(stopped(part.theta)), camera.within(part.transform)))
    if known is None:
        return None
    inputs, local = known
    proxy = part.surface.proxy(inputs, local, (1, 1))
    return _outside(proxy, local) if len(proxy.faces) else None


def _outside(proxy: Proxy, local: Camera) -> str | None:
    """The place of triangles that all lie outside of the view, in words; None if some may be seen."""
    corners = proxy.vertices[np.unique(proxy.faces)].astype(np.float64)
    at = np.concatenate([corners, np.ones((len(corners), 1))], axis=1) @ (local.projection @ local.view).T
    depth = -(corners @ local.view[2, :3] + local.view[2, 3])
    near, far = local.depth_range()
    if (depth < near).all():
        where = "behind the camera" if (at[:, 3] <= 0).all() else f"nearer than the near plane, at {near + 0.0:.3g}"
        return f"lies {where}"
    if (depth > far).all():
        return f"lies beyond the far plane, at {far:.3g}"
    for axis, sign, side in ((0, 1, "right"), (0, -1, "left"), (1, 1, "top"), (1, -1, "bottom")):
        if (sign * at[:, axis] > at[:, 3]).all():
            return f"lies outside of the view, beyond its {side} edge"
    return None
