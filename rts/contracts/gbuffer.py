"""The attributes of samples, some of them computed only when read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

from rts.errors import InputError
from rts.operations.unit import unit

FOOTPRINT, STEPS = "uv_footprint", "uv_steps"
"""Names of attributes; see `GBuffer`."""


class GBuffer(dict):
    """Attributes of the samples by name, each (N, C); "position" (N, 3) is required.

    Surfaces return attributes in local space; shaders receive positions and normals in world space. An attribute may be
    deferred: it is computed when first read, as `gbuffer[name]`, so a shader pays for what it reads. Reading a missing
    attribute raises an `InputError`.

    Built-in surfaces use the names position, normal, uv and color. Meshes, whose normals are interpolated, also give
    "face_normal" (N, 3), that of the triangle on either side, of any length. If there is "uv",
    shaders also receive "uv_footprint" (N, 4): ∂u/∂x, ∂v/∂x, the change of uv to the cell on the right, and ∂u/∂y,
    ∂v/∂y, the change to the cell below; without derivative. A surface that gives "uv_steps" (N, 10), constant, saves
    two evaluations for it: how position, in local space, changes along both parameters of a sample, three numbers each,
    then how uv does. If there are "uv" and "normal", they receive "tangent" (N,
    4), unless the surface has one: the direction in which u grows, and a sign. The direction of v is sign · normal ×
    tangent. Coordinates of normal maps alone, "uv_normal_map", take the place of "uv" there.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._deferred: dict[str, Callable[[], Any]] = {}
        self._units: dict[str, tuple[Any, Any]] = {}
        self._like = None
        self._check: Callable[[str, Any], None] | None = None

    def check(self, check: Callable[[str, Any], None]) -> None:
        """Check all attributes by `check(name, attribute)`, deferred ones once they are computed."""
        self._check = check
        for name, value in super().items():
            check(name, value)

    @property
    def like(self) -> Any:
        """An array (N, ·), a row for each sample, for its dtype and device, where no attribute is needed."""
        return self["position"] if self._like is None else self._like

    @property
    def computed(self) -> dict[str, Any]:
        """Attributes computed so far, among them the deferred ones that have been read."""
        return {name: self[name] for name in super().__iter__()}

    def defer(self, name: str, compute: Callable[[], Any]) -> None:
        """Add an attribute that is computed by `compute()` when first read."""
        self._deferred[name] = compute

    def changed(self, changes: Mapping[str, Callable[[Any], Any]]) -> GBuffer:
        """A G-buffer of the same attributes, of which `changes` turns some into others; all are computed when read."""
        other = GBuffer()
        other._like = self["position"] if self._like is None else self._like
        for name in self:
            read, change = partial(self.__getitem__, name), changes.get(name)
            other._deferred[name] = read if change is None else lambda read=read, change=change: change(read())
        return other

    def unit(self, name: str) -> Any:
        """An attribute of vectors (N, 3), scaled to length one; a zero vector stays zero.

        Computed when first read, like deferred attributes: with the derivatives that it has there.
        """
        vectors = self[name]
        if name not in self._units or self._units[name][0] is not vectors:
            self._units[name] = vectors, unit(vectors)
        return self._units[name][1]

    def __missing__(self, name: str) -> Any:
        if name not in self._deferred:
            raise InputError(
                f"the shader reads {name!r}, but the surface provides {', '.join(map(repr, self))}; "
                f"add the attribute to the part's theta or choose another shader"
            )
        value = self._deferred[name]()
        if self._check is not None:
            self._check(name, value)
        self[name] = value
        self._deferred.pop(name, None)
        return value

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or name in self._deferred

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys([*super().__iter__(), *self._deferred]))
