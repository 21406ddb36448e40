"""Claims about views that do not show a part, or show it from inside, cut or edge-on."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts import Camera, Engine, Part
from rts_testing import derivatives, scenes
from rts_testing.claims import claim, claim_finite, no_error
from rts_testing.derivatives import joined, split


def image_and_gradient(part: Part, camera: Camera, sampler: Any, engine: Engine) -> tuple[np.ndarray, list]:
    """The image of a part, and the gradient of its sum under random weights: an array for each floating leaf of θ."""
    values, join = split(part.theta)
    weights = engine.constant(derivatives.single(np.random.default_rng(0).random((*scenes.SIZE, 4))))

    def shown(x: list) -> Any:
        return scenes.shown(part.replace(theta=joined(engine, join, x)), camera, sampler)

    at = derivatives.on(engine, values)
    _, gradient = engine.value_and_grad(lambda x: engine.namespace.sum(shown(x) * weights))(at)
    return engine.to_numpy(shown(at)), derivatives.host(engine, gradient)


def claim_unseen_is_nothing(part: Part, sampler: Any, engine: Engine) -> None:
    """Fail unless a part gives an image and a gradient of zeros for each camera of `scenes.UNSEEN`, which miss it."""
    for view, camera in scenes.UNSEEN.items():
        with no_error(f"{view}, in {engine.name}"):
            image, gradient = image_and_gradient(part, camera, sampler, engine)
        for what, x in (("image", image), *(("gradient", g) for g in gradient)):
            claim((x == 0).all(), f"{view}, in {engine.name}: the {what} is not zero: {np.ravel(x[x != 0])[:3]}")


def claim_awkward_views_are_finite(part: Part, sampler: Any, engine: Engine) -> None:
    """Fail unless views from inside, cut by planes, and along the axes give finite images in [0, 1] and gradients."""
    views = {"from inside": scenes.INSIDE, "cut by the near plane": scenes.NEAR}
    for view, camera in {**views, **{f"along axis {i}": c for i, c in enumerate(scenes.AXES)}}.items():
        with no_error(f"{view}, in {engine.name}"):
            image, gradient = image_and_gradient(part, camera, sampler, engine)
        claim_finite((image, gradient), f"{view}, in {engine.name}: the image or its gradient")
        claim(-1e-5 <= image.min() and image.max() <= 1 + 1e-4, f"{view}: the image leaves the range from 0 to 1")
