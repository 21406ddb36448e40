"""A toon shader: bands of one colour."""

from dataclasses import dataclass

from rts.plugin_api.arrays import namespace, unit
from rts.plugin_api.bases import Shader
from rts.plugin_api.checks import check_numbers


@dataclass(frozen=True)
class Toon(Shader):
    """Lights θ["tint"] (3,) from the viewer, in bands. They meet in short ramps, which have a derivative."""

    levels: int = 3

    opaque = True
    reads = ("normal", "tint")
    takes_views = True

    def __call__(self, theta, gbuffer, camera):
        check_numbers('theta["tint"]', theta.get("tint"), (3,))
        normal, toward = gbuffer["normal"], camera.toward(gbuffer["position"])
        xp = namespace(normal, theta["tint"])
        cosine = xp.sum(unit(normal) * unit(toward), axis=-1, keepdims=True)
        level = self.levels * cosine * cosine
        band = xp.floor(level)
        ramp = xp.clip((level - band - 0.7) / 0.3, 0.0, 1.0)
        shade = (0.5 + band + ramp * ramp * (3 - 2 * ramp)) / (self.levels + 0.5)
        rgb = xp.clip(shade, 0.0, 1.0) * theta["tint"]
        return xp.concat([rgb, xp.ones_like(shade)], axis=-1)
