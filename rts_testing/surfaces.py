"""Checks that every surface must pass."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rts import GBuffer, Part, RaySurface, TriangleSurface, engine_of
from rts.plugin_api.arrays import Tree, map_leaves
from rts.plugin_api.records import Samples
from rts.tool_api.scenes import ATTRIBUTE_WIDTHS
from rts_testing import derivatives, scenes
from rts_testing.awkward_views import claim_awkward_views_are_finite, claim_unseen_is_nothing
from rts_testing.claims import claim, claim_close, claim_finite, no_error, refusal
from rts_testing.conformance import Conformance
from rts_testing.derivatives import DIFFERENTIABLE, claim_slope, differentiating, installed, joined, split
from rts_testing.motion_claims import claim_followed, claim_inputs_change
from rts_testing.normal_claims import claim_upright
from rts_testing.proxy_claims import claim_corners, claim_keys_tell_views, triangles_of
from rts_testing.refine_claims import (
    claim_compiled,
    claim_found_again,
    claim_found_from_behind,
    claim_misses_dropped,
    claim_refined,
)
from rts_testing.sample_claims import claim_ordered, claim_reprojected
from rts_testing.tessellation_claims import claim_rates, claim_tessellated

STEP = 1e-5


class SurfaceConformance(Conformance):
    """Checks of a surface.

    Override the fixture `part`: an `rts.Part` of it about the origin, within two units, whose θ holds NumPy arrays. To
    try another sampler than "auto" chooses, override `sampler`, too.
    """

    @pytest.fixture
    def part(self) -> Part:
        """The part to try: the surface, its θ, and a shader."""
        raise NotImplementedError("override the fixture 'part' with an rts.Part of your surface")

    @pytest.fixture
    def sampler(self) -> Any:
        """Name or object of a sampler that can sample it."""
        return "auto"

    # ------------------------------------------------------------------------------------------ samples

    def test_samples_lie_on_the_centres_of_their_pixels(self, part: Part, sampler: Any) -> None:
        """Samples, evaluated and projected, lie on their pixels' centres, at their depths: 97 % to 0.02 pixels."""
        for view, camera in scenes.VIEWS.items():
            claim_reprojected(part, scenes.find(part, camera, sampler), camera, view)

    def test_layers_are_front_to_back(self, part: Part, sampler: Any) -> None:
        """Layers of a pixel are sorted by depth, without gaps."""
        for view, camera in scenes.VIEWS.items():
            claim_ordered(scenes.find(part, camera, sampler), view)

    def test_refine_keeps_samples_on_their_rays(self, part: Part) -> None:
        """`refine` moves each sample along its ray onto the surface, with its depth, or sets `row` to −1."""
        surface = scenes.checked(part).surface
        if not (isinstance(surface, TriangleSurface) and surface.refines):
            pytest.skip("the surface has no refine")
        for view, camera in scenes.VIEWS.items():
            claim_refined(part, surface, camera, view)
        if surface.refine_moves:
            claim_misses_dropped(part, surface)

    def test_rays_from_before_a_hit_find_it(self, part: Part) -> None:
        """`intersect` from just before each hit finds that hit: a tracer that steps through the surface fails."""
        surface = scenes.checked(part).surface
        if not isinstance(surface, RaySurface):
            pytest.skip("the surface does not intersect rays itself")
        for view, camera in scenes.VIEWS.items():
            claim_found_again(part, surface, camera, view)

    def test_rays_from_behind_hit_the_same_places(self, part: Part) -> None:
        """`intersect` finds the same hits from either end of a ray."""
        surface = scenes.checked(part).surface
        if not isinstance(surface, RaySurface):
            pytest.skip("the surface does not intersect rays itself")
        for view, camera in scenes.VIEWS.items():
            claim_found_from_behind(part, surface, camera, view)

    @pytest.mark.parametrize("engine", DIFFERENTIABLE)
    def test_intersect_can_be_compiled(self, part: Part, engine: str) -> None:
        """`intersect` can be traced, as it looks at no values: rays of a compiled call hit where NumPy's do."""
        surface = scenes.checked(part).surface
        if not isinstance(surface, RaySurface):
            pytest.skip("the surface does not intersect rays itself")
        claim_compiled(part, surface, differentiating(engine))

    def test_two_renders_are_the_same(self, part: Part, sampler: Any) -> None:
        """Two renders agree to the last bit, despite others in between; changes of arrays in place are seen."""
        values, join = split(part.theta)
        other = part.replace(theta=join([0.9 * v for v in values]))
        first, different = (scenes.shown(p, sampler=sampler) for p in (part, other))
        again = scenes.shown(part, sampler=sampler)
        claim(np.array_equal(first, again), "the same part gives another image after another one was rendered")
        changing = [v.copy() for v in values]
        part = part.replace(theta=join(changing))
        scenes.shown(part, sampler=sampler)
        for v in changing:
            v *= 0.9
        same = np.array_equal(scenes.shown(part, sampler=sampler), different)
        claim(same, "a change in place of the arrays of θ is not seen; keep nothing by an array's identity")
        claim_reprojected(part, scenes.find(part, sampler=sampler), scenes.CAMERA, "after a change in place")

    # ----------------------------------------------------------------------------------------- evaluate

    def test_the_g_buffer_has_a_row_for_each_sample(self, part: Part, sampler: Any) -> None:
        """The G-buffer holds (N, C) finite numbers in θ's dtype, even in padding rows of zeros."""
        samples = map_leaves(derivatives.single, scenes.find(part, sampler=sampler).samples[0])
        widths, declared = (samples.ids.shape[1], samples.params.shape[1]), tuple(part.surface.sample_widths)
        claim(widths == declared, f"samples have ids and params of widths {widths}; sample_widths says {declared}")
        for kind, some in (("found", samples), ("padding", map_leaves(np.zeros_like, samples))):
            with no_error(f"evaluate of {kind} samples"):
                gbuffer = _evaluated(part, _single(part.theta), some)
            claim("position" in gbuffer, f"the G-buffer has {sorted(gbuffer)}; 'position' is missing")
            for name, value in gbuffer.items():
                expected = len(some.ids), ATTRIBUTE_WIDTHS.get(name, value.shape[-1])
                claim(value.shape == expected, f"{name!r} has shape {value.shape}; expected {expected}")
                claim(value.dtype == np.float32, f"{name!r} is {value.dtype} where θ is float32; expected float32")
                claim_finite(value, f"{name!r} of {kind} samples")

    def test_triangles_have_their_corners_on_the_surface(self, part: Part) -> None:
        """The `proxy`'s ids and parameters of a corner evaluate to that corner, also after θ has changed."""
        surface = triangles_of(part)
        values, join = split(part.theta)
        for scale, when in ((1.0, ""), (0.9, ", asked again with another θ (is something kept on the object?)")):
            theta = join([np.asarray(scale * v, v.dtype) for v in values])
            claim_corners(part.replace(theta=theta), surface, when)

    def test_triangles_depend_on_the_view_only_with_a_key(self, part: Part) -> None:
        """Triangles are the same in two views, unless `proxy_key` differs."""
        claim_keys_tell_views(part, triangles_of(part))

    def test_triangles_are_made_anew_for_every_array_that_moves_them(self, part: Part, sampler: Any) -> None:
        """`proxy_inputs` changes with each array of θ that moves the surface."""
        claim_inputs_change(part, triangles_of(part), sampler)

    def test_normals_stand_upright(self, part: Part, sampler: Any) -> None:
        """Normals, if any, are not zero; they are perpendicular to the surface, unless it consists of its triangles."""
        claim_upright(part, sampler)

    def test_the_surface_follows_theta(self, part: Part, sampler: Any) -> None:
        """Points at kept samples follow the surface as θ changes a little: at most 35 % of its motion is left."""
        claim_followed(part, sampler)

    def test_tessellate_gives_a_mesh_on_the_surface(self, part: Part, sampler: Any) -> None:
        """A mesh of the surface lies on it, has the rate's number of triangles, and is closer at a higher rate."""
        claim_tessellated(part, triangles_of(part), sampler)

    def test_rates_are_the_surface_coarser_or_finer(self, part: Part, sampler: Any) -> None:
        """Each of `rates` has a setting and an amount of work, and shows the surface; more work shows it better."""
        if not part.surface.rates(_single(part.theta)):
            pytest.skip("the surface has no rates")
        claim_rates(part, sampler)

    @pytest.mark.parametrize("engine", DIFFERENTIABLE)
    def test_evaluate_can_be_compiled(self, part: Part, sampler: Any, engine: str) -> None:
        """`evaluate` can be traced, as it reads no values of θ: positions of a compiled call are NumPy's, to 1e-5."""
        chosen, (values, join) = differentiating(engine), split(part.theta)
        sampled = scenes.frozen(part, sampler=sampler).samples[0]
        samples = derivatives.on(chosen, sampled)
        with no_error(f"evaluate compiled by {engine}"):
            evaluate = chosen.jit(lambda x: part.surface.evaluate(joined(chosen, join, x), samples)["position"])
            positions = chosen.to_numpy(evaluate(derivatives.on(chosen, values)))
        expected = _evaluated(part, _single(part.theta), sampled)["position"]
        claim_close(positions, expected, 1e-5, f"position compiled by {engine}")

    # -------------------------------------------------------------------------------------- derivatives

    @pytest.mark.parametrize("engine", DIFFERENTIABLE)
    def test_gradients_at_frozen_samples_are_finite_differences(self, part: Part, sampler: Any, engine: str) -> None:
        """Gradients of every entry of the G-buffer in every entry of θ agree with finite differences."""
        chosen, (values, join) = differentiating(engine), split(part.theta)
        values = [v.astype(np.float64) for v in values]
        sampled = scenes.frozen(part, sampler=sampler).samples[0]
        samples, at = derivatives.on(chosen, sampled), derivatives.on(chosen, values)
        rng = np.random.default_rng(0)
        for name, value in _evaluated(part, part.theta, sampled).items():
            weights = rng.standard_normal(value.shape) / np.sqrt(value.size)
            on_device = chosen.constant(derivatives.single(weights))

            def product(x: list, name: str = name, weights: Any = on_device) -> Any:
                entry = part.surface.evaluate(joined(chosen, join, x), samples)[name]
                return engine_of(entry).namespace.sum(entry * weights)

            gradient = derivatives.host(chosen, chosen.value_and_grad(product)(at)[1])
            for i, along in enumerate(derivatives.directions(values)):
                ends = []
                for step in (STEP, -STEP):
                    moved = [v + step * along if i == j else v for j, v in enumerate(values)]
                    ends.append(np.sum(_evaluated(part, join(moved), sampled)[name] * weights))
                what = f"the derivative of {name!r} in {derivatives.names(part.theta)[i]}, in {engine},"
                claim_slope(gradient[i], along, (ends[0] - ends[1]) / (2 * STEP), what)

    @pytest.mark.parametrize("engine", DIFFERENTIABLE)
    def test_forward_and_reverse_mode_agree(self, part: Part, sampler: Any, engine: str) -> None:
        """Forward and reverse mode agree on the whole G-buffer, weighted at random."""
        chosen, (values, join) = differentiating(engine), split(part.theta)
        samples = scenes.frozen(part, sampler=sampler).samples[0]
        rows = _evaluated(part, part.theta, samples)
        on_device, along = derivatives.on(chosen, samples), derivatives.directions(values)
        weights = np.random.default_rng(0).standard_normal((len(samples.ids), sum(x.shape[1] for x in rows.values())))

        def everything(x: list) -> Any:
            gbuffer = part.surface.evaluate(joined(chosen, join, x), on_device)
            return chosen.namespace.concat([gbuffer[name] for name in rows], axis=1)

        result = derivatives.derivatives(chosen, everything, values, along, weights)
        derivatives.claim_consistent(result, along, weights, f"the G-buffer ({', '.join(rows)}) in {engine}")

    def test_engines_agree(self, part: Part, sampler: Any) -> None:
        """Engines agree on image, gradient and derivative along a direction, at the same samples."""
        values, join = split(part.theta)
        sampled = scenes.frozen(part, sampler=sampler)

        def image(x: list) -> Any:
            return scenes.shown_at(sampled, part.replace(theta=join(x)))

        derivatives.claim_engines_agree(image, values, image([derivatives.single(v) for v in values]), "the image")

    def test_the_image_depends_on_the_surface(self, part: Part, sampler: Any) -> None:
        """The image of the silhouette has a gradient that is not zero in at least one entry of θ."""
        values, join = split(part.theta)
        sampled = scenes.frozen(part.replace(shader="silhouette"), sampler=sampler)
        weights = np.random.default_rng(0).random((*scenes.SIZE, 4))
        for engine in installed():

            def product(x: list, engine: Any = engine) -> Any:
                image = scenes.shown_at(sampled, part.replace(theta=join(x), shader="silhouette"))
                return engine.namespace.sum(image * engine.constant(derivatives.single(weights)))

            gradient = derivatives.host(engine, engine.value_and_grad(product)(derivatives.on(engine, values))[1])
            largest = max(np.abs(g).max(initial=0) for g in gradient)
            claim(largest > 1e-6, f"in {engine.name} the silhouette has no gradient in θ; is something detached?")

    # ------------------------------------------------------------------------------------ unusual input

    @pytest.mark.parametrize("engine", DIFFERENTIABLE)
    def test_unseen_it_gives_nothing_and_no_gradient(self, part: Part, sampler: Any, engine: str) -> None:
        """A part behind the camera or beside the image gives an empty image, and a gradient of zero."""
        claim_unseen_is_nothing(part, sampler, differentiating(engine))

    @pytest.mark.parametrize("engine", DIFFERENTIABLE)
    def test_awkward_views_are_finite(self, part: Part, sampler: Any, engine: str) -> None:
        """Views from inside, cut by the near plane and along the axes have a finite image and gradient."""
        claim_awkward_views_are_finite(part, sampler, differentiating(engine))

    def test_wrong_theta_is_refused_in_one_line(self, part: Part, sampler: Any) -> None:
        """An empty θ, or an entry of a wrong shape, raises an `rts.RtsError` of one line; a missing entry may."""
        reads = scenes.checked(part).surface.reads(part.theta)
        part = part.replace(shader="silhouette")

        def refused(theta: Tree, what: str) -> str | None:
            return refusal(lambda: scenes.shown(part.replace(theta=theta), sampler=sampler), what)

        claim(not reads or refused({}, "an empty theta"), "an empty theta is accepted")
        for name in reads:
            refused({k: v for k, v in part.theta.items() if k != name}, f"theta without {name!r}")
            wrong = map_leaves(lambda _: np.zeros((2, 1, 3, 1, 2), np.float32), part.theta[name])
            what = f"theta[{name!r}] of shape (2, 1, 3, 1, 2)"
            claim(refused({**part.theta, name: wrong}, what), f"{what} is accepted")


def _single(theta: Tree) -> Tree:
    return map_leaves(derivatives.single, theta)


def _evaluated(part: Part, theta: Tree, samples: Samples) -> dict[str, np.ndarray]:
    """Every entry of the G-buffer, deferred ones too."""
    result = part.surface.evaluate(theta, samples)
    gbuffer = result if isinstance(result, GBuffer) else GBuffer(result)
    return {name: np.asarray(gbuffer[name]) for name in list(gbuffer)}
