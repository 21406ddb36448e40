"""Triangle meshes: positions and any attributes, interpolated with barycentrics (paper §3.1.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rts import GBuffer, InputError, Part, TriangleSurface, engine_of
from rts.plugin_api.arrays import Array, Tree, exemplar
from rts.plugin_api.checks import fingerprint, index_table, quoted
from rts.plugin_api.operations import differences, interpolate, take, with_room
from rts.plugin_api.records import Proxy, Rate, Samples
from rts.plugin_api.threads import read_only
from rts_surfaces import smooth_normals as smooth
from rts_surfaces.parameter_checks import G_BUFFER_NAMES, check_names, check_rows

VERTEX_ATTRIBUTES = ("normals", "colors", "uv", "tangents")


class Mesh(TriangleSurface):
    """A triangle mesh.

    θ["vertices"] (V, 3) are the positions. Attributes are further entries of θ, each (A, C): "normals", "colors", "uv"
    and "tangents" are known and have one row a vertex (A = V). `indices` declares attributes of other names, and tables
    for attributes with other rows, such as a uv map with split seams. In the G-buffer "normals" becomes "normal",
    "colors" becomes "color", and "tangents" becomes "tangent". Where θ has no normals, smooth ones are computed from
    the positions, differentiably, if the shader reads them; so are tangents for normal maps. "tangents" (A, 4) are the
    directions in which u grows, each with the sign of the direction of v (`rts.GBuffer`).

    Args:
        faces: (T, 3) integers into θ["vertices"]; copied.
        indices: attribute name → (T, 3) integers into θ[name], or None for one row a vertex; copied.

    Raises:
        InputError: tables of another shape, of no integers, or traced: topology is known while Python runs; or a name
            in `indices` that is reserved, such as "normal".
    """

    proxy_is_cheap = True
    param_step = 0.25

    def __init__(self, faces: ArrayLike, indices: Mapping[str, ArrayLike | None] | None = None):
        if indices is not None and not isinstance(indices, Mapping):
            raise InputError(
                f"indices is {quoted(indices)}; expected a dict of name → (T, 3) integers. Vertices are no argument: "
                "Part(Mesh(faces), {'vertices': vertices})"
            )
        self.faces = index_table("faces", faces, 3)
        self.face_count = len(self.faces)
        self._tables = [self.faces]
        self._columns: dict[str, int] = dict.fromkeys(VERTEX_ATTRIBUTES, 0)
        check_names(indices or ())
        for name, table in (indices or {}).items():
            self._columns[name] = 0
            if table is not None:
                table = index_table(f"indices[{name!r}]", table, 3)
                if table.shape != self.faces.shape:
                    raise InputError(f"indices[{name!r}] has shape {table.shape}; expected {self.faces.shape} as faces")
                if not np.array_equal(table, self.faces):
                    self._columns[name] = 3 * len(self._tables)
                    self._tables.append(table)
        self._ids = self.faces if len(self._tables) == 1 else read_only(np.concatenate(self._tables, axis=1))
        self._corners = None if len(self._tables) == 1 else _corners(self._tables)
        self._extents = [int(t.max()) + 1 for t in self._tables]
        self.sample_widths = (self._ids.shape[1], 2)
        self._normals: tuple[tuple, np.ndarray, np.ndarray] | None = None
        self._reads: dict[tuple, tuple[str, ...]] = {}
        self._looked_at = False

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make a copy's tables read-only, too."""
        vars(self).update(state)
        for table in (*self._tables, self._ids, *([] if self._corners is None else [self._corners])):
            table.flags.writeable = False

    def __repr__(self) -> str:
        return f"Mesh({len(self.faces)} faces)"

    @property
    def indices(self) -> dict[str, np.ndarray | None]:
        """Attribute name → its table (T, 3), read-only, or None for one row a vertex: of all that were declared."""
        declared = [name for name, column in self._columns.items() if column or name not in VERTEX_ATTRIBUTES]
        columns = {name: self._columns[name] for name in declared}
        return {name: self._tables[column // 3] if column else None for name, column in columns.items()}

    @classmethod
    def example(cls) -> Part:
        """A coloured icosahedron."""
        golden = (1 + 5**0.5) / 2
        corners = [c for a in (-1, 1) for b in (-golden, golden) for c in ((a, b, 0), (0, a, b), (b, 0, a))]
        directions = np.array(corners) / np.hypot(1, golden)
        triples = np.array(list(combinations(range(12), 3)))
        # Its faces are the triples of corners one edge apart; others are at least √2 times as far.
        sides = np.linalg.norm(directions[triples] - directions[np.roll(triples, 1, axis=1)], axis=2)
        faces = triples[(sides < 1.1).all(axis=1)]
        inward = np.linalg.det(directions[faces]) < 0
        faces[inward] = faces[inward][:, ::-1]
        theta = {"vertices": directions.astype(np.float32), "colors": (0.5 + 0.5 * directions).astype(np.float32)}
        return Part(cls(faces), theta, shader="lambert")

    def check(self, theta: Mapping[str, Tree]) -> None:
        """Refuse θ that lacks an entry of `reads`, or has one of wrong shape or dtype."""
        for name in self.reads(theta):
            column = self._columns.get(name, 0)
            check_rows("a mesh", theta, name, self._extents[column // 3])
            rows, vertices = theta[name].shape[0], theta["vertices"].shape[0]
            if column == 0 and rows > vertices:
                raise InputError(
                    f"theta[{name!r}] of a mesh has {rows} rows, and there are {vertices} vertices; expected one row a "
                    f"vertex, or Mesh(faces, indices={{{name!r}: table}}), as the surfaces that rts.load makes have"
                )

    def _attributes(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        return self.reads(theta)[1:]

    def reads(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The entries of θ that `evaluate` needs: "vertices", known attributes that θ has, and all declared ones."""
        names = tuple(theta)
        if names not in self._reads:
            known = (name for name in self._columns if name in theta or name not in VERTEX_ATTRIBUTES)
            self._reads[names] = ("vertices", *known)
        return self._reads[names]

    def rates(self, theta: Mapping[str, Tree]) -> Sequence[Rate]:
        """Meshes with about 1/16 and 1/4 of the faces, the coarser first.

        Empty if there are fewer than 20,000 faces, if fast-simplification is not installed, if the vertices are of
        torch or jax, if θ has normals or uv, or if an attribute has a table other than the faces.
        """
        from rts_surfaces.decimation import fewer_faces

        plain = len(self._tables) == 1 and "normals" not in theta and "uv" not in theta
        if not plain or exemplar(theta["vertices"]) is not None:
            return ()
        declared = dict.fromkeys(name for name in self._columns if name not in VERTEX_ATTRIBUTES)
        offered = []
        for faces, vertices, nearest in fewer_faces(np.asarray(theta["vertices"]), self.faces):
            change = partial(self._thinned, vertices, nearest)
            offered.append(Rate(f"faces={len(faces)}", len(faces) / len(self.faces), Mesh(faces, declared), change))
        return offered

    def _thinned(self, vertices: np.ndarray, nearest: np.ndarray, theta: Mapping[str, Tree]) -> dict[str, Tree]:
        """θ with fewer `vertices` (V', 3); each has the attributes of an old vertex, whose index is in `nearest` (V',).

        Further entries of θ stay.
        """
        kept = {name: theta[name] for name in self._attributes(theta)}
        attributes = {name: take(x, engine_of(x).constant(nearest, x)) for name, x in kept.items()}
        return {**theta, **attributes, "vertices": vertices}

    def proxy_inputs(self, theta: Mapping[str, Tree]) -> Array:
        """The vertices."""
        return theta["vertices"]

    def proxy(self, inputs: np.ndarray, camera: Any, size: tuple[int, int]) -> Proxy:
        """The mesh itself, its vertices in float32, or in float64 if they are given so."""
        dtype = np.float64 if inputs.dtype == np.float64 else np.float32
        return Proxy(np.ascontiguousarray(inputs, dtype=dtype), self.faces, self._ids, corners=self._corners)

    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """Interpolated positions and attributes; see the class for their names."""
        vertices = with_room(theta["vertices"])
        gbuffer = GBuffer(position=self._interpolate(vertices, samples, 0))
        gbuffer.defer("face_normal", partial(smooth.face_normals, vertices, samples.ids))
        for name in self._attributes(theta):
            gbuffer.defer(G_BUFFER_NAMES.get(name, name), partial(self.attribute, name, theta[name], samples))
        if "normals" not in theta:
            gbuffer.defer("normal", partial(self._smooth_normals, vertices, samples))
        if "uv" in theta:
            gbuffer.defer("uv_steps", partial(self._steps, vertices, theta["uv"], samples))
        return gbuffer

    def _steps(self, vertices: Array, uv: Array, samples: Samples) -> Array:
        """How position and uv change along both parameters (N, 10), constant."""
        steps = [differences(rows, samples.ids, self._columns.get(n, 0)) for n, rows in (("", vertices), ("uv", uv))]
        return engine_of(*steps).namespace.concat(steps, axis=1)

    def attribute(self, name: str, rows: Array, samples: Samples) -> Array:
        """An attribute (N, C) at samples, interpolated between `rows` (A, C) of θ[name]."""
        return self._interpolate(rows, samples, self._columns[name])

    def _interpolate(self, rows: Array, samples: Samples, column: int) -> Array:
        return interpolate(rows, samples.ids, column, samples.params)

    def _smooth_normals(self, vertices: Array, samples: Samples) -> Array:
        """Normals (N, 3) at samples where θ has none; the first time, a warning if they are of no use."""
        if not self._looked_at:
            self._looked_at = True
            smooth.warn_of_windings(self.faces)
        if isinstance(vertices, np.ndarray):
            normals, cancelled = self._vertex_normals(vertices)
            found = self._interpolate(normals, samples, 0)
            if not cancelled.any():
                return found
            return smooth.with_own_normals(found, cancelled, vertices, samples.params, samples.ids)
        return smooth.smooth_normals(vertices, samples.params, samples.ids, self.faces)

    def vertex_normals(self, vertices: Array) -> Array:
        """Unit normals (V, 3): directions of the area-weighted sums over the faces around each vertex, or zero.

        They are zero where there is no area around a vertex, or where its faces nearly cancel, as both sides of a
        double face do; samples have the normals of their own triangles there. Those of NumPy vertices are kept until
        the vertices change.
        """
        return self._vertex_normals(vertices)[0]

    def _vertex_normals(self, vertices: Array) -> tuple[Array, Array]:
        if exemplar(vertices) is not None:
            return smooth.vertex_normals(vertices, smooth.table_of(self.faces, vertices))
        key, kept = fingerprint(vertices), self._normals
        if kept is None or kept[0] != key:
            kept = self._normals = (key, *smooth.vertex_normals(vertices, self.faces))
        return kept[1:]


def _corners(tables: Sequence[np.ndarray]) -> np.ndarray:
    """`Proxy.corners` (T, 3) of tables (T, 3): corners are alike which are so in all tables."""
    numbers = tables[0].astype(np.int64)
    for table in tables[1:]:
        numbers = np.unique(numbers * (int(table.max()) + 1) + table, return_inverse=True)[1].reshape(numbers.shape)
    found = numbers.astype(np.int32)
    found.flags.writeable = False  # It owns its memory, so that what is known of it is kept.
    return found
