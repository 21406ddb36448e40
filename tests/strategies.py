"""Settings and strategies of the property-based tests."""

from fractions import Fraction

import numpy as np
from helpers import rotation
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rts import Camera
from rts.contracts.records import Cells
from rts.plugin_api.records import Samples

PROPERTIES = settings()
"""Settings of the profile that is in force: `conftest.py` names them."""


def examples(share: float) -> settings:
    """Settings for a share of the profile's examples, at least one."""
    return settings(PROPERTIES, max_examples=max(1, round(share * PROPERTIES.max_examples)))


# --------------------------------------------------------------------------------------------------- arrays


def table(dtype, shape, elements):
    """An array each entry of which is drawn on its own."""
    return hnp.arrays(dtype, shape, elements=elements, fill=st.nothing())


def masks(shape):
    """Booleans, the simplest of which are all true: there is more to see where more is covered."""
    return table(bool, shape, st.booleans()).map(np.logical_not)


def steps(shape, low, high, step=Fraction(1, 4), dtype=np.float32):
    """Multiples of a power of two from `low` to `high`: they are exact, and equal ones are frequent."""
    number = st.integers(int(low / step), int(high / step))
    return table(np.int64, shape, number).map(lambda x: (x * float(step)).astype(dtype))


def grids(layers=4, side=5):
    """Shapes (K, H, W)."""
    return st.tuples(st.integers(1, layers), st.integers(1, side), st.integers(1, side))


# -------------------------------------------------------------------------------------------------- samples


@st.composite
def rows_of(draw, covered, spare=3):
    """`row` (K, H, W) with the packed rows of the covered cells in any order, and N; some rows belong to no cell."""
    count = int(covered.sum())
    total = max(1, count + draw(st.integers(0, spare)))
    row = np.full(covered.shape, -1, np.int32)
    row[covered] = draw(st.permutations(range(total)))[:count]
    return row, total


def told_apart(row, total, depth, **options):
    """Samples of two integers and a real, each row of which can be told from all others."""
    number = np.arange(total)
    ids, params = np.stack([number, -number], axis=1).astype(np.int32), number[:, None].astype(np.float32) / 8
    return Samples(ids, params, Cells(row, np.where(row >= 0, depth, 0).astype(depth.dtype)), np.int32(0), **options)


# --------------------------------------------------------------------------------------------------- space


def reals(low, high):
    """Numbers in a range, in float64."""
    return st.floats(low, high, allow_subnormal=False)


def vectors(low, high, count=3):
    """Arrays of so many numbers."""
    return st.tuples(*[reals(low, high)] * count).map(np.array)


@st.composite
def rotations(draw):
    """(3, 3) rotations, of any axis and angle."""
    axis = draw(vectors(-1, 1).filter(lambda v: np.linalg.norm(v) > 0.1))
    return rotation(axis, draw(reals(-180, 180)))


@st.composite
def affine_maps(draw):
    """(4, 4) invertible affine maps; some mirror."""
    transform = np.eye(4)
    scale = np.diag(draw(vectors(0.2, 4)) * draw(st.sampled_from([-1.0, 1.0])))
    transform[:3, :3] = draw(rotations()) @ scale @ draw(rotations())
    transform[:3, 3] = draw(vectors(-5, 5))
    return transform


def sizes(most=40):
    """(height, width)."""
    return st.tuples(st.integers(1, most), st.integers(1, most))


@st.composite
def views(draw):
    """Eye, target and a direction of up that are those of some camera."""
    linear, target = draw(rotations()), draw(vectors(-5, 5))
    eye = target + draw(reals(0.5, 20)) * linear[2]
    return eye, target, linear[1] + draw(reals(-3, 3)) * linear[2]


@st.composite
def cameras(draw, kinds=("look_at", "orthographic", "skewed")):
    """Cameras of several kinds, with planes at depths from 0.1 to 60."""
    eye, target, up = draw(views())
    near, aspect, point = draw(reals(0.1, 1)), draw(reals(0.3, 3)), draw(vectors(-0.8, 0.8, 2))
    options = {"aspect": aspect, "near": near, "far": near * draw(reals(1.5, 60)), "principal_point": point}
    kind = draw(st.sampled_from(kinds))
    if kind == "look_at":
        return Camera.look_at(eye, target, up, fov_y=draw(reals(5, 130)), **options)
    camera = Camera.orthographic(eye, target, up, height=draw(reals(0.2, 20)), **options)
    if kind == "skewed":
        focal, skew = draw(vectors(10, 90, 2)), draw(reals(-9, 9))
        k = np.array([[focal[0], skew, draw(reals(0, 40))], [0, focal[1], draw(reals(0, 40))], [0, 0, 1]])
        view = camera.view * np.array([1, -1, -1, 1])[:, None]
        camera = Camera.from_opencv(k, view[:3, :3], view[:3, 3], (40, 40), near=near, far=options["far"])
    return camera
