"""The step without derivative: from surfaces to packed samples, on the host."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Self

import array_api_compat
import numpy as np

from rts.arrays import engine_of, exemplar, is_constant, is_traced, leaves, map_leaves, namespace
from rts.camera import Camera
from rts.errors import InputError
from rts.keeping import Entry, Keeper, fingerprint, same_faces
from rts.protocols import Array, ArraySpec, Fragments, Part, Proxy, Rays, Sampled, Samples, Tree


class TriangleSampler(abc.ABC):
    """Base class of samplers that know only triangles: `sample` for any surface that gives a proxy.

    A sampler implements `rasterize`; also `prepare`, where something is worth building once for a proxy, and
    `update(prepared, proxy) -> prepared`, where that can follow moved vertices more cheaply. What was prepared is kept
    (`rts.keeping`) until the proxy's inputs change.
    """

    update: Callable[[Any, Proxy], Any] | None = None
    prunes = True
    _keeper: Keeper

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Give every instance a keeper, whatever `__init__` a subclass has."""
        self = super().__new__(cls)
        self._keeper = Keeper()
        return self

    def prepare(self, proxy: Proxy) -> Any:
        """What `rasterize` needs of the proxy: an acceleration structure, device buffers. Default the proxy itself."""
        return proxy

    @abc.abstractmethod
    def rasterize(self, prepared: Any, camera: Camera, size: tuple[int, int], layers: int, cull: str) -> Fragments:
        """The `layers` nearest triangles of every pixel, at its centre, between the near and the far plane.

        Args:
            prepared: what `prepare` gave.
            camera: NumPy float64 matrices; world is the proxy's local space.
            size: (height, width).
            layers: K.
            cull: "none", or "back": ignore triangles whose normal (counter-clockwise winding) faces away.
        """

    def build(self, surface: Any, inputs: Tree, camera: Any, size: Any) -> Entry:
        """A copy of the surface's proxy for host inputs, checked, and what this sampler prepares of it."""
        proxy = _checked_proxy(surface, inputs, camera, size)
        # A copy, since the arrays given may be changed in place, or lent for the length of one call only.
        proxy = proxy._replace(vertices=proxy.vertices.copy())
        return Entry(proxy, self.prepare(proxy) if len(proxy.faces) else None)

    def _entry(self, surface: Any, inputs: Tree, camera: Camera, size: tuple[int, int]) -> Entry:
        """The same, kept from call to call where that pays."""
        if type(self).prepare is TriangleSampler.prepare and getattr(surface, "proxy_is_cheap", False):
            proxy = _checked_proxy(surface, inputs, camera, size)
            return Entry(proxy, self.prepare(proxy))
        beside = surface.proxy_key(inputs, camera, size) if hasattr(surface, "proxy_key") else None

        def follow(old: Entry) -> Entry | None:
            if self.update is None:
                return None
            proxy = _checked_proxy(surface, inputs, camera, size)
            if old.prepared is None or not same_faces(old.proxy, proxy):
                return None
            proxy = proxy._replace(vertices=proxy.vertices.copy())
            return Entry(proxy, self.update(old.prepared, proxy))

        key = (fingerprint(inputs), beside)
        return self._keeper.get(surface, key, lambda: self.build(surface, inputs, camera, size), follow)

    def sample(
        self,
        part: Part,
        camera: Camera,
        size: tuple[int, int],
        layers: int,
        *,
        capacity: int | None = None,
        needed: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
        entry: Entry | None = None,
    ) -> Samples:
        """See `rts.protocols.Sampler`. One call to the host does everything.

        Args:
            part: see there.
            camera: see there.
            size: see there.
            layers: see there.
            capacity: see there.
            needed: see there.
            entry: to be used without a look at the surface's inputs; see `rts.prepare`.
        """
        surface, theta = part.surface, part.theta
        if not hasattr(surface, "proxy"):
            raise InputError(
                f"{surface!r} has no triangles, which this sampler needs; use a sampler of its kind, such as 'rays'"
            )
        engine = engine_of(theta, camera)
        inputs = surface.proxy_inputs(theta) if entry is None or hasattr(surface, "refine") else None
        host_theta = {name: theta[name] for name in reads_of(part)}
        if engine.name == "numpy" or not is_constant(host_theta):
            host_theta = None

        rows = layers * size[0] * size[1] if capacity is None else capacity
        packed = capacity is None
        table_specs = surface.table_specs(rows) if hasattr(surface, "table_specs") else {}
        like = exemplar(theta, camera)
        real = np.float64 if like is not None and namespace(like).finfo(like.dtype).bits == 64 else np.float32
        gbuffer_specs = _gbuffer_specs(part, host_theta, ArraySpec((rows,), real, packed))
        specs = (
            ArraySpec((rows, surface.sample_widths[0]), np.int32, packed),
            ArraySpec((rows, surface.sample_widths[1]), np.float32, packed),
            ArraySpec((layers, *size), np.int32),
            ArraySpec((layers, *size), np.float32),
            ArraySpec((), np.int32),
            *table_specs.values(),
            *gbuffer_specs.values(),
        )

        def host(view: np.ndarray, projection: np.ndarray, *host_leaves: np.ndarray) -> tuple[np.ndarray, ...]:
            it = iter(host_leaves)
            host_inputs = map_leaves(lambda _: next(it), inputs)
            host_camera = Camera(np.asarray(view, np.float64), np.asarray(projection, np.float64))
            check_camera(host_camera)
            with self._keeper.lock:
                found = entry or self._entry(surface, host_inputs, host_camera, size)
                if len(found.proxy.faces):
                    fragments = self.rasterize(found.prepared, host_camera, size, layers, part.cull)
                    _check_fragments(fragments, (layers, *size), len(found.proxy.faces), self)
                else:
                    fragments = _no_fragments((layers, *size))
            covered = fragments.triangle_ids >= 0
            kept = covered if needed is None else needed(covered, fragments.depth)
            samples = lift(fragments, found.proxy, capacity, kept)
            if hasattr(surface, "refine"):
                samples = surface.refine(host_inputs, samples, _sample_rays(samples, host_camera, size))
            gbuffer = surface.evaluate(host_theta, samples) if host_theta is not None else {}
            return (
                samples.ids,
                samples.params,
                samples.row,
                samples.depth,
                samples.overflow,
                *(np.asarray(samples.tables[name], spec.dtype) for name, spec in table_specs.items()),
                *(np.asarray(gbuffer[name], spec.dtype) for name, spec in gbuffer_specs.items()),
            )

        results = engine.call_host(host, specs, camera.view, camera.projection, *leaves(inputs))
        tables = results[5 : 5 + len(table_specs)]
        gbuffer = results[5 + len(table_specs) :]
        return Samples(
            *results[:5],
            tables=dict(zip(table_specs, tables, strict=True)),
            gbuffer=dict(zip(gbuffer_specs, gbuffer, strict=True)) if host_theta is not None else None,
            asked=getattr(part.shader, "reads", None),
            centered=getattr(surface, "centered", True),
        )


