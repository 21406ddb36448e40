"""Where the time of a render goes: its stages one by one, and the setting that would help."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

from rts.arrays.argument_checks import quoted
from rts.arrays.engines import is_constant
from rts.arrays.trees import Array, Tree, leaves, map_leaves
from rts.compiling.process import TORCH_SPINS
from rts.contracts.checks import check_splatter, is_count
from rts.contracts.records import Sampled
from rts.errors import InputError
from rts.rendering.arguments import Layers, SamplerLike, SplatterLike
from rts.rendering.image import image_of
from rts.rendering.samples import sampled_scene
from rts.rendering.settings import RenderSettings
from rts.rendering.splats import to_splats
from rts.sampling.prepared import Prepared
from rts.sampling.scene import Scene
from rts.scene.camera import Camera
from rts.scene.parts import Part
from rts.splatting.channels import cropped_image

_T = TypeVar("_T")

SAMPLING, OUTLINES, SHADING, SPLATTING, BACKWARD = "sample", "outlines", "evaluate and shade", "splat", "gradient"
HINTS = {
    SAMPLING: "if triangles stay the same, rts.prepare sorts them once; many parts of one surface are drawn at once if "
    "they are neighbours in the list and their samplers are alike",
    OUTLINES: "they cost by their length in pixels, and by the number of triangles or of rays that are cast anew at a "
    "field: render fewer pixels while far from the solution (rts.pyramid), or simplify a mesh; splatter='single' takes "
    "none, for coarse gradients",
    SHADING: "shaders run on each covered pixel: a mask needs only 'silhouette', and promises of `opaque` and `reads` "
    "spare layers and attributes; θ in NumPy is a constant, and is evaluated without derivative",
    SPLATTING: "fewer pixels, samples a pixel or layers; opaque=True where no light passes through",
    BACKWARD: "only torch and jax arrays are differentiated: leave what is not fitted in NumPy",
}
"""Advice for the stage that takes most."""

SPINNING = (
    "\nTorch was imported before rts: its idle threads may take cores. "
    "Import rts first, or set OMP_WAIT_POLICY=PASSIVE and GOMP_SPINCOUNT=1000."
)


class StageTime(NamedTuple):
    """One stage of a render.

    Attributes:
        name: "sample", "outlines", "evaluate and shade", "splat", or "gradient", the whole of backward.
        first: milliseconds of the first call, in which loops may be compiled and structures built.
        later: the median of later calls, milliseconds.
        rows: number of samples, entries of the stencil, splats or pixels; for a gradient, of numbers differentiated by.
        megabytes: of the arrays that it makes; 0 for a gradient.
    """

    name: str
    first: float
    later: float
    rows: int
    megabytes: float


class Profile(NamedTuple):
    """Where the time of a render goes. Its text is a table.

    Attributes:
        stages: in order.
        parts: the number of parts.
        hint: what would help most.
    """

    stages: tuple[StageTime, ...]
    parts: int
    hint: str

    def __str__(self) -> str:
        total = sum(stage.later for stage in self.stages)
        lines = [f"{'':20}{'first, ms':>12}{'later, ms':>12}{'share':>8}{'rows':>10}{'MB':>8}"]
        for name, first, later, rows, megabytes in self.stages:
            share = f"{100 * later / total:.0f} %"
            lines.append(f"{name:20}{first:>12.1f}{later:>12.2f}{share:>8}{rows:>10}{megabytes:>8.1f}")
        lines.append(f"{'':20}{sum(stage.first for stage in self.stages):>12.1f}{total:>12.2f}")
        longest = max(self.stages, key=lambda stage: stage.later).name
        parts = "1 part" if self.parts == 1 else f"{self.parts} parts"
        late = SPINNING if TORCH_SPINS else ""
        return "\n".join([*lines, f"{parts}. Most time: {longest}; {self.hint}.{late}"])


def profile(
    parts: Part | Sequence[Part] | Prepared,
    camera: Camera,
    size: tuple[int, int],
    *,
    sampler: SamplerLike = "auto",
    splatter: SplatterLike = "auto",
    layers: Layers = "auto",
    supersample: int = 1,
    repeats: int = 5,
) -> Profile:
    """Measure where the time of `rts.render` goes, stage by stage, and of its gradient in torch or jax arrays.

    Stages are run one after the other, each `repeats` times. The gradient is that of the image's mean with respect to
    all torch or jax arrays of floats in the parts.

    Args:
        parts: as in `rts.render`.
        camera: as in `rts.render`.
        size: (height, width) in pixels.
        sampler: as in `rts.render`.
        splatter: as in `rts.render`.
        layers: as in `rts.render`.
        supersample: as in `rts.render`.
        repeats: number of later calls, whose median is taken.

    Returns:
        The stages: print it for a table, with a hint.

    Raises:
        InputError: an argument is wrong; the scene cannot be rendered.
    """
    if not is_count(repeats):
        raise InputError(f"repeats is {quoted(repeats)}; expected a number of calls, at least 1")
    scene = Scene.of(parts, camera, sampler, None)
    size, settings = RenderSettings.checked(size, splatter, layers, supersample, None)
    scene = scene.at(size)
    settings, context = settings.of(scene), scene.context
    chosen = settings.splatter
    assert chosen is not None

    def timed(make: Callable[[], _T]) -> tuple[_T, float, float]:
        """The result of a function, and the milliseconds of its first call and of later ones."""
        times, result = [], None
        for _ in range(repeats + 1):
            start = time.perf_counter()
            result = make()
            for array in list(leaves(result))[-1:]:  # Waits for devices.
                context.engine.to_numpy(array)
            times.append(1e3 * (time.perf_counter() - start))
        assert result is not None
        return result, times[0], statistics.median(times[1:])

    def sampled_with(settings: RenderSettings) -> Sampled:
        return sampled_scene(scene, settings.grid(scene, scene.camera, size), settings)

    stages = []
    if settings.finds_outlines:
        plain = replace(settings, splatter=check_splatter("none"))
        bare, first, later = timed(lambda: sampled_with(plain))
        stages.append(StageTime(SAMPLING, first, later, _rows(bare), _megabytes(bare)))
    sampled, whole_first, whole_later = timed(lambda: sampled_with(settings))
    if stages:
        found, before = sampled.stencil, stages[0]
        count = 0 if found is None else found.color_cell.shape[0] + found.motion_cell.shape[0]
        spent = max(whole_first - before.first, 0.0), max(whole_later - before.later, 0.0)
        stages.append(StageTime(OUTLINES, *spent, count, _megabytes(found)))
    else:
        stages.append(StageTime(SAMPLING, whole_first, whole_later, _rows(sampled), _megabytes(sampled)))
    grid = settings.grid(scene, scene.camera, size)
    splats, first, later = timed(lambda: to_splats(sampled, scene.parts, scene.camera, grid, context))
    stages.append(StageTime(SHADING, first, later, splats.rgba.shape[0], _megabytes((splats.positions, splats.rgba))))
    image, first, later = timed(lambda: cropped_image(chosen, splats))
    stages.append(StageTime(SPLATTING, first, later, size[0] * size[1], _megabytes(image)))
    if context.engine.differentiates:
        spent = sum(stage.later for stage in stages)
        first, later, count = _gradient(scene, size, settings, timed)
        if count:
            stages.append(StageTime(BACKWARD, max(first - spent, 0.0), max(later - spent, 0.0), count, 0.0))
    longest = max(stages, key=lambda stage: stage.later)
    return Profile(tuple(stages), len(scene.parts), HINTS[longest.name])


def _gradient(scene: Scene, size: tuple[int, int], settings: RenderSettings, timed: Any) -> tuple[float, float, int]:
    """Milliseconds of the first and of later calls of value and gradient, and the number of unknowns."""
    engine = scene.context.engine
    tree = [(part.theta, part.transform) for part in scene.parts]
    xp = engine.namespace
    arrays = [x for x in leaves(tree) if not is_constant(x) and xp.isdtype(x.dtype, "real floating")]
    known = {id(x) for x in arrays}
    if not arrays:
        return 0.0, 0.0, 0

    def loss(unknowns: Sequence[Array]) -> Array:
        it = iter(unknowns)
        changed: Tree = map_leaves(lambda x: next(it) if id(x) in known else x, tree)
        parts = [
            replace(part, theta=theta, transform=transform)
            for part, (theta, transform) in zip(scene.parts, changed, strict=True)
        ]
        return xp.mean(image_of(scene._replace(parts=parts), size, scene.context, settings))

    both = engine.value_and_grad(loss)
    _, first, later = timed(lambda: both([engine.stop_gradient(x) for x in arrays]))
    return first, later, sum(int(x.size if isinstance(x.size, int) else x.numel()) for x in arrays)


def _rows(sampled: Sampled) -> int:
    """The number of samples."""
    return sum(samples.ids.shape[-2] for samples in sampled.samples)


def _megabytes(tree: Tree) -> float:
    """The size of arrays."""
    return sum(x.nbytes for x in leaves(tree) if hasattr(x, "nbytes")) / 1e6
