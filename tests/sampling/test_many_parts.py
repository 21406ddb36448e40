"""Many parts: those that are drawn at once give the image and the gradient of one part at a time."""

from unittest import mock

import numpy as np
import pytest
from helpers import CAMERA, TORCH, arrays, box, gradient, icosphere, relative_error, rigid, soup, to_numpy

import rts
from rts.sampling import joint

pytestmark = pytest.mark.rendering

torch = pytest.importorskip("torch")
pytest.importorskip("numba")

from rts.sampling import merging_loops  # noqa: E402

SIZE = 40, 48


@pytest.fixture
def singly(monkeypatch):
    """A function that renders with each part by itself."""

    def render(function, *given):
        with monkeypatch.context() as patch:
            patch.setattr(joint, "MOST", 0)
            return function(*given)

    return render


class Glass(rts.Shader):
    """One colour and alpha for all samples."""

    opaque = False

    def __call__(self, theta, gbuffer, camera):
        """Give each row the entry "tint"."""
        return theta["tint"] + 0 * gbuffer["position"][:, :1]


def crowd(count, moved=True, seed=0, shader="lambert", kinds=3, **options):
    """Spheres, boxes and soups that overlap; the `transforms` (P, 4, 4), and a function of these that gives parts."""
    random, pieces, matrices = np.random.default_rng(seed), [], []
    for index in range(count):
        vertices, faces = (icosphere(1, 0.5), box(0.4), soup(12, seed + index, 0.5))[index % kinds]
        matrix = rigid(random.normal(size=3), random.uniform(0, 180), random.uniform(-0.8, 0.8, 3)).astype(np.float32)
        vertices = vertices if moved else vertices + matrix[:3, 3]
        theta = {"vertices": vertices.astype(np.float32), "tint": random.uniform(0.1, 0.5, 4).astype(np.float32)}
        theta = theta if shader != "lambert" else {"vertices": theta["vertices"]}
        pieces.append((rts.Mesh(faces), theta))
        matrices.append(matrix)

    def parts(transforms):
        return [
            rts.Part(surface, theta, shader, transform=transforms[i] if moved else None, **options)
            for i, (surface, theta) in enumerate(pieces)
        ]

    return np.stack(matrices), parts


def image_of(parts, **options):
    return to_numpy(rts.render(parts, CAMERA, SIZE, engine="torch", **options))


def kinds_of(parts, **options):
    """For each part, whether a pass of the sampler draws it along with others."""
    together, drawn = set(), joint.Joint.drawn

    def noted(self, size, layers):
        for draw in self.draws:
            triangles = np.arange(self.starts[-1]) if draw.triangles is None else draw.triangles
            several = set(np.searchsorted(self.starts, triangles, side="right") - 1)
            together.update(several if len(several) > 1 else ())
        return drawn(self, size, layers)

    with mock.patch.object(joint.Joint, "drawn", noted):
        rts.sample(parts, CAMERA, SIZE, engine="torch", **options)
    return [index in together for index in range(len(parts))]


def test_parts_without_transforms_are_bit_for_bit_as_one_at_a_time(singly):
    _, parts = crowd(7, moved=False)
    assert all(kinds_of(parts(None))) and not any(singly(kinds_of, parts(None)))
    np.testing.assert_array_equal(image_of(parts(None)), singly(image_of, parts(None)))


@pytest.mark.parametrize("options", [{}, {"cull": "back"}, {"shader": Glass()}])
def test_moved_parts_give_the_image_and_the_gradient_of_one_at_a_time(singly, options):
    # With a seventh part three breaks lie in one place, and rounding tells which of them are joined.
    transforms, parts = crowd(6, **options)
    weights = np.random.default_rng(1).normal(size=(*SIZE, 4))

    def loss(x):
        image = rts.render(parts(x), CAMERA, SIZE)
        return (image * torch.as_tensor(weights)).sum()

    np.testing.assert_allclose(image_of(parts(transforms)), singly(image_of, parts(transforms)), rtol=0, atol=1e-5)
    transforms = arrays(TORCH[0], transforms, np.float64)
    joined, alone = gradient(TORCH[0], loss, transforms), singly(gradient, TORCH[0], loss, transforms)
    assert relative_error(joined, alone) < 1e-5


