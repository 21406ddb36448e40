"""OpenSubdiv's limit surfaces with NumPy in and out: cages, weights of their control points, points, rays.

All loops run without the interpreter lock, on all cores. OpenSubdiv's objects are only read once they are made.
"""

from __future__ import annotations

import ctypes
import weakref
from typing import Any, NamedTuple

import numpy as np

from rts import InputError
from rts.plugin_api.threads import parallel, read_only
from rts_surfaces.subdivision import library
from rts_surfaces.subdivision.cage import Cage

SMOOTH, SHARP = 10, 10
"""Levels to which Bfr, OpenSubdiv's evaluator, isolates extraordinary vertices and creases: the largest possible. The
second limits the first. Bfr's defaults, 2 and 6, are off by up to 5e-3 of the extent; 8 and 8 by 1e-4, at spot's ears
and at semi-sharp creases of sharpness 7; 10 and 10 by 2e-5 there, at the same cost. Farther than 2⁻¹⁰ of a face from
such vertices, 10 and 10 are exact."""
MOST_NUMBERS = 2**28
"""The most numbers in the table of control points: a gigabyte."""

SCHEMES = {"catmark": 1, "loop": 2}
BOUNDARIES = {"none": 0, "edge_only": 1, "edge_and_corner": 2}
UV_RULES = {"none": 0, "corners_only": 1, "corners_plus1": 2, "corners_plus2": 3, "boundaries": 4, "all": 5}
"""Values of OpenSubdiv's options, by their names in USD."""

NONE, QUAD, TRIANGLE, SUBFACES = -1, 0, 1, 2
"""Kinds of faces: without a limit surface; with parameters in the unit square; with parameters in the triangle (0, 0),
(1, 0), (0, 1); with sub-faces, one a corner, each with parameters in its own square of side 1/2."""
VERTEX, UV = 0, 1
"""Kinds of data that are subdivided: of vertices, or face-varying."""


class Rules(NamedTuple):
    """The rules by which a cage is subdivided.

    Attributes:
        boundary: a key of `BOUNDARIES`.
        chaikin: True to smooth the sharpness of a crease along it by Chaikin's rule.
        uv: a key of `UV_RULES`: the places where face-varying data is interpolated linearly.
        smooth: the level to which extraordinary vertices are isolated.
        sharp: the level to which creases are isolated; it limits `smooth`, too.
    """

    boundary: str = "edge_and_corner"
    chaikin: bool = False
    uv: str = "corners_plus1"
    smooth: int = SMOOTH
    sharp: int = SHARP


class _Description(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int) for name in ("scheme", "boundary", "chaikin", "uv_rule", "smooth", "sharp")),
        *((name, ctypes.c_int) for name in ("vertices", "faces")),
        *((name, ctypes.c_void_p) for name in ("sizes", "indices", "twins")),
        *((name, ctypes.c_int) for name in ("creases", "corners")),
        *((name, ctypes.c_void_p) for name in ("crease_pairs", "crease_sharpness")),
        *((name, ctypes.c_void_p) for name in ("corner_vertices", "corner_sharpness")),
        ("holes", ctypes.c_int),
        ("hole_faces", ctypes.c_void_p),
        ("uv_rows", ctypes.c_int),
        ("uv_indices", ctypes.c_void_p),
    ]


