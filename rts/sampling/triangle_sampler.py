"""Samplers that know only triangles: from any surface's triangles to packed samples, on the host."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np

from rts.arrays.array_functions import shape_of
from rts.arrays.engines import stopped, value_of
from rts.arrays.extremes import largest
from rts.arrays.trees import Array, Tree, leaves, map_leaves
from rts.contracts.records import ArraySpec, Decision, Fragments, Hidden, Proxy, Question, Request, Samples
from rts.contracts.sampler import Sampler
from rts.contracts.surface import TriangleSurface
from rts.errors import InputError, PluginError
from rts.plugin_base import overrides
from rts.sampling.cache import Entry, Keeper, fingerprint, same_faces
from rts.sampling.exits import Exits, beside_outlines, with_pairs
from rts.sampling.facing import facing as facing_of
from rts.sampling.host_call import HostCall, Shape
from rts.sampling.layer_order import on_surface, refined, steps_of
from rts.sampling.packing import lift, repack, triangles_of
from rts.sampling.points import at_points
from rts.sampling.sample_checks import check_faces, check_fragments, checked_pieces, checked_proxy
from rts.scene.camera import Camera
from rts.scene.parts import Part

_T = TypeVar("_T")

NOTHING_ELSE = Request()
"""A request for all samples, and nothing else."""

LEAST_LAYERS = 3
"""Fewest layers of triangles to draw for a surface that moves its samples; for K layers, K + 1 if that is more. At an
outline both sides of a fold of triangles may lie beside the surface."""


class TriangleSampler(Sampler):
    """Base class of samplers of triangles: subclasses rasterize, this class samples any surface that has a proxy.

    The result of `prepare` is kept (`rts.sampling.cache`) until the proxy's inputs change.

    Attributes:
        concurrent: True if several threads may call `rasterize` at once. Threads of a sampler with an `update` always
            wait for one another.
    """

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

        The default returns the proxy, once its `faces` are found to name vertices; else it raises an InputError.
        """
        check_faces(proxy)
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
            cull: "none"; "back": ignore triangles whose normal (counter-clockwise winding) faces away; or "front":
                ignore the others.

        Returns:
            Fragments, front to back in each pixel; no layer follows an empty one.
        """

    def rasterize_cells(
        self, prepared: Any, camera: Camera, size: tuple[int, int], layers: int, cull: str, cells: np.ndarray
    ) -> Fragments:
        """Fragments of some cells alone; see `rasterize`. The default draws all cells, and selects some.

        Args:
            prepared: see `rasterize`.
            camera: see `rasterize`.
            size: see `rasterize`.
            layers: see `rasterize`.
            cull: see `rasterize`.
            cells: (L, C) int32, flat indices of cells in the grid, none of them twice; −1 for an unused place.

        Returns:
            Fragments, (K, L, C), with `triangle_ids` of −1 in unused places.
        """
        whole, listed = self.rasterize(prepared, camera, size, layers, cull), cells >= 0
        check_fragments(whole, (layers, *size), np.iinfo(np.int32).max, self)
        at = np.where(listed, cells, 0)
        ids = np.where(listed, whole.triangle_ids.reshape(layers, -1)[:, at], -1)
        return Fragments(ids, whole.barycentrics.reshape(layers, -1, 2)[:, at], whole.depth.reshape(layers, -1)[:, at])

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

    def rasterize_exits(
        self,
        prepared: Any,
        camera: Camera,
        size: tuple[int, int],
        layers: int,
        beside: Callable[[Fragments], np.ndarray],
    ) -> tuple[Fragments, np.ndarray, Fragments]:
        """`rasterize` with cull="back", and the triangles seen from behind in the cells that `beside` names.

        The default calls `rasterize` and `rasterize_cells`, each of which goes through all triangles.

        Args:
            prepared: see `rasterize`.
            camera: see `rasterize`.
            size: see `rasterize`.
            layers: see `rasterize`.
            beside: fragments (K, H, W) → the cells (1, M) int32, flat indices in the grid. The fragments must not
                change afterwards.

        Returns:
            Fragments (K, H, W), the cells (1, M), and the fragments (1, 1, M) of cull="front" in these; M may be 0.
        """
        fragments = self.rasterize(prepared, camera, size, layers, "back")
        cells = beside(fragments)
        backs = _no_fragments((1, *cells.shape))
        if cells.size:
            backs = self.rasterize_cells(prepared, camera, size, 1, "front", cells)
        return fragments, cells, backs

    def between(
        self, prepared: Any, camera: Camera, size: tuple[int, int], cull: str, depth: np.ndarray
    ) -> np.ndarray | None:
        """`Cells.between` (H, W) float32 of a finished image; None, the default, for samplers that do not tell.

        Args:
            prepared: see `rasterize`.
            camera: see `rasterize`.
            size: see `rasterize`.
            cull: see `rasterize`.
            depth: (H, W) float32, the depth of the nearest triangle at each cell's centre; 0 where there is none.
        """
        return None

    def hold(self, part: Part, camera: Camera | None, size: tuple[int, int] | None) -> Entry:
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
        return Entry(proxy, self.prepare(proxy) if len(proxy.faces) else None, largest(proxy.vertices))

    def _entry(self, surface: TriangleSurface, inputs: Tree, camera: Camera, size: tuple[int, int]) -> Entry:
        """The surface's entry; kept from call to call unless its proxy is cheap and `prepare` the default."""
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
        self, part: Part, camera: Camera, size: tuple[int, int], layers: int, request: Request = NOTHING_ELSE
    ) -> Samples:
        """The `layers` nearest samples of every cell asked for, by one call to the host; see `rts.Sampler`.

        If requested, `facing` is recorded for K > 1 layers of parts that are not culled, of surfaces with `pieces` that
        do not move their samples. Requested exits are of two kinds. Single ones are recorded for parts with
        cull="back", of centred surfaces without `refine`, but not for lists of cells. Pairs at outlines are recorded
        for surfaces with `refine_outlines` that do not move their samples. `between` goes by the triangles, whatever
        the surface makes of them.

        Raises:
            InputError: the surface has no triangles, the camera makes no image, or a plugin broke its contract.
        """
        surface, camera = _of_triangles(part.surface), camera.for_size(size)
        listed, hidden, entry = request.cells, request.hidden, request.entry
        if request.points is not None:
            listed = request.points[None, ...]
        more = 0 if request.points is None or not request.exits else 2 * layers * len(request.points)
        shape = Shape(layers, size if listed is None else tuple(listed.shape[:2]), request.capacity, size, more)
        refines = surface.refines
        tables, moves = shape.tables(surface) if refines else {}, refines and surface.refine_moves
        sides = request.facing and layers > 1 and part.cull == "none" and not moves
        sides = sides and overrides(surface, "pieces", TriangleSurface)
        exits = request.exits and part.cull == "back" and listed is None and not refines and surface.centered
        pairs = request.exits and refines and not moves
        pairs = pairs and overrides(surface, "refine_outlines", TriangleSurface)
        thin = request.between and listed is None and overrides(self, "between", TriangleSampler)
        beside = {
            **({"facing": ArraySpec((layers, *shape.size), np.int16)} if sides else {}),
            **({"settled": ArraySpec(shape.size, np.int8)} if hidden and hidden.settles and not refines else {}),
            **({"exit": ArraySpec((1 + pairs, *shape.size), np.int32)} if exits or pairs else {}),
            **({"ran_out": ArraySpec((), np.int32)} if moves else {}),
            **({"between": ArraySpec(shape.size, np.float32)} if thin else {}),
            **({"triangle": shape.row_spec(np.int32)} if request.triangles and not moves else {}),
        }

        def find(cameras: Sequence[Camera], inputs: Tree, *cells: np.ndarray) -> tuple[Samples, dict[str, Any]]:
            own = np.asarray(cells[0], np.int32 if request.points is None else np.float64) if cells else None
            search = _Search(self, surface, part.cull, inputs, cameras[0], shape, tables, hidden, entry, own, thin)
            samples = search.moved() if moves else search.in_place(sides, exits, pairs)
            return samples, {name: getattr(samples, name) for name in beside}

        call = HostCall(part, surface, [camera], shape, entry)
        samples, more = call.samples(find, beside, tables, [] if listed is None else [listed])
        followed = [name for name in ("cells", "points", "hidden") if getattr(request, name) is not None]
        return samples.replace(**more, followed=tuple(followed))

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
            known = entry or self._entry(surface, inputs, camera, view)
            if not self.draws_at_once:
                return work(known)
        return work(known)

    @property
    def draws_at_once(self) -> bool:
        """True if several threads may draw one prepared entry at once."""
        return self.concurrent and not self._follows

    @property
    def _follows(self) -> bool:
        """True if the sampler can adapt a prepared entry to moved vertices."""
        return overrides(self, "update", TriangleSampler)


