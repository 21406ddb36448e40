"""The shader `pbr`: metals and dielectrics of any roughness, with maps, by glTF 2.0, Appendix B."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rts.arrays.argument_checks import quoted
from rts.arrays.array_functions import described, dot, shape_of
from rts.arrays.engines import namespace
from rts.arrays.trees import Array, Tree
from rts.contracts.gbuffer import FOOTPRINT, GBuffer
from rts.errors import InputError
from rts.operations.unit import unit
from rts.scene.camera import Camera
from rts.scene.row_cameras import RowCameras
from rts.shading import microfacets
from rts.shading.light import light_of
from rts.shading.shaders import Unlit, is_behind
from rts.shading.tangents import TANGENT, tangent_frame
from rts.shading.textures import MAPS, Wrap, check_sampler, own_uv, sample_texture
from rts.shading.theta_entries import check_base, entry_of

DIELECTRIC = 0.04
"""The reflectance of dielectrics at normal incidence."""


@dataclass(frozen=True)
class Pbr(Unlit):
    """Metallic-roughness shading of glTF 2.0 (Appendix B), two-sided.

    A metal reflects its base colour. Anything else reflects 4 %, and the rest of its light has the base colour. Grazing
    light is reflected entirely (Schlick); highlights have the shape of GGX, with Smith's height-correlated shadowing.
    Light from all around is reflected by the split-sum approximation (Karis 2013), without shadows.

    It reads, besides what `Unlit` reads and `rts.shading.light` has, these entries of θ, all differentiable:

        "metallic" () or (h, w, 1)       0, the default, to 1
        "roughness" () or (h, w, 1)      perceptual, 0 to 1, the default; below 0.045 it counts as 0.045
        "normal_map" (h, w, 3)           directions x along u, y along v, z outward, of any length; not colours
        "occlusion" () or (h, w, 1)      the share of light from all around that comes in, by default 1
        "emissive" (3,) or (h, w, 3)     light of its own, by default none
        "specular" (), (3,) or (h, w, 3) how many times 4 % anything but a metal reflects at normal incidence, by
                                         default 1 (`KHR_materials_specular`); at most all light

    Maps are looked up as the texture is, but for those named in `samplers`. Where the surface has an attribute
    "uv_occlusion", the map θ["occlusion"] is looked up there, and not averaged by `mip`; so are the other maps at
    theirs. A normal map needs the G-buffer's "tangent".

    Attributes:
        samplers: for maps that are looked up in another way the entry of θ, and its `wrap` and `filter`, three of each.
    """

    samplers: tuple[tuple[str, Wrap, str], ...] = ()
    takes_views = True
    reads = "normal", "face_normal", "color", "uv", "texture", FOOTPRINT, "light", TANGENT, *MAPS, *map(own_uv, MAPS)

    def __post_init__(self):
        super().__post_init__()
        for one in self.samplers if isinstance(self.samplers, tuple) else (None,):
            if not isinstance(one, tuple) or len(one) != 3 or not isinstance(one[0], str) or one[0] not in MAPS:
                raise InputError(
                    f"samplers is {quoted(self.samplers)}; expected a tuple of (name, wrap, filter), where the name is "
                    f"one of {', '.join(MAPS)}"
                )
            check_sampler(*one[1:])

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera | RowCameras) -> Array:
        """See `rts.Shader`."""
        color, alpha = self.base_color(theta, gbuffer)
        xp, light = namespace(color), light_of(theta, camera)
        metallic, roughness = self._entry(theta, gbuffer, "metallic", 1), self._entry(theta, gbuffer, "roughness", 1)
        metallic = 0.0 if metallic is None else metallic
        roughness = 1.0 if roughness is None else xp.clip(roughness, microfacets.SMOOTHEST, 1.0)
        specular = self._entry(theta, gbuffer, "specular", 3)
        dielectric = DIELECTRIC if specular is None else xp.clip(DIELECTRIC * specular, 0.0, 1.0)
        reflectance = dielectric + metallic * (color - dielectric)
        base = (1 - metallic) * (1 - reflectance) * color
        normal, toward = self._normals(theta, gbuffer, camera), unit(camera.toward(gbuffer["position"]))
        facing, shown = dot(normal, toward), None
        for direction, brightness in light.lamps(gbuffer["position"]):
            a, b, c = microfacets.of_light(normal, toward, facing, direction, roughness)
            lit = (reflectance * a + b + base * c) * brightness
            shown = lit if shown is None else shown + lit
        if light.surrounds:
            (a, b, c), lobe = microfacets.around(normal, toward, facing, roughness, light.directed)
            if lobe is None:
                around = (reflectance * a + b + base * c) * light.ambient
            else:
                diffuse, reflected = light.diffuse(normal), light.reflected(lobe.mean, lobe.roughness)
                reflected = reflected + lobe.flat * (diffuse - reflected)
                around = (reflectance * a + b) * reflected + base * c * diffuse
            occlusion = self._entry(theta, gbuffer, "occlusion", 1)
            around = around if occlusion is None else occlusion * around
            shown = around if shown is None else shown + around
        shown = xp.zeros_like(color) if shown is None else shown
        emissive = self._entry(theta, gbuffer, "emissive", 3)
        return self.premultiplied(shown if emissive is None else shown + emissive, alpha)

    def _normals(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Camera | RowCameras) -> Array:
        """Unit normals (N, 3), bent by the normal map; frames seen from behind are turned over, as glTF says."""
        bent = self._entry(theta, gbuffer, "normal_map", 3)
        if bent is None:
            normal = gbuffer.unit("normal")
        else:
            tangent, bitangent, upright = tangent_frame(gbuffer)
            normal = unit(bent[:, :1] * tangent + bent[:, 1:2] * bitangent + bent[:, 2:] * upright)
        return namespace(normal).where(is_behind(gbuffer, camera), -normal, normal)

    def _entry(self, theta: Mapping[str, Tree], gbuffer: GBuffer, name: str, channels: int) -> Any:
        """A number (), a colour (3,), or a map's values (N, channels) at the samples; None if θ has no such entry."""
        if name not in theta:
            return None
        shape = shape_of(theta[name])
        if len(shape) == 2 and name != "normal_map":
            raise InputError(
                f"theta[{name!r}] {described(theta[name])}; expected a number, or a map (h, w, {channels})"
            )
        if len(shape) != 3 and name != "normal_map":
            numbers = ((3,),) if name == "emissive" else ((), (1,)) if channels == 1 else ((), (1,), (3,))
            return entry_of(theta, name, *numbers)
        if len(shape) != 3 or shape[2] != channels or 0 in shape:
            raise InputError(f"theta[{name!r}] {described(theta[name])}; expected a map (h, w, {channels})")
        _, wrap, filter = next((one for one in self.samplers if one[0] == name), (name, self.wrap, self.filter))
        own = own_uv(name) if own_uv(name) in gbuffer else None
        footprint = self.footprint(gbuffer, filter) if own is None else None
        if own is not None and shape_of(gbuffer[own])[1:] != (2,):
            raise InputError(f"the surface's {own!r} {described(gbuffer[own])}; expected (N, 2), coordinates of a map")
        values = sample_texture(theta[name], gbuffer[own or "uv"], wrap, footprint, filter, self.mip)
        check_base(f"theta[{name!r}]", values)
        return values
