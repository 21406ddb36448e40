# Types of `rts.results` for type checkers and editors.

from rts.contracts.records import Sampled
from rts.diagnostics.notebooks import Shown
from rts.diagnostics.profile import Profile
from rts.fitting.fit import Fit
from rts.registry import PluginInfo
from rts.rendering.renderer import PreparedParts, Renderer
from rts.sampling.auto import Choice
from rts.scene.clips import Channel, Clip
from rts.scene.model import Binding, Model, Node, Pose, Skin
from rts_diagnostics.gradient_images import GradientImage
from rts_diagnostics.gradients import GradientCheck

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
