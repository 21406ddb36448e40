# Names of `rts` for type checkers and editors. Classes and functions of other packages, which the core does not import,
# are declared here: `python tests/stub.py` copies their signatures and docstrings from the code, and a test compares.
"""rts: differentiable surface rendering by rasterize-then-splat.

With any ordinary renderer, find where camera rays meet a surface; evaluate it there, shade it and splat it;
differentiate only that.

Names that only plugins need are in `rts.plugin_api`, the kinds of warnings in `rts.errors`, types of results in
`rts.results`, shadows in `rts.shadows`.

The built-in surfaces are attributes of `rts`, imported on first use: `rts.Mesh`, `rts.Bezier`, `rts.BSpline`,
`rts.Revolution`, `rts.Subdivision`, `rts.Isosurface`, `rts.Sdf` and `rts.Skinned`. So are `rts.tune`, of the package
`rts_compare`, `rts.check_gradient` and `rts.gradient_image`, of `rts_diagnostics`, `rts.NarrowBand`, `rts.Ndc` and
`rts.load_radiance_field`.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from rts import errors as errors
from rts import registry as registry
from rts import regularizers as regularizers
from rts import results as results
from rts import shadows as shadows
from rts.arrays.engine_base import Engine
from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Array, Tree
from rts.compiling.warmup import warmup
from rts.contracts.gbuffer import GBuffer
from rts.contracts.records import Proxy, RayHits, Samples
from rts.contracts.residuals import Residuals
from rts.contracts.sampler import Sampler
from rts.contracts.shader import Shader
from rts.contracts.splatter import Splatter
from rts.contracts.surface import Evaluator, RaySurface, Surface, TriangleSurface
from rts.diagnostics.explain import explain
from rts.diagnostics.notebooks import show
from rts.diagnostics.profile import profile
from rts.errors import InputError, RtsError
from rts.files.images import load_image, save_animation, save_image
from rts.files.models import load
from rts.files.moving_models import load_model as load_model
from rts.files.views.loading import load_views
from rts.files.views.saving import save_views
from rts.fitting.fit import fit
from rts.fitting.image_residuals import ImageResiduals
from rts.fitting.large_steps import LargeSteps
from rts.fitting.losses import Loss
from rts.fitting.schedule import Stage, pyramid
from rts.fitting.view_residuals import ViewResiduals
from rts.registry import plugin, plugins
from rts.rendering.arguments import Adaptive as Adaptive
from rts.rendering.image import render, render_samples
from rts.rendering.program import program
from rts.rendering.renderer import prepare
from rts.rendering.samples import sample
from rts.sampling.triangle_sampler import TriangleSampler
from rts.scene.camera import Camera
from rts.scene.parts import Part
from rts.scene.rigid import rigid
from rts.scene.view import View
from rts.views.render_views import render_views
from rts_diagnostics.gradient_images import gradient_image
from rts_diagnostics.gradients import check_gradient

__version__: str
__all__ = [
    "Camera",
    "Engine",
    "Evaluator",
    "GBuffer",
    "ImageResiduals",
    "InputError",
    "LargeSteps",
    "Loss",
    "Part",
    "RaySurface",
    "Residuals",
    "RtsError",
    "Sampler",
    "Shader",
    "Splatter",
    "Stage",
    "Surface",
    "TriangleSampler",
    "TriangleSurface",
    "View",
    "ViewResiduals",
    "check_gradient",
    "engine_of",
    "explain",
    "fit",
    "gradient_image",
    "load",
    "load_image",
    "load_radiance_field",
    "load_views",
    "namespace",
    "plugin",
    "plugins",
    "prepare",
    "profile",
    "program",
    "pyramid",
    "render",
    "render_samples",
    "render_views",
    "rigid",
    "sample",
    "save_animation",
    "save_image",
    "save_views",
    "show",
    "tune",
    "warmup",
]

class _BuiltIn(Surface):
    def evaluate(self, theta: Mapping[str, Tree], samples: Samples) -> GBuffer: ...
    @classmethod
    def example(cls) -> Part: ...

class _BuiltInTriangles(_BuiltIn, TriangleSurface):
    def proxy_inputs(self, theta: Mapping[str, Tree]) -> Tree: ...
    def proxy(self, inputs: Any, camera: Any, size: tuple[int, int]) -> Proxy: ...

class _BuiltInRays(_BuiltIn, RaySurface):
    def intersect(self, theta: Mapping[str, Tree], origins: Array, directions: Array, layers: int) -> RayHits: ...

class Mesh(_BuiltInTriangles):
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

    faces: np.ndarray

    def __init__(self, faces: ArrayLike, indices: Mapping[str, ArrayLike | None] | None = None) -> None: ...
    def vertex_normals(self, vertices: Array) -> Array:
        """Unit normals (V, 3): directions of the area-weighted sums over the faces around each vertex, or zero.

        They are zero where there is no area around a vertex, or where its faces nearly cancel, as both sides of a
        double face do; samples have the normals of their own triangles there. Those of NumPy vertices are kept until
        the vertices change.
        """
        ...

class Skinned(_BuiltInTriangles):
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

    mesh: Mesh
    joints: np.ndarray | None

    def __init__(
        self, faces: ArrayLike, joints: ArrayLike | None = None, indices: Mapping[str, ArrayLike | None] | None = None
    ) -> None: ...
    def posed(self, theta: Mapping[str, Tree]) -> Array:
        """The posed vertices (V, 3), differentiable in θ. NumPy arrays beside others are constants."""
        ...

class Bezier(_BuiltInTriangles):
    """Bicubic Bézier patches on control points that they may share.

    θ["points"] (m, 3) are the control points. "colors" (m, 1, 3 or 4) and "uv" (m, 2) are attributes of control points,
    interpolated as they are. The normal is the cross product of the derivatives along u and v, in this order: it points
    outside where u, v and the outward normal are right-handed.

    Args:
        indices: (n, 16) integers into θ["points"]: the 4 × 4 points of each patch, first along u, then along v.
        tolerance: the largest distance of triangles from the surface near outlines, pixels.

    Raises:
        InputError: indices of another shape, or a tolerance that is not positive.
    """

    tolerance: float

    def __init__(self, indices: ArrayLike, tolerance: float = 0.1) -> None: ...

class BSpline(_BuiltInTriangles):
    """A uniform bicubic B-spline surface.

    θ["points"] (nu, nv, 3) are the control points. "colors" (nu, nv, 1, 3 or 4) and "uv" (nu, nv, 2) are attributes of
    control points, interpolated as they are. The normal is the cross product of the derivatives along u and v, in this
    order.

    Args:
        shape: (nu, nv), the numbers of control points, at least 4 in each direction.
        ends: "open", "clamped" or "periodic", or a pair of these for u and v. An open spline ends between its control
            points, a clamped one at its first and last, and a periodic one is closed.
        tolerance: the largest distance of triangles from the surface near outlines, pixels.

    Raises:
        InputError: fewer than 4 control points, other ends, or a tolerance that is not positive.
    """

    shape: tuple[int, int]
    ends: tuple[str, str]
    tolerance: float

    def __init__(
        self, shape: tuple[int, int], ends: str | tuple[str, str] = "clamped", tolerance: float = 0.1
    ) -> None: ...

class Revolution(BSpline):
    """A profile curve swept around the y axis: a periodic B-spline, which is very nearly a surface of revolution.

    θ["radii"] (n,) are the distances of the profile's control points from the axis. In planes through the axis and
    control points the surface is the B-spline of radii and heights; between these planes it is nearer to the axis, by
    0.12 % with 8 points around, by 0.007 % with 16. "colors" (n, count, 1, 3 or 4) and "uv" (n, count, 2) are
    attributes of control points. Normals point away from the axis where heights grow.

    Args:
        heights: (n,) numbers, the y of the profile's control points, at least 4.
        count: the number of control points around the axis, at least 4.
        ends: "clamped" or "open" for the ends of the profile.
        tolerance: the largest distance of triangles from the surface near outlines, pixels.

    Raises:
        InputError: fewer than 4 control points, other ends, or a tolerance that is not positive.
    """

    def __init__(self, heights: ArrayLike, count: int = 8, ends: str = "clamped", tolerance: float = 0.1) -> None: ...

class Subdivision(_BuiltInTriangles):
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

    tolerance: float

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
        tolerance: float = 0.1,
    ) -> None: ...

@dataclass(frozen=True)
class NarrowBand:
    """A search for the cells of a lattice that a surface passes through.

    With a Lipschitz bound these are all cells whose corners differ in sign. A block of cells is dropped if the level at
    its centre is further from zero than it can change within the block; other blocks are halved.

    Without one, the search halves coarse cells whose corners differ in sign, with a margin around them. Of the halves,
    only those whose corners differ in sign are halved again. At every fineness the surface is then followed across the
    sides of cells that it crosses. So each coarse cell whose corners differ in sign has cells in the band, and the band
    has no holes: if the four corners shared with a neighbour differ in sign, the neighbour is in it, too. A separate
    part of the surface between coarse corners of one sign is found only in the margin, and only if it shows at corners
    of halved cells.

    Isosurfaces also need levels one cell further inside, where rays that graze the surface are deepest.

    Args:
        lipschitz: the fastest change of the level, per unit of length; None if unknown.
        coarse: cells along each side of the first blocks, a power of two; None for 16 with a Lipschitz bound and 8
            without one.
        margin: width, in coarse cells, of this margin. It has no effect with a Lipschitz bound.
        chunk: the largest number of points at which the level is evaluated together.

    Raises:
        InputError: an argument is of the wrong kind.
    """

    lipschitz: float | None = None
    coarse: int | None = None
    margin: int = 1
    chunk: int = 262144

class _Extracted(NamedTuple):
    vertices: np.ndarray
    faces: np.ndarray
    near_singular: int
    evaluations: int

class Isosurface(_BuiltInTriangles, _BuiltInRays):
    """The isosurface of a field: θ["values"] (X, Y, Z) at the points of a lattice, or a function of θ and points.

    A sample's ids are the numbers of six lattice points, the ends of three edges; point (x, y, z) has the number
    (x Y + y) Z + z. The first three of its parameters are the barycentrics in the triangle between these edges.
    The field at these six points alone moves the sample. Values equal to the isovalue are outside.

    Samplers of triangles see the triangles of marching cubes; the sampler "rays" meets the field itself, for given
    values interpolated along each axis.

    Args:
        bounds: two corners ((x0, y0, z0), (x1, y1, z1)) of the lattice, the lower one first.
        isovalue: the value of the field on the surface.
        f: (θ, points (M, 3)) → (M,), in array code or for one engine; None for θ["values"].
        shape: (X, Y, Z), lattice points along each axis. Needed with `f`; else None, or the shape of the values.
        motion: how samples move with the field. "normal": along its gradient, by its change there. "edge": their
            triangle's corners slide along the edges of the lattice, as in the paper.
        inside: which values are inside: "below" or "above" the isovalue.
        at_bounds: "capped": where the inside reaches the bounds, it is closed there; or "open".
        near_singular: the rule for edges whose ends have nearly equal values, so that a corner on them would move
            without bound. "bound": derivatives are bounded. "drop": their triangles are dropped, as in the paper.
            "keep": derivatives stay as they are.
        table: True for a costly `f`: it is evaluated once for each lattice point, not once for each sample at the
            point. A number allots room for so many points where shapes must be known, as in `jax.jit`; True allots
            twice as many as samples.
        band: a `NarrowBand`, to evaluate `f` near the surface only; θ must not be traced, then. Where pixels are wider
            than cells, fewer outlines move as exactly as on the whole lattice. None for the whole lattice.
        lipschitz: the most that `f` changes over a unit of length, for the sampler "rays"; None if unknown.
        reads: the entries of θ that `f` reads; None for all.
        attributes: name → function (θ, positions (N, 3)) → (N, C), further entries of the G-buffer.

    Raises:
        InputError: an argument is wrong.
    """

    def __init__(
        self,
        bounds: ArrayLike,
        isovalue: float = 0.0,
        f: Callable[[Any, Array], Array] | None = None,
        shape: Sequence[int] | None = None,
        *,
        motion: str = "normal",
        inside: str = "below",
        at_bounds: str = "capped",
        near_singular: str = "bound",
        table: bool | int = False,
        band: NarrowBand | None = None,
        lipschitz: float | None = None,
        reads: Sequence[str] | None = None,
        attributes: Mapping[str, Callable[[Any, Array], Array]] | None = None,
    ) -> None: ...
    def extract(self, theta: Mapping[str, Tree]) -> _Extracted:
        """The triangles of marching cubes, dropped ones included, and their cost.

        Args:
            theta: θ, not traced.

        Raises:
            InputError: the field is NaN or infinite somewhere.
        """
        ...

_Function = Callable[[Mapping[str, Tree], Array], Array]

class Sdf(_BuiltInRays):
    """The surface of a field within a ball, found by rays: of a signed distance, or of any other function of space.

    A sample is the point x₀ where a ray meets the surface, and it moves along the surface's normal as θ changes: its
    position is x₀ − f(θ, x₀) w, with f the field and w = ∇f / |∇f|² at x₀. If it moved along the ray, it would never
    leave its pixel, and outlines would have no derivative.

    The ball cuts off parts of the surface outside of it; it should enclose the surface tightly.

    Args:
        f: (θ, points (M, 3)) → (M,), in array code; see `Field`. `rts_surfaces.implicit.fields` has ready-made ones.
        radius: the radius of the ball, in the units of the points.
        center: (3,), the centre of the ball.
        isovalue: the value of `f` on the surface.
        inside: which values are inside, "below" the isovalue or "above" it.
        lipschitz: a number that the slope of `f` nowhere exceeds, 1 for distances. If it is too small, rays miss parts
            of the surface. None if unknown: rays then take steps of one length, and cost more.
        reads: the names of the entries of θ that `f` reads; None for all.
        attributes: name → g(θ, positions (N, 3)) → (N, C), further entries of the G-buffer; see `Implicit`.
        steps: the number of shortest steps across the ball: parts thinner than one step may be missed, so that sharp
            edges are cut off by some hundredths of a pixel (0.05 at 256², with bounds). More steps cost little; twice
            as many halve it. None for 256 without `lipschitz`, 1024 with it.

    Raises:
        InputError: wrong arguments.
    """

    def __init__(
        self,
        f: _Function,
        radius: float = 2.0,
        center: ArrayLike = (0.0, 0.0, 0.0),
        isovalue: float = 0.0,
        inside: str = "below",
        *,
        lipschitz: float | None = 1.0,
        reads: Sequence[str] | None = None,
        attributes: Mapping[str, _Function] | None = None,
        steps: int | None = None,
    ) -> None: ...

@dataclass(frozen=True)
class Ndc:
    """The map between the world and NDC; NumPy, torch and jax, differentiable.

    Attributes:
        scale: (x, y), focal length over half the width and half the height of the image.
        near: depth of the near plane, 1 in the frame of NeRF's forward-facing data sets
            (`rts.load_views(frame="nerf")`).

    Raises:
        InputError: a number is not positive.
    """

    scale: tuple[float, float]
    near: float = 1.0

    @classmethod
    def of_images(cls, size: tuple[int, int], focal: float, near: float = 1.0) -> Ndc:
        """NDC of images of a size (height, width) in pixels, with a focal length in pixels.

        Raises:
            InputError: an argument is not positive, or the size is not two integers.
        """
        ...

    def from_world(self, points: Array) -> Array:
        """NDC (N, 3) of world points (N, 3); depths less than `NEAREST` near planes count as that."""
        ...

    def to_world(self, points: Array) -> Array:
        """World points (N, 3) of NDC (N, 3); depths of more than `FARTHEST` near planes, and z ≥ 1, count as that."""
        ...

    def rays(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Rays in NDC of world rays: t = 0 at the near plane, t = 1 at infinity.

        Args:
            origins: (N, 3) world, on either side of the near plane.
            directions: (N, 3) world, towards −z, of any length.

        Returns:
            Origins and directions, (N, 3) each; equal steps of t are equal steps of disparity.

        Raises:
            InputError: arrays that are not (N, 3), or of different shapes.
        """
        ...

