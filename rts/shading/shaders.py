"""The built-in shaders: from θ and the G-buffer in world space to premultiplied linear RGBA.

A shader is any function `shader(theta, gbuffer, camera) -> (N, 4)`. Entries of θ that it reads are differentiable:

    "color" (3,) or (4,)             a factor of the base colour
    "texture" (h, w, C)              row 0 on top, C = 1, 3 or 4; sampled at gbuffer["uv"], whose v points up, and
                                     averaged over gbuffer["uv_footprint"], if it is there
    "light"                          see `rts.shading.light`
    "specular" () or (3,)            of `blinn_phong`: the highlight's strength, by default 0.3
    "shininess" ()                   of `blinn_phong`: its exponent, by default 32
    "depth_range" (2,)               of `depth`: the depths of black and white; default the near and far planes

The base colour is the product of θ["color"], of the texture where the surface has uv, and of the G-buffer's "color", as
far as there are any.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import described, dot, shape_of
from rts.arrays.engines import namespace, stopped, value_of
from rts.arrays.trees import Array, Tree
from rts.contracts.gbuffer import FOOTPRINT, GBuffer
from rts.contracts.shader import Shader
from rts.errors import InputError
from rts.operations.unit import unit
from rts.scene.camera import Camera
from rts.scene.row_cameras import RowCameras
from rts.shading.light import light_of
from rts.shading.textures import Wrap, check_sampler, sample_texture
from rts.shading.theta_entries import check_base, entry_of

DEFAULT_SPECULAR, DEFAULT_SHININESS = 0.3, 32.0


@dataclass(frozen=True)
class Silhouette(Shader):
    """White where there is a surface."""

    opaque = True
    uniform = True
    reads = ()

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera | RowCameras) -> Array:
        """See `rts.Shader`."""
        like = gbuffer.like
        xp = namespace(like)
        return xp.broadcast_to(xp.ones_like(like[:1, :1]), (like.shape[0], 4))


@dataclass(frozen=True)
class Normals(Shader):
    """World-space unit normals, mapped from [−1, 1] to [0, 1]."""

    opaque = True
    takes_views = True
    reads = ("normal",)

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera | RowCameras) -> Array:
        """See `rts.Shader`."""
        return _opaque(gbuffer.unit("normal") * 0.5 + 0.5)


@dataclass(frozen=True)
class Depth(Shader):
    """Linear depth as a grey, from 0 at the near plane to 1 at the far plane, or over θ["depth_range"]; clipped."""

    opaque = True
    takes_views = True
    reads = ("depth_range",)

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera | RowCameras) -> Array:
        """See `rts.Shader`."""
        depth = camera.depth(gbuffer["position"])
        xp = namespace(depth)
        if "depth_range" in theta:
            ends = entry_of(theta, "depth_range", (2,))
            known, (near, far) = value_of(ends), (ends[0], ends[1])
            if known is not None and (known[..., 0] == known[..., 1]).any():
                raise InputError(f"theta['depth_range'] is {quoted(known)}; expected two different depths")
        else:
            near, far = camera.depth_range()
        grey = xp.clip((depth - near) / (far - near), 0.0, 1.0)
        return _opaque(xp.stack([grey, grey, grey], axis=-1))


@dataclass(frozen=True)
class Unlit(Shader):
    """The base colour times θ["color"], without light.

    Attributes:
        wrap: continuation of the texture outside [0, 1]: "repeat", "mirror" or "clamp", or a pair, along u and along v.
        opaque: whether to ignore the alpha of texture and colours.
        mip: whether to average over footprints of many texels in a pyramid (mipmaps), so that texels much smaller than
            pixels do not alias. Without it, the mean is one of at most 16 lookups.
        filter: "linear" between the centres of texels, or "nearest", for textures of plain squares; "nearest" averages
            with `mip` alone.
    """

    wrap: Wrap = "repeat"
    opaque: bool = True
    mip: bool = False
    filter: str = "linear"
    takes_views = True
    reads = ("color", "uv", "texture", FOOTPRINT)

    def __post_init__(self):
        check_sampler(self.wrap, self.filter)

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera | RowCameras) -> Array:
        """See `rts.Shader`."""
        color, alpha = self.base_color(theta, gbuffer)
        return self.premultiplied(color, alpha)

    def base_color(self, theta: Mapping[str, Tree], gbuffer: GBuffer) -> tuple[Array, Array]:
        """The base colour (N, 3), not premultiplied, and its alpha (N, 1): a product, see the top of this file."""
        position = gbuffer["position"]
        # One row stands for all until some entry differs from sample to sample.
        xp, count = namespace(position), position.shape[0]
        color = alpha = xp.ones_like(position[:1, :1])
        for base in self._bases(theta, gbuffer):
            color = color * (base[:, :3] if base.shape[1] >= 3 else base[:, :1])
            alpha = alpha * base[:, 3:] if base.shape[1] == 4 else alpha
        if "color" in theta:
            factor = entry_of(theta, "color", (3,), (4,))
            color = color * factor[:3]
            alpha = alpha * factor[3] if factor.shape[0] == 4 else alpha
        return xp.broadcast_to(color, (count, 3)), xp.broadcast_to(alpha, (count, 1))

    def _bases(self, theta: Mapping[str, Tree], gbuffer: GBuffer) -> Iterator[Array]:
        """The texture and the surface's colours at the samples (N, C), as far as there are any."""
        if "texture" in theta and "uv" in gbuffer:
            texture = theta["texture"]
            xp = namespace(texture)
            # Averages are of visible colours: transparent texels count by their alpha.
            weighed = self.mip and not self.opaque and shape_of(texture)[-1] == 4
            if weighed:
                texture = xp.concat([texture[..., :3] * texture[..., 3:], texture[..., 3:]], axis=-1)
            base = self.looked_up(texture, gbuffer)
            check_base("theta['texture']", base)
            if weighed:
                alpha = base[:, 3:]
                base = xp.concat([base[:, :3] / xp.where(alpha > 0, alpha, 1.0), alpha], axis=1)
            yield base
        if "color" in gbuffer:
            base = gbuffer["color"]
            if base.shape[1] not in (1, 3, 4):
                raise InputError(f"the surface's 'color' {described(base)}; expected 1, 3 or 4 columns")
            check_base("the surface's 'color'", base)
            yield base

    def looked_up(self, texture: Array, gbuffer: GBuffer) -> Array:
        """A texture (h, w, C) at the samples (N, C), with the options of this shader."""
        return sample_texture(
            texture, gbuffer["uv"], self.wrap, self.footprint(gbuffer, self.filter), self.filter, self.mip
        )

    def footprint(self, gbuffer: GBuffer, filter: str) -> Array | None:
        """The footprints (N, 4) that textures are averaged over, or None where they are read at points.

        Raises:
            InputError: `mip` is asked for on a surface without footprints.
        """
        if self.mip and FOOTPRINT not in gbuffer:
            raise InputError(
                f"mipmaps need {FOOTPRINT!r}, which surfaces of two parameters a sample have; leave out mip=True"
            )
        return gbuffer[FOOTPRINT] if FOOTPRINT in gbuffer and (self.mip or filter != "nearest") else None

    def premultiplied(self, color: Array, alpha: Array) -> Array:
        """Premultiplied (N, 4) of colour (N, 3) and alpha (N, 1); an opaque shader takes 1 for alpha."""
        return _opaque(color) if self.opaque else namespace(color).concat([color * alpha, alpha], axis=1)


