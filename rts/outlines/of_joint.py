"""Parts of triangles that are drawn at once: their samples and the stencil, in one table from the first.

A part's rows are those at centres, then those beside breaks, so that nothing is numbered anew.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rts.compiling.threads import parallel, read_only
from rts.contracts.records import Cells, Fragments, Sampled
from rts.outlines.found import Outlines, Told
from rts.outlines.gaps import Breaks, Fronts
from rts.outlines.sheets import Sheets
from rts.outlines.spans import breaks_of_triangles
from rts.sampling.camera_checks import on_host
from rts.sampling.joint import Joint
from rts.sampling.points import pixel_widths
from rts.sampling.sample_checks import check_fragments
from rts.sampling.scene import Grid


def sampled_fronts(joint: Joint, grid: Grid, told: Told, uniform: bool, real: Any) -> Sampled:
    """The samples in front, at centres and beside breaks, of parts that are drawn at once, with their stencil.

    Args:
        joint: all parts of a scene.
        grid: the cells.
        told: what samples beside breaks have to tell.
        uniform: whether one sample stands for all cells of a part.
        real: the dtype of weights.
    """
    from rts.outlines import samples_loops
    from rts.sampling import packing_loops

    size, proxy = grid.size, joint.proxy
    fragments = joint.sampler.rasterize(joint.prepared, joint.camera, size, 1, joint.cull)
    covered = check_fragments(fragments, (1, *size), len(proxy.faces), joint.sampler)
    triangle, depth = (read_only(x[0]) for x in (fragments.triangle_ids, fragments.depth))
    owners, part, deep = packing_loops.owners_of(joint.starts), np.empty(size, np.int32), np.empty(size)
    parallel(samples_loops.fronts, size[0], triangle, depth, owners, part, deep, work=2 * part.size)
    sheets = Sheets.of(proxy, joint.camera, size, joint.cull, joint.first, joint.proxies, told.colors)
    width = pixel_widths(on_host(grid.camera).for_size(size), size)
    breaks = breaks_of_triangles(Fronts(part, triangle, deep), (sheets,), width, told.colors)
    place, beside = _beside(breaks, sheets, told)
    known = proxy.ids, proxy.corner_params
    if uniform:  # One fragment of each part, at the first of its cells.
        _, first = packing_loops.parts_of(triangle, covered[0], joint.starts)
        seen = first[first >= 0]
        cells = Fragments(*(x.reshape(-1, *x.shape[3:])[seen] for x in fragments))
        counts, ids, params, found, _, rows = packing_loops.pack(
            cells, np.ones(len(seen), np.bool_), *known, starts=joint.starts, beside=beside
        )
        row_of = np.full(len(first) + 1, -1, np.int32)
        row_of[:-1][first >= 0] = found
        row, depth = row_of.take(part)[None], deep.astype(np.float32)[None]
    else:
        counts, ids, params, row, depth, rows = packing_loops.pack(
            fragments, covered, *known, starts=joint.starts, beside=beside
        )
    of_breaks = np.full((len(breaks.gap), 6), -1, np.int32)
    of_breaks.reshape(-1)[place] = rows
    stencil = Outlines.of(breaks, of_breaks).stencil(row, told, real)
    sampled = joint.of_parts(counts, ids, params, Cells(row, depth, fragments.triangle_ids))
    return replace(sampled, stencil=stencil)


def _beside(breaks: Breaks, sheets: Sheets, told: Told) -> tuple[np.ndarray, Fragments]:
    """The fragments (1, 1, M) beside breaks, and their places (M,) in `Outlines.rows`."""
    from rts.outlines import samples_loops

    most = 4 * len(breaks.gap)
    place, triangles, points = np.empty(most, np.int32), np.empty(most, np.int32), np.empty((most, 2))
    of_breaks = breaks.parts, breaks.ends, breaks.points, breaks.inner, breaks.triangles
    count = samples_loops.needed(*of_breaks, *told, place, triangles, points)
    return place[:count], sheets.at(triangles[:count], points[:count])
