"""Parts of a model as triangles to show: their colours and textures as they are, in the scene's coordinates."""

from __future__ import annotations

import numpy as np

import rts
from rts.plugin_api.records import Cells, Samples
from rts_viewer.glb import Triangles

CUTS = 16
"""Number of cuts along each side of a patch, for surfaces that are curved."""
ATTRIBUTES = {"colors": "color", "uv": "uv", "normals": "normal"}
"""Entries of a mesh's θ, and their names in its G-buffer."""


def triangles_of(part: rts.Part) -> Triangles:
    """The triangles of a part of NumPy arrays. A surface other than a mesh is shown by its shape alone.

    Raises:
        InputError: the surface cannot become a mesh.
    """
    factor = np.atleast_1d(part.theta.get("color", np.ones(3)))
    if not isinstance(part.surface, rts.Mesh):
        vertices, faces = part.surface.tessellate(part.theta, CUTS)
        return _moved(Triangles(vertices, faces, factor=factor), part.transform)
    vertices, faces, found = _attributes(part)
    opaque = getattr(part.shader, "opaque", True)
    if opaque and "colors" in found:
        found["colors"] = found["colors"][:, :3]
    texture = part.theta.get("texture")
    if texture is not None and opaque and texture.shape[-1] == 4:
        texture = texture[..., :3]
    wrap = getattr(part.shader, "wrap", "repeat")
    if texture is not None and "uv" in found:
        found.pop("colors", None)  # As shaders have it, the texture takes their place.
    mesh = Triangles(vertices, faces, **found, texture=texture, wrap=wrap, factor=factor)
    return _moved(mesh, part.transform)


def _attributes(part: rts.Part) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Vertices, faces and attributes with one row a vertex.

    Where an attribute has an index table of its own, every corner of a triangle becomes a vertex.
    """
    theta, faces = part.theta, part.surface.faces
    names = [name for name in ATTRIBUTES if name in theta]
    if part.surface.sample_widths[0] == 3:
        return theta["vertices"], faces, {name: theta[name] for name in names}
    corners = _at_corners(part)
    found = {name: corners[ATTRIBUTES[name]] for name in {*names, "normals"}}
    return corners["position"], np.arange(3 * len(faces)).reshape(-1, 3), found


def _at_corners(part: rts.Part) -> rts.GBuffer:
    """The G-buffer of a mesh at the three corners of each triangle, row 3 t + i for corner i of triangle t."""
    count = len(part.surface.faces)
    ids = part.surface.proxy(part.surface.proxy_inputs(part.theta), None, (1, 1)).ids
    weights = np.array([[1, 0], [0, 1], [0, 0]], np.float32)  # Barycentrics of the first two corners.
    cells = Cells(np.arange(3 * count, dtype=np.int32).reshape(1, 1, -1))
    samples = Samples(np.repeat(ids, 3, axis=0), np.tile(weights, (count, 1)), cells, np.int32(0))
    return part.surface.evaluate(part.theta, samples)


def _moved(mesh: Triangles, transform: np.ndarray | None) -> Triangles:
    """A mesh in the coordinates of the scene. Triangles that a transform mirrors are turned round."""
    if transform is None:
        return mesh
    matrix = np.asarray(transform, np.float64)
    linear = matrix[:3, :3]
    mirrored = np.linalg.det(linear) < 0
    normals = mesh.normals
    if normals is not None:
        cofactors = np.stack([np.cross(linear[(i + 1) % 3], linear[(i + 2) % 3]) for i in range(3)])
        normals = normals @ cofactors.T * (-1 if mirrored else 1)
    return mesh._replace(
        vertices=mesh.vertices @ linear.T + matrix[:3, 3],
        faces=mesh.faces[:, ::-1] if mirrored else mesh.faces,
        normals=normals,
    )
