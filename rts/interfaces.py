"""What plugins implement: a base class for each kind, with every optional member, its default and its contract.

A plugin subclasses its base, or is any object with the required members: such are wrapped (`rts.adapting`).
Shapes use the letters of `rts.records`; conventions of space are in `rts.camera`.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, final

import numpy as np

from rts.errors import EngineError, InputError, RtsError
from rts.gbuffer import GBuffer
from rts.records import Array, ArraySpec, Proxy, RayHits, Rays, Samples, Splats, Tree, record

if TYPE_CHECKING:
    from rts.camera import Camera
    from rts.operations.operation import Operation


class Plugin(abc.ABC):  # noqa: B024
    """What all bases share: class variables that follow from the methods of a class.

    Attributes:
        FLAGS: method → class variable, which is True in a subclass that has such a method of its own, unless it says
            otherwise.
        DECLARES: of a base of plugins in another module than this one: its methods are members of plugins, too.
    """

    FLAGS: ClassVar[Mapping[str, str]] = {}
    DECLARES: ClassVar[bool] = False

    def __init_subclass__(cls, **options: Any) -> None:
        """Set the class variables."""
        super().__init_subclass__(**options)
        for base in cls.__mro__:
            for method, flag in base.__dict__.get("FLAGS", {}).items():
                derived = cls.__mro__[: cls.__mro__.index(base)]
                own = any(method in c.__dict__ for c in derived)
                if own and not any(flag in c.__dict__ for c in derived):
                    setattr(cls, flag, True)


# ----------------------------------------------------------------------------------------------------- surfaces


class Evaluator(Plugin):
    """Evaluates a surface at samples: the step G of the method."""

    @abc.abstractmethod
    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """Points of the surface and their attributes, in local space; differentiable in θ.

        Args:
            theta: the entries that `Surface.reads` names.
            samples: where; constants. Rows that no cell refers to are all zero, and must give finite values.

        Returns:
            "position" (N, 3), and what else there is, each (N, C), in θ's dtype; written over θ's array namespace.
        """


class Surface(Evaluator):
    """A kind of surface: holds topology, takes θ, and is immutable. One of `TriangleSurface`, `RaySurface`, or both.

    Attributes:
        sample_widths: (I, P), how many integers and reals a sample has, after `refine`.
        centered: whether samples lie on the rays through pixel centres.
    """

    sample_widths: tuple[int, int] = (-1, -1)
    centered: bool = True

    def check(self, theta: Mapping[str, Tree]) -> None:
        """Raise an `InputError` of one line where an entry is missing or of a wrong shape; values may be traced."""

    def reads(self, theta: Mapping[str, Tree]) -> tuple[str, ...]:
        """The entries of θ that the surface needs, the others being its shader's. Default all of them."""
        return tuple(theta)

    @classmethod
    def example(cls) -> Part | None:
        """A small part with its shader and NumPy θ, about the origin and within two units of it; None for none.

        `rts plugins --matrix` and tests draw it.
        """
        return None


class TriangleSurface(Surface):
    """A surface that gives triangles to be sampled in its place.

    Attributes:
        proxy_is_cheap: making the triangles costs no more than looking whether their inputs have changed.
        depends_on_view: whether the triangles depend on camera and size; True where there is a `proxy_key`.
        refines: whether samples on the triangles go through `refine`; True where there is one.
        face_count: how many triangles there are, or None where that is not known beforehand; "auto" goes by it.
    """

    FLAGS = {"refine": "refines", "proxy_key": "depends_on_view"}

    proxy_is_cheap: bool = False
    depends_on_view: bool = False
    refines: bool = False
    face_count: int | None = None

    @abc.abstractmethod
    def proxy_inputs(self, theta: Mapping[str, Tree]) -> Tree:
        """The arrays that `proxy` and `refine` need; computed on the device, then moved to the host.

        Args:
            theta: θ without derivatives.
        """

    @abc.abstractmethod
    def proxy(self, inputs: Tree, camera: Camera, size: tuple[int, int]) -> Proxy:
        """Triangles that stand for the surface while it is sampled, counter-clockwise seen from outside.

        Args:
            inputs: what `proxy_inputs` gave, on the host.
            camera: NumPy float64 matrices; world is the surface's local space.
            size: (height, width) of the grid of samples.
        """

    def proxy_key(self, inputs: Tree, camera: Camera, size: tuple[int, int]) -> Hashable:
        """What changes when triangles must be made anew for another reason than their inputs.

        Asked where `depends_on_view`; the default is the view itself.
        """
        return size, *(m.tobytes() for m in camera)

    def refine(self, inputs: Tree, samples: Samples, rays: Rays) -> Samples:
        """Better samples: on the host, move or replace those that were found on the triangles.

        Rows of a cell may become −1 where its ray misses the surface. Layers need not be in order afterwards, and two
        may have met at one root: what is dropped, sorted and merged, the core sees to.

        Args:
            inputs: what `proxy_inputs` gave, on the host.
            samples: ids (N, I), params (N, P) and the depth (K, H, W) of cells, a row for each covered cell. Its tables
                are those of `table_specs`, zeros of the largest shape, to be filled, or replaced by shorter ones; those
                `by_sample` have N rows.
            rays: origins and directions (N, 3), of each row.

        Returns:
            Samples with other ids and params, of N rows, other depths, and tables. What does not fit into a table is to
            be dropped, its rows −1, and added to `overflow`.
        """
        return samples

    def table_specs(self, rows: int, capacity: int | None) -> Mapping[str, ArraySpec]:
        """The `Samples.tables` that `refine` fills.

        Args:
            rows: the largest number of samples that `refine` may be given: every cell of every layer.
            capacity: the number of rows that is allotted for samples where shapes have to be known, as in `jax.jit`;
                None where tables may have any length, and their specs are to be packed. The core sees to the rows of
                tables `by_sample`.
        """
        return {}


