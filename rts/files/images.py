"""Pictures to and from files.

Inside the library colours are linear and images premultiplied; files hold sRGB and straight alpha.
"""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rts.arrays.argument_checks import quoted
from rts.arrays.engines import engine_of
from rts.arrays.trees import Array
from rts.contracts.checks import MEMORY, is_real
from rts.errors import EngineError, InputError, PluginError
from rts.files.bright_images import read_exr, read_hdr, write_exr, write_hdr
from rts.files.damaged_files import Fail, gathered, warn, warn_once
from rts.files.deep_images import is_deep, read_deep
from rts.files.paths import as_path, output_file, writing
from rts.files.srgb import decode_srgb, encode_srgb
from rts.shading.tone_mapping import check_exposure, tonemap

PICTURES = (".png", ".hdr", ".exr")
"""Extensions that `save_image` writes."""


def save_image(path: Any, image: Array, exposure: float | None = None) -> None:
    """Write a PNG, or with colours of any brightness Radiance's .hdr, or .exr if OpenEXR is installed (extra `exr`).

    Args:
        path: a name with one of these extensions; folders that do not exist are made.
        image: (H, W, 4) premultiplied linear RGBA, (H, W, 3), (H, W, 1) or (H, W), floating numbers, an array of any
            engine or nested lists. In a .png, values outside [0, 1] are clipped, and colours are sRGB; of (H, W),
            which is light, too. A mask of coverage, such as `image[..., 3]`, would be encoded as well: save the
            RGBA image, whose alpha is not. A .hdr has no alpha, and nothing below 0.
        exposure: for colours in a .png: stops by which they are made brighter, before `rts.shading.tonemap` brings
            them into the range of a display. None does neither.

    Raises:
        InputError: no array, another shape, integers, NaN or infinity, more than fits into memory, another extension,
            a path that cannot be or may not be written to, or an exposure that is no number, or not for this picture.
        PluginError: .exr without OpenEXR.
    """
    from PIL import Image

    path = output_file(path, "picture", PICTURES)
    kind, pixels = path.suffix.lower(), pixels_of(image, "the image")
    if exposure is not None:
        check_exposure(exposure)
        if kind != ".png" or pixels.ndim == 2:
            raise InputError(f"exposure is {exposure}, for {path.name!r}; expected None, but for colours in a .png")
        pixels = tonemap(pixels, exposure)
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == ".hdr":
            write_hdr(path, pixels)
        elif kind == ".exr":
            write_exr(path, pixels)
        else:
            Image.fromarray(_bytes(pixels)).save(path)


