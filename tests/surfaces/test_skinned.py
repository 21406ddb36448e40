"""The surface `skinned`: joints that bend, morph targets that change, and their derivatives."""

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, FRONT, SIZE, arrays, derivative, relative_error, rotation, to_numpy

import rts
from rts import InputError

pytestmark = pytest.mark.rendering

BAR = np.array([(-1, -2, 0), (1, -2, 0), (1, 0, 0), (-1, 0, 0), (1, 2, 0), (-1, 2, 0)], np.float32)
"""Two squares, one above the other; the upper one's joint is at the origin."""
FACES = np.array([(0, 1, 2), (0, 2, 3), (3, 2, 4), (3, 4, 5)])
UPPER = np.array([0, 0, 0.5, 0.5, 1, 1], np.float32)


def bar(degrees=90.0, upper=UPPER, **more):
    turned = np.eye(4)
    turned[:3, :3] = rotation((0, 0, 1), degrees)[:3, :3]
    theta = {
        "vertices": BAR,
        "joint_transforms": np.stack([np.eye(4), turned]).astype(np.float32),
        "joint_weights": np.stack([1 - upper, upper], axis=1).astype(np.float32),
        **more,
    }
    return rts.Part(rts.Skinned(FACES, np.tile([0, 1], (6, 1))), theta, "silhouette")


@pytest.mark.parametrize("target", ALL)
def test_a_bar_of_two_joints_is_bent_by_a_right_angle(target):
    part = bar()
    posed = to_numpy(part.surface.posed(arrays(target, part.theta)))
    # Vertices of both joints go half as far, as matrices are averaged.
    expected = [(-1, -2, 0), (1, -2, 0), (0.5, 0.5, 0), (-0.5, -0.5, 0), (-2, 1, 0), (-2, -1, 0)]
    np.testing.assert_allclose(posed, expected, atol=1e-6)


def test_joints_turn_about_where_they_are():
    about, turned = np.array([0.3, -1.0, 0.5]), rotation((1, 2, 3), 40)[:3, :3]
    part = bar(upper=np.ones(6))
    transforms = part.theta["joint_transforms"].astype(np.float64)
    transforms[1, :3, :3], transforms[1, :3, 3] = turned, about - turned @ about
    posed = part.surface.posed({**part.theta, "joint_transforms": transforms})
    np.testing.assert_allclose(posed, (BAR - about) @ turned.T + about, atol=1e-6)


@pytest.mark.parametrize("target", ALL)
def test_morph_targets_are_added_by_their_weights_before_joints_bend(target):
    moves = np.random.default_rng(0).standard_normal((3, 6, 3)).astype(np.float32)
    weights = np.array([0.5, -1.0, 2.0], np.float32)
    part = bar(upper=np.ones(6), morph_vertices=moves, morph_weights=weights)
    posed = to_numpy(part.surface.posed(arrays(target, part.theta)))
    at_rest = BAR + np.tensordot(weights, moves, 1)
    np.testing.assert_allclose(posed, at_rest @ rotation((0, 0, 1), 90)[:3, :3].T, atol=1e-5)


def test_without_joints_only_morph_targets_are_needed():
    theta = {"vertices": BAR, "morph_vertices": BAR[None], "morph_weights": np.ones(1, np.float32)}
    np.testing.assert_array_equal(rts.Skinned(FACES).posed(theta), 2 * BAR)
    assert set(rts.Skinned(FACES).reads(theta)) == set(theta)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
@pytest.mark.parametrize("name", ["joint_transforms", "joint_weights", "morph_weights", "morph_vertices", "vertices"])
def test_derivatives_are_finite_differences(target, name):
    rng = np.random.default_rng(1)
    more = {"morph_vertices": rng.standard_normal((2, 6, 3)), "morph_weights": rng.standard_normal(2)}
    part = bar(30.0, **more)
    theta = {key: np.asarray(x, np.float64) for key, x in part.theta.items()}
    along = rng.standard_normal(theta[name].shape)
    above, below = (part.surface.posed({**theta, name: theta[name] + step * along}) for step in (1e-5, -1e-5))
    held = arrays(target, theta, np.float64)
    _, pushed = derivative(
        target,
        lambda x: part.surface.posed({**held, name: x}),
        *(arrays(target, x, np.float64) for x in (theta[name], along)),
    )
    assert relative_error(to_numpy(pushed), (above - below) / 2e-5) < 1e-6


