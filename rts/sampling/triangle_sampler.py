"""Samplers that know only triangles: from any surface's triangles to packed samples, on the host."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np

from rts.arrays import shape_of
from rts.camera import Camera
from rts.engines import stopped, value_of
from rts.errors import InputError, PluginError
from rts.interfaces import AnyNeeded, Needed, Sampler, TriangleSurface
from rts.parts import Part
from rts.plugin_base import overrides
from rts.records import ArraySpec, Fragments, Proxy, Samples
from rts.sampling.cache import Entry, Keeper, fingerprint, same_faces
from rts.sampling.exits import Exits, beside_outlines
from rts.sampling.extremes import largest
from rts.sampling.facing import facing as facing_of
from rts.sampling.host_call import HostCall, Shape
from rts.sampling.packing import lift, of_first_row, repack
from rts.sampling.pruning import ByFunction
from rts.sampling.settling import on_surface, refined
from rts.sampling.validation import check_faces, check_fragments, checked_pieces, checked_proxy
from rts.trees import Array, Tree, leaves, map_leaves

_T = TypeVar("_T")

LEAST_LAYERS = 3
"""Where a surface refines its samples, so many layers of triangles are looked for, or one more than samples are asked
for, if that is more: at an outline both sides of a fold may stand where the surface is not."""


class TriangleSampler(Sampler):
    """Base class of samplers that know only triangles: `sample` for any surface that gives a proxy.

    What was prepared is kept (`rts.sampling.cache`) until the proxy's inputs change.

    Attributes:
        tells_exits: whether `rasterize` knows cull="front", too.
        concurrent: whether several threads may call `rasterize` at once; those of a sampler with an `update` wait
            for one another in any case.
    """

    culls = True
    prunes = True
    takes_cells = True
    tells_facing = True
    _keeper: Keeper

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Give every instance a keeper, whatever `__init__` a subclass has; refuse what would never be called."""
        if overrides(cls, "update", TriangleSampler) and not overrides(cls, "prepare", TriangleSampler):
            raise PluginError(
                f"{cls.__qualname__} has an update, which adapts what prepare built, and no prepare; write prepare, or "
                f"leave update out"
            )
        self = super().__new__(cls)
        self._keeper = Keeper()
        return self

    def __getstate__(self) -> dict[str, Any]:
        """The sampler's own settings: copies, and those in other processes, build anew."""
        return {name: value for name, value in self.__dict__.items() if name != "_keeper"}

    def prepare(self, proxy: Proxy) -> Any:
        """Build what `rasterize` needs: an acceleration structure, device buffers. The default is the proxy itself."""
        check_faces(proxy)
        return proxy

    def update(self, prepared: Any, proxy: Proxy) -> Any:
        """Adapt what was prepared to moved vertices of the same faces, and return it; None if it must be made anew.

        A class with this method has its own `prepare`, too.
        """
        return None

    def arrange(self, prepared: Any) -> Any:
        """Rearrange what was prepared of triangles that will stay as they are, as `rts.prepare` promises.

        It may take longer than to draw them a few times. The default returns what was prepared.
        """
        return prepared

    @abc.abstractmethod
    def rasterize(self, prepared: Any, camera: Camera, size: tuple[int, int], layers: int, cull: str) -> Fragments:
        """The `layers` nearest triangles of every pixel, at its centre, between the near and the far plane.

        Args:
            prepared: what `prepare` or `arrange` gave.
            camera: NumPy float64 matrices; world is the proxy's local space.
            size: (height, width).
            layers: K.
            cull: "none", or "back": ignore triangles whose normal (counter-clockwise winding) faces away; and where a
                class `tells_exits`, "front": ignore the others.

        Returns:
            Fragments, front to back in each pixel; no layer follows an empty one.
        """

    def rasterize_cells(
        self, prepared: Any, camera: Camera, size: tuple[int, int], layers: int, cull: str, cells: np.ndarray
    ) -> Fragments:
        """As `rasterize`, of some cells alone. The default draws all, and takes those.

        Args:
            prepared: see `rasterize`.
            camera: see `rasterize`.
            size: see `rasterize`.
            layers: see `rasterize`.
            cull: see `rasterize`.
            cells: (L, C) int32, flat indices of cells in the grid, none of them twice, or −1 for none.

        Returns:
            Fragments, (K, L, C).
        """
        whole, there = self.rasterize(prepared, camera, size, layers, cull), cells >= 0
        check_fragments(whole, (layers, *size), np.iinfo(np.int32).max, self)
        at = np.where(there, cells, 0)
        ids = np.where(there, whole.triangle_ids.reshape(layers, -1)[:, at], -1)
        return Fragments(ids, whole.barycentrics.reshape(layers, -1, 2)[:, at], whole.depth.reshape(layers, -1)[:, at])

    def rasterize_exits(
        self,
        prepared: Any,
        camera: Camera,
        size: tuple[int, int],
        layers: int,
        beside: Callable[[Fragments], np.ndarray],
    ) -> tuple[Fragments, np.ndarray, Fragments]:
        """`rasterize` with cull="back", and what is seen from behind in some cells; where a class `tells_exits`.

        The default calls `rasterize` and `rasterize_cells`, which look at all triangles anew.

        Args:
            prepared: see `rasterize`.
            camera: see `rasterize`.
            size: see `rasterize`.
            layers: see `rasterize`.
            beside: gives the cells (1, M) int32, flat indices in the grid, of the fragments (K, H, W), which are not to
                be changed from then on.

        Returns:
            Fragments (K, H, W), the cells, and the fragments (1, 1, M) of cull="front" in these.
        """
        fragments = self.rasterize(prepared, camera, size, layers, "back")
        cells = beside(fragments)
        backs = _no_fragments((1, *cells.shape))
        if cells.size:
            backs = self.rasterize_cells(prepared, camera, size, 1, "front", cells)
        return fragments, cells, backs

    def hold(self, part: Part, camera: Camera | None, size: tuple[int, int] | None) -> Entry:
        """See `Sampler`: the proxy of a part, and what is prepared of it."""
        surface = _of_triangles(part.surface)
        if surface.depends_on_view and (camera is None or size is None):
            raise InputError(f"the triangles of {surface!r} depend on the view; give camera and size")
        inputs = surface.proxy_inputs(stopped(part.theta))
        inputs = map_leaves(_held, inputs)
        if camera is not None:
            camera = camera if size is None else camera.for_size(size)
            camera = camera.within(part.transform).map(_held)
        built = self.arranged(self._built(surface, inputs, camera, size))
        arrays = leaves(stopped({name: part.theta[name] for name in surface.reads(part.theta)}))
        read = [_held(x) for x in arrays]
        built = built._replace(size=max([built.size or 0.0, *(largest(x) for x in read if x.dtype.kind == "f")]))
        return built._replace(inputs=map_leaves(np.copy, inputs)) if surface.refines else built

    def arranged(self, entry: Entry) -> Entry:
        """An entry for triangles that will stay; see `arrange`."""
        return entry if entry.prepared is None else entry._replace(prepared=self.arrange(entry.prepared))

    def _built(self, surface: TriangleSurface, inputs: Tree, camera: Any, size: Any) -> Entry:
        """A copy of the surface's proxy for host inputs, checked, and what this sampler prepares of it."""
        proxy = checked_proxy(surface, inputs, camera, size)
        # A copy, since the arrays given may be changed in place, or lent for the length of one call only.
        proxy = proxy._replace(vertices=proxy.vertices.copy())
        return Entry(proxy, self.prepare(proxy) if len(proxy.faces) else None, largest(proxy.vertices))

    def _entry(self, surface: TriangleSurface, inputs: Tree, camera: Camera, size: tuple[int, int]) -> Entry:
        """What `_built` gives, kept from call to call where that pays."""
        if surface.proxy_is_cheap and not overrides(self, "prepare", TriangleSampler):
            proxy = checked_proxy(surface, inputs, camera, size)
            return Entry(proxy, self.prepare(proxy))
        beside = surface.proxy_key(inputs, camera, size) if surface.depends_on_view else None

        def follow(old: Entry) -> Entry | None:
            if not self._follows or old.prepared is None:
                return None
            proxy = checked_proxy(surface, inputs, camera, size)
            if not same_faces(old.proxy, proxy):
                return None
            proxy = proxy._replace(vertices=proxy.vertices.copy())
            updated = self.update(old.prepared, proxy)
            return None if updated is None else Entry(proxy, updated, largest(proxy.vertices))

        key = (fingerprint(inputs), beside)
        return self._keeper.get(surface, key, lambda: self._built(surface, inputs, camera, size), follow)

    def sample(
        self,
        part: Part,
        camera: Camera,
        size: tuple[int, int],
        layers: int,
        *,
        capacity: int | None = None,
        needed: AnyNeeded | None = None,
        entry: Entry | None = None,
        cells: Array | None = None,
        facing: bool = False,
        exits: bool = False,
    ) -> Samples:
        """The `layers` nearest samples of every pixel, by one call to the host; see `rts.Sampler`.

        Args:
            part: as in `rts.Sampler`.
            camera: as in `rts.Sampler`.
            size: as in `rts.Sampler`.
            layers: as in `rts.Sampler`.
            capacity: as in `rts.Sampler`.
            needed: says which samples to keep; None for all.
            entry: what `hold` gave, to be used without a look at the surface's inputs.
            cells: as in `rts.Sampler`.
            facing: as in `rts.Sampler`; surfaces that move samples off their triangles tell nothing.
            exits: as in `rts.Sampler`; surfaces with a `refine` tell nothing, nor do those that are not `centered`, nor
                lists of cells.

        Raises:
            InputError: the surface has no triangles, or a plugin broke its contract.
        """
        surface, camera = _of_triangles(part.surface), camera.for_size(size)
        shape = Shape(layers, size if cells is None else tuple(cells.shape), capacity, size)
        tells = facing and layers > 1 and part.cull == "none" and overrides(surface, "pieces", TriangleSurface)
        tells = tells and not (surface.refines and surface.refine_moves)
        exits = exits and part.cull == "back" and cells is None and not surface.refines and surface.centered
        tables = shape.tables(surface) if surface.refines else {}
        wanted = needed if needed is None or isinstance(needed, Needed) else ByFunction(needed)
        settles = wanted is not None and wanted.settles and not surface.refines
        beside = {
            **({"facing": ArraySpec((layers, *shape.size), np.int16)} if tells else {}),
            **({"settled": ArraySpec(shape.size, np.int8)} if settles else {}),
            **({"exit": ArraySpec(size, np.int32)} if exits else {}),
        }

        def find(cameras: Sequence[Camera], inputs: Tree, *cells: np.ndarray) -> tuple[Samples, dict[str, Any]]:
            own = np.asarray(cells[0], np.int32) if cells else None
            given = shape, tables, wanted, entry, own, tells, exits
            found = self._found(surface, part.cull, inputs, cameras[0], *given)
            return found, {name: getattr(found, name) for name in beside}

        call = HostCall(part, surface, [camera], shape, entry)
        samples, more = call.samples(find, beside, tables, [] if cells is None else [cells])
        return replace(samples, **more)

    def _found(
        self,
        surface: TriangleSurface,
        cull: str,
        inputs: Tree,
        camera: Camera,
        shape: Shape,
        tables: Mapping[str, ArraySpec],
        needed: Needed | None,
        entry: Entry | None,
        cells: np.ndarray | None,
        tells: bool,
        exits: bool,
    ) -> Samples:
        """The samples that are to be kept, on the host.

        With what faces the viewer, if it `tells`, and with `exits`.
        """
        # Of tables there is but one set, so that no samples can be added later.
        more = surface.refines and surface.refine_moves and not tables
        grid = max(shape.layers + 1, LEAST_LAYERS) if more else shape.layers, *shape.size
        moves = surface.refines and surface.refine_moves

        def keep(covered: np.ndarray, depth: np.ndarray) -> np.ndarray:
            """Which of the fragments, where nothing moves them any more, are samples."""
            kept = covered if needed is None else needed(covered, depth)
            return kept if kept is covered else kept & covered

        asked = keep if exits else None
        found, fragments, covered, kept, behind = self._fragments(
            surface, cull, inputs, camera, shape.view, grid, entry, cells, asked
        )
        if not moves:
            kept = keep(covered, fragments.depth) if kept is None else kept
            settled, size = None, found.size
            if needed is not None and not surface.refines:
                if size is None:
                    # Vertices that were looked at as a part of θ need not be looked at again.
                    read = any(np.may_share_memory(x, found.proxy.vertices) for x in leaves(inputs))
                    size = needed.size if read and needed.size is not None else largest(found.proxy.vertices)
                if needed.settles:
                    kept = kept.copy() if kept is covered else kept  # It is changed in place.
                    settled = of_first_row(needed.settled(covered, fragments.depth, kept, size))
            sides = None
            if tells:
                # Nobody looks at them where no sample is hidden, and to find them takes long.
                pieces = checked_pieces(surface, found.proxy) if kept[1:].any() else np.zeros(1, np.int16)
                sides = facing_of(fragments, kept, found.proxy, pieces, camera, listed=cells is not None)
            if not surface.refines:
                if size is not None and needed is not None and needed.size is not None and size <= needed.size:
                    size = 0.0  # Where numbers of this size are too large all is kept already.
                lifted = lift(fragments, found.proxy, shape.capacity, kept, size, behind)
                return replace(lifted, facing=sides, settled=settled)
            lifted = lift(fragments, found.proxy, None, kept)
            samples, _ = refined(surface, inputs, lifted, camera, tables, shape.view, cells)
            return replace(repack(samples, samples.row >= 0, shape.capacity), facing=sides)
        given = surface, inputs, fragments, found.proxy, camera, shape.layers, tables, shape.view, cells
        settled = on_surface(*given)
        # `needed` is asked only now, since it goes by the final depths.
        left = kept = settled.row >= 0
        if needed is not None:
            needed.ran_out(int((covered[-1] & ~left[-1]).sum()))
            kept = needed(left, settled.depth)
        return repack(settled, kept, shape.capacity)

    def _fragments(
        self,
        surface: TriangleSurface,
        cull: str,
        inputs: Tree,
        camera: Camera,
        view: tuple[int, int],
        grid: tuple[int, int, int],
        entry: Entry | None,
        cells: np.ndarray | None,
        keep: Callable[[np.ndarray, np.ndarray], np.ndarray] | None,
    ) -> _Found:
        """What is prepared of a surface, and the fragments (K, ·, ·) of a grid of the size `view`, or of some cells.

        With what says which of them to `keep` also that, and the exits beside outlines.
        """

        def drawn(found: Entry) -> tuple[Fragments, np.ndarray]:
            if not len(found.proxy.faces):
                return _no_fragments(grid), np.zeros(grid, np.bool_)
            given = found.prepared, camera, view, grid[0], cull
            fragments = self.rasterize(*given) if cells is None else self.rasterize_cells(*given, cells)
            return fragments, check_fragments(fragments, grid, len(found.proxy.faces), self)

        def all_of(found: Entry) -> _Found:
            if keep is None:
                return _Found(found, *drawn(found))
            if not (count := len(found.proxy.faces)):
                fragments, covered = drawn(found)
                nowhere = np.empty((1, 0), np.int32)
                return _Found(found, fragments, covered, None, Exits.of(fragments, nowhere, _no_fragments((1, 1, 0))))
            wanted, looked_at, covered, kept = keep, None, None, None

            def beside(fragments: Fragments) -> np.ndarray:
                nonlocal looked_at, covered, kept
                looked_at, covered = fragments, check_fragments(fragments, grid, count, self)
                kept = wanted(covered, fragments.depth)
                return beside_outlines(kept)

            fragments, asked, backs = self.rasterize_exits(found.prepared, camera, view, grid[0], beside)
            if covered is None or fragments is not looked_at:
                covered, kept = check_fragments(fragments, grid, count, self), None
            if asked.size:
                check_fragments(backs, (1, *asked.shape), count, self)
            return _Found(found, fragments, covered, kept, Exits.of(fragments, asked, backs))

        return self.working_on(surface, inputs, camera, view, entry, all_of)

    def working_on(
        self,
        surface: TriangleSurface,
        inputs: Tree,
        camera: Camera,
        view: tuple[int, int],
        entry: Entry | None,
        work: Callable[[Entry], _T],
    ) -> _T:
        """What `work` gives for what is prepared of a surface, which no other thread changes meanwhile.

        Args:
            surface: the surface.
            inputs: of its proxy, on the host.
            camera: the camera.
            view: (height, width) of the grid of cells.
            entry: what is prepared, if it is known.
            work: may be called by several threads at once where several may draw.
        """
        with self._keeper.lock:
            found = entry or self._entry(surface, inputs, camera, view)
            if not self.draws_at_once:
                return work(found)
        return work(found)

    @property
    def draws_at_once(self) -> bool:
        """Whether several threads may draw what is prepared of one surface at once."""
        return self.concurrent and not self._follows

    @property
    def _follows(self) -> bool:
        """Whether what was prepared can follow moved vertices."""
        return overrides(self, "update", TriangleSampler)