def reads_of(part: Part) -> tuple[str, ...]:
    """The entries of a part's θ that its surface evaluates; the others are its shader's."""
    return part.surface.reads(part.theta) if hasattr(part.surface, "reads") else tuple(part.theta)


def _checked_proxy(surface: Any, inputs: Tree, camera: Any, size: Any) -> Proxy:
    proxy = surface.proxy(inputs, camera, size)
    if not getattr(surface, "proxy_is_cheap", False):
        proxy = _packed_proxy(proxy, surface)
    check_proxy(proxy, surface)
    return proxy


def _packed_proxy(proxy: Any, surface: Any) -> Proxy:
    """The proxy with contiguous arrays of the right dtypes; triangles that would be read out of bounds are refused."""
    if not isinstance(proxy, Proxy):
        raise InputError(f"the proxy of {surface!r} is a {type(proxy).__name__}; expected an rts.Proxy")
    vertices, faces = np.asarray(proxy.vertices), np.asarray(proxy.faces)
    for name, array, kind in (("vertices", vertices, np.floating), ("faces", faces, np.integer)):
        if array.ndim != 2 or array.shape[1] != 3 or not np.issubdtype(array.dtype, kind):
            raise InputError(
                f"the proxy of {surface!r} has {name} of shape {array.shape} and dtype {array.dtype}; "
                f"expected (rows, 3) of {'float32' if kind is np.floating else 'int32'}"
            )
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise InputError(
            f"the proxy of {surface!r} has faces from {faces.min()} to {faces.max()}, but {len(vertices)} vertices"
        )
    widths = faces.shape[1] if proxy.ids is None else np.shape(proxy.ids)[1]
    if not hasattr(surface, "refine") and widths != surface.sample_widths[0]:
        raise InputError(
            f"the proxy of {surface!r} has {widths} ids a triangle, but sample_widths says {surface.sample_widths[0]}"
        )
    for name, array in (("ids", proxy.ids), ("corner_params", proxy.corner_params)):
        if array is not None and len(array) < len(faces):
            raise InputError(
                f"the proxy of {surface!r} has {len(faces)} faces, but {name} of shape {np.shape(array)}; "
                f"expected a row a face"
            )
    return proxy._replace(
        vertices=np.ascontiguousarray(vertices, np.float32), faces=np.ascontiguousarray(faces, np.int32)
    )