class _Architecture(NamedTuple):
    position_levels: int
    direction_levels: int
    width: int
    layers: int
    parameters: int

class _VolumeImage(NamedTuple):
    image: np.ndarray
    coarse: int
    fine: int

class _RadianceField:
    weights: Any

    def volume_render(
        self,
        camera: Camera,
        size: tuple[int, int],
        *,
        near: float | None = None,
        far: float | None = None,
        samples: tuple[int, int] = (64, 64),
        background: Literal["white", "black"] | Sequence[float] | np.ndarray | None = "white",
        ndc: Ndc | None = None,
        progress: bool | None = None,
    ) -> _VolumeImage:
        """The image of the field by quadrature along rays, without noise and derivatives, as in NeRF's test mode.

        The coarse network is evaluated at N_c equal steps of depth (of disparity with `ndc`). Its samples' weights are
        a distribution along the ray, by whose inverse N_f more samples are placed. The fine network is evaluated at all
        N_c + N_f samples (Mildenhall et al. 2020, §4 and 5). Surface light fields are compared with this image.
        Computed by torch if installed, else by NumPy.

        Args:
            camera: a perspective camera; rays pass through the centres of its pixels (for rays as NeRF's, take cameras
                of `load_views` with `pixel_center`).
            size: (height, width) in pixels.
            near: depth at which rays begin; default 2, as in NeRF's Blender data sets; with `ndc`, always its near
                plane.
            far: depth at which rays end; default 6; with `ndc`, always infinity.
            samples: (N_c, N_f), at least 3 and 1.
            background: the colour behind the field: "white", "black" or (3,) from 0 to 1; None for transparency.
            ndc: the map from the world to the field's space; None if the field's space is the world.
            progress: True to show a progress bar, None to do so in a terminal, False for none.

        Returns:
            A named tuple: `image` (H, W, 3) float32 on the background, or (H, W, 4) premultiplied RGBA, in the encoding
            of the images that the field was trained on; `coarse` and `fine`, the evaluations of each network.

        Raises:
            InputError: an argument is wrong, or the camera is orthographic.
        """
        ...

    def architecture(self, network: str = "fine") -> _Architecture:
        """The architecture of the network "coarse" or "fine"."""
        ...

    def save(self, path: Any) -> None:
        """Write the weights as an .npz that `rts.load_radiance_field` reads, in their dtypes.

        Raises:
            InputError: another extension, or a path that cannot be or may not be written to.
        """
        ...

    def lattice(
        self,
        bounds: Any,
        shape: tuple[int, int, int],
        *,
        network: str = "fine",
        keep: Any = True,
        progress: bool | None = None,
    ) -> np.ndarray:
        """Densities on a lattice, (X, Y, Z) float32; see `rts_surfaces.radiance_field.lattice`.

        Args:
            bounds: ((x0, y0, z0), (x1, y1, z1)) in the field's space, the first and the last point of the lattice.
            shape: (X, Y, Z), at least 2 each.
            network: "fine" or "coarse".
            keep: True to keep densities in the user's cache and to look for them there; a folder in place of the cache;
                False for neither.
            progress: True to show a progress bar; None to do so in a terminal.

        Raises:
            InputError: there is no such lattice or network.
        """
        ...

    def on_host(self) -> Tree:
        """The weights of both networks, nested as `weights` is, as NumPy arrays without derivatives."""
        ...

