"""What a step of a fit moves between the host and another device: each array by name, and faces once."""

from collections import Counter

import elsewhere
import numpy as np
import pytest
from helpers import icosphere

import rts

torch = pytest.importorskip("torch")

from benchmarks.gpu import crossings  # noqa: E402
from benchmarks.speed.pose_iteration import Task  # noqa: E402

pytestmark = pytest.mark.devices

VERTICES, FACES = icosphere(2)
SIDE = 24


@pytest.fixture(scope="module")
def step():
    """The crossings of a step, in their order."""
    task = Task("ball", np.float32(0.5 * VERTICES), FACES, SIDE, "lambert", 1)
    with elsewhere.Device():
        return crossings.counted(task, elsewhere.DEVICE.type)[0]


def bytes_by_name(found):
    sums = Counter()
    for crossing, name in zip(found, crossings.names(found), strict=True):
        sums[crossing.way, name] += crossing.bytes
    return sums


@pytest.mark.thorough
def test_samples_and_stencils_cross_by_their_sizes(step):
    sums, cells = bytes_by_name(step), (SIDE + 6) ** 2
    assert sums["to the device", "row"] == 4 * cells and not sums["to the host", "row"]
    assert sums["to the device", "joined"] == 2 * cells
    rows = sums["to the device", "ids"] // 12
    colors, motions = (sums["to the device", f"cells of {kind}"] // 4 for kind in ("colours", "motions"))
    assert 0 < rows < cells and 0 < colors < motions
    assert sums["to the device", "barycentrics"] == 8 * rows
    for name in ("colours", "weights of colours"):
        assert sums["to the device", name] == 4 * colors
    for name, bytes_each in {"motions": 4, "weights of motions": 12, "colours of motions": 8}.items():
        assert sums["to the device", name] == bytes_each * motions
    # Vertices are prepared, and images and gradients stay.
    assert not [crossing for crossing in step if crossing.way == "to the host" and crossing.bytes > 64]


@pytest.mark.thorough
def test_every_crossing_has_a_name_and_faces_cross_once(step):
    known = {name for names in crossings.ORDER.values() for name in names} | {crossings.NUMBERS}
    assert set(crossings.names(step)) <= known
    assert not bytes_by_name(step)["to the device", "faces"]
    with elsewhere.Device():
        like, table = torch.zeros(1).to(elsewhere.DEVICE), rts.Mesh(FACES).faces
        engine = rts.engine_of(like)
        with crossings.Counted(elsewhere.DEVICE.type) as counts:
            first, second = (engine.constant(table, like) for _ in range(2))
            changing = [engine.constant(np.array(table), like) for _ in range(2)]
    assert first is second and changing[0] is not changing[1] and len(counts.crossings) == 3
