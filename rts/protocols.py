"""Every record and protocol that crosses a wall between the core and the plugins.

Shapes use these letters: N packed samples, K layers front to back, H × W pixels (row 0 on top), V vertices,
T triangles, I integers and P reals a sample, C channels. Conventions of space are in `rts.camera`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from rts.errors import InputError
from rts.gbuffer import GBuffer
from rts.records import record

Array = Any
"""An array of NumPy, torch or jax."""

Tree = Any
"""Arrays in nested dicts, lists, tuples and records."""

# --------------------------------------------------------------------------------------------- what passes


class ArraySpec(NamedTuple):
    """What a host function returns: the shape and dtype of one array.

    Attributes:
        shape: the shape, or the largest one where `packed`.
        dtype: a NumPy dtype.
        packed: the first axis counts samples and may come back shorter; an engine that needs fixed shapes pads it
            with zeros.
    """

    shape: tuple[int, ...]
    dtype: Any
    packed: bool = False


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

    surface: Surface
    theta: Mapping[str, Tree]
    shader: Shader | str = "silhouette"
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


class Proxy(NamedTuple):
    """Triangles that stand for a surface while it is sampled. Host arrays.

    Attributes:
        vertices: (V, 3) float32, local space.
        faces: (T, 3) int32.
        ids: (T, I) int32, handed on to the samples of the triangle; None means `faces`.
        corner_params: (T, 3, P) float32, interpolated with the barycentrics; None means the barycentrics themselves.
    """

    vertices: np.ndarray
    faces: np.ndarray
    ids: np.ndarray | None = None
    corner_params: np.ndarray | None = None


class Fragments(NamedTuple):
    """What a triangle sampler finds. Host arrays.

    Attributes:
        triangle_ids: (K, H, W) int32 front to back, −1 where a pixel has no such layer.
        barycentrics: (K, H, W, 2) float32, the weights of the triangle's first two corners, perspective-correct.
        depth: (K, H, W) float32, linear distance along the camera's axis; 0 where empty.
    """

    triangle_ids: np.ndarray
    barycentrics: np.ndarray
    depth: np.ndarray


class Rays(NamedTuple):
    """Rays through pixel centres: the point at camera depth z is `origins + z * directions`.

    Attributes:
        origins: (..., 3), on the plane of the camera's centre.
        directions: (..., 3), scaled to advance one unit of depth.
    """

    origins: Array
    directions: Array


class RayHits(NamedTuple):
    """Where R rays meet a surface that intersects them itself, nearest first, K for each.

    Attributes:
        hit: (K, R) bool, whether there is such a hit; those of a ray come first.
        distance: (K, R) the hit is at `origin + distance * direction`; any finite number where there is none.
        params: (K, R, P) what `evaluate` finds in `Samples.params`; finite where there is no hit, too.
        ids: (K, R, I) int32, or None for I = 0.
    """

    hit: Array
    distance: Array
    params: Array
    ids: Array | None = None


@record(static=("asked", "centered"))
class Samples:
    """Where the rays of one part meet its surface: the paper's U, packed.

    Attributes:
        ids: (N, I) int32.
        params: (N, P) float32; θ's own dtype where they were found on the device.
        row: (K, H, W) int32, the sample in each cell, or −1.
        depth: (K, H, W) float32, linear camera depth; 0 where `row` is −1.
        overflow: () int32, samples that did not fit into the capacity and were dropped, deepest layers first.
        tables: further arrays of the surface, filled by its `refine`.
        gbuffer: the evaluated G-buffer where the surface's θ is constant, else None.
        asked: the entries that were asked for when `gbuffer` was evaluated; None for all.
        centered: whether the samples reproject to the centres of their pixels.
    """

    ids: Array
    params: Array
    row: Array
    depth: Array
    overflow: Array
    tables: Mapping[str, Array] = field(default_factory=dict)
    gbuffer: Mapping[str, Array] | None = None
    asked: tuple[str, ...] | None = None
    centered: bool = True


@record(static=("supersample",))
class Sampled:
    """A whole scene, sampled: what `rts.sample` returns and `rts.render_samples` takes.

    The grid has an apron of two cells around the image, so that what lies just outside can splat into it:
    here H and W are the image's, times `supersample`, plus four.

    Attributes:
        samples: one `Samples` a part.
        row: (K, H, W) int32, the sample in each cell, counted over all parts in order, or −1.
        depth: (K, H, W) float32, linear camera depth; 0 where empty.
        overflow: () int32, samples dropped for want of capacity, or beyond the limit of `layers="auto"`. Should be 0.
        supersample: s, where each pixel has s² cells.
    """

    samples: tuple[Samples, ...]
    row: Array
    depth: Array
    overflow: Array
    supersample: int = 1

    @property
    def part(self) -> Array:
        """(K, H, W) int32, the part seen in each cell, or −1."""
        from rts.arrays import namespace

        xp, first = namespace(self.row), 0
        part = xp.astype(self.row >= 0, self.row.dtype) - 1
        for samples in self.samples[:-1]:
            first += samples.ids.shape[-2]
            part = part + xp.astype(self.row >= first, self.row.dtype)
        return part


# ------------------------------------------------------------------------------------------------ protocols


class Surface(Protocol):
    """A kind of surface: holds topology, takes θ.

    Optional members, looked up by name:
        check(theta): raise an InputError if shapes or dtypes are wrong; values may be traced.
        reads(theta) -> tuple of the θ entries that `evaluate` needs; default all of them.
        proxy_key(inputs, camera, size) -> hashable: what besides the bytes of the inputs makes a proxy stale; without
            it the proxy may not depend on camera and size.
        faces: where the surface has this attribute, the sampler "auto" goes by its length.
        centered (bool): whether its samples reproject to pixel centres; default True.
        proxy_is_cheap (bool): making the proxy costs no more than looking whether its inputs have changed.
        refine(inputs, samples, rays) -> Samples: on the host, polish or replace ids and params.
        table_specs(rows) -> dict of ArraySpec: the `Samples.tables` that `refine` fills, for at most `rows` samples.
        example() -> Part: of the class, not of an object: a small part with its shader and θ in NumPy, about the origin
            and within two units of it. `rts plugins --matrix` and tests draw it.
    """

    sample_widths: tuple[int, int]
    """(I, P) of the samples, after `refine`."""

    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """Points of the surface: differentiable, written over the array namespace of θ; local space."""
        ...

    def proxy_inputs(self, theta: Mapping[str, Tree]) -> Tree:
        """The arrays that `proxy` needs; computed on the device, then moved to the host."""
        ...

    def proxy(self, inputs: Tree, camera: Any, size: tuple[int, int]) -> Proxy:
        """Triangles for these inputs, on the host; tessellation may depend on the view."""
        ...


class RaySurface(Protocol):
    """A surface without triangles, for the sampler `rays`. Optional members as of `Surface`, as far as they go."""

    sample_widths: tuple[int, int]
    """(I, P) of the samples."""

    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer:
        """See `Surface.evaluate`."""
        ...

    def intersect(self, theta: Mapping[str, Tree], origins: Array, directions: Array, layers: int) -> RayHits:
        """The `layers` nearest hits of each ray at distances of at least 0; on the device, perhaps traced.

        Args:
            theta: θ without derivatives.
            origins: (R, 3), local space.
            directions: (R, 3), not of unit length; distances are in units of them.
            layers: K.
        """
        ...


class Sampler(Protocol):
    """Finds where rays meet one part; the step without derivative.

    Optional member: `prunes` (bool, default False), whether `sample` also takes `needed`, a function (or None) of
    covered (K, H, W) bool and depth (K, H, W) on the host that says which samples to keep.
    """

    def sample(
        self, part: Part, camera: Any, size: tuple[int, int], layers: int, *, capacity: int | None = None
    ) -> Samples:
        """The `layers` nearest samples of every pixel.

        Args:
            part: the part; its `transform` is already in the camera.
            camera: the camera, in the part's local space.
            size: (height, width).
            layers: K.
            capacity: number of packed rows to allot, or None for as many as there are.
        """
        ...


class Shader(Protocol):
    """Colours samples. Any function with the call signature will do.

    Optional attributes: `opaque` (bool, default False) promises alpha = 1; `reads` (tuple of str) names the
    G-buffer entries it needs besides position, default all of them.
    """

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Any) -> Array:
        """(N, 4) premultiplied linear RGBA from the part's θ and its G-buffer in world space."""
        ...