@dataclass(frozen=True)
class Textured(Unlit):
    """`Unlit` whose base colour must come from a texture; θ without one, or a surface without uv, is refused."""

    takes_views = True
    reads = ("uv", "texture", "color", FOOTPRINT)

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera | RowCameras) -> Array:
        """See `rts.Shader`."""
        if "texture" not in theta:
            raise InputError(f"the textured shader needs theta['texture'] (h, w, C); theta has {sorted(theta)}")
        gbuffer["uv"]  # Raises an error without uv, where the base colour would be white.
        return super().__call__(theta, gbuffer, camera)


@dataclass(frozen=True)
class Lambert(Unlit):
    """Diffuse shading, two-sided: normals are those of the side that is seen."""

    takes_views = True
    reads = ("normal", "face_normal", "color", "uv", "texture", FOOTPRINT, "light")

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera | RowCameras) -> Array:
        """See `rts.Shader`."""
        color, alpha = self.base_color(theta, gbuffer)
        normal, behind = gbuffer.unit("normal"), is_behind(gbuffer, camera)
        xp = namespace(color)
        light = light_of(theta, camera)
        shade = light.diffuse(xp.where(behind, -normal, normal)) if light.directed else light.diffuse(normal)
        for direction, brightness in light.lamps(gbuffer["position"]):
            cosine = dot(normal, direction)
            shade = shade + positive(xp.where(behind, -cosine, cosine)) * brightness
        return self.premultiplied(color * shade, alpha)