def load_radiance_field(path: str | os.PathLike[str]) -> _RadianceField:
    """The radiance field (Mildenhall et al. 2020) whose weights an .npz holds.

    Its arrays are called as krrish94/nerf-pytorch calls its layers, after the name of the network: coarse.layer1.weight
    (out, in), coarse.layer1.bias (out,), coarse.layers_xyz.0.weight, …, coarse.fc_alpha.weight, coarse.fc_feat.weight,
    coarse.layers_dir.0.weight, coarse.fc_rgb.weight, and so on for fine. Nothing is unpickled.

    To draw the field as a surface light field, take a part with the shader "radiance" and one of its networks as
    θ["weights"]. Its surface may be the isosurface of the density, `lattice`, at the value 50.

    Returns:
        An object with `weights`, {"coarse": network, "fine": network} of float32 NumPy arrays; `architecture(network)`;
        `lattice(bounds, shape)`, its density at points; `volume_render(camera, size)`; and `save(path)`.

    Raises:
        InputError: there is no such file, it is no .npz, holds pickles, or other than finite floating-point numbers; a
            layer is missing, unknown, or its shape does not fit.
    """
    ...

_SceneFunction = Callable[[Tree], tuple[Part | Sequence[Part], Camera]]

class _Scene(Protocol):
    @property
    def at(self) -> _SceneFunction: ...
    @property
    def parameters(self) -> Tree: ...
    @property
    def directions(self) -> Mapping[str, Tree]: ...

