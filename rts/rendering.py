"""Rendering: sample → evaluate → shade → project → splat, and its two halves."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from rts import registry
from rts.arrays import affine, constants, engine_of, exemplar, from_numbers, is_constant, namespace
from rts.camera import Camera
from rts.errors import InputError
from rts.protocols import Array, GBuffer, Part, Sampled, Samples
from rts.sampling import merge

APRON = 1
"""Cells sampled beyond the image's border on each side, so that they can splat into it."""

BYTES_PER_CELL = 200
"""Rough memory of one cell of one layer through sampling, shading and splatting without gradients."""


def _memory() -> float:
    """Physical memory in bytes, or infinity where the system does not tell."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return math.inf


MEMORY = _memory()

AUTO = {"rts.samplers": "raster", "rts.splatters": "multi"}


def render(
    parts: Part | Sequence[Part],
    camera: Camera,
    size: tuple[int, int],
    *,
    sampler: Any = "auto",
    splatter: Any = "auto",
    layers: int = 2,
    background: Any = None,
    capacity: int | None = None,
) -> Array:
    """Render a scene, differentiably in everything that is a torch or jax array.

    Args:
        parts: one part or several; NumPy arrays in them are constants.
        camera: the camera.
        size: (height, width) in pixels.
        sampler: name or object of a `Sampler`.
        splatter: name or object of a `Splatter`.
        layers: K, the number of surface layers kept at each pixel.
        background: colour (3,) or (4,), or image (H, W, 3 or 4), premultiplied, to composite onto; None for
            transparent.
        capacity: number of rows to allot for the samples of a part inside `jax.jit`, where shapes must be known;
            None for the worst case, every cell of every layer. What does not fit is dropped, deepest layers first:
            `rts.sample` reports how much.

    Returns:
        (H, W, 4) premultiplied linear RGBA, row 0 on top.

    Raises:
        InputError: what was given cannot be rendered.
        EngineError: torch and jax arrays in one scene.
    """
    sampled = sample(parts, camera, size, sampler=sampler, layers=layers, capacity=capacity)
    return render_samples(sampled, parts, camera, splatter=splatter, background=background)


def sample(
    parts: Part | Sequence[Part],
    camera: Camera,
    size: tuple[int, int],
    *,
    sampler: Any = "auto",
    layers: int = 2,
    capacity: int | None = None,
) -> Sampled:
    """The half of `render` without derivative: where the rays through pixel centres meet the surfaces.

    Takes the arguments of `render`. The result may be handed to a function under `jax.jit`.
    """
    parts, camera = _resolve(parts, camera)
    height, width = _check_size(size, layers, capacity)
    chosen = _choose("rts.samplers", sampler)
    engine = engine_of(parts, camera)
    if engine.name != "numpy":
        # Every part is then sampled by the one engine, and by the very matrices that samples are projected with.
        camera = constants(camera, engine, exemplar(parts, camera))
    grid = height + 2 * APRON, width + 2 * APRON
    wide = camera.with_apron((height, width), APRON)
    samples = [chosen.sample(p, wide.within(p.transform), grid, layers, capacity=capacity) for p in parts]
    return merge(samples, layers)


def render_samples(
    sampled: Sampled,
    parts: Part | Sequence[Part],
    camera: Camera,
    *,
    splatter: Any = "auto",
    background: Any = None,
) -> Array:
    """The half of `render` with derivatives: evaluate the parts at the samples, shade, project and splat.

    Args:
        sampled: what `sample` gave for these parts, perhaps with other values in θ, transform and camera.
        parts: as in `render`.
        camera: as in `render`.
        splatter: as in `render`.
        background: as in `render`.

    Returns:
        (H, W, 4) premultiplied linear RGBA.
    """
    parts, camera = _resolve(parts, camera)
    if len(parts) != len(sampled.samples):
        raise InputError(
            f"{len(parts)} parts were given for the samples of {len(sampled.samples)}; pass the same parts"
        )
    splatter = _choose("rts.splatters", splatter)
    engine = engine_of(parts, camera, sampled)
    like = exemplar(parts, camera, sampled)
    if engine.name != "numpy":
        camera, sampled = constants(camera, engine, like), constants(sampled, engine, like)
    grid = tuple(sampled.row.shape[1:])
    wide = camera.with_apron((grid[0] - 2 * APRON, grid[1] - 2 * APRON), APRON)

    positions, colors = [], []
    for part, samples in zip(parts, sampled.samples, strict=True):
        gbuffer = _to_world(_evaluate(part, samples, engine, like), part.transform, engine, like)
        rest = {name: value for name, value in part.theta.items() if name not in _surface_reads(part)}
        theta = constants(rest, engine, like) if engine.name != "numpy" else rest
        rgba = part.shader({**part.theta, **theta}, gbuffer, camera)
        count = gbuffer["position"].shape[0]
        if tuple(rgba.shape) != (count, 4):
            raise InputError(f"the shader {part.shader!r} returned shape {tuple(rgba.shape)}; expected ({count}, 4)")
        positions.append(wide.project(gbuffer["position"], grid))
        colors.append(rgba)
    xp = namespace(sampled.row)
    image = splatter.splat(xp.concat(positions), xp.concat(colors), sampled.row)
    image = image[APRON : grid[0] - APRON, APRON : grid[1] - APRON, :]
    return image if background is None else _over_background(image, background, engine)


def _evaluate(part: Part, samples: Samples, engine: Any, like: Array | None) -> GBuffer:
    """The part's G-buffer in local space."""
    reads = {name: part.theta[name] for name in _surface_reads(part)}
    if samples.gbuffer is not None and is_constant(reads):
        return GBuffer(samples.gbuffer)
    theta = constants(reads, engine, like) if engine.name != "numpy" else reads
    gbuffer = part.surface.evaluate(theta, samples)
    return gbuffer if isinstance(gbuffer, GBuffer) else GBuffer(gbuffer)


