# Names of `rts.testing` for type checkers and editors.

from rts_testing.engines import EngineConformance as EngineConformance
from rts_testing.operations import OperationConformance as OperationConformance
from rts_testing.samplers import SamplerConformance as SamplerConformance
from rts_testing.shaders import ShaderConformance as ShaderConformance
from rts_testing.splatters import SplatterConformance as SplatterConformance
from rts_testing.surfaces import SurfaceConformance as SurfaceConformance

__all__ = [
    "EngineConformance",
    "OperationConformance",
    "SamplerConformance",
    "ShaderConformance",
    "SplatterConformance",
    "SurfaceConformance",
]
