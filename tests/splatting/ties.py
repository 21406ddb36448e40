"""Scenes of one or two parts in which layers tie, cross or nearly do, each by its number."""

from typing import NamedTuple

import numpy as np
from helpers import rotation

from rts import Camera
from rts.scene.camera import orthographic, perspective


class Ties(NamedTuple):
    """A scene: meshes, a camera (NumPy float64), and how to look at them."""

    meshes: list[tuple[np.ndarray, np.ndarray]]
    camera: Camera
    size: tuple[int, int]
    layers: int
    cull: str


KINDS = ("plates", "crossing", "centers", "needles", "depths", "stacks", "grids")


def ties_of(number):
    """The scene of a number; its kind is `KINDS[number % len(KINDS)]`."""
    rng = np.random.default_rng(number)
    size = tuple(int(n) for n in rng.integers(5, 41, 2))
    layers, cull = int(rng.integers(2, 5)), str(rng.choice(["none", "none", "back"]))
    kind = KINDS[number % len(KINDS)]
    meshes, snapped = _MAKERS[kind](rng, size)
    if snapped:  # Corners on centres of pixels, and on their corners.
        meshes = [(np.round((v * max(size) / 2 + [size[1] / 2, size[0] / 2, 0]) * 2) / 2, f) for v, f in meshes]
    camera = _straight(size) if snapped or kind in ("centers", "grids") else _camera(rng, size, kind)
    return Ties([(v.astype(np.float32), f) for v, f in meshes], camera, size, layers, cull)


def _sheet(rng, normal, at, half):
    """A rectangle of two triangles, wound either way: its vertices (4, 3) and faces."""
    across = np.cross(normal, rng.normal(size=3))
    across /= np.linalg.norm(across)
    up = np.cross(normal, across)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * rng.uniform(0.3, 1, 2) * half
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return at + corners @ np.stack([across, up]), faces if rng.random() < 0.7 else faces[:, ::-1]


def _unit(rng, spread=1.0):
    """A direction within some spread of the viewer's."""
    way = np.array([0, 0, 1.0]) + spread * rng.normal(size=3)
    return way / np.linalg.norm(way)


def _joined(sheets):
    first = np.cumsum([0, *(len(v) for v, _ in sheets)])
    faces = [f + n for (_, f), n in zip(sheets, first, strict=False)]
    return np.concatenate([v for v, _ in sheets]), np.concatenate(faces).astype(np.int32)


def _plates(rng, size):
    """Plates of two parts in one plane, which overlap, and sometimes something before or behind them."""
    normal, parts = _unit(rng), []
    for _ in range(2):
        sheets = []
        for _ in range(rng.integers(1, 3)):
            shift = rng.normal(size=3) * 0.4
            sheets.append(_sheet(rng, normal, shift - (shift @ normal) * normal, 0.8))
        parts.append(sheets)
    if rng.random() < 0.5:
        parts[rng.integers(2)].append(_sheet(rng, _unit(rng), rng.choice([-0.5, 0.5]) * normal, 0.8))
    return [_joined(sheets) for sheets in parts], rng.random() < 0.3


def _crossing(rng, size):
    """Sheets that pass through one another, most at shallow angles."""
    normal, sheets = _unit(rng, 0.7), []
    for _ in range(rng.integers(2, 5)):
        tilt = normal + 10 ** rng.uniform(-3, 0) * rng.normal(size=3)
        sheets.append(_sheet(rng, tilt / np.linalg.norm(tilt), 0.1 * rng.normal(size=3) * rng.random(), 1.2))
    return _parts(rng, sheets), rng.random() < 0.2


def _centers(rng, size):
    """Triangles whose corners and edges lie exactly on pixels' centres and rows, some in one plane."""
    count = rng.integers(2, 12)
    corners = rng.integers(-1, 2 * max(size) + 2, (count, 3, 3)) / 2.0
    corners[..., 2] = rng.choice([-1, 0, 0, 1, 0.5], (count, 1)) + rng.choice([0, 0, 0.25], (count, 3))
    triangles = [(t, np.array([[0, 1, 2]], np.int32)) for t in corners]
    return _parts(rng, triangles), False


