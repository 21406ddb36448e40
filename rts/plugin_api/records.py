"""Records that pass between the library and plugins."""

from rts.contracts.records import ArraySpec, Cells, Fragments, Proxy, RayHits, Request, Samples, Splats
from rts.contracts.surface import Rate
from rts.scene.rays import Rays

__all__ = ["ArraySpec", "Cells", "Fragments", "Proxy", "Rate", "RayHits", "Rays", "Request", "Samples", "Splats"]
