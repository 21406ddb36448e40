"""Subdivision surfaces: the limit of Catmull–Clark or Loop subdivision of a cage, by OpenSubdiv.

A sample is a face of the cage and (u, v) in this face, as OpenSubdiv's module Bfr defines them. Points are sums of
control points with weights that depend on the sample alone: linear in θ, and exactly differentiable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rts import GBuffer, InputError, Part, engine_of
from rts.plugin_api.arrays import Array, Tree, constants, shape_of, unit
from rts.plugin_api.checks import fingerprint, quoted
from rts.plugin_api.operations import combine, filled_up, take, tangent_along, with_room
from rts.plugin_api.records import ArraySpec, Rays, Samples
from rts.plugin_api.threads import read_only
from rts_surfaces.parameter_checks import G_BUFFER_NAMES, check_names, check_rows
from rts_surfaces.patches.parametric import (
    BEYOND,
    CROSSINGS,
    LARGEST_STEP,
    RESIDUAL,
    STEPS,
    TOLERANCE,
    Geometry,
    Parametric,
)
from rts_surfaces.subdivision import library
from rts_surfaces.subdivision.binding import BOUNDARIES, UV, UV_RULES, VERTEX, Limit, Points, Rules
from rts_surfaces.subdivision.cage_checks import checked_cage, checked_lists
from rts_surfaces.subdivision.face_tiles import tiles_of

library.find()  # Without OpenSubdiv there is no such plugin.

BESIDE = 1 / 16
"""Distance from the border of a tile, as a share of its size, from which on its bend is measured. At extraordinary
vertices second derivatives have no bound, and at creases they are large. Both cover so little of a tile that triangles
stay near the surface."""
LIMITS = RESIDUAL, STEPS + CROSSINGS, LARGEST_STEP, BEYOND, CROSSINGS

VERTEX_ATTRIBUTES = ("colors", "uv")


class LimitGeometry(Geometry):
    """The limit surface of control points."""

    def __init__(self, points: Points):
        self._points = points

    def points(self, patch: np.ndarray, params: np.ndarray, order: int) -> np.ndarray:
        """See `Geometry`."""
        return self._points.evaluate(patch, params, order)

    def meet(self, samples: Samples, rays: Rays) -> Samples:
        """See `Geometry`; samples may go on to other faces."""
        ends = rays.origins, rays.directions, rays.spread
        faces, params, depth, met = self._points.newton(samples.ids[:, 0], samples.params, *ends, LIMITS)
        kept = samples.row >= 0
        kept &= met[samples.row]
        faces[~met], params[~met] = 0, 0
        row = np.where(kept, samples.row, -1)
        return samples.replace(ids=faces[:, None], params=params, row=row, depth=np.where(kept, depth[samples.row], 0))


class Subdivision(Parametric):
    """The limit surface of a cage.

    θ["vertices"] (V, 3) are the control points. Attributes of control points are further entries of θ, each (A, C):
    "colors" (1, 3 or 4 wide) and "uv" (2 wide) are known, others are declared by `indices`. All attributes are
    subdivided as positions are. In the G-buffer "colors" becomes "color". Normals are those of the limit surface.

    Points are those of the limit but for rounding, except within 2⁻¹⁰ of a face from an extraordinary vertex, where
    OpenSubdiv's patches end: there they are off by less than 1e-4 of the cage's extent.

    Args:
        faces: lists of integers into θ["vertices"], counter-clockwise seen from outside; or an array (F, n).
        scheme: "catmark" (Catmull–Clark, any polygons) or "loop" (triangles).
        creases: rows (a, b, sharpness): edges by their vertices. An edge of sharpness s stays sharp for s steps of
            subdivision; from 10 on, for ever.
        corners: rows (vertex, sharpness).
        holes: numbers of faces that shape the surface, and are no part of it.
        boundary: the rule for edges with one face: "edge_and_corner" (the surface ends there, and vertices of one
            face are corners), "edge_only" (no corners), "none" (faces at the boundary have no surface).
        chaikin: True if the sharpness of creases is smoothed along them.
        indices: attribute name → None for one row a vertex, which declares an attribute of another name. For "uv" it
            may be lists of integers into θ["uv"], shaped as `faces`: a face-varying map with seams.
        uv_rule: where a face-varying uv is linear rather than smooth: "none", "corners_only", "corners_plus1",
            "corners_plus2", "boundaries" or "all", as in OpenSubdiv and USD.
        tolerance: the largest distance of triangles from the surface near outlines, pixels.

    Raises:
        InputError: the cage has no limit surface that can be computed, or an option is wrong.
        PluginError: OpenSubdiv does not work.
    """

    beside = BESIDE

    def __init__(
        self,
        faces: ArrayLike | Sequence[Sequence[int]],
        scheme: str = "catmark",
        *,
        creases: ArrayLike = (),
        corners: ArrayLike = (),
        holes: ArrayLike = (),
        boundary: str = "edge_and_corner",
        chaikin: bool = False,
        indices: Mapping[str, ArrayLike | Sequence[Sequence[int]] | None] | None = None,
        uv_rule: str = "corners_plus1",
        tolerance: float = TOLERANCE,
    ):
        for name, value, known in (("boundary", boundary, BOUNDARIES), ("uv_rule", uv_rule, UV_RULES)):
            if not isinstance(value, str) or value not in known:
                raise InputError(f"{name} is {quoted(value)}; expected one of {', '.join(map(repr, known))}")
        if not isinstance(chaikin, (bool, np.bool_)):
            raise InputError(f"chaikin is {quoted(chaikin)}; expected True or False")
        self._rules = Rules(boundary, bool(chaikin), uv_rule)
        self.cage = checked_cage(faces, scheme, creases, corners, holes)
        self._declared, self._uv = self._attribute_indices(indices)
        self._count = int(self.cage.indices.max()) + 1
        self._uv_count = self._count if self._uv is None else int(self._uv.max()) + 1
        self._prepare()
        super().__init__(tiles_of(self.limit), tolerance, self.limit.used)

    def _attribute_indices(self, indices: Mapping[str, Any] | None) -> tuple[tuple[str, ...], np.ndarray | None]:
        """Names of known and declared attributes, and the rows (H,) of a face-varying uv, or None.

        Raises:
            InputError: `indices` is no dict of names that attributes may have, or has lists of another shape, or for
                another name than "uv".
        """
        if indices is not None and not isinstance(indices, Mapping):
            raise InputError(f"indices is {quoted(indices)}; expected a dict of name → None, or lists for 'uv'")
        check_names(indices or (), ("normals",))
        uv = None
        for name, lists in (indices or {}).items():
            if lists is None:
                continue
            if name != "uv":
                raise InputError(f"indices[{name!r}] is {quoted(lists)}; expected None; only 'uv' has lists")
            sizes, uv = checked_lists("indices['uv']", lists)
            if not np.array_equal(sizes, self.cage.sizes):
                raise InputError("indices['uv'] has faces of other sizes than the cage; expected a row for each corner")
            uv = read_only(uv)
        return tuple(dict.fromkeys((*VERTEX_ATTRIBUTES, *(indices or {})))), uv

    def _prepare(self) -> None:
        """Make OpenSubdiv's objects, which copies must make anew; an InputError if no face has a surface."""
        self.limit = Limit(self.cage, self._rules, self._uv)
        if not len(self.limit.table) or (self.limit.kinds < 0).all():
            raise InputError(
                "no face of the cage has a surface: all are holes, or at its boundary; leave out holes, or use another "
                "boundary rule"
            )
        self._points: tuple[tuple, Points] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """The state of a copy, without OpenSubdiv's objects, which no other process can use."""
        return {name: value for name, value in vars(self).items() if name not in ("limit", "_points")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._prepare()

    def __repr__(self) -> str:
        return f"Subdivision({len(self.cage.sizes)} faces, {self.cage.scheme})"

    @classmethod
    def example(cls) -> Part:
        """A coloured cube whose top is creased."""
        corners = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], np.float32)
        faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6)]
        creases = [(4, 5, 10), (5, 7, 10), (7, 6, 2), (6, 4, 2)]
        theta = {"vertices": 1.15 * corners, "colors": 0.5 + 0.4 * corners}
        return Part(cls(faces, creases=creases), theta, "lambert")

    @classmethod
    def load(cls, path: Path) -> list[Part]:
        """One part: the cage in an OBJ file, with uv, and OpenSubdiv's statements "t" for creases, corners and holes.

        Raises:
            InputError: the file is no OBJ, is damaged, or its cage has no limit surface.

        Warns:
            FileWarning: a statement is ignored.
        """
        from rts_surfaces.subdivision.obj_cages import read_cage

        cage = read_cage(path)
        try:
            surface = cls(cage.faces, **cage.options)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        return [Part(surface, cage.theta, cage.shader)]

    # ---------------------------------------------------------------------------------------------- checks

    def check(self, theta: Mapping[str, Tree]) -> None:
        """Refuse θ that lacks an entry of `reads`, or has one of wrong shape or dtype."""
        for name in self.reads(theta):
            check_rows(repr(self), theta, name, self._uv_count if name == "uv" else self._count)

    def reads(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The entries of θ that `evaluate` needs: "vertices", known attributes that θ has, and all declared ones."""
        known = (name for name in self._declared if name in theta or name not in VERTEX_ATTRIBUTES)
        return "vertices", *known

    # -------------------------------------------------------------------------------------------- sampling

    def control_points(self, theta: Mapping[str, Tree]) -> Array:
        """The vertices of the cage."""
        return theta["vertices"]

    def geometry(self, points: np.ndarray) -> Geometry:
        """See `Parametric`; the result is kept until the vertices change."""
        key, kept = fingerprint(points), self._points
        if kept is None or kept[0] != key:
            kept = self._points = key, self.limit.points(points)
        return LimitGeometry(kept[1])

    def uniform(self, rate: int) -> tuple[np.ndarray, np.ndarray]:
        """See `Parametric`. Where faces are quartered, an odd `rate` is rounded up."""
        # A quarter of a face has half of each side, and half of the pieces.
        quarters = len(self.whole.patch) != np.count_nonzero(self.limit.kinds >= 0)
        return super().uniform(-(-rate // 2) if quarters else rate)

    # ------------------------------------------------------------------------------------------ evaluation

    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """Positions, normals, and attributes of control points; see the class for their names."""
        vertices = theta["vertices"]
        engine = engine_of(vertices, samples.params)
        if not engine.owns(vertices):
            vertices = engine.constant(vertices, samples.params)
        params, faces = constants((samples.params, samples.ids[:, 0]), engine, vertices)
        vertices = with_room(vertices)
        at = partial(self._weights, vertices, faces, params)

        def ids_of(table: Any) -> Array:
            return take(engine.constant(filled_up(table, engine.room(len(table), vertices)), vertices), faces)

        ids = ids_of(self.limit.table)
        (weights,) = at(VERTEX, False)
        gbuffer = GBuffer(position=combine(vertices, ids, weights))

        @cache  # For normals and tangents.
        def slopes() -> tuple[Array, ...]:
            return tuple(combine(vertices, ids, w) for w in at(VERTEX, True))

        def uv(derivatives: bool) -> tuple[Array, ...]:
            varies = self._uv is not None
            rows = ids_of(self.limit.uv_table) if varies else ids
            return tuple(combine(theta["uv"], rows, w) for w in at(UV if varies else VERTEX, derivatives))

        gbuffer.defer("normal", lambda: unit(engine.namespace.linalg.cross(*slopes())))
        if "uv" in theta:
            gbuffer.defer("tangent", lambda: tangent_along(gbuffer["normal"], *zip(slopes(), uv(True), strict=True)))
        for name in self.reads(theta)[1:]:
            entry = G_BUFFER_NAMES.get(name, name)
            if name == "uv" and self._uv is not None:
                gbuffer.defer(entry, lambda: uv(False)[0])
            else:
                gbuffer.defer(entry, partial(combine, theta[name], ids, weights))
        return gbuffer

    def _weights(self, like: Array, faces: Array, params: Array, channel: int, derivatives: bool) -> tuple[Array, ...]:
        """Weights (N, W) of control points for points of the surface; for `derivatives` two arrays, along u and v.

        Returns a tuple of one array or two, in the dtype of `like`, float32 at least. `channel` is `VERTEX` or `UV`.
        """
        engine = engine_of(like, params)
        dtype = np.float64 if engine.namespace.finfo(like.dtype).bits == 64 else np.float32
        table = self.limit.table if channel == VERTEX else self.limit.uv_table
        assert table is not None
        spec = ArraySpec((shape_of(faces)[0], table.shape[1]), dtype)

        def host(faces: np.ndarray, params: np.ndarray) -> tuple[np.ndarray, ...]:
            if derivatives:
                return self.limit.derivative_stencils(faces, params, dtype, channel)
            return (self.limit.stencils(faces, params, dtype, channel),)

        return engine.call_host(host, [spec] * (1 + derivatives), faces, params)
