"""The conformance kit: what every plugin must do, as pytest classes to subclass.

    from rts.testing import SurfaceConformance

    class TestHeightfield(SurfaceConformance):
        @pytest.fixture
        def part(self):
            return Heightfield.example()

Each class says which fixtures to override. Checks that need torch or jax are skipped, with the reason, where it is not
installed. Nothing is collected unless it is subclassed, and `import rts` does not load this package or pytest.
"""

from rts.testing.engines import EngineConformance
from rts.testing.samplers import SamplerConformance
from rts.testing.shaders import ShaderConformance
from rts.testing.splatters import SplatterConformance
from rts.testing.surfaces import SurfaceConformance

__all__ = ["EngineConformance", "SamplerConformance", "ShaderConformance", "SplatterConformance", "SurfaceConformance"]
