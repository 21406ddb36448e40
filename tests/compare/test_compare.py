"""`rts_compare.compare` and `rts.tune`: truth, errors, times, what is kept of them, and the command line."""

import json
import math
import random
import sys
import time
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from helpers import quad, refused
from hypothesis import given
from hypothesis import strategies as st

import rts
from rts import registry
from rts.arrays.engines import engine_named
from rts.errors import InputError, PluginError, ToleranceWarning
from rts.registry import plugin
from rts_compare import compare, compared_settings, interleaved_timing, measurements, true_derivatives
from rts_compare.commands import summary
from rts_compare.compared_settings import Setting, _no_worse, engines, worth_timing
from rts_compare.comparison import Comparison
from rts_compare.derivative_scores import loss_weights, scores
from rts_compare.kept_measurements import KeptMeasurements
from rts_compare.moving_scenes import moving
from rts_compare.settings_search import Search
from rts_compare.skip_reasons import limited
from rts_compare.tuning import tune

pytestmark = pytest.mark.rendering
pytest.importorskip("torch")

SIDE = 48
CAMERA = rts.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=40)


def card(left=-0.6, right=0.43, z=0.0, color=(0.9, 0.5, 0.2)):
    vertices, faces = quad(left, right, -0.5, 0.55, z)
    turn = np.array([[np.cos(0.2), -np.sin(0.2), 0], [np.sin(0.2), np.cos(0.2), 0], [0, 0, 1]])
    theta = {"vertices": (vertices @ turn.T).astype(np.float32), "colors": np.tile(np.float32(color), (4, 1))}
    return rts.Part(plugin("surfaces", "mesh")(faces), theta, "unlit")


def two_cards():
    return [card(), card(-0.2, 0.8, -0.4, (0.2, 0.4, 0.9))], CAMERA


def scene(*modes):
    found = moving("two cards", *two_cards(), (SIDE, SIDE), moves=[0])
    return found.with_modes(modes) if modes else found


TRUTH = dict(truth_samples=6, progress=False)
SMALL = dict(**TRUTH, engines=["torch"], samplers=["raster"], supersample=[1, 2], layers=[1, 2], peers=False)


# -------------------------------------------------------------------------------------------------- truth, scores


class TestScores:
    def test_exact(self):
        true = np.random.default_rng(0).normal(size=(20, 24, 3))
        found = scores(true, true)
        assert found["error"] == 0 and found["loss_error"] == 0
        assert found["gain"] == pytest.approx(1)

    def test_twice(self):
        true = np.random.default_rng(1).normal(size=(20, 24, 3))
        assert scores(2 * true, true) == pytest.approx({"error": 1, "gain": 2, "loss_error": 1})

    def test_weights(self):
        weights = loss_weights(32, 40)
        assert weights.shape[1:] == (32, 40, 3)
        np.testing.assert_allclose(weights.std(axis=(1, 2, 3)), 1, rtol=1e-5)


class TestTruth:
    def test_lattice(self):
        points = true_derivatives.lattice(8)
        assert points.shape == (64, 2) and np.abs(points).max() <= 0.5
        assert len(np.unique(points[:, 0])) == len(np.unique(points[:, 1])) == 64
        np.testing.assert_allclose(points.mean(axis=0), 0, atol=0.01)

    def test_closed_form(self, tmp_path):
        """A moving convex card keeps its area, and its upright edges keep their length."""
        moved = moving("card", card(), CAMERA, (SIDE, SIDE), modes=["translation"])
        found = true_derivatives.truth(
            moved, "translation", 2 * 3 * np.tan(np.radians(20)) / SIDE, samples=8, folder=tmp_path
        )
        image = found.derivative
        assert np.abs(image.sum(axis=(0, 1))).max() < 1e-2 * np.abs(image).sum()
        # The first moment grows by the area, for each pixel of motion.
        area = rts.render(card(), CAMERA, (SIDE, SIDE), splatter="none", layers=1, supersample=8)[..., :3].sum((0, 1))
        moment = (image * (np.arange(SIDE) + 0.5)[None, :, None]).sum(axis=(0, 1))
        np.testing.assert_allclose(moment, area, rtol=0.01)
        assert 0 < found.error < 0.1

    def test_kept(self, tmp_path, monkeypatch):
        first = true_derivatives.truth(scene(), "translation", 0.03, samples=2, folder=tmp_path)
        (path,) = (tmp_path / "truths").iterdir()
        made = true_derivatives.area_image
        monkeypatch.setattr(true_derivatives, "area_image", None)
        again = true_derivatives.truth(scene(), "translation", 0.03, samples=2, folder=tmp_path)
        np.testing.assert_array_equal(again.derivative, first.derivative)
        # A file that was cut off is made anew.
        path.write_bytes(path.read_bytes()[:100])
        monkeypatch.setattr(true_derivatives, "area_image", made)
        anew = true_derivatives.truth(scene(), "translation", 0.03, samples=2, folder=tmp_path)
        np.testing.assert_array_equal(anew.derivative, first.derivative)

    @pytest.mark.parametrize("change", ["color", "camera", "pixel", "cull", "samples"])
    def test_another_scene_has_another_key(self, change):
        def key(scene, step=0.1, samples=4):
            return true_derivatives.truth_key(scene, "translation", step, samples, None)

        parts, camera = two_cards()
        others = {
            "color": lambda: key(moving("two cards", [card(color=(0.9, 0.5, 0.21)), parts[1]], camera, (SIDE, SIDE))),
            "camera": lambda: key(
                moving("two cards", parts, rts.Camera.look_at((0, 0, 3), (0, 1e-3, 0), fov_y=40), (SIDE, SIDE))
            ),
            "pixel": lambda: key(scene(), 0.11),
            "cull": lambda: key(moving("two cards", [parts[0].replace(cull="back"), parts[1]], camera, (SIDE, SIDE))),
            "samples": lambda: key(scene(), samples=5),
        }
        base = key(moving("two cards", parts, camera, (SIDE, SIDE)))
        assert base == key(moving("two cards", *two_cards(), (SIDE, SIDE))) != others[change]()


