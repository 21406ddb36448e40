"""The cameras that surfaces and samplers get on the host, and their checks."""

from __future__ import annotations

import functools
import math

import numpy as np

from rts.arrays.argument_checks import is_invertible
from rts.arrays.engines import host_value
from rts.arrays.value_ranges import largest_absolute
from rts.errors import InputError
from rts.scene.camera import Camera


def on_host(camera: Camera) -> Camera:
    """A camera that is not traced, with matrices on the host."""
    if type(camera.view) is type(camera.projection) is np.ndarray:
        if camera.view.dtype == camera.projection.dtype == np.float64:
            return camera
    view, projection = host_value(camera.view), camera.projection
    projection = projection if type(projection) is np.ndarray else host_value(projection)
    return camera.replace(view=np.asarray(view, np.float64), projection=np.asarray(projection, np.float64))


WELL_CONDITIONED = 1e-6
"""The `_spread` of rows from which on a matrix is far from singular."""


def check_camera(camera: Camera, transform: np.ndarray | None = None) -> Camera:
    """The camera of host matrices, refused where it makes no image.

    Its matrices must be finite and invertible, with entries, and those of their product, of at most `LARGEST`. The last
    row of the view must be 0, 0, 0, 1, and that of the projection 0, 0, c ≤ 0, d.

    Args:
        camera: float64; its view is that of the camera times the part's transform.
        transform: the part's transform, if it has one, which an error may blame.

    Returns:
        The camera, the last row of its view without rounding.
    """
    # Few numbers: NumPy would take far longer.
    few = camera.view.ravel().tolist(), camera.projection.ravel().tolist()
    for name, numbers in zip(("view", "projection"), few, strict=True):
        if not all(map(math.isfinite, numbers)):
            bad = name == "view" and transform is not None and not np.isfinite(transform).all()
            what = "transform of a part" if bad else f"camera's {name} matrix"
            raise InputError(f"the {what} holds NaN or infinity; check how it was made")
    if max(map(abs, [*few[0], *few[1]])) > LARGEST or largest_absolute(camera.projection @ camera.view) > LARGEST:
        _refuse_large(camera, transform)
    # Most are far from singular; singular values take longer.
    well = _spread(camera.view[:3, :3]) > WELL_CONDITIONED
    if not (well and _spread_of_projection(camera.projection.tobytes()) > WELL_CONDITIONED):
        _check_invertible(camera)
    x, y, z, w = camera.view[3].tolist()
    if max(abs(x), abs(y), abs(z), abs(w - 1)) > ROUNDING:
        raise InputError(
            f"the last row of the camera's view times the part's transform is {[x, y, z, w]}; expected 0, 0, 0, 1"
        )
    a, b, c, d = camera.projection[3].tolist()
    if max(abs(a), abs(b)) > ROUNDING * max(abs(c), abs(d)):
        raise InputError(
            f"the last row of the camera's projection is {[a, b, c, d]}; expected (0, 0, ±c, d): if it is the product "
            f"of projection and view, use Camera.from_mvp(matrix)"
        )
    if c > 0:
        raise InputError(
            f"the last row of the camera's projection is {[a, b, c, d]}: it looks along +z, which cannot be turned "
            f"while it is traced; use Camera.from_mvp(projection @ view)"
        )
    if x == y == z == 0 and w == 1:
        return camera
    return camera.replace(view=np.concatenate([camera.view[:3], [[0.0, 0.0, 0.0, 1.0]]]))


LARGEST = 1e18
"""The largest entry of a view, a transform, a projection and their product: with larger ones places in the image
overflow float32, for vertices of the largest size that is allowed."""


def _refuse_large(camera: Camera, transform: np.ndarray | None) -> None:
    """Raise the error of a camera with an entry larger than `LARGEST`; `transform` is blamed if it has one, too."""
    blamed = {"transform of a part": transform, "camera's projection matrix": camera.projection}
    sizes = {name: largest_absolute(np.asarray(x)) for name, x in blamed.items() if x is not None}
    sizes["camera's view matrix, times the part's transform,"] = largest_absolute(camera.view)
    with np.errstate(over="ignore", invalid="ignore"):
        sizes["product of the camera's projection and view"] = largest_absolute(camera.projection @ camera.view)
    name = next(name for name, size in sizes.items() if size > LARGEST)
    raise InputError(
        f"the {name} has an entry of size {sizes[name]:.3g}; expected at most {LARGEST:g}, "
        f"beyond which places in the image overflow: check how it was made, or choose larger units"
    )


ROUNDING = 1e-6
"""Tolerance of the entries of a matrix's last row, relative to its largest."""


def _spread(m: np.ndarray) -> float:
    """The squared determinant of a (3, 3) matrix over the product of its rows' squared lengths.

    It is 1 for orthogonal rows, 0 for dependent rows.
    """
    a, b, c, d, e, f, g, h, i = m.ravel().tolist()
    square = (a * a + b * b + c * c) * (d * d + e * e + f * f) * (g * g + h * h + i * i)
    return (a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)) ** 2 / square if square > 0 else 0.0


@functools.lru_cache(maxsize=64)
def _spread_of_projection(data: bytes) -> float:
    """The `_spread` of a (4, 4) float64 matrix, given as bytes; cached, since calls often repeat it."""
    matrix = np.frombuffer(data).reshape(4, 4)
    square = float((matrix * matrix).sum(axis=1).prod())
    return float(np.linalg.det(matrix)) ** 2 / square if square > 0 else 0.0


def _check_invertible(camera: Camera) -> None:
    # A view must not flatten, at whatever scale; the rows of a projection may differ in scale.
    singular = np.linalg.svd(camera.view[:3, :3], compute_uv=False)
    sound = {"view": singular[-1] > 1e-12 * singular[0], "projection": is_invertible(camera.projection)}
    for name in (name for name, ok in sound.items() if not ok):
        raise InputError(
            f"the camera's {name} matrix is singular (times the part's transform, for view); it has no inverse"
        )
