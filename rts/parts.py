"""Part, one object of a scene: a surface, its numbers θ, a shader and a place."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from rts import registry
from rts.arguments import quoted
from rts.errors import InputError
from rts.interfaces import Shader, Surface
from rts.plugin_base import promised
from rts.trees import Array, Tree, record


@record(static=("surface", "shader", "cull"))
class Part:
    """One object of a scene.

    Attributes:
        surface: the topology, a `Surface`; immutable.
        theta: nested dict of every number of the part: vertices or control points, texture, lights, weights.
        shader: a `Shader`, the name of a registered one, or any function with the same signature.
        transform: (4, 4) world-from-local affine map, differentiable, or None for the identity.
        cull: "none", or "back" to ignore triangles seen from behind. Never inferred.
    """

    surface: Any
    theta: Mapping[str, Tree]
    shader: Shader | Callable[..., Array] | str = "silhouette"
    transform: Array | None = None
    cull: str = "none"

    def __post_init__(self):
        if not isinstance(self.cull, str) or self.cull not in ("none", "back"):
            raise InputError(f'cull is {quoted(self.cull)}; expected "none" or "back"')
        if not isinstance(self.theta, Mapping):
            raise InputError(f"theta is {quoted(self.theta)}; expected a dict of arrays")
        if isinstance(self.shader, str):
            registry.check_name("rts.shaders", self.shader)

    def replace(self, **changes: Any) -> Part:
        """A copy with some fields changed."""
        return replace(self, **changes)


@record(static=("surface", "shader", "cull"))
class CheckedPart(Part):
    """A part whose surface and shader are of their bases, as `rts.checks` makes it."""

    surface: Surface
    theta: Mapping[str, Tree]
    shader: Shader  # pyright: ignore[reportGeneralTypeIssues]  # It is always given.
    transform: Array | None = None
    cull: str = "none"

    @property
    def uniform(self) -> bool:
        """Whether its shader promises one colour."""
        return promised(self.shader, "uniform")

    @property
    def takes_views(self) -> bool:
        """Whether its shader promises to take samples of several views."""
        return promised(self.shader, "takes_views")

    @property
    def reads(self) -> tuple[str, ...] | None:
        """The entries that its shader promises to do with, of the G-buffer and of θ; None for all."""
        return promised(self.shader, "reads")
