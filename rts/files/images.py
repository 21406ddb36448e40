"""Pictures to and from files.

Inside the library colours are linear and images premultiplied; files hold sRGB and straight alpha.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rts.engines import engine_of
from rts.errors import InputError, PluginError
from rts.files.paths import as_path, output_file
from rts.files.srgb import decode_srgb, encode_srgb
from rts.trees import Array


def save_image(path: Any, image: Array) -> None:
    """Write a PNG.

    Args:
        path: a name ending in .png; folders that do not exist are made.
        image: (H, W, 4) premultiplied linear RGBA, (H, W, 3), (H, W, 1) or (H, W); values outside [0, 1] are
            clipped.

    Raises:
        InputError: another shape, integers, NaN or infinity, another extension, or a path that cannot be.
    """
    from PIL import Image

    path = output_file(path, "picture", (".png",))
    encoded = _bytes(image)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(encoded).save(path)


def load_image(path: Any) -> np.ndarray:
    """(H, W, 4) float32 premultiplied linear RGBA of a picture of any kind that Pillow reads.

    Raises:
        InputError: there is no such file, or it cannot be read as a picture.
    """
    path = as_path(path)
    if not path.is_file():
        raise InputError(f"there is no picture {path}; check the path (relative paths start at {Path.cwd()})")
    encoded = read_image(path)
    straight = decode_srgb(encoded)
    alpha = straight[..., 3:] if straight.shape[2] == 4 else np.ones_like(straight[..., :1])
    return np.concatenate([straight[..., :3] * alpha, alpha], axis=2)


def save_animation(path: Any, frames: Iterable[Array], fps: float = 20.0) -> None:
    """Write an animated .gif or .png, or an .mp4 if imageio-ffmpeg is installed.

    Args:
        path: a name with one of these extensions; folders that do not exist are made.
        frames: images as for `save_image`, all of one size; transparent ones are put on white.
        fps: frames a second.

    Raises:
        InputError: no frames, a wrong or changing shape, NaN or infinity, another extension, or a path that cannot be.
        PluginError: .mp4 without imageio-ffmpeg.
    """
    from PIL import Image

    path = output_file(path, "animation", (".gif", ".png", ".mp4"))
    kind = path.suffix.lower()
    if not (np.isfinite(fps) and fps > 0):
        raise InputError(f"fps is {fps}; expected a positive number of frames a second")
    pictures = [_bytes(_on_white(_host(frame))) for frame in frames]
    if not pictures or len({p.shape for p in pictures}) > 1:
        shapes = ", ".join(sorted({str(p.shape) for p in pictures})) or "nothing"
        raise InputError(f"the frames are {shapes}; expected at least one, and all of one shape")
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == ".mp4":
        _write_mp4(path, pictures, fps)
        return
    images = [Image.fromarray(p) for p in pictures]
    if kind == ".gif":
        images = [i.convert("RGB").quantize(256, dither=Image.Dither.NONE) for i in images]
    images[0].save(path, save_all=True, append_images=images[1:], duration=1000 / fps, loop=0)


def _write_mp4(path: Path, pictures: list[np.ndarray], fps: float) -> None:
    import imageio.v2 as imageio

    try:
        # Not among what is installed for checks of types.
        import imageio_ffmpeg  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        raise PluginError("mp4 needs the package imageio-ffmpeg: pip install imageio-ffmpeg; or write a .gif") from None
    # The usual pixel format of mp4 halves the resolution of colour: sides must be even.
    even: list[Any] = [p if p.ndim == 3 else np.repeat(p[..., None], 3, axis=2) for p in pictures]
    even = [np.pad(p, ((0, p.shape[0] % 2), (0, p.shape[1] % 2), (0, 0)), mode="edge") for p in even]
    # The format's own options are not in the function's annotations.
    imageio.mimwrite(path, even, fps=fps, macro_block_size=2)  # pyright: ignore[reportCallIssue]


def _host(image: Array) -> np.ndarray:
    """A checked image as NumPy floats, (H, W, 3 or 4) or (H, W)."""
    array = np.asarray(engine_of(image).to_numpy(image))
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.ndim not in (2, 3) or array.size == 0 or (array.ndim == 3 and array.shape[2] not in (3, 4)):
        raise InputError(f"the image has shape {array.shape}; expected (H, W, 4), (H, W, 3), (H, W, 1) or (H, W)")
    if not np.issubdtype(array.dtype, np.floating):
        raise InputError(f"the image has dtype {array.dtype}; expected linear floats in [0, 1]")
    wrong = array.size - int(np.isfinite(array).sum())
    if wrong:
        raise InputError(f"{wrong} of the image's {array.size} values are NaN or infinite; check what made it")
    return array


def _bytes(image: Array) -> np.ndarray:
    """8-bit sRGB with straight alpha of a premultiplied linear image."""
    array = _host(image).astype(np.float64)
    if array.ndim == 3 and array.shape[2] == 4:
        alpha = np.clip(array[..., 3:], 0, 1)
        straight = np.divide(array[..., :3], alpha, out=np.zeros_like(array[..., :3]), where=alpha > 0)
        array = np.concatenate([encode_srgb(np.clip(straight, 0, 1)), alpha], axis=2)
    else:
        array = encode_srgb(np.clip(array, 0, 1))
    return np.round(array * 255).astype(np.uint8)


def _on_white(image: np.ndarray) -> np.ndarray:
    return image[..., :3] + (1 - image[..., 3:]) if image.ndim == 3 and image.shape[2] == 4 else image


def read_texture(path: Path, referrer: Path) -> np.ndarray:
    """Pixels of the image that `referrer` names; see `pixels`."""
    if not path.is_file():
        raise InputError(
            f"{referrer} refers to the texture {path.name!r}, but there is no file {path}; put it there, or "
            f"remove the reference to load without it"
        )
    return read_image(path)


def read_image(path: Path) -> np.ndarray:
    """Pixels of an image file; see `pixels`."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return pixels(image)
    except Exception as error:  # Pillow's decoders raise many kinds, SyntaxError and struct.error among them.
        raise InputError(f"{path} cannot be read as an image ({error}); export it again, as PNG for example") from error


def pixels(image: Any) -> np.ndarray:
    """(h, w, 3) float32 in [0, 1] of a Pillow image as encoded, (h, w, 4) where some alpha is below one."""
    if image.mode.startswith("I"):  # 16 bits of grey, which Pillow would clip to 8.
        grey = np.asarray(image, np.float32) / 65535
        return np.repeat(np.clip(grey, 0, 1)[..., None], 3, axis=2)
    rgba = np.asarray(image.convert("RGBA"), np.float32) / 255
    return rgba if (rgba[..., 3] < 1).any() else np.ascontiguousarray(rgba[..., :3])
