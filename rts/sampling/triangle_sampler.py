"""Samplers that know only triangles: from any surface's triangles to packed samples, on the host."""

from __future__ import annotations

import abc
import contextlib
import functools
from collections.abc import Callable
from typing import Any, Self, TypeVar

import numpy as np

from rts.arrays.array_functions import shape_of
from rts.arrays.engines import stopped, value_of
from rts.arrays.trees import Array, Tree, map_leaves
from rts.contracts.records import ArraySpec, Fragments, Proxy, Request, Samples
from rts.contracts.sampler import Sampler
from rts.contracts.surface import TriangleSurface
from rts.errors import InputError, PluginError
from rts.plugin_base import is_subclass, overrides
from rts.sampling.cache import Entry, Keeper, fingerprint, same_faces
from rts.sampling.host_call import HostCall, SampleBounds
from rts.sampling.sample_checks import check_faces, checked_proxy
from rts.sampling.triangle_search import TriangleSearch
from rts.scene.camera import Camera
from rts.scene.parts import Part

_T = TypeVar("_T")

NOTHING_ELSE = Request()
"""A request for all samples, and nothing else."""


class TriangleSampler(Sampler):
    """Base class of samplers of triangles: subclasses rasterize, this class samples any surface that has a proxy.

    The result of `prepare` is kept (`rts.sampling.cache`) until the proxy's inputs change.

    Attributes:
        concurrent: True if several threads may call `rasterize` at once. Threads of a sampler with an `update` always
            wait for one another.
        joins_parts: True if `rasterize` takes the result of `prepare` for any proxy, with vertices in float64 too, as
            soon as it is made. Neighbouring parts of few triangles are then drawn at once; see `rts.sampling.joint`. It
            has to be `concurrent`.
    """

    joins_parts: bool = False
    _keeper: Keeper

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Give every instance a keeper, whatever `__init__` a subclass has; refuse an `update` without a `prepare`."""
        if overrides(cls, "update", TriangleSampler) and not overrides(cls, "prepare", TriangleSampler):
            raise PluginError(
                f"{cls.__qualname__} has an update, which adapts what prepare built, and no prepare; write prepare, or "
                f"leave update out"
            )
        self = super().__new__(cls)
        self._keeper = Keeper()
        return self

    def __getstate__(self) -> dict[str, Any]:
        """The sampler's own settings: a copy, for example in another process, prepares anew."""
        return {name: value for name, value in self.__dict__.items() if name != "_keeper"}

    def prepare(self, proxy: Proxy) -> Any:
        """Build the input of `rasterize`: an acceleration structure, device buffers.

        Results are independent of one another: those of all parts may be built before one of them is drawn.
        The default returns the proxy, once its `faces` are found to name vertices; else it raises an InputError.
        """
        check_faces(proxy.vertices, proxy.faces)
        return proxy

    def update(self, prepared: Any, proxy: Proxy) -> Any:
        """Adapt the result of `prepare` to moved vertices of the same faces, and return it; None to prepare anew.

        A class with this method has its own `prepare`, too.
        """
        return None

    def arrange(self, prepared: Any) -> Any:
        """Rearrange the result of `prepare` for triangles that will stay, as `rts.prepare` promises.

        This may take longer than drawing the triangles a few times. The default changes nothing.
        """
        return prepared

    @abc.abstractmethod
    def rasterize(self, prepared: Any, camera: Camera, size: tuple[int, int], layers: int, cull: str) -> Fragments:
        """The `layers` nearest triangles of every pixel, at its centre, between the near and the far plane.

        Args:
            prepared: the result of `prepare` or `arrange`.
            camera: NumPy float64 matrices; world is the proxy's local space.
            size: (height, width).
            layers: K.
            cull: "none", or "back" to ignore triangles whose normal (counter-clockwise winding) faces away.

        Returns:
            Fragments in new arrays, front to back in each pixel; no layer follows an empty one.
        """

    def rasterize_points(
        self, prepared: Any, camera: Camera, size: tuple[int, int], layers: int, cull: str, points: np.ndarray
    ) -> Fragments | None:
        """Fragments at points of the image; see `rasterize`. With None, the default, the core finds them itself.

        Args:
            prepared: see `rasterize`.
            camera: see `rasterize`.
            size: see `rasterize`.
            layers: see `rasterize`.
            cull: see `rasterize`.
            points: (M, 2) float64, x and y in cells from the upper left corner.

        Returns:
            Fragments, (K, 1, M).
        """
        return None

    def prepare_part(self, part: Part, camera: Camera | None, size: tuple[int, int] | None) -> Entry:
        """The proxy of a part, and the result of `prepare` for it; see `Sampler`.

        Raises:
            InputError: the surface has no triangles, θ or the camera is traced, or the triangles depend on the view
                and the camera or the size is None.
        """
        surface = _of_triangles(part.surface)
        if surface.depends_on_view and (camera is None or size is None):
            raise InputError(f"the triangles of {surface!r} depend on the view; give camera and size")
        inputs = surface.proxy_inputs(stopped(part.theta))
        inputs = map_leaves(_held, inputs)
        if camera is not None:
            camera = camera if size is None else camera.for_size(size)
            camera = camera.within(part.transform).map(_held)
        built = self.arranged(self._built(surface, inputs, camera, size))
        map_leaves(_held, stopped({name: part.theta[name] for name in surface.reads(part.theta)}))
        return built._replace(inputs=map_leaves(np.copy, inputs)) if surface.refines else built

    def arranged(self, entry: Entry) -> Entry:
        """An entry for triangles that will stay; see `arrange`."""
        return entry if entry.prepared is None else entry._replace(prepared=self.arrange(entry.prepared))

    def _built(self, surface: TriangleSurface, inputs: Tree, camera: Any, size: Any) -> Entry:
        """An entry of a copy of the surface's proxy, checked, and of the result of `prepare` for it."""
        proxy = checked_proxy(surface, inputs, camera, size)
        # A copy, since the given arrays may change in place, or be valid only during this call.
        proxy = proxy._replace(vertices=proxy.vertices.copy())
        return Entry(proxy, self.prepare(proxy) if len(proxy.faces) else None)

    def _entry(self, surface: TriangleSurface, inputs: Tree, camera: Camera, size: tuple[int, int]) -> Entry:
        """The surface's entry; kept from call to call unless its proxy is cheap and `prepare` the default."""
        if surface.proxy_is_cheap and not overrides(self, "prepare", TriangleSampler):
            proxy = checked_proxy(surface, inputs, camera, size)
            return Entry(proxy, proxy)
        beside = surface.proxy_key(inputs, camera, size) if surface.depends_on_view else None

        def follow(old: Entry) -> Entry | None:
            if not overrides(self, "update", TriangleSampler) or old.prepared is None:
                return None
            proxy = checked_proxy(surface, inputs, camera, size)
            if not same_faces(old.proxy, proxy):
                return None
            proxy = proxy._replace(vertices=proxy.vertices.copy())
            updated = self.update(old.prepared, proxy)
            return None if updated is None else Entry(proxy, updated)

        key = (fingerprint(inputs), beside)
        return self._keeper.get(surface, key, lambda: self._built(surface, inputs, camera, size), follow)

    def sample(
        self, part: Part, camera: Camera, size: tuple[int, int], layers: int, request: Request = NOTHING_ELSE
    ) -> Samples:
        """The `layers` nearest samples of every cell or point, by one call to the host; see `rts.Sampler`.

        Raises:
            InputError: the surface has no triangles, the camera makes no image, or a plugin broke its contract.
        """
        surface, camera = _of_triangles(part.surface), camera.for_size(size)
        points, entry = request.points, request.entry
        cells = size if points is None else (1, points.shape[0])
        refines, moves = surface.refines, surface.refines and surface.refine_moves
        pairs = request.pairs and points is not None and refines and not moves
        pairs = pairs and overrides(surface, "refine_outlines", TriangleSurface)
        bounds = SampleBounds(layers, cells, request.capacity, size, 2 * cells[1] if pairs else 0)
        tables = bounds.tables(surface) if refines else {}
        beside = {
            **({"incomplete_cells": ArraySpec((), np.int32)} if moves else {}),
            **({"pair": ArraySpec((2, cells[1]), np.int32)} if pairs else {}),
            **({"triangle": ArraySpec((layers, *cells), np.int32)} if request.triangles and not moves else {}),
        }

        def find(camera: Camera, inputs: Tree, *further: np.ndarray) -> tuple[Samples, dict[str, Any]]:
            host_points = np.asarray(further[0], np.float64) if further else None
            search = TriangleSearch(self, surface, part.cull, inputs, camera, bounds, tables, entry, host_points)
            samples = search.moved() if moves else search.in_place(pairs)
            return samples, {name: getattr(samples, name) for name in beside}

        call = HostCall(part, surface, camera, bounds, entry, self.draws_at_once and surface.concurrent)
        samples, more = call.samples(find, beside, tables, [] if points is None else [points[None, ...]])
        return samples.replace(**more, at_points=points is not None)

    def working_on(
        self,
        surface: TriangleSurface,
        inputs: Tree,
        camera: Camera,
        view: tuple[int, int],
        entry: Entry | None,
        work: Callable[[Entry], _T],
    ) -> _T:
        """Call `work` with a surface's prepared entry, which no other thread changes meanwhile; returns its result.

        Args:
            surface: the surface.
            inputs: the result of its `proxy_inputs`, on the host.
            camera: the camera.
            view: (height, width) of the grid of cells.
            entry: the prepared entry; None to look it up, or to build it.
            work: a function of the entry. Several threads may call it at once if `draws_at_once`.
        """
        with self._keeper.lock:
            ready = entry or self._entry(surface, inputs, camera, view)
            if not self.draws_at_once:
                return work(ready)
        return work(ready)

    @property
    def draws_at_once(self) -> bool:
        """True if several threads may draw one prepared entry at once."""
        return self.concurrent and not overrides(self, "update", TriangleSampler)


