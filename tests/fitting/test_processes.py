"""Fits that several processes share, as torchrun starts them."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.fitting
pytest.importorskip("torch")

SCRIPT = Path(__file__).parents[1] / "distributed_fit.py"


def run(count, *args, restarts=0):
    """The output of the script in `count` processes."""
    # torchrun looks seldom whether a process has ended, so that the others have time to say so before they are stopped.
    launch = ["-m", "torch.distributed.run", "--standalone", "--monitor-interval", "3", "--nproc-per-node", str(count)]
    command = [sys.executable, *(launch if count > 1 else []), *(["--max-restarts", str(restarts)] if restarts else [])]
    paths = [str(SCRIPT.parent), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        "OMP_NUM_THREADS": "1",
        "TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1",  # Restarts may hang without, see docs/guides/many_views.md.
    }
    done = subprocess.run(
        [*command, str(SCRIPT), *map(str, args)], env=environment, capture_output=True, text=True, timeout=300
    )
    return done.returncode, done.stdout + done.stderr


def results(path):
    with np.load(path) as known:
        return {name: known[name] for name in known.files}


@pytest.mark.thorough
def test_two_processes_take_the_steps_of_one(tmp_path):
    """By LM; those of Adam are compared in the next test, where one of the processes ends."""
    one, two = (tmp_path / f"{count}.npz" for count in (1, 2))
    for count, path in ((1, one), (2, two)):
        code, output = run(count, "lm", path)
        assert code == 0, output
    one, two = results(one), results(two)
    assert len(one["history"]) >= 8
    for name in one:
        np.testing.assert_allclose(two[name], one[name], rtol=1e-5, atol=1e-6)


@pytest.mark.thorough
def test_a_job_goes_on_after_a_process_has_ended(tmp_path):
    ended, alone = tmp_path / "ended.npz", tmp_path / "alone.npz"
    code, output = run(1, "adam", alone)
    assert code == 0, output
    code, output = run(2, "adam", ended, tmp_path / "checkpoint", "1:23", restarts=1)
    assert code == 0, output
    assert Path(f"{ended}.ended").exists()
    # The process that was left said why it stopped, in one line.
    lines = [line for line in output.splitlines() if "waited for the others, and one has ended" in line]
    assert len(lines) == 1 and "process 0 of 2" in lines[0]
    one, two = results(alone), results(ended)
    for name in one:
        np.testing.assert_allclose(two[name], one[name], rtol=1e-5, atol=1e-6)