@dataclass(frozen=True)
class BlinnPhong(Unlit):
    """Diffuse shading with highlights (Blinn 1977), two-sided."""

    takes_views = True
    reads = ("normal", "face_normal", "color", "uv", "texture", FOOTPRINT, "light", "specular", "shininess")

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera | RowCameras) -> Array:
        """See `rts.Shader`."""
        color, alpha = self.base_color(theta, gbuffer)
        normal, toward = facing_normals(gbuffer, camera)
        xp = namespace(color)
        light = light_of(theta, camera)
        shade = light.diffuse(normal)
        specular = entry_of(theta, "specular", (), (1,), (3,)) if "specular" in theta else DEFAULT_SPECULAR
        shininess = entry_of(theta, "shininess", (), (1,)) if "shininess" in theta else DEFAULT_SHININESS
        highlight = xp.zeros_like(color)
        for direction, brightness in light.lamps(gbuffer["position"]):
            cosine = dot(normal, direction)
            shade = shade + positive(cosine) * brightness
            # A power of zero has an infinite derivative for exponents below one, and a NaN one in its exponent.
            half = xp.clip(dot(normal, unit(direction + toward)), 1e-6, 1.0)
            highlight = highlight + xp.where(cosine > 0, half**shininess, 0 * half) * brightness
        return self.premultiplied(color * shade + specular * highlight, alpha)


def facing_normals(gbuffer: GBuffer, camera: Camera | RowCameras) -> tuple[Array, Array]:
    """Unit normals (N, 3) on the side that the viewer sees, and unit vectors (N, 3) towards the viewer; world space.

    Normals that are interpolated over a triangle may still turn away from the viewer; see `is_behind`.
    """
    normal, toward = gbuffer.unit("normal"), unit(camera.toward(gbuffer["position"]))
    return namespace(normal).where(is_behind(gbuffer, camera), -normal, normal), toward


def is_behind(gbuffer: GBuffer, camera: Camera | RowCameras) -> Array:
    """(N, 1) bool, true where the viewer sees the side of a surface that normals point away from; without derivative.

    Near the outlines of a mesh, normals that are interpolated over a triangle turn away before the triangle does. So
    "face_normal", on either side of the triangle, tells which side is seen, if there is one.
    """
    normal, toward = stopped(gbuffer["normal"]), camera.toward(stopped(gbuffer["position"]))
    if "face_normal" not in gbuffer:
        return dot(normal, toward) < 0
    face = stopped(gbuffer["face_normal"])
    return (dot(face, toward) < 0) != (dot(face, normal) < 0)


def positive(x: Array) -> Array:
    """The array with zeros in place of negative numbers, which have no derivative there."""
    return namespace(x).where(x <= 0, 0.0, x)  # NaN stays NaN.


def _opaque(color: Array) -> Array:
    """(N, 4): colours (N, 3) with an alpha of 1."""
    xp = namespace(color)
    return xp.concat([color, xp.broadcast_to(xp.ones_like(color[:1, :1]), (color.shape[0], 1))], axis=1)
