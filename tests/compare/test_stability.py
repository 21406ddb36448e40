"""Ways to fail: what must not break does not, what must fail does, and the table says so."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from rts.errors import InputError
from rts_compare import stability
from rts_compare.failures import failure_scenes, library_only_rows
from rts_compare.failures.method_renderers import renderer, shifted
from rts_compare.failures.row_measures import Derivative, Fitted, Vanishing, distance
from rts_compare.failures.table_cells import VERDICTS, Context, Outcome, Row, graded
from rts_compare.failures.table_columns import DEFAULT, METHODS
from rts_compare.failures.table_rows import ROWS

pytestmark = pytest.mark.fitting

QUICK = Context(seeds=2, samples=3, steps=40)
METHOD = {method.name: method for method in METHODS}
SPLATTING = [m.name for m in METHODS if not m.peer and m.name != "none"]
PRONE = (
    failure_scenes.coplanar,
    failure_scenes.through_near,
    failure_scenes.past_camera,
    failure_scenes.with_slivers,
    failure_scenes.grazing,
    lambda: failure_scenes.scaled(1e-4),
    lambda: failure_scenes.scaled(1e4),
    lambda: failure_scenes.scaled(1.0, 1e5),
    lambda: failure_scenes.with_slivers("lambert"),
    failure_scenes.empty,
)
"""Scenes in which something is divided by what may be zero, or too large."""


@pytest.fixture(autouse=True)
def truths(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def row(name):
    return next(found for found in ROWS if found.name == name)


@pytest.mark.parametrize("scene", PRONE)
def test_derivatives_are_finite(scene):
    drawn = renderer(scene(), METHOD[DEFAULT])
    assert np.isfinite(drawn.derivative(next(iter(drawn.scene.directions)))).all()
    assert drawn.broken() == 0


@pytest.mark.parametrize("measure", [library_only_rows.lattice_ties, library_only_rows.singular_crossings])
def test_isosurfaces_have_finite_gradients(measure):
    found = measure(METHOD[DEFAULT], QUICK)
    assert found.numbers["nan"] == 0
    assert found.numbers["largest"] > 0


def test_an_empty_view_has_a_gradient_of_zero():
    assert row("empty view").measure(METHOD[DEFAULT], QUICK) == Outcome("ok", "0", {"left": 0.0, "nan": 0})


def test_plain_rasterization_does_not_see_outlines():
    scene = failure_scenes.upright()
    assert not renderer(scene, METHOD["none"]).derivative("tx").any()
    assert renderer(scene, METHOD[DEFAULT]).derivative("tx").any()
    assert row("upright edges").measure(METHOD["none"], QUICK).verdict == "failed"


def test_one_layer_does_not_see_what_is_behind():
    one, two = (row("card behind a shell").measure(METHOD[name], QUICK).numbers for name in ("single", DEFAULT))
    assert one["error"] > 1.5 * two["error"]


def test_fits_converge_with_outlines_and_not_without():
    fitted = Fitted(failure_scenes.far_card, lambda rng: rng.uniform(-5, 5, 2))
    assert fitted(METHOD[DEFAULT], QUICK).numbers["converged"] == 2
    found = fitted(METHOD["none"], QUICK)
    assert (found.verdict, found.numbers["converged"], found.numbers["largest"]) == ("failed", 0, 0.0)


def test_fits_from_far_off_need_blurred_images():
    near, blurred = (
        row(name).measure(METHOD[DEFAULT], QUICK) for name in ("too far for overlap", "… images blurred at first")
    )
    assert near.numbers["converged"] < blurred.numbers["converged"] == QUICK.seeds


def test_slopes_are_those_of_the_derivative_image():
    scene = failure_scenes.box_pose()
    weights = np.random.default_rng(0).normal(size=(*scene.size, 3))
    for name in SPLATTING:
        drawn = renderer(scene, METHOD[name])
        slopes = drawn.slopes(np.zeros(6), lambda image: weights)
        expected = [(drawn.derivative(mode) * weights).sum() for mode in scene.directions]
        np.testing.assert_allclose(slopes, expected, atol=1e-4 * np.abs(expected).max())


def test_other_renderers_give_slopes_of_the_same_loss():
    pytest.importorskip("deodr")
    scene, rng = failure_scenes.far_card(), np.random.default_rng(1)
    weights = rng.normal(size=(2, 3))[0] * np.linspace(0, 1, scene.size[1])[:, None] * np.ones((*scene.size, 3))
    ours, theirs = (
        renderer(scene, METHOD[name]).slopes(np.array([3.0, -2.0]), lambda image: weights)
        for name in (DEFAULT, "DEODR")
    )
    np.testing.assert_allclose(theirs, ours, atol=0.1 * np.abs(ours).max())


def test_amounts_are_pixels():
    scene = failure_scenes.far_card()
    assert distance(scene, np.array([3.0, 4.0])) == pytest.approx(5.0, rel=1e-6)
    assert shifted(scene, np.zeros(2))["pose"].tolist() == [0.0] * 6


def test_verdicts():
    assert [graded(x, 0.2, 0.5) for x in (0.1, 0.3, 0.6, math.nan, math.inf)] == ["ok", "degraded"] + 3 * ["failed"]
    assert graded(0.1, 0.2, 0.5, nan=1) == "failed"


def test_every_row_is_told():
    assert len(ROWS) >= 20
    assert len({row.name for row in ROWS}) == len(ROWS)
    assert all(row.note for row in ROWS)
    assert METHOD[DEFAULT].options == {"splatter": "edges"}


def test_the_committed_table_is_whole():
    path = Path(__file__).parents[2] / "benchmarks" / "results" / "stability.json"
    data = json.loads(path.read_text())
    own = [i for i, name in enumerate(data["methods"]) if not METHOD[name].peer]
    assert data["methods"] == list(METHOD)
    assert [row["name"] for row in data["rows"][1:]] == [row.name for row in ROWS]
    for row in data["rows"]:
        cells = row["cells"]
        assert not cells[data["methods"].index(DEFAULT)]["numbers"].get("nan"), row["name"]
        if any(cells[i]["verdict"] in ("degraded", "failed") for i in own):
            assert row["why"], row["name"]


def test_the_table_is_written_and_goes_on(tmp_path):
    calls = []

    def measure(method, context):
        calls.append(method.name)
        return Outcome("failed", "7", {"nan": 0, "error": np.float32(0.123456), "worst": math.inf})

    options = dict(
        rows=["empty view"], methods=["none", DEFAULT], output=tmp_path, more=[Row("mine", "a note", measure)]
    )
    table = stability(**options)
    assert stability(**options).data()["rows"] == table.data()["rows"]
    assert calls == ["none", DEFAULT]
    assert table.cell("mine", "none") == Outcome("failed", "7", {"nan": 0, "error": 0.1235, "worst": "inf"})
    assert (tmp_path / "stability.md").read_text() == str(table)
    assert str(table).splitlines()[2:] == ["| mine | ✗ 7 | ✗ 7 |", "| empty view | 0 | 0 |"]
    data = json.loads((tmp_path / "stability.json").read_text())
    assert data["methods"] == ["none", DEFAULT]
    assert {cell["verdict"] for row in data["rows"] for cell in row["cells"]} <= set(VERDICTS)
    stability(**options, fresh=True)
    assert calls == 2 * ["none", DEFAULT]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rows": ["grazing shed"]}, "did you mean 'grazing sheet'"),
        ({"methods": "egdes"}, "did you mean 'edges'"),
        ({"seeds": 0}, "seeds is 0"),
        ({"truth_samples": 1.5}, "truth_samples is 1.5"),
    ],
)
def test_what_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        stability(**options)


def test_rows_say_why_a_method_cannot():
    found = [row(name).measure(METHOD["DEODR"], QUICK) for name in ("lattice ties", "gauge freedom, LM")]
    assert [(cell.verdict, cell.text) for cell in found] == [
        ("cannot", "it has no isosurfaces"),
        ("cannot", "it offers no Jacobian"),
    ]


def test_what_turns_and_does_not_change():
    turning = Vanishing(failure_scenes.turning_ball, (0.1, 0.3))
    assert turning(METHOD["none"], QUICK).text == "no derivative at all"
    assert turning(METHOD[DEFAULT], QUICK).numbers["left"] < 0.5


def test_scales_change_nothing():
    plain, small = (Derivative(lambda s=s: failure_scenes.scaled(s)).scene() for s in (1.0, 1e-4))
    found = [renderer(scene, METHOD[DEFAULT]).derivative("tx") for scene in (plain, small)]
    assert np.abs(found[0] - found[1]).max() < 0.02 * np.abs(found[0]).max()
