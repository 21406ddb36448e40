"""A part of each of several views, evaluated at the samples of all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rts.arrays.engine_base import Engine
from rts.arrays.engines import Context
from rts.arrays.trees import Array, leaves
from rts.contracts.checked_parts import CheckedPart
from rts.contracts.gbuffer import FOOTPRINT, GBuffer
from rts.contracts.records import Samples
from rts.contracts.shader import Shader
from rts.rendering.shade import add_footprint, evaluate, split_by_view
from rts.rendering.splats import concatenated
from rts.shading.tangents import OWN_UV, TANGENT


class Evaluated(NamedTuple):
    """A part of each view, evaluated.

    Attributes:
        part: a part whose shader may colour the samples of all views in one call, as far as θ is concerned; None if
            the shader or what it reads of θ differs from view to view.
        transforms: the transform of each view's part, in arrays of the engine; None for none.
        gbuffer: the G-buffer of all samples, in local spaces.
        pieces: the samples and the G-buffer of each view; None if they are cut from `gbuffer`.
    """

    part: CheckedPart | None
    transforms: list[Array | None]
    gbuffer: GBuffer
    pieces: list[tuple[Samples, GBuffer]] | None

    @classmethod
    def of(
        cls, parts: Sequence[CheckedPart | None], samples: Samples, counts: np.ndarray | None, inputs: Context
    ) -> Evaluated:
        """Evaluate the part of each view, at the `counts` (B,) of its samples; None for unknown ones of one part."""
        first = next(part for part in parts if part is not None)
        if all(part is first for part in parts):
            transforms = [inputs.constants(first.transform)] * len(parts)
            return cls(first, transforms, evaluate(first, samples, inputs), None)
        assert counts is not None
        transforms = [None if part is None else inputs.constants(part.transform) for part in parts]
        sizes = counts.tolist()
        rows = [inputs.engine.split(x, sizes) for x in (samples.ids, samples.params)]
        pieces = []
        if samples.gbuffer is not None:  # Of constant surfaces.
            whole = GBuffer(samples.gbuffer)
            mapped = "uv" in whole or OWN_UV in whole
            if not (mapped and any(part is not None and _reads_tangents(part) for part in parts)):
                return cls(_of_all(parts, [whole]), transforms, whole, None)
            samples = replace(samples, gbuffer=None)  # Tangents are made by the surface of each view.
        for part, ids, params in zip(parts, *rows, strict=True):
            of_view = replace(samples, ids=ids, params=params)
            if part is None or not ids.shape[0]:
                pieces.append((of_view, GBuffer(position=params[:, :1])))
            else:
                pieces.append((of_view, evaluate(part, of_view, inputs)))
        shown = [local for (samples, local) in pieces if samples.ids.shape[0]]
        (position,) = concatenated([local["position"] for local in shown])
        whole = GBuffer(position=position)
        for name in set.intersection(*(set(local) for local in shown)) - {"position"}:
            whole.defer(name, lambda name=name: concatenated([local[name] for local in shown])[0])
        return cls(_of_all(parts, shown), transforms, whole, pieces)

    @property
    def one(self) -> bool:
        """True if all views have the same transform, or none."""
        return all(transform is self.transforms[0] for transform in self.transforms)

    def add_footprints(
        self, parts: Sequence[CheckedPart | None], samples: Samples, rows: Array, view: Array, inputs: Context
    ) -> None:
        """Add deferred footprints of uv to `gbuffer`; arguments are as in `of`, and `rts.shading.uv_footprints`."""
        if self.pieces is None:
            assert self.part is not None
            add_footprint(self.part, samples, self.gbuffer, rows, inputs, view)
            return
        of_views = []
        for b, (part, (of_view, local)) in enumerate(zip(parts, self.pieces, strict=True)):
            if part is not None and of_view.ids.shape[0]:
                add_footprint(part, of_view, local, rows[b, ...], inputs)
                of_views.append(local)
        if all(FOOTPRINT in local for local in of_views) and FOOTPRINT not in self.gbuffer:
            self.gbuffer.defer(FOOTPRINT, lambda: concatenated([local[FOOTPRINT] for local in of_views])[0])

    def split(self, samples: Samples, counts: np.ndarray, engine: Engine) -> list[tuple[Samples, GBuffer]]:
        """The samples and the G-buffer of each view."""
        return self.pieces or split_by_view(samples, self.gbuffer, counts.tolist(), engine)


def _reads_tangents(part: CheckedPart) -> bool:
    """True if the part's shader may read tangents."""
    return part.reads is None or TANGENT in part.reads


def _differ(a: Shader, b: Shader) -> bool:
    """True unless two shaders are known to be equal; records that hold arrays do not say whether they are."""
    try:
        return a is not b and not bool(a == b)
    except ValueError:
        return True


def _of_all(parts: Sequence[CheckedPart | None], gbuffers: Sequence[GBuffer]) -> CheckedPart | None:
    """A part whose shader sees the same θ, and the same attributes, in all views; None if there is none."""
    known = [part for part in parts if part is not None]
    first, reads = known[0], known[0].reads
    if reads is None or any(_differ(part.shader, first.shader) for part in known):
        return None
    if any(set(gbuffer) != set(gbuffers[0]) for gbuffer in gbuffers):
        return None
    for name in reads:
        entries = [(name in part.read, *map(id, leaves(part.theta.get(name)))) for part in known]
        if any(of_surface for of_surface, *_ in entries) or len(set(entries)) > 1:
            return None
        if len({name in part.theta for part in known}) > 1:
            return None
    return first
