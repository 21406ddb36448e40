"""Checks of arguments that users give, with one-line errors; tables of triangles; fingerprints of arrays."""

from rts.arrays.argument_checks import check_numbers, check_positive, quoted
from rts.contracts.checks import is_count
from rts.sampling.cache import fingerprint
from rts.sampling.camera_checks import check_camera
from rts.scene.topology import index_table
from rts.terminal import shows_bar

__all__ = [
    "check_camera",
    "check_numbers",
    "check_positive",
    "fingerprint",
    "index_table",
    "is_count",
    "quoted",
    "shows_bar",
]
