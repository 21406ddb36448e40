"""The base classes of surfaces.

Letters of shapes are in `rts.contracts.records`, conventions of space in `rts.scene.camera`.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from rts.arrays.array_functions import from_numbers
from rts.arrays.engines import engine_of, stopped
from rts.arrays.trees import Array, Tree, map_leaves
from rts.contracts.gbuffer import GBuffer
from rts.contracts.records import ArraySpec, Proxy, RayHits, Samples
from rts.errors import InputError
from rts.plugin_base import Plugin
from rts.scene.camera import Camera
from rts.scene.parts import Part
from rts.scene.rays import Rays


class Rate(NamedTuple):
    """Another form of a surface, coarser or finer.

    Attributes:
        setting: the difference, as the keyword argument that a user would give: "tolerance=0.4".
        work: estimated cost relative to the present surface, for ordering.
        surface: the surface.
        theta: function θ → θ for this form, differentiable; None where θ stays.
    """

    setting: str
    work: float
    surface: Surface
    theta: Callable[[Mapping[str, Tree]], Mapping[str, Tree]] | None = None


class Evaluator(Plugin):
    """The step from samples to points of a surface; the paper's S(θ, U)."""

    @abc.abstractmethod
    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """Points of the surface and their attributes, in local space; differentiable in θ.

        Write it over the array namespace of θ (`rts.namespace`), and every engine can run it.

        Args:
            theta: the entries of θ that it reads.
            samples: the points to evaluate, without derivative. Rows that no cell refers to are all zero, and must
                give finite values.

        Returns:
            "position" (N, 3) and further attributes, each (N, C), in θ's dtype.
        """


