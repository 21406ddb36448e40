"""Which loops ordinary calls need, found by such calls on small pictures, which Python interprets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from rts import companion, registry
from rts.arrays.engines import engine_named
from rts.contracts.checks import check_splatter
from rts.operations.operation import Operation
from rts.rendering.image import render
from rts.rendering.samples import sample
from rts.rendering.scene import Scene
from rts.rendering.splats import to_splats
from rts.sampling.adaptive import Adaptive
from rts.scene.camera import Camera
from rts.scene.parts import Part
from rts.scene.rigid import rigid
from rts.threads import read_only

if TYPE_CHECKING:
    from rts.compiling import Need

SIZES = {1: (8, 10), 2: (24, 32)}
"""Sizes of pictures of one part and of two, which are to cross; Python takes a tenth of a second, and one."""


def routes() -> Iterator[list[dict[int, Need | None]]]:
    """What kinds of calls need, by number, in the order in which they need it; ordinary kinds first, a few at a time.

    Those that `companion.expect` knows have the number of their name, too, of no loop.
    """
    yield [_route(_render, 1)]
    yield [_route(kind, 1) for kind in KINDS[1:]]
    yield [_route(kind, 2) for kind in KINDS]


def _route(kind: Callable[[list[Part], tuple[int, int]], None], count: int) -> dict[int, Need | None]:
    from rts import compiling

    with compiling.interpreting() as needs, np.errstate(all="ignore"):
        kind(_parts()[:count], SIZES[count])
    name = {companion.number(EXPECTED[kind]): None} if kind in EXPECTED else {}
    return {**name, **needs}


def _camera() -> Camera:
    return Camera.look_at((0.3, 0.8, 3), (0, 0, 0), fov_y=40)


def _parts() -> list[Part]:
    """Two octahedra that pass through one another, so that all that splatters distinguish is there."""
    corners = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
    faces = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
    surface = registry.plugin("rts.surfaces", "mesh")(np.array(faces))
    color = np.array([0.2, 0.5, 0.8], np.float32)
    theta = [{"vertices": corners * 0.9, "color": color}, {"vertices": corners[:, ::-1] * 0.7 + 0.3, "color": color}]
    return [Part(surface, each, shader) for each, shader in zip(theta, ("lambert", "silhouette"), strict=True)]


@dataclass
class _Tape:
    """What operations have been called with, while NumPy stands for an engine that differentiates."""

    pushes: bool
    calls: list[tuple[Operation, Sequence[np.ndarray], Any, dict]] = field(default_factory=list)

    def apply(self, operation: Operation, operands: Sequence[np.ndarray], params: Any) -> np.ndarray:
        """The value; the derivative along a direction too, if it pushes."""
        # Constants have the dtype of what is differentiated.
        operands = [read_only(x, np.float32 if x.dtype == np.float64 else None) for x in operands]
        value = np.empty(operation.shape(*(x.shape for x in operands), **params), operands[0].dtype)
        kept = operation.forward(operands, value, **params)
        self.calls.append((operation, operands, kept, dict(params)))
        if self.pushes:
            tangents = [read_only(np.zeros((1, *x.shape), x.dtype)) for x in operands[: operation.differentiable]]
            operation.push_on_host(operands, tangents, np.empty((1, *value.shape), value.dtype), kept, dict(params))
        return value

    def pull(self) -> None:
        """Go back through all calls, as for a gradient."""
        for operation, operands, kept, params in reversed(self.calls):
            g = read_only(np.zeros(operation.shape(*(x.shape for x in operands), **params), operands[0].dtype))
            results = [np.zeros(x.shape, x.dtype) for x in operands[: operation.differentiable]]
            operation.pull_on_host(operands, g, results, kept, params)


@contextmanager
def _differentiating(pushes: bool = False) -> Iterator[_Tape]:
    """Have NumPy stand for an engine that differentiates."""
    engine: Any = engine_named("numpy")
    tape = _Tape(pushes)
    engine.__dict__.update(differentiates=True, apply=tape.apply)
    try:
        yield tape
    finally:
        del engine.__dict__["differentiates"], engine.__dict__["apply"]


def _render(parts: list[Part], size: tuple[int, int]) -> None:
    render(parts, _camera(), size)


def _gradient_of_vertices(parts: list[Part], size: tuple[int, int]) -> None:
    with _differentiating() as tape:
        _render(parts, size)
        tape.pull()


def _gradient_of_pose(parts: list[Part], size: tuple[int, int]) -> None:
    with _differentiating() as tape:
        _render(_posed(parts), size)
        tape.pull()


def _gradient_of_silhouette(parts: list[Part], size: tuple[int, int]) -> None:
    _gradient_of_pose(_dark(parts), size)


def _least_squares_of_silhouette(parts: list[Part], size: tuple[int, int]) -> None:
    for splatter, layers in (("auto", 2), ("single", 1)):
        _least_squares(_dark(parts), size, splatter, layers, channels=1)


def _least_squares(
    parts: list[Part], size: tuple[int, int], splatter: Any = "auto", layers: int = 2, channels: int = 4
) -> None:
    with _differentiating(pushes=True):
        splatter, camera = check_splatter(splatter), _camera().for_size(size)
        parts = _posed(parts)
        sampled = sample(parts, camera, size, splatter=splatter, layers=layers, settles=True)
        scene = Scene.of(parts, camera, "auto", None).at(size)
        splats = to_splats(sampled, scene.parts, camera, camera, scene.context)
        t_positions, t_rgba = (np.zeros((1, *x.shape), x.dtype) for x in (splats.positions, splats.rgba))
        splatter.normal_equations(splats, t_positions, t_rgba, np.zeros((*size, channels), np.float32))


def _adaptive(parts: list[Part], size: tuple[int, int]) -> None:
    render(parts, _camera(), size, supersample=Adaptive(2))


def _posed(parts: list[Part]) -> list[Part]:
    return [part.replace(transform=rigid(np.zeros(6, np.float32))) for part in parts]


def _dark(parts: list[Part]) -> list[Part]:
    return [part.replace(shader="silhouette") for part in parts]


KINDS = (
    _render,
    _gradient_of_vertices,
    _gradient_of_pose,
    _least_squares,
    _adaptive,
    _gradient_of_silhouette,
    _least_squares_of_silhouette,
)
EXPECTED = {
    _least_squares: companion.LEAST_SQUARES,
    _least_squares_of_silhouette: companion.LEAST_SQUARES_OF_MASKS,
}
