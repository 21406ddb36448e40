"""Bodies: meshes that joints bend (linear blend skinning), and that morph targets change.

Vertices are posed in array code; what samplers and shaders see is the mesh of the posed vertices.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rts import GBuffer, InputError, Part, TriangleSurface, engine_of, namespace
from rts.plugin_api.arrays import Array, Tree, constants, exemplar, from_numbers, shape_of, unit
from rts.plugin_api.checks import index_table, quoted
from rts.plugin_api.operations import combine, take
from rts.plugin_api.records import Proxy, Samples
from rts.plugin_api.threads import read_only
from rts_surfaces.mesh import Mesh
from rts_surfaces.parameter_checks import check_entry, check_rows

MORPHS = ("morph_vertices", "morph_weights")
"""Entries of θ that a mesh with morph targets has."""


class Skinned(TriangleSurface):
    """A triangle mesh that joints bend, and that morph targets change.

    θ has the entries of `rts.Mesh`, with "vertices" (V, 3) and "normals" at rest. A vertex v is posed as
    Σᵢ wᵢ M(jᵢ) (v + Σₖ mₖ dₖ), by further entries of θ, all differentiable:

    - "joint_transforms" (J, 4, 4): M, the affine map of each joint, from the mesh at rest to its pose.
    - "joint_weights" (V, I): w, the share of each joint of a vertex. They ought to sum to 1, and are taken as they are.
    - "morph_weights" (M,): m, the share of each morph target; "morph_vertices" (M, V, 3): d, its displacements.
    - "morph_normals" (M, A, 3): displacements of "normals", if there are any.

    Without `joints` no entry of joints is needed, and without "morph_vertices" none of morph targets. Normals of θ are
    turned with the joints, by the inverse transpose. Where θ has none, smooth ones of the posed vertices are computed.

    Args:
        faces: (T, 3) integers into θ["vertices"]; copied.
        joints: (V, I) integers into θ["joint_transforms"], the joints of each vertex; None for a mesh without joints.
            Vertices of fewer joints than I repeat any joint with a weight of 0.
        indices: as of `rts.Mesh`.

    Raises:
        InputError: tables of another shape, of no integers, or traced; or `indices` that `rts.Mesh` refuses.
    """

    proxy_is_cheap = True
    param_step = Mesh.param_step

    def __init__(
        self,
        faces: ArrayLike,
        joints: ArrayLike | None = None,
        indices: Mapping[str, ArrayLike | None] | None = None,
    ):
        self.mesh = Mesh(faces, indices)
        self.joints: np.ndarray | None = None
        self._normal_rows: tuple[np.ndarray, np.ndarray] | None = None
        self._normal_count = int(self.mesh.faces.max()) + 1
        table = None if indices is None else indices.get("normals")
        if joints is not None:
            shape = shape_of(from_numbers(joints, "joints"))
            if len(shape) != 2 or not shape[1]:
                raise InputError(f"joints is {quoted(joints)}; expected (V, I) integers, the joints of each vertex")
            self.joints = index_table("joints", joints, shape[1])
            if len(self.joints) < self._normal_count:
                raise InputError(
                    f"joints has {len(self.joints)} rows, but faces refer to vertex {self._normal_count - 1}; "
                    "expected a row for each vertex"
                )
        if table is not None:
            self._split_normals(index_table("indices['normals']", table, 3), dict(indices or {}))
        self.sample_widths, self.face_count = self.mesh.sample_widths, self.mesh.face_count

    def _split_normals(self, table: np.ndarray, indices: dict[str, Any]) -> None:
        """Give each pair of a normal and a vertex a row of its own, since each vertex turns its normals otherwise."""
        self._normal_count = int(table.max()) + 1
        pairs = np.stack([table.reshape(-1), self.mesh.faces.reshape(-1)], axis=1)
        pairs, rows = np.unique(pairs, axis=0, return_inverse=True)
        self._normal_rows = read_only(pairs[:, 0]), read_only(pairs[:, 1])
        self.mesh = Mesh(self.mesh.faces, {**indices, "normals": rows.reshape(-1, 3)})

    def __repr__(self) -> str:
        by = "no joints" if self.joints is None else f"{int(self.joints.max()) + 1} joints"
        return f"Skinned({self.face_count} faces, {by})"

    @classmethod
    def example(cls) -> Part:
        """A coloured bar of two joints, bent by 60° and widened by a morph target."""
        turn, heights = 2 * np.pi * np.arange(8) / 8, np.linspace(-1.2, 1.2, 9)
        ring = np.stack([0.35 * np.cos(turn), 0 * turn, 0.35 * np.sin(turn)], axis=1)
        rings = ring + heights[:, None, None] * np.array([0, 1, 0])
        ends = np.array([[0, heights[0], 0], [0, heights[-1], 0]])
        vertices = np.concatenate([rings.reshape(-1, 3), ends]).astype(np.float32)
        i, j = (x.reshape(-1) for x in np.meshgrid(np.arange(8), np.arange(8), indexing="ij"))
        a, b = 8 * i + j, 8 * i + (j + 1) % 8
        around = np.arange(8), (np.arange(8) + 1) % 8
        caps = [(np.full(8, 72), *around), (np.full(8, 73), 64 + around[1], 64 + around[0])]
        sides = [(a, a + 8, b), (b, a + 8, b + 8)]
        faces = np.concatenate([np.stack(corners, axis=1) for corners in (*sides, *caps)])
        upper = np.clip(vertices[:, 1] + 0.5, 0, 1)
        c, s = np.cos(np.pi / 3), np.sin(np.pi / 3)
        bent = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        theta = {
            "vertices": vertices,
            "colors": 0.5 + 0.4 * np.sin(2 * vertices + np.array([0, 1, 2])),
            "joint_transforms": np.stack([np.eye(4), bent]),
            "joint_weights": np.stack([1 - upper, upper], axis=1),
            "morph_vertices": (vertices * np.array([1, 0, 0.5]))[None],
            "morph_weights": np.array([0.4]),
        }
        joints = np.tile([0, 1], (len(vertices), 1))
        return Part(cls(faces, joints), {name: x.astype(np.float32) for name, x in theta.items()}, "lambert")

    # ---------------------------------------------------------------------------------------------- checks

    def check(self, theta: Mapping[str, Tree]) -> None:
        """Refuse θ that lacks an entry of `reads`, or has one of wrong shape or dtype."""
        who = "a skinned mesh"
        self.mesh.check({name: x for name, x in theta.items() if name != "normals"})
        if "normals" in theta:
            check_rows(who, theta, "normals", self._normal_count)
        rows = shape_of(theta["vertices"])[0]
        if self.joints is not None and self._normal_rows is None and "normals" in theta:
            normals = shape_of(theta["normals"])[0]
            if normals != rows:
                raise InputError(
                    f"theta['normals'] of {who} has {normals} rows, and there are {rows} vertices; expected one a "
                    "vertex, or indices of normals"
                )

        def check(name: str, *shape: int | str) -> None:
            def expected(x: tuple[int, ...]) -> str | None:
                fits = len(x) == len(shape) and all(isinstance(n, str) or n == m for n, m in zip(shape, x, strict=True))
                return None if fits else f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"

            check_entry(who, theta, name, expected)

        if self.joints is not None:
            if rows != len(self.joints):
                raise InputError(f"theta['vertices'] of {who} has {rows} rows, and its joints {len(self.joints)}")
            check("joint_transforms", "J", 4, 4)
            check("joint_weights", *self.joints.shape)
            count, largest = shape_of(theta["joint_transforms"])[0], int(self.joints.max())
            if count <= largest:
                raise InputError(
                    f"theta['joint_transforms'] of {who} has {count} rows, but a vertex has joint {largest}; joints "
                    "count from 0"
                )
        if self._morphs(theta):
            check("morph_weights", "M")
            targets = shape_of(theta["morph_weights"])[0]
            check("morph_vertices", targets, rows, 3)
            if self._morphs_normals(theta):
                check("morph_normals", targets, shape_of(theta["normals"])[0], 3)

    def _morphs(self, theta: Mapping[str, Tree]) -> bool:
        return any(name in theta for name in MORPHS)

    def _morphs_normals(self, theta: Mapping[str, Tree]) -> bool:
        return self._morphs(theta) and "normals" in theta and "morph_normals" in theta

    def reads(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The entries of θ that `evaluate` needs: those of the mesh, of joints and of morph targets."""
        joints = ("joint_transforms", "joint_weights") if self.joints is not None else ()
        morphs = MORPHS if self._morphs(theta) else ()
        normals = ("morph_normals",) if self._morphs_normals(theta) else ()
        return *self._attributes(theta), *joints, *morphs, *normals

    def _attributes(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The entries of the mesh; tangents would have to turn with joints, and are computed from uv instead."""
        return self.mesh.reads({name: x for name, x in theta.items() if name != "tangents"})

    # ------------------------------------------------------------------------------------------------ pose

    def posed(self, theta: Mapping[str, Tree]) -> Array:
        """The posed vertices (V, 3), differentiable in θ. NumPy arrays beside others are constants."""
        vertices, morphs, weights = self._alike(theta, "vertices", *MORPHS)
        vertices = _morphed(vertices, morphs, weights)
        if self.joints is None:
            return vertices
        maps = self._blended(theta)
        return sum((maps[:, :, i] * vertices[:, i : i + 1] for i in range(3)), maps[:, :, 3])

    def _posed_normals(self, theta: Mapping[str, Tree]) -> Array:
        """Unit normals (A', 3) of the pose: one a vertex, or one for each pair of a normal and a vertex."""
        normals, morphs, weights = self._alike(theta, "normals", "morph_normals", "morph_weights")
        normals = _morphed(normals, morphs, weights)
        maps = None if self.joints is None else self._blended(theta)
        if self._normal_rows is not None:
            own, vertex = constants(self._normal_rows, engine_of(normals), normals)
            xp = namespace(normals)
            normals = take(normals, own)
            if maps is not None:
                maps = xp.reshape(take(xp.reshape(maps, (-1, 12)), vertex), (-1, 3, 4))
        return unit(normals if maps is None else _turned(maps, normals))

    def _blended(self, theta: Mapping[str, Tree]) -> Array:
        """The map (V, 3, 4) of each vertex: the sum of its joints' maps, each with its weight."""
        transforms, weights = self._alike(theta, "joint_transforms", "joint_weights")
        xp = namespace(transforms)
        rows = xp.reshape(transforms[:, :3, :], (-1, 12))
        return xp.reshape(combine(rows, engine_of(rows).constant(self.joints, rows), weights), (-1, 3, 4))

    def _alike(self, theta: Mapping[str, Tree], *names: str) -> list[Array]:
        """Entries of θ in one engine, None for those that it lacks."""
        values = [theta.get(name) for name in names]
        read = {name: theta[name] for name in self.reads(theta)}
        return constants(values, engine_of(read), exemplar(read))

    # -------------------------------------------------------------------------------------------- sampling

    def proxy_inputs(self, theta: Mapping[str, Tree]) -> Array:
        """The posed vertices."""
        return self.posed(theta)

    def proxy(self, inputs: np.ndarray, camera: Any, size: tuple[int, int]) -> Proxy:
        """The mesh of the posed vertices."""
        return self.mesh.proxy(inputs, camera, size)

    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """Interpolated posed positions and attributes; see the class for their names."""
        entries = {name: theta[name] for name in self._attributes(theta) if name != "normals"}
        gbuffer = self.mesh.evaluate({**entries, "vertices": self.posed(theta)}, samples)
        if "normals" in theta:
            gbuffer.defer("normal", lambda: self.mesh.attribute("normals", self._posed_normals(theta), samples))
        return gbuffer


def _morphed(rows: Array, displacements: Array | None, weights: Array | None) -> Array:
    """Rows (A, 3) plus the displacements (M, A, 3) of all morph targets, each with its weight (M,)."""
    if displacements is None or weights is None or not displacements.shape[0]:
        return rows
    xp, engine = namespace(rows), engine_of(rows, displacements, weights)
    flat = xp.reshape(displacements, (displacements.shape[0], -1))
    return rows + xp.reshape(engine.product(weights[None, :], flat), rows.shape)


def _turned(maps: Array, normals: Array) -> Array:
    """Normals (A, 3) under the inverse transposes of maps (A, 3, 4), up to positive factors.

    The cofactors of a matrix are its inverse transpose times its determinant, and are finite where that is zero.
    """
    xp = namespace(maps)
    a, b, c = (maps[:, :, i] for i in range(3))
    cofactors = xp.linalg.cross(b, c), xp.linalg.cross(c, a), xp.linalg.cross(a, b)
    turned = sum(x * normals[:, i : i + 1] for i, x in enumerate(cofactors))
    mirrored = xp.sum(a * cofactors[0], axis=1, keepdims=True) < 0
    return xp.where(mirrored, -turned, turned)
