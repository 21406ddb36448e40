"""Crossings of a scene, as many as there is room for, and the samples beside them that tell colours and motions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rts.compiling.threads import read_only
from rts.errors import InputWarning, warn
from rts.outlines import samples_loops
from rts.outlines.gaps import Crossings, Hits, Stacks
from rts.outlines.required import Required
from rts.outlines.seen_mesh import SeenMesh
from rts.outlines.spans import crossings_of_triangles


class Beside(NamedTuple):
    """The M samples that outlines need beside crossings. Host arrays.

    Attributes:
        place: (M,) int, places in `Outlines.rows`, (B, columns).
        part: (M,) int32, the parts of samples.
        triangle: (M,) int32, on which they lie; −1 where none is known.
        points: (M, 2), where they are.
        number: (M,) int32, how many layers of the same part are in front; 0 where triangles are known.
        columns: the number of columns of `Outlines.rows`.
    """

    place: np.ndarray
    part: np.ndarray
    triangle: np.ndarray
    points: np.ndarray
    number: np.ndarray
    columns: int

    @classmethod
    def of(cls, crossings: Crossings, stacks: Stacks | None, required: Required) -> Beside:
        """The samples that stand for `required` beside crossings of one layer, or that stacks have there."""
        if stacks is not None:
            parts = np.concatenate([stacks.last, stacks.parts], 1)
            (place,) = (parts.reshape(-1) >= 0).nonzero()
            triangles = np.concatenate([crossings.triangles[:, :2], stacks.triangles], 1)
            points = np.concatenate([crossings.points, stacks.points], 1)
            part, triangle, number = (x.reshape(-1).take(place) for x in (parts, triangles, stacks.numbers))
            return cls(place, part, triangle, points.reshape(-1, 2)[place], number, parts.shape[1])
        most = 4 * len(crossings.gap)
        place, part, triangle = np.empty((3, most), np.int32)
        points = np.empty((most, 2))
        count = samples_loops.needed(crossings, required, place, part, triangle, points)
        return cls(place[:count], part[:count], triangle[:count], points[:count], np.zeros(count, np.int32), 6)

    def table(self, crossings: int, values: np.ndarray) -> np.ndarray:
        """A table (B, columns) int32 with a value (M,) for each sample; else −1."""
        table = np.full((crossings, self.columns), -1, np.int32)
        table.reshape(-1)[self.place] = values
        return table


def crossings_of_meshes(
    layers: Hits, opaque: np.ndarray, meshes: Sequence[SeenMesh], width: np.ndarray, seams: bool
) -> tuple[Crossings, Stacks | None]:
    """The crossings between what is seen at centres (K, H, W); of several layers, nothing behind an opaque one."""
    layers = Hits(*map(read_only, layers))
    if len(layers.part) == 1:
        return crossings_of_triangles(Hits(*(x[0] for x in layers)), meshes, width, seams), None
    from rts.outlines.stacks import crossings_of_stacks

    return crossings_of_stacks(layers, opaque, meshes, width, seams)


def limited(
    find: Callable[[bool], tuple[Crossings, Stacks | None]], most: int | None, seams: bool
) -> tuple[Crossings, Stacks | None, int]:
    """The crossings that `find` gives, and their stacks, at most so many; and the number of those left out.

    `find` takes whether there are crossings at seams, which are left out before outlines are; `seams` is what is
    wanted.

    Warns:
        InputWarning: some are left out.
    """
    crossings, stacks = _contiguous(*find(seams))
    count = len(crossings.gap)
    if most is None or count <= most:
        return crossings, stacks, 0
    if seams:
        crossings, stacks = _contiguous(*find(False))
    left_out = count - min(most, len(crossings.gap))
    warn(
        f"{left_out} edge crossings find no room beside {most}, and edges there neither move nor are smooth; "
        f"give the compiled program capacity={4 * count} or more",
        InputWarning,
    )
    crossings = Crossings(*(x if name == "joined" else x[:most] for name, x in crossings._asdict().items()))
    return crossings, stacks if stacks is None else Stacks(*(x[:most] for x in stacks)), left_out


def _contiguous(crossings: Crossings, stacks: Stacks | None) -> tuple[Crossings, Stacks | None]:
    """Crossings in contiguous arrays, however they were found: loops are compiled for each layout of a record."""
    return Crossings(*map(np.ascontiguousarray, crossings)), stacks
