"""Claims about what a sampler finds between the centres of cells."""

from __future__ import annotations

from typing import Any

import numpy as np

from rts.contracts.records import Request, Samples
from rts.scene.camera import Camera
from rts.scene.parts import Part
from rts.testing import scenes
from rts.testing.claims import claim
from rts.testing.derivatives import single

SIZE = 24, 32
WIDTH = 0.25
"""Width of wires, in cells."""

WIRES = {
    "level": ((3.3, 12.0), (28.6, 12.0)),
    "slanted": ((5.2, 3.4), (25.7, 19.9)),
    "steep": ((14.3, 2.6), (17.2, 21.3)),
}
"""Both ends of wires, (x, y) in cells from the upper left corner."""


def told(sampler: Any, part: Part) -> Samples | None:
    """The samples of a part on the plane's grid, with `between`; None if the sampler does not tell."""
    height, width = SIZE
    middle = width / 2, -height / 2
    camera = Camera.orthographic((*middle, 4), (*middle, 0), height=height, aspect=width / height, near=1, far=9)
    samples = sampler.sample(scenes.checked(part), camera.map(single), SIZE, 1, Request(between=True))
    return None if samples.between is None else samples


def wire(start: tuple[float, float], end: tuple[float, float]) -> Part:
    """A rectangle half a unit above the plane z = 0, where a cell is a unit."""
    ends = np.array([start, end])
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    across = WIDTH / 2 * np.array([-along[1], along[0]])
    corners = np.array([ends[0] - across, ends[1] - across, ends[1] + across, ends[0] + across])
    return scenes.mesh(np.column_stack([corners * [1, -1], np.full(4, 0.5)]), np.array([[0, 1, 2], [0, 2, 3]]))


def hills() -> Part:
    """A wavy sheet of triangles that are smaller than cells."""
    y, x = np.meshgrid(np.linspace(-26, 2, 71), np.linspace(-2, 34, 91), indexing="ij")
    heights = np.sin(x / 3) * np.cos(y / 4)
    index = np.arange(71 * 91).reshape(71, 91)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return scenes.mesh(np.stack([x, y, heights], -1).reshape(-1, 3), faces)


def claim_wires_are_told(sampler: Any) -> bool:
    """Fail unless wires are found in the cells that they cross and that show them nowhere around; False if it is mute.

    Cells that a wire only grazes, by less than a fiftieth, may be told or not.
    """
    for name, (start, end) in WIRES.items():
        samples = told(sampler, wire(start, end))
        if samples is None:
            return False
        between, seen = np.asarray(samples.between), np.pad(np.asarray(samples.row)[0] >= 0, 1)
        claim(between.shape == SIZE, f"{name} wire: between has shape {between.shape}; expected {SIZE}")
        seen = np.lib.stride_tricks.sliding_window_view(seen, (3, 3)).any(axis=(2, 3))
        surely, perhaps = (_crossed(start, end, WIDTH + margin) & ~seen for margin in (-0.02, 0.02))
        missed, wrong = surely & (between == 0), ~perhaps & (between != 0)
        claim(
            not missed.any(),
            f"{name} wire: {missed.sum()} of {surely.sum()} cells that it crosses unseen have no `between`",
        )
        claim(not wrong.any(), f"{name} wire: {wrong.sum()} cells have a `between` that do not hold it, or show it")
        claim(np.allclose(between[between != 0], 3.5, rtol=1e-4), f"{name} wire: between is not its depth, 3.5")
    return True


def claim_fine_meshes_are_not_told(sampler: Any) -> None:
    """Fail if small triangles of a sheet that every cell shows are taken for something between centres."""
    samples = told(sampler, hills())
    assert samples is not None
    count = np.count_nonzero(np.asarray(samples.between))
    claim(not count, f"small triangles of a wavy sheet: {count} cells have a `between`; expected none")


def _crossed(start: tuple[float, float], end: tuple[float, float], width: float) -> np.ndarray:
    """Cells (H, W) bool that a rectangle touches: no axis of the square or the rectangle separates them."""
    y, x = np.indices(SIZE) + 0.5
    ends = np.array([start, end])
    length = np.linalg.norm(ends[1] - ends[0]) + width - WIDTH
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    across, off = np.array([-along[1], along[0]]), np.stack([x, y], -1) - ends.mean(axis=0)
    reach = np.abs(along).sum() / 2
    near = (np.abs(off @ along) < length / 2 + reach) & (np.abs(off @ across) < width / 2 + reach)
    return near & (np.abs(off) < 0.5 + np.abs(along) * length / 2 + np.abs(across) * width / 2).all(axis=-1)
