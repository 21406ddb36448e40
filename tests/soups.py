"""Random soups of triangles, of many kinds of nastiness, each by its number; and what may be said of their hits."""

from itertools import permutations
from typing import NamedTuple

import numpy as np
from helpers import rotation

from rts import Camera
from rts.scene.camera import orthographic, perspective
from rts_backends.triangles import pixel_matrix

DOUBLE, SINGLE = np.finfo(np.float64).eps, np.finfo(np.float32).eps


class Soup(NamedTuple):
    """A scene: triangles, a camera (NumPy float64), and how to look at them."""

    vertices: np.ndarray
    faces: np.ndarray
    camera: Camera
    size: tuple[int, int]
    layers: int
    cull: str


SHAPES = ("any", "slivers", "degenerate", "copies", "shared", "lattice", "parallel", "mixed", "lines")
CAMERAS = ("outside",) * 5 + ("amid", "amid", "narrow", "grazing", "behind")


def soup_of(number, far=1e5):
    """The soup of a number, at most `far` units off the origin."""
    rng = np.random.default_rng(number)
    count = int(np.ceil(60 ** rng.random() ** 0.5))
    kind = SHAPES[number % len(SHAPES)]
    vertices, faces = _triangles(rng, count, kind)
    size = tuple(int(n) for n in np.ceil(24 ** rng.random(2) ** 0.5))
    layers, cull = int(rng.integers(1, 5)), str(rng.choice(["none", "back"]))
    if kind == "lattice" and rng.random() < 0.7:  # Edges and corners exactly on pixels' centres.
        middle = np.array([size[1] / 2, -size[0] / 2, 0])
        view = np.eye(4)
        view[:3, 3] = -middle - [0, 0, 20]
        vertices = np.round(vertices * 4) / 2 + np.round(middle * 2) / 2
        camera = Camera(view, orthographic(size[0], size[1] / size[0], 0.0, 100.0))
        return Soup(vertices.astype(np.float32), faces, camera, size, layers, cull)
    scale = 10 ** rng.uniform(-4, 5) if rng.random() < 0.5 else 1.0
    off = far ** rng.random() if rng.random() < 0.4 else 0.0
    place = off * _direction(rng)
    vertices = (vertices * scale + place).astype(np.float32)
    return Soup(vertices, faces, _camera(rng, place, scale, size), size, layers, cull)


def _triangles(rng, count, kind):
    size = 10 ** rng.uniform(-1.3, 0.3)
    if kind == "mixed":
        size = 10 ** rng.uniform(-4, 1, (count, 1, 1))
    corners = rng.uniform(-1, 1, (count, 1, 3)) + rng.normal(0, 1, (count, 3, 3)) * size
    if kind == "slivers":
        between = rng.uniform(-0.5, 1.5, (count, 1))
        corners[:, 2] = corners[:, 0] * between + corners[:, 1] * (1 - between)
        corners[:, 2] += rng.normal(0, 1, (count, 3)) * 10 ** rng.uniform(-8, -1, (count, 1))
    elif kind == "degenerate":
        corners[::3, 1] = corners[::3, 0]
        corners[1::5] = corners[1::5, :1]
        corners[2::4, 2] = (corners[2::4, 0] + corners[2::4, 1]) / 2
    elif kind == "copies":
        source = rng.integers(0, count, count)
        corners = corners[source]
        for t in range(count):
            corners[t] = corners[t, rng.permutation(3)]
    elif kind == "lattice":
        corners = np.round(corners * 2) / 2
    elif kind == "parallel":
        corners = np.round(corners * 4) / 4
        corners[..., 2] = rng.integers(-2, 3, (count, 1)) / 4
        corners = corners @ rotation((1, 2, 0), rng.choice([0, 20])).T
    elif kind == "lines":
        corners[:, 2] = corners[:, 0] + rng.normal(0, 1, (count, 3)) * 1e-5
    if kind in ("shared", "lattice", "parallel"):
        vertices = corners.reshape(-1, 3)[: max(3, count)]
        return vertices, rng.integers(0, len(vertices), (count, 3)).astype(np.int32)
    return corners.reshape(-1, 3), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def _direction(rng):
    way = rng.normal(size=3)
    return way / np.linalg.norm(way)


def _camera(rng, place, scale, size):
    kind, aspect = rng.choice(CAMERAS), size[1] / size[0]
    way = _direction(rng)
    if kind == "grazing":
        way = np.round(way)
        way = way / max(np.linalg.norm(way), 1) + [0, 0, 1e-3]
    distance = {"amid": rng.uniform(0, 0.8), "narrow": 10 ** rng.uniform(1, 4)}.get(kind, rng.uniform(1, 4)) * scale
    eye = place + distance * way
    target = place + rng.normal(0, 0.2, 3) * scale
    if kind == "behind":
        target = eye + (eye - target)
    near = rng.uniform(0.05, 1.0) * scale
    far = near + distance + rng.uniform(0.1, 4) * scale
    view = Camera.look_at(eye, target, up=_direction(rng)).view
    if rng.random() < 0.4:
        near = rng.choice([0.0, -2 * scale, near])
        return Camera(view, orthographic(rng.uniform(0.5, 4) * scale, aspect, near, far))
    opening = np.degrees(2 * np.arctan(scale / distance)) if kind == "narrow" else rng.uniform(20, 110)
    return Camera(view, perspective(opening, aspect, near, far if rng.random() < 0.7 else 1e3 * far))