def test_the_gradient_is_that_of_a_merged_mesh():
    transforms, parts = crowd(9, shader="silhouette", kinds=2)
    # Outlines of a part go on along it alone, and no two parts hide one another here.
    transforms[:, :3, :3] *= 0.4
    transforms[:, :3, 3] = [(i % 3 - 1, i // 3 - 1, 0.1 * i) for i in range(9)]
    own = parts(transforms)
    shifts = np.cumsum([0, *(len(part.theta["vertices"]) for part in own)])
    merged = rts.Mesh(np.concatenate([p.surface.faces + s for p, s in zip(own, shifts, strict=False)]))
    weights = torch.as_tensor(np.random.default_rng(2).normal(size=(*SIZE, 4)))

    def of_parts(x):
        return (rts.render(parts(x), CAMERA, SIZE) * weights).sum()

    def of_one(x):
        pieces = [torch.as_tensor(p.theta["vertices"], dtype=x.dtype) @ m[:3, :3].T + m[:3, 3] for p, m in zip(own, x)]  # noqa: B905
        part = rts.Part(merged, {"vertices": torch.cat(pieces)}, "silhouette")
        return (rts.render(part, CAMERA, SIZE) * weights).sum()

    transforms = arrays(TORCH[0], transforms, np.float64)
    found, expected = (gradient(TORCH[0], f, transforms) for f in (of_parts, of_one))
    assert relative_error(found[:, :3], expected[:, :3]) < 1e-3


def test_mirrored_and_large_parts_and_those_of_other_samplers_are_drawn_alone(singly, monkeypatch):
    transforms, parts = crowd(6, cull="back")
    transforms[2, :3, :3] *= [-1, 1, 1]
    own = parts(transforms)
    assert kinds_of(own) == [True, True, False, True, True, True]
    np.testing.assert_allclose(image_of(own), singly(image_of, own), rtol=0, atol=1e-5)
    monkeypatch.setattr(joint, "MOST", 30)
    assert kinds_of(own) == [False, True, False, False, True, True]


@pytest.mark.parametrize("mirrors", ["parts", "camera"])
def test_neighbours_that_are_all_mirrored_show_the_sides_that_each_shows_alone(singly, mirrors):
    transforms, parts = crowd(6, cull="back")
    camera = CAMERA
    if mirrors == "parts":
        transforms[2:5, :3, :3] *= [-1, 1, 1]
    else:
        camera = CAMERA.replace(view=np.diag([-1.0, 1, 1, 1]) @ np.asarray(CAMERA.view))
    own = parts(transforms)

    def image():
        return to_numpy(rts.render(own, camera, SIZE, engine="torch"))

    np.testing.assert_allclose(image(), singly(image), rtol=0, atol=1e-5)
    reference = to_numpy(rts.render(own, camera, SIZE, engine="torch", sampler="reference"))
    np.testing.assert_allclose(image(), reference, rtol=0, atol=1e-4)


def test_a_part_that_nothing_is_seen_of_keeps_a_row(singly):
    transforms, parts = crowd(5)
    transforms[1, :3, 3] += 100
    own = parts(transforms)
    samples = rts.sample(own, CAMERA, SIZE, engine="torch").samples
    assert samples[1].ids.shape[0] >= 1 and (samples[1].row == -1).all() and (samples[0].row >= 0).all()
    np.testing.assert_allclose(image_of(own), singly(image_of, own), rtol=0, atol=1e-5)


def test_parts_beside_a_surface_without_triangles_are_drawn_alone():
    transforms, parts = crowd(3)
    ball = rts.plugin("rts.surfaces", "sdf").example().replace(shader="lambert")
    assert not any(kinds_of([*parts(transforms), ball]))


def test_passes_are_merged_by_depth_and_equal_depths_by_triangle():
    rng = np.random.default_rng(3)
    layers, size, passes, start = 3, (7, 9), [], 0
    for _ in range(3):  # Depths of few kinds, so that many are equal.
        depth = np.sort(rng.integers(1, 5, (layers, *size)).astype(np.float32), axis=0)
        ids = np.sort(rng.integers(0, 50, (layers, *size)), axis=0).astype(np.int32) + start
        count, start = rng.integers(0, layers + 1, size), start + 100
        there = np.arange(layers)[:, None, None] < count
        ids, depth = np.where(there, ids, np.int32(-1)), np.where(there, depth, np.float32(0))
        passes.append((ids, np.stack([ids, -ids], -1).astype(np.float32), depth))
    merged = np.full((layers, *size), -1, np.int32), np.zeros((layers, *size, 2), np.float32), np.zeros((layers, *size))
    merged = *merged[:2], merged[2].astype(np.float32)
    for n in (1, 2, 0):
        merging_loops.insert_fragments(0, size[0], *passes[n], *merged)
    for y, x in np.ndindex(size):
        every = [(p[2][k, y, x], p[0][k, y, x]) for p in passes for k in range(layers) if p[0][k, y, x] >= 0]
        nearest = sorted(every)[:layers]
        found = merged[0][:, y, x]
        assert [t for _, t in nearest] == found[: len(nearest)].tolist() and (found[len(nearest) :] == -1).all()
        np.testing.assert_array_equal(merged[2][: len(nearest), y, x], [z for z, _ in nearest])
        np.testing.assert_array_equal(merged[1][: len(nearest), y, x, 0], found[: len(nearest)])


def test_samplers_that_do_not_join_draw_each_part(singly):
    transforms, parts = crowd(4)
    own = parts(transforms)
    assert not any(kinds_of(own, sampler="reference"))
    found, expected = image_of(own), image_of(own, sampler="reference")
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)


def test_a_number_of_rows_to_allot_is_that_of_each_part():
    transforms, parts = crowd(4)
    own = arrays(TORCH[0], parts(transforms))
    assert not any(kinds_of(own, capacity=20_000))


class ByCull(rts.Sampler):
    """Culled parts by "reference", others by "raster": two samplers in one scene."""

    def __init__(self):
        self.raster, self.reference = (rts.plugin("samplers", name)() for name in ("raster", "reference"))

    def sampler_for(self, part, camera):
        """Choose by `cull`."""
        return self.reference if part.cull == "back" else self.raster

    def sample(self, part, camera, size, layers, request):
        """Never called."""
        raise NotImplementedError


def test_two_samplers_of_one_scene_share_no_pass(singly):
    (_, parts), (_, culled) = crowd(4, moved=False, cull="none"), crowd(3, moved=False, seed=9, cull="back")
    own, sampler = [*parts(None), *culled(None)], ByCull()
    assert kinds_of(own, sampler=sampler) == [True] * 4 + [False] * 3
    np.testing.assert_array_equal(image_of(own, sampler=sampler), singly(lambda: image_of(own, sampler=sampler)))
