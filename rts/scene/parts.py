"""Part, one object of a scene: a surface, its numbers θ, a shader and a transform."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from rts import registry
from rts.arrays.argument_checks import in_short, quoted
from rts.arrays.trees import Array, Tree, record
from rts.errors import InputError


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
    shader: Any = "silhouette"
    transform: Array | None = None
    cull: str = "none"

    def __post_init__(self):
        if not isinstance(self.cull, str) or self.cull not in ("none", "back"):
            raise InputError(f'cull is {quoted(self.cull)}; expected "none" or "back"')
        if type(self.theta) is not dict and not isinstance(self.theta, Mapping):
            raise InputError(f"theta is {quoted(self.theta)}; expected a dict of arrays")
        if isinstance(self.shader, str):
            registry.check_name("rts.shaders", self.shader)

    def __repr__(self) -> str:
        transform = "" if self.transform is None else f", transform={in_short(self.transform)}"
        cull = "" if self.cull == "none" else f", cull={self.cull!r}"
        return f"Part({self.surface!r}, {in_short(self.theta)}, {quoted(self.shader)}{transform}{cull})"

    def replace(self, **changes: Any) -> Part:
        """A copy with some fields changed; its fields are checked again."""
        return replace(self, **changes)
