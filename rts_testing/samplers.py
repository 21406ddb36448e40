"""Checks that every sampler must pass."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rts import Camera, GBuffer, Part, Surface, prepare, sample
from rts.plugin_api.arrays import Tree, leaves, map_leaves
from rts.plugin_api.records import Request
from rts.results import Sampled
from rts.tool_api.plugins import check_sampler
from rts_testing import derivatives, scenes
from rts_testing.awkward_views import claim_awkward_views_are_finite, claim_unseen_is_nothing
from rts_testing.claims import claim, no_error, refusal
from rts_testing.compatibility import BORDER
from rts_testing.conformance import Conformance
from rts_testing.derivatives import DIFFERENTIABLE, ENGINES, differentiating, engine_or_skip, joined, split
from rts_testing.expected_samples import Silhouettes, again, claim_like, differing, is_of_triangles, reference, right
from rts_testing.sample_claims import claim_empty_where_empty, claim_ordered, claim_reprojected

SCALES = 1, 0.9, 0.8, 0.7, 0.8
"""Factors of θ in successive calls: more than the cache keeps (`rts.sampling.cache.KEPT`), then one that it keeps."""


class Elsewhere(Surface):
    """A surface that no sampler can sample: it has neither triangles nor `intersect`."""

    sample_widths = (0, 2)

    def __repr__(self) -> str:
        return "Elsewhere()"

    def evaluate(self, theta: Any, samples: Any) -> GBuffer:
        """The origin, for any sample."""
        return GBuffer(position=theta["center"] + 0 * samples.params[:, :1])


class SamplerConformance(Conformance):
    """Checks of a sampler.

    Override the fixture `sampler`: the name of one, or an object. For a sampler of surfaces that are not triangles,
    override `parts`, too: a list of parts about the origin, within two units, whose θ holds NumPy arrays.
    """

    @pytest.fixture
    def sampler(self) -> Any:
        """Name or object of the sampler."""
        raise NotImplementedError("override the fixture 'sampler' with the sampler, or its name")

    @pytest.fixture
    def parts(self) -> list[Part]:
        """The parts to sample: triangles that are closed, culled, moved, and piled at random."""
        turned = np.array([(0.8, 0, 0.6, 0.1), (0, 1.2, 0, -0.1), (-0.6, 0, 0.8, 0.2), (0, 0, 0, 1)], np.float32)
        return [scenes.ball(), scenes.ball(cull="back", transform=turned), scenes.soup()]

    # ---------------------------------------------------------------------------------------- geometry

    def test_samples_lie_on_the_centres_of_their_pixels(self, sampler: Any, parts: list[Part]) -> None:
        """Samples, evaluated and projected, lie on their pixels' centres, at their depths: 97 % to 0.02 pixels."""
        for view, camera, part in _scenes(parts):
            claim_reprojected(part, scenes.find(part, camera, sampler, layers=3), camera, view)

    def test_it_agrees_with_the_reference(self, sampler: Any, parts: list[Part]) -> None:
        """Triangles are those of `reference`; at silhouettes at most one pixel in a hundred differs."""
        triangles = [p for p in parts if is_of_triangles(p)]
        if not triangles:
            pytest.skip("no triangles to compare with the reference")
        silhouettes = Silhouettes()
        for view, camera, part in _scenes(triangles):
            for layers in (1, 3):
                sampled = scenes.find(part, camera, sampler, layers=layers)
                silhouettes += claim_like(sampled, reference(part, camera, layers), f"{view}, {layers} layers")
        silhouettes.claim_few("")

    def test_layers_are_front_to_back(self, sampler: Any, parts: list[Part]) -> None:
        """Layers of a pixel are sorted by depth, without gaps; a single layer is the first of three."""
        for view, camera, part in _scenes(parts):
            one, three = (scenes.find(part, camera, sampler, layers=k) for k in (1, 3))
            claim_ordered(three, view)
            first = np.asarray(three.depth)[:1]
            claim(np.allclose(one.depth, first, rtol=1e-6), f"{view}: one layer is not the first of three")

    def test_background_is_empty(self, sampler: Any, parts: list[Part]) -> None:
        """Empty cells have `row` −1, depth 0 and image 0; no row appears twice."""
        for view, camera, part in _scenes(parts):
            sampled = scenes.find(part, camera, sampler)
            claim_empty_where_empty(sampled, view)
            image = scenes.render(part, camera, scenes.SIZE, sampler=sampler, splatter="none")
            empty = np.asarray(sampled.row)[0, BORDER:-BORDER, BORDER:-BORDER] < 0
            claim((image[empty] == 0).all(), f"{view}: the image is not zero where nothing is seen")

    def test_samples_lie_between_the_near_and_the_far_plane(self, sampler: Any, parts: list[Part]) -> None:
        """Nothing is seen nearer than the near plane or beyond the far plane."""
        near, far = 3.4, 4.2
        for part in parts:
            sampled = scenes.find(part, scenes.NEAR, sampler, layers=3)
            depth = np.asarray(sampled.depth)[np.asarray(sampled.row) >= 0]
            claim(len(depth), "nothing is seen of a part that both planes cut")
            ok = (depth >= near * (1 - 1e-5)) & (depth <= far * (1 + 1e-5))
            claim(ok.all(), f"depths from {depth.min():.5g} to {depth.max():.5g}; the planes are at {near} and {far}")

    # -------------------------------------------------------------------------------------- the contract

    def test_two_calls_give_the_same(self, sampler: Any, parts: list[Part]) -> None:
        """Two calls agree to the last bit; parts with new θ, sampled in between, are right; results stay."""
        scaled_parts = [_scaled(part, 0.9) for part in parts]
        expected = [right(part, scenes.AXES[2], sampler) for part in scaled_parts]
        silhouettes = Silhouettes()
        for view, camera, part in _scenes(parts):
            first = scenes.find(part, camera, sampler)
            for i, (other, like) in enumerate(zip(scaled_parts, expected, strict=True)):
                sampled = scenes.find(other, scenes.AXES[2], sampler)
                silhouettes += claim_like(sampled, like, f"part {i} with new arrays in θ, after {view}")
            _claim_same(scenes.find(part, camera, sampler), first, view)
        silhouettes.claim_few("with new arrays in θ, ")
        chosen, part, request = check_sampler(sampler), scenes.checked(parts[0]), Request(triangles=True)
        found = chosen.sample(part, scenes.CAMERA, scenes.SIZE, scenes.LAYERS, request)
        kept = map_leaves(np.array, found)
        chosen.sample(part, scenes.AXES[2], scenes.SIZE, scenes.LAYERS, request)
        _claim_same(found, kept, "samples", "a later call has changed their arrays; give new ones each time")

    def test_prepared_parts_are_sampled_alike(self, sampler: Any, parts: list[Part]) -> None:
        """Data that `rts.prepare` builds once for a part give the right samples, wherever the part is moved."""
        turn = np.array([(0, -1, 0, 0), (1, 0, 0, 0), (0, 0, 1, 0.1), (0, 0, 0, 1)], np.float32)
        silhouettes = Silhouettes()
        for index, part in enumerate(parts):
            held = prepare(part, sampler, camera=scenes.CAMERA, size=scenes.SIZE)
            for moved in (part, part.replace(transform=turn)):
                moved_parts, whole = (
                    held.replace(transform=moved.transform),
                    {"splatter": None, "layers": scenes.LAYERS},
                )
                sampled = sample(moved_parts, scenes.CAMERA, scenes.SIZE, **whole)
                silhouettes += claim_like(sampled, right(moved, scenes.CAMERA, sampler), f"part {index}, prepared")
        silhouettes.claim_few("prepared, ")

    def test_it_follows_theta(self, sampler: Any, parts: list[Part]) -> None:
        """Several θ in turn on one surface, more than the cache keeps and one that it keeps, are sampled right."""
        silhouettes = Silhouettes()
        for i, part in enumerate(parts):
            for call, scale in enumerate(SCALES):
                moved = _scaled(part, scale)
                sampled = scenes.find(moved, sampler=sampler)
                what = f"part {i}, call {call + 1} on one surface, each with another θ (is `update` right?)"
                silhouettes += claim_like(sampled, right(moved, scenes.CAMERA, sampler), what)
        silhouettes.claim_few("with one θ after another, ")

    def test_it_sees_arrays_that_change_in_place(self, sampler: Any, parts: list[Part]) -> None:
        """A change of arrays in place is seen: the cache compares values, not identity."""
        for i, part in enumerate(parts):
            values, join = split(part.theta)
            changing = [v.copy() for v in values]
            changed = part.replace(theta=join(changing))
            before = scenes.find(changed, sampler=sampler)
            for v in changing:
                v *= 0.9
            expected = again(part.replace(theta=join([v.copy() for v in changing])), scenes.CAMERA, sampler)
            sampled = scenes.find(changed, sampler=sampler)
            if differing(sampled, expected.sampled).any():
                stale = not differing(sampled, before).any()
                claim(not stale, "a change in place of the arrays of θ is not seen; keep what is built by their values")
                claim_like(sampled, expected, f"part {i}, after a change in place of the arrays of θ").claim_few("")

    def test_capacity_drops_the_deepest_layers_first(self, sampler: Any, parts: list[Part]) -> None:
        """`capacity` is the exact number of rows; the deepest layers are dropped first, and counted."""
        part = parts[0]
        everything = np.asarray(scenes.find(part, sampler=sampler).row)
        hits, front = (everything >= 0).sum(), (everything[0] >= 0).sum()
        capacity = int((hits + front) // 2)
        sampled = scenes.find(part, sampler=sampler, capacity=capacity)
        samples, row = sampled.samples[0], np.asarray(sampled.row)
        rows = len(samples.ids), len(samples.params)
        claim(rows == (capacity, capacity), f"{rows} rows of ids and params; the capacity is {capacity}")
        dropped = int(sampled.overflow)
        claim(dropped == hits - capacity, f"overflow is {dropped}; {hits - capacity} were dropped")
        claim((row >= 0).sum() == capacity, f"{(row >= 0).sum()} cells have samples; the capacity is {capacity}")
        claim((row[0] >= 0).sum() == front, "samples of the front layer were dropped before those behind")

    def test_points_are_sampled_as_centres_are(self, sampler: Any, parts: list[Part]) -> None:
        """A sampler that follows `Request.points` finds at centres what it finds there in the grid, in all layers.

        At other points it finds what it would find at the centres of an image moved by as much.
        """
        chosen, (height, width) = check_sampler(sampler), scenes.SIZE
        y, x = np.divmod(np.random.default_rng(0).permutation(height * width)[: height * width // 3], width)
        y, x = np.append(y, y[:1]), np.append(x, x[:1])  # One of them twice.
        for index, part in enumerate(map(scenes.checked, parts)):
            for move, layers in (((0.0, 0.0), 3), ((0.3, -0.21), 2)):
                camera = scenes.CAMERA.for_size(scenes.SIZE).within(part.transform)
                centred = scenes.shifted(scenes.shifted(camera, -move[0], 0), move[1], 1)
                request = Request(points=np.column_stack([x, y]) + 0.5 + move, triangles=True)
                found = chosen.sample(part, camera, scenes.SIZE, layers, request)
                if not found.at_points:
                    pytest.skip("the sampler samples whole grids")
                whole = chosen.sample(part, centred, scenes.SIZE, layers, Request(triangles=True))
                row, depth = np.asarray(whole.row)[:, y, x], np.asarray(whole.depth)[:, y, x]
                claim(found.row.shape == (layers, 1, len(x)), f"part {index}: row has shape {found.row.shape}")
                seen, deep = np.asarray(found.row)[:, 0] >= 0, np.asarray(found.depth)[:, 0]
                # On an edge rounding decides, and a surface may have other triangles for another view.
                same = seen == (row >= 0)
                claim(same.mean() >= 0.995, f"part {index}: {np.sum(~same)} points are covered, or not, unlike centres")
                near = np.abs(deep - depth) <= (1e-3 if any(move) else 1e-5) * np.abs(depth)
                claim((near | ~same | ~seen).mean() >= 0.995, f"part {index}: depths are not those of centres")
                if not any(move) and found.triangle is not None:
                    alike = np.asarray(found.triangle)[:, 0] == np.asarray(whole.triangle)[:, y, x]
                    claim(alike.mean() >= 0.995, f"part {index}: {np.sum(~alike)} triangles are not those of centres")

    def test_triangles_are_told_where_it_says_so(self, sampler: Any, parts: list[Part]) -> None:
        """`Cells.triangle`, if a sampler records it, names the triangles whose corners samples have as ids, or −1."""
        chosen, part = check_sampler(sampler), scenes.checked(parts[0])
        found = chosen.sample(part, scenes.CAMERA, scenes.SIZE, 2, Request(triangles=True))
        if found.triangle is None:
            pytest.skip("the sampler tells no triangles")
        row, triangle = np.asarray(found.row), np.asarray(found.triangle)
        claim(triangle.shape == row.shape, f"triangle has shape {triangle.shape}; expected {row.shape}")
        claim(((triangle >= 0) == (row >= 0)).all(), "triangle is not −1 where there is no sample")
        surface: Any = part.surface
        ids = surface.proxy(surface.proxy_inputs(part.theta), scenes.CAMERA, scenes.SIZE).faces[triangle[row >= 0]]
        same = np.array_equal(np.asarray(found.ids)[row[row >= 0]], ids)
        claim(same or surface.refines, "samples do not lie on the triangles that are told")

    def test_what_it_cannot_sample_is_refused_in_one_line(self, sampler: Any) -> None:
        """A surface with neither triangles nor `intersect` raises an `rts.RtsError` of one line."""
        part = Part(Elsewhere(), {"center": np.zeros(3, np.float32)})
        what = "a surface without triangles and intersection"
        claim(refusal(lambda: scenes.find(part, sampler=sampler), what), f"{what} is accepted")

    # ------------------------------------------------------------------------------------------- engines

    @pytest.mark.parametrize("engine", ENGINES)
    def test_every_engine_finds_the_same_samples(self, sampler: Any, parts: list[Part], engine: str) -> None:
        """Every engine finds NumPy's samples in 99 % of the cells, inside a compiled function, too."""
        chosen = engine_or_skip(engine)
        for part in parts[:2]:
            values, join = split(part.theta)
            expected = scenes.frozen(part, sampler=sampler)

            def sampled(x: list, part: Part = part, join: Any = join) -> Sampled:
                theta = joined(chosen, join, x)
                return scenes.find(part.replace(theta=theta), sampler=sampler, capacity=scenes.CAPACITY)

            at = derivatives.on(chosen, values)
            for how, f in (("", sampled), (", compiled", chosen.jit(sampled))):
                with no_error(f"sampling in {engine}{how}"):
                    result = derivatives.host(chosen, f(at))
                claim(result.row.shape == expected.row.shape, f"in {engine}{how}, row has shape {result.row.shape}")
                same = (result.row >= 0) == (expected.row >= 0)
                same &= np.abs(result.depth - expected.depth) <= 1e-4 * expected.depth
                claim(same.mean() >= 0.99, f"in {engine}{how}, {np.sum(~same)} of {same.size} cells are not NumPy's")

    def test_engines_agree(self, sampler: Any, parts: list[Part]) -> None:
        """Engines agree on image, gradient and derivative along a direction, each at the samples that it finds."""
        part = parts[0]
        values, join = split(part.theta)

        def image(x: list) -> Any:
            return scenes.shown(part.replace(theta=join(x)), sampler=sampler)

        expected = image([derivatives.single(v) for v in values])
        derivatives.claim_engines_agree(image, values, expected, "the image", derivatives.derivatives)

    @pytest.mark.parametrize("engine", DIFFERENTIABLE)
    def test_samples_carry_no_derivative(self, sampler: Any, parts: list[Part], engine: str) -> None:
        """Parameters and depths of samples are constants, though θ is not."""
        chosen, (values, join) = differentiating(engine), split(parts[0].theta)
        xp = chosen.namespace

        def total(x: list) -> Any:
            part = parts[0].replace(theta=joined(chosen, join, x))
            samples = scenes.find(part, sampler=sampler, capacity=scenes.CAPACITY).samples[0]
            return xp.sum(samples.params) + xp.sum(samples.depth)

        gradient = derivatives.host(chosen, chosen.value_and_grad(total)(derivatives.on(chosen, values))[1])
        claim(all((g == 0).all() for g in gradient), f"in {engine}, samples have a gradient in θ; stop it")

    # ------------------------------------------------------------------------------------ unusual scenes

    @pytest.mark.parametrize("engine", DIFFERENTIABLE)
    def test_unseen_parts_give_nothing_and_no_gradient(self, sampler: Any, parts: list[Part], engine: str) -> None:
        """A part behind the camera or beside the image gives an empty image, and a gradient of zero."""
        for part in parts[:1]:
            claim_unseen_is_nothing(part, sampler, differentiating(engine))

    @pytest.mark.parametrize("engine", DIFFERENTIABLE)
    def test_awkward_views_are_finite(self, sampler: Any, parts: list[Part], engine: str) -> None:
        """Views from inside, cut by the near plane and edge-on have a finite image and gradient."""
        triangles = [scenes.flat()] if is_of_triangles(parts[0]) else []
        for part in [parts[0], *triangles]:
            claim_awkward_views_are_finite(part, sampler, differentiating(engine))


def _scaled(part: Part, scale: float) -> Part:
    """The part with θ times a factor, in new arrays."""
    values, join = split(part.theta)
    return part.replace(theta=join([(scale * v).astype(v.dtype) for v in values]))


def _scenes(parts: list[Part]) -> list[tuple[str, Camera, Part]]:
    return [(f"part {i}, {view}", c, p) for i, p in enumerate(parts) for view, c in scenes.VIEWS.items()]


def _claim_same(
    actual: Tree, expected: Tree, view: str, fault: str = "the same call gives other samples after another one"
) -> None:
    pairs = zip(leaves(actual), leaves(expected), strict=True)
    claim(all(np.array_equal(a, b) for a, b in pairs), f"{view}: {fault}")
