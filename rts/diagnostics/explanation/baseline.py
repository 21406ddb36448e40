"""Baseline for a derivative's error: the error of a similar sphere or box, moved in the same manner."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rts.arrays.engines import engine_of, namespace
from rts.arrays.trees import Tree, leaves, map_leaves
from rts.diagnostics.example_shapes import box, icosphere, unlit
from rts.diagnostics.explanation import variants
from rts.diagnostics.explanation.slopes import Number, measured
from rts.diagnostics.explanation.subject import Subject
from rts.scene.camera import Camera
from rts.scene.parts import Part

SUBDIVISIONS = 4
"""Subdivisions of the sphere."""
FEWEST = 8
"""The least number of pixels of an object that a sphere or a box is fitted to."""
SAMPLES = 8
"""Samples a pixel along each axis, for the baseline's truth."""
COLOR = (0.9, 0.6, 0.3)


class Baseline(NamedTuple):
    """Derivatives of the fitted sphere or box.

    Attributes:
        name: "a sphere" or "a box".
        pushed: (H, W, 4), see `Number`.
        true: (H, W, 4), see `Number`.
        slope: the derivative of the loss through the splatter.
        difference: the finite difference of the loss.
    """

    name: str
    pushed: np.ndarray
    true: np.ndarray
    slope: float
    difference: float


def nearest(
    subject: Subject, number: Number, parts: Sequence[int] | None, options: Mapping[str, Any]
) -> Baseline | None:
    """The sphere or the box whose outline is most like that of the moving parts.

    None if the parts show in fewer than `FEWEST` pixels, or if forward mode fails through the splatter.

    Args:
        subject: the scene.
        number: the number of the parameters that moves the scene.
        parts: indices of the parts that move; None for all.
        options: options of `rts.render`, which replace those of the subject.
    """
    only = variants.alone(range(len(subject.parts)) if parts is None else parts)
    probe = variants.all_of(only, variants.placed)
    plain: dict[str, Any] = dict(splatter="none", layers=1, supersample=1, background=None, capacity=None)
    places = subject.engine.to_numpy(subject.image(subject.parameters, probe, **plain)).astype(np.float64)
    seen = places[..., 3] > 0.5
    if seen.sum() < FEWEST:
        return None
    position = places[seen][:, :3]
    velocity = subject.push(number.direction, probe, **plain)[seen][:, :3].astype(np.float64)
    rows = np.column_stack([position, np.ones(len(position))])
    motion = np.linalg.lstsq(rows, velocity, rcond=1e-6)[0]  # (4, 3), velocity = rows @ motion.
    camera = subject.shown(subject.parameters)[1]
    candidates = []
    for name, (vertices, faces) in zip(("a sphere", "a box"), _shapes(position, camera), strict=True):
        moved = replace(
            subject,
            scene=partial(_scene, subject, number, vertices, faces, motion),
            parameters={"by": subject.engine.constant(np.zeros(()), next(leaves(subject.parameters)))},
            options={**subject.options, **options, "background": None, "sampler": "auto"},
        )
        mask = moved.seen[..., 3] > 0.5
        candidates.append(((mask & seen).sum() / max((mask | seen).sum(), 1), name, moved))
    _, name, moved = max(candidates, key=lambda c: c[0])
    direction = map_leaves(namespace(*leaves(moved.parameters)).ones_like, moved.parameters)
    result = measured(moved, name, direction, None, SAMPLES)
    if not result.forward:
        return None
    return Baseline(name, result.pushed, result.true, result.slope.autodiff, result.slope.difference)


def _shapes(position: np.ndarray, camera: Camera) -> list[tuple[np.ndarray, np.ndarray]]:
    """A sphere and a box about points (N, 3) that a camera sees: (vertices (V, 3), world, faces (T, 3)) of each."""
    view = np.asarray(engine_of(camera.view).to_numpy(camera.view), np.float64)
    local = position @ view[:3, :3].T + view[:3, 3]
    low, high = np.percentile(local, 1, axis=0), np.percentile(local, 99, axis=0)
    half, middle = (high - low) / 2, (high + low) / 2
    # Of a round object only the half before its outline is seen.
    depth = max(high[2] - low[2], 1e-3 * half[:2].max())
    sphere, triangles = icosphere(SUBDIVISIONS)
    back = np.linalg.inv(view)

    def world(points: np.ndarray) -> np.ndarray:
        return points @ back[:3, :3].T + back[:3, 3]

    flat = half[:2].max() + 1e-9
    round_ = sphere * [half[0], half[1], max(depth, 0.2 * flat)] + [*middle[:2], low[2]]
    corners, faces = box([*low[:2], high[2] - depth], high)
    return [(world(round_), triangles), (world(corners), faces)]


def _scene(
    subject: Subject, number: Number, vertices: np.ndarray, faces: np.ndarray, motion: np.ndarray, parameters: Tree
) -> tuple[Part, Camera]:
    """The fitted shape and the scene's camera, both moved as the number moves them.

    Args:
        subject: the scene.
        number: the number that moves.
        vertices: (V, 3) of the shape, world space.
        faces: (T, 3) of the shape.
        motion: (4, 3), from a point (x, y, z, 1) to its velocity for a unit of the number.
        parameters: {"by": (), the change of the number}.
    """
    by, engine = parameters["by"], subject.engine
    steps = iter(leaves(number.direction))
    camera = subject.shown(map_leaves(lambda p: p + by * next(steps), subject.parameters))[1]
    velocity = np.column_stack([vertices, np.ones(len(vertices))]) @ motion
    part = unlit(vertices, faces, COLOR)
    if np.abs(velocity).max() > 0:
        part = part.replace(
            theta={**part.theta, "vertices": engine.constant(vertices, by) + by * engine.constant(velocity, by)}
        )
    return part, camera