# ------------------------------------------------------------------------------------------------------- choosing


class TestWorthTiming:
    settings = st.lists(
        st.tuples(st.integers(1, 3), st.integers(1, 3), st.floats(0.01, 1)), min_size=1, max_size=12, unique=True
    )

    @given(settings)
    def test_front(self, drawn):
        errors = {Setting("edges", k, s, str(i)): e for i, (k, s, e) in enumerate(drawn)}

        def work(setting):
            return setting.layers, setting.supersample

        kept = worth_timing(errors, work)
        assert kept
        for setting in errors:
            cheaper = [
                k for k in kept if k is not setting and all(a <= b for a, b in zip(work(k), work(setting), strict=True))
            ]
            bettered = any(_no_worse(errors[k], errors[setting]) for k in cheaper)
            assert (setting in kept) or bettered
        # Nothing that is kept is bettered by something else that is kept and was there before.
        for n, setting in enumerate(kept):
            for other in kept[:n]:
                dearer = all(a <= b for a, b in zip(work(other), work(setting), strict=True))
                assert not (dearer and _no_worse(errors[other], errors[setting]))

    def test_levels(self):
        """A setting just within 3 % is not dropped for one just beyond."""
        cheap, dear, dearer = (Setting("edges", k, 1) for k in (1, 2, 4))
        assert worth_timing({cheap: 0.0305, dear: 0.0295, dearer: 0.029}, lambda s: (s.layers,)) == [cheap, dear]


class TestLimited:
    def test_slow(self):
        with pytest.raises(Exception, match=r"more than 0\.05 s"), limited(0.05):
            while True:
                pass

    def test_quick(self):
        with limited(0.05):
            pass
        for _ in range(100):
            sum(range(10000))


# -------------------------------------------------------------------------------------------------------- journal


class TestKeptMeasurements:
    def test_kept(self, tmp_path):
        path = tmp_path / "deep" / "journal"
        KeptMeasurements(path).put({"error": 0.1}, "error", "translation", 1)
        assert KeptMeasurements(path).get("error", "translation", 1) == {"error": 0.1}
        assert KeptMeasurements(path).get("error", "translation", 2) is None

    @given(st.integers(0, 200))
    def test_cut_off_anywhere(self, at):
        import tempfile
        from pathlib import Path

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "journal"
            journal = KeptMeasurements(path)
            for n in range(8):
                journal.put(n, "key", n)
            text = path.read_bytes()
            path.write_bytes(text[:at])
            whole = text[:at].count(b"\n")
            again = KeptMeasurements(path)
            assert [again.get("key", n) for n in range(8)] == [n if n < whole else None for n in range(8)]
            again.put("new", "key", "new")
            assert KeptMeasurements(path).get("key", "new") == "new"

    def test_damaged(self, tmp_path):
        path = tmp_path / "journal"
        path.write_text("not a measurement\n")
        with pytest.raises(InputError, match="line 1 of .* is no measurement; remove the file"):
            KeptMeasurements(path)


