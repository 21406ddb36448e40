"""The names of nvdiffrast's torch module, to be imported as `import rts_nvdiffrast.torch as dr`.

Differences in meaning are in the README; the first of them are in `antialias`.
"""

from rts_nvdiffrast.antialiasing import antialias, antialias_construct_topology_hash
from rts_nvdiffrast.interpolation import interpolate
from rts_nvdiffrast.rasterizing import (
    DepthPeeler,
    RasterizeCudaContext,
    RasterizeGLContext,
    get_log_level,
    rasterize,
    set_log_level,
)
from rts_nvdiffrast.texture import texture, texture_construct_mip

__all__ = [
    "DepthPeeler",
    "RasterizeCudaContext",
    "RasterizeGLContext",
    "antialias",
    "antialias_construct_topology_hash",
    "get_log_level",
    "interpolate",
    "rasterize",
    "set_log_level",
    "texture",
    "texture_construct_mip",
]
