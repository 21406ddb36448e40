"""The compiled rigid matrix against the array code, near and far from where series end."""

import math

import numpy as np
import pytest
from helpers import ALL, arrays

import rts
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


@pytest.mark.parametrize("pose", POSES.values(), ids=POSES)
def test_value_and_derivatives_are_those_of_the_array_code(pose):
    pose, center = torch.tensor(pose, dtype=torch.float64), torch.tensor(CENTER, dtype=torch.float64)
    given = [x.clone().requires_grad_(True) for x in (pose, center)]
    found = rts.rigid(*given)
    assert type(found.grad_fn).__name__ == "_ValueBackward"
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


def test_batches_of_derivatives():
    poses = torch.tensor(list(POSES.values()), dtype=torch.float64)
    center = torch.tensor(CENTER, dtype=torch.float64)
    for derivative in (torch.func.jacfwd, torch.func.jacrev, torch.func.hessian):
        found, expected = (
            torch.func.vmap(derivative(lambda p, f=f: f(p, center)))(poses) for f in (rts.rigid, RIGID.specification)
        )
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("target", ALL)
def test_a_pose_or_center_of_nan_is_refused(target):
    for name, wrong in ("pose", [0, 0, math.nan, 0, 0, 0]), ("center", [0, math.inf, 0]):
        given = arrays(target, {"pose": np.zeros(6), "center": np.zeros(3), name: np.array(wrong)})
        with pytest.raises(rts.InputError, match=f"{name} .*; expected finite numbers"):
            rts.rigid(given["pose"], given["center"])