class RaySurface(Surface):
    """A surface that intersects rays itself, for the sampler `rays`."""

    @abc.abstractmethod
    def intersect(self, theta: Mapping[str, Tree], origins: Array, directions: Array, layers: int) -> RayHits:
        """The `layers` nearest hits of each ray at distances of at least 0; on the device, perhaps traced.

        Args:
            theta: θ without derivatives.
            origins: (R, 3), local space.
            directions: (R, 3), not of unit length; distances are in units of them.
            layers: K.
        """


# ----------------------------------------------------------------------------------------------------- samplers


class Needed(Plugin):
    """Which samples can reach the image; on the host. Any function of that signature will do."""

    @abc.abstractmethod
    def __call__(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """(K, H, W) bool of covered (K, H, W) bool and depth (K, H, W)."""

    def ran_out(self, cells: int) -> None:
        """Told of how many cells had K layers of triangles, of which fewer were left when they were refined."""


class Sampler(Plugin):
    """Finds where rays meet one part: the step without derivative.

    Attributes:
        prunes: whether `sample` also takes `needed`, a `Needed`, a function or None: which samples to keep.
    """

    prunes: bool = False

    @abc.abstractmethod
    def sample(
        self, part: Part, camera: Camera, size: tuple[int, int], layers: int, *, capacity: int | None = None
    ) -> Samples:
        """The `layers` nearest samples of every pixel.

        Args:
            part: the part; its `transform` is already in the camera.
            camera: the camera, in the part's local space.
            size: (height, width).
            layers: K.
            capacity: number of packed rows to allot, or None for as many as there are.
        """

    def suited(self, part: Part, camera: Camera | None) -> Sampler:
        """The sampler that is to sample a part; another than this one where it only chooses.

        Args:
            part: the part.
            camera: the camera; None where what is built of the part is to be kept.
        """
        return self

    def hold(self, part: Part, camera: Camera | None, size: tuple[int, int] | None) -> Any:
        """What `rts.prepare` is to build once of a part, and hand to `sample` as `entry`; None for nothing."""
        return None


# ------------------------------------------------------------------------------------------ shaders, splatters


class Shader(Plugin):
    """Colours samples. Any function with the signature of `__call__` will do.

    Attributes:
        opaque: a promise that alpha is 1.
        reads: the entries of the G-buffer that it needs besides position; None for all.
    """

    opaque: bool = False
    reads: tuple[str, ...] | None = None

    @abc.abstractmethod
    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera) -> Array:
        """(N, 4) premultiplied linear RGBA from the part's θ and its G-buffer in world space."""