# -------------------------------------------------------------------------------------------------------- compare


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A folder for truths, which are made once."""
    return tmp_path_factory.mktemp("truths")


@pytest.fixture(scope="module")
def found(kept, tmp_path_factory):
    output = tmp_path_factory.mktemp("output")
    return compare(scene("translation", "shape"), output=output, truths=kept, **SMALL), output


class TestCompare:
    def test_rows(self, found):
        comparison, _ = found
        names = {r["settings"]["splatter"] for r in comparison.rows}
        assert names == {"none", "single", "multi", "edges"}
        assert set(comparison.modes) == {"translation", "shape"}
        for mode in comparison.modes:
            errors = {tuple(r["settings"].values())[:3]: r["error"] for r in comparison.rows if r["mode"] == mode}
            assert errors["none", 1, 1] == pytest.approx(1, abs=1e-3)  # It has no derivative here.
            assert errors["edges", 1, 2] < 1.05 * errors["edges", 1, 1]  # Mostly the truth's own.
            assert errors["edges", 1, 1] < errors["multi", 2, 1] < errors["single", 1, 1] < 1
            assert 0 < comparison.modes[mode]["truth_error"] < 0.1

    def test_front(self, found):
        comparison, _ = found
        for mode in comparison.modes:
            timed = [r for r in comparison.rows if r["mode"] == mode and r["ms"]]
            for row in timed:
                better = [
                    o
                    for o in timed
                    if o["error"] <= row["error"] and o["ms"]["median"] <= row["ms"]["median"] and o is not row
                ]
                assert row["front"] == (not better)
            best = comparison.best(mode, 0.3)
            assert best["error"] <= 0.3
            assert comparison.best(mode, 1e-6) is None

    def test_it_prints_a_line_for_each_row(self, found):
        comparison, _ = found
        lines = str(comparison).splitlines()
        rows = [line for line in lines if " %  " in line]
        assert len(rows) == len(comparison.rows) and sum(line[0] == "*" for line in rows) == sum(
            row["front"] for row in comparison.rows
        )
        assert lines[0].endswith("time of a render and gradient") and set(comparison.modes) <= set(lines)
        errors = [float(line[2:10]) for line in rows if "edges" in line]
        assert max(errors) < 100 and len(errors) > 1

    def test_error_is_that_of_the_derivative(self, found, kept):
        torch = pytest.importorskip("torch")
        comparison, _ = found
        cards = scene("translation")
        measured = measurements.Measurements(cards, KeptMeasurements(), [engine_named("torch")], truths=kept, samples=6)
        pixel = measured.pixel("translation")
        # The nearer card moves by a pixel at its own depth; each of its samples, at its own.
        assert pixel == pytest.approx(2 * 3 * np.tan(np.radians(20)) / SIDE, rel=1e-3)

        def image(t):
            parts, camera = cards.at(cards.moved("translation", t, measured.engine))
            return rts.render(parts, camera, (SIDE, SIDE), splatter="edges", layers=1)[..., :3]

        derivative = torch.func.jvp(image, (torch.zeros(()),), (torch.tensor(pixel),))[1].numpy()
        wanted = {"splatter": "edges", "layers": 1, "supersample": 1}
        rows = [r for r in comparison.rows if r["mode"] == "translation" and wanted.items() <= r["settings"].items()]
        true = measured.truth("translation").derivative
        assert [r["error"] for r in rows] == [pytest.approx(scores(derivative, true)["error"], rel=1e-4)]

    def test_files(self, found):
        comparison, output = found
        assert [p.name for p in comparison.files(output)] == ["two_cards.json", "two_cards.png", "two_cards.html"]
        assert json.loads((output / "two_cards.json").read_text()) == json.loads(json.dumps(comparison.data))

    def test_another_run_measures_nothing(self, found, kept, monkeypatch):
        comparison, output = found
        monkeypatch.setattr(measurements.Measurements, "_measured", None)
        monkeypatch.setattr(interleaved_timing.InterleavedTiming, "timed", None)
        again = compare(scene("translation", "shape"), output=output, truths=kept, **SMALL)
        assert again.data == comparison.data

    def test_interrupted(self, found, kept, tmp_path, monkeypatch):
        """Ten times at random: nothing is measured twice, and nothing is lost."""
        chance, finished, begun = random.Random(1), [], []

        def interrupted(of, name):
            whole = getattr(of, name)

            def part(self, *args):
                key = str(args)
                begun.append(key)
                if len(begun) - len(finished) <= 10 and chance.random() < 0.3:
                    raise KeyboardInterrupt
                value = whole(self, *args)
                finished.append((name, key))
                return value

            monkeypatch.setattr(of, name, part)

        interrupted(measurements.Measurements, "_measured")
        interrupted(interleaved_timing.InterleavedTiming, "timed")
        interruptions = 0
        while True:
            try:
                again = compare(scene("translation"), output=tmp_path, truths=kept, **SMALL)
                break
            except KeyboardInterrupt:
                interruptions += 1
        assert interruptions == 10
        errors = [key for name, key in finished if name == "_measured"]
        assert len(errors) == len(set(errors))
        taken = [key for name, key in finished if name == "timed"]
        assert {taken.count(key) for key in taken} == {interleaved_timing.ROUNDS}
        want = [(r["settings"], r["error"]) for r in found[0].rows if r["mode"] == "translation"]
        timed = {json.dumps(r["settings"]) for r in again.rows if r["ms"]}
        assert {json.dumps(s) for s, _ in want if s["sampler"]} == timed

    def test_function(self, kept):
        def pose(parameters):
            transform = rts.rigid(parameters["pose"])
            return [p.replace(transform=transform) for p in two_cards()[0]], CAMERA

        options = {**SMALL, "supersample": [1], "layers": 1, "splatters": ["edges"]}
        start = {"pose": np.zeros(6)}
        comparison = compare(pose, start, size=(SIDE, SIDE), modes=["pose[3]"], truths=kept, **options)
        (row,) = comparison.rows
        assert row["error"] < 0.5 and row["ms"]["median"] > 0

    def test_auto_layers(self, kept):
        options = {**SMALL, "supersample": [1], "layers": ["auto", 4, 1], "splatters": ["multi"]}
        comparison = compare(scene("translation"), truths=kept, **options)
        errors = {r["settings"]["layers"]: r["error"] for r in comparison.rows}
        assert errors["auto"] == errors[4] < errors[1]

    def test_a_mode_that_changes_nothing(self, kept):
        def still(parameters):
            parts, camera = two_cards()
            x = parameters["x"]
            pose = rts.namespace(x).stack([0 * x, 0 * x, 0 * x, x, 0 * x, 0 * x])
            return [parts[0].replace(transform=rts.rigid(pose)), parts[1]], camera

        start = {"x": np.zeros(()), "y": np.zeros(())}
        options = {**SMALL, "supersample": [1], "layers": 1, "splatters": ["edges"], "size": (SIDE, SIDE)}
        comparison = compare(still, start, truths=kept, **options)
        assert list(comparison.modes) == ["x"]
        assert comparison.left_out[0].startswith(
            "nothing in the image of 'still' changes with 'y'; expected parameters"
        )
        with pytest.raises(InputError, match="changes with 'y'"):
            compare(still, start, modes=["y"], truths=kept, **options)

    def test_translucent(self, kept):
        """The truth sees what shines through: then two layers are right, and one is not."""
        glass = card().replace(shader=lambda theta, gbuffer, camera: 0.5 * gbuffer_color(gbuffer))
        behind = card(-0.2, 0.8, -0.4, (0.2, 0.4, 0.9))
        moved = moving("glass", [glass, behind], CAMERA, (SIDE, SIDE), moves=[1], modes=["translation"])
        options = {**SMALL, "supersample": [2], "layers": [1, 2], "splatters": ["multi"]}
        errors = {r["settings"]["layers"]: r["error"] for r in compare(moved, truths=kept, **options).rows}
        assert errors[2] < 0.5 * errors[1]

    def test_a_function_for_torch_alone(self, kept):
        import torch

        def shifted(parameters):
            pose = torch.cat([torch.zeros(3), parameters])
            return card().replace(transform=rts.rigid(pose)), CAMERA

        options = {**SMALL, "engines": None, "supersample": [1], "layers": 1, "splatters": ["edges"], "peers": True}
        start = torch.zeros(3, requires_grad=True)
        comparison = compare(shifted, start, size=(SIDE, SIDE), modes=["parameters[0]"], truths=kept, **options)
        assert {r["settings"]["engine"] for r in comparison.rows if "peer" not in r} == {"torch"}

    def test_a_function_for_jax_alone(self, kept):
        jnp = pytest.importorskip("jax").numpy

        def shifted(parameters):
            pose = jnp.concatenate([jnp.zeros(3), parameters])
            return card().replace(transform=rts.rigid(pose)), CAMERA

        options = {**SMALL, "engines": None, "supersample": [1], "layers": 1, "splatters": ["edges"]}
        start = {"size": (SIDE, SIDE), "modes": ["parameters[0]"], "truths": kept}
        for start_at in (jnp.zeros(3), np.zeros(3)):
            comparison = compare(shifted, start_at, **start, **options)
            assert {r["settings"]["engine"] for r in comparison.rows} == {"jax"}
        assert any(line.startswith("engine 'torch': ") for line in comparison.left_out)


def gbuffer_color(gbuffer):
    xp, color = rts.namespace(gbuffer["color"]), gbuffer["color"]
    return xp.concat([color, xp.ones_like(color[:, :1])], axis=-1)


class TestStrangers:
    def test_sampler_with_errors_of_its_own(self, kept, monkeypatch):
        """A sampler's own errors are reported of it alone."""

        class Askew(plugin("samplers", "reference")):
            def rasterize(self, prepared, camera, size, layers, cull):
                found = super().rasterize(prepared, camera, size, layers, cull)
                return found._replace(**{k: np.roll(v, 1, axis=2) for k, v in found._asdict().items()})

        monkeypatch.setitem(registry._defaults, ("rts.samplers", "reference"), Askew())
        options = {**SMALL, "samplers": ["raster", "reference"], "supersample": [1], "splatters": ["multi"]}
        rows = compare(scene("translation"), truths=kept, **options).rows
        errors = {(r["settings"]["sampler"], r["settings"]["layers"]): r["error"] for r in rows}
        assert errors["reference", 2] > 1.5 * errors["raster", 2]

    def test_sampler(self, kept):
        pytest.importorskip("rts_plugin_example")
        options = {**SMALL, "samplers": ["raster", "toy"], "supersample": [1], "splatters": ["edges"]}
        comparison = compare(scene("translation"), truths=kept, **options, quick=True)
        assert "toy" in {r["settings"]["sampler"] for r in comparison.rows if r["ms"]}

    def test_splatter(self, kept, monkeypatch):
        """A splatter that another distribution registers."""
        from importlib.metadata import EntryPoint

        entries = dict(registry._entries("rts.splatters"))
        entries["gauss5"] = [EntryPoint("gauss5", "second_plugin.gauss5:Gauss5", "rts.splatters")]
        monkeypatch.setitem(registry._entry_points, "rts.splatters", entries)
        comparison = compare(scene("translation"), truths=kept, **{**SMALL, "supersample": [1]})
        timed = {r["settings"]["splatter"] for r in comparison.rows if r["ms"]}
        assert {"gauss5", "edges"} <= timed

    def test_splatter_that_fails(self, kept, monkeypatch):
        class Broken(rts.Splatter):
            def image(self, splats):
                raise RuntimeError("it broke\nin two lines")

        monkeypatch.setitem(registry._defaults, ("rts.splatters", "multi"), Broken())
        comparison = compare(scene("translation"), truths=kept, **{**SMALL, "supersample": [1]})
        assert "multi" not in {r["settings"]["splatter"] for r in comparison.rows}
        assert any("it broke in two lines" in line for line in comparison.left_out)

    @pytest.mark.parametrize("slow", ["every call", "the first call"])
    def test_sampler_that_takes_long(self, kept, monkeypatch, slow):
        """It is left out; but not if only its first call, of one pixel, takes long, which may compile loops."""

        class Slow(plugin("samplers", "reference")):
            calls = 0

            def rasterize(self, *args):
                Slow.calls += 1
                time.sleep(0.3 if slow == "every call" or Slow.calls == 1 else 0)
                return super().rasterize(*args)

        monkeypatch.setattr(measurements, "PATIENCE", 0.2)
        monkeypatch.setitem(registry._defaults, ("rts.samplers", "reference"), Slow())
        options = {**SMALL, "samplers": ["raster", "reference"], "supersample": [1], "splatters": ["edges"]}
        comparison = compare(scene("translation"), truths=kept, **options)
        left_out = any("'reference': more than 0.2 s for an image 8 pixels high" in x for x in comparison.left_out)
        timed = {r["settings"]["sampler"] for r in comparison.rows if r["ms"]}
        assert (timed, left_out) == (({"raster"}, True) if slow == "every call" else ({"raster", "reference"}, False))


