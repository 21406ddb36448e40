"""Views that are drawn at once: their samples, all found in one pass over a picture, in the order of views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rts.contracts.checks import check_memory
from rts.contracts.records import Cells, Sampled, Samples
from rts.outlines.of_joint import AtOnce
from rts.rendering.settings import RenderSettings
from rts.sampling.host_scenes import in_engine, real_of, with_attributes
from rts.sampling.picture import Picture
from rts.sampling.side_by_side import DrawnView, joined
from rts.sampling.tables import in_one_table
from rts.views.sampled_views import Views, with_counts


def sampled_at_once(views: Sequence[DrawnView], picture: Picture, settings: RenderSettings) -> Views:
    """The samples of views of one kind, and their outlines if the splatter reads these."""
    scene, grid, joint = joined(views, picture)
    gradient = scene.context.engine.differentiates
    check_memory(*picture.view, settings.most_layers, settings.capacity, gradient=gradient)
    outlines, layers = settings.finds_outlines, settings.most_layers
    required = settings.required([view.scene for view in views])
    same = not required.colors and outlines and layers == 1 and not settings.fronts
    at_once = AtOnce(joint, grid, scene.opaque if outlines else [False] * len(scene.parts))
    sampled = at_once.found(at_once.centres(layers), required if outlines else None, real_of(scene), same)
    sampled, counts = _by_place(with_attributes(sampled, scene), [len(view.proxies) for view in views])
    sampled = replace(in_engine(sampled, scene), supersample=settings.supersample, border=settings.border)
    return with_counts(sampled, picture, counts)


def _by_place(sampled: Sampled, numbers: Sequence[int]) -> tuple[Sampled, tuple[np.ndarray, ...]]:
    """Samples of parts, view after view, as tables: of the first parts of all views, of the second, and so on.

    Args:
        sampled: the samples on the host, with a table for each part of each view.
        numbers: the number of parts of each of B views.

    Returns:
        The samples, and for each table the numbers (B,) of rows of each view.
    """
    places = np.concatenate([np.arange(n) for n in numbers])
    sizes = np.array([table.ids.shape[0] for table in sampled.samples])
    counts = np.zeros((max(numbers), len(numbers)), np.int64)
    counts[places, np.repeat(np.arange(len(numbers)), numbers)] = sizes
    tables = [
        [table for table, at in zip(sampled.samples, places, strict=True) if at == n] for n in range(max(numbers))
    ]
    samples = tuple(map(_in_one_table, tables))
    cells, stencil = replace(sampled.cells, triangle=None), sampled.stencil
    if max(numbers) > 1:
        order = np.argsort(places, kind="stable")
        starts = np.empty(len(sizes), np.int64)
        starts[order] = np.cumsum(sizes[order]) - sizes[order]
        moved = np.arange(sizes.sum()) + np.repeat(starts - (np.cumsum(sizes) - sizes), sizes)
        table = np.append(moved, -1).astype(np.int32)  # The index −1 reads the last one, −1.
        cells = replace(cells, row=table[cells.row])
        stencil = None if stencil is None else stencil.with_samples(table.__getitem__)
    return replace(sampled, samples=samples, cells=cells, stencil=stencil), tuple(counts)


def _in_one_table(samples: Sequence[Samples]) -> Samples:
    """The samples of several parts as one table, with attributes if all of them have the same."""
    names = {None if table.gbuffer is None else (*table.gbuffer, table.gbuffer_names) for table in samples}
    if len(names) > 1:
        samples = [replace(table, gbuffer=None) for table in samples]
    whole = in_one_table(samples)
    return replace(whole, cells=Cells(np.arange(whole.ids.shape[0], dtype=np.int32)[None, None]))
