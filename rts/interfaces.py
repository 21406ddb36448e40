"""What plugins implement: a base class for each kind, with every optional member, its default and its contract.

A plugin subclasses its base; a plain function is a shader, too. What a class overrides, and which of its promises
hold, is found out by `rts.plugin_base`.
Shapes use the letters of `rts.records`; conventions of space are in `rts.camera`.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, final

import numpy as np

from rts.arguments import quoted
from rts.arrays import from_numbers, shape_of, without_border
from rts.engines import constants, engine_of, exemplar, namespace, stopped
from rts.errors import InputError
from rts.gbuffer import GBuffer
from rts.plugin_base import Plugin, overrides
from rts.records import ArraySpec, Cells, Proxy, RayHits, Rays, Request, Samples, Splats
from rts.trees import Array, Tree, map_leaves

if TYPE_CHECKING:
    from rts.camera import Camera
    from rts.fitting.losses import Loss
    from rts.fitting.schedule import Stage
    from rts.parts import Part


# ------------------------------------------------------------------------------------------------------------ surfaces


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


class Evaluator(Plugin):
    """Evaluates a surface at samples: the step that makes the G-buffer."""

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


class Surface(Evaluator):
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

    def check(self, theta: Mapping[str, Tree]) -> None:
        """Raise an `InputError` of one line where an entry is missing or of a wrong shape; values may be traced."""

    def reads(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The names of the entries of θ that the surface reads; others are its shader's. The default is all of them."""
        return tuple(theta)

    def rates(self, theta: Mapping[str, Tree]) -> Sequence[Rate]:
        """Coarser and finer forms of the surface, for whoever looks for the cheapest that will do; none by default.

        `rts.diagnostics.compare` and `rts.tune` try them. The surface as it is need not be among them.

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

        Not asked where `refine` moves samples. `rts.topology.pieces` finds them by the edges that triangles share.

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


# ------------------------------------------------------------------------------------------------------------ samplers


class Sampler(Plugin):
    """Finds where rays meet one part: the step without derivative.

    Attributes:
        concurrent: whether several threads may call `sample` at once, so that `rts.render_views` takes views at once.
    """

    concurrent: bool = False

    @abc.abstractmethod
    def sample(self, part: Part, camera: Camera, size: tuple[int, int], layers: int, request: Request) -> Samples:
        """The `layers` nearest samples of every pixel.

        Args:
            part: the part; its `transform` is already in the camera. A sampler that cannot leave out what is seen from
                behind refuses parts with `cull="back"`.
            camera: the camera, in the part's local space.
            size: (height, width) of the grid of cells.
            layers: K.
            request: the number of rows to allot, and what may be found, or left out, besides.

        Returns:
            Samples, without derivative, in arrays of the engine of the part and the camera. Which of their fields are
            there depends on the sampler, the part and the request, never on values.

        Raises:
            InputError: this sampler cannot sample the surface.
        """

    def suited(self, part: Part, camera: Camera | None) -> Sampler:
        """The sampler that is to sample a part: this one or, if this one only chooses, as "auto" does, another.

        Args:
            part: the part.
            camera: the camera; None in `rts.prepare`, which keeps what is built.
        """
        return self

    def hold(self, part: Part, camera: Camera | None, size: tuple[int, int] | None) -> Any:
        """What `rts.prepare` is to build once of a part, and hand to `sample` as `Request.entry`; None for nothing."""
        return None


# -------------------------------------------------------------------------------------------------- shaders, splatters


class Shader(Plugin):
    """Colours samples. Any function with the signature of `__call__` will do; its attributes are those of a shader.

    Promises but for `opaque` are of a class and its `__call__`: a subclass with its own has to say so itself.

    Attributes:
        channels: C, how many numbers it gives besides alpha: 3 for colours, any other number for features.
        opaque: a promise that alpha is 1.
        uniform: a promise that all samples of a part have one colour, through whatever camera. It may depend on θ.
        takes_views: a promise that a call may be of samples of several views, as `rts.render_views` then makes it:
            `camera` is a `RowCameras`, whose methods give a row for each sample. A shader that says so also says
            what it `reads`, without "uv_footprint".
        reads: a promise that it needs no entries but these, of the G-buffer besides position and of θ; None for all.
            Samples then carry no others. `rts.explain` lists entries of θ that nobody reads, and what is almost one of
            these is warned of.
    """

    channels: int = 3
    opaque: bool = False
    uniform: bool = False
    takes_views: bool = False
    reads: tuple[str, ...] | None = None

    @abc.abstractmethod
    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera) -> Array:
        """The colours of N samples, each from its own sample alone: N may be all, or some thousands at a time.

        Args:
            theta: θ of the part.
            gbuffer: its G-buffer, in world space.
            camera: the camera of the whole image; for a shader that `takes_views` it may be a `RowCameras`.

        Returns:
            (N, 4) premultiplied linear RGBA, in [0, 1]; (N, C + 1), alpha last, of a shader with other `channels`, all
            of them multiplied by alpha and otherwise of any value.

        Raises:
            InputError: an entry that the shader needs is missing.
        """


class FunctionShader(Shader):
    """A function as a shader, with the attributes of a shader that it has."""

    def __init__(self, function: Callable[..., Array]):
        self.function = function
        for name in ("channels", "opaque", "uniform", "takes_views", "reads"):
            setattr(self, name, getattr(function, name, getattr(Shader, name)))

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera) -> Array:
        """See `Shader`."""
        return self.function(theta, gbuffer, camera)

    def __repr__(self) -> str:
        return quoted(self.function)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FunctionShader) and self.function == other.function

    def __hash__(self) -> int:
        return hash(self.function)


class Splatter(Plugin):
    """Turns shaded samples into an image that has derivatives at occlusion boundaries.

    Attributes:
        layers: how many layers it looks at, from the front; None for all that there are.
        reach: how many cells away from its own, along either axis, a sample may have an effect.
        reads: which of "facing" and "exit" of `Cells` it reads; these are found only then.
        fills_interiors: a promise on samples of one opaque colour, on cells' centres. A cell shows this colour where
            all nine samples around it are fronts and no hidden one beside them is `needed`, and nothing where none of
            the nine is there, whatever moves by little. A cell that is `settled` shows the colour of that sample,
            whatever samples there are; so those farther than `reach` from all other cells need not be there, or where
            `Splats.wanted` is told, those farther than one cell more from the others of them.
    """

    layers: int | None = None
    reach: int = 1
    reads: frozenset[str] = frozenset()
    fills_interiors: bool = False

    @abc.abstractmethod
    def image(self, splats: Splats) -> Array:
        """The image of all cells, those of the border included: (H, W, 4) premultiplied RGBA."""

    def cropped(self, splats: Splats) -> Array:
        """The image without the border: (H − 2 border, W − 2 border, 4). Override it only to save a copy."""
        return without_border(self.image(splats), splats.border)

    @final
    def splat(self, positions: Array, rgba: Array, row: Array, border: int = 0) -> Array:
        """Splat packed samples; for direct calls, with arrays of any engine, lists and numbers.

        Args:
            positions: (N, 3) pixel x, pixel y, linear depth.
            rgba: (N, 4) premultiplied.
            row: (K, H, W) int32, the sample of each cell front to back, or −1.
            border: cells at each side that splat into the image but are no part of it.

        Returns:
            (H − 2 border, W − 2 border, 4) premultiplied RGBA.

        Raises:
            InputError: wrong shapes, or `row` holds no integers.
            EngineError: arrays of two engines.
        """
        return self.cropped(_checked_splats(positions, rgba, row, border))

    def needed(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """The samples that can reach the image, in value or derivative, where all are opaque and on pixel centres.

        Others are dropped before they are evaluated, in a class that overrides it. Host arrays.

        Args:
            covered: (K, H, W) bool.
            depth: (K, H, W) float.

        Returns:
            (K, H, W) bool; by default all that are covered.
        """
        return covered


class SummingSplatter(Splatter):
    """A splatter that can sum up the normal equations of an image without the Jacobian of it."""

    @abc.abstractmethod
    def normal_equations(
        self,
        splats: Splats,
        t_positions: Array,
        t_rgba: Array | None,
        target: Array,
        weights: Array | None = None,
        background: Array | None = None,
        loss: Loss | None = None,
    ) -> tuple[Array, Array, Array] | None:
        """Normal equations of the n residuals weight · (image − target), without their Jacobian.

        Args:
            splats: the samples; without their border there are s h × s w cells, and a pixel is the mean of s × s.
            t_positions: (T, N, 3), tangents of positions along T directions.
            t_rgba: (T, N, 4), tangents of colours; None for zeros.
            target: (h, w, C): alpha (C = 1), colours (3) or both (4).
            weights: (h, w, 1) or (h, w, C); None for ones.
            background: (h, w, 4), what the image is composited onto, or None.
            loss: of the residuals; None for the square.

        Returns:
            Mean loss (), JᵀSJ / n (T, T) and JᵀWr / n (T,), where W and S are diagonals of `loss.weights(r)`, ones for
            the square; None where it cannot work on these arrays.
        """


def _checked_splats(positions: Any, rgba: Any, row: Any, border: int = 0) -> Splats:
    """Splats of arrays, or of lists, all of one engine; wrong shapes and dtypes are refused."""
    given = from_numbers(positions, "positions"), from_numbers(rgba, "rgba")
    row = np.asarray(from_numbers(row, "row"), np.int32) if isinstance(row, (list, tuple)) else from_numbers(row, "row")
    shapes = [shape_of(x) for x in (*given, row)]
    ok = len(shapes[0]) == 2 and shapes[0][1] == 3 and shapes[1] == (shapes[0][0], 4) and len(shapes[2]) == 3
    if not ok or shapes[2][0] < 1:
        raise InputError(
            f"positions, rgba and row have shapes {shapes[0]}, {shapes[1]}, {shapes[2]}; "
            f"expected (N, 3), (N, 4), (K, H, W)"
        )
    if not namespace(row).isdtype(row.dtype, "signed integer"):
        raise InputError(f"row has dtype {row.dtype}; expected signed integers, -1 where a cell is empty")
    positions, rgba, row = constants((*given, row), engine_of(given, row), exemplar(given))
    return Splats(positions, rgba, Cells(row), border=border)


# ------------------------------------------------------------------------------------------------------------- fitting


class Residuals(Plugin):
    """Function of parameters that `rts.fit` makes small. A plain function will do, which has none of the other methods.

    Attributes:
        loss: what their mean is taken of, an `rts.Loss`; None for the square. What `at_stage` gives has its own, or
            where that is None this one.
    """

    loss: Loss | None = None

    @abc.abstractmethod
    def __call__(self, parameters: Tree) -> Array:
        """Residuals, of any shape."""

    def at_stage(self, stage: Stage) -> Callable[[Tree], Array]:
        """The residuals at another resolution, for `rts.fit` with a schedule."""
        raise NotImplementedError

    def normal_equations(self, parameters: Tree) -> tuple[Array, Array, Array]:
        """Mean loss () of the n residuals r, JᵀSJ / n (U, U) and JᵀWr / n (U,) for their Jacobian J.

        W and S are diagonals of `self.loss.weights(r)`, ones for the mean square.
        U counts the numbers in the parameters, in the order of `rts.trees.leaves`. All are arrays of the parameters'
        engine, which may be traced. With it, Levenberg–Marquardt makes no Jacobian of its own.
        """
        raise NotImplementedError
