"""Shadows of any surface, with derivatives: a scene is sampled from its lights, and these samples hide points.

`with_shadows` gives a light its shadows; `seen_from` and `visibility` are its two halves, of use for other questions of
what is seen from where.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rts.arrays.argument_checks import check_numbers, quoted
from rts.arrays.array_functions import dot, from_numbers, promote, shape_of
from rts.arrays.engines import constants, engine_of, namespace, stopped, uncompiled, value_of
from rts.arrays.trees import Array, map_leaves
from rts.contracts.checked_parts import check_parts, listed_parts
from rts.contracts.checks import check_size, is_count
from rts.errors import InputError
from rts.operations.unit import unit
from rts.rendering.arguments import Layers, SamplerLike
from rts.rendering.samples import sampled_scene
from rts.rendering.settings import RenderSettings
from rts.rendering.splats import to_splats
from rts.sampling.scene import Scene
from rts.scene.camera import Camera
from rts.scene.default_camera import MARGIN, Bounds, bounds_of
from rts.scene.parts import Part
from rts.shading.light import check_light
from rts.shading.visibility import DepthPicture, Seen, picture_of, visibility

__all__ = ["Seen", "seen_from", "visibility", "with_shadows"]

INSIDE = 1.25
"""Point lights nearer to the scene's centre than so many radii see it in six pictures, which make a cube."""
NEAREST = 0.01
"""The depth of the near plane of a point light inside the scene, in radii."""


@uncompiled
def seen_from(
    parts: Part | Sequence[Part],
    camera: Camera,
    size: tuple[int, int],
    *,
    sampler: SamplerLike = "auto",
    layers: Layers = "auto",
    capacity: int | None = None,
    engine: str | None = None,
) -> Seen:
    """Sample a scene from a camera, for `visibility`: a picture of depths, differentiable as the parts are.

    Args:
        parts: as in `rts.render`.
        camera: as in `rts.render`; a light's point of view, for instance.
        size: (height, width) in pixels. Edges of what is hidden are sharp to a pixel or two.
        sampler: as in `rts.render`.
        layers: as in `rts.render`, of translucent parts; opaque ones need one layer.
        capacity: as in `rts.render`.
        engine: as in `rts.render`.

    Returns:
        A record of arrays, which may be an argument of `jax.jit`, and be kept as long as nothing moves.

    Raises:
        InputError: an argument is wrong; the scene cannot be sampled.
        EngineError: torch and jax arrays in one scene, or arrays on two devices.
        PluginError: a plugin cannot be imported, such as for want of a package.
    """
    scene = Scene.of(parts, camera, sampler, engine)
    size = check_size(size, layers, capacity, 1)
    solid = [part.replace(theta=part.read, shader="silhouette") for part in scene.parts if part.shader.opaque]
    settings = camera, size, sampler
    pictures = [_picture(solid, *settings, 1, capacity, engine)] if solid else []
    # Translucent parts have pictures of their own, so that what they hide is hidden where they end, too.
    for part in scene.parts:
        if not part.shader.opaque:
            pictures.append(_picture([_without_shadow(part)], *settings, layers, capacity, engine))
    return Seen(tuple(pictures))


def _picture(
    parts: Sequence[Part], camera: Camera, size: tuple[int, int], sampler: Any, layers: Any, capacity: Any, engine: Any
) -> DepthPicture:
    """The picture of parts that have one number of layers."""
    scene = Scene.of(parts, camera, sampler, engine).at(size)
    settings = RenderSettings(None, layers, 1, capacity).of(scene)
    grid = settings.grid(scene, scene.camera, size)
    sampled = sampled_scene(scene, grid, settings, one_shader=False)
    opaque, context = all(scene.opaque), scene.context
    if opaque and not context.engine.differentiates:
        depth, row, place = context.constants((sampled.depth, sampled.row, scene.camera))
        # Nothing moves, so that one sample stands for all.
        return picture_of(depth, context.engine.constant(np.zeros((1, 3)), depth), row, place, size, opaque)
    splats = to_splats(sampled, scene.parts, scene.camera, grid, context)
    positions, row, engine = splats.positions, splats.row, engine_of(splats.positions)
    depth, place = constants((stopped(sampled.depth), scene.camera), engine, positions)
    if not positions.shape[0]:
        positions = constants(np.zeros((1, 3)), engine, positions)
    xp = namespace(positions)
    samples = positions if opaque else xp.concat([positions[:, :2], splats.rgba[:, -1:]], axis=1)
    depth = xp.astype(depth, positions.dtype, copy=False)
    return picture_of(depth, samples, row, place, size, opaque)


def _without_shadow(part: Part) -> Part:
    """The part whose light has no shadows: alpha does not depend on light."""
    light = part.theta.get("light")
    if not isinstance(light, Mapping) or "shadow" not in light:
        return part
    return part.replace(theta={**part.theta, "light": {k: v for k, v in light.items() if k != "shadow"}})


