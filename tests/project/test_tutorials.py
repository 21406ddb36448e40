"""The tutorials run as scripts, with small pictures, and write the picture that they end in."""

import re
import runpy
import warnings
from pathlib import Path

import numpy as np
import pytest

import rts

pytestmark = pytest.mark.docs

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = sorted((ROOT / "docs/tutorials").glob("*.py"))
FRAMEWORKS = ("torch", "jax")


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.stem)
def test_a_tutorial_runs_and_writes_its_picture(script, tmp_path, monkeypatch, capsys):
    text = script.read_text()
    for package in FRAMEWORKS:
        if re.search(rf"^import {package}$", text, re.MULTILINE):
            pytest.importorskip(package)
    for name in set(re.findall(r"\brts\.([A-Z]\w+)", text)) & set(rts.registry.built_in_attributes()):
        if not hasattr(rts, name):  # Such as OpenSubdiv's headers.
            with pytest.raises(AttributeError) as error:
                getattr(rts, name)
            pytest.skip(str(error.value))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RTS_QUICK", "1")
    with warnings.catch_warnings():
        warnings.simplefilter("error", rts.errors.RtsWarning)
        runpy.run_path(str(script), run_name="__main__")
    image = rts.load_image(tmp_path / f"{script.stem}.png")
    # Pictures side by side, none of them empty; the first is not yet the last.
    shown = np.array_split(image, round(image.shape[1] / image.shape[0]), axis=1)
    assert len(shown) > 1 and all(np.ptp(x[..., 3] + x[..., 0]) > 0.1 for x in shown)
    assert np.abs(shown[0] - shown[-1]).max() > 0.1
    assert capsys.readouterr().out.strip()


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.stem)
def test_a_tutorial_is_short_and_ends_in_its_picture(script):
    text = script.read_text()
    cells = [cell.strip().splitlines() for cell in text.split("# %%") if cell.strip()]
    words = " ".join(line for cell in cells if cell[0] == "[markdown]" for line in cell[1:]).replace("#", "").split()
    code = [line for cell in cells if cell[0] != "[markdown]" for line in cell]
    # A reader takes 200 words, or 20 lines of code, a minute.
    assert len(words) / 200 + len(code) / 20 < 10
    [last] = [cell for cell in cells if "rts.save_image(" in "".join(cell)]
    assert last[-1].startswith(f'Image.open("{script.stem}.png")')
    assert f"({script.name})" in (ROOT / "docs/tutorials/index.md").read_text()
