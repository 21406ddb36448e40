"""The scenes whose results two commits are compared on: surfaces that are small, and need no files.

`rts` is imported by functions only, once a worker knows that it is the right one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

SIZE = (28, 36)
POSE = (0.11, -0.07, 0.05, 0.02, -0.03, 0.04)
"""At which all is rendered: radians and units."""

CULLED = ", culled"
"""The end of the names of scenes without what faces away."""


class Ellipsoid:
    """A surface that intersects rays itself: θ["center"] (3,) and θ["radii"] (3,); params (N, 3) on the unit sphere."""

    sample_widths = (0, 3)

    def __repr__(self):
        return "Ellipsoid()"

    def evaluate(self, theta, samples):
        import rts

        gbuffer = rts.GBuffer(position=theta["center"] + samples.params * theta["radii"])
        gbuffer.defer("normal", lambda: _unit(rts.namespace(samples.params), samples.params / theta["radii"]))
        return gbuffer

    def intersect(self, theta, origins, directions, layers):
        import rts

        xp = rts.namespace(origins)
        o, d = (origins - theta["center"]) / theta["radii"], directions / theta["radii"]
        a, b, c = xp.sum(d * d, axis=1), xp.sum(o * d, axis=1), xp.sum(o * o, axis=1) - 1
        square = b * b - a * c
        root = xp.sqrt(xp.where(square > 0, square, 0.0))
        near, far = (-b - root) / a, (-b + root) / a
        seen, outside = square > 0, near >= 0
        distance = xp.stack([xp.where(outside, near, far), far, *[far] * (layers - 2)][:layers])
        hit = xp.stack([seen & (far >= 0), seen & outside, *[seen & ~seen] * (layers - 2)][:layers])
        return _ray_hits()(hit, distance, _unit(xp, o[None] + distance[..., None] * d[None]))


def _unit(xp: Any, vectors: Any) -> Any:
    return vectors / xp.sqrt(xp.sum(vectors * vectors, axis=-1))[..., None]


def torus(around: int = 15, across: int = 8) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (T, 3) of a torus, uv (A, 2) with a seam, and its indices (T, 3)."""
    u, v = (x.reshape(-1) for x in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    a, b = 2 * np.pi * u / around, 2 * np.pi * v / across
    ring = 0.75 + 0.35 * np.cos(b)
    vertices = np.stack([ring * np.cos(a), 0.35 * np.sin(b), -ring * np.sin(a)], axis=-1).astype(np.float32)
    corners = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    cells = (np.stack([u, v], axis=-1)[:, None, None] + corners).reshape(-1, 3, 2)
    faces = cells[..., 0] % around * across + cells[..., 1] % across
    uv = np.stack(np.meshgrid(np.arange(around + 1), np.arange(across + 1), indexing="ij"), axis=-1).reshape(-1, 2)
    return vertices, faces, (uv / [around, across]).astype(np.float32), cells[..., 0] * (across + 1) + cells[..., 1]


def scenes() -> dict[str, list[Any]]:
    """Parts with NumPy θ, by name. All turn with the pose but those that have a transform."""
    import rts

    mesh, random = rts.plugin("surfaces", "mesh"), np.random.default_rng(1)
    vertices, faces, uv, uv_faces = torus()
    light = {"direction": [0.4, 0.8, 0.5], "color": [0.7, 0.6, 0.5], "ambient": [0.2, 0.25, 0.3]}
    theta = {
        "vertices": vertices,
        "uv": uv,
        "texture": random.random((5, 7, 3), np.float32),
        "light": {name: np.array(value, np.float32) for name, value in light.items()},
        "specular": np.array([0.3, 0.2, 0.4], np.float32),
        "shininess": np.array(9.0, np.float32),
    }
    split = rts.Part(mesh(faces, {"uv": uv_faces}), theta, "blinn_phong")
    outline = rts.Part(mesh(faces), {"vertices": vertices}, "silhouette")
    example = mesh.example()
    colors = np.concatenate([example.theta["colors"], random.random((12, 1), np.float32)], axis=1)
    glass = example.replace(
        theta={**example.theta, "colors": colors}, shader=rts.plugin("shaders", "unlit")(opaque=False)
    )
    # A part of its own size, place and turn, which meets the torus.
    moved = np.array(rts.rigid(np.array([0.3, 0.4, -0.2, 0.25, 0.1, -0.15])), np.float32)
    moved[:3, :3] *= 0.7
    ellipsoid = {"center": [0.1, -0.1, 0.05], "radii": [0.9, 0.6, 0.75], "color": [0.8, 0.5, 0.3]}
    ellipsoid = {name: np.array(value, np.float32) for name, value in ellipsoid.items()}
    own = type("Ellipsoid", (Ellipsoid, getattr(rts, "RaySurface", object)), {})  # Old commits know no such base.
    found = {
        "mesh": [example],
        "split uv": [split],
        "silhouette": [outline],
        "scene": [split, example.replace(transform=moved)],
        "glass": [split, glass.replace(transform=moved)],
        "ellipsoid": [rts.Part(own(), ellipsoid, "lambert")],
    }
    if "heightfield" in rts.plugins("surfaces"):
        found["heightfield"] = [rts.plugin("surfaces", "heightfield").example()]
    for name in ("mesh", "split uv", "silhouette", "scene", "heightfield"):
        if name in found:
            found[name + CULLED] = [part.replace(cull="back") for part in found[name]]
    return found


def matrix_of_pose() -> np.ndarray:
    """(4, 4) float32: what `rts.rigid` gives of the pose, the same on both sides."""
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(POSE[:3]).as_matrix(), POSE[3:]
    return matrix


def camera_of_scenes() -> Any:
    import rts

    return rts.Camera.look_at((0.4, 1.3, 2.6), (0, 0, 0), fov_y=45, aspect=SIZE[1] / SIZE[0])


def _ray_hits() -> Any:
    """The record, which has moved."""
    import rts

    if hasattr(rts, "RayHits"):
        return rts.RayHits
    from rts.plugin_api.records import RayHits

    return RayHits
