"""Reconstructions whose pictures several processes share, as torchrun starts them."""

import os
import subprocess
import sys

import numpy as np
import pytest
from seen_ellipsoid import SIZE, written

pytestmark = pytest.mark.thorough
WORDS = f"--quick --steps 30 --size {SIZE} --texture 32 --held-out 4 --batch 4 --fit-cameras".split()
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1",  # Processes may hang without, see docs/guides/many_views.md.
}


def ran(photos, out, surface, *launcher):
    """The arrays of a reconstruction, which runs in processes of its own."""
    words = [sys.executable, *launcher, "-m", "rts", "reconstruct", str(photos), "-o", str(out), *WORDS]
    words += ["--surface", surface]
    run = subprocess.run(words, env={**os.environ, **ENVIRONMENT}, capture_output=True, text=True, timeout=540)
    assert run.returncode == 0, run.stderr
    heads = [line.split()[0] for line in run.stdout.splitlines()]
    assert heads.count("PSNR") == heads.count("verdict:") == 1, run.stdout  # The first process alone speaks.
    with np.load(out / "checkpoint/stages.npz") as data:
        return {name: data[name] for name in data.files if name != "about"}, (out / "views.csv").read_text()


@pytest.mark.parametrize("surface", ["mesh", "isosurface"])
def test_two_processes_give_the_mesh_of_one(tmp_path, surface):
    photos = written(tmp_path / "photos")
    one, table = ran(photos, tmp_path / "one", surface)
    two, again = ran(photos, tmp_path / "two", surface, "-m", "torch.distributed.run", "--nproc-per-node", "2")
    assert set(one) == set(two) and "atlas_texture" in one
    for name in one:
        np.testing.assert_allclose(two[name], one[name], atol=1e-5, err_msg=name)
    assert table == again