def _gbuffer_specs(part: Part, host_theta: Mapping | None, row_spec: ArraySpec) -> dict[str, ArraySpec]:
    """The attributes to evaluate on the host for a surface that is constant: those its shader reads."""
    if host_theta is None:
        return {}
    i, p = part.surface.sample_widths
    none = np.full((1, 1, 1), -1, np.int32)
    one = Samples(np.zeros((1, i), np.int32), np.zeros((1, p), np.float32), none, none, np.int32(0))
    gbuffer = part.surface.evaluate(host_theta, one)
    names = getattr(part.shader, "reads", None)
    names = list(gbuffer) if names is None else ["position", *(n for n in names if n in gbuffer)]
    return {n: row_spec._replace(shape=row_spec.shape + gbuffer[n].shape[1:]) for n in dict.fromkeys(names)}


def _no_fragments(shape: tuple[int, int, int]) -> Fragments:
    return Fragments(np.full(shape, -1, np.int32), np.zeros((*shape, 2), np.float32), np.zeros(shape, np.float32))


def _check_fragments(fragments: Any, shape: tuple[int, int, int], faces: int, sampler: Any) -> None:
    """Refuse what `rasterize` of a sampler should not have returned."""
    expected = shape, (*shape, 2), shape
    given = tuple(np.shape(x) for x in fragments) if isinstance(fragments, Fragments) else type(fragments).__name__
    if given != expected:
        raise InputError(
            f"rasterize of {type(sampler).__name__} returned {given}; expected rts.Fragments of {expected}"
        )
    last = int(np.max(fragments.triangle_ids))
    if last >= faces:
        raise InputError(f"rasterize of {type(sampler).__name__} returned triangle {last} of {faces}")


def lift(fragments: Fragments, proxy: Proxy, capacity: int | None = None, kept: np.ndarray | None = None) -> Samples:
    """Packed samples from fragments: the triangle's ids, and its corner parameters interpolated.

    Samples are numbered layer by layer, each in rows and columns of the image. There is always at least one row, so
    that what follows stays connected to θ; a row that no cell refers to has no effect. `kept` (K, H, W) bool says which
    of the covered cells to take, None for all.
    """
    from rts import lifting

    kept = fragments.triangle_ids >= 0 if kept is None else kept
    table = np.ascontiguousarray(proxy.faces if proxy.ids is None else proxy.ids, np.int32)
    corner_params = None if proxy.corner_params is None else np.ascontiguousarray(proxy.corner_params, np.float32)
    ids, params, row, depth, total = lifting.pack(fragments, kept, table, corner_params, capacity or 0)
    return Samples(ids, params, row, depth, np.asarray(max(0, total - len(ids)), np.int32))


def _sample_rays(samples: Samples, camera: Camera, size: tuple[int, int]) -> Rays:
    """The ray of each packed sample (N, 3); samples that no cell refers to get the first pixel's."""
    rays = camera.rays(size)
    pixel = np.zeros(len(samples.ids), np.int64)
    flat = samples.row.reshape(-1)
    cells = np.flatnonzero(flat >= 0)
    pixel[flat[cells]] = cells % (size[0] * size[1])
    return Rays(rays.origins.reshape(-1, 3)[pixel], rays.directions.reshape(-1, 3)[pixel])


