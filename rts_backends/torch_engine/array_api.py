"""The array-API namespace of torch tensors: `array_api_compat.torch`, with a `take` and a `clip` of our own."""

from __future__ import annotations  # Names of torch, such as `int`, hide those of Python here.

from typing import Any

from array_api_compat import torch as _compat
from array_api_compat.torch import *  # noqa: F403  # pyright: ignore[reportWildcardImportFromLibrary]
from torch import Tensor, clamp, compiler


def take(x: Tensor, indices: Tensor, /, *, axis: int | None = None) -> Tensor:
    """Entries of `x` along an axis, by integers of any width: `torch.vmap` of torch 2.4 takes 64 bits alone."""
    return _compat.take(x, indices.long(), axis=axis)


def clip(x: Tensor, /, min: Any = None, max: Any = None) -> Tensor:
    """`x` between bounds. array_api_compat asks whether they are NaN, which `torch.compile` cannot trace of sizes."""
    if compiler.is_compiling() and not isinstance(min, Tensor) and not isinstance(max, Tensor):
        return clamp(x, min, max)
    return _compat.clip(x, min, max)