class Splatter(Protocol):
    """Turns shaded samples into an image that has derivatives at occlusion boundaries.

    Optional members: `needed(covered, depth) -> (K, H, W) bool`, of host arrays (K, H, W) bool and float: the samples
    that can reach the image, in value or derivative, where all are opaque and on pixel centres. Others are dropped.
    `splat` may take a further argument `border`, the number of cells at each side that splat into the image but are no
    part of it: the result is then (H − 2 border, W − 2 border, 4).
    `normal_equations(positions, rgba, row, t_positions, t_rgba, target, weights=None, background=None, border=0)`:
    mean square () of the n residuals weight · (image − target), JᵀJ / n (T, T) and Jᵀr / n (T,) for tangents (T, N, 3)
    of positions and (T, N, 4) or None of rgba; None where the arrays are not of a kind that it knows. The target
    (h, w, C) is alpha (C = 1), colours (3) or both (4); weights are (h, w, 1) or (h, w, C), the background (h, w, 4).
    """

    def splat(self, positions: Array, rgba: Array, row: Array) -> Array:
        """Splat packed samples.

        Args:
            positions: (N, 3) pixel x, pixel y, linear depth.
            rgba: (N, 4) premultiplied.
            row: (K, H, W) int32, the sample of each cell front to back, or −1.

        Returns:
            (H, W, 4) premultiplied RGBA.
        """
        ...