def deepened(soup, number):
    """A soup with some corners up to 1e7 times as far off, and a near plane as much nearer to the camera."""
    rng = np.random.default_rng(number)
    vertices, (near, far) = soup.vertices.astype(np.float64), soup.camera.depth_range()
    middle, some = vertices.mean(axis=0), rng.random(len(vertices)) < 0.3
    vertices[some] = middle + (vertices[some] - middle) * 10 ** rng.uniform(0, 7)
    projection, far = soup.camera.projection.copy(), 1e4 * far
    if projection[3, 2]:
        near *= 10 ** rng.uniform(-7, 0)
        projection[2, 2:] = -(far + near) / (far - near), -2 * far * near / (far - near)
    return soup._replace(vertices=vertices.astype(np.float32), camera=Camera(soup.camera.view, projection))


class Hits(NamedTuple):
    """Every triangle at every pixel's centre in float64, with bounds on rounding; (T, H, W) each.

    Attributes:
        open: whether rounding in float64 decides.
        depth: linear depth.
        unsure: the largest rounding error of the depth.
        weights: barycentrics of the first two corners, (T, H, W, 2).
        skewed: the largest rounding error of the weights.
        flat: (T, 1, 1), whether rounding decides which way the triangle faces.
        outline: pixels from the nearest line through an edge.
    """

    open: np.ndarray
    depth: np.ndarray
    unsure: np.ndarray
    weights: np.ndarray
    skewed: np.ndarray
    flat: np.ndarray
    outline: np.ndarray


