import os
from pathlib import Path

import pytest

# Idle threads of OpenMP otherwise spin, which on a busy machine makes small renders many times slower.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# Most programs that tests have jax compile run once: to have LLVM improve them takes longer than it saves.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true")

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real models and pictures."""
    folder = Path(os.environ.get("RTS_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; point RTS_DATA to it")
    return folder
