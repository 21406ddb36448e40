"""One command makes the figures and tables of the paper, and says of each claim whether it holds."""

import importlib.util
import json

import numpy as np
import pytest

from benchmarks.paper import __main__ as command
from benchmarks.paper import airplane_scene, blur, claims, surface_claims
from benchmarks.paper.registry import EXPERIMENTS
from benchmarks.paper.rows import verdict

pytestmark = pytest.mark.docs

NAMES = set("derivatives blur silhouettes pose-speed airplane hand bspline swept spheres lego fern".split())


def test_every_figure_and_table_has_a_name_and_a_script():
    assert set(EXPERIMENTS) == NAMES
    assert all(importlib.util.find_spec(one.script) for one in EXPERIMENTS.values())
    assert len({one.place for one in EXPERIMENTS.values()}) == len(NAMES)


def test_a_wrong_name_gives_one_line_that_lists_the_names():
    with pytest.raises(SystemExit) as stop:
        command.main(["aeroplane"])
    text = str(stop.value.code)
    assert text.startswith("no experiment is called 'aeroplane'; expected all, or some of ") and "\n" not in text
    assert all(name in text for name in NAMES)


def test_quick_results_are_not_kept():
    with pytest.raises(SystemExit, match="--keep is for results of full size"):
        command.main(["blur", "--quick", "--keep"])


def test_an_experiment_without_its_data_is_left_out_and_says_why(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(airplane_scene, "FOLDER", tmp_path / "nowhere")
    airplane_scene.photograph.cache_clear()
    with pytest.raises(SystemExit) as stop:
        command.main(["airplane", "--quick", "-o", str(tmp_path)])
    assert stop.value.code == 1
    assert f"not run: {tmp_path / 'nowhere'} is missing; set RTS_DATA" in capsys.readouterr().out


def test_a_script_that_knows_torch_alone_is_left_out_with_jax(tmp_path):
    with pytest.raises(command.NotRun, match="benchmarks.paper.hand has no option for the engine jax"):
        command.run("hand", tmp_path, quick=True, engine="jax")


def test_verdicts_count_the_parts_that_hold():
    assert [verdict(True, True), verdict(True, False), verdict(False, False)] == ["holds", "in part", "does not"]


@pytest.mark.parametrize(("after", "told"), [(33.2, "holds"), (33.6, "holds"), (34.2, "holds"), (32.6, "does not")])
def test_a_loss_as_small_as_the_papers_holds(after, told):
    psnr = {"mipmaps": {"none": 33.7, "multi": after}, "none": {"none": 25.4, "multi": 28.3}}
    rows = claims.blur({"steps": 1, "side": 2, "rows": 3, "psnr": psnr})
    assert [row.verdict for row in rows] == [told, "holds"]


def test_a_trapped_sphere_is_no_torus():
    fit = {"task": "rotated, lambert", "motion": "edge", "engine": "torch", "steps": 150}
    assert surface_claims.swept([fit | {"radii": [0.6, 0.25]}])[0].verdict == "holds"
    assert surface_claims.swept([fit | {"radii": [0.33, 0.51]}])[0].verdict == "does not"


def test_texels_are_judged_by_their_area():
    truth = np.zeros((6, 12, 3), np.float32)
    assert blur.psnr(truth + 0.1, truth) == pytest.approx(20, abs=1e-4)
    # The rows at 75° are not judged; the four others weigh cos 45°, cos 15°, cos 15°, cos 45°.
    off = truth.copy()
    off[[0, 1, -1]] = 0.1
    share = np.cos(np.pi / 4) / (2 * np.cos(np.pi / 4) + 2 * np.cos(np.pi / 12))
    assert blur.psnr(off, truth) == pytest.approx(20 - 10 * np.log10(share), abs=1e-4)


@pytest.mark.thorough
def test_a_quick_version_writes_picture_numbers_and_rows(tmp_path, monkeypatch):
    name = "blur"
    monkeypatch.setattr(blur, "QUICK", blur.QUICK._replace(steps=8))
    with pytest.raises(SystemExit) as stop:
        command.main([name, "--quick", "-o", str(tmp_path)])
    assert not stop.value.code
    found = json.loads((tmp_path / name / "row.json").read_text())
    assert found["about"]["size"] == "quick" and found["rows"]
    assert {row["verdict"] for row in found["rows"]} <= {"holds", "in part", "does not", "not run"}
    assert (tmp_path / name / f"{name}.png").stat().st_size > 10_000
