"""The sRGB curve (IEC 61966-2-1, exactly); models and pictures are converted by it, and nothing else is."""

from __future__ import annotations

import numpy as np


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear values, of any shape, as sRGB; alpha must not be among them."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def decode_srgb(encoded: np.ndarray) -> np.ndarray:
    """The sRGB values (…, C) of the first three channels as linear ones; further channels, such as alpha, stay."""
    color = encoded[..., :3]
    linear = np.where(color <= 0.04045, color / 12.92, ((np.maximum(color, 0) + 0.055) / 1.055) ** 2.4)
    return np.concatenate([linear, encoded[..., 3:]], axis=-1).astype(encoded.dtype)
