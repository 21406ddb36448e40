"""Checks that every shader must pass."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from rts import Engine, GBuffer, Shader, engine_of
from rts.plugin_api.arrays import Tree, constants, map_leaves
from rts.tool_api.plugins import check_shader, promised
from rts.tool_api.scenes import RowCameras
from rts_testing import derivatives, scenes
from rts_testing.claims import claim, claim_close, claim_finite, no_error, refusal
from rts_testing.conformance import Conformance
from rts_testing.derivatives import DIFFERENTIABLE, differentiating, names, split
from rts_testing.shadow_claims import claim_shadows_dim

ROWS = 64
STEP = 1e-6
TOLERANCE = 1e-5


class ShaderConformance(Conformance):
    """Checks of a shader.

    Override the fixture `shader`: its name, an object or a function; `theta` if it reads entries of θ; and `gbuffer` if
    it reads entries other than position, normal, uv, tangent and color.
    """

    @pytest.fixture
    def shader(self) -> Any:
        """Name or object of the shader."""
        raise NotImplementedError("override the fixture 'shader' with the shader, or its name")

    @pytest.fixture
    def theta(self) -> Tree:
        """The entries of θ that it reads; NumPy arrays."""
        return {}

    @pytest.fixture
    def gbuffer(self) -> dict[str, np.ndarray]:
        """Entries of the G-buffer, (64, C) float32 each, in world space about the origin."""
        return random_gbuffer()

    # ------------------------------------------------------------------------------------------- values

    def test_it_gives_a_premultiplied_color_for_each_sample(self, shader: Any, theta: Tree, gbuffer: dict) -> None:
        """Colours are (N, 4) in the G-buffer's dtype: alpha from 0 to 1, colours from 0 on, and 0 where alpha is.

        A shader with other `channels` gives (N, C + 1), and numbers below 0, too.
        """
        rgba = _shaded(shader, theta, gbuffer)
        expected = ROWS, _instance(shader).channels + 1
        claim(rgba.shape == expected, f"the shader returned {rgba.shape}; expected {expected}")
        claim(rgba.dtype == np.float32, f"the shader returned {rgba.dtype} for float32; expected float32")
        alpha, least = rgba[:, -1], rgba[:, :-1].min()
        low, high = alpha.min(), alpha.max()
        claim(low >= -TOLERANCE and high <= 1 + TOLERANCE, f"alpha runs from {low:.3g} to {high:.3g}; expected 0 to 1")
        claim(expected[1] != 4 or least >= -TOLERANCE, f"a colour is {least:.3g}; expected none below 0")
        if gbuffer.get("color", rgba[:, :3]).shape[1] == 4:
            clear = {**gbuffer, "color": gbuffer["color"] * np.array([1, 1, 1, 0], np.float32)}
            rgba = _shaded(shader, theta, clear)
            seen = np.abs(rgba[rgba[:, -1] == 0, :-1]).max(initial=0)
            claim(seen <= TOLERANCE, f"a colour is {seen:.3g} where alpha is 0; multiply colours by alpha")

    def test_samples_are_shaded_one_by_one(self, shader: Any, theta: Tree, gbuffer: dict) -> None:
        """A sample's colour depends neither on the order of samples nor on the other samples."""
        rgba = _shaded(shader, theta, gbuffer)
        order = np.random.default_rng(1).permutation(ROWS)
        permuted = _shaded(shader, theta, {name: value[order] for name, value in gbuffer.items()})
        claim_close(permuted, rgba[order], TOLERANCE, "the colour of permuted samples")
        for half in (slice(0, ROWS // 2), slice(ROWS // 2, ROWS)):
            alone = _shaded(shader, theta, {name: value[half] for name, value in gbuffer.items()})
            claim_close(alone, rgba[half], TOLERANCE, "the colour of samples shaded without the others")

    def test_lengths_of_directions_have_no_effect(self, shader: Any, theta: Tree, gbuffer: dict) -> None:
        """Colours do not depend on the lengths of normals, or of the direction in θ["light"]."""
        rgba = _shaded(shader, theta, gbuffer)
        if "normal" in gbuffer:
            lengths = np.random.default_rng(2).uniform(0.25, 4, (ROWS, 1)).astype(np.float32)
            other = _shaded(shader, theta, {**gbuffer, "normal": lengths * gbuffer["normal"]})
            claim_close(
                other,
                rgba,
                TOLERANCE,
                "the colour with normals of other lengths (see `unit` of rts.plugin_api.arrays)",
            )
        light = theta.get("light")
        if isinstance(light, Mapping) and "direction" in light:
            longer = {**theta, "light": {**light, "direction": 3 * np.asarray(light["direction"])}}
            other = _shaded(shader, longer, gbuffer)
            claim_close(other, rgba, TOLERANCE, "the colour with a light's direction three times as long")

    def test_opaque_is_true(self, shader: Any, theta: Tree, gbuffer: dict) -> None:
        """A shader that promises to be opaque has alpha 1, exactly."""
        if not _instance(shader).opaque:
            pytest.skip("the shader does not promise to be opaque")
        alpha = _shaded(shader, theta, gbuffer)[:, -1]
        claim((alpha == 1).all(), f"the shader promises to be opaque; alpha is {alpha.min():.3g} somewhere")

    def test_uniform_is_one_color(self, shader: Any, theta: Tree, gbuffer: dict) -> None:
        """A shader that promises to be uniform gives all samples one colour, through any camera."""
        instance, theta = _instance(shader), map_leaves(derivatives.single, theta)
        if not promised(instance, "uniform"):
            pytest.skip("the shader does not promise one colour")
        first = np.asarray(instance(theta, GBuffer(gbuffer), scenes.CAMERA))[:1]
        for view, camera in scenes.VIEWS.items():
            with no_error(f"shading from {view}"):
                rgba = np.asarray(instance(theta, GBuffer(gbuffer), camera))
            claim((rgba == first).all(), f"the shader promises one colour; from {view} there are others")

    def test_it_reads_what_it_says(self, shader: Any, theta: Tree, gbuffer: dict) -> None:
        """Colours need only position and the entries that `reads` names, of the G-buffer and of θ."""
        reads = promised(_instance(shader), "reads")
        if reads is None:
            pytest.skip("the shader does not say what it reads")
        fewer = {name: value for name, value in gbuffer.items() if name in ("position", *reads)}
        few = {name: value for name, value in theta.items() if name in reads}
        with no_error(f"shading with position, {', '.join(reads)} only, as `reads` says"):
            colors = _shaded(shader, few, fewer)
        claim_close(colors, _shaded(shader, theta, gbuffer), 0, "the colour without what is not in `reads`")

    def test_samples_of_several_views_are_shaded_as_by_each(self, shader: Any, theta: Tree, gbuffer: dict) -> None:
        """A shader that takes samples of several views gives each the colour seen by its own camera."""
        instance: Any = _instance(shader)
        if not promised(instance, "takes_views"):
            pytest.skip("the shader does not take samples of several views")
        claim(
            promised(instance, "reads") is not None,
            "the shader takes samples of several views; expected it to say what it `reads`, too",
        )
        cameras, single = [scenes.CAMERA, scenes.NEAR], map_leaves(derivatives.single, theta)
        number = np.repeat(np.array([1, 2], np.int32), [ROWS // 4, ROWS - ROWS // 4])
        with no_error("shading samples of two views with RowCameras"):
            colors = instance(single, GBuffer(gbuffer), RowCameras.of(cameras, number))
        first, second = (np.asarray(instance(single, GBuffer(gbuffer), camera)) for camera in cameras)
        expected = np.where(number[:, None] == 1, first, second)
        claim_close(colors, expected, TOLERANCE, "the colour of samples of two views")

    # -------------------------------------------------------------------------------------- derivatives

    def test_engines_agree(self, shader: Any, theta: Tree, gbuffer: dict) -> None:
        """Engines agree on colours, gradient and derivative along a direction, in θ and the G-buffer."""
        values, join = split({"theta": theta, "gbuffer": gbuffer})

        def f(x: list) -> Any:
            return _call(shader, join(x), None)

        expected = f([derivatives.single(v) for v in values])
        derivatives.claim_engines_agree(f, values, expected, "the colour")

    @pytest.mark.parametrize("engine", DIFFERENTIABLE)
    def test_gradients_are_finite_differences(self, shader: Any, theta: Tree, gbuffer: dict, engine: str) -> None:
        """The gradient in every entry of θ agrees with finite differences."""
        chosen, (values, join) = differentiating(engine), split(theta)
        values = [v.astype(np.float64) for v in values]
        if not values:
            pytest.skip("the shader is given no θ")
        weights = np.random.default_rng(0).standard_normal((ROWS, _instance(shader).channels + 1))
        wide = map_leaves(lambda x: np.asarray(x, np.float64), gbuffer)

        def value(x: list) -> float:
            return float(np.sum(_call(shader, {"theta": join(x), "gbuffer": wide}, None) * weights))

        on_device = derivatives.on(chosen, (gbuffer, weights))

        def product(x: list) -> Any:
            rgba = _call(shader, {"theta": join(x), "gbuffer": on_device[0]}, chosen)
            return chosen.namespace.sum(rgba * on_device[1])

        gradient = derivatives.host(chosen, chosen.value_and_grad(product)(derivatives.on(chosen, values))[1])
        for i, along in enumerate(derivatives.directions(values)):
            ends = []
            for step in (STEP, -STEP):
                ends.append(value([v + step * along if i == j else v for j, v in enumerate(values)]))
            what = f"the derivative of the colour in {names(theta)[i]}, in {engine},"
            derivatives.claim_slope(gradient[i], along, (ends[0] - ends[1]) / (2 * STEP), what, exact=1e-3)

    @pytest.mark.parametrize("engine", DIFFERENTIABLE)
    def test_awkward_samples_have_finite_gradients(self, shader: Any, theta: Tree, gbuffer: dict, engine: str) -> None:
        """Gradients are finite: normals of zero, edge-on or from behind, uv far outside, black, at the camera."""
        chosen = differentiating(engine)
        values, join = split({"theta": theta, "gbuffer": awkward(gbuffer)})

        def f(x: list) -> Any:
            return _call(shader, join(x), chosen)

        ones = np.ones((ROWS, _instance(shader).channels + 1))
        result = derivatives.derivatives(chosen, f, values, derivatives.directions(values), ones)
        claim_finite(result, f"in {engine}, the colour of awkward samples or its derivative")

    def test_shadows_dim_what_lights_add(self, shader: Any, theta: Tree, gbuffer: dict) -> None:
        """θ["light"]["shadow"] multiplies what each light adds by the visibility of samples, and so its derivative."""

        def shaded(inputs: dict, at: Any, engine: Engine | None) -> Any:
            """The colours at positions, for entries of θ."""
            singles = {"theta": map_leaves(derivatives.single, inputs), "gbuffer": {**gbuffer, "position": at}}
            return _call(shader, singles, engine)

        claim_shadows_dim(shaded, theta, gbuffer["position"])

    # ------------------------------------------------------------------------------------------- errors

    def test_what_is_missing_is_refused_in_one_line(self, shader: Any, theta: Tree, gbuffer: dict) -> None:
        """A shader without an entry of θ or the G-buffer works, or raises an `rts.RtsError` of one line."""
        for name in theta:
            fewer = {k: v for k, v in theta.items() if k != name}
            refusal(lambda fewer=fewer: _shaded(shader, fewer, gbuffer), f"theta without {name!r}")
        for name in sorted(set(gbuffer) - {"position"}):
            without = {k: v for k, v in gbuffer.items() if k != name}
            refusal(lambda without=without: _shaded(shader, theta, without), f"a G-buffer without {name!r}")


def random_gbuffer() -> dict[str, np.ndarray]:
    """Usual entries of the G-buffer, at random points about the origin."""
    rng = np.random.default_rng(0)
    normal = rng.standard_normal((ROWS, 3))
    gbuffer = {
        "position": rng.uniform(-0.8, 0.8, (ROWS, 3)),
        "normal": normal / np.linalg.norm(normal, axis=1, keepdims=True),
        "uv": rng.uniform(0.02, 0.98, (ROWS, 2)),
        "color": rng.uniform(0, 1, (ROWS, 4)),
    }
    across = np.cross(normal, rng.standard_normal((ROWS, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    gbuffer["tangent"] = np.concatenate([across, np.sign(rng.standard_normal((ROWS, 1)))], axis=1)
    return {name: value.astype(np.float32) for name, value in gbuffer.items()}


def awkward(gbuffer: dict) -> dict:
    """A copy of a G-buffer with rows on which careless arithmetic divides by zero."""
    gbuffer = {name: value.copy() for name, value in gbuffer.items()}
    eye = np.linalg.inv(scenes.CAMERA.view.astype(np.float64))[:3, 3]
    gbuffer["position"][5] = eye
    if "normal" in gbuffer:
        toward = eye - gbuffer["position"]
        gbuffer["normal"][:10] = 0
        gbuffer["normal"][10:20] = np.cross(toward[10:20], [0.0, 1.0, 0.0])
        gbuffer["normal"][20:25] = -toward[20:25]
    if "uv" in gbuffer:
        gbuffer["uv"][25:30] = [-1e4, 1e4]
        gbuffer["uv"][30:32] = 1.0
    for name, value in gbuffer.items():
        if name not in ("position", "normal", "uv"):
            value[35:40] = 0
    return gbuffer


def _instance(shader: Any) -> Shader:
    return check_shader(shader, "the shader")


def _call(shader: Any, inputs: dict, engine: Engine | None) -> Any:
    """The colours for {"theta": …, "gbuffer": …}, with constants of the engine."""
    engine = engine or engine_of(inputs)
    inputs, camera = constants((inputs, scenes.CAMERA), engine, None)
    return _instance(shader)(inputs["theta"], GBuffer(inputs["gbuffer"]), camera)


def _shaded(shader: Any, theta: Tree, gbuffer: dict) -> np.ndarray:
    single = map_leaves(derivatives.single, theta)
    return np.asarray(_call(shader, {"theta": single, "gbuffer": gbuffer}, None))
