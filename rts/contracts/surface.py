"""The bases of surfaces.

Letters of shapes are in `rts.contracts.records`, conventions of space in `rts.scene.camera`.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, final

import numpy as np

from rts.arrays.array_functions import from_numbers
from rts.arrays.engines import engine_of, stopped
from rts.arrays.trees import Array, Tree, map_leaves
from rts.contracts.gbuffer import GBuffer
from rts.contracts.records import ArraySpec, Proxy, RayHits, Samples
from rts.errors import InputError
from rts.plugin_base import Plugin, overrides
from rts.scene.camera import Camera
from rts.scene.parts import Part
from rts.scene.rays import Rays


class Rate(NamedTuple):
    """Another form of a surface, coarser or finer.

    Attributes:
        setting: what differs, as the keyword argument that a user would give: "tolerance=0.4".
        work: how much work it is, relative to the surface as it is; roughly, to order them.
        surface: the surface.
        theta: θ → θ for it, differentiable; None where θ stays.
    """

    setting: str
    work: float
    surface: Surface
    theta: Callable[[Mapping[str, Tree]], Mapping[str, Tree]] | None = None


class Surface(Plugin):
    """A kind of surface. It holds topology and is immutable; its numbers come as θ.

    Subclass `TriangleSurface`, `RaySurface`, or both. Several threads may call its methods at once.

    Attributes:
        sample_widths: (I, P), how many integers and reals a sample has, after `refine`. Every surface sets it.
        centered: whether samples lie on the rays through cells' centres. If not, splatters are given them there.
        param_step: by how much the two `params` of a sample are changed to tell how position and uv change with them,
            which mipmaps go by; larger where both are linear in them.
    """

    sample_widths: tuple[int, int] = (-1, -1)
    centered: bool = True
    param_step: float = 2**-8

    @abc.abstractmethod
    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """Points of the surface and their attributes, in local space; differentiable in θ.

        Write it over the array namespace of θ (`rts.namespace`), and every engine can run it.

        Args:
            theta: the entries that `Surface.reads` names.
            samples: where to evaluate; constants. Rows that no cell refers to are all zero, and must give finite
                values.

        Returns:
            "position" (N, 3) and further attributes, each (N, C), in θ's dtype.
        """

    def check(self, theta: Mapping[str, Tree]) -> None:
        """Raise an `InputError` of one line where an entry is missing or of a wrong shape; values may be traced."""

    def reads(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The names of the entries of θ that the surface reads; others are its shader's. The default is all of them."""
        return tuple(theta)

    def rates(self, theta: Mapping[str, Tree]) -> Sequence[Rate]:
        """Coarser and finer forms of the surface, for whoever looks for the cheapest that will do; none by default.

        `rts_compare.compare` and `rts.tune` try them. The surface as it is need not be among them.

        Args:
            theta: θ; NumPy arrays are constants, others may be of any engine.
        """
        return ()

    def unbounded(self) -> Surface | None:
        """This surface without bounds on its derivatives; None where it has none, which is the default.

        `rts.check_gradient` looks at it, to tell whether such a bound is why a gradient is off.
        """
        return None

    @classmethod
    def example(cls) -> Part | None:
        """A small part to try the surface with, or None.

        It has a shader and NumPy θ, and lies about the origin, within two units of it. `rts plugins --matrix` and tests
        draw it.
        """
        return None

    @classmethod
    def load(cls, path: Path) -> Sequence[Part]:
        """The parts of a file of a format that is this kind of surface's own; `rts.load(path, surface=…)` calls it.

        Args:
            path: a file that exists.

        Raises:
            InputError: there is no such format, or the file is damaged; one line that names it.
        """
        raise InputError(f"{cls.__name__} reads no files; expected a surface that does, such as 'mesh' or 'bezier'")