def png_of(image: Array) -> bytes:
    """The bytes of the PNG that `save_image` writes."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(_bytes(pixels_of(image, "the image"))).save(file, "PNG")
    return file.getvalue()


PHOTOGRAPHS = {"JPEG", "MPO", "WEBP"}
"""Formats of photographs, whose EXIF data are read in no time."""


def load_image(path: Any) -> np.ndarray:
    """(H, W, 4) float32 premultiplied linear RGBA of a picture of any kind that Pillow reads, of .hdr or .exr.

    Of several frames it is the first. Colours of .hdr and .exr have any brightness.

    Raises:
        InputError: there is no such file, it cannot be read as a picture, holds NaN or infinity, or floating-point
            numbers whose range is not known.
        PluginError: .exr without OpenEXR (extra `exr`).

    Warns:
        FileWarning: Pillow found something wrong with it; it is a JPEG or WebP that is stored on its side, as which it
            is read.
    """
    path = as_path(path)
    if path.is_dir():
        raise InputError(f"{path} is a folder; expected a picture")
    if not path.is_file():
        raise InputError(f"there is no picture {path}; check the path (relative paths start at {Path.cwd()})")
    if path.suffix.lower() in (".hdr", ".exr"):
        return _bright(path)
    with gathered(path) as notes:
        encoded = read_image(path)
        _warn_of_turns(path)
    warn_once(path, notes)
    straight = decode_srgb(encoded)
    alpha = straight[..., 3:] if straight.shape[2] == 4 else np.ones_like(straight[..., :1])
    return np.concatenate([straight[..., :3] * alpha, alpha], axis=2)


def _warn_of_turns(path: Path) -> None:
    """Warn of a picture that viewers turn upright, or mirror, by its EXIF data."""
    from PIL import ExifTags, Image

    orientation = None
    # Pillow itself turns TIFF. Damaged EXIF data raise many kinds of errors, and say nothing.
    with Image.open(path) as image, contextlib.suppress(Exception):
        if image.format in PHOTOGRAPHS:
            orientation = image.getexif().get(ExifTags.Base.Orientation)
    if orientation in range(2, 9):
        warn(
            f"{path} is stored on its side or mirrored (EXIF orientation {orientation}), and is read as stored; "
            f"PIL.ImageOps.exif_transpose turns it, for which a camera found from stored pixels is wrong"
        )


def _bright(path: Path) -> np.ndarray:
    """The result of `load_image` for .hdr and .exr."""
    pixels = read_hdr(path) if path.suffix.lower() == ".hdr" else read_exr(path)
    wrong = pixels.size - int(np.isfinite(pixels).sum())
    if wrong:
        raise InputError(f"{wrong} of {path}'s {pixels.size} values are NaN or infinite; check what made it")
    color = pixels[..., :3] if pixels.shape[2] > 1 else np.repeat(pixels, 3, axis=2)
    alpha = pixels[..., 3:] if pixels.shape[2] == 4 else np.ones_like(pixels[..., :1])
    return np.concatenate([color, alpha], axis=2)


def save_animation(path: Any, frames: Iterable[Array], fps: float = 20.0) -> None:
    """Write an animated .gif or .png, or an .mp4 if imageio-ffmpeg is installed (extra `video`).

    Args:
        path: a name with one of these extensions; folders that do not exist are made.
        frames: images as for `save_image`, all of one size; transparent ones are put on white.
        fps: frames a second. A .gif counts in hundredths of a second, a .png in thousandths: the nearest is taken.

    Raises:
        InputError: no frames, or one image instead of several; what is no image, a wrong or changing shape, NaN or
            infinity; fps that are no positive number, or that the format cannot hold; another extension, or a path
            that cannot be or may not be written to.
        PluginError: .mp4 without imageio-ffmpeg.
    """
    from PIL import Image

    path = output_file(path, "animation", (".gif", ".png", ".mp4"))
    kind = path.suffix.lower()
    if not (is_real(fps) and np.isfinite(fps) and fps > 0):
        raise InputError(f"fps is {quoted(fps)}; expected a positive number of frames a second")
    duration = _duration(kind, float(fps))
    pictures = [_bytes(_on_white(pixels_of(f, f"frame {i}"))) for i, f in enumerate(_each(frames))]
    if not pictures or len({p.shape for p in pictures}) > 1:
        shapes = ", ".join(sorted({str(p.shape) for p in pictures})) or "nothing"
        raise InputError(f"the frames are {shapes}; expected at least one, and all of one shape")
    if kind == ".gif" and max(pictures[0].shape[:2]) > 65535:
        raise InputError(f"the frames are {pictures[0].shape}; expected at most 65535 pixels a side in a .gif")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == ".mp4":
            _write_mp4(path, pictures, float(fps))
            return
        images = [Image.fromarray(p) for p in pictures]
        if kind == ".gif":
            images = [i.convert("RGB").quantize(256, dither=Image.Dither.NONE) for i in images]
        images[0].save(path, save_all=True, append_images=images[1:], duration=duration, loop=0)


def _duration(kind: str, fps: float) -> int:
    """Milliseconds of a frame, rounded as the format needs; 0 for .mp4. Refuses rates that the format cannot hold."""
    step = {".gif": 10, ".png": 1}.get(kind)
    if step is None:
        return 0
    duration = round(1000 / fps / step) if 1000 / fps < 1e9 else 2**31
    if not 1 <= duration <= 65535:
        raise InputError(
            f"fps is {fps:g}, and a {kind} holds from {1000 / step / 65535:.2g} to {1000 // step} frames a second; "
            "choose others, or leave frames out"
        )
    return duration * step


def _each(frames: Any) -> Iterable[Any]:
    """The frames of an animation as they are, refused if they are one image, or nothing to iterate over."""
    shape = tuple(getattr(frames, "shape", ()))
    one = len(shape) in (1, 2) or (len(shape) == 3 and shape[2] in (1, 3, 4))
    if one or isinstance(frames, (str, bytes, dict)) or not isinstance(frames, Iterable):
        description = f"one image, {shape}" if one else f"a {type(frames).__name__}"
        raise InputError(f"frames is {description}; expected several images, such as a list of arrays (H, W, 4)")
    return frames


def _write_mp4(path: Path, pictures: list[np.ndarray], fps: float) -> None:
    try:
        # Not among what is installed for checks of types.
        from imageio_ffmpeg import write_frames  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        raise PluginError(
            "mp4 needs imageio-ffmpeg: pip install 'rasterize-then-splat[video]'; or write a .gif"
        ) from None
    # The usual pixel format of mp4 halves the resolution of colour: sides must be even.
    even_sized = [
        np.pad(p, ((0, p.shape[0] % 2), (0, p.shape[1] % 2), *[(0, 0)] * (p.ndim - 2)), mode="edge") for p in pictures
    ]
    kind = "rgb24" if even_sized[0].ndim == 3 else "gray"
    writer = write_frames(path, even_sized[0].shape[1::-1], pix_fmt_in=kind, fps=fps, macro_block_size=2)
    writer.send(None)
    for picture in even_sized:
        writer.send(np.ascontiguousarray(picture))
    writer.close()


def pixels_of(image: Any, name: str) -> np.ndarray:
    """An image as NumPy floats, (H, W, 3 or 4), or (H, W) for one channel; all else is refused, as `name`."""
    shapes = "(H, W, 4), (H, W, 3), (H, W, 1) or (H, W)"
    pixels: Any = image
    if isinstance(image, (list, tuple)):
        with contextlib.suppress(ValueError, TypeError, RuntimeError):  # Of rows of different lengths, for example.
            pixels = np.asarray(image)
    if not hasattr(pixels, "shape"):
        raise InputError(f"{name} is {quoted(image)}, a {type(image).__name__}; expected an array {shapes}")
    try:
        engine = engine_of(pixels)
    except EngineError as error:
        raise InputError(
            f"{name} is a {type(image).__name__}; expected an array {shapes} of NumPy, torch or jax"
        ) from error
    shape = tuple(pixels.shape)
    if len(shape) not in (2, 3) or 0 in shape or (len(shape) == 3 and shape[2] not in (1, 3, 4)):
        raise InputError(f"{name} has shape {shape}; expected {shapes}")
    if 100 * math.prod(shape) > MEMORY:  # A few copies in float64.
        raise InputError(f"{name} has shape {shape}, which does not fit into memory; write it in pieces")
    array = np.asarray(engine.to_numpy(pixels))
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if not np.issubdtype(array.dtype, np.floating):
        raise InputError(f"{name} has dtype {array.dtype}; expected linear floats")
    wrong = array.size - int(np.isfinite(array).sum())
    if wrong:
        raise InputError(f"{wrong} of {name}'s {array.size} values are NaN or infinite; check what made it")
    return array


def _bytes(image: np.ndarray) -> np.ndarray:
    """uint8 sRGB of a linear image, clipped to [0, 1]: (H, W, 4) premultiplied, made straight; (H, W, 3); or (H, W)."""
    array = image.astype(np.float64)
    if array.ndim == 3 and array.shape[2] == 4:
        alpha = np.clip(array[..., 3:], 0, 1)
        with np.errstate(over="ignore"):  # What is infinite is clipped.
            straight = np.divide(array[..., :3], alpha, out=np.zeros_like(array[..., :3]), where=alpha > 0)
        array = np.concatenate([encode_srgb(np.clip(straight, 0, 1)), alpha], axis=2)
    else:
        array = encode_srgb(np.clip(array, 0, 1))
    return np.round(array * 255).astype(np.uint8)


def _on_white(image: np.ndarray) -> np.ndarray:
    if image.ndim == 2 or image.shape[2] == 3:
        return image
    return np.clip(image[..., :3], -1e30, 1e30) + (1 - np.clip(image[..., 3:], 0, 1))


def read_image(path: Path) -> np.ndarray:
    """The result of `pixels` for an image file; an InputError if it cannot be read."""
    return decoded(path, str(path), lambda what: InputError(f"{what}; export it again, as PNG for example"))


def decoded(source: Path | bytes, name: str, fail: Fail) -> np.ndarray:
    """The result of `pixels` for a file or its bytes, of 16 bits where a PNG has them.

    An error, `fail` of a text with `name`, if it cannot be read.
    """
    from PIL import Image

    try:
        with Image.open(io.BytesIO(source) if isinstance(source, bytes) else source) as image:
            found = pixels(image)
            if image.format != "PNG":
                return found
        data = source if isinstance(source, bytes) else source.read_bytes()
        return _with_alpha_if_any(read_deep(data)) if is_deep(data) else found
    except Exception as error:  # Pillow's decoders raise many kinds, SyntaxError and struct.error among them.
        raise fail(f"{name} cannot be read as an image ({' '.join(str(error).split())})") from error


def pixels(image: Any) -> np.ndarray:
    """(h, w, 3) float32 in [0, 1] of a Pillow image as encoded, (h, w, 4) where some alpha is below one."""
    if image.mode == "F":
        raise ValueError("it holds floating-point numbers, whose range is not known")
    if image.mode.startswith("I"):  # 16 bits of grey, which Pillow would clip to 8.
        grey = np.asarray(image, np.float32) / 65535
        return np.repeat(np.clip(grey, 0, 1)[..., None], 3, axis=2)
    return _with_alpha_if_any(np.asarray(image.convert("RGBA"), np.float32) / 255)


def _with_alpha_if_any(rgba: np.ndarray) -> np.ndarray:
    return rgba if (rgba[..., 3] < 1).any() else np.ascontiguousarray(rgba[..., :3])