# ----------------------------------------------------------------------------------------------------------- tune


@pytest.fixture
def modelled(monkeypatch):
    """Times that are a formula of the setting, so that the fastest is known."""
    costs = {"none": 0.8, "single": 0.9, "multi": 1.1, "edges": 1.3}
    samplers = {"raster": 1.0, "embree": 2.0, "opengl": 3.0, "reference": 5.0, "toy": 50.0}

    def cost(setting):
        return costs[setting.splatter] * setting.layers**0.3 * setting.supersample**2 * samplers[setting.sampler]

    def timed(self, name):
        assert callable(self.calls[name]())
        return [1e-3 * cost(Setting(*name))] * 2

    monkeypatch.setattr(interleaved_timing.InterleavedTiming, "timed", timed)
    return cost


class TestTune:
    @pytest.mark.thorough
    def test_programs_of_jax_are_timed_with_them(self, kept):
        pytest.importorskip("jax")
        options = dict(splatters=["edges"], samplers=["raster"], engine="jax", size=(16, 16), truths=kept, **TRUTH)
        tuned = tune(scene("translation"), budget_s=5, tolerance=0.9, **options)
        assert tuned.settings["splatter"] == "edges" and tuned.seconds > 0

    @pytest.mark.parametrize("tolerance", [0.6, 0.1])
    @pytest.mark.thorough
    def test_cheapest(self, modelled, kept, tolerance):
        modes = ["translation", "shape"]
        options = dict(splatters=["none", "single", "multi", "edges"], samplers=["raster", "reference"], truths=kept)
        tuned = tune(scene(*modes), tolerance=tolerance, **TRUTH, **options)
        whole = compare(
            scene(*modes),
            **{**SMALL, "layers": [1, 2, 4], "supersample": [1, 2, 4], "splatters": options["splatters"]},
            truths=kept,
        )
        worst = {}
        for row in whole.rows:
            key = tuple(row["settings"].values())[:4]
            worst[key] = max(worst.get(key, 0), row["error"])
        within = [Setting(*key, "raster", "torch") for key, error in worst.items() if error <= tolerance]
        best = min(modelled(s) for s in within)
        chosen = Setting(**tuned.settings, engine="torch")
        assert modelled(chosen) == pytest.approx(best)
        assert tuned.error == pytest.approx(max(worst[tuple(chosen)[:4]], 0), rel=1e-6)
        assert tuned.seconds == pytest.approx(best / 1e3)
        assert rts.render(tuned.parts, CAMERA, (SIDE, SIDE), **tuned.settings).shape == (SIDE, SIDE, 4)

    def test_nothing_is_within(self, modelled, kept):
        with pytest.warns(ToleranceWarning, match="nothing is within 0.0001 %: the least error that was found"):
            tuned = tune(scene("translation"), tolerance=1e-6, samplers=["raster"], truths=kept, **TRUTH)
        assert tuned.settings["splatter"] == "edges" and tuned.settings["supersample"] > 1
        assert tuned.error > 1e-6

    def test_bounds_are_no_errors(self, monkeypatch, modelled, kept):
        """Where nothing is within the tolerance, the best is known by all of its modes."""
        told = {"edges": (0.3, 0.3), "multi": (0.25, 5.0), "single": (0.25, 6.0), "none": (0.25, 7.0)}

        def scores(self, mode, setting):
            return {"error": told[setting.splatter][mode == "shape"]}

        monkeypatch.setattr(measurements.Measurements, "scores", scores)
        with pytest.warns(ToleranceWarning, match="the least error that was found is 30 %"):
            tuned = tune(scene("translation", "shape"), tolerance=0.1, samplers=["raster"], truths=kept, **TRUTH)
        assert tuned.settings["splatter"] == "edges" and tuned.error == 0.3

    def test_reasons(self, modelled, kept):
        tuned = tune(scene("translation"), tolerance=0.2, samplers=["raster", "reference"], truths=kept, **TRUTH)
        told = " | ".join(tuned.reasons)
        assert "sampler='raster': sampler='reference' takes 5 times as long" in told
        assert "supersample=" in told and "off by" in told

    def test_a_turn_about_an_axis_of_symmetry(self, modelled, kept):
        """A pillar's image hardly changes with its turn: relative to that, any derivative's error is large."""
        import torch

        pillar = trimesh.creation.cylinder(0.6, 1.2, sections=40)
        pillar.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
        camera = rts.Camera.look_at((0, 1, 3), (0, 0, 0), fov_y=45)

        def posed(pose):
            theta = {"vertices": np.asarray(pillar.vertices, np.float32)}
            return rts.Part(rts.Mesh(pillar.faces), theta, "silhouette", transform=rts.rigid(pose)), camera

        pose = torch.zeros(6)
        tuned = tune(posed, pose, tolerance=0.3, size=(32, 32), samplers=["raster"], truths=kept, **TRUTH)
        assert tuned.error < 0.3
        assert any("hardly changes along parameters[1]: no errors" in line for line in tuned.reasons), tuned.reasons

    @pytest.mark.thorough
    def test_rates(self, modelled, kept):
        """A lattice that is finer than need be is thinned, and the scene that is given back has derivatives."""
        import torch

        axis = np.linspace(-1, 1, 17)
        x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
        values = (np.sqrt(x**2 + y**2 + z**2) - 0.7).astype(np.float32)
        surface = plugin("surfaces", "isosurface")(((-1, -1, -1), (1, 1, 1)))

        def ball(parameters):
            theta = {"values": rts.namespace(parameters).asarray(values) + parameters}
            return rts.Part(surface, theta, "silhouette"), CAMERA

        start = torch.zeros(())
        tuned = tune(ball, start, tolerance=0.5, size=(32, 32), samplers=["raster"], truths=kept, **TRUTH)
        assert tuned.parts[0].theta["values"].shape == (5, 5, 5)
        moved = torch.zeros((), requires_grad=True)
        parts, camera = tuned.scene(moved)
        rts.render(parts, camera, (32, 32), **tuned.settings).sum().backward()
        assert moved.grad < -10

    def test_samples_that_do_not_suffice_are_tried_twice(self):
        """With the least work, and with the most layers; settings between these are left out."""
        tried = []

        class Measured:
            scene = SimpleNamespace(directions={"translation": None})
            engine = SimpleNamespace(name="torch")

            def work(self, group, setting):
                return setting.layers, setting.supersample, 1.0

            def scores(self, mode, setting):
                tried.append((setting.supersample, setting.layers))
                return {"error": 0.05 if setting.supersample == 4 else 1.0}

        search = Search(Measured(), {"raster": ""}, 0.1, math.inf, lambda name, count: lambda: None)
        assert search._within([Setting("edges", k, s) for s in (1, 2, 4) for k in (1, 2, 4)]) == [
            Setting("edges", 1, 4)
        ]
        assert tried == [(1, 1), (1, 4), (2, 1), (2, 4), (4, 1)]

    def test_budget(self, kept):
        """When the budget is spent, the choice is made from the settings known by then."""
        options = dict(samplers=["raster"], truths=kept, **TRUTH)
        tuned = tune(scene("translation"), tolerance=0.5, budget_s=1e-6, **options)
        assert tuned.reasons[-1] == "the budget was spent before all settings were looked at"
        assert tuned.error <= 0.5

    @pytest.mark.parametrize("tolerance, samples", [(1e9, [4]), (1e-9, [4, 8])])
    def test_truth(self, modelled, tmp_path, monkeypatch, tolerance, samples):
        """It takes as many samples as it needs to be much more accurate than the tolerance; what is left is told."""
        monkeypatch.setattr(sys.modules[tune.__module__], "TRUTH_SAMPLES", (4, 8))
        made = []
        true = measurements.truth
        monkeypatch.setattr(
            measurements, "truth", lambda *given, **options: made.append(options["samples"]) or true(*given, **options)
        )
        options = dict(splatters=["single"], samplers=["raster"], truths=tmp_path, progress=False)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ToleranceWarning)
            for seconds, expected in ((1e-9, [4]), (60.0, samples)):  # Nothing is refined without time for it.
                made.clear()
                found = tune(scene("translation"), tolerance=tolerance, budget_s=seconds, **options)
                assert made == expected
                assert ("the truth itself" in found.reasons[-1]) == (tolerance < 1)


