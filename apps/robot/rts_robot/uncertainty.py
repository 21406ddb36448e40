"""How sure parameters are that were fitted to masks."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

import rts

BLOCKS = 10
"""Blocks along the longer side of the pixels that change."""
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

    Residuals of neighbours are alike, those of wrong pixels are large, and a base that stands still has the same
    residuals in every view. So the inverse of JᵀJ times their mean square is too small. Instead a block of pixels at a
    time is left out of all views, and the parameters move by (H − H_b)⁻¹ g_b, to first order: H is the loss's second
    derivative, g_b the slope of the block's share. The covariance is (n − 1) / n times the sum of the squares of these
    moves over n blocks, the mean for four grids of blocks. It is Efron's jackknife, close to the sandwich estimate for
    clustered residuals (CR3).

    Args:
        residuals: parameters (U,), number of a view → (H, W).
        parameters: (U,).
        views: their number.
        loss: of each residual.
        names: the parameters, in words.

    Raises:
        rts.InputError: the residuals do not tell the parameters apart.
    """
    engine, moments = rts.engine_of(parameters), []
    for number in range(views):
        image, rows = engine.jacobian(lambda v, number=number: residuals(v, number))(parameters)
        r, jacobian = image.double(), rows.double().numpy()
        y, x = np.nonzero(np.abs(jacobian).sum(axis=0))
        j = jacobian[:, y, x].T
        curved = (_slope(r + STEP, loss) - _slope(r - STEP, loss)) / (2 * STEP)
        second = curved[y, x, None, None] * j[:, :, None] * j[:, None]
        moments.append((y, x, _slope(r, loss)[y, x, None] * j, second))
    y, x, first, second = (np.concatenate(of_views) for of_views in zip(*moments, strict=True))
    hessian = second.sum(axis=0)
    _refuse_open(hessian, names)
    total, grids = np.zeros_like(hessian), _blocks(y - y.min(), x - x.min())
    for block in grids:
        count = block.max() + 1
        slopes, curvatures = np.zeros((count, *first.shape[1:])), np.zeros((count, *second.shape[1:]))
        np.add.at(slopes, block, first)
        np.add.at(curvatures, block, second)
        moves = np.linalg.solve(hessian - curvatures, slopes[..., None])[..., 0]
        total += moves.T @ moves * (count - 1) / count
    return total / len(grids)


def _slope(r: torch.Tensor, loss: rts.Loss) -> np.ndarray:
    """The derivative of the loss of each residual."""
    return (loss.weights(r)[0] * r).numpy()


def _blocks(y: np.ndarray, x: np.ndarray) -> list[np.ndarray]:
    """The block of each pixel, numbered from 0 on, in each grid: grids are half a block apart."""
    side = max(y.max(), x.max()) // BLOCKS + 1
    corners = ((0, 0), (side // 2, 0), (0, side // 2), (side // 2, side // 2))
    places = (((y + top) // side) * 2 * BLOCKS + (x + left) // side for top, left in corners)
    return [np.unique(place, return_inverse=True)[1] for place in places]


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
