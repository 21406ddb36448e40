import os
import re
from pathlib import Path

import hypothesis
import pytest

# Idle threads of OpenMP otherwise spin, which on a busy machine makes small renders many times slower.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# Most programs that tests have jax compile run once: to improve them takes longer than it saves. Without LLVM's passes
# and XLA's emitters of fused loops, a program of one operation takes half the time.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true --xla_cpu_use_fusion_emitters=false",
)

ROOT = Path(__file__).resolve().parent.parent

# Outside of programs jax compiles each operation for each shape: what one worker has compiled, others load.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / "build" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

# The same examples every time, however busy the machine is. `make test-all` asks for many.
for name, examples in {"few": 10, "many": 30}.items():
    hypothesis.settings.register_profile(name, deadline=None, derandomize=True, max_examples=examples)
hypothesis.settings.load_profile("few")

COMPILING = re.compile("jax|engines_agree|every_engine", re.IGNORECASE)
"""Names of tests that have jax compile programs, which takes seconds each."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leave to `make test-all` tests of jax, but for those of `test_jax.py`."""
    for item in items:
        if COMPILING.search(item.nodeid) and item.path.name != "test_jax.py":
            item.add_marker("thorough")


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real models and pictures."""
    folder = Path(os.environ.get("RTS_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; point RTS_DATA to it")
    return folder
