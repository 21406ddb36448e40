"""The colours of a radiance field on a surface: a surface light field, one evaluation a sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rts import GBuffer, InputError, Shader, engine_of, namespace
from rts.plugin_api.arrays import Array, Tree, constants, exemplar, unit
from rts.plugin_api.checks import is_count, quoted
from rts_surfaces.radiance_field.chunks import CHUNK, in_chunks
from rts_surfaces.radiance_field.ndc import Ndc
from rts_surfaces.radiance_field.network import check_network, radiance


@dataclass(frozen=True)
class RadianceShader(Shader):
    """The colour that a network θ["weights"] gives a sample, seen along its ray (Miller et al. 1998, NeRF).

    Colours are in the encoding of the images on which the network was trained: sRGB, as a rule. For linear colours,
    decode the rendered image.

    Attributes:
        ndc: the map from the world to the network's space; None if the network's space is the world.
        chunk: number of samples evaluated at a time. In torch and jax only their colours are kept for the gradient,
            which computes the rest anew, so that memory stays bounded.

    Raises:
        InputError: an attribute is of another kind.
    """

    ndc: Ndc | None = None
    chunk: int = CHUNK
    opaque = True
    takes_views = True
    reads = ("weights",)

    def __post_init__(self):
        if self.ndc is not None and not isinstance(self.ndc, Ndc):
            raise InputError(f"ndc is {quoted(self.ndc)}; expected an Ndc, or None")
        if not is_count(self.chunk):
            raise InputError(f"chunk is {quoted(self.chunk)}; expected an integer of at least 1")

    def __call__(self, theta: Mapping[str, Tree], gbuffer: GBuffer, camera: Any) -> Array:
        """See `rts.Shader`."""
        if "weights" not in theta:
            raise InputError(
                "the radiance shader needs theta['weights'], a network such as load_radiance_field(path)"
                f".weights['fine']; theta has {sorted(theta)}"
            )
        weights = theta["weights"]
        check_network(weights, "theta['weights']")
        position = gbuffer["position"]
        trees = weights, position, -unit(camera.toward(position))
        weights, position, direction = constants(trees, engine_of(trees), exemplar(trees))
        points = position if self.ndc is None else self.ndc.from_world(position)
        color = in_chunks(lambda p, d: radiance(weights, p, d), self.chunk, points, direction)
        xp = namespace(color)
        return xp.concat([color, xp.ones_like(color[:, :1])], axis=1)
