"""Outputs of a render as files: arrays in one .npz, or a picture each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import typer

import rts
from rts.tool_api.files import writing

MOST = 65535
"""The largest number of a PNG of 16 bits."""
NUMBERS = ("position", "uv")
"""Outputs that are no picture."""


def names_of(text: str) -> tuple[str, ...]:
    """The outputs written as "depth,normal"."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def check_names(names: tuple[str, ...], path: Path) -> None:
    """Refuse outputs that a picture of this kind cannot hold, before any is computed."""
    kind = path.suffix.lower()
    wrong = [name for name in names if name in NUMBERS or (kind == ".hdr" and name != "color")]
    if wrong and kind != ".npz":
        raise typer.BadParameter(
            f"{', '.join(wrong)} are numbers, and no picture; write all outputs into one .npz: -o out.npz",
            param_hint="'--outputs'",
        )


def write_outputs(path: Path, outputs: Mapping[str, np.ndarray], exposure: float | None = None) -> list[str]:
    """Write outputs (H, W, ·), and return a line for each file, which says what its numbers mean.

    Args:
        path: a .npz for all; or the picture of "color", beside which lie those of others, as out.depth.png beside
            out.png. In .exr all are numbers as they are.
        outputs: name → array.
        exposure: of "color", as `rts.save_image` takes it.
    """
    with writing(path):
        return _written(path, outputs, exposure)


def _written(path: Path, outputs: Mapping[str, np.ndarray], exposure: float | None) -> list[str]:
    """The lines of `write_outputs`, as files are written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() == ".npz":
        np.savez(path, **outputs)  # pyright: ignore[reportArgumentType]  # No output is called allow_pickle.
        return [f"{path}: {', '.join(outputs)}"]
    return list(_pictures(path, outputs, exposure))


def _pictures(path: Path, outputs: Mapping[str, np.ndarray], exposure: float | None) -> Iterator[str]:
    from PIL import Image

    for name, array in outputs.items():
        if name == "color":
            rts.save_image(path, array, exposure)
            yield f"{path}: color"
            continue
        file = path.with_suffix(f".{name}{path.suffix}")
        if path.suffix.lower() == ".exr":
            rts.save_image(file, array.astype(np.float32))
            yield f"{file}: {name}"
            continue
        if name == "normal":
            there = np.abs(array).max(axis=-1, keepdims=True) > 0
            Image.fromarray(np.where(there, np.round(127.5 * (array + 1)), 0).astype(np.uint8)).save(file)
            yield f"{file}: normals from −1 to 1 as 0 to 255"
            continue
        most = float(array.max(initial=0))
        if name in ("part", "triangle"):
            scale, offset, what = 1.0, 1, "indices plus one, 0 where nothing is"
        elif name == "alpha":
            scale, offset, what = float(MOST), 0, f"alpha, {MOST} is 1"
        else:
            scale, offset, what = MOST / most if most > 0 else 1.0, 0, f"{name}, {MOST} is {most:g} world units"
        grey = np.round(array[..., 0] * scale + offset)
        if grey.max(initial=0) > MOST or array.shape[-1] != 1:
            raise rts.InputError(f"the output {name!r} does not fit into a PNG of 16 bits; write a .npz: -o out.npz")
        Image.fromarray(grey.astype(np.uint16)).save(file)
        yield f"{file}: {what}"
