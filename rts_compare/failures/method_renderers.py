"""Renderers of the table's methods: derivative images and slopes of losses, by this library and by others."""

from __future__ import annotations

import abc
import contextlib
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np

from rts import Engine, engine_of, render
from rts.errors import RtsWarning
from rts.plugin_api.arrays import Array, Tree, leaves, map_leaves
from rts.tool_api.plugins import engine_named
from rts_compare.derivative_scores import loss_weights
from rts_compare.failures.table_columns import Method
from rts_compare.moving_scenes import Scene, parts_of
from rts_compare.other_renderers.installed_renderers import Deodr, Mitsuba, MitsubaScene
from rts_compare.other_renderers.renderer_input import Peer, Unsuited, renderer_input
from rts_compare.skip_reasons import one_line

Weigh = Callable[[np.ndarray], np.ndarray]
"""An image (H, W, 3) → the derivative of a loss with respect to it."""


JUMP = 1e3
"""A derivative of a pixel that DEODR's images can only have by a jump: it is a difference over 1e-6 pixels."""


class Unable(Exception):
    """Raised if a method cannot measure a row; the message is a clause that says why."""


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """A context in which the library does not warn: some views are empty, and layers too few, on purpose."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RtsWarning)
        yield


def shifted(scene: Scene, amounts: Array) -> Tree:
    """The parameters of a scene, moved along all its directions at once.

    Args:
        scene: the scene.
        amounts: (modes,) how far along each, in the order of `directions`; an array of any engine.
    """
    columns = [list(leaves(direction)) for direction in scene.directions.values()]
    engine, number = engine_of(amounts), count()

    def leaf(p: Array) -> Array:
        place, total = next(number), np.asarray(p)
        live = [k for k, column in enumerate(columns) if np.any(np.asarray(column[place]))]
        total = engine.constant(total, amounts) if live and engine.differentiates else total
        for k in live:
            total = total + amounts[k] * engine.constant(np.asarray(columns[k][place]), amounts)
        return total

    return map_leaves(leaf, scene.parameters)


class Renderer(abc.ABC):
    """A method of the table, ready to differentiate one scene."""

    @abc.abstractmethod
    def derivative(self, mode: str) -> np.ndarray:
        """The derivative image (H, W, 3) along a mode, per unit, where the scene is at rest."""

    @abc.abstractmethod
    def slopes(self, amounts: np.ndarray, weigh: Weigh) -> np.ndarray:
        """The derivatives (modes,) of a loss along all modes, with the scene moved by amounts (modes,)."""

    def broken(self) -> int:
        """The number of NaN and infinite values of a loss and its gradients; 0 where these are not computed."""
        return 0


def renderer(scene: Scene, method: Method, dtype: Any = np.float32) -> Renderer:
    """The `Renderer` of a method for a scene.

    Raises:
        Unable: another renderer is not installed, or cannot render the scene.
    """
    return Other(scene, method) if method.peer else Own(scene, method.options, dtype)


class Own(Renderer):
    """A `Renderer` by this library, with torch.

    Args:
        scene: the scene.
        options: of `render`.
        dtype: of the parameters, float32 or float64.
    """

    def __init__(self, scene: Scene, options: Mapping[str, Any], dtype: Any = np.float32):
        self.scene, self.options = scene, options
        self.engine: Engine = engine_named("torch")
        self.number = self.engine.namespace.asarray(0.0, dtype=getattr(self.engine.namespace, np.dtype(dtype).name))

    def _image(self, parameters: Tree) -> Array:
        with quiet():
            return render(*self.scene.at(parameters), self.scene.size, **self.options)[..., :3]

    def derivative(self, mode: str) -> np.ndarray:
        """See `Renderer`."""
        column = [*self.scene.directions].index(mode)
        unit = np.eye(len(self.scene.directions))[column]

        def image(t: Array) -> Array:
            return self._image(shifted(self.scene, t * self.engine.constant(unit, self.number)))

        found = self.engine.jvp(image, self.number, self.number + 1)[1]
        return self.engine.to_numpy(found).astype(np.float64)

    def slopes(self, amounts: np.ndarray, weigh: Weigh) -> np.ndarray:
        """See `Renderer`."""

        def loss(t: Array) -> Array:
            image = self._image(shifted(self.scene, t))
            still = self.engine.to_numpy(self.engine.stop_gradient(image)).astype(np.float64)
            return (image * self.engine.constant(weigh(still), image)).sum()

        _, found = self.engine.value_and_grad(loss)(self.engine.constant(np.asarray(amounts), self.number))
        return self.engine.to_numpy(found).astype(np.float64)

    def broken(self) -> int:
        """See `Renderer`; gradients in all numbers of the θ of all parts."""
        parts, camera = self.scene.at(self.scene.parameters)
        parts = parts_of((parts, camera))
        engine, weights = self.engine, loss_weights(*self.scene.size)[0]

        def live(x: Any) -> Any:
            return engine.constant(np.asarray(x, np.float64), self.number)

        def loss(thetas: Tree) -> Array:
            moved = [part.replace(theta=theta) for part, theta in zip(parts, thetas, strict=True)]
            with quiet():
                image = render(moved, camera, self.scene.size, **self.options)[..., :3]
            return (image * engine.constant(weights, image)).sum()

        value, gradient = engine.value_and_grad(loss)([map_leaves(live, part.theta) for part in parts])
        found = [value, *leaves(gradient)]
        return int(sum((~np.isfinite(engine.to_numpy(engine.stop_gradient(x)))).sum() for x in found))


class Other(Renderer):
    """A `Renderer` by DEODR or Mitsuba.

    Raises:
        Unable: it is not installed, or cannot render the scene.
    """

    def __init__(self, scene: Scene, method: Method):
        self.scene, self.method = scene, method
        self.peer = self._peer(scene)

    def _peer(self, scene: Scene) -> Peer:
        try:
            given = renderer_input(scene)
            if self.method.peer == "DEODR":
                return Deodr(given)
            return Mitsuba(MitsubaScene(given), self.method.options["spp"])
        except ImportError as error:
            raise Unable(f"{self.method.peer} is not installed: {one_line(str(error))}") from None
        except Unsuited as error:
            raise Unable(str(error)) from None

    def derivative(self, mode: str) -> np.ndarray:
        """See `Renderer`.

        Raises:
            Unable: DEODR refuses the mesh, or its images jump.
        """
        try:
            found = self.peer.derivative(mode)
        except AssertionError:
            raise Unable("it refuses the mesh by an assertion") from None
        if self.method.peer == "DEODR" and np.abs(found).max(initial=0.0) > JUMP:
            raise Unable("its derivative is here a difference of its images, and these jump at the least motion")
        return found

    def slopes(self, amounts: np.ndarray, weigh: Weigh) -> np.ndarray:
        """See `Renderer`."""
        peer = self._peer(replace(self.scene, parameters=shifted(self.scene, np.asarray(amounts, np.float64))))
        modes = list(self.scene.directions)
        if isinstance(peer, Mitsuba):
            return peer.slopes(modes, weigh)
        assert isinstance(peer, Deodr)
        weights = weigh(peer.image())
        return np.array([peer.gradient(mode, weights)() for mode in modes])
