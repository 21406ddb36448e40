"""The base class of samplers. Those of triangles derive from `rts.TriangleSampler`, and write `rasterize` alone."""

from __future__ import annotations

import abc
from typing import Any

from rts.contracts.records import Request, Samples
from rts.plugin_base import Plugin
from rts.scene.camera import Camera
from rts.scene.parts import Part


class Sampler(Plugin):
    """The step without derivative: it finds where the rays of cells meet one part.

    Attributes:
        concurrent: whether several threads may call `sample` at once, so that `rts.render_views` takes views at once.
    """

    concurrent: bool = False

    @abc.abstractmethod
    def sample(self, part: Part, camera: Camera, size: tuple[int, int], layers: int, request: Request) -> Samples:
        """The `layers` nearest samples of every cell.

        Args:
            part: the part, whose `transform` is already in the camera. A sampler that cannot ignore triangles seen from
                behind refuses parts with `cull="back"`.
            camera: the camera, in the part's local space.
            size: (height, width) of the grid of cells.
            layers: K.
            request: the number of rows to allot, and further options.

        Returns:
            Samples, without derivative, in arrays of the engine of the part and the camera. Which fields are None
            depends on the sampler, the part and the request, never on values in arrays.

        Raises:
            InputError: this sampler cannot sample the part.
        """

    def sampler_for(self, part: Part, camera: Camera | None) -> Sampler:
        """The sampler for a part: this one, or another if this one only chooses among samplers, as "auto" does.

        Args:
            part: the part.
            camera: the camera; None in `rts.prepare`.
        """
        return self

    def prepare_part(self, part: Part, camera: Camera | None, size: tuple[int, int] | None) -> Any:
        """A structure that `rts.prepare` builds once for a part, such as a tree; None for nothing.

        `sample` receives it as `Request.entry`.
        """
        return None
