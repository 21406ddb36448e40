"""Rows that only the library itself can measure: isosurfaces, poses with directions that change nothing, float32.

Each function measures one cell; for another renderer the outcome is "cannot".
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rts import Camera, Part, fit, plugin, render, rigid
from rts.errors import InputError
from rts.plugin_api.arrays import Array
from rts.tool_api.plugins import engine_named
from rts_compare.derivative_scores import relative_l2
from rts_compare.failures import failure_scenes
from rts_compare.failures.method_renderers import Own, Unable, quiet
from rts_compare.failures.row_measures import own
from rts_compare.failures.table_cells import Context, Outcome, cannot, graded
from rts_compare.failures.table_columns import Method
from rts_compare.moving_scenes import parts_of
from rts_compare.true_derivatives import area_image, lattice
from rts_diagnostics.smoothing import low_pass

COUNT, BOUNDS = 16, ((-1.0,) * 3, (1.0,) * 3)
COLOR = np.array([0.9, 0.6, 0.3], np.float32)
VIEW = ((1.2, 1.6, 2.6), (0, 0, 0))
SIZE = (64, 64)
RADII = 0.448, 0.449, 0.45, 0.451, 0.452
"""Radii of the balls that lattices show at first."""


def _points() -> np.ndarray:
    """The points (n, n, n, 3) of a lattice in [−1, 1]³, `COUNT` along each axis."""
    line = np.linspace(-1, 1, COUNT)
    return np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)


def _grid_part(values: Any, shader: str = "lambert") -> Part:
    return Part(plugin("rts.surfaces", "isosurface")(BOUNDS), {"values": values, "color": COLOR}, shader)


def _camera() -> Camera:
    return Camera.look_at(*VIEW, fov_y=40.0)


def _image(values: Array, method: Method, shader: str = "lambert") -> Array:
    with quiet():
        return render(_grid_part(values, shader), _camera(), SIZE, **method.options)[..., :3]


def _gradient(values: np.ndarray, method: Method) -> tuple[float, int]:
    """The largest derivative of the image's mean square by a lattice value; and the number of NaN and infinite ones.

    Over images with the shaders "lambert" and "silhouette".
    """
    engine = engine_named("torch")
    largest, nan = 0.0, 0
    for shader in ("lambert", "silhouette"):

        def loss(x: Array, shader: str = shader) -> Array:
            return (_image(x, method, shader) ** 2).mean()

        value, found = engine.value_and_grad(loss)(engine.constant(values.astype(np.float32)))
        gradient = engine.to_numpy(found)
        nan += int((~np.isfinite(gradient)).sum()) + int(not np.isfinite(float(value)))
        largest = max(largest, float(np.abs(np.nan_to_num(gradient)).max()))
    return largest, nan


def _of_values(values: np.ndarray, usual: np.ndarray, limits: tuple[float, float], method: Method) -> Outcome:
    """The outcome of comparing the largest gradient at `values` with that at `usual` values."""
    try:
        own(method)
    except Unable:
        return cannot("it has no isosurfaces")
    (largest, nan), (before, _) = _gradient(values, method), _gradient(usual, method)
    ratio = largest / before if before else 0.0
    text = f"{ratio:.1f}×" + (f", {nan} NaN" if nan else "")
    return Outcome(graded(ratio, *limits, nan), text, {"largest": ratio, "nan": nan})


def lattice_ties(method: Method, context: Context) -> Outcome:
    """Compare gradients of a box whose faces pass exactly through lattice points, where values are −0."""
    distances = np.round(np.abs(_points()).max(axis=-1) * (COUNT - 1)) - 9.0  # Odd multiples of half a cell.
    return _of_values(np.where(distances == 0, -0.0, distances), distances + 0.4, (3.0, 30.0), method)


def singular_crossings(method: Method, context: Context) -> Outcome:
    """Compare gradients of two balls that all but touch: at the saddle between them the field has no slope."""
    x, y, z = np.moveaxis(_points(), -1, 0)
    saddle = (x**2 - 0.3) ** 2 + y**2 + z**2 - 0.3**2
    return _of_values(saddle + 1e-7, saddle - 0.05, (30.0, 300.0), method)


def density_grid(name: str, rate: float, method: Method, context: Context) -> Outcome:
    """Fit the values of a lattice, which show a ball, to the image of an egg, by "adam" or "sgd" at a learning rate.

    Fits from starts that differ by a thousandth end up to three times as far off: numbers are medians.
    """
    if method.peer:
        return cannot("it has no isosurfaces")
    engine = engine_named("torch")
    true = (np.linalg.norm(_points() * [1, 1.3, 0.8], axis=-1) - 0.6).astype(np.float32)
    target = np.asarray(_image(true, Method("", {"supersample": 3})))

    def difference(values: Array) -> Array:
        return _image(values, method) - engine.constant(target, values)

    options: dict[str, Any] = dict(steps=3 * context.steps, patience=10**6, progress=False, learning_rate=rate)
    fits = []
    for radius in RADII:
        start = engine.constant((np.linalg.norm(_points(), axis=-1) - radius).astype(np.float32))
        run = fit(difference, start, method=name, loss=lambda r: abs(r).mean(), **options)
        history = np.array(run.history)
        nan = int((~np.isfinite(history)).sum()) + ("not finite" in run.reason)
        fits.append([history[0], history.min(), history[-10:].mean(), history[-10:].mean() / history.min(), nan])
    begun, least, end, ratio, _ = np.median(fits, axis=0).tolist()
    nan = int(sum(f[-1] for f in fits))
    verdict = "failed" if least > 0.5 * begun else graded(ratio, 1.2, 2.0, nan)
    numbers = {"start": begun, "least": least, "end": end, "ends": [float(f[2]) for f in fits], "nan": nan}
    return Outcome(verdict, f"{end:.4f} ({ratio:.1f}×)", numbers)


def gauge_freedom(method: Method, context: Context) -> Outcome:
    """Fit a product of two poses by Levenberg–Marquardt: six combinations of its twelve numbers change nothing."""
    if method.peer:
        return cannot("it offers no Jacobian")
    scene, engine = failure_scenes.box_pose(), engine_named("torch")
    parts, camera = scene.at(scene.parameters)
    parts = parts_of((parts, camera))
    target = area_image(parts, camera, scene.size, lattice(4))[..., :3].astype(np.float32)
    ends, drifts, nan = [], [], 0
    for seed in range(max(1, context.seeds // 2)):
        start = np.random.default_rng(seed).normal(size=(2, 6)) * 0.06

        def residuals(poses: Array) -> Array:
            moved = parts[0].replace(transform=rigid(poses[0]) @ rigid(poses[1]))
            image = render([moved, *parts[1:]], camera, scene.size, **method.options)[..., :3]
            return image - engine.constant(target, image)

        first = engine.constant(start.astype(np.float32))
        try:
            run = fit(residuals, first, method="lm", steps=40, progress=False)
        except InputError as error:
            return Outcome("failed", "no derivative", {"why": str(error), "nan": 0})
        poses = engine.to_numpy(run.parameters).astype(np.float64)
        nan += int((~np.isfinite(poses)).sum())
        drifts.append(float(np.abs(poses - start).max()))
        transform = rigid(poses[0]) @ rigid(poses[1])
        points = np.asarray(parts[0].theta["vertices"])
        still = np.asarray(camera.project(points, scene.size))
        ended = np.asarray(camera.project(points @ transform[:3, :3].T + transform[:3, 3], scene.size))
        ends.append(float(np.sqrt(((still - ended)[:, :2] ** 2).sum(axis=1).mean())))
    done = sum(end < 0.5 for end in ends)
    share = done / len(ends)
    verdict = "failed" if nan or share < 0.5 else "ok" if share >= 0.9 else "degraded"
    text = f"{done}/{len(ends)}, {np.median(ends):.2g} px"
    return Outcome(verdict, text, {"off": ends, "drift": max(drifts), "nan": nan})


def precision(method: Method, context: Context) -> Outcome:
    """Compare the derivative image of a scene in float32 with that in float64."""
    if method.peer:
        return cannot("it has one precision only: " + ("float64" if method.peer == "DEODR" else "float32"))
    scene = failure_scenes.plain()
    found = [Own(scene, method.options, dtype).derivative("tx") for dtype in (np.float32, np.float64)]
    low = low_pass(found[1])
    if not low.any():
        return Outcome("failed", "no derivative at all", {"nan": 0})
    left = relative_l2(low_pass(found[0]), low, low)
    nan = int(sum((~np.isfinite(f)).sum() for f in found))
    return Outcome(graded(left, 1e-3, 1e-1, nan), f"{left:.1g}", {"error": left, "nan": nan})


def swept_trap(method: Method, context: Context) -> Outcome:
    """Fit a sphere swept along a circle to a torus that is seen from its axis: the hole never opens (paper §4.5)."""
    if method.peer:
        return cannot("it has no isosurfaces")
    return _swept(method, context, ((0, 3.4, 0), (0, 0, -1)))


def swept_turned(method: Method, context: Context) -> Outcome:
    """Repeat the fit of `swept_trap`, seen obliquely: symmetry no longer hides the hole."""
    if method.peer:
        return cannot("it has no isosurfaces")
    return _swept(method, context, ((0.9, 2.2, 2.4), (0, 1, 0)))


def _swept(method: Method, context: Context, view: tuple) -> Outcome:
    from rts_compare.builtin_scenes import torus

    engine = engine_named("torch")
    surface = plugin("rts.surfaces", "isosurface")(BOUNDS, f=torus, shape=(28,) * 3, reads=("radii",))
    camera = Camera.look_at(view[0], (0, 0, 0), up=view[1], fov_y=40.0)

    def image(radii: Any, **options: Any) -> Array:
        with quiet():
            part = Part(surface, {"radii": radii, "color": COLOR}, "lambert")
            return render(part, camera, SIZE, **options)[..., :3]

    truth = np.array([0.6, 0.25], np.float32)
    target = np.asarray(image(truth, supersample=3))

    def residuals(radii: Array) -> Array:
        return image(radii, **method.options) - engine.constant(target, radii)

    start = engine.constant(np.array([0.05, 0.5], np.float32))
    run = fit(residuals, start, steps=context.steps, learning_rate=0.03, patience=10**6, progress=False)
    radii = engine.to_numpy(run.parameters)
    off, nan = float(np.abs(radii - truth).max()), int((~np.isfinite(radii)).sum())
    text = f"radii {radii[0]:.2f}, {radii[1]:.2f}"
    return Outcome(graded(off, 0.02, 0.1, nan), text, {"radii": radii.tolist(), "nan": nan})
