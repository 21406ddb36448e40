"""The conformance kit on isosurfaces: of values, of a function, and with a table of lattice points."""

import numpy as np
import pytest

import rts
from rts.testing import SurfaceConformance
from rts_surfaces.implicit.fields import swept_sphere

pytestmark = pytest.mark.plugins

Isosurface = rts.plugin("surfaces", "isosurface")
BOUNDS = ((-1.51, -0.7, -1.5), (1.5, 0.72, 1.53))


def of_function(**options):
    surface = Isosurface(BOUNDS, f=swept_sphere, shape=(31, 15, 31), **options)
    return rts.Part(surface, {"radii": np.array([0.9, 0.4], np.float32)}, "normals")


class TestValues(SurfaceConformance):
    @pytest.fixture
    def part(self):
        return Isosurface.example()


class TestFunction(SurfaceConformance):
    """With motion along edges, whose derivatives are exact only if they are not bounded."""

    @pytest.fixture
    def part(self):
        return of_function(motion="edge", near_singular="keep")


class TestTable(SurfaceConformance):
    @pytest.fixture
    def part(self):
        return of_function(table=True, lipschitz=1.0)
