"""Measures of cells: the error of a derivative image, and the share of fits that converge."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rts_compare.derivative_scores import relative_l2
from rts_compare.failures.method_renderers import Unable, quiet, renderer, shifted
from rts_compare.failures.table_cells import Context, Outcome, cannot, graded
from rts_compare.failures.table_columns import Method
from rts_compare.moving_scenes import Scene, parts_of
from rts_compare.other_renderers.renderer_input import renderer_input
from rts_compare.true_derivatives import area_image, lattice, truth
from rts_diagnostics.smoothing import low_pass

ERRORS = 0.2, 0.5
"""The largest error of a derivative image that is ok, and degraded."""
SHARES = 0.9, 0.5
"""The least share of converged fits with which a method is ok, and degraded."""
CLOSE = 0.5
"""The largest distance of points, pixels root mean square, of a converged fit."""
SEEDS_OF_MITSUBA = 5


# ---------------------------------------------------------------------------------------------------- derivatives


def pixel_of(scene: Scene, mode: str) -> float:
    """The step along a mode that moves the fastest vertex by a pixel; 1 if nothing moves.

    Raises:
        Unsuited: the scene's parts are no coloured triangles, see `renderer_input`.
    """
    return 1.0 / (renderer_input(scene).fastest(mode) or 1.0)


class Derivative(NamedTuple):
    """A row that measures one derivative image.

    Attributes:
        scene: () → the scene, at rest where the derivative is taken.
        reference: () → another scene of the same image, whose true derivative is taken; None for the scene's own.
        pixel: the step that moves the fastest point by a pixel; None to compute it by `pixel_of`.
        double: whether the library computes in float64.
        mode: the scene's mode to measure; None for the first.
    """

    scene: Callable[[], Scene]
    reference: Callable[[], Scene] | None = None
    pixel: float | None = None
    double: bool = False
    mode: str | None = None

    def __call__(self, method: Method, context: Context) -> Outcome:
        """The cell of a method: its error, see `numbers`, and the verdict by `ERRORS`."""
        try:
            numbers = self.numbers(method, context)
        except Unable as reason:
            return cannot(str(reason))
        more = f", {numbers['nan']} NaN" if numbers["nan"] else ""
        verdict = graded(numbers["error"], *ERRORS, int(numbers["nan"]))
        return Outcome(verdict, f"{numbers['error']:.2f} ({numbers['largest']:.1f}×){more}", numbers)

    def numbers(self, method: Method, context: Context) -> dict[str, float]:
        """Measure the derivative of a method.

        Returns:
            error: relative L2 through `low_pass`.
            largest: the largest derivative of a pixel's colour, over that of the true derivative.
            nan: the number of values of the derivative, and of `Renderer.broken`, that are not finite.
            truth_error: the estimated error of the true derivative.

        Raises:
            Unable: the method does not apply.
            Unsuited: see `pixel_of`, where it is needed.
        """
        scene = self.scene()
        mode = next(iter(scene.directions)) if self.mode is None else self.mode
        drawn = renderer(scene, method, np.float64 if self.double else np.float32)
        pixel = pixel_of(scene, mode) if self.pixel is None else self.pixel
        found = drawn.derivative(mode) * pixel
        nan = int((~np.isfinite(found)).sum()) + drawn.broken()
        found = np.nan_to_num(found)
        other = scene if self.reference is None else self.reference()
        step = pixel if self.reference is None else pixel_of(other, mode)
        with quiet():
            true, noise, _ = truth(other, mode, step, samples=context.samples, folder=context.folder)
        low = low_pass(true)
        return {
            "error": relative_l2(low_pass(found), low, low),
            "largest": float(np.abs(found).max() / max(float(np.abs(true).max()), 1e-30)),
            "nan": nan,
            "truth_error": noise,
        }


class Several(NamedTuple):
    """A row of several derivative images, the worst of which counts.

    Attributes:
        derivatives: the images to measure.
    """

    derivatives: tuple[Derivative, ...]

    def __call__(self, method: Method, context: Context) -> Outcome:
        """The cell of a method: the error of each derivative, and the verdict on the largest."""
        try:
            found = [d.numbers(method, context) for d in self.derivatives]
        except Unable as reason:
            return cannot(str(reason))
        errors, nan = [n["error"] for n in found], int(sum(n["nan"] for n in found))
        text = " ".join(f"{error:.2f}" for error in errors) + (f", {nan} NaN" if nan else "")
        numbers = {"errors": errors, "largest": max(n["largest"] for n in found), "nan": nan}
        return Outcome(graded(max(errors), *ERRORS, nan), text, numbers)


class Vanishing(NamedTuple):
    """A row in which the image does not change: the false derivative, relative to that along another mode if any.

    Attributes:
        scene: () → the scene. Its first mode changes nothing; the second, if any, gives the derivative by a pixel of
            motion.
        limits: the largest false derivatives that are ok, and degraded.
    """

    scene: Callable[[], Scene]
    limits: tuple[float, float]

    def __call__(self, method: Method, context: Context) -> Outcome:
        """The cell of a method: the norm of the false derivative, through `low_pass`, over that of the other mode."""
        scene = self.scene()
        try:
            drawn = renderer(scene, method)
            found = [drawn.derivative(mode) * pixel_of(scene, mode) for mode in scene.directions]
            nan = int(sum((~np.isfinite(f)).sum() for f in found)) + drawn.broken()
        except Unable as reason:
            return cannot(str(reason))
        norms = [float(np.linalg.norm(low_pass(np.nan_to_num(f)))) for f in found]
        left = norms[0] if len(norms) == 1 else norms[0] / norms[1] if norms[1] else float(norms[0] > 0)
        text = f"{left:.2g}" + (f", {nan} NaN" if nan else "")
        if len(norms) > 1 and not norms[1]:
            return Outcome("failed", "no derivative at all", {"left": left, "nan": nan})
        return Outcome(graded(left, *self.limits, nan), text, {"left": left, "nan": nan})


# ----------------------------------------------------------------------------------------------------------- fits


class Fitted(NamedTuple):
    """A row of fits by Adam, along all modes of a scene, to an image of the scene at rest.

    Attributes:
        scene: () → the scene, with directions of about a pixel each; in the target all amounts are zero.
        start: random numbers → amounts (modes,) to start from.
        rate: Adam's learning rate at the start; it falls along a cosine to a twentieth.
        blur: standard deviation, pixels, of a Gaussian on the images at the start; it shrinks to zero in the first two
            thirds of the steps.
    """

    scene: Callable[[], Scene]
    start: Callable[[np.random.Generator], np.ndarray]
    rate: float = 0.8
    blur: float = 0.0

    def __call__(self, method: Method, context: Context) -> Outcome:
        """The cell of a method: how many fits converge, and the verdict by `SHARES`.

        "failed" if any slope is not finite.
        """
        scene = self.scene()
        still = parts_of(scene.at(scene.parameters)), scene.at(scene.parameters)[1]
        with quiet():
            target = area_image(*still, scene.size, lattice(4))[..., :3]
        count = min(context.seeds, SEEDS_OF_MITSUBA) if method.peer == "Mitsuba" else context.seeds
        ends, nan, largest = [], 0, 0.0
        try:
            drawn = renderer(scene, method)
            for seed in range(count):
                first = self.start(np.random.default_rng(seed))
                end, bad, slope = self._fit(drawn, first, target, context.steps)
                ends.append(distance(scene, end))
                nan, largest = nan + bad, max(largest, slope)
        except Unable as reason:
            return cannot(str(reason))
        done = sum(end < CLOSE for end in ends)
        share = done / count
        verdict = "ok" if share >= SHARES[0] else "degraded" if share >= SHARES[1] else "failed"
        text = f"{done}/{count}, {np.median(ends):.2g} px" + (f", {nan} NaN" if nan else "")
        numbers = {"converged": done, "of": count, "off": [float(f"{e:.3g}") for e in ends], "largest": largest}
        return Outcome("failed" if nan else verdict, text, {**numbers, "nan": nan})

    def _fit(self, drawn: Any, first: np.ndarray, target: np.ndarray, steps: int) -> tuple[np.ndarray, int, float]:
        """The amounts (modes,) at the end, the number of slopes that were not finite, and the largest of the others.

        Slopes that are not finite count as zero.
        """
        import torch
        from scipy.ndimage import gaussian_filter

        amounts, nan, largest = torch.tensor(np.array(first, np.float64)), 0, 0.0
        adam = torch.optim.Adam([amounts], lr=self.rate, betas=(0.9, 0.99), eps=1e-12)
        for step in range(1, steps + 1):
            sigma = self.blur * max(0.0, 1 - step / (steps * 2 / 3))

            def weigh(image: np.ndarray, sigma: float = sigma) -> np.ndarray:
                rest = image - target
                if sigma > 0:  # With zeros beyond the image the filter is its own adjoint.
                    for _ in range(2):
                        rest = gaussian_filter(rest, (sigma, sigma, 0), mode="constant")
                return 2 * rest / rest.size

            slopes = drawn.slopes(amounts.numpy().copy(), weigh)
            bad = ~np.isfinite(slopes)
            nan, slopes = nan + int(bad.sum()), np.where(bad, 0.0, slopes)
            largest = max(largest, float(np.abs(slopes).max()))
            adam.param_groups[0]["lr"] = self.rate * (0.05 + 0.95 * (1 + np.cos(np.pi * step / steps)) / 2)
            amounts.grad = torch.as_tensor(slopes, dtype=amounts.dtype)
            adam.step()
        return amounts.numpy(), nan, largest


def distance(scene: Scene, amounts: np.ndarray) -> float:
    """The distance of vertices from their places at rest: pixels, root mean square over parts that moved; else 0."""
    total = []
    zero = np.zeros(len(amounts))
    for a, b in zip(_on_screen(scene, amounts), _on_screen(scene, zero), strict=True):
        if not np.array_equal(a, b):
            total.append(((a - b) ** 2).sum(axis=1))
    return float(np.sqrt(np.concatenate(total).mean())) if total else 0.0


def _on_screen(scene: Scene, amounts: np.ndarray) -> list[np.ndarray]:
    """The pixel coordinates (V, 2) of the vertices of each part, moved by amounts (modes,)."""
    parts, camera = scene.at(shifted(scene, amounts))
    points_of = []
    for part in parts_of((parts, camera)):
        points = np.asarray(part.theta["vertices"], np.float64)
        if part.transform is not None:
            points = points @ part.transform[:3, :3].T + part.transform[:3, 3]
        points_of.append(np.asarray(camera.project(points, scene.size))[:, :2])
    return points_of


def own(method: Method) -> None:
    """Refuse methods that are other renderers.

    Raises:
        Unable: the method is another renderer.
    """
    if method.peer:
        raise Unable("the row is about what only we have")
