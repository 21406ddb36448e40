"""A toon shader: bands of one colour, and a dark rim."""

from dataclasses import dataclass

import rts
from rts.plugin_api.arrays import unit
from rts.plugin_api.checks import check_numbers, is_count


@dataclass(frozen=True)
class Toon(rts.Shader):
    """Lights θ["tint"] (3,) from the viewer, in bands, on both sides of the surface.

    Bands meet in short ramps, so that the colour has a derivative, which is not zero there.

    Attributes:
        levels: how many bands there are, at least 1.
        rim: how dark the surface becomes where it turns away from the viewer, from 0 to 1.
    """

    levels: int = 3
    rim: float = 0.5

    opaque = True
    takes_views = True
    reads = ("normal", "tint")

    def __post_init__(self):
        if not is_count(self.levels):
            raise rts.InputError("A toon shader's levels must be a whole number of at least 1.")
        check_numbers("rim", self.rim, ())
        if not 0 <= self.rim <= 1:
            raise rts.InputError("A toon shader's rim must be from 0 to 1.")

    def __call__(self, theta, gbuffer, camera):
        if "tint" not in theta:
            raise rts.InputError('The toon shader needs θ["tint"].')
        check_numbers('θ["tint"]', theta["tint"], (3,))
        normal, position, tint = gbuffer["normal"], gbuffer["position"], theta["tint"]
        xp = rts.namespace(normal, position, tint)
        cosine = xp.sum(unit(normal) * unit(camera.toward(position)), axis=-1)[:, None]
        light = cosine * cosine
        steps = light * self.levels
        band = xp.floor(steps)
        shade = (0.5 + band + smooth_step(xp, (steps - band - 0.7) / 0.3)) / (self.levels + 0.5)
        shade = shade * (1 - self.rim * (1 - smooth_step(xp, light / 0.2)))
        rgb = xp.clip(shade, 0.0, 1.0) * tint
        return xp.concat([rgb, xp.ones_like(rgb[:, :1])], axis=-1)


def smooth_step(xp, x):
    """0 below 0, 1 above 1, and a cubic between, whose slope is zero at both."""
    x = xp.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)