class Splatter(Plugin):
    """Turns shaded samples into an image that has derivatives at occlusion boundaries.

    Attributes:
        reach: how many cells away from its own, along either axis, a sample may have an effect.
        prunes: whether it knows what it needs; True where there is a `needed`.
        sums_products: whether it gives normal equations; True where there is a `normal_equations`.
    """

    FLAGS = {"needed": "prunes", "normal_equations": "sums_products"}

    reach: int = 1
    prunes: bool = False
    sums_products: bool = False

    @abc.abstractmethod
    def image(self, splats: Splats) -> Array:
        """(H, W, 4) premultiplied RGBA of all cells; `border` is left to `cropped`."""

    def cropped(self, splats: Splats) -> Array:
        """The image without the border: (H − 2 border, W − 2 border, 4). To be overridden only to save a copy."""
        from rts.splatting import inside

        return inside(self.image(splats), splats.border)

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
        """
        from rts.splatting import check_splats

        return self.cropped(check_splats(positions, rgba, row, border))

    def needed(self, covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """The samples that can reach the image, in value or derivative, where all are opaque and on pixel centres.

        Others are dropped before they are evaluated. Host arrays.

        Args:
            covered: (K, H, W) bool.
            depth: (K, H, W) float.

        Returns:
            (K, H, W) bool. Default all that are covered.
        """
        return covered

    def normal_equations(
        self,
        splats: Splats,
        t_positions: Array,
        t_rgba: Array | None,
        target: Array,
        weights: Array | None = None,
        background: Array | None = None,
    ) -> tuple[Array, Array, Array] | None:
        """Normal equations of the n residuals weight · (image − target), without their Jacobian.

        Args:
            splats: the samples; the image is without their border, (h, w).
            t_positions: (T, N, 3), tangents of positions along T directions.
            t_rgba: (T, N, 4) of colours; None for zeros.
            target: (h, w, C): alpha (C = 1), colours (3) or both (4).
            weights: (h, w, 1) or (h, w, C).
            background: (h, w, 4), what the image is composited onto.

        Returns:
            Mean square (), JᵀJ / n (T, T) and Jᵀr / n (T,); None for arrays of a kind that it does not know.
        """
        return None


# ------------------------------------------------------------------------------------------------------ fitting


class Residuals(Plugin):
    """What `rts.fit` makes small: any function of parameters will do.

    Attributes:
        sums_products: whether it gives normal equations; True where there is a `normal_equations`.
    """

    FLAGS = {"normal_equations": "sums_products"}
    sums_products: bool = False

    @abc.abstractmethod
    def __call__(self, parameters: Tree) -> Array:
        """Residuals, of any shape."""

    def normal_equations(self, parameters: Tree) -> tuple[Array, Array, Array]:
        """Mean square () of the n residuals r, JᵀJ / n (U, U) and Jᵀr / n (U,) for their Jacobian J.

        U counts the numbers in the parameters, in the order of `rts.arrays.leaves`. All are arrays of the parameters'
        engine, which may be traced. With it, Levenberg–Marquardt makes no Jacobian of its own.
        """
        raise NotImplementedError


# ------------------------------------------------------------------------------------------------------ engines


class Engine(Plugin):
    """An array framework, chosen by the type of the arrays, never a global setting.

    The entry point's name must be the name of the framework's top-level module: an engine is only loaded once the user
    has imported that module.

    Attributes:
        name: of the entry point.
        namespace: the array-API namespace of its arrays.
        differentiates: whether it has derivatives: `value_and_grad`, `jvp`, `jacobian` and `optimizer`.
    """

    name: ClassVar[str]
    namespace: ClassVar[Any]
    differentiates: ClassVar[bool] = True

    @abc.abstractmethod
    def owns(self, x: Any) -> bool:
        """Whether this is an array of the framework, traced ones included."""

    @abc.abstractmethod
    def constant(self, value: Any, like: Array | None = None) -> Array:
        """An array with no derivative on the device of `like`; floats take the dtype of `like`, or are float32."""

    @abc.abstractmethod
    def call_host(self, fn: Callable, specs: Sequence[ArraySpec], *args: Array) -> tuple[Array, ...]:
        """Call `fn` on NumPy copies of `args`; the results carry no derivative and live where `args` do.

        Args:
            fn: host arrays → as many host arrays as there are specs.
            specs: of the results.
            *args: arrays.
        """

    @abc.abstractmethod
    def stop_gradient(self, x: Array) -> Array:
        """The same values without derivatives."""

    @abc.abstractmethod
    def segment_sum(self, values: Array, segments: np.ndarray, count: int) -> Array:
        """(count, C) sums of the rows of `values` (M, C) that share a segment (M,)."""

    @abc.abstractmethod
    def to_numpy(self, x: Array) -> np.ndarray:
        """The value on the host; not for traced arrays."""

    # ----------------------------------------------------------------------------- how arrays are computed with

    def apply(self, operation: Operation, operands: Sequence[Array], params: Mapping[str, Any]) -> Array:
        """The result of an operation; by its compiled functions where the engine can. Default its specification."""
        return operation.specification(*operands, **params)

    def on_host(self, *arrays: Array) -> bool:
        """Whether compiled code for the host may work on these arrays, in place of array code."""
        return False

    def by_host(self, f: Callable, otherwise: Callable, *arrays: Array) -> tuple[Array, ...]:
        """`f` of arrays for which `on_host` holds, `otherwise` of others; the results are alike.

        Engines that trace decide when the compiled program knows its device.
        """
        return f(*arrays) if self.on_host(*arrays) else otherwise(*arrays)

    def exact_products(self, *arrays: Array) -> bool:
        """Whether matrix products of these keep their precision; matrix units of some devices round float32."""
        return False

    def traced(self, x: Array) -> bool:
        """Whether an array has a shape but not yet a value."""
        return False

    def padded(self, x: Array) -> bool:
        """Whether packed arrays like this one may have rows that nobody uses."""
        return False

    def fill_unused(self, x: Array, row: Array) -> Array:
        """Packed x (N, ·) with its first row for those that no cell of `row` (K, H, W) names; asked where `padded`."""
        return x

    def block(self, x: Tree) -> Tree:
        """Wait until the arrays are computed."""
        return x

    def repeat(self, body: Callable[[Tree], Tree], going: Callable[[Tree], Array], state: Tree, most: int) -> Tree:
        """`state = body(state)` as long as `going(state)` () bool holds, at most so many times.

        Without derivatives, and a loop in compiled programs, too, where unrolling takes minutes to compile. What `body`
        closes over has to be without derivatives by itself (`stop_gradient`), as θ is where rays are intersected.

        Args:
            body: tree of arrays → the same tree of other values; shapes and dtypes stay.
            going: tree → () bool, such as whether any is not done.
            state: arrays of this engine.
            most: the largest number of times.
        """
        for _ in range(most):
            if not bool(going(state)):
                break
            state = body(state)
        return state

    # ---------------------------------------------------------------------------------------------- derivatives

    def checkpoint(self, make: Callable[[], Tree], f: Callable[[Tree], Array]) -> Array:
        """`f(make())`, done again for its gradient instead of keeping what it went through; `make` has no derivative.

        What `make` gives may be kept where it could not be made again as it was.
        """
        return f(make())

    def value_and_grad(self, f: Callable) -> Callable:
        """`f(tree) -> scalar` to `tree -> (value, gradient tree)`."""
        raise self._no_derivatives()

    def jvp(self, f: Callable, primal: Tree, tangent: Tree) -> tuple[Array, Array]:
        """The value of `f` and its derivative along `tangent`, differentiable in turn in what `f` closes over."""
        raise self._no_derivatives()

    def jacobian(self, f: Callable) -> Callable:
        """`f(vector) -> arrays` to `vector -> (values, derivatives)`, a row for each unknown, by forward mode."""
        raise self._no_derivatives()

    def optimizer(self, name: str, learning_rate: float, parameters: Tree) -> Callable[[Tree, Tree], Tree]:
        """A step function `(parameters, gradient) -> parameters` with its own state; "adam" or "sgd"."""
        raise self._no_derivatives()

    def _no_derivatives(self) -> EngineError:
        if not self.differentiates:
            return EngineError(
                f"{self.name} arrays have no derivatives; pass arrays of an engine that has, such as torch or jax, for "
                f"what is to be differentiated"
            )
        return EngineError(f"the engine {self.name} lacks this function, though it says that it differentiates")

    # ---------------------------------------------------------------------------------------------- compilation

    def jit(self, f: Callable) -> Callable:
        """Compile where the framework can, else return `f`."""
        return f

    def uncompiled(self, f: Callable) -> Callable:
        """`f`, which what compiles Python code is to call as it is, and not to look into."""
        return f

    def take_error(self) -> RtsError | None:
        """The last error raised inside a host call, once, where the framework wraps such errors in its own."""
        return None


# -------------------------------------------------------------------------------------------------------- parts


@record(static=("surface", "shader", "cull"))
class Part:
    """One object of a scene.

    Attributes:
        surface: the topology, a `Surface`; immutable.
        theta: nested dict of every number of the part: vertices or control points, texture, lights, weights.
        shader: a `Shader`, the name of a registered one, or any function with the same signature.
        transform: (4, 4) world-from-local affine map, differentiable, or None for the identity.
        cull: "none", or "back" to ignore triangles seen from behind. Never inferred.
    """

    surface: Any
    theta: Mapping[str, Tree]
    shader: Shader | Callable[..., Array] | str = "silhouette"
    transform: Array | None = None
    cull: str = "none"

    def __post_init__(self):
        if self.cull not in ("none", "back"):
            raise InputError(f'cull is {self.cull!r}; expected "none" or "back"')
        if not isinstance(self.theta, Mapping):
            raise InputError(f"theta is a {type(self.theta).__name__}; expected a dict of arrays")

    def replace(self, **changes: Any) -> Part:
        """A copy with some fields changed."""
        return replace(self, **changes)