class Limit:
    """The limit surface of a cage, for any control points. Its C++ memory is freed when it is garbage-collected.

    Args:
        cage: a cage that has been checked.
        rules: the rules of subdivision; None for the default ones.
        uv: (H,) int32, the row of face-varying data of each corner of each face, or None.

    Attributes:
        table: (F, W) int32, the vertices on which each face depends, padded with one of them; read-only. For faces
            without a limit surface, the first of `used`.
        uv_table: (F, W') int32, the rows of face-varying data on which each face depends; None without such data.
        kinds: (F,) int32, `NONE`, `QUAD`, `TRIANGLE` or `SUBFACES`.
        used: (U,) int32, the vertices that faces refer to, in increasing order; read-only.
        corners: (H, 2) float64, parameters at the corners of each face; for sub-faces their least parameters; zero for
            faces without a limit surface.

    Raises:
        InputError: OpenSubdiv refuses the cage, or its faces depend on too many vertices.
        PluginError: OpenSubdiv cannot be used.
    """

    def __init__(self, cage: Cage, rules: Rules | None = None, uv: np.ndarray | None = None):
        self._library, self.cage, rules = library.load(), cage, rules or Rules()
        # Vertices and rows that no face refers to stay out of it.
        used, indices = np.unique(cage.indices, return_inverse=True)
        place = np.zeros(int(used[-1]) + 1, np.int32)
        place[used] = np.arange(len(used), dtype=np.int32)
        uv_used, uv_indices = (None, None) if uv is None else np.unique(uv, return_inverse=True)
        arrays = {
            "sizes": cage.sizes,
            "indices": indices.reshape(-1).astype(np.int32),
            "twins": cage.twins,
            "crease_pairs": place[cage.creases],
            "crease_sharpness": cage.crease_sharpness,
            "corner_vertices": place[cage.corners],
            "corner_sharpness": cage.corner_sharpness,
            "hole_faces": cage.holes,
        }
        if uv_indices is not None:
            arrays["uv_indices"] = uv_indices.reshape(-1).astype(np.int32)
        arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        description = _Description(
            scheme=SCHEMES[cage.scheme],
            boundary=BOUNDARIES[rules.boundary],
            chaikin=rules.chaikin,
            uv_rule=UV_RULES[rules.uv],
            smooth=rules.smooth,
            sharp=rules.sharp,
            vertices=len(used),
            faces=len(cage.sizes),
            creases=len(cage.creases),
            corners=len(cage.corners),
            holes=len(cage.holes),
            uv_rows=0 if uv_used is None else len(uv_used),
            **{name: array.ctypes.data for name, array in arrays.items()},
        )
        handle, widths = ctypes.c_void_p(), (ctypes.c_int * 2)()
        self._call("rts_cage", ctypes.byref(description), ctypes.byref(handle), widths)
        self.handle = handle.value or 0
        # Memory that one `Points` leaves to the next, so that the system need not clear it page by page.
        self._left: list[int] = []
        weakref.finalize(self, _free, self._library, self.handle, self._left)
        self.used = read_only(used.astype(np.int32))
        self._tables(widths[0], uv_used, widths[1])

    def _tables(self, width: int, uv_used: np.ndarray | None, uv_width: int) -> None:
        count = len(self.cage.sizes)
        if count * max(width, uv_width) > MOST_NUMBERS:
            raise InputError(
                f"a face of the cage depends on {max(width, uv_width)} vertices, too many for a table of {count} "
                f"faces; divide the faces with many corners, and those around vertices with many edges"
            )
        table = np.empty((count, width), np.int32)
        uv_table = None if uv_used is None else np.empty((count, uv_width), np.int32)
        self.kinds, self.corners = np.empty(count, np.int32), np.empty((len(self.cage.indices), 2))
        uv_data = None if uv_table is None else uv_table.ctypes.data
        self._call(
            "rts_tables", self.handle, table.ctypes.data, uv_data, self.kinds.ctypes.data, self.corners.ctypes.data
        )
        self.table = read_only(self.used[table])
        self.uv_table = None if uv_table is None or uv_used is None else read_only(uv_used.astype(np.int32)[uv_table])

    def _call(self, name: str, *args: Any) -> None:
        if getattr(self._library, name)(*args):
            said = " ".join(self._library.rts_message().decode(errors="replace").split())
            raise InputError(f"the subdivision surface cannot be computed: {said}")

    def stencils(
        self, faces: np.ndarray, params: np.ndarray, dtype: Any = np.float64, channel: int = VERTEX
    ) -> np.ndarray:
        """Weights (N, W) of the vertices `table[faces]`: their weighted sums are points on the limit surface.

        All are zero on a face without a limit surface (whose kind is `NONE`).

        Args:
            faces: (N,) integers.
            params: (N, 2) float.
            dtype: float32 or float64.
            channel: `VERTEX`; or `UV`, for weights (N, W') of rows `uv_table[faces]`; `uv_table` must not be None.

        Raises:
            InputError: there is no such face, or parameters are of another shape, not finite, or far outside of their
                face.
        """
        out = np.empty((len(faces), self._width(channel)), dtype)
        self._stencils(faces, params, channel, out, None, None)
        return out

    def derivative_stencils(
        self, faces: np.ndarray, params: np.ndarray, dtype: Any = np.float64, channel: int = VERTEX
    ) -> tuple[np.ndarray, np.ndarray]:
        """Weights (N, W) for the derivatives along u, and along v; see `stencils`.

        At points whose derivatives are parallel for any control points, as at the corner of a sheet with a smooth
        boundary, the weights are those of a point beside.
        """
        along_u, along_v = np.empty((2, len(faces), self._width(channel)), dtype)
        self._stencils(faces, params, channel, None, along_u, along_v)
        return along_u, along_v

    def _width(self, channel: int) -> int:
        table = self.table if channel == VERTEX else self.uv_table
        assert table is not None
        return table.shape[1]

    def _stencils(self, faces: np.ndarray, params: np.ndarray, channel: int, *out: np.ndarray | None) -> None:
        faces, params = self._samples(faces, params)
        kind = next(x for x in out if x is not None)
        name = "rts_stencils_float" if kind.dtype == np.float32 else "rts_stencils_double"
        data = [None if x is None else x.ctypes.data for x in out]

        def some(start: int, stop: int) -> None:
            self._call(name, self.handle, channel, start, stop, faces.ctypes.data, params.ctypes.data, *data)

        parallel(some, len(faces), work=500 * len(faces))

    def _samples(self, faces: np.ndarray, params: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Checked faces (N,) int32 and parameters (N, 2) float64, contiguous, as the C++ library takes them.

        Raises:
            InputError: there is no such face, or parameters are of another shape, or not finite.
        """
        faces, params = np.ascontiguousarray(faces, np.int32), np.ascontiguousarray(params, np.float64)
        if len(faces) and not 0 <= faces.min() <= faces.max() < len(self.kinds):
            raise InputError(f"samples lie on faces {faces.min()} to {faces.max()} of {len(self.kinds)}; sample anew")
        if params.shape != (len(faces), 2):
            raise InputError(f"samples have {len(faces)} faces and parameters of shape {params.shape}; sample anew")
        if not np.isfinite(params).all():
            raise InputError("parameters of samples are NaN or infinite; expected finite numbers")
        return faces, params

    def points(self, vertices: np.ndarray) -> Points:
        """The limit surface for vertices (V, 3), prepared to be evaluated many times; see `Points`."""
        return Points(self, vertices)


class Points:
    """The limit surface of a cage for given vertices. Its C++ memory is freed when it is garbage-collected.

    Args:
        limit: the limit surface.
        vertices: (V, 3) float, all to which faces refer.

    Raises:
        InputError: vertices of another shape.
    """

    def __init__(self, limit: Limit, vertices: np.ndarray):
        self.limit = limit  # The limit must live as long as these points.
        if np.ndim(vertices) != 2 or np.shape(vertices)[1] != 3 or len(vertices) <= limit.used[-1]:
            raise InputError(
                f"vertices have shape {np.shape(vertices)}; expected (V, 3), V at least {limit.used[-1] + 1}"
            )
        try:
            self.handle = limit._left.pop()
        except IndexError:
            handle = ctypes.c_void_p()
            limit._call("rts_points", limit.handle, ctypes.byref(handle))
            self.handle = handle.value or 0
        weakref.finalize(self, _leave, limit._library, limit._left, self.handle)
        rows = np.ascontiguousarray(np.asarray(vertices, np.float64)[limit.used])

        def some(start: int, stop: int) -> None:
            limit._call("rts_move", self.handle, start, stop, rows.ctypes.data)

        parallel(some, len(limit.kinds), work=10_000 * len(limit.kinds))

    def evaluate(self, faces: np.ndarray, params: np.ndarray, derivatives: int = 0) -> np.ndarray:
        """Points and derivatives (N, D, 3) float64, D = 1, 3 or 6: the point; in u, v; in uu, uv, vv.

        All are zero on a face without a limit surface.

        Args:
            faces: (N,) integers.
            params: (N, 2) float.
            derivatives: the highest order of derivatives, 0, 1 or 2. In OpenSubdiv 3.5.0 all second derivatives have
                the wrong sign in those triangles of Loop's subdivision that are turned round, such as the middle one of
                four.

        Raises:
            InputError: there is no such face, or parameters are of another shape, not finite, or far outside of their
                face.
        """
        faces, params = self.limit._samples(faces, params)
        out = np.empty((len(faces), (1, 3, 6)[derivatives], 3))

        def some(start: int, stop: int) -> None:
            data = faces.ctypes.data, params.ctypes.data, derivatives, out.ctypes.data
            self.limit._call("rts_evaluate", self.handle, start, stop, *data)

        parallel(some, len(faces), work=500 * len(faces))
        return out

    def newton(
        self,
        faces: np.ndarray,
        params: np.ndarray,
        origins: np.ndarray,
        directions: np.ndarray,
        spread: np.ndarray,
        limits: tuple[float, int, float, float, int],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Hits of rays with the surface, by Newton's method from samples nearby.

        Args:
            faces: (N,) integers, the faces of the samples.
            params: (N, 2) float, the parameters of the samples.
            origins: (N, 3) float.
            directions: (N, 3) float; the point at depth z is `origin + z direction`.
            spread: (2,), a pixel at depth z is `spread[0] + spread[1] z` wide.
            limits: residual in pixels, largest number of steps, largest step, largest distance beyond the edge of a
                face, both in units of the face or sub-face; and the number of edges that may be crossed.

        Returns:
            Faces (N,) int32, parameters (N, 2) float64, depth (N,) float64, and (N,) bool, True for a hit. Without a
            hit the first three mean nothing. The arguments are not changed.

        Raises:
            InputError: there is no such face, arrays have other shapes, or parameters are not finite, or far outside of
                their face.
        """
        faces, params = (x.copy() for x in self.limit._samples(faces, params))
        rays = [np.ascontiguousarray(x, np.float64) for x in (origins, directions, spread, limits)]
        shapes = [x.shape for x in rays]
        if shapes != [(len(faces), 3), (len(faces), 3), (2,), (5,)]:
            raise InputError(f"rays and limits have shapes {shapes}; expected (N, 3), (N, 3), (2,) and (5,)")
        depth, met = np.empty(len(faces)), np.empty(len(faces), bool)
        data = [x.ctypes.data for x in (faces, params, *rays, depth, met)]

        def some(start: int, stop: int) -> None:
            self.limit._call("rts_newton", self.handle, start, stop, *data)

        parallel(some, len(faces), work=2000 * len(faces))
        return faces, params, depth, met


def _leave(functions: ctypes.CDLL, left: list[int], points: int) -> None:
    """Keep the memory of one `Points` for the next; free it if some is kept already."""
    if left:
        functions.rts_points_free(points)
    else:
        left.append(points)


def _free(functions: ctypes.CDLL, cage: int, left: list[int]) -> None:
    for points in left:
        functions.rts_points_free(points)
    left[:] = [0]  # So that `_leave` frees points that are collected later, in a cycle, and keeps none.
    functions.rts_cage_free(cage)
