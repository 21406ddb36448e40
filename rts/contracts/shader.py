"""The base class of shaders, and plain functions as shaders."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping

from rts.arrays.argument_checks import quoted
from rts.arrays.trees import Array, Tree
from rts.contracts.gbuffer import GBuffer
from rts.plugin_base import Plugin
from rts.scene.camera import Camera


class Shader(Plugin):
    """A function that colours samples. A plain function with the signature of `__call__` will do, attributes or not.

    The promises `uniform`, `takes_views` and `reads` hold for the `__call__` of the class that states them. A subclass
    that overrides `__call__` has to repeat them, but inherits `opaque`.

    Attributes:
        channels: C, the number of channels besides alpha: 3 for colours, any other number for features.
        opaque: a promise that alpha is 1.
        uniform: a promise that all samples of a part have one colour, through any camera. It may depend on θ.
        takes_views: a promise that one call may take samples of several views, as `rts.render_views` then does:
            `camera` is a `RowCameras`, whose methods give a row for each sample. Such a shader also declares `reads`.
        reads: a promise to need no entries but these, of θ and, besides "position", of the G-buffer; None for all.
            Samples then carry no others. Rendering warns of an unread entry of θ whose name is almost that of a read
            one. `rts.explain` lists all entries of θ that neither surface nor shader reads.
    """

    channels: int = 3
    opaque: bool = False
    uniform: bool = False
    takes_views: bool = False
    reads: tuple[str, ...] | None = None

    @abc.abstractmethod
    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera) -> Array:
        """The colours of N samples, each from its own sample alone: N may be all, or some thousands at a time.

        Args:
            theta: θ of the part.
            gbuffer: its G-buffer, in world space.
            camera: the camera of the whole image; for a shader that `takes_views` it may be a `RowCameras`.

        Returns:
            (N, 4) premultiplied linear RGBA: alpha in [0, 1], colours from 0 on, above 1 where it is bright. With other
            `channels`, (N, C + 1), alpha last; every channel is multiplied by alpha, and otherwise of any value.

        Raises:
            InputError: an entry that the shader needs is missing.
        """


class FunctionShader(Shader):
    """A function as a shader; attributes that the function lacks have the defaults of `Shader`."""

    def __init__(self, function: Callable[..., Array]):
        self.function = function
        for name in ("channels", "opaque", "uniform", "takes_views", "reads"):
            setattr(self, name, getattr(function, name, getattr(Shader, name)))

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera) -> Array:
        """The colours that the function returns; see `Shader`."""
        return self.function(theta, gbuffer, camera)

    def __repr__(self) -> str:
        return quoted(self.function)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FunctionShader) and self.function == other.function

    def __hash__(self) -> int:
        return hash(self.function)
