"""The scripts in examples/ run, at their smallest, and write the picture that they say."""

import re
import runpy
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

import rts

pytestmark = pytest.mark.docs

ROOT = Path(__file__).resolve().parent.parent
SCRIPTS = sorted((ROOT / "examples").glob("*.py"))
FRAMEWORKS = ("torch", "jax")


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.stem)
def test_an_example_runs_and_writes_its_picture(script, tmp_path, monkeypatch, capsys):
    text = script.read_text()
    for package in FRAMEWORKS:
        if re.search(rf"^import {package}$", text, re.MULTILINE):
            pytest.importorskip(package)
    for name in set(re.findall(r"\brts\.([A-Z]\w+)", text)) & set(rts.registry.built_in_attributes()):
        if not hasattr(rts, name):  # Such as OpenSubdiv's headers.
            with pytest.raises(AttributeError) as error:
                getattr(rts, name)
            pytest.skip(str(error.value))
    if "rts.Isosurface" in text:
        pytest.importorskip("mcubes")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(script), "--quick"])
    with warnings.catch_warnings():
        warnings.simplefilter("error", rts.RtsWarning)
        runpy.run_path(str(script), run_name="__main__")
    image = rts.load_image(tmp_path / f"{script.stem}.png")
    # Pictures side by side, none of them empty; the first is not yet the last.
    shown = np.array_split(image, round(image.shape[1] / image.shape[0]), axis=1)
    assert len(shown) > 1 and all(np.ptp(x[..., 3] + x[..., 0]) > 0.1 for x in shown)
    assert np.abs(shown[0] - shown[-1]).max() > 0.1
    assert capsys.readouterr().out.strip()


def test_the_examples_are_short_and_told_in_the_readme():
    readme = (ROOT / "README.md").read_text()
    assert len(SCRIPTS) == 8
    for script in SCRIPTS:
        text = script.read_text()
        assert len(text.splitlines()) < 60 and text.startswith('"""') and f"{script.stem}.png" in text
        assert f"(examples/{script.name})" in readme, f"{script.name} is not in README.md"