class TriangleSurface(Surface):
    """A surface that gives triangles to be sampled in its place.

    Attributes:
        proxy_is_cheap: whether making the triangles costs no more than looking whether their inputs have changed.
        refine_moves: whether `refine` moves samples or drops them. Where it only adds to what they carry, hidden ones
            are left out before.
        face_count: how many triangles there are, or None if that is not known beforehand; the sampler "auto" goes by
            it.
    """

    proxy_is_cheap: bool = False
    refine_moves: bool = True
    face_count: int | None = None

    @property
    @final
    def refines(self) -> bool:
        """Whether samples on the triangles go through `refine`: it is overridden."""
        return overrides(self, "refine", TriangleSurface)

    @property
    @final
    def depends_on_view(self) -> bool:
        """Whether the triangles depend on camera and size: `proxy_key` is overridden."""
        return overrides(self, "proxy_key", TriangleSurface)

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
            inputs: what `proxy_inputs` gave, on the host.
            camera: NumPy float64 matrices; world is the surface's local space.
            size: (height, width) of the grid of cells.
        """

    def proxy_key(self, inputs: Tree, camera: Camera, size: tuple[int, int]) -> Hashable:
        """A value that changes when triangles must be rebuilt for another reason than their inputs, e.g. the camera.

        Override it only where triangles depend on the view. This one gives the view itself: they are rebuilt for each.
        """
        return size, *(m.tobytes() for m in camera)

    def pieces(self, proxy: Proxy) -> np.ndarray:
        """Which triangles are wound alike, so that what shows its front does not go on in what shows its back.

        Not asked where `refine` moves samples. `rts.plugin_api.checks.pieces` finds them by the edges
        that triangles share.

        Args:
            proxy: what `proxy` gave.

        Returns:
            (T,) int16, for each triangle the number of its piece, from 1 on, or 0 where it may be wound in any way; or
            (1,), the number of all.
        """
        return np.zeros(1, np.int16)

    def refine(self, inputs: Tree, samples: Samples, rays: Rays) -> Samples:
        """Move samples from the triangles onto the surface, along their rays, or drop them; on the host.

        Set `row` of a cell to −1 where its ray misses the surface. Layers need not be in order afterwards, and two may
        have met at one root: the core sorts and merges them, and closes gaps.

        Args:
            inputs: what `proxy_inputs` gave, on the host.
            samples: samples on the triangles: ids (N, I) and params (N, P), a row for each covered cell, and `row` and
                depth (K, H, W) of the cells. The tables are those of `table_specs`, as zeros of the largest shape: fill
                them, or replace them by shorter ones. Tables `by_sample` have N rows.
            rays: the ray of each row: origins and directions (N, 3), local space.

        Returns:
            Samples with new ids and params, in the same N rows, new depths, and tables. A sample that finds no room in
            a table is dropped: `row` of its cell becomes −1, and `overflow` counts it.
        """
        return samples

    def why_no_triangles(self, inputs: Tree) -> str:
        """What a warning says of the part where `proxy` has no triangles, beginning with a verb.

        Args:
            inputs: what `proxy_inputs` gave, on the host.
        """
        return "has no triangles"

    def tessellate(self, theta: Mapping[str, Tree], rate: int | float) -> tuple[np.ndarray, np.ndarray]:
        """A mesh whose vertices lie on the surface.

        Args:
            theta: θ, with values that are known.
            rate: a whole number, of cuts along each side of a patch; or a float, the distance in the units of θ that
                triangles may be off the surface. A surface that is made of triangles ignores it.

        Returns:
            Vertices (V, 3) float32 and faces (T, 3) int32.

        Raises:
            InputError: the surface cannot be made a mesh without a view of it, which is the default where triangles
                depend on the view; else the default is what `proxy` gives.
        """
        if self.depends_on_view:
            raise InputError(
                f"{self!r} has no tessellate, and its triangles depend on the view; it cannot be made a mesh"
            )
        inputs = self.proxy_inputs(stopped(from_numbers(theta, "theta")))
        inputs = map_leaves(engine_of(inputs).to_numpy, inputs)
        proxy = self.proxy(inputs, None, (1, 1))  # pyright: ignore[reportArgumentType]  # It does not look at it.
        return np.asarray(proxy.vertices, np.float32), np.asarray(proxy.faces, np.int32)

    def table_specs(self, rows: int, capacity: int | None) -> Mapping[str, ArraySpec]:
        """The `Samples.tables` that `refine` fills.

        Args:
            rows: the largest number of samples that `refine` may be given: every cell of every layer.
            capacity: the number of rows that is allotted for samples where shapes have to be known, as in `jax.jit`;
                None if tables may have any length up to that of their specs, which then say `packed=True`.

        Returns:
            Name → spec; none by default. The core sets the number of rows of tables `by_sample`.
        """
        return {}


class RaySurface(Surface):
    """A surface that intersects rays itself, for the sampler `rays`.

    Attributes:
        hit_widths: (I, P) of the samples that `intersect` gives; None for `sample_widths`. A surface that has triangles
            too may tell the two kinds of samples apart by their widths.
    """

    hit_widths: tuple[int, int] | None = None

    @abc.abstractmethod
    def intersect(self, theta: Mapping[str, Tree], origins: Array, directions: Array, layers: int) -> RayHits:
        """The `layers` nearest hits of each ray at distances of at least 0; on the device, perhaps traced.

        Args:
            theta: θ without derivatives.
            origins: (R, 3), local space.
            directions: (R, 3), not of unit length; distances are in units of them.
            layers: K.
        """
