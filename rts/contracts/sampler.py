"""The base of samplers."""

from __future__ import annotations

import abc
from typing import Any

from rts.contracts.records import Request, Samples
from rts.plugin_base import Plugin
from rts.scene.camera import Camera
from rts.scene.parts import Part


class Sampler(Plugin):
    """Finds where rays meet one part: the step without derivative.

    Attributes:
        concurrent: whether several threads may call `sample` at once, so that `rts.render_views` takes views at once.
    """

    concurrent: bool = False

    @abc.abstractmethod
    def sample(self, part: Part, camera: Camera, size: tuple[int, int], layers: int, request: Request) -> Samples:
        """The `layers` nearest samples of every pixel.

        Args:
            part: the part; its `transform` is already in the camera. A sampler that cannot leave out what is seen from
                behind refuses parts with `cull="back"`.
            camera: the camera, in the part's local space.
            size: (height, width) of the grid of cells.
            layers: K.
            request: the number of rows to allot, and what may be found, or left out, besides.

        Returns:
            Samples, without derivative, in arrays of the engine of the part and the camera. Which of their fields are
            there depends on the sampler, the part and the request, never on values.

        Raises:
            InputError: this sampler cannot sample the surface.
        """

    def suited(self, part: Part, camera: Camera | None) -> Sampler:
        """The sampler that is to sample a part: this one or, if this one only chooses, as "auto" does, another.

        Args:
            part: the part.
            camera: the camera; None in `rts.prepare`, which keeps what is built.
        """
        return self

    def hold(self, part: Part, camera: Camera | None, size: tuple[int, int] | None) -> Any:
        """What `rts.prepare` is to build once of a part, and hand to `sample` as `Request.entry`; None for nothing."""
        return None
