import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.core

PROGRAM = """
import resource, sys
import numpy as np
if "rts" in sys.argv: import rts

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    arrays = [np.ones(3 << 20, np.uint8) for _ in range(10)]
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

print([faults() for _ in range(4)][-1])
"""


HUGE_PAGES = Path("/sys/kernel/mm/transparent_hugepage/enabled")


@pytest.mark.skipif(HUGE_PAGES.exists() and "[always]" in HUGE_PAGES.read_text(), reason="huge pages have few faults")
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="how much is kept is a matter of the C library of Linux")
def test_memory_of_one_step_serves_the_next():
    environment = {
        name: value for name, value in os.environ.items() if "MALLOC" not in name and name != "GLIBC_TUNABLES"
    }
    pages = 30 * 2**20 // os.sysconf("SC_PAGESIZE")

    def faults(*arguments):
        run = subprocess.run(
            [sys.executable, "-c", PROGRAM, *arguments], env=environment, capture_output=True, text=True
        )
        assert run.returncode == 0, run.stderr
        return int(run.stdout)

    assert faults("rts") < 0.05 * pages < 0.5 * pages < faults()
