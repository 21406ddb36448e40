"""The plugins of `third_plugin`, a distribution written from docs/plugins.md alone, by the conformance kit."""

import sys
from pathlib import Path

import numpy as np
import pytest

from rts.testing import SamplerConformance, ShaderConformance, SplatterConformance, SurfaceConformance

sys.path.insert(0, str(Path(__file__).parent / "third_plugin"))  # Nothing installs it.

from rts_third_plugin.caster import Caster
from rts_third_plugin.loft import Loft
from rts_third_plugin.toon import Toon
from rts_third_plugin.wide import Wide

pytestmark = pytest.mark.plugins


class TestLoft(SurfaceConformance):
    @pytest.fixture
    def part(self):
        return Loft.example()


class TestCaster(SamplerConformance):
    @pytest.fixture
    def sampler(self):
        return Caster()


class TestToon(ShaderConformance):
    @pytest.fixture
    def shader(self):
        return Toon(levels=4, rim=0.8)

    @pytest.fixture
    def theta(self):
        return {"tint": np.array([0.9, 0.6, 0.2])}


class TestWide(SplatterConformance):
    @pytest.fixture
    def splatter(self):
        return Wide()
