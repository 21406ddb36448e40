"""Where the time of a render goes."""

import os
import subprocess
import sys

import numpy as np
import pytest

import rts
from tests.helpers import arrays, icosphere, mesh_part

pytestmark = pytest.mark.rendering

CAMERA = rts.Camera.look_at((0, 0, 3), (0, 0, 0))


@pytest.mark.parametrize("splatter", ["edges", "single"])
def test_a_profile_names_the_stages_and_counts_rows(splatter):
    pytest.importorskip("torch")
    parts = [arrays("torch-cpu", mesh_part(icosphere(1), shader="lambert"))] * 2
    found = rts.profile(parts, CAMERA, (16, 16), splatter=splatter, repeats=1)
    names = [stage.name for stage in found.stages]
    assert names == ["sample", *["outlines"] * (splatter == "edges"), "evaluate and shade", "splat", "gradient"]
    rows = dict(zip(names, (stage.rows for stage in found.stages), strict=True))
    sampled = rts.sample(parts, CAMERA, (16, 16), splatter=splatter)
    assert rows["evaluate and shade"] == sum(len(samples.ids) for samples in sampled.samples)
    assert rows["splat"] == 256 and rows["gradient"] == 2 * 42 * 3
    assert all(stage.first >= 0 and stage.later >= 0 for stage in found.stages)
    text = str(found)
    assert all(name in text for name in names) and "2 parts. Most time: " in text


def test_without_derivatives_there_is_no_gradient():
    found = rts.profile(mesh_part(icosphere(1), shader="lambert"), CAMERA, (16, 16), repeats=1)
    assert "gradient" not in [stage.name for stage in found.stages]
    camera = arrays("torch-cpu", CAMERA)  # It has derivatives, but no part has.
    found = rts.profile(mesh_part(icosphere(1), shader="lambert"), camera, (16, 16), repeats=1)
    assert "gradient" not in [stage.name for stage in found.stages]
    with pytest.raises(rts.InputError, match="repeats is 0"):
        rts.profile(mesh_part(icosphere(1)), CAMERA, (16, 16), repeats=0)
    assert np.isfinite([stage.later for stage in found.stages]).all()


@pytest.mark.parametrize(
    ("first", "then", "policy"), [("rts", "torch", ""), ("torch", "rts", ""), ("torch", "rts", "ACTIVE")]
)
def test_torch_is_asked_to_spin_for_microseconds_unless_it_came_first(first, then, policy):
    pytest.importorskip("torch")
    program = f"""
import {first}, {then}, os
from rts.diagnostics import profile
text = str(profile.Profile((profile.StageTime("splat", 1.0, 1.0, 1, 1.0),), 1, ""))
print(os.environ["OMP_WAIT_POLICY"], os.environ.get("GOMP_SPINCOUNT"), "Import rts first" in text)
"""
    names = "OMP_WAIT_POLICY", "GOMP_SPINCOUNT"
    environment = {name: value for name, value in os.environ.items() if name not in names}
    environment |= {"OMP_WAIT_POLICY": policy} if policy else {}
    run = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    late = first == "torch" and not policy
    assert run.stdout.split() == [policy or "PASSIVE", "None" if policy else "1000", str(late)], run.stderr
