"""Measurements of this library: accuracy, speed, and one commit against another; see README.md."""

import os

# As `import rts` sets them, where torch comes first: spinning threads of two libraries take each other's cores.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "1000")
