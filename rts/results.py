"""Types of what the library's functions return, for annotations: `rts.results.Fit` is that of `rts.fit`.

Images are arrays, and have no type of their own.
"""

from rts.contracts.records import Sampled
from rts.diagnostics.gradient_images import GradientImage
from rts.diagnostics.gradients import GradientCheck
from rts.diagnostics.notebooks import Shown
from rts.diagnostics.profile import Profile
from rts.fitting.fit import Fit
from rts.registry import PluginInfo
from rts.rendering.renderer import PreparedParts, Renderer
from rts.sampling.auto import Choice
from rts.scene.clips import Channel, Clip
from rts.scene.model import Binding, Model, Node, Pose, Skin

__all__ = [
    "Binding",
    "Channel",
    "Choice",
    "Clip",
    "Fit",
    "GradientCheck",
    "GradientImage",
    "Model",
    "Node",
    "PluginInfo",
    "Pose",
    "PreparedParts",
    "Profile",
    "Renderer",
    "Sampled",
    "Shown",
    "Skin",
]
