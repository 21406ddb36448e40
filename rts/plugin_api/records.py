"""Records that pass between the library and plugins."""

from rts.interfaces import Rate
from rts.records import ArraySpec, Fragments, Proxy, RayHits, Rays, Samples, Splats
from rts.row_cameras import RowCameras

__all__ = ["ArraySpec", "Fragments", "Proxy", "Rate", "RayHits", "Rays", "RowCameras", "Samples", "Splats"]
