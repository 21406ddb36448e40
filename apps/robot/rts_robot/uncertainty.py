"""How sure parameters are that were fitted to masks."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

import rts

BLOCKS = 16
"""Blocks along the longer side of a picture."""
STEP = 1e-3
"""Step of differences of a loss's slope, in units of residuals."""
UNDETERMINED = 1e-6
"""Least eigenvalue of the scaled normal equations, that of parameters which residuals tell."""


def covariance_of(
    residuals: Callable[[torch.Tensor, int], torch.Tensor],
    parameters: torch.Tensor,
    views: int,
    loss: rts.Loss,
    names: Sequence[str],
) -> np.ndarray:
    """The covariance (U, U) of parameters at the minimum of a loss, by a jackknife over blocks of pixels.

    Residuals of neighbours are alike, and those of wrong pixels are large, so the inverse of JᵀJ times their mean
    square is too small. Instead a block of pixels at a time is left out, and the parameters move by (H − H_b)⁻¹ g_b, to
    first order: H is the loss's second derivative, g_b the slope of the block's share. The covariance is (n − 1) / n
    times the sum of the squares of these moves over n blocks, the mean for four grids of blocks. It is Efron's
    jackknife, close to the sandwich estimate for clustered residuals (CR3).

    Args:
        residuals: parameters (U,), number of a view → (H, W).
        parameters: (U,).
        views: their number.
        loss: of each residual.
        names: the parameters, in words.

    Raises:
        rts.InputError: the residuals do not tell the parameters apart.
    """
    moments = [_moments(residuals, parameters, number, loss) for number in range(views)]
    # Sums over blocks for each grid, of all views.
    grids = [
        tuple(np.concatenate(sums) for sums in zip(*of_views, strict=True)) for of_views in zip(*moments, strict=True)
    ]
    hessian = grids[0][1].sum(axis=0)
    _refuse_open(hessian, names)
    total = np.zeros_like(hessian)
    for slopes, curvatures in grids:
        moves = np.linalg.solve(hessian - curvatures, slopes[..., None])[..., 0]
        total += moves.T @ moves * (len(moves) - 1) / len(moves)
    return total / len(grids)


def _moments(
    residuals: Callable[[torch.Tensor, int], torch.Tensor], parameters: torch.Tensor, number: int, loss: rts.Loss
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Sums over the blocks of a view, for each grid: slopes (n, U) and second derivatives (n, U, U) of the loss."""
    engine = rts.engine_of(parameters)
    image, rows = engine.jacobian(lambda v: residuals(v, number))(parameters)
    r, jacobian = image.double(), rows.double().numpy()

    def slope(x: torch.Tensor) -> torch.Tensor:
        return loss.weights(x)[0] * x

    first = slope(r).numpy()
    second = ((slope(r + STEP) - slope(r - STEP)) / (2 * STEP)).numpy()
    y, x = np.nonzero(np.abs(jacobian).sum(axis=0))
    j = jacobian[:, y, x].T
    slopes, curvatures = first[y, x, None] * j, second[y, x, None, None] * j[:, :, None] * j[:, None]
    side = -(-max(r.shape) // BLOCKS)
    half, grids = side // 2, []
    for top, left in ((0, 0), (half, 0), (0, half), (half, half)):
        _, block = np.unique(((y + top) // side) * (2 * BLOCKS) + (x + left) // side, return_inverse=True)
        sums = (
            np.zeros((block.max(initial=-1) + 1, len(parameters))),
            np.zeros((block.max(initial=-1) + 1, *2 * (len(parameters),))),
        )
        np.add.at(sums[0], block, slopes)
        np.add.at(sums[1], block, curvatures)
        grids.append(sums)
    return grids


def _refuse_open(hessian: np.ndarray, names: Sequence[str]) -> None:
    """Refuse parameters of which some combination changes nothing."""
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    values, vectors = np.linalg.eigh(hessian / scale[:, None] / scale)
    if values[0] < UNDETERMINED:
        share = np.abs(vectors[:, 0])
        involved = dict.fromkeys(name for name, s in zip(names, share, strict=True) if s > 0.1)
        raise rts.InputError(
            f"the masks do not tell {' and '.join(involved)} apart; expected views in which the outline tells them, or "
            f"fewer offsets"
        )
