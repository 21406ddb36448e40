"""`rts.rigid`: closed forms, and compiled code against array code, near and far from where series end."""

import math

import numpy as np
import pytest
from helpers import ALL, DIFFERENTIABLE, arrays, gradient, rotation, to_numpy
from scipy.spatial.transform import Rotation

import rts
from rts.errors import InputError
from rts.scene.rigid import RIGID

pytestmark = pytest.mark.engines

torch = pytest.importorskip("torch")
pytest.importorskip("numba")

POSES = {
    "zero": [0.0] * 6,
    "tiny": [1e-5, -2e-5, 3e-6, 0.1, 0.2, 0.3],
    "below the series' end": [0.05, -0.06, 0.06, 1.0, 2.0, 3.0],
    "above it": [0.06, -0.06, 0.06, 1.0, 2.0, 3.0],
    "half a turn": [0.0, np.pi, 0.0, -1.0, 0.5, 0.2],
    "many turns": [9.0, -4.0, 7.0, 0.0, 0.0, 5.0],
}
CENTER = [0.3, -0.2, 0.7]


def test_several_poses_are_refused_with_what_takes_them():
    with pytest.raises(InputError, match=r"pose has shape \(19, 6\); expected \(6,\), one pose: stack .* torch.vmap"):
        rts.rigid(np.zeros((19, 6)))


def test_rigid_equals_scipy_on_both_sides_of_the_threshold():
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(60, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = [0.0, 1e-9, 1e-4, 0.05, 0.0999999, 0.1, 0.1000001, 0.2, 1.0, 3.0, math.pi, 2 * math.pi, 7.0]
    for axis, angle in zip(axes, [*angles, *rng.uniform(0, 0.3, 47)], strict=True):
        vector = axis * angle
        matrix = rts.rigid(np.array([*vector, 1.0, 2.0, 3.0]))
        np.testing.assert_allclose(matrix[:3, :3], Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(matrix[:, 3], [1, 2, 3, 1], atol=1e-15)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_rigid_in_float32(target):
    for angle in (0.0, 0.0999, 0.1001, 2.0):
        vector = np.array([0.6, 0.0, 0.8]) * angle
        matrix = to_numpy(rts.rigid(arrays(target, np.array([*vector, 0, 0, 0]))))
        np.testing.assert_allclose(matrix[:3, :3], Rotation.from_rotvec(vector).as_matrix(), atol=1e-6)


@pytest.mark.parametrize("target", DIFFERENTIABLE)
def test_rigid_is_the_identity_at_zero_with_its_derivatives(target):
    zero = arrays(target, np.zeros(6))
    np.testing.assert_array_equal(to_numpy(rts.rigid(zero)), np.eye(4))
    point = arrays(target, np.array([0.3, -0.7, 0.5, 1.0]))
    weights = arrays(target, np.array([1.0, 2.0, -1.0, 0.0]))

    def f(pose):
        return (rts.rigid(pose) @ point) @ weights

    # d(R p)/dω at zero is the cross product.
    expected = [*np.cross(to_numpy(point)[:3], to_numpy(weights)[:3]), *to_numpy(weights)[:3]]
    np.testing.assert_allclose(gradient(target, f, zero), expected, atol=1e-6)
    p, w = to_numpy(point)[:3].astype(float), to_numpy(weights)[:3].astype(float)
    # R p = p + ω × p + ω × (ω × p) / 2 + …: the Hessian is (w pᵀ + p wᵀ) / 2 − (w · p) I.
    hessian = np.zeros((6, 6))
    hessian[:3, :3] = (np.outer(w, p) + np.outer(p, w)) / 2 - (w @ p) * np.eye(3)
    func = pytest.importorskip("jax") if target == "jax" else torch.func
    np.testing.assert_allclose(to_numpy(func.hessian(f)(zero)), hessian, atol=1e-5)


def test_rigid_turns_about_the_centre_and_takes_lists():
    center = np.array([1.0, -2.0, 0.5])
    matrix = rts.rigid([0, 0, 0.7, 0.1, 0.2, 0.3], center)
    np.testing.assert_allclose(matrix @ [*center, 1], [1.1, -1.8, 0.8, 1], atol=1e-12)
    np.testing.assert_allclose(matrix[:3, :3], rotation((0, 0, 1), np.degrees(0.7)), atol=1e-12)
    np.testing.assert_array_equal(matrix, rts.rigid(np.array([0, 0, 0.7, 0.1, 0.2, 0.3]), center))
    for wrong in ([0, 0, 0], np.zeros((6, 1)), 3.0, None):
        with pytest.raises(InputError, match=r"expected .*\(6,\)"):
            rts.rigid(wrong)


@pytest.mark.parametrize("pose", POSES.values(), ids=POSES)
def test_value_and_derivatives_are_those_of_the_array_code(pose):
    pose, center = torch.tensor(pose, dtype=torch.float64), torch.tensor(CENTER, dtype=torch.float64)
    given = [x.clone().requires_grad_(True) for x in (pose, center)]
    found = rts.rigid(*given)
    assert type(found.grad_fn).__name__ == "_EagerBackward"
    torch.testing.assert_close(found, RIGID.specification(pose, center), rtol=0, atol=1e-14)
    g = torch.tensor(np.random.default_rng(0).normal(size=(4, 4)))
    gradients = torch.autograd.grad(found, given, g, create_graph=True)
    expected = torch.func.vjp(RIGID.specification, pose, center)[1](g)
    torch.testing.assert_close(gradients, expected, rtol=1e-12, atol=1e-12)
    # The second derivative, of a sum of all first ones.
    second = torch.autograd.grad(sum(x.sum() for x in gradients), given)
    of_first = lambda p, c: sum(x.sum() for x in torch.func.vjp(RIGID.specification, p, c)[1](g))  # noqa: E731
    torch.testing.assert_close(second, torch.func.grad(of_first, (0, 1))(pose, center), rtol=1e-10, atol=1e-10)


def test_float32_stays_float32():
    pose = torch.tensor(POSES["above it"], requires_grad=True)
    matrix = rts.rigid(pose)
    matrix.sum().backward()
    assert matrix.dtype == pose.grad.dtype == torch.float32
    torch.testing.assert_close(matrix, RIGID.specification(pose.detach(), torch.zeros(3)), rtol=0, atol=1e-6)


@pytest.mark.parametrize("target", ALL)
def test_a_pose_or_center_of_nan_is_refused(target):
    for name, wrong in ("pose", [0, 0, math.nan, 0, 0, 0]), ("center", [0, math.inf, 0]):
        given = arrays(target, {"pose": np.zeros(6), "center": np.zeros(3), name: np.array(wrong)})
        with pytest.raises(rts.InputError, match=f"{name} .*; expected finite numbers"):
            rts.rigid(given["pose"], given["center"])
