"""A checked scene, shared by sampling and shading, and the grids of cells that it is sampled on."""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import Any, NamedTuple

from rts.advice.bright_textures import warn_of_bright_textures
from rts.advice.coarse_coordinates import warn_of_coarse_coordinates
from rts.advice.unread_entries import warn_of_unread
from rts.advice.winding import warn_of_winding
from rts.arrays.engines import Context, context_of_scene, is_traced
from rts.arrays.trees import Tree, leaves
from rts.contracts.checked_parts import CheckedPart, check_scene
from rts.contracts.checks import check_ratio, check_sampler, sampler_for_part
from rts.contracts.records import Sampled
from rts.contracts.sampler import Sampler
from rts.contracts.surface import TriangleSurface
from rts.plugin_base import is_subclass
from rts.sampling.prepared import Prepared
from rts.sampling.triangle_sampler import TriangleSampler
from rts.scene.camera import Camera
from rts.scene.parts import Part

_OPAQUE, _READ = attrgetter("shader.opaque"), attrgetter("read")


class Scene(NamedTuple):
    """A checked scene.

    Attributes:
        parts: checked parts.
        camera: the camera of the whole image.
        samplers: the sampler of each part.
        entries: the structure that each sampler has built for its part, or None.
        context: the engine of parts and camera, and an array that sets dtype and device of its constants.
        cameras: the camera of the grid in the local space of each part, where it is known already.
    """

    parts: list[CheckedPart]
    camera: Camera
    samplers: Sequence[Sampler]
    entries: Sequence[Any]
    context: Context
    cameras: Sequence[Camera] = ()

    @property
    def channels(self) -> int:
        """The number of channels of the shaders, besides alpha."""
        return self.parts[0].shader.channels

    @property
    def opaque(self) -> list[bool]:
        """For each part, whether its shader promises to be opaque."""
        return list(map(bool, map(_OPAQUE, self.parts)))

    @property
    def read(self) -> list[dict[str, Tree]]:
        """The entries of each part's θ that its surface reads."""
        return list(map(_READ, self.parts))

    @property
    def traced(self) -> bool:
        """True if it depends on traced values where samples lie."""
        return any(map(is_traced, leaves((self.read, [part.transform for part in self.parts], self.camera))))

    @classmethod
    def of(cls, parts: Part | Sequence[Part] | Prepared, camera: Camera, sampler: Any, engine: str | None) -> Scene:
        """The checked scene of a user's arguments."""
        prepared = isinstance(parts, Prepared)
        checked, camera = check_scene(parts.parts if prepared else parts, camera)
        warn_of_unread(checked)
        warn_of_bright_textures(checked)
        warn_of_winding(checked, camera)
        if prepared:
            fields = parts.samplers, parts.entries
        else:
            sampler_object = check_sampler(sampler)
            fields = [sampler_for_part(sampler_object, part, camera) for part in checked], [None] * len(checked)
        return cls(checked, camera, *fields, context_of_scene(checked, camera, engine=engine))

    def at(self, size: tuple[int, int]) -> Scene:
        """The scene with its camera made for images of a size.

        An AspectWarning if the camera is for another ratio; an InputWarning if coordinates are too large for float32.
        """
        check_ratio(self.camera, size)
        camera = self.camera.for_size(size)
        warn_of_coarse_coordinates(self.parts, camera, size, self.context)
        return Scene(self.parts, camera, *self[2:])

    def local_camera(self, part: int, grid: Grid) -> Camera:
        """The camera of a grid in the local space of a part."""
        cameras = self.cameras or grid.cameras
        return cameras[part] if cameras else grid.camera.within(self.parts[part].transform)

    def context_with(self, *others: Tree) -> Context:
        """The context of the scene and further arrays, such as a background; the scene's own if none differentiates."""
        context = context_of_scene(self.parts, self.camera, *others)
        return context if context.engine.differentiates else self.context


def lies_on_triangles(part: CheckedPart, sampler: Sampler) -> bool:
    """True if all samples of a part lie on triangles, which tell where its outlines are."""
    surface: Any = part.surface
    if not (is_subclass(type(sampler), TriangleSampler) and is_subclass(type(surface), TriangleSurface)):
        return False
    return not (surface.refines and surface.refine_moves)


class Grid(NamedTuple):
    """A grid of cells: its camera and its size (height, width), and the camera in each part's local space, if known."""

    camera: Camera
    size: tuple[int, int]
    cameras: Sequence[Camera] = ()

    @classmethod
    def of_samples(cls, sampled: Sampled, parts: Sequence[Part], camera: Camera, context: Context) -> Grid:
        """The grid of samples of parts that are seen by a camera; see `of_parts`."""
        height, width = (n - 2 * sampled.border for n in sampled.row.shape[1:])
        return cls.of_parts(parts, camera, (height, width), sampled.border, context)

    @classmethod
    def of_parts(
        cls, parts: Sequence[Part], camera: Camera, size: tuple[int, int], border: int, context: Context
    ) -> Grid:
        """The grid of an image (height, width) of cells with a border, in which there are parts.

        The views of cameras are arrays of the context's engine, if it differentiates.
        """
        # One engine samples every part, through the same matrices that later project the samples.
        if context.engine.differentiates:
            camera = camera.replace(view=context.constants(camera.view))
        cells = size[0] + 2 * border, size[1] + 2 * border
        camera = camera.window(size, (-border, -border), cells)
        return cls(camera, cells, [camera.within(part.transform) for part in parts])
