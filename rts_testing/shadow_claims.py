"""Claims about shaders whose lights cast shadows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from rts import Engine
from rts.plugin_api.arrays import Array, Tree
from rts.shadows import seen_from, visibility
from rts_testing import derivatives, scenes
from rts_testing.claims import claim_close
from rts_testing.compatibility import SIZE

TOLERANCE = 1e-5
LAMPS = {"color": "direction", "intensity": "position"}
"""The brightness of lights in θ["light"], and their place."""


def claim_shadows_dim(
    shade: Callable[[dict[str, Any], Any, Engine | None], Array], theta: Mapping[str, Tree], positions: np.ndarray
) -> None:
    """Fail unless shadows multiply what each light adds by the visibility of samples, in value and gradient.

    Skipped without lights that have a place or a direction.

    Args:
        shade: entries of θ, positions (N, 3) and their engine → colours (N, 4).
        theta: entries of θ.
        positions: (N, 3), where samples are.
    """
    entry = theta.get("light")
    light: Mapping[str, Any] = entry if isinstance(entry, Mapping) else {}
    counts = _lamps(light)
    if not counts:
        pytest.skip("theta['light'] has no 'direction' or 'position' of a light")
    ball, total = scenes.ball(), sum(counts.values())
    first, second = (seen_from(ball, camera, SIZE, layers=1) for camera in (scenes.CAMERA, scenes.PARALLEL))
    shadows: list[Any] = [(first, [first, second], None)[i % 3] for i in range(total)]
    brightness = {name: np.broadcast_to(light.get(name, 1.0), (counts[name], 3)) for name in counts}

    def shaded(at: Any, engine: Engine | None, lit: np.ndarray, shadow: list) -> Any:
        """The colours at positions, of lights as bright as `lit` (total, 1) says."""
        share = zip(LAMPS, np.split(lit, [counts.get("color", 0)]), strict=True)
        lamps = {**light, **{n: s * brightness[n] for n, s in share if n in counts}, "shadow": shadow}
        return shade({**theta, "light": lamps}, at, engine)

    def expected(at: Any, engine: Engine | None) -> Any:
        colors = dark = shaded(at, engine, np.zeros((total, 1)), [None] * total)
        for shadow, one in zip(shadows, np.eye(total)[:, :, None], strict=True):
            colors = colors + _mean_visibility(shadow, at) * (shaded(at, engine, one, [None] * total) - dark)
        return colors

    def found(at: Any, engine: Engine | None) -> Any:
        return shaded(at, engine, np.ones((total, 1)), shadows)

    weights = np.random.default_rng(0).standard_normal((len(positions), 1))
    claim_close(found(positions, None), expected(positions, None), TOLERANCE, "the colour in shadows")
    engine = derivatives.installed()[0]  # All agree on visibility.
    slopes = [
        derivatives.derivatives(engine, lambda x, f=f: f(x[0], engine), [positions], [positions], weights).gradient[0]
        for f in (found, expected)
    ]
    scale = max(1.0, float(np.abs(slopes[1]).max()))
    claim_close(slopes[0], slopes[1], TOLERANCE * scale, f"in {engine.name}, the gradient of the colour in shadows")


def _mean_visibility(shadow: Any, at: Array) -> Any:
    """The share (N, 1) of a lamp that points see, by one record, the mean of several, or 1.0 for none."""
    if shadow is None:
        return 1.0
    shares = [visibility(seen, at, outside=1.0)[:, None] for seen in (shadow if isinstance(shadow, list) else [shadow])]
    return sum(shares[1:], shares[0]) / len(shares)


def _lamps(light: Mapping[str, Any]) -> dict[str, int]:
    """The number of lights, by the name of their brightness."""
    places = {name: np.reshape(light[place], (-1, 3)) for name, place in LAMPS.items() if place in light}
    return {name: len(place) for name, place in places.items()}
