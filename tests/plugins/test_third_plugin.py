"""The plugins of `third_plugin`, which docs/plugins.md shows, by the conformance kit."""

import re
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from rts import registry
from rts.testing import SamplerConformance, ShaderConformance, SurfaceConformance
from rts_cli.main import app

sys.path.insert(0, str(Path(__file__).parents[1] / "third_plugin"))  # Nothing installs it.

from rts_third_plugin.caster import Caster
from rts_third_plugin.loft import Loft
from rts_third_plugin.ring import Ring
from rts_third_plugin.toon import Toon

pytestmark = pytest.mark.plugins


class TestLoft(SurfaceConformance):
    @pytest.fixture
    def part(self):
        return Loft.example()


class TestRing(SurfaceConformance):
    @pytest.fixture
    def part(self):
        return Ring.example()


class TestCaster(SamplerConformance):
    @pytest.fixture
    def sampler(self):
        return Caster()


class TestToon(ShaderConformance):
    @pytest.fixture
    def shader(self):
        return Toon(levels=4)

    @pytest.fixture
    def theta(self):
        return {"tint": np.array([0.9, 0.6, 0.2])}


def test_its_command_is_listed_and_runs_beside_ours(tmp_path, monkeypatch):
    entry = EntryPoint("turntable", "rts_third_plugin.turntable:turntable", "rts.commands")
    commands = {**registry._entries("rts.commands"), "turntable": [entry]}
    monkeypatch.setitem(registry._entry_points, "rts.commands", commands)
    monkeypatch.chdir(tmp_path)
    listed = CliRunner().invoke(app, ["--help"]).output
    for told in ("render ", "compare ", "turntable "):
        assert re.search(told, listed)
    trimesh.creation.box().export("box.obj")
    done = CliRunner().invoke(app, ["turntable", "box.obj", "--frames", "2", "--output", "box.gif"])
    assert done.exit_code == 0, done.output
    assert Path("box.gif").stat().st_size > 1000
    wrong = CliRunner().invoke(app, ["turntable", "none.obj"])
    assert wrong.exit_code == 1 and "none.obj" in wrong.output and "Traceback" not in wrong.output
