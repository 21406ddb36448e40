"""rts: differentiable surface rendering by rasterize-then-splat.

Find where camera rays meet a surface with any ordinary renderer; evaluate the surface there, shade it and splat it;
differentiate only that.
"""

from rts.arrays import namespace
from rts.camera import Camera
from rts.choosing import explain
from rts.errors import EngineError, InputError, LayersWarning, PluginError, RtsError
from rts.fitting import Fit, fit
from rts.gradients import check_gradient, gradient_image
from rts.image_residuals import ImageResiduals
from rts.preparing import prepare
from rts.protocols import Fragments, GBuffer, Part, Proxy, RayHits, Sampled, Samples
from rts.registry import plugin, plugins
from rts.rendering import render, render_samples, sample
from rts.sampling import TriangleSampler
from rts.scenes import load, load_image, save_animation, save_image
from rts.transforms import rigid

__all__ = [
    "Camera",
    "EngineError",
    "Fit",
    "Fragments",
    "GBuffer",
    "ImageResiduals",
    "InputError",
    "LayersWarning",
    "Part",
    "PluginError",
    "Proxy",
    "RayHits",
    "RtsError",
    "Sampled",
    "Samples",
    "TriangleSampler",
    "check_gradient",
    "explain",
    "fit",
    "gradient_image",
    "load",
    "load_image",
    "namespace",
    "plugin",
    "plugins",
    "prepare",
    "render",
    "render_samples",
    "rigid",
    "sample",
    "save_animation",
    "save_image",
]