# --------------------------------------------------------------------------------------------------------- misuse


def nothing(parameters):
    pass


MY_SCENE = """
from __future__ import annotations

import dataclasses

import numpy as np
import rts


@dataclasses.dataclass
class Look:
    eye: tuple = (1, 1, 3)


def scene():
    return rts.plugin("surfaces", "mesh").example(), rts.Camera.look_at(Look().eye, (0, 0, 0))
"""


class TestMisuse:
    @pytest.mark.parametrize(
        ("given", "message"),
        [
            (dict(scene="bunni over black"), "did you mean"),
            (dict(scene="missing.obj"), "missing.obj does not exist; expected a model, a Python file, or one of"),
            (dict(scene="missing.py"), "missing.py does not exist"),
            (dict(scene=3), "scene is 3; expected a name"),
            (dict(scene=nothing), "nothing takes parameters"),
            (dict(scene=nothing, parameters=np.zeros(2)), "nothing gave None.*expected .parts, camera."),
            (dict(scene=lambda: None), "gave None.*expected .parts, camera."),
            (dict(scene=nothing, parameters={}), "parameters holds no numbers"),
            (dict(scene=nothing, parameters={"a": "b"}), "parameters holds 'b'; expected arrays of real numbers"),
            (dict(scene=lambda p: 1 / 0, parameters=np.zeros(2)), "fails: ZeroDivisionError"),
            (dict(scene="thin wires", samplers=[]), "samplers is .*; expected a list of names"),
            (dict(scene="thin wires", splatters="edges"), "splatters is 'edges'; expected a list of names"),
            (dict(scene="thin wires", directions={}), "only functions of parameters have them"),
            (
                dict(scene=nothing, parameters=np.zeros(2), directions={"a": np.zeros(3)}),
                "expected those of parameters",
            ),
            (dict(scene=nothing, parameters=np.zeros(2), directions={"a": np.zeros(2)}), "is zero"),
            (dict(scene="thin wires", parameters=np.zeros(2)), "only functions of parameters"),
            (dict(scene="thin wires", modes=["sideways"]), "expected some of translation"),
            (dict(scene="thin wires", modes="shape"), "expected some of translation"),
            (dict(scene="thin wires", size=(0, 4)), "size"),
            (dict(scene="thin wires", layers=[0]), "layers is .0.; expected integers of at least 1 or 'auto'"),
            (dict(scene="thin wires", supersample=["auto"]), "supersample is"),
            (dict(scene="thin wires", samplers=["rays"]), "none of the samplers rays suits"),
        ],
    )
    def test_compare(self, given, message):
        with refused(message):
            compare(given.pop("scene"), given.pop("parameters", None), progress=False, **given)

    @pytest.mark.parametrize("name", ["splatters", "samplers", "engines"])
    def test_unknown_plugin(self, name):
        with pytest.raises((InputError, PluginError), match="no .* named 'blender'"):
            compare("thin wires", **{name: ["blender"]}, progress=False)

    def test_folder(self, tmp_path):
        (tmp_path / "file").write_text("")
        with pytest.raises(InputError, match="is a file; expected a folder to write into"):
            compare("thin wires", output=tmp_path / "file" / "deeper", progress=False)

    @pytest.mark.parametrize("tolerance", [0, -1, float("nan"), "much"])
    def test_tolerance(self, tolerance):
        with pytest.raises(InputError, match="tolerance is"):
            tune("thin wires", tolerance=tolerance)

    def test_no_engine(self, monkeypatch):
        monkeypatch.setattr(compared_settings, "plugins", lambda group: ["numpy"] if group == "rts.engines" else [])
        with pytest.raises(PluginError, match="no engine with derivatives is installed"):
            compare("thin wires", progress=False)

    def test_engines_without_derivatives(self):
        with refused(r"engines is \['numpy'\], without derivatives, .*; expected some of torch"):
            compare("thin wires", engines=["numpy"], progress=False)
        found, left_out = engines(["numpy", "torch"])
        assert [engine.name for engine in found] == ["torch"]
        assert left_out == ["engine 'numpy': it has no derivatives"]

    def test_python_file(self, tmp_path):
        path = tmp_path / "mine.py"
        path.write_text("def other():\n    return None\n")
        with pytest.raises(InputError, match="has no function 'scene'; name one"):
            compare(path, progress=False)
        with pytest.raises(InputError, match="other gave None"):
            compare(f"{path}:other", progress=False)
        path.write_text(MY_SCENE)
        options = {**SMALL, "supersample": [1], "layers": 1, "splatters": ["edges"], "size": (SIDE, SIDE)}
        assert list(compare(path, modes=["camera"], truths=tmp_path, **options).modes) == ["camera"]
        path.write_text("1 / 0\n")
        with pytest.raises(InputError, match="fails: ZeroDivisionError: division by zero"):
            compare(path, progress=False)


