"""Types of what the library's functions return, for annotations: `rts.results.Fit` is that of `rts.fit`.

Images are arrays, and have no type of their own.
"""

# pyright: reportUnsupportedDunderAll=false
# Type checkers read `results.pyi`.

from typing import Any

from rts.contracts.records import Sampled
from rts.diagnostics.notebooks import Shown
from rts.diagnostics.profile import Profile
from rts.fitting.fit import Fit
from rts.registry import PluginInfo, load_own
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
    "GradientCheck",  # noqa: F822
    "GradientImage",  # noqa: F822
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


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = load_own(__name__, name)
    return found
