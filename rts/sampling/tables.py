"""Rows of samples: some of them, and those of several tables in one."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

from rts.arrays.engines import namespace
from rts.arrays.trees import Array
from rts.contracts.records import Samples


def in_one_table(samples: Sequence[Samples]) -> Samples:
    """Several samples of one part as one, with the cells of the first alone; `ids` become rows of a shared table."""
    if len(samples) == 1:
        return samples[0]
    first, xp = samples[0], namespace(samples[0].ids)
    shared = [name for name in first.tables if name not in first.by_sample]
    tables = {name: xp.concat([s.tables[name] for s in samples]) for name in first.tables}
    gbuffer = None
    if first.gbuffer is not None:
        gbuffer = {name: xp.concat([(s.gbuffer or {})[name] for s in samples]) for name in first.gbuffer}
    ids, start = [first.ids], 0
    for before, current in itertools.pairwise(samples):
        start += before.tables[shared[0]].shape[0] if shared else 0
        ids.append(current.ids + start)
    ids, params = xp.concat(ids), xp.concat([s.params for s in samples])
    return replace(first, ids=ids, params=params, tables=tables, gbuffer=gbuffer)


def taken_rows(samples: Samples, index: Array) -> Samples:
    """The rows of samples with some indices (N,)."""
    xp = namespace(samples.ids)

    def taken(named: Mapping[str, Array]) -> dict[str, Array]:
        return {name: xp.take(x, index, axis=0) for name, x in named.items()}

    per_sample = taken({"ids": samples.ids, "params": samples.params})
    gbuffer = None if samples.gbuffer is None else taken(samples.gbuffer)
    tables = {**samples.tables, **taken({name: samples.tables[name] for name in samples.by_sample})}
    return replace(samples, **per_sample, tables=tables, gbuffer=gbuffer)