def _surface_reads(part: Part) -> tuple[str, ...]:
    return part.surface.reads(part.theta) if hasattr(part.surface, "reads") else tuple(part.theta)


def _to_world(gbuffer: GBuffer, transform: Array | None, engine: Any, like: Array | None) -> GBuffer:
    """Positions and normals moved by the part's transform."""
    if transform is None:
        return gbuffer
    transform = constants(transform, engine, like) if engine.name != "numpy" else transform
    xp = namespace(transform)
    local = GBuffer(gbuffer)
    position = gbuffer["position"]
    local["position"] = xp.stack([affine(transform[i, :], position) for i in range(3)], axis=-1)
    for name in gbuffer:
        if name not in local:
            local.defer(name, lambda name=name: gbuffer[name])
    if "normal" in gbuffer:
        dict.pop(local, "normal", None)
        local.defer("normal", lambda: _move_normals(transform, gbuffer["normal"]))
    return local


def _move_normals(transform: Array, normals: Array) -> Array:
    """Normals under an affine map: times the cofactor matrix, turned so that a mirror image keeps its outside."""
    xp = namespace(transform)
    a, b, c = (transform[:3, i] for i in range(3))
    cofactors = [xp.linalg.cross(b, c), xp.linalg.cross(c, a), xp.linalg.cross(a, b)]
    volume = xp.sum(a * cofactors[0])
    outside = xp.where(volume < 0, -xp.ones_like(volume), xp.ones_like(volume))
    return sum(normals[:, i : i + 1] * (cofactors[i] * outside) for i in range(3))


def _over_background(image: Array, background: Any, engine: Any) -> Array:
    xp = namespace(image)
    if is_constant(background):
        background = engine.constant(np.asarray(background, np.float64), image)
    shape = tuple(background.shape)
    if shape not in ((3,), (4,), (*image.shape[:2], 3), (*image.shape[:2], 4)):
        height, width = image.shape[:2]
        raise InputError(
            f"background has shape {shape}; expected (3,), (4,), ({height}, {width}, 3) or ({height}, {width}, 4)"
        )
    if shape[-1] == 3:
        background = xp.concat([background, xp.ones_like(background[..., :1])], axis=-1)
    return image + (1 - image[..., 3:]) * background


# --------------------------------------------------------------------------------------------------- checks


def _choose(group: str, chosen: Any) -> Any:
    return registry.instance(group, AUTO[group] if chosen == "auto" else chosen)


def _resolve(parts: Part | Sequence[Part], camera: Camera) -> tuple[list[Part], Camera]:
    """Checked parts, with their shaders looked up and plain numbers made arrays."""
    parts = list(parts) if isinstance(parts, Sequence) else [parts]
    if not parts or not all(isinstance(p, Part) for p in parts):
        kinds = ", ".join(type(p).__name__ for p in parts) or "nothing"
        raise InputError(f"parts holds {kinds}; expected an rts.Part or several")
    if not isinstance(camera, Camera):
        raise InputError(f"camera is a {type(camera).__name__}; expected an rts.Camera")
    camera = Camera(*from_numbers(tuple(camera)))
    parts = [p.replace(theta=from_numbers(p.theta), transform=from_numbers(p.transform)) for p in parts]
    for name, matrix in zip(camera._fields, camera, strict=True):
        _check_matrix(f"the camera's {name}", matrix)
    engine_of(parts, camera)
    for index, part in enumerate(parts):
        if part.transform is not None:
            _check_matrix(f"the transform of part {index}", part.transform)
        if hasattr(part.surface, "check"):
            part.surface.check(part.theta)
    return [p.replace(shader=registry.instance("rts.shaders", p.shader)) for p in parts], camera


def _check_matrix(name: str, matrix: Any) -> None:
    if tuple(getattr(matrix, "shape", ())) != (4, 4):
        raise InputError(f"{name} has shape {tuple(getattr(matrix, 'shape', ()))}; expected a (4, 4) array")


def _check_size(size: Any, layers: Any, capacity: Any) -> tuple[int, int]:
    try:
        height, width = (int(s) for s in size)
        whole = (height, width) == tuple(size)
    except (TypeError, ValueError, OverflowError):
        whole = False
    if not whole or height <= 0 or width <= 0:
        raise InputError(f"size is {size!r}; expected (height, width), two positive integers")
    if not isinstance(layers, (int, np.integer)) or layers < 1:
        raise InputError(f"layers is {layers!r}; expected an integer of at least 1")
    if capacity is not None and (not isinstance(capacity, (int, np.integer)) or capacity < 1):
        raise InputError(f"capacity is {capacity!r}; expected an integer of at least 1, or None")
    needed = height * width * layers * BYTES_PER_CELL
    if needed > MEMORY:
        raise InputError(
            f"{height} x {width} pixels with {layers} layers need about {needed / 2**30:.3g} GiB, and this machine has "
            f"{MEMORY / 2**30:.3g} GiB; choose a smaller size or fewer layers"
        )
    return height, width
