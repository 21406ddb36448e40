"""From the G-buffer to colours: light, textures, and what shaders share; the built-in shaders."""

from rts.shading.environment import prefiltered, turned_environment
from rts.shading.shaders import facing_normals
from rts.shading.spherical_harmonics import harmonics, irradiance
from rts.shading.tangents import tangent_frame
from rts.shading.textures import sample_texture
from rts.shading.tone_mapping import tonemap

__all__ = [
    "facing_normals",
    "harmonics",
    "irradiance",
    "prefiltered",
    "sample_texture",
    "tangent_frame",
    "tonemap",
    "turned_environment",
]
