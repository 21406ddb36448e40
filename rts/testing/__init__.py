"""The conformance kit: what every plugin must do, as pytest classes to subclass.

    from rts.testing import SurfaceConformance

    class TestHeightfield(SurfaceConformance):
        @pytest.fixture
        def part(self):
            return Heightfield.example()

The docstring of each class names the fixtures to override. Checks that need torch or jax are skipped, with the reason,
if that is not installed. pytest collects subclasses alone. Classes are imported on first use: `import rts` and the
command line do without pytest.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rts.testing.engines import EngineConformance
    from rts.testing.operations import OperationConformance
    from rts.testing.samplers import SamplerConformance
    from rts.testing.shaders import ShaderConformance
    from rts.testing.splatters import SplatterConformance
    from rts.testing.surfaces import SurfaceConformance

__all__ = [
    "EngineConformance",
    "OperationConformance",
    "SamplerConformance",
    "ShaderConformance",
    "SplatterConformance",
    "SurfaceConformance",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{name.removesuffix('Conformance').lower()}s"), name)
