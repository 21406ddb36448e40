"""Scenes of opaque and translucent parts give one image and one gradient, in whatever way they are rendered.

`mixed_ways.py` tries as many scenes as one likes.
"""

import numpy as np
import pytest
from mixed_scenes import AWKWARD, mixed_of
from mixed_ways import PAIRS, SINGLES, differences, name_of

pytestmark = pytest.mark.rendering

pytest.importorskip("torch")
pytest.importorskip("numba")

FIRST, SHARED = 10, (10, 2, 3, 4, 6)
"""The scene of `make test`, of jax and of pairs of ways; and those of all other ways."""

ONCE = [
    (4, "enough"),
    (6, "specified"),
    (8, "specified"),
    (17, "views"),
    (17, "specified"),
    (31, "enough"),
    (41, "views"),
    (125, "forward"),
    (125, "jit"),
    (125, "jax"),
    (19, "bands"),
    (54, "bands"),
    (19, "shuffled"),
    (36, "shuffled"),
    (10006, "shuffled"),
    (10030, "shuffled"),
]
"""Numbers of scenes and names of ways that differed once, most by the default splatter before found edges."""

TURNS = ("bands", "shuffled", "found", "views", "embree", "reference")
"""Ways that awkward scenes take turns in: of cameras among the parts, alpha of exactly 1, parts that share an edge."""
OFTEN, QUICK = 20, 6
"""The number of awkward scenes, and how many of them are in `make test`."""


def cases():
    """Scenes and single ways; then each pair of ways, on one scene; and awkward scenes."""
    singles = [(n, way) for way in SINGLES for n in SHARED if n == FIRST or not way & {"jax", "jit"}]
    singles += [(n, frozenset([name])) for n, name in ONCE if n not in SHARED]
    for number, way in singles + [(FIRST, way) for way in PAIRS]:
        quick = number == FIRST and len(way) == 1 and not way & {"jax", "jit"}
        marks = [] if quick else [pytest.mark.thorough]
        yield pytest.param(number, way, marks=marks, id=f"{number}-{name_of(way)}")
    for i in range(OFTEN):
        number, name = AWKWARD + i, TURNS[i % len(TURNS)]
        marks = [] if i < QUICK else [pytest.mark.thorough]
        yield pytest.param(number, frozenset([name]), marks=marks, id=f"{number}-{name}")


@pytest.mark.parametrize(("number", "way"), list(cases()))
def test_every_way_of_rendering_gives_one_image_and_one_gradient(number, way):
    assert differences(number, way) == []


def test_mixed_scenes_are_of_all_kinds_and_the_same_every_time():
    scenes = [mixed_of(number) for number in range(80)]
    assert sum(scene.translucent for scene in scenes) == 60
    assert all(any(part.shader.opaque for part in scene.parts) for scene in scenes)
    assert {size for scene in scenes for size in scene.size} <= set(range(5, 41))
    assert {scene.layers for scene in scenes} == {1, 2, 3, 4, 6, "auto"}
    assert {scene.supersample for scene in scenes} == {1, 2, 3}
    for scene, again in zip(scenes, map(mixed_of, range(80)), strict=True):
        assert scene[2:] == again[2:]
        for part, other in zip(scene.parts, again.parts, strict=True):
            np.testing.assert_array_equal(part.theta["vertices"], other.theta["vertices"])
            np.testing.assert_array_equal(part.theta["colors"], other.theta["colors"])


def test_awkward_scenes_have_cameras_among_the_parts_alpha_of_exactly_1_and_neighbours():
    scenes = [mixed_of(AWKWARD + number) for number in range(OFTEN)]
    eyes = [np.linalg.inv(camera.view)[:3, 3] for scene in scenes for camera in scene.cameras]
    assert 10 < sum(np.linalg.norm(eye) < 1.5 for eye in eyes) < 30
    alphas = [part.theta["colors"][:, 3] for scene in scenes for part in scene.parts if not part.shader.opaque]
    assert 10 < sum((alpha == 1).any() for alpha in alphas) < len(alphas) - 10
    assert 5 < sum(len(scene.parts[-1].surface.faces) == 1 for scene in scenes) < 15