def _grids(rng, size):
    """Sheets of triangles with a vertex on every pixel's centre, or on every other, at depths that often tie."""
    sheets = []
    for _ in range(rng.integers(1, 4)):
        (height, width), step = rng.integers(2, 8, 2), rng.choice([1.0, 1.0, 2.0, 0.5])
        y, x = np.indices((height, width)).reshape(2, -1)
        start = rng.integers(0, 2 * np.array(size[::-1])) / 2 - rng.choice([0, 2])
        z = rng.choice([0.5, 1, 4]) * rng.integers(-2, 3, height * width) + rng.choice([0, 0, 0.3]) * x
        first = (y * width + x).reshape(height, width)[:-1, :-1].reshape(-1, 1)
        faces = np.concatenate([first + [0, 1, width + 1], first + [0, width + 1, width]]).astype(np.int32)
        sheets.append((np.stack([start[0] + step * x, start[1] + step * y, z], 1), faces))
    return _parts(rng, sheets), False


def _needles(rng, size):
    """Long triangles that are thinner than a pixel, before and through a sheet."""
    sheets = [_sheet(rng, _unit(rng), 0.2 * rng.normal(size=3), 1.0)]
    for _ in range(rng.integers(2, 10)):
        start, way = rng.normal(size=3) * 0.5, rng.normal(size=3)
        width = 10 ** rng.uniform(-4, -1)
        corners = np.stack([start - way, start + way, start + way * rng.uniform(-1, 1) + width * rng.normal(size=3)])
        sheets.append((corners, np.array([[0, 1, 2]], np.int32)))
    return _parts(rng, sheets), False


def _depths(rng, size):
    """Sheets before and behind one another, at depths of a ratio of up to a million."""
    sheets = []
    for _ in range(rng.integers(2, 6)):
        far = 10 ** rng.uniform(-3, 3)
        # Seen from (0, 0, 0) along -z, as `_camera` places itself for this kind.
        at = np.array([*rng.normal(size=2) * 0.3, -1]) * far
        sheets.append(_sheet(rng, _unit(rng), at, 0.7 * far))
    return _parts(rng, sheets), False


def _stacks(rng, size):
    """Sheets close behind one another, parallel or nearly, and the same sheet twice."""
    normal, sheets = _unit(rng), []
    gap = 10 ** rng.uniform(-6, -1)
    for i in range(rng.integers(2, 6)):
        tilt = normal + rng.choice([0, 0, gap]) * rng.normal(size=3)
        shift = rng.normal(size=3) * 0.3
        at = shift - (shift @ normal) * normal + i * gap * normal * rng.choice([0, 1, 1])
        sheets.append(_sheet(rng, tilt / np.linalg.norm(tilt), at, 0.8))
    return _parts(rng, sheets), rng.random() < 0.2


_MAKERS = dict(zip(KINDS, (_plates, _crossing, _centers, _needles, _depths, _stacks, _grids), strict=True))


def _parts(rng, sheets):
    """The sheets as one mesh, or shared out to two."""
    if len(sheets) < 2 or rng.random() < 0.5:
        return [_joined(sheets)]
    cut = rng.integers(1, len(sheets))
    return [_joined(sheets[:cut]), _joined(sheets[cut:])]


def _straight(size):
    """A camera whose pixels are of unit size, with the corner of the first at (0, 0) and rows along +y."""
    height, width = size
    view = np.eye(4)
    view[:3, 3] = [-width / 2, -height / 2, -20]
    return Camera(view, orthographic(height, width / height, 0.0, 100.0))


def _camera(rng, size, kind):
    aspect = size[1] / size[0]
    if kind == "depths":
        return Camera(np.eye(4), perspective(60, aspect, 1e-4, 1e4))
    eye = 3 * _unit(rng, 0.5)
    view = Camera.look_at(eye, 0.1 * rng.normal(size=3), up=rotation((0, 0, 1), rng.uniform(0, 360))[:, 1]).view
    if rng.random() < 0.4:
        return Camera(view, orthographic(rng.uniform(1, 3), aspect, 0.1, 10.0))
    return Camera(view, perspective(rng.uniform(20, 60), aspect, 0.1, 10.0))
