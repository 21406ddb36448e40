"""How large the numbers of an array are."""

from __future__ import annotations

import numpy as np

from rts.threads import parallel, read_only


def largest(x: np.ndarray) -> float:
    """The largest size of a number in an array of floats; 0 for none, NaN where any is NaN."""
    from rts.sampling import extremes_kernels

    if x.dtype != np.float32:
        return float(max(x.max(initial=0), -x.min(initial=0)))
    bits = read_only(x).reshape(-1).view(np.int32)
    found = np.zeros(max(1, -(-bits.size // extremes_kernels.CHUNK)), np.int32)
    parallel(extremes_kernels.find, len(found), bits, found, work=bits.size // 12)
    return float(found.max().view(np.float32))
