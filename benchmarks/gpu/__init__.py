"""Tests and timings on a machine with a GPU, by one command that needs no internet: `run.py`."""
