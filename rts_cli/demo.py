"""A scene made of formulas, and its pose recovered from a silhouette: a test drive that needs no files."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from rts import Part, plugin, render, rigid
from rts.tool_api.files import writing
from rts.tool_api.scenes import bounds_of, orbit
from rts_cli.pose_file import posed
from rts_cli.pose_fit import PoseFit, fit_pose, shrunk, silhouette_of
from rts_cli.pose_report import write_report
from rts_cli.pose_verdict import judged

SIZE = (320, 320)
TRUE_ROTATION = (0.22, -0.38, 0.16)
TRUE_TRANSLATION = (0.28, 0.12, -0.2)


def knot(rings: int = 360, sides: int = 32) -> Part:
    """A closed trefoil tube, coloured along its length, and thicker on one side: it has no symmetry."""
    t = np.linspace(0, 2 * np.pi, rings, endpoint=False)

    def curve(t: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -1.4 * np.sin(3 * t)], axis=1)

    step = 1e-3
    tangent = _unit(curve(t + step) - curve(t - step))
    sideways = _unit(np.cross(tangent, [0.0, 0.0, 1.0]))
    above = np.cross(sideways, tangent)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)[None, :, None]
    radius = (0.5 + 0.2 * np.cos(t - 0.6))[:, None, None]
    ring = np.cos(angle) * sideways[:, None] + np.sin(angle) * above[:, None]
    vertices = (curve(t)[:, None] + radius * ring).reshape(-1, 3) * 0.5
    phase = 2 * np.pi * (t[:, None] / (2 * np.pi) + np.array([0.0, 0.36, 0.62]))
    colors = np.repeat((0.5 + 0.42 * np.cos(phase)) ** 1.6, sides, axis=0)
    return _mesh(_grid(rings, sides), {"vertices": vertices, "colors": colors}, "blinn_phong")


def ground(height: float, half: float = 4.2, squares: int = 12) -> Part:
    """A chequered square, wound to face up."""
    corners = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float64)
    vertices = corners * half + [0, height, 0]
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    row, column = np.indices((squares * 16,) * 2) // 16
    light, dark = np.array([0.62, 0.64, 0.68]), np.array([0.2, 0.23, 0.3])
    texture = np.where(((row + column) % 2 == 0)[..., None], light, dark)
    return _mesh(np.array([[0, 1, 2], [0, 2, 3]]), {"vertices": vertices, "uv": uv, "texture": texture}, "lambert")


def run(folder: Path, engine: str | None = None, progress: bool | None = None) -> tuple[PoseFit, list[Path]]:
    """Recover the knot's pose, and write pose.json, pictures, animation, summary.json and summary.md.

    Returns the fit and the files written. `engine` and `progress` are as in `fit_pose`.
    """
    model = [knot()]
    bounds = bounds_of(model)
    floor = ground(float(bounds.center[1] - 1.02 * bounds.radius))
    camera = orbit(bounds._replace(radius=1.25 * bounds.radius), SIZE, 28, 24, fov=40)
    true = np.asarray(rigid(np.array([*TRUE_ROTATION, *TRUE_TRANSLATION]), bounds.center))
    # One layer, as in the fit: two would widen the outline, since back faces of the knot are not culled.
    target = silhouette_of(render(posed(model, true, "silhouette"), camera, SIZE, splatter="single", layers=1))
    result = fit_pose(model, target, camera, bounds, engine=engine, progress=progress)
    verdict = judged(result.pose, model, target)
    files = write_report(folder, result, verdict, model, target, scenery=[floor])
    errors = {
        "rotation_error_degrees": {"start": _degrees(np.eye(4), true), "end": _degrees(result.pose.matrix, true)},
        "translation_error_over_radius": {
            "start": float(np.linalg.norm(TRUE_TRANSLATION) / bounds.radius),
            "end": float(np.linalg.norm(result.translation - TRUE_TRANSLATION) / bounds.radius),
        },
    }
    summary: dict[str, Any] = {
        **errors,
        "loss": {"start": result.first_loss, "end": result.fit.loss},
        "iou": {"start": judged(result.start, model, target).iou, "end": verdict.iou},
        "steps": len(result.fit.history),
        "seconds": result.fit.seconds,
        "triangles": len(model[0].surface.faces),
        "pixels": list(shrunk(target, 256).shape),
    }
    with writing(folder / "summary.json"):
        (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
        (folder / "summary.md").write_text(_markdown(summary, files), encoding="utf-8")
    return result, [*files, folder / "summary.json", folder / "summary.md"]


def _markdown(summary: dict[str, Any], files: list[Path]) -> str:
    rows = [
        ("rotation error, degrees", summary["rotation_error_degrees"]),
        ("translation error, object radii", summary["translation_error_over_radius"]),
        ("mean square difference of silhouettes", summary["loss"]),
        ("intersection over union of silhouettes", summary["iou"]),
    ]
    table = "\n".join(f"| {name} | {v['start']:.3g} | {v['end']:.3g} |" for name, v in rows)
    pictures = "\n\n".join(f"![{f.stem}]({f.name})" for f in files if f.suffix in (".png", ".gif"))
    return (
        "# The pose of a knot, from its silhouette\n\n"
        f"{summary['triangles']} triangles, fitted by Levenberg–Marquardt in {summary['steps']} steps and "
        f"{summary['seconds']:.1f} s, from coarse pixels to {summary['pixels'][0]} × {summary['pixels'][1]}. "
        "Orange is the outline of the target.\n\n"
        f"| | start | end |\n| --- | --- | --- |\n{table}\n\n{pictures}\n"
    )


def _degrees(a: np.ndarray, b: np.ndarray) -> float:
    """Angle of the rotation from one rigid transform to the other; exact for small angles too."""
    half = np.linalg.norm(a[:3, :3] - b[:3, :3]) / math.sqrt(8)
    return math.degrees(2 * math.asin(min(1.0, half)))


def _grid(rings: int, sides: int) -> np.ndarray:
    """Triangles of a torus of vertices, counter-clockwise from outside."""
    i, j = (x.reshape(-1) for x in np.indices((rings, sides)))
    a, b = i * sides + j, (i + 1) % rings * sides + j
    c, d = (i + 1) % rings * sides + (j + 1) % sides, i * sides + (j + 1) % sides
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _mesh(faces: np.ndarray, theta: dict[str, Any], shader: str) -> Part:
    theta = {name: np.ascontiguousarray(value, np.float32) for name, value in theta.items()}
    return Part(plugin("rts.surfaces", "mesh")(faces), theta, shader)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
