"""Files of polygons, and the cache folder for results that are costly to compute."""

from rts.files.obj_reader import read_polygons
from rts.files.paths import cache_folder

__all__ = ["cache_folder", "read_polygons"]
