"""Wrong arguments, refused in one line: what was given, and what was expected."""

from __future__ import annotations

from typing import Any

import torch

from rts import InputError

FLOATS = (torch.float32, torch.float64)
MOST = 1 << 24
"""Triangles, at most: their numbers are stored as floats in `rast`."""


def described(x: Any) -> str:
    """A tensor's shape and dtype in words, or the kind of anything else."""
    if isinstance(x, torch.Tensor):
        return f"has shape {tuple(x.shape)} and dtype {str(x.dtype).removeprefix('torch.')}"
    return f"is {type(x).__name__}"


def check_floats(name: str, x: Any, shape: tuple[int | str, ...], *others: tuple[int | str, ...]) -> torch.Tensor:
    """A tensor of floats of one of some shapes, others are refused.

    Words in a shape stand for any number from 1; "vertices" may be none.
    """
    shapes = (shape, *others)
    if isinstance(x, torch.Tensor) and x.dtype in FLOATS and any(_fits(tuple(x.shape), s) for s in shapes):
        return x
    expected = " or ".join(f"({', '.join(map(str, s))})" for s in shapes)
    raise InputError(f"{name} {described(x)}; expected a tensor {expected} of float32 or float64")


def _fits(shape: tuple[int, ...], expected: tuple[int | str, ...]) -> bool:
    fits = (
        n == e or (isinstance(e, str) and (n > 0 or e == "vertices")) for n, e in zip(shape, expected, strict=False)
    )
    return len(shape) == len(expected) and all(fits)


def check_finite(pos: torch.Tensor) -> None:
    """Refuse positions that are NaN or infinite."""
    wrong = (~pos.detach().isfinite()).nonzero()
    if len(wrong):
        raise InputError(f"pos{wrong[0].tolist()} is NaN or infinite ({len(wrong)} such numbers); expected finite ones")


def check_triangles(tri: Any) -> torch.Tensor:
    """`tri` (T, 3) int32 or int64; others are refused."""
    if not isinstance(tri, torch.Tensor) or tri.dtype not in (torch.int32, torch.int64) or tri.shape[1:] != (3,):
        raise InputError(f"tri {described(tri)}; expected a tensor (triangles, 3) of int32")
    if len(tri) >= MOST:
        raise InputError(f"tri has {len(tri)} triangles; expected fewer than {MOST}, whose numbers a float can hold")
    return tri


def check_corners(tri: torch.Tensor, count: int, of: str) -> None:
    """Refuse triangles whose corners name none of `count` rows `of` an argument."""
    if len(tri) and not 0 <= int(tri.min()) <= int(tri.max()) < count:
        raise InputError(f"tri names rows {int(tri.min())} to {int(tri.max())}; expected 0 to {count - 1}, as {of} has")


def check_rast(rast: Any) -> torch.Tensor:
    """`rast` (B, H, W, 4); others are refused."""
    return check_floats("rast", rast, ("images", "height", "width", 4))


def check_devices(**tensors: torch.Tensor | None) -> None:
    """Refuse tensors of several devices."""
    devices = {name: x.device for name, x in tensors.items() if x is not None}
    if len(set(devices.values())) > 1:
        told = ", ".join(f"{name} on {device}" for name, device in devices.items())
        raise InputError(f"tensors are on several devices: {told}; expected one")