class _Drawn(NamedTuple):
    """Drawn triangles.

    Attributes:
        known: the prepared entry.
        fragments: (K, ·, ·).
        covered: (K, ·, ·) bool, the cells of the fragments.
        decision: a decision on them; None without exits, or if the part has no triangles.
        exits: where rays leave the part; None if not asked for.
        between: `Cells.between`; None if not asked for.
    """

    known: Entry
    fragments: Fragments
    covered: np.ndarray
    decision: Decision | None
    exits: Exits | None
    between: np.ndarray | None


@dataclass(frozen=True)
class _Search:
    """The search for the samples of one view, on the host.

    Attributes:
        sampler: draws the triangles.
        surface: the surface.
        cull: the part's `cull`.
        inputs: the result of the surface's `proxy_inputs`, on the host.
        camera: host matrices.
        shape: bounds on the number of samples.
        tables: the result of the surface's `table_specs`.
        hidden: the rule for hidden samples; None to keep all.
        entry: the surface's prepared entry; None to look it up, or to build it.
        cells: (L, C), the cells to sample, or points (1, M, 2); None for all cells.
        thin: True to record `Cells.between`.
    """

    sampler: TriangleSampler
    surface: TriangleSurface
    cull: str
    inputs: Tree
    camera: Camera
    shape: Shape
    tables: Mapping[str, ArraySpec]
    hidden: Hidden | None
    entry: Entry | None
    cells: np.ndarray | None
    thin: bool

    def in_place(self, sides: bool, exits: bool, pairs: bool) -> Samples:
        """Samples on the triangles, or refined by a surface that does not move them.

        Args:
            sides: True to record `Cells.facing`.
            exits: True to record, at outlines, the sample where the ray leaves the part.
            pairs: True to record, at outlines, the surface's pairs of samples.
        """
        known, fragments, covered, decision, behind, between = self._drawn(self.shape.layers, exits)
        decision = decision or self._decided(covered, fragments, known)
        # All refined samples stay, also those amid one colour.
        kept, facing = decision.needed if self.surface.refines else decision.kept, None
        if sides:
            # Without hidden samples nothing reads the sides, and finding them takes long.
            pieces = checked_pieces(self.surface, known.proxy) if kept[1:].any() else np.zeros(1, np.int16)
            facing = facing_of(fragments, kept, known.proxy, pieces, self.camera, listed=self.cells is not None)
        if not self.surface.refines:
            lifted = lift(fragments, known.proxy, self.shape.capacity, kept, behind)
            told = triangles_of(fragments, lifted)
            return lifted.replace(facing=facing, settled=decision.settled, between=between, triangle=told)
        lifted = lift(fragments, known.proxy, None, kept)
        samples, rays = refined(
            self.surface, self.inputs, lifted, self.camera, self.tables, self.shape.view, self.cells
        )
        further = None
        if pairs:
            given = rays, steps_of(self.camera, self.shape.view), self.cells, self.shape.view, self.tables
            samples, further = with_pairs(samples, self.surface, self.inputs, *given)
        repacked = repack(samples, samples.row >= 0, self.shape.capacity, further, self.shape.more)
        return repacked.replace(facing=facing, between=between, triangle=triangles_of(fragments, repacked))

    def moved(self) -> Samples:
        """Samples that the surface moves off its triangles, with `ran_out`."""
        layers = self.shape.layers
        # There is only one set of tables, so that no samples can be added later.
        known, fragments, covered, *_, between = self._drawn(
            layers if self.tables else max(layers + 1, LEAST_LAYERS), False
        )
        samples = on_surface(
            self.surface,
            self.inputs,
            fragments,
            known.proxy,
            self.camera,
            layers,
            self.tables,
            self.shape.view,
            self.cells,
        )
        covers = kept = samples.row >= 0
        if self.hidden is not None:  # The rule comes last, since it goes by the final depths.
            kept = self.hidden.decide(Question(covers, samples.depth)).needed
        ran_out = np.count_nonzero(covered[-1] & ~covers[-1])
        repacked = repack(samples, kept, self.shape.capacity)
        return repacked.replace(ran_out=np.asarray(ran_out, np.int32), between=between)

    def _drawn(self, layers: int, exits: bool) -> _Drawn:
        """The triangles drawn into `layers` layers; with `exits`, also what lies behind outlines."""
        sampler, (camera, view) = self.sampler, (self.camera, self.shape.view)
        grid = layers, *self.shape.size

        def between(known: Entry, fragments: Fragments) -> np.ndarray | None:
            if not self.thin:
                return None
            found = sampler.between(known.prepared, camera, view, self.cull, fragments.depth[0])
            return np.zeros(self.shape.size, np.float32) if found is None else found

        def draw(known: Entry) -> _Drawn:
            if not (count := len(known.proxy.faces)):
                nowhere = Exits(np.empty((1, 0), np.int32), *_nothing((1, 1, 0))) if exits else None
                none = np.zeros(self.shape.size, np.float32) if self.thin else None
                return _Drawn(known, *_nothing(grid), None, nowhere, none)
            arguments = known.prepared, camera, view, layers
            if not exits:
                if self.cells is None:
                    fragments = sampler.rasterize(*arguments, self.cull)
                elif self.cells.ndim == 3:
                    fragments = sampler.rasterize_points(*arguments, self.cull, self.cells[0])
                    if fragments is None:
                        fragments = at_points(known.proxy, camera, view, layers, self.cull, self.cells[0])
                else:
                    fragments = sampler.rasterize_cells(*arguments, self.cull, self.cells)
                covered = check_fragments(fragments, grid, count, sampler)
                return _Drawn(known, fragments, covered, None, None, between(known, fragments))
            seen: list[tuple[Fragments, np.ndarray, Decision]] = []

            def beside(fragments: Fragments) -> np.ndarray:
                covered = check_fragments(fragments, grid, count, sampler)
                seen[:] = [(fragments, covered, self._decided(covered, fragments, known))]
                return beside_outlines(seen[0][2].needed)

            fragments, asked, backs = sampler.rasterize_exits(*arguments, beside)
            if not seen or fragments is not seen[0][0]:
                covered = check_fragments(fragments, grid, count, sampler)
                seen[:] = [(fragments, covered, self._decided(covered, fragments, known))]
            if asked.size:
                check_fragments(backs, (1, *asked.shape), count, sampler)
            return _Drawn(known, *seen[0], Exits.of(fragments, asked, backs), between(known, fragments))

        return sampler.working_on(self.surface, self.inputs, camera, view, self.entry, draw)

    def _decided(self, covered: np.ndarray, fragments: Fragments, known: Entry) -> Decision:
        """The decision on which fragments become samples; their depths must be final."""
        if self.hidden is None:
            return Decision(covered, None, covered)
        return self.hidden.decide(Question(covered, fragments.depth, self._size(known)))

    def _size(self, known: Entry) -> float:
        """The triangles' largest absolute coordinate; 0 if no rule needs it, or the rule has it in its own `size`."""
        if known.size is not None or self.hidden is None:
            return known.size or 0.0
        # The rule knows the size of vertices that are themselves in θ.
        read = self.hidden.size > 0 and any(np.may_share_memory(x, known.proxy.vertices) for x in leaves(self.inputs))
        return 0.0 if read else largest(known.proxy.vertices)


def _of_triangles(surface: Any) -> TriangleSurface:
    """The surface; an InputError refuses one without triangles."""
    if not isinstance(surface, TriangleSurface):
        raise InputError(
            f"{surface!r} has no triangles, which this sampler needs; use a sampler of its kind, such as 'rays'"
        )
    return surface


def _nothing(shape: tuple[int, int, int]) -> tuple[Fragments, np.ndarray]:
    """Empty fragments of a shape, and their covered cells: none."""
    return _no_fragments(shape), np.zeros(shape, np.bool_)


def _no_fragments(shape: tuple[int, int, int]) -> Fragments:
    return Fragments(np.full(shape, -1, np.int32), np.zeros((*shape, 2), np.float32), np.zeros(shape, np.float32))


def _held(x: Array) -> np.ndarray:
    """The value of an array, to be kept on the host; refused if it is traced."""
    value = value_of(x)
    if value is None or value.shape != shape_of(x):
        raise InputError(
            f"rts.prepare was given a traced array of shape {shape_of(x)}; expected known values: call it outside of "
            f"jit, vmap and other transforms, and give what changes to `replace`"
        )
    return value
