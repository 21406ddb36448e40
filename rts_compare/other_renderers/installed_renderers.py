"""The other differentiable renderers that can take a scene, DEODR and Mitsuba, and why one cannot.

They are made here, and render later. They come with the extra `bench`.
"""

from __future__ import annotations

from collections.abc import Sequence

from rts import Engine
from rts_compare.moving_scenes import Scene
from rts_compare.other_renderers.deodr_renderer import Deodr
from rts_compare.other_renderers.mitsuba_renderer import Mitsuba, MitsubaScene
from rts_compare.other_renderers.renderer_input import Peer, RendererInput, Unsuited, renderer_input
from rts_compare.skip_reasons import one_line

SPP = (1, 4, 16)
"""Samples a pixel of Mitsuba."""


def peers(scene: Scene, spp: Sequence[int] = SPP, engine: Engine | None = None) -> tuple[list[Peer], list[str]]:
    """The renderers that can render a scene, and the reasons why others cannot.

    Args:
        scene: of unlit parts or silhouettes without textures, seen by a perspective camera; see `renderer_input`.
        spp: numbers of samples a pixel; the result has Mitsuba once for each.
        engine: of the scene's parameters; None for NumPy.

    Returns:
        The renderers; and a line for each that is left out, or one line for both if neither can take the scene.
    """
    try:
        given = renderer_input(scene, engine)
    except Exception as error:
        reason = str(error) if isinstance(error, Unsuited) else f"{type(error).__name__}: {error}"
        return [], [f"DEODR and Mitsuba: {one_line(reason)}"]
    found: list[Peer] = []
    left_out = []
    for name, make in (("DEODR", _deodr), ("Mitsuba", _mitsuba)):
        try:
            found += make(given, spp)
        except ModuleNotFoundError as error:
            left_out.append(f"{name}: no module {error.name!r}; pip install 'rasterize-then-splat[bench]'")
        except Exception as error:
            left_out.append(f"{name}: {one_line(str(error))}")
    return found, left_out


def _deodr(given: RendererInput, spp: Sequence[int]) -> list[Peer]:
    return [Deodr(given)]


def _mitsuba(given: RendererInput, spp: Sequence[int]) -> list[Peer]:
    scene = MitsubaScene(given)
    return [Mitsuba(scene, n) for n in spp]