def test_an_image_of_a_bent_bar_is_that_of_the_mesh_of_its_posed_vertices():
    part = bar(50.0)
    mesh = rts.Part(rts.Mesh(FACES), {"vertices": part.surface.posed(part.theta)}, "silhouette")
    for sampler in ("raster", "reference"):
        images = [rts.render(x, FRONT, SIZE, sampler=sampler) for x in (part, mesh)]
        assert images[0][..., 3].sum() > 20
        np.testing.assert_array_equal(*images)


@pytest.mark.parametrize("mirror", [1, -1])
def test_normals_are_turned_by_the_inverse_transpose_of_joints(mirror):
    maps = np.eye(4)
    maps[:3, :3] = rotation((1, 1, 0), 35)[:3, :3] @ np.diag([2.0, 0.5, mirror])
    normals = np.tile([0.6, 0.0, 0.8], (6, 1))
    theta = {**bar(upper=np.ones(6)).theta, "normals": normals, "joint_transforms": np.stack([np.eye(4), maps])}
    part = rts.Part(bar().surface, theta, "normals")
    samples = rts.sample(part, FRONT, SIZE).samples[0]
    expected = normals[0] @ np.linalg.inv(maps[:3, :3])
    found = part.surface.evaluate(part.theta, samples)["normal"]
    np.testing.assert_allclose(found, np.tile(expected / np.linalg.norm(expected), (len(found), 1)), atol=1e-6)
    assert len(found) > 20


def test_a_normal_of_several_vertices_is_turned_for_each_of_them():
    # One normal for all corners; only the upper vertices turn, about x.
    maps = np.stack([np.eye(4), np.eye(4)])
    maps[1, :3, :3] = rotation((1, 0, 0), 60)[:3, :3]
    theta = {**bar(upper=np.float32([0, 0, 0, 0, 1, 1])).theta, "normals": np.array([[0, 0, 1.0]])}
    theta["joint_transforms"] = maps
    surface = rts.Skinned(FACES, np.tile([0, 1], (6, 1)), {"normals": np.zeros((4, 3), int)})
    surface.check(theta)
    samples = rts.sample(rts.Part(surface, theta, "normals"), FRONT, SIZE).samples[0]
    found = surface.evaluate(theta, samples)["normal"]
    # Between them, normals are interpolated as those of any mesh.
    upper = samples.ids[:, :3] >= 4
    first = np.stack([samples.params[:, 0], samples.params[:, 1], 1 - samples.params.sum(1)], axis=1)
    share = (first * upper).sum(1)
    expected = (1 - share)[:, None] * [0, 0, 1] + share[:, None] * (maps[1, :3, :3] @ [0, 0, 1])
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert (share > 0.1).any() and (share == 0).any()


@pytest.mark.parametrize(
    ("theta", "message"),
    [
        ({"joint_transforms": None}, "no 'joint_transforms'"),
        ({"joint_transforms": np.eye(4, dtype=np.float32)[None]}, "has 1 rows, but a vertex has joint 1"),
        ({"joint_transforms": np.zeros((2, 3, 4), np.float32)}, r"expected \(J, 4, 4\)"),
        ({"joint_weights": np.ones((5, 2), np.float32)}, r"expected \(6, 2\)"),
        ({"morph_weights": np.ones(2, np.float32)}, "no 'morph_vertices'"),
        (
            {"morph_weights": np.ones(2, np.float32), "morph_vertices": np.ones((1, 6, 3), np.float32)},
            r"expected \(2, 6, 3\)",
        ),
        ({"vertices": np.ones((7, 3), np.float32)}, "7 rows, and its joints 6"),
    ],
)
def test_wrong_entries_are_refused(theta, message):
    part = bar()
    changed = {name: x for name, x in {**part.theta, **theta}.items() if x is not None}
    with pytest.raises(InputError, match=message):
        rts.render(part.replace(theta=changed), FRONT, SIZE)


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        ([0, 1], r"expected \(V, I\)"),
        ([[0, 1]] * 5, "a row for each vertex"),
        ([[0.5, 1]] * 6, "expected integers"),
        ([[0, -1]] * 6, "count from 0"),
    ],
)
def test_wrong_joints_are_refused(joints, message):
    with pytest.raises(InputError, match=message):
        rts.Skinned(FACES, joints)