def rasterized(
    sampler: TriangleSampler, prepared: Any, camera: Camera, size: tuple[int, int], layers: int, cull: str
) -> Fragments:
    """`TriangleSampler.rasterize`, which one thread calls at a time unless it is `concurrent`."""
    with contextlib.nullcontext() if sampler.concurrent else sampler._keeper.lock:
        return sampler.rasterize(prepared, camera, size, layers, cull)


@functools.lru_cache(maxsize=4096)
def is_drawn(surface: type, sampler: type) -> bool:
    """True if the triangles of surfaces are all that samplers ask of them, and stay as they are made; for classes."""
    own = overrides(sampler, "sample", TriangleSampler) or overrides(sampler, "update", TriangleSampler)
    return is_subclass(sampler, TriangleSampler) and is_subclass(surface, TriangleSurface) and not own


def _of_triangles(surface: Any) -> TriangleSurface:
    """The surface; an InputError refuses one without triangles."""
    if not isinstance(surface, TriangleSurface):
        raise InputError(
            f"{surface!r} has no triangles, which this sampler needs; use a sampler of its kind, such as 'rays'"
        )
    return surface


def _held(x: Array) -> np.ndarray:
    """The value of an array, to be kept on the host; refused if it is traced."""
    value = value_of(x)
    if value is None or value.shape != shape_of(x):
        raise InputError(
            f"rts.prepare was given a traced array of shape {shape_of(x)}; expected known values: call it outside of "
            f"jit, vmap and other transforms, and give what changes to `replace`"
        )
    return value
