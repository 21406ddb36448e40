"""PNG of 16 bits with colours, which Pillow cuts to 8 bits (PNG specification, third edition)."""

from __future__ import annotations

import struct
import zlib

import numpy as np

SIGNATURE = b"\x89PNG\r\n\x1a\n"
CHANNELS = {2: 3, 4: 2, 6: 4}
"""Channels of pictures with colours or alpha, by the type that the header gives."""
_PASSES = ((0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1))
"""First row, first column, and steps between rows and columns, of the passes of Adam7."""


def is_deep(data: bytes) -> bool:
    """True for a PNG of 16 bits that has colours or alpha."""
    return data[:8] == SIGNATURE and data[12:16] == b"IHDR" and data[24] == 16 and data[25] in CHANNELS


def read_deep(data: bytes) -> np.ndarray:
    """(h, w, 4) float32 in [0, 1], as encoded, of a PNG that `is_deep`, and that Pillow reads.

    Raises:
        ValueError: there are too few data; zlib.error: they are damaged.
    """
    from rts.files.deep_images_loops import unfilter

    width, height, _, kind, _, _, interlaced = struct.unpack_from(">IIBBBBB", data, 16)
    channels = CHANNELS[kind]
    chunks = _chunks(data)
    stream = np.frombuffer(zlib.decompress(b"".join(content for name, content in chunks if name == b"IDAT")), np.uint8)
    found, at = np.zeros((height, width, channels), np.uint16), 0
    for row, column, down, across in _PASSES if interlaced else ((0, 0, 1, 1),):
        place = found[row::down, column::across]
        if not place.size:
            continue
        length = 1 + 2 * channels * place.shape[1]
        end = at + length * place.shape[0]
        if end > len(stream):
            raise ValueError(f"it has {len(stream)} bytes of pixels; expected {end} or more")
        rows = stream[at:end].reshape(-1, length).copy()
        if rows[:, 0].max() > 4:
            raise ValueError(f"it has a row of filter {rows[:, 0].max()}; expected 0 to 4")
        unfilter(rows, 2 * channels)
        place[...] = rows[:, 1:].copy().view(">u2").reshape(place.shape)
        at = end
    values = found.astype(np.float32) / 65535
    if channels == 2:
        return values[..., [0, 0, 0, 1]]
    if channels == 4:
        return values
    clear = next((content for name, content in chunks if name == b"tRNS"), b"")
    # One colour may be transparent.
    seen = (found != np.frombuffer(clear[:6], ">u2")).any(axis=2) if len(clear) >= 6 else np.ones((height, width), bool)
    return np.concatenate([values, seen[..., None].astype(np.float32)], axis=2)


def _chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """The name and content of each chunk."""
    found, at = [], 8
    while at + 8 <= len(data):
        length, name = struct.unpack_from(">I4s", data, at)
        found.append((name, data[at + 8 : at + 8 + length]))
        at += 12 + length
    return found
