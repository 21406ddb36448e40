"""The outlines that stencils are made from, which nothing hands on."""

import contextlib

import pytest

import rts
from rts.outlines.found import Outlines


@contextlib.contextmanager
def noted():
    """A list of pairs, filled meanwhile: outlines with `rows` counted over all parts, and the samples (K, H, W)."""
    found, whole = [], Outlines.stencil

    def stencil(self, row, told, real):
        found.append((self, row))
        return whole(self, row, told, real)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Outlines, "stencil", stencil)
        yield found


def sampled_with_outlines(*args, **options):
    """What `rts.sample` gives, and the outlines that its stencil was made from."""
    with noted() as found:
        sampled = rts.sample(*args, **options)
    return sampled, found[-1][0]
