"""The scenes that views show: one for all, or one for each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rts.errors import InputError
from rts.rendering.arguments import SamplerLike
from rts.sampling.prepared import Prepared
from rts.sampling.scene import Scene
from rts.scene.camera import Camera
from rts.scene.parts import Part

SceneParts = Part | Sequence[Part] | Prepared
"""The parts of a scene."""


def scenes_of_views(parts: Any, cameras: Sequence[Camera], sampler: SamplerLike, engine: str | None) -> list[Scene]:
    """The checked scene of each view; views of one scene share its lists of parts, samplers and entries."""
    if not are_scenes(parts):
        scene = Scene.of(parts, cameras[0], sampler, engine)
        return [scene._replace(camera=camera) for camera in cameras]
    if len(parts) != len(cameras):
        raise InputError(
            f"{len(parts)} scene{'s'[: len(parts) != 1]} came with {len(cameras)} cameras; expected one for each"
        )
    scenes = []
    for b, (of_view, camera) in enumerate(zip(parts, cameras, strict=True)):
        try:
            scenes.append(Scene.of(of_view, camera, sampler, engine))
        except InputError as error:
            raise InputError(f"scene {b}: {error}") from error
    return scenes


def are_scenes(parts: Any) -> bool:
    """True for a list of scenes, False for the parts of one.

    Raises:
        InputError: a list of both.
    """
    if not isinstance(parts, (list, tuple)):
        return False
    several = [isinstance(x, (list, tuple, Prepared)) for x in parts]
    if any(several) and not all(several):
        raise InputError(
            "parts holds both parts and scenes; expected the parts of one scene, or a list of parts for each scene"
        )
    return any(several)


def distinct(scenes: Sequence[Scene]) -> list[Scene]:
    """Scenes of different lists of parts."""
    return list({id(scene.parts): scene for scene in scenes}.values())


def check_scene_channels(scenes: Sequence[Scene]) -> int:
    """The number of channels besides alpha, which all scenes must share."""
    for b, scene in enumerate(scenes):
        if scene.channels != scenes[0].channels:
            raise InputError(
                f"the shaders of scene 0 give {scenes[0].channels} channels and those of scene {b} give "
                f"{scene.channels}; expected the same number for all scenes"
            )
    return scenes[0].channels
