"""The conformance kit: what every plugin must do, as pytest classes to subclass.

    from rts.testing import SurfaceConformance

    class TestHeightfield(SurfaceConformance):
        @pytest.fixture
        def part(self):
            return Heightfield.example()

The docstring of each class names the fixtures to override. Checks that need torch or jax are skipped, with the reason,
if that is not installed. pytest collects subclasses alone. Classes are imported on first use, from the package that
registers them in the group "rts.testing" of entry points: `import rts` and the command line do without pytest.
"""

# pyright: reportUnsupportedDunderAll=false
# Type checkers read `testing.pyi`.

from typing import Any

from rts.registry import load_own

KINDS = ("Engine", "Operation", "Sampler", "Shader", "Splatter", "Surface")
__all__ = [f"{kind}Conformance" for kind in KINDS]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = load_own(__name__, name)
    return found
