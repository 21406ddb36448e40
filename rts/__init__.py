"""rts: differentiable surface rendering by rasterize-then-splat.

With any ordinary renderer, find where camera rays meet a surface; evaluate it there, shade it and splat it;
differentiate only that.

Names that only plugins need are in `rts.plugin_api`, the kinds of warnings in `rts.errors`, types of results in
`rts.results`, shadows in `rts.shadows`.

The built-in surfaces are attributes of `rts`, imported on first use: `rts.Mesh`, `rts.Bezier`, `rts.BSpline`,
`rts.Revolution`, `rts.Subdivision`, `rts.Isosurface`, `rts.Sdf` and `rts.Skinned`. So are `rts.tune`, of the package
`rts_compare`, `rts.check_gradient` and `rts.gradient_image`, of `rts_diagnostics`, `rts.NarrowBand`, `rts.Ndc` and
`rts.load_radiance_field`.
"""

# pyright: reportUnsupportedDunderAll=false
# Type checkers read `__init__.pyi`, which declares the names that are imported on first use.

import importlib

from rts import errors as errors
from rts import registry
from rts.arrays.engine_base import Engine
from rts.arrays.engines import engine_of, namespace
from rts.contracts.gbuffer import GBuffer
from rts.contracts.sampler import Sampler
from rts.contracts.shader import Shader
from rts.contracts.splatter import Splatter
from rts.contracts.surface import Evaluator, RaySurface, Surface, TriangleSurface
from rts.errors import InputError, RtsError
from rts.registry import plugin, plugins
from rts.rendering.arguments import Adaptive as Adaptive
from rts.rendering.image import render, render_samples
from rts.rendering.renderer import prepare
from rts.rendering.samples import sample
from rts.sampling.triangle_sampler import TriangleSampler
from rts.scene.camera import Camera
from rts.scene.parts import Part
from rts.scene.rigid import rigid

_LATER = {
    "rts.compiling.warmup": "warmup",
    "rts.contracts.residuals": "Residuals",
    "rts.diagnostics.explain": "explain",
    "rts.diagnostics.notebooks": "show",
    "rts.diagnostics.profile": "profile",
    "rts.files.images": "load_image save_animation save_image",
    "rts.files.models": "load",
    "rts.files.moving_models": "load_model",
    "rts.files.views.loading": "load_views",
    "rts.files.views.saving": "save_views",
    "rts.fitting.fit": "fit",
    "rts.fitting.image_residuals": "ImageResiduals",
    "rts.fitting.large_steps": "LargeSteps",
    "rts.fitting.losses": "Loss",
    "rts.fitting.schedule": "Stage pyramid",
    "rts.fitting.view_residuals": "ViewResiduals",
    "rts.rendering.program": "program",
    "rts.scene.view": "View",
    "rts.views.render_views": "render_views",
}
"""Module → names of `rts` that are imported from there on first use, separated by spaces: a render needs none."""

_PLACES = {name: place for place, names in _LATER.items() for name in names.split()}
_MODULES = "regularizers", "results", "shadows"
"""Modules that are attributes of `rts`, too."""

_MOVED = {
    "rts.errors": "AspectWarning EmptyImageWarning EngineError FileWarning InputWarning "
    "LayersWarning PluginError RtsWarning SamplerWarning ToleranceWarning",
    "rts.plugin_api.operations": "Operation combine gradient",
    "rts.plugin_api.records": "ArraySpec Fragments Proxy Rate RayHits Rays Samples Splats",
    "rts.plugin_api.splats": "SummingSplatter",
    "rts.splatting": "exact_calibration",
}
"""Module → names that moved there from `rts`, separated by spaces."""


_GONE = {
    "Fit": "rts.fit returns rts.results.Fit",
    "RowCameras": "rts.Camera.stack makes one record of several cameras",
    "Sampled": "it is the type of what rts.sample returns",
    "Tuned": "it is the type of what rts.tune returns",
    "transforms": "rts.Camera.look_at, .perspective and .orthographic make cameras, rts.rigid the matrix of a pose",
    "volume_render": "the result of rts.load_radiance_field has the method volume_render",
}
"""Names of earlier versions that are no names of `rts` any more → what there is instead."""


def __getattr__(name: str):
    """The name, imported on first use: built-in surfaces and functions of other packages through entry points."""
    if name in _MODULES:
        return importlib.import_module(f"rts.{name}")
    if name in _PLACES:
        found = globals()[name] = getattr(importlib.import_module(_PLACES[name]), name)
        return found
    if name in _GONE:
        raise AttributeError(f"rts.{name} is gone: {_GONE[name]}")
    for place, names in _MOVED.items():
        if name in names.split():
            errors.warn_deprecated(f"rts.{name}", f"{place}.{name}", until="0.4")
            return getattr(importlib.import_module(place), name)
    found = globals()[name] = registry.attribute(name, __all__)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_PLACES, *_MODULES, *registry.built_in_attributes()})


__version__ = "0.3.0.dev0"

__all__ = [
    "Camera",
    "Engine",
    "Evaluator",
    "GBuffer",
    "ImageResiduals",
    "InputError",
    "LargeSteps",
    "Loss",
    "Part",
    "RaySurface",
    "Residuals",
    "RtsError",
    "Sampler",
    "Shader",
    "Splatter",
    "Stage",
    "Surface",
    "TriangleSampler",
    "TriangleSurface",
    "View",
    "ViewResiduals",
    "check_gradient",
    "engine_of",
    "explain",
    "fit",
    "gradient_image",
    "load",
    "load_image",
    "load_radiance_field",
    "load_views",
    "namespace",
    "plugin",
    "plugins",
    "prepare",
    "profile",
    "program",
    "pyramid",
    "render",
    "render_samples",
    "render_views",
    "rigid",
    "sample",
    "save_animation",
    "save_image",
    "save_views",
    "show",
    "tune",
    "warmup",
]
