"""Outputs of a render by name: what is asked for beside colours, carried as further channels of the shaders."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import shape_of
from rts.arrays.engines import engine_of, namespace, stopped
from rts.arrays.trees import Array, Tree
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.gbuffer import GBuffer
from rts.contracts.records import Sampled, Splats
from rts.contracts.shader import Shader
from rts.errors import InputError
from rts.plugin_base import promised
from rts.rendering.settings import RenderSettings
from rts.sampling.scene import Scene

MEANS = {"depth": 1, "normal": 3, "position": 3, "uv": 2}
"""Name → number of channels, of outputs that are means over what is covered of a pixel."""
FRONTS = ("depth_front", "part", "triangle")
"""Outputs of the sample in front at the centre of a pixel."""
LEAST_ALPHA = 1e-3
"""Pixels of a smaller alpha count as empty: what little is covered of them tells no mean."""


class Outputs:
    """The outputs of one render.

    Args:
        names: as the user gave them.

    Attributes:
        names: checked.
        means: those that are carried as channels: of `MEANS`, or attributes of surfaces.
        fronts: those of `FRONTS`.

    Raises:
        InputError: `names` is no sequence of names.
    """

    def __init__(self, names: Any):
        ok = isinstance(names, (list, tuple)) and len(names) > 0 and all(isinstance(name, str) for name in names)
        if not ok:
            raise InputError(
                f"outputs is {quoted(names)}; expected a tuple of names, such as ('color', 'depth'), or None"
            )
        self.names: tuple[str, ...] = tuple(dict.fromkeys(names))
        others = {"color", "alpha", *FRONTS}
        self.means = tuple(name for name in self.names if name not in others)
        self.fronts = tuple(name for name in self.names if name in FRONTS)
        self._widths: dict[str, set[int]] = {name: set() for name in self.means}

    def of_scene(self, scene: Scene) -> Scene:
        """The scene with shaders that give the means, too, as channels before the colours."""
        return self.of_scenes([scene])[0]

    def of_scenes(self, scenes: Sequence[Scene]) -> list[Scene]:
        """The scenes as of `of_scene`; those that share a list of parts do so still."""
        if not self.means:
            return list(scenes)
        parts = {id(scene.parts): [_widened(part, self) for part in scene.parts] for scene in scenes}
        return [scene._replace(parts=parts[id(scene.parts)]) for scene in scenes]

    def of_settings(self, settings: RenderSettings) -> RenderSettings:
        """The settings under which samples tell what is asked for."""
        return replace(settings, fronts=bool(self.fronts))

    def channels(self, gbuffer: GBuffer, camera: Any) -> list[Array]:
        """The means (N, ·) at samples, in order, as the G-buffer and the camera tell them."""
        arrays = []
        for name in self.means:
            if name == "depth":
                array = camera.depth(gbuffer["position"])[:, None]
            elif name == "uv" and name not in gbuffer:
                arrays.append(namespace(gbuffer.like).zeros_like(gbuffer["position"][:, :2]))
                continue
            elif name in gbuffer:
                array = gbuffer.unit(name) if name == "normal" else gbuffer[name]
            else:
                raise InputError(_unknown(name, gbuffer))
            self._widths[name].add(shape_of(array)[1])
            arrays.append(array)
        return arrays

    @property
    def count(self) -> int:
        """The number of channels of all means, as the last call of `channels` gave them."""
        return sum(max(self._widths[name], default=MEANS.get(name, 0)) for name in self.means)

    def taken(self, image: Array, fronts: Sequence[Array], channels: int) -> dict[str, Array]:
        """The outputs by name, of an image (..., M + C + 1) of M channels of means, C `channels` of colour, and alpha.

        Raises:
            InputError: no part has "uv"; or an attribute has other numbers of channels in some parts.
        """
        for name in self.means:
            widths = self._widths[name]
            if not widths:
                raise InputError(f"the output {name!r} is an attribute that no part has; leave it out")
            if len(widths) > 1:
                raise InputError(
                    f"the attribute {name!r} has {sorted(widths)} numbers a sample, by part; expected as many in all"
                )
        xp, sizes = namespace(image), [*(min(self._widths[name]) for name in self.means), channels, 1]
        # Cut once, since the derivative of a slice is an array as large as the image.
        pieces = [xp.moveaxis(x, 0, -1) for x in engine_of(image).split(xp.moveaxis(image, -1, 0), sizes)]
        color, alpha = pieces[-2:]
        outputs = {**dict(zip(self.fronts, fronts, strict=True)), "alpha": alpha}
        if "color" in self.names:
            outputs["color"] = xp.concat([color, alpha], axis=-1)
        covered = alpha >= LEAST_ALPHA
        for name, shares in zip(self.means, pieces, strict=False):
            # Normals are scaled to length 1; other means are shares of what is covered.
            size = alpha if name != "normal" else _length(shares)
            outputs[name] = shares * xp.where(covered, 1 / xp.where(covered, size, 1.0), 0.0)
        return {name: outputs[name] for name in self.names}


def _length(x: Array) -> Array:
    """The lengths (..., 1) of vectors (..., C); 1 for those that are zero."""
    xp = namespace(x)
    square = xp.sum(x * x, axis=-1, keepdims=True)
    return xp.sqrt(xp.where(square > 0, square, 1.0))


class _Widened(Shader):
    """A shader whose colours follow the means of some outputs, times alpha."""

    def __init__(self, shader: Shader, outputs: Outputs):
        self._shader, self._outputs = shader, outputs
        self.opaque, self.takes_views = shader.opaque, promised(shader, "takes_views")
        reads = promised(shader, "reads")
        self.reads = None if reads is None else (*reads, *(name for name in outputs.means if name != "depth"))

    @property
    def channels(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]  # Known once it has shaded.
        """The channels of the shader, and those of the outputs."""
        return self._shader.channels + self._outputs.count

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Any) -> Array:
        """See `rts.Shader`."""
        rgba, means = self._shader(theta, gbuffer, camera), self._outputs.channels(gbuffer, camera)
        xp = namespace(rgba, gbuffer.like)
        rows = [xp.astype(x, rgba.dtype) for x in means]
        if not self.opaque:
            rows = [x * rgba[:, -1:] for x in rows]
        return xp.concat([*rows, rgba], axis=1)

    def __repr__(self) -> str:
        return repr(self._shader)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Widened) and self._shader == other._shader and self._outputs is other._outputs

    def __hash__(self) -> int:
        return hash((_Widened, self._shader))


def _widened(part: CheckedPart, outputs: Outputs) -> CheckedPart:
    return replace(part, shader=_Widened(part.shader, outputs))


def fronts_of(names: Sequence[str], sampled: Sampled, splats: Splats) -> list[Array]:
    """Outputs of the sample in front that is next to each pixel's centre: (h, w, 1) each.

    Args:
        names: some of `FRONTS`.
        sampled: the samples; with triangles, counted by part, if "triangle" is among the names.
        splats: of these samples.

    Raises:
        InputError: samples do not tell triangles.
    """
    step, border = sampled.supersample, sampled.border

    def of_pixels(cells: Array) -> Array:
        rows, columns = (slice(border + step // 2, n - border, step) for n in cells.shape)
        return cells[rows, columns][..., None]

    fronts = []
    for name in names:
        if name == "depth_front":
            fronts.append(of_pixels(_front_depth(splats)))
        elif name == "part":
            fronts.append(of_pixels(sampled.part[0, ...]))
        else:
            if sampled.triangle is None:
                raise InputError("the samples of some part lie on no triangles; leave out the output 'triangle'")
            fronts.append(of_pixels(sampled.triangle[0, ...]))
    return fronts


def _front_depth(splats: Splats) -> Array:
    """(H, W) the depth of the surface in front at the centres of cells, with the derivative there; 0 where empty.

    A sample takes its depth along as it moves in the image. The slope of depth, from the next cells of the same
    surface, brings it back to the centre.
    """
    xp, row = namespace(splats.positions), splats.row[0, ...]
    there = row >= 0
    at = xp.take(splats.positions, xp.reshape(xp.where(there, row, 0), (-1,)), axis=0)
    at = xp.reshape(at, (*row.shape, 3))
    depth = xp.where(there, at[..., 2], 0.0)
    if splats.stencil is None:
        return depth
    still, joined = stopped(depth), splats.stencil.joined
    for axis in (0, 1):
        rise = xp.where(joined[axis, ...], xp.roll(still, -1, axis=1 - axis) - still, 0.0)
        before, behind = joined[axis, ...], xp.roll(joined[axis, ...], 1, axis=1 - axis)
        sides = xp.clip(xp.astype(before, depth.dtype) + xp.astype(behind, depth.dtype), 1.0, None)
        slope = (rise + xp.roll(rise, 1, axis=1 - axis)) / sides
        moved = at[..., axis] - stopped(at[..., axis])
        depth = depth - xp.where(there, slope * moved, 0.0)
    return depth


def _unknown(name: str, gbuffer: GBuffer) -> str:
    """The error of an output that a surface does not give."""
    names = ["color", "alpha", *MEANS, *FRONTS, *gbuffer]
    close = ["alpha"] if name == "mask" else difflib.get_close_matches(name, names, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else f"; expected some of {', '.join(dict.fromkeys(names))}"
    return f"outputs has {name!r}, which is neither an output nor an attribute of the surface{hint}"