class _Tuned(NamedTuple):
    parts: list[Part]
    settings: dict[str, Any]
    rate: str
    reasons: list[str]
    scene: _SceneFunction
    error: float
    seconds: float

def tune(
    scene: str | Path | _Scene | _SceneFunction | Callable[[], tuple[Part | Sequence[Part], Camera]],
    parameters: Tree = None,
    *,
    tolerance: float = 0.05,
    budget_s: float = 60.0,
    directions: Mapping[str, Tree] | None = None,
    size: tuple[int, int] | None = None,
    modes: Sequence[str] | None = None,
    engine: str | None = None,
    samplers: Sequence[str] | None = None,
    splatters: Sequence[str] | None = None,
    surface: str = "mesh",
    truths: Path | str | None = None,
    truth_samples: int | None = None,
    progress: bool | None = None,
) -> _Tuned:
    """Find the cheapest settings whose derivatives are accurate enough.

    Render with them by `rts.render(tuned.parts, camera, size, **tuned.settings)`.

    The choices are sampler, splatter, layers, samples a pixel, and the rates that surfaces offer: tolerances, lattices,
    and meshes of fewer faces where no derivative is taken of their vertices. Errors are measured as in
    `rts_compare.compare`, of cheap settings first, until dearer ones are not needed. Settings that are accurate enough
    are timed in turns, and the slower half is left out each time.

    Args:
        scene: as in `rts_compare.compare`.
        parameters: of the scene's function: where derivatives are taken.
        tolerance: the largest error of the derivatives along any mode, see `Tuned.error`; such as 0.05.
        budget_s: seconds of measuring, after which the best so far is taken. The truth, which is made before and kept,
            is not refined when that would take longer than half the budget.
        directions: as in `compare`.
        size: (height, width); None for the scene's own. Errors and times are those of this size.
        modes: as in `compare`.
        engine: the engine's name; None for the engine of the parameters, or the first that is installed.
        samplers: names; None for all that suit the scene.
        splatters: names; None for all.
        surface: the name of the surface that reads a model, such as "mesh" or "bezier".
        truths: the folder of true derivatives; None for the folder of caches.
        truth_samples: the square root of the number of samples a pixel, on each of two grids, of true derivatives;
            fewer are faster and less exact. None for 4, 8 or 16: for each mode the fewest that make the true
            derivative's estimated error at most 0.3 of the tolerance. Where that takes too long, or 16 do not suffice,
            a reason says so.
        progress: whether to show progress; None for where standard error is a terminal.

    Raises:
        InputError: there is no such scene, or an argument is wrong; before anything is measured. Or no sampler suits
            the scene, nothing in the image changes, or nothing can be measured.
        PluginError: a named plugin cannot be loaded, or no engine with derivatives is installed.

    Warns:
        ToleranceWarning: nothing is accurate enough; the most accurate is given.
    """
    ...
