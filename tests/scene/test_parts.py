"""Parts as they are shown."""

import numpy as np
import pytest

import rts

pytestmark = pytest.mark.rendering


def test_a_part_shows_its_arrays_by_dtype_and_shape():
    theta = {"vertices": np.zeros((3, 3), np.float32), "light": {"ambient": 0.2, "color": [np.ones((2, 3)), None]}}
    part = rts.Part(rts.Mesh([[0, 1, 2]]), theta, "lambert", transform=np.eye(4), cull="back")
    assert repr(part) == (
        "Part(Mesh(1 faces), {'vertices': float32 (3, 3), 'light': {'ambient': 0.2, 'color': [float64 (2, 3), None]}}, "
        "'lambert', transform=float64 (4, 4), cull='back')"
    )
    assert repr(part.replace(theta={}, transform=None, cull="none")) == "Part(Mesh(1 faces), {}, 'lambert')"