class Residuals(Protocol):
    """What `rts.fit` makes small: any function of parameters will do.

    Optional member: `normal_equations(parameters) -> (mean square (), JᵀJ / n (U, U), Jᵀr / n (U,))` for n residuals r
    and their Jacobian J by the U numbers in the parameters, in the order of `rts.arrays.leaves`; all are arrays of the
    parameters' engine, which may be traced. Levenberg–Marquardt then makes no Jacobian of its own.
    """

    def __call__(self, parameters: Tree) -> Array:
        """Residuals, of any shape."""
        ...


class Engine(Protocol):
    """An array framework. Chosen by the type of the arrays, never a global setting.

    Optional members: `take_error() -> RtsError | None`, the last error raised inside a host call, where the framework
    wraps such errors in its own; `traced(x) -> bool`, whether an array has a shape but not yet a value, and
    with it `on_cpu(f, otherwise, *arrays)`, `f` of traced arrays where they turn out to be on a CPU; and functions
    of `rts.arrays` and `rts.transforms` in full precision but faster, `matmul(a, b)`, `rigid(pose, center)`,
    `affine_map(rows, points)`, `take(rows, index)`, `interpolate(rows, ids, column, weights)` and
    `projective_map(rows, points)`, which may give None for arrays that they do not know. And `fill_unused(x, row)`, for
    engines that allot more rows than are used: x (N, ·) with its first row for those that no cell of `row` names. And
    `uncompiled(f)`, for engines whose compiler looks into Python code: `f`, which it is to call as it is.

    The entry point's name must be the name of the framework's top-level module: an engine is only loaded once the
    user has imported that module.
    """

    name: str
    namespace: Any
    """The array-API namespace of its arrays."""

    def owns(self, x: Any) -> bool:
        """Whether this is an array of the framework, traced ones included."""
        ...

    def constant(self, value: Any, like: Array | None = None) -> Array:
        """An array with no derivative on the device of `like`; floats take the dtype of `like`."""
        ...

    def call_host(self, fn: Callable, specs: tuple[ArraySpec, ...], *args: Array) -> tuple[Array, ...]:
        """Call `fn` on NumPy copies of `args`; the results carry no derivative and live where `args` do."""
        ...

    def stop_gradient(self, x: Array) -> Array:
        """The same values without derivatives."""
        ...

    def segment_sum(self, values: Array, segments: np.ndarray, count: int) -> Array:
        """(count, C) sums of the rows of `values` (M, C) that share a segment (M,)."""
        ...

    def to_numpy(self, x: Array) -> np.ndarray:
        """The value on the host; not for traced arrays."""
        ...

    def block(self, x: Tree) -> Tree:
        """Wait until the arrays are computed."""
        ...

    def value_and_grad(self, f: Callable) -> Callable:
        """`f(tree) -> scalar` to `tree -> (value, gradient tree)`."""
        ...

    def checkpoint(self, make: Callable[[], Tree], f: Callable[[Tree], Array]) -> Array:
        """`f(make())`, done again for its gradient instead of keeping what it went through; `make` has no derivative.

        What `make` gives may be kept where it could not be made again as it was.
        """
        ...

    def jvp(self, f: Callable, primal: Tree, tangent: Tree) -> tuple[Array, Array]:
        """The value of `f` and its derivative along `tangent`."""
        ...

    def jacobian(self, f: Callable) -> Callable:
        """`f(vector) -> arrays` to `vector -> (values, derivatives)`, a row for each unknown, by forward mode."""
        ...

    def jit(self, f: Callable) -> Callable:
        """Compile where the framework can, else return `f`."""
        ...

    def optimizer(self, name: str, learning_rate: float, parameters: Tree) -> Callable[[Tree, Tree], Tree]:
        """A step function `(parameters, gradient) -> parameters` with its own state; "adam" or "sgd"."""
        ...