class _Found(NamedTuple):
    """What a sampler has found of a surface.

    Attributes:
        entry: what is prepared of it.
        fragments: (K, ·, ·).
        covered: (K, ·, ·) bool, which cells have one.
        kept: (K, ·, ·) bool, which of them are to be samples, if that was asked.
        exits: those beside outlines, if they were asked for.
    """

    entry: Entry
    fragments: Fragments
    covered: np.ndarray
    kept: np.ndarray | None = None
    exits: Exits | None = None


def _of_triangles(surface: Any) -> TriangleSurface:
    """The surface, which must be one of triangles."""
    if not isinstance(surface, TriangleSurface):
        raise InputError(
            f"{surface!r} has no triangles, which this sampler needs; use a sampler of its kind, such as 'rays'"
        )
    return surface


def _no_fragments(shape: tuple[int, int, int]) -> Fragments:
    return Fragments(np.full(shape, -1, np.int32), np.zeros((*shape, 2), np.float32), np.zeros(shape, np.float32))


def _held(x: Array) -> np.ndarray:
    """The value of an array that is to be held on the host."""
    value = value_of(x)
    if value is None or value.shape != shape_of(x):
        raise InputError(
            f"rts.prepare was given a traced array of shape {shape_of(x)}; expected known values: call it outside of "
            f"jit, vmap and other transforms, and give what changes to `replace`"
        )
    return value