def merge(samples: Sequence[Samples], layers: int) -> Sampled:
    """Interleave the layers of several parts by depth and keep the nearest; equal depths go to the earlier part."""
    overflow = samples[0].overflow
    for s in samples[1:]:
        overflow = overflow + s.overflow
    if len(samples) == 1:
        only = samples[0]
        return Sampled(tuple(samples), only.row, only.depth, overflow)
    given = *(s.row for s in samples), *(s.depth for s in samples)
    on_host, elsewhere = partial(_interleaved_on_the_host, layers), partial(_interleaved, layers)
    if is_traced(given[0]):
        part, row, depth = engine_of(given).on_cpu(on_host, elsewhere, *given)
    else:
        on_cpu = "cpu" in str(array_api_compat.device(given[0])).lower()
        part, row, depth = on_host(*given) if on_cpu else elsewhere(*given)
    xp, start = namespace(row), 0
    for i, s in enumerate(samples):
        row = xp.where(part == i, row + start, row) if start else row
        start += s.ids.shape[0]
    return Sampled(tuple(samples), row, depth, overflow)


def _interleaved(layers: int, *given: Array) -> tuple[Array, ...]:
    """Part, row within it and depth, (K, H, W) each, from the rows of each part and the depths of each."""
    xp, rows = namespace(given[0]), given[: len(given) // 2]
    row, depth = xp.concat(rows), xp.concat(given[len(rows) :])
    part = xp.concat([xp.where(r >= 0, i, r) for i, r in enumerate(rows)])
    order = xp.argsort(xp.where(row >= 0, depth, xp.max(depth) + 1), axis=0, stable=True)[:layers]
    part, row, depth = (xp.take_along_axis(x, order, axis=0) for x in (part, row, depth))
    return part, row, depth


def _interleaved_on_the_host(layers: int, *given: Array) -> tuple[Array, ...]:
    """The same: sorting many short columns takes array code far longer."""
    rows, depths = given[: len(given) // 2], given[len(given) // 2 :]
    shape = (min(layers, sum(r.shape[0] for r in rows)), *rows[0].shape[1:])
    dtype = np.float64 if any(namespace(d).finfo(d.dtype).bits == 64 for d in depths) else np.float32

    def host(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        from rts import lifting

        return lifting.interleave(arrays[: len(rows)], arrays[len(rows) :], layers)

    specs = ArraySpec(shape, np.int32), ArraySpec(shape, np.int32), ArraySpec(shape, dtype)
    return engine_of(given).call_host(host, specs, *given)


WELL_CONDITIONED = 1e-6
"""The `_spread` of rows from which on a matrix is far from singular."""


def check_camera(camera: Camera) -> None:
    """Refuse host matrices that are not finite, not invertible, or a view that is not affine."""
    for name, matrix in zip(("view", "projection"), camera, strict=True):
        if not np.isfinite(matrix).all():
            raise InputError(f"the camera's {name} matrix holds NaN or infinity; check how it was made")
    # Most are far from singular; singular values take longer.
    if not min(_spread(camera.view[:3, :3]), _spread(camera.projection)) > WELL_CONDITIONED:
        _check_invertible(camera)
    if not np.array_equal(camera.view[3], [0, 0, 0, 1]):
        raise InputError(
            f"the last row of the camera's view times the part's transform is {camera.view[3].tolist()}; "
            f"expected 0, 0, 0, 1"
        )


def _spread(matrix: np.ndarray) -> float:
    """The square of the determinant over that of the rows' lengths: 1 for orthogonal rows, 0 for dependent ones."""
    square = float((matrix * matrix).sum(axis=1).prod())
    return float(np.linalg.det(matrix)) ** 2 / square if square > 0 else 0.0


def _check_invertible(camera: Camera) -> None:
    # Far from the origin, or at lengths far from one, a matrix is none the worse: so rows and columns are scaled.
    projection = camera.projection
    for axis in (1, 0):
        length = np.linalg.norm(projection, axis=axis, keepdims=True)
        projection = projection / np.where(length > 0, length, 1)
    for name, matrix in (("view", camera.view[:3, :3]), ("projection", projection)):
        singular_values = np.linalg.svd(matrix, compute_uv=False)
        if not singular_values[-1] > 1e-12 * singular_values[0]:
            raise InputError(
                f"the camera's {name} matrix is singular (times the part's transform, for view); it has no inverse"
            )


def check_proxy(proxy: Proxy, surface: Any) -> None:
    """Refuse vertices that are NaN or infinite."""
    vertices = proxy.vertices
    if len(vertices) and not (np.isfinite(vertices.min()) and np.isfinite(vertices.max())):
        bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
        raise InputError(
            f"{len(bad)} of the {len(vertices)} vertices of {surface!r} are NaN or infinite, the first is vertex "
            f"{bad[0]}; check the input, or lower the step size if an optimisation led here"
        )