def with_shadows(
    parts: Part | Sequence[Part],
    light: Mapping[str, Any],
    *,
    size: int = 512,
    bounds: tuple[Any, float] | None = None,
    sampler: SamplerLike = "auto",
    layers: Layers = "auto",
    capacity: int | None = None,
) -> list[Part]:
    """The parts in a light that casts shadows: `seen_from` of each distant and each point light.

    Args:
        parts: one part or several; all of them cast shadows, those that are culled from either side.
        light: θ["light"] of all parts, see `rts.shading.light`, with "direction" or "position". Light from all around
            casts no shadow.
        size: height and width of each picture, pixels. A pixel as large as one of the image's is best:
            derivatives at edges that are narrower than samples are noise.
        bounds: (center, radius) of a sphere around all that casts or receives shadows, world space, known numbers;
            None to find it. Needed where the parts are traced, as in `jax.jit`. Where the position of a point light is
            traced, it has six pictures, in which things far from it are small.
        sampler: as in `rts.render`.
        layers: as in `seen_from`.
        capacity: as in `rts.render`, of each picture.

    Returns:
        The parts with the light, and its "shadow", in their θ. Call this again whenever something moves.

    Raises:
        InputError: an argument is wrong; the light has no place or direction; or the scene is traced, without bounds.
    """
    part_list = listed_parts(parts)
    check_parts(part_list)
    if not isinstance(light, Mapping) or not ("direction" in light or "position" in light):
        raise InputError(f"light is {quoted(light)}; expected a dict with the 'direction' or 'position' of a light")
    if "color" in light and "direction" not in light:
        raise InputError("light has a 'color' of distant lights, but no 'direction'; give both")
    check_light({name: value for name, value in light.items() if name != "shadow"})
    if not is_count(size):
        raise InputError(f"size is {quoted(size)}; expected one number of pixels: pictures of lights are square")
    sphere = _sphere(part_list, bounds)
    cameras = [[_distant_camera(d, sphere)] for d in _vectors(light, "direction")]
    cameras += [_point_cameras(p, sphere) for p in _vectors(light, "position")]
    settings: dict[str, Any] = {"sampler": sampler, "layers": layers, "capacity": capacity}
    shadows, casters = [], [part.replace(cull="none") for part in part_list]
    for several in cameras:
        records = [seen_from(casters, camera, (size, size), **settings) for camera in several]
        shadows.append(Seen(tuple(picture for one in records for picture in one.pictures)))
    shadowed = {**light, "shadow": shadows}
    return [part.replace(theta={**part.theta, "light": shadowed}) for part in part_list]


def _vectors(light: Mapping[str, Any], name: str) -> list[Array]:
    """The vectors (3,) of an entry (3,) or (L, 3); none if there is no such entry."""
    if name not in light:
        return []
    vectors = from_numbers(light[name], f"light[{name!r}]")
    if shape_of(vectors)[-1:] != (3,) or len(shape_of(vectors)) > 2:
        raise InputError(f"light[{name!r}] is {quoted(light[name])}; expected vectors (3,) or (L, 3)")
    vectors = namespace(vectors).reshape(vectors, (-1, 3))
    return [vectors[i, :] for i in range(vectors.shape[0])]


def _sphere(parts: Sequence[Part], bounds: Any) -> Bounds:
    """The sphere around the parts, as given or found."""
    if bounds is not None:
        ok = isinstance(bounds, (list, tuple)) and len(bounds) == 2
        center = check_numbers("the center of bounds", bounds[0], (3,)) if ok else None
        radius = check_numbers("the radius of bounds", bounds[1], ()) if ok else None
        if center is None or radius is None or radius <= 0:
            raise InputError(
                f"bounds is {quoted(bounds)}; expected (center, radius) of a sphere around the scene, known numbers"
            )
        return Bounds(center, float(radius))

    def known(x: Any) -> Any:
        value = value_of(x)
        if value is None:
            raise InputError("the scene is traced, so its extent is not known; give bounds=(center, radius)")
        return value

    return bounds_of(
        [
            part.replace(theta=map_leaves(known, _read(index, part)), transform=map_leaves(known, part.transform))
            for index, part in enumerate(parts)
        ]
    )


def _read(index: int, part: Part) -> dict[str, Any]:
    """The entries of θ that the part's surface reads."""
    missing = [name for name in part.surface.reads(part.theta) if name not in part.theta]
    if missing:
        raise InputError(f"part {index} lacks {', '.join(f'theta[{name!r}]' for name in missing)}")
    return {name: part.theta[name] for name in part.surface.reads(part.theta)}


def _distant_camera(direction: Array, sphere: Bounds) -> Camera:
    """The camera of a distant light, which sees all of a sphere."""
    value, reach = value_of(direction), MARGIN * sphere.radius
    if value is not None and not value.any():
        raise InputError("light['direction'] is zero; expected a vector towards the light")
    _, (toward, center) = promote(unit(direction), sphere.center)
    return Camera.orthographic(center + reach * toward, center, height=2 * reach, aspect=1.0, far=2 * reach)


def _point_cameras(position: Array, sphere: Bounds) -> list[Camera]:
    """The cameras of a point light: one if it is well outside of a sphere, else those of a cube."""
    value = value_of(position)
    distance = 0.0 if value is None else float(np.linalg.norm(value - sphere.center))
    if distance > INSIDE * MARGIN * sphere.radius:
        reach = MARGIN * sphere.radius
        fov = 2 * np.degrees(np.arcsin(reach / distance))
        planes = {"near": distance - reach, "far": distance + reach}
        return [Camera.look_at(position, sphere.center, fov_y=fov, aspect=1.0, **planes)]
    _, (position, axes) = promote(position, np.concatenate([np.eye(3), -np.eye(3)]))
    far = 4 * sphere.radius
    if value is None:  # As far as the scene's other end.
        offset = stopped(position) - constants(sphere.center, engine_of(position), position)
        far = namespace(position).sqrt(dot(offset, offset)[0]) + MARGIN * sphere.radius
    planes = {"near": NEAREST * sphere.radius, "far": far}
    return [
        Camera.look_at(position, position + axes[i, :], np.eye(3)[(i + 1) % 3], fov_y=90.0, aspect=1.0, **planes)
        for i in range(6)
    ]
