"""The pose iteration that speed is measured on, by rts: loss, and a step with torch or jax.

One iteration renders the silhouette of a mesh, takes the mean squared difference (or another loss) to the hard
silhouette of 4 × 4 samples a pixel at the zero pose, its gradient in the pose, and a step of Adam.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

import rts
from benchmarks.camera import camera, supersampled
from benchmarks.timing import RATE, START

VERTEX_RATE = 1e-5
"""The learning rate of Adam for vertices: steps so small that the mesh stays what it is while time is taken."""

MODES = ("pose", "full", "full, both")
"""Gradient of the pose, vertices constant; of pose and vertices, a step in the pose; the same, a step in both."""


class Task:
    """A mesh, and the image that its pose is to be found from.

    Args:
        name: of the mesh.
        vertices: (V, 3) float32.
        faces: (T, 3) int32.
        side: of the image, pixels.
        shader: of the part.
        layers: K.
        splatter: by which it is rendered.
        cull: of the part.
        reduction: the loss of the differences to the target.
        entries: further entries of the part's θ.
    """

    def __init__(
        self,
        name: str,
        vertices: np.ndarray,
        faces: np.ndarray,
        side: int,
        shader: str = "silhouette",
        layers: int = 2,
        splatter: Any = "auto",
        cull: str = "none",
        reduction: rts.Loss = rts.Loss(),  # noqa: B008  (It is a constant.)
        entries: Mapping[str, Any] | None = None,
    ):
        self.name, self.vertices, self.faces, self.side = name, vertices, faces, side
        self.layers, self.splatter, self.reduction = layers, splatter, reduction
        self.size, self.view = (side, side), camera()
        theta = {"vertices": vertices, **(entries or {})}
        self.part = rts.Part(rts.plugin("rts.surfaces", "mesh")(faces), theta, shader, cull=cull)
        self.channels = slice(3, 4) if shader == "silhouette" else slice(0, 4)
        self.target = self._target()

    def _target(self) -> np.ndarray:
        image = supersampled(self.part, self.view, self.size, 4)
        return image[..., self.channels].astype(np.float32)

    def resized(self, side: int) -> Task:
        """This part, with what samplers keep of it, in an image of another size."""
        other = copy.copy(self)
        other.side, other.size = side, (side, side)
        other.target = other._target()
        return other

    def posed(self, pose: Any, vertices: Any = None) -> rts.Part:
        """The part at a pose (6,); its vertices replaced if others are given."""
        part = self.part.replace(transform=rts.rigid(pose))
        return part if vertices is None else part.replace(theta={**part.theta, "vertices": vertices})

    def loss(self, pose: Any, vertices: Any, target: Any, sampler: str) -> Any:
        """Mean loss of the differences."""
        parts = self.posed(pose, vertices)
        image = rts.render(parts, self.view, self.size, sampler=sampler, splatter=self.splatter, layers=self.layers)
        return self.reduction(image[..., self.channels] - target)

    def residuals(self, scene: Callable[[Any], Any], target: Any, sampler: str) -> rts.ImageResiduals:
        """The differences of `scene(pose)`; their loss is `loss`."""
        options: dict[str, Any] = {"sampler": sampler, "splatter": self.splatter, "layers": self.layers}
        options |= {"loss": self.reduction.name, "f_scale": self.reduction.f_scale}
        return rts.ImageResiduals(scene, self.view, self.size, target, **options)

    def prepared(self) -> Callable[[Any], Any]:
        """The part at a pose (6,), of triangles that the sampler has once and for all."""
        held = rts.prepare(self.part)
        return lambda pose: held.replace(transform=rts.rigid(pose))


# ------------------------------------------------------------------------------------------------------- iterations


def torch_iteration(
    task: Task, mode: str = "pose", sampler: str = "auto", prepared: bool = False
) -> Callable[[], object]:
    """One eager iteration a call, of a `prepared` part or of one that may change."""
    import torch

    pose = torch.tensor(START, requires_grad=True)
    vertices = None if mode == "pose" else torch.tensor(task.vertices, requires_grad=True)
    groups: list[dict] = [{"params": [pose], "lr": RATE}]
    if mode == "full, both":
        groups.append({"params": [vertices], "lr": VERTEX_RATE})
    optimizer = torch.optim.Adam(groups)
    target = torch.from_numpy(task.target)
    scene = task.prepared() if prepared else lambda pose: task.posed(pose, vertices)
    residuals = task.residuals(scene, target, sampler) if prepared else None

    def step() -> float:
        pose.grad = None
        if vertices is not None:
            vertices.grad = None
        loss = task.loss(pose, vertices, target, sampler) if residuals is None else residuals.loss(residuals(pose))
        loss.backward()
        optimizer.step()
        return loss.item()

    return step


def jax_iteration(task: Task, mode: str = "pose", sampler: str = "auto") -> Callable[[], object]:
    """One iteration a call, all of it in one compiled function."""
    import jax

    function, (variables, states) = jax_function(task, mode, sampler)
    function = jax.jit(function)

    def step() -> float:
        nonlocal variables, states
        (moved, states), loss, gradient = function(variables, states)
        jax.block_until_ready((moved, states, gradient))
        variables = variables | moved
        return loss.item()

    return step


def jax_function(task: Task, mode: str, sampler: str) -> tuple[Callable, tuple]:
    """An iteration as a function of parameters and the optimiser's state, and the first of both.

    It gives those parameters that are stepped, and the state; the loss; and its gradient. What is not stepped is not
    handed out: a compiled program copies what it only passes on.
    """
    import jax
    import jax.numpy as jnp
    import optax

    variables = {"pose": jnp.asarray(START, jnp.float32)}
    if mode != "pose":
        variables["vertices"] = jnp.asarray(task.vertices)
    stepped = ("pose", "vertices") if mode == "full, both" else ("pose",)
    rates = {"pose": RATE, "vertices": VERTEX_RATE}
    rules = {name: optax.adam(rates[name]) for name in stepped}
    target = jnp.asarray(task.target)

    def function(variables: dict, states: dict) -> tuple:
        value, gradient = jax.value_and_grad(lambda x: task.loss(x["pose"], x.get("vertices"), target, sampler))(
            variables
        )
        moved, kept = {}, {}
        for name, rule in rules.items():
            updates, kept[name] = rule.update(gradient[name], states[name])
            moved[name] = optax.apply_updates(variables[name], updates)
        # All of the gradient is handed out, lest XLA leave out what nothing reads.
        return (moved, kept), value, gradient

    return function, (variables, {name: rule.init(variables[name]) for name, rule in rules.items()})


ENGINES = {"torch": torch_iteration, "jax": jax_iteration}
