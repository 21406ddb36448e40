"""Base classes of plugins, and the G-buffer that surfaces give: names of `rts`, too, but for the shader `Unlit`."""

from rts.arrays.engine_base import Engine
from rts.contracts.gbuffer import GBuffer
from rts.contracts.residuals import Residuals
from rts.contracts.sampler import Sampler
from rts.contracts.shader import Shader
from rts.contracts.splatter import Splatter
from rts.contracts.surface import Evaluator, RaySurface, Surface, TriangleSurface
from rts.sampling.triangle_sampler import TriangleSampler
from rts.shading.shaders import Unlit

__all__ = [
    "Engine",
    "Evaluator",
    "GBuffer",
    "RaySurface",
    "Residuals",
    "Sampler",
    "Shader",
    "Splatter",
    "Surface",
    "TriangleSampler",
    "TriangleSurface",
    "Unlit",
]