def hits_of(soup):
    """The hits of a soup, with bounds of rounding."""
    height, width = soup.size
    points = np.concatenate([soup.vertices[soup.faces].astype(np.float64), np.ones((*soup.faces.shape, 1))], axis=2)
    matrix = pixel_matrix(soup.camera, soup.size)
    to_pixels = np.array([[width / 2, 0, 0, width / 2], [0, height / 2, 0, height / 2], [0, 0, 1, 0], [0, 0, 0, 1]])
    sizes = to_pixels @ np.abs(soup.camera.projection) @ np.abs(soup.camera.view)
    corners, error = points @ matrix.T, 8 * DOUBLE * (np.abs(points) @ sizes.T)
    depth = -points @ soup.camera.view[2]
    depth_error = 8 * DOUBLE * (np.abs(points) @ np.abs(soup.camera.view[2])).max(axis=1)
    x, y = (np.arange(width) + 0.5)[None, None, :], (np.arange(height) + 0.5)[None, :, None]
    edges, bounds = [], []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        a, b, da, db = corners[:, i], corners[:, j], error[:, i], error[:, j]
        total, bound = 0.0, 0.0
        for p, q, at in ((1, 3, x), (3, 0, y), (0, 1, np.ones((1, 1, 1)))):
            coefficient = a[:, p] * b[:, q] - a[:, q] * b[:, p]
            rounding = (
                np.abs(a[:, p]) * db[:, q] + da[:, p] * np.abs(b[:, q])
                + np.abs(a[:, q]) * db[:, p] + da[:, q] * np.abs(b[:, p])
                + 8 * DOUBLE * (np.abs(a[:, p] * b[:, q]) + np.abs(a[:, q] * b[:, p]))
            )  # fmt: skip
            total = total + coefficient[:, None, None] * at
            bound = bound + rounding[:, None, None] * at + 8 * DOUBLE * np.abs(coefficient)[:, None, None] * at
        edges.append(total)
        bounds.append(bound)
    edges, bounds = np.stack(edges, -1), np.stack(bounds, -1)
    total, doubt = edges.sum(-1), bounds.sum(-1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        weights = edges / total[..., None]
        skewed = (bounds + np.abs(weights) * doubt[..., None]) / np.abs(total)[..., None]
        z = (weights * depth[:, None, None]).sum(-1)
        spread = np.ptp(depth, axis=1)
        unsure = skewed.sum(-1) * spread[:, None, None] + depth_error[:, None, None]
        near = (weights * (corners[..., 2] + corners[..., 3])[:, None, None]).sum(-1)
        far = (weights * (corners[..., 3] - corners[..., 2])[:, None, None]).sum(-1)
        ahead = (weights * corners[:, None, None, :, 3]).sum(-1)
        w_error = (error[..., 2] + error[..., 3]).max(axis=1)[:, None, None]
        w_spread = (np.ptp(corners[..., 2], axis=1) + np.ptp(corners[..., 3], axis=1))[:, None, None]
        plane = skewed.sum(-1) * w_spread + w_error
        inside = (edges * np.sign(total)[..., None] > -bounds).all(-1)
        certain_sign = np.abs(total) > doubt
        doubtful = (np.abs(edges) <= bounds).any(-1) | ~certain_sign
        doubtful |= (np.abs(near) <= plane) | (np.abs(far) <= plane) | (np.abs(ahead) <= plane)
        seen = (near >= -plane) & (far >= -plane) & (ahead >= -plane)
        opened = doubtful & (inside | ~certain_sign) & (seen | ~np.isfinite(plane))
    flat = _flat(corners[..., [0, 1, 3]], error[..., [0, 1, 3]])
    if soup.cull == "back":
        front = np.linalg.det(corners[..., [0, 1, 3]]) * soup.camera.kept_sign("back") > 0
        opened = (opened & (front | flat)[:, None, None]) | (flat[:, None, None] & inside & seen)
    unsure = np.where(np.isfinite(unsure), unsure, np.inf)
    across = np.stack([np.hypot(*_slopes(corners, i, j)) for i, j in ((1, 2), (2, 0), (0, 1))], -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        outline = (np.abs(edges) / across[:, None, None]).min(-1)
    return Hits(opened, z, unsure, weights[..., :2], skewed[..., :2].max(-1), flat[:, None, None], outline)


def _slopes(corners, i, j):
    a, b = corners[:, i], corners[:, j]
    return a[:, 1] * b[:, 3] - a[:, 3] * b[:, 1], a[:, 3] * b[:, 0] - a[:, 0] * b[:, 3]


def _flat(corners, error):
    """Marks of triangles whose facing rounding decides, by corners (T, 3, 3) in (X, Y, w)."""
    size, most = np.abs(corners) + error, 0.0
    for i, j, k in permutations(range(3)):
        terms = error[:, i, 0] * size[:, j, 1] * size[:, k, 2] + size[:, i, 0] * error[:, j, 1] * size[:, k, 2]
        terms = terms + size[:, i, 0] * size[:, j, 1] * (error[:, k, 2] + 8 * DOUBLE * size[:, k, 2])
        most = most + terms
    return np.abs(np.linalg.det(corners)) <= 3 * most


def found_in(fragments, count):
    """Masks (T, H, W) of the pixels that show each triangle, at most once; no layer follows an empty one."""
    ids = fragments.triangle_ids
    covered = ids >= 0
    assert not (covered[1:] & ~covered[:-1]).any(), "a layer follows an empty one"
    counts = np.zeros((count, *ids.shape[1:]), np.int32)
    k, y, x = np.nonzero(covered)
    np.add.at(counts, (ids[k, y, x], y, x), 1)
    assert counts.max(initial=0) <= 1, "a triangle was found twice"
    return counts > 0


def differences(soup, fragments, every, known, opened):
    """Words for each way in which fragments are not the K nearest of all hits, but for what rounding decides.

    Args:
        soup: the scene.
        fragments: of the sampler under test.
        every: of the sampler to compare with, with as many layers as there are triangles.
        known: the hits of the soup.
        opened: (T, H, W) bool, or fewer axes: hits that may be there or not.
    """
    said = [name for name, x in zip(fragments._fields, fragments, strict=True) if not np.isfinite(x).all()]
    own, others = found_in(fragments, len(soup.faces)), found_in(every, len(soup.faces))
    if (extra := own & ~others & ~opened).any():
        said.append(f"{extra.sum()} extra")
    covered, z = fragments.triangle_ids >= 0, fragments.depth.astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        unsure = known.unsure + 2 * SINGLE * np.abs(known.depth)
        unsure = np.where(np.isnan(unsure), np.inf, unsure)
        # At the last layer others of the same depth may stand.
        at = np.where(covered[-1], fragments.triangle_ids[-1], 0)
        rough = 4 * np.maximum(unsure, np.take_along_axis(unsure, at[None], axis=0))
        missing = others & ~own & ~opened & ((known.depth < z[-1] - rough) | ~covered[-1])
    if missing.any():
        said.append(f"{missing.sum()} missing")
    k, y, x = np.nonzero(covered)
    t = fragments.triangle_ids[k, y, x]
    if (np.abs(fragments.depth[k, y, x] - known.depth[t, y, x]) > 4 * unsure[t, y, x]).any():
        said.append("depths")
    off = np.abs(fragments.barycentrics[k, y, x] - known.weights[t, y, x]).max(axis=-1, initial=0)
    if (off > 1e-6 + 4 * known.skewed[t, y, x]).any():
        said.append("barycentrics")
    if fragments.depth[~covered].any() or fragments.barycentrics[~covered].any():
        said.append("something where nothing is")
    if (covered[1:] & (z[1:] < z[:-1])).any():
        said.append("order")
    return said