# --------------------------------------------------------------------------------------------------- command line


def run(*arguments):
    from typer.testing import CliRunner

    from rts_cli import main

    result = CliRunner().invoke(main.app, [str(a) for a in arguments])
    return result.exit_code, " ".join(result.output.split())


@pytest.fixture
def model(tmp_path, monkeypatch, kept):
    trimesh = pytest.importorskip("trimesh")
    monkeypatch.setenv("XDG_CACHE_HOME", str(kept))
    path = tmp_path / "model.obj"
    trimesh.creation.box((1, 0.7, 0.5)).export(path)
    return path


class TestCommandLine:
    def test_compare(self, model, tmp_path):
        samples = ["--supersample", "1", "--supersample", "2"]
        code, told = run("compare", model, "--quick", "--size", SIDE, *samples, "-o", tmp_path / "out")
        assert code == 0, told
        assert "fastest settings by the error of derivatives" in told and "translation" in told
        assert [p.suffix for p in sorted((tmp_path / "out").glob("model.*"))] == [".html", ".json", ".png"]
        rows = json.loads((tmp_path / "out" / "model.json").read_text())["rows"]
        assert {r["mode"] for r in rows} == {"translation"} and len(rows) <= 40
        assert {r["settings"]["engine"] for r in rows if r["ms"]} == {"torch"}
        assert {r["settings"]["supersample"] for r in rows} == {1, 2}

    def test_list(self):
        code, told = run("compare", "list")
        assert code == 0 and "thin wires" in told and "meshes/bunny.obj" in told

    def test_missing_charts_are_told_before_anything_is_measured(self, monkeypatch, tmp_path):
        def interrupted(*args, **options):
            raise KeyboardInterrupt

        monkeypatch.setattr("rts_compare.comparison.compare", interrupted)
        for missing, said in (
            (["matplotlib"], "no PNG, which needs matplotlib"),
            (["plotly"], "no HTML, which needs plotly"),
            (["matplotlib", "plotly"], "no PNG or HTML, which needs matplotlib and plotly"),
        ):
            with monkeypatch.context() as without:
                for package in missing:
                    without.setitem(sys.modules, package, None)
                code, told = run("compare", "thin wires", "-o", tmp_path)
            assert code == 130 and told.startswith(
                f"{said}: pip install 'rasterize-then-splat[plots]'. What is measured"
            )

    def test_times_are_written_without_powers_of_ten(self):
        for ms, text in {0.25: "0.25 ms", 47.53: "47.5 ms", 999.7: "1 s", 4750.0: "4.75 s", 4.75e6: "4750 s"}.items():
            settings = Setting("edges", 2, 1, "", "raster", "torch")._asdict()
            row = {"mode": "x", "error": 0.0, "ms": {"median": ms}, "settings": settings}
            table = summary(Comparison({"name": "s"}, {}, {"x": {}}, [row], []))
            assert [*table.columns[1].cells] == [f"edges K=2 raster torch\n{text}"]

    @pytest.mark.thorough
    def test_tune(self, model):
        code, told = run("tune", model, "--size", SIDE, "--mode", "translation", "--tolerance", 0.5)
        assert code == 0, told
        assert "rts.render(parts, camera, size, sampler='" in told and "error " in told

    def test_interrupted(self, model, tmp_path, monkeypatch):
        def interrupted(*args, **options):
            raise KeyboardInterrupt

        monkeypatch.setattr(measurements.Measurements, "truths", interrupted)
        code, told = run("compare", model, "--quick", "-o", tmp_path / "out")
        assert (
            code == 130 and told == "rts: interrupted; what was measured is kept: the same command goes on from there"
        )

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["compare", "missing.obj"], "missing.obj does not exist; expected a model"),
            (["compare", "thin wires", "--mode", "sideways"], "expected some of translation"),
            (
                ["compare", "thin wires", "--supersample", "adaptive:4"],
                "'adaptive:4' is no supersample; expected a number",
            ),
            (["compare", "thin wires", "--sampler", "blender"], "no sampler named 'blender'"),
            (["tune", "thin wires", "--tolerance", "-1"], "tolerance is -1.0; expected a positive number"),
        ],
    )
    def test_misuse(self, arguments, message):
        code, told = run(*arguments)
        assert code == 1 and told.startswith("rts: ") and message in told
