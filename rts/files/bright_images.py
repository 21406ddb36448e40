"""Pictures of any brightness: Radiance's .hdr (Ward 1991), and .exr by the package OpenEXR."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from rts.contracts.checks import MEMORY
from rts.errors import InputError, PluginError

LEAST, MOST = 8, 32767
"""Widths of lines that may be run-length encoded."""


def read_hdr(path: Path) -> np.ndarray:
    """(h, w, 3) float32 linear colours of a Radiance file; an InputError if it is damaged or of another kind."""
    data = path.read_bytes()
    head = re.match(rb"#\?[^\n]*\n(.*?)\n\n?-Y (\d{1,9}) \+X (\d{1,9})\n", data[:65536], re.DOTALL)
    if not head or b"FORMAT=32-bit_rle_rgbe" not in head[1]:
        raise InputError(
            f"{path} is no Radiance picture of red, green and blue, row by row from the top; save it anew as .hdr"
        )
    height, width = int(head[2]), int(head[3])
    if not height or not width or 40 * height * width > MEMORY:
        raise InputError(f"{path} says that it has {height} x {width} pixels, which is none, or too many for memory")
    rgbe, place = np.empty((height, width, 4), np.uint8), head.end()
    encoded = LEAST <= width <= MOST and data[place : place + 2] == b"\2\2" and data[place + 2 : place + 3] < b"\x80"
    try:
        if encoded:
            for line in rgbe:
                place = _read_line(data, place, line)
        else:
            flat = np.frombuffer(data, np.uint8, 4 * height * width, place).reshape(rgbe.shape)
            if ((flat[..., :3] == 1).all(axis=2) & (flat[..., 3] > 0)).any():
                raise ValueError("it has repeats of the oldest kind; save it anew")
            rgbe[...] = flat
    except (ValueError, IndexError) as error:
        raise InputError(f"{path} cannot be read as a picture ({' '.join(str(error).split())})") from error
    exposures = [float(x) for x in re.findall(rb"^EXPOSURE=\s*(\d*\.?\d+(?:[eE][-+]?\d+)?)\s*$", head[1], re.MULTILINE)]
    scale = np.ldexp(1.0, rgbe[..., 3:].astype(np.int32) - 136) * (rgbe[..., 3:] > 0)
    return (rgbe[..., :3] * scale / np.prod(exposures or [1.0])).astype(np.float32)


def _read_line(data: bytes, place: int, line: np.ndarray) -> int:
    """Fill a line (w, 4) of bytes, component by component, from encoded runs. Returns the place behind them."""
    width = len(line)
    if data[place : place + 4] != bytes([2, 2, width >> 8, width & 255]):
        raise ValueError("a line has another length")
    place += 4
    for component in line.T:
        column = 0
        while column < width:
            count = data[place]
            run = count - 128 if count > 128 else count
            if not run or column + run > width:
                raise ValueError("a run of pixels is longer than its line")
            size = 1 if count > 128 else run
            component[column : column + run] = np.frombuffer(data, np.uint8, size, place + 1)
            place, column = place + 1 + size, column + run
    return place


def write_hdr(path: Path, image: np.ndarray) -> None:
    """Write linear colours (h, w, 3 or 4) or greys (h, w) as a Radiance file: without alpha, and nothing below 0."""
    color = np.clip(np.stack([image] * 3, axis=2) if image.ndim == 2 else image[..., :3], 0, 1e38).astype(np.float64)
    share, exponent = np.frexp(color.max(axis=2, keepdims=True))
    seen = exponent > -128
    mantissa = np.where(seen, np.minimum(np.rint(np.ldexp(color, 8 - exponent)), 255), 0)
    rgbe = np.concatenate([mantissa, np.where(seen & (share > 0), exponent + 128, 0)], axis=2).astype(np.uint8)
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {image.shape[0]} +X {image.shape[1]}\n"
    path.write_bytes(head.encode() + rgbe.tobytes())


def read_exr(path: Path) -> np.ndarray:
    """(h, w, 1, 3 or 4) float32 linear colours, premultiplied, of an OpenEXR file; else an InputError."""
    exr = _package()
    try:
        with exr.File(str(path)) as file:
            channels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except Exception as error:  # The package raises several kinds.
        raise InputError(f"{path} cannot be read as a picture ({' '.join(str(error).split())})") from error
    for name in ("RGBA", "RGB", "Y"):
        if name in channels:
            pixels = channels[name].astype(np.float32)
            return pixels[..., None] if pixels.ndim == 2 else pixels
    raise InputError(f"{path} has the channels {', '.join(sorted(channels))}; expected R, G, B, or Y")


def write_exr(path: Path, image: np.ndarray) -> None:
    """Write linear colours (h, w, 3 or 4), premultiplied, or greys (h, w) in float32 as an OpenEXR file."""
    exr = _package()
    pixels = np.ascontiguousarray(image, np.float32)
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    names = "Y" if pixels.ndim == 2 else "RGBA"[: pixels.shape[2]]
    exr.File(header, {names: pixels}).write(str(path))


def _package() -> Any:
    try:
        # Not among what is installed for checks of types.
        import OpenEXR  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        raise PluginError("exr needs OpenEXR: pip install 'rasterize-then-splat[exr]'; or take a .hdr") from None
    return OpenEXR
