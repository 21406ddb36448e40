"""Measurements of this library: accuracy, speed, and one commit against another; see README.md."""

import os

# Spinning threads of two libraries take each other's cores. Read when a library is first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