class Surface(Evaluator):
    """The topology of a surface, such as the triangles of a mesh; immutable. Its numbers, such as vertices, come as θ.

    Subclass `TriangleSurface`, `RaySurface`, or both.

    Attributes:
        sample_widths: (I, P), the number of integers and reals of a sample, after `refine`. Every surface sets it.
        centered: whether samples lie on the rays through cells' centres. If not, splatters receive points of the rays.
        param_step: step in each of the two `params` of a sample, for the finite differences of position and uv that
            choose the level of mipmaps. Set a larger step where position and uv are linear in `params`.
        concurrent: whether several threads may call its methods at once. False for surfaces of a function that a user
            gives: a network may not bear it, such as one by `torch.func.functional_call`, which exchanges its weights.
    """

    sample_widths: tuple[int, int] = (-1, -1)
    centered: bool = True
    concurrent: bool = True
    param_step: float = 2**-8

    def check(self, theta: Mapping[str, Tree]) -> None:
        """Raise an `InputError` of one line if an entry of θ is missing or of a wrong shape; values may be traced.

        The default accepts every θ.
        """

    def reads(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The names of the entries of θ that the surface reads; others are its shader's. The default is all of them."""
        return tuple(theta)

    def rates(self, theta: Mapping[str, Tree]) -> Sequence[Rate]:
        """Coarser and finer forms of the surface; none by default.

        `rts_compare.compare` and `rts.tune` try them. The surface as it is need not be among them.

        Args:
            theta: θ; NumPy arrays are constants, others may be of any engine.
        """
        return ()

    def unbounded(self) -> Surface | None:
        """This surface without bounds on its derivatives; None, the default, for a surface without such bounds.

        `rts.check_gradient` compares with it, to tell if such a bound explains a wrong gradient.
        """
        return None

    @classmethod
    def example(cls) -> Part | None:
        """A small part to try the surface with, or None.

        The part has a shader and NumPy θ, and lies within two units of the origin. `rts plugins --matrix` and tests
        draw it.
        """
        return None

    @classmethod
    def load(cls, path: Path) -> Sequence[Part]:
        """The parts in a file of this surface's own format, for `rts.load(path, surface=…)`.

        Args:
            path: a file that exists.

        Raises:
            InputError: this surface reads no files, or the file is damaged; one line that names the file.
        """
        raise InputError(f"{cls.__name__} reads no files; expected a surface that does, such as 'mesh' or 'bezier'")


class TriangleSurface(Surface):
    """A surface that is sampled by means of triangles.

    Attributes:
        proxy_is_cheap: whether making the triangles costs no more than comparing their inputs with the last ones.
        refine_moves: whether `refine` moves samples or drops them. If it only adds tables or params, hidden samples are
            dropped before `refine` is called.
        face_count: the number of triangles, or None if unknown beforehand; by it the sampler "auto" chooses a sampler.
        refines: whether `refine` is overridden, so that samples on the triangles pass through it; not to be set.
        depends_on_view: whether `proxy_key` is, so that the triangles depend on camera and size; not to be set.
    """

    proxy_is_cheap: bool = False
    refine_moves: bool = True
    face_count: int | None = None

    refines: ClassVar[bool] = False
    depends_on_view: ClassVar[bool] = False

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.refines = cls.refine is not TriangleSurface.refine
        cls.depends_on_view = cls.proxy_key is not TriangleSurface.proxy_key

    @abc.abstractmethod
    def proxy_inputs(self, theta: Mapping[str, Tree]) -> Tree:
        """The arrays that `proxy` and `refine` need; computed on the device, then moved to the host.

        Args:
            theta: θ without derivatives.

        Returns:
            An array, or tree of arrays, of θ's engine.
        """

    @abc.abstractmethod
    def proxy(self, inputs: Tree, camera: Camera, size: tuple[int, int]) -> Proxy:
        """Triangles that stand for the surface while it is sampled, counter-clockwise seen from outside.

        Args:
            inputs: the result of `proxy_inputs`, on the host.
            camera: NumPy float64 matrices; world is the surface's local space.
            size: (height, width) of the grid of cells.
        """

    def proxy_key(self, inputs: Tree, camera: Camera, size: tuple[int, int]) -> Hashable:
        """A value that changes when the view requires other triangles, for the same inputs.

        Override it only if triangles depend on the view; otherwise it is not called. `super().proxy_key` gives each
        view its own triangles.
        """
        return size, *(m.tobytes() for m in camera)

    def refine(self, inputs: Tree, samples: Samples, rays: Rays) -> Samples:
        """Move samples from the triangles onto the surface, along their rays, or drop them; on the host.

        Set `row` of a cell to −1 where its ray misses the surface. Layers need not be in order afterwards, and two may
        hold the same point of the surface: the core sorts and merges them, and closes gaps.

        Args:
            inputs: the result of `proxy_inputs`, on the host.
            samples: samples on the triangles: ids (N, I) and params (N, P), a row for each covered cell, and `row` and
                depth (K, H, W) of the cells. The tables of `table_specs` come as zeros of the largest shape: fill them,
                or replace them by shorter ones. Tables `by_sample` have N rows.
            rays: the ray of each row: origins and directions (N, 3), local space.

        Returns:
            Samples with new ids and params, in the same N rows, new depths, and tables. A sample that finds no room in
            a table is dropped: `row` of its cell becomes −1, and `overflow` counts it.
        """
        return samples

    def refine_outlines(
        self, inputs: Tree, rays: Rays, beside: Rays, depth: np.ndarray, tables: Mapping[str, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Mapping[str, np.ndarray]] | None:
        """Pairs of samples that tell how outlines move, on the host; see `RaySurface.deepest`.

        Called for points just inside of outlines, of surfaces with a `refine` that does not move samples.

        Args:
            inputs: the result of `proxy_inputs`, on the host.
            rays: the rays (R, 3), local space.
            beside: the rays (R, 8, 3) a cell away from each, in eight directions.
            depth: (R,), the depth of each ray's front.
            tables: the tables that `refine` filled. None may be `by_sample`.

        Returns:
            Ids (R, 2, I) and params (R, 2, P) of the pairs, as after `refine`, marks (R,) bool of rays that have a
            pair, and the tables, perhaps with further rows; if tables exceed their specs, no pair is used. None, the
            default, for surfaces without a field.
        """
        return None

    def why_no_triangles(self, inputs: Tree) -> str:
        """The predicate of a warning on a part whose `proxy` has no triangles, beginning with a verb.

        Args:
            inputs: the result of `proxy_inputs`, on the host.
        """
        return "has no triangles"

    def tessellate(self, theta: Mapping[str, Tree], rate: int | float) -> tuple[np.ndarray, np.ndarray]:
        """A mesh whose vertices lie on the surface.

        Args:
            theta: θ; not traced.
            rate: an integer is the number of cuts along each side of a patch. A float is the largest distance of
                triangles from the surface, in the units of θ. A surface that is made of triangles ignores it.

        Returns:
            Vertices (V, 3) float32 and faces (T, 3) int32.

        Raises:
            InputError: the surface cannot become a mesh without a view. This is the default where triangles depend
                on the view; otherwise the default is the result of `proxy`.
        """
        if self.depends_on_view:
            raise InputError(
                f"{self!r} has no tessellate, and its triangles depend on the view; it cannot be made a mesh"
            )
        inputs = self.proxy_inputs(stopped(from_numbers(theta, "theta")))
        inputs = map_leaves(engine_of(inputs).to_numpy, inputs)
        proxy = self.proxy(inputs, None, (1, 1))  # pyright: ignore[reportArgumentType]  # `proxy` reads no camera.
        return np.asarray(proxy.vertices, np.float32), np.asarray(proxy.faces, np.int32)

    def table_specs(self, rows: int, capacity: int | None) -> Mapping[str, ArraySpec]:
        """The `Samples.tables` that `refine` fills.

        Args:
            rows: the largest number of samples that `refine` may be given: every cell of every layer.
            capacity: the number of rows allotted for samples where shapes must be known, as in `jax.jit`. None if
                tables may have any length up to that of their specs, which then set `packed=True`.

        Returns:
            Name → spec; none by default. The core sets the number of rows of tables `by_sample`. Other tables are
            shared by samples, whose `ids` are rows of them, all of one length. Where further samples join the first
            ones, their tables are appended, and their ids are shifted by the rows before.
        """
        return {}


class RaySurface(Surface):
    """A surface that intersects rays itself, for the sampler `rays`.

    Attributes:
        hit_widths: (I, P) of the samples that `intersect` returns; None for `sample_widths`. A surface that has
            triangles too may tell the two kinds of samples apart by their widths.
    """

    hit_widths: tuple[int, int] | None = None

    @abc.abstractmethod
    def intersect(self, theta: Mapping[str, Tree], origins: Array, directions: Array, layers: int) -> RayHits:
        """The `layers` nearest hits of each ray at distances of at least 0; on the device, perhaps traced.

        Args:
            theta: θ without derivatives.
            origins: (R, 3), local space.
            directions: (R, 3), of any length, which is the unit of distances.
            layers: K.
        """

    def deepest(
        self, theta: Mapping[str, Tree], points: Array, directions: Array, reach: Array
    ) -> tuple[Array, Array] | None:
        """Pairs of samples beside the deepest points of rays; they tell splatters how outlines of fields move.

        A ray enters a solid at a point of its surface. The field is least at the deepest point of the chord that begins
        there, and the outline is where this least value is zero. The mean of the two samples' motions is the motion of
        the outline. Two are needed where the field has a kink, one on each side of it; elsewhere they nearly coincide.

        Args:
            theta: θ without derivatives.
            points: (R, 3), points of the surface, local space.
            directions: (R, 3), the rays' directions, of any length.
            reach: (R,), the distance from the ray beyond which an outline is of no interest, local units.

        Returns:
            `Samples.params` (R, 2, P) of the pairs, for surfaces whose hits have no ids, and marks (R,) bool of rays
            that have a pair. None, the default, for surfaces without a field.
        """
        return None
