"""The compiled splatters as jax primitives: eager, `jit`, `grad`, `jvp`, `vmap` and what is made of them."""

from __future__ import annotations

import collections
import itertools
import secrets
import threading
from typing import Any

import jax
import numpy as np

from rts import splatting
from rts_backends.fused_kernels import Choices, Settings, Splats
from rts_backends.jax_host import clear
from rts_backends.jax_operations import Arrays, Differentiable, Kernels, Some

MOST_KEPT = 1 << 24
"""Bytes of choices that are kept from images to their derivatives."""


def fits(positions: jax.Array, rgba: jax.Array) -> bool:
    """Whether the arrays are of the kernels' dtypes; on what device they are, a traced function cannot know."""
    return positions.dtype == rgba.dtype and positions.dtype in (np.float32, np.float64)


def splat(settings: Settings, positions: jax.Array, rgba: jax.Array, row: jax.Array) -> jax.Array:
    """The image (H, W, 4) of positions (N, 3), rgba (N, 4) and row (K, H, W), without the settings' border."""
    return _image(positions, rgba, row, settings=settings)


def _host_image(samples: Arrays, image: np.ndarray, note: np.ndarray, settings: Settings) -> None:
    splats = _splats(samples, None, settings)
    image[...] = splats.image()
    note[...] = _kept.add(splats.choices) if image.size else -1


def _host_push(samples: Arrays, tangents: Some, out: np.ndarray, settings: Settings) -> None:
    out[...] = _splats(samples[:3], _kept.get(int(samples[3])), settings).jvp(*tangents)


def _host_pull(samples: Arrays, gradients: np.ndarray, results: Some, settings: Settings) -> None:
    splats = _splats(samples[:3], _kept.get(int(samples[3])), settings)
    used, wanted = len(splats.positions), (results[0] is not None, results[1] is not None)
    for i, g in enumerate(gradients):
        for result, found in zip(results, splats.vjp(g, wanted), strict=True):
            if result is not None:
                result[i, :used] = found
                clear(result[i, used:])


def _splats(samples: Arrays, choices: Choices | None, settings: Settings) -> Splats:
    """The samples in use: under `jit` there may be many more."""
    positions, rgba, row = samples
    used = max(1, int(row.max(initial=0)) + 1)
    rgba = np.broadcast_to(rgba, (used, 4)) if len(rgba) == 1 else rgba[:used]
    return Splats(settings, positions[:used], rgba, row, choices)


class _Kept:
    """The latest choices, by a number for each: derivatives need not decide again what the image has decided."""

    def __init__(self):
        # Not from 0: a number that some other process has given is to name nothing here.
        self._numbers, self._choices = itertools.count(secrets.randbits(30)), collections.OrderedDict()
        self._lock, self._bytes = threading.Lock(), 0

    def add(self, choices: Choices) -> int:
        """The number of these choices."""
        with self._lock:
            number = next(self._numbers) % 2**31
            self._choices[number] = choices
            self._bytes += _size(choices)
            while self._bytes > MOST_KEPT:
                self._bytes -= _size(self._choices.popitem(last=False)[1])
        return number

    def get(self, number: int) -> Choices | None:
        """The choices of a number, if they are still known."""
        with self._lock:
            return self._choices.get(number)


def _size(choices: Choices) -> int:
    return sum(x.nbytes for x in choices if isinstance(x, np.ndarray))


_kept = _Kept()


def _specification(positions: jax.Array, rgba: jax.Array, row: jax.Array, *, settings: Settings) -> jax.Array:
    kernel = {"single": splatting.Single, "multi": splatting.Multi, "visible": splatting.Visible}[settings.kind]
    return kernel(settings.sigma, settings.epsilon, settings.gamma).image(positions, rgba, row, settings.border)


def _shape(positions: tuple, rgba: tuple, row: tuple, *, settings: Settings | None = None, **_: Any) -> tuple[int, ...]:
    border = 0 if settings is None else settings.border
    return *(max(0, n - 2 * border) for n in row[1:]), 4


_image = Differentiable(
    "image",
    (2, 2, 3),
    _shape,
    Kernels(_host_image, _host_push, _host_pull),
    _specification,
    even=(1,),
    noted=True,
)
