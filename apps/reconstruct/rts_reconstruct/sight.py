"""What of a surface the pictures see, and colours for what they do not."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import trimesh

import rts
from rts_reconstruct.model import Model, moved_camera
from rts_reconstruct.pictures import Pictures

FACING = 0.1
"""The least cosine between a normal and the way to a camera that sees the surface."""
SPECK = 0.001
"""Patches, seen or not, of less than this share of the surface are cut or kept with what surrounds them."""


def camera_of(model: Model, pictures: Pictures, place: int, camera: rts.Camera) -> rts.Camera:
    """A camera (of the pictures' world) of a view, as its pose is fitted."""
    moved = moved_camera(model.cameras, camera, place)
    return moved.map(lambda matrix: np.asarray(matrix))


def facing(camera: rts.Camera, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Cosines (N,) between normals and the ways to a camera."""
    ways = np.linalg.inv(np.asarray(camera.view, np.float64))[:3, 3] - points
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
    return (ways * normals).sum(axis=1)


def seen(model: Model, pictures: Pictures) -> np.ndarray:
    """True for vertices (V,) that a view to fit sees."""
    mesh = trimesh.Trimesh(model.vertices, model.faces, process=False)
    part = rts.Part(rts.Mesh(model.faces), {"vertices": model.vertices})
    found = np.zeros(len(model.vertices), bool)
    for place, view in enumerate(pictures.views):
        camera = camera_of(model, pictures, place, view.camera)
        there = rts.shadows.visibility(rts.shadows.seen_from(part, camera, view.size), model.vertices) > 0.5
        found |= np.asarray(there) & (facing(camera, model.vertices, mesh.vertex_normals) > FACING)
    return found


def filled(model: Model, known: np.ndarray) -> Model:
    """The model with colours at vertices that no view sees which change as little as can be from those beside.

    Args:
        model: the model.
        known: (V,) True for vertices that are seen.
    """
    if known.all() or not known.any():
        return model
    ends = np.concatenate([model.faces[:, [0, 1]], model.faces[:, [1, 2]], model.faces[:, [2, 0]]])
    ends = np.unique(np.concatenate([ends, ends[:, ::-1]]), axis=0)
    count = len(known)
    joined = scipy.sparse.csr_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count))
    laplacian = scipy.sparse.csr_array(scipy.sparse.diags_array(joined.sum(axis=1) + 1e-6) - joined)
    free = ~known
    right = joined[free][:, known] @ model.colors[known] + 1e-6 * model.colors[known].mean(axis=0)
    colors = model.colors.copy()
    solved = scipy.sparse.linalg.spsolve(laplacian[free][:, free].tocsc(), right)
    colors[free] = np.asarray(solved, np.float32).reshape(-1, 3)
    return model._replace(colors=colors)


def unseen_share(model: Model, known: np.ndarray) -> float:
    """The share of the surface whose corners no view sees."""
    areas = trimesh.Trimesh(model.vertices, model.faces, process=False).area_faces
    return float(areas[~known[model.faces].any(axis=1)].sum() / max(areas.sum(), 1e-12))


def trimmed(model: Model, known: np.ndarray) -> tuple[Model, np.ndarray, float]:
    """The model without faces that no view sees, `known` for the vertices that stay, and the share that is cut away.

    A model that no view sees at all stays whole.
    """
    away = _hidden(model, known)
    if away.all():
        return model, known, 0.0
    areas = trimesh.Trimesh(model.vertices, model.faces, process=False).area_faces
    used, faces = _rest(model.faces[~away])
    atlas = model.atlas
    if atlas is not None:
        rows, corners = _rest(atlas.faces[~away])
        atlas = atlas._replace(uv=atlas.uv[rows], faces=corners)
    rest = model._replace(vertices=model.vertices[used], faces=faces, colors=model.colors[used], atlas=atlas)
    return rest, known[used], float(areas[away].sum() / max(areas.sum(), 1e-12))


def _hidden(model: Model, known: np.ndarray) -> np.ndarray:
    """True for faces (T,) whose corners no view sees, but for patches that are specks."""
    mesh = trimesh.Trimesh(model.vertices, model.faces, process=False)
    found = ~np.asarray(known[model.faces].any(axis=1))
    pairs = mesh.face_adjacency
    same = found[pairs[:, 0]] == found[pairs[:, 1]]
    labels = trimesh.graph.connected_component_labels(pairs[same], node_count=len(found))
    areas = np.bincount(labels, mesh.area_faces)
    specks = areas < SPECK * areas.sum()
    specks &= np.isin(np.arange(len(areas)), labels[pairs[~same]])  # A small piece that stands alone is none.
    return found ^ specks[labels]


def _rest(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows that faces (T, 3) use, and the faces between these rows."""
    rows, corners = np.unique(faces, return_inverse=True)
    return rows, corners.reshape(-1, 3).astype(np.int32)
