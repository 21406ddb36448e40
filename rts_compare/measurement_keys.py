"""Keys of measurements: hashes of the scene and the code that a kept measurement depends on."""

from __future__ import annotations

import hashlib
import inspect
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from rts import Camera, Part, engine_of, plugin, render, sample
from rts.plugin_api.arrays import leaves
from rts.plugin_api.checks import fingerprint
from rts.tool_api.scenes import check_scene

PACKAGES = ("rts", "rts_backends", "rts_surfaces")
"""Packages of the library whose code is part of the keys."""
WITHOUT_EFFECT = ("rts/diagnostics", "rts/tool_api", "__pycache__")
"""Folders whose files change no measurement."""
MOST_LAYERS = 8
"""Layers of hard images where something is translucent."""


def layers_of(parts: list[Part], camera: Camera) -> int:
    """The number of layers that a hard image needs: 1, or `MOST_LAYERS` if a shader is not opaque."""
    return 1 if all(part.shader.opaque for part in check_scene(parts, camera)[0]) else MOST_LAYERS


def state_key(parts: list[Part], camera: Camera, size: tuple[int, int]) -> str:
    """A hash of θ, transforms, culling, camera, size, classes of surfaces, and depths and colours of a hard image."""
    arrays = [*leaves([p.theta for p in parts]), *leaves([p.transform for p in parts]), *leaves(camera.for_size(size))]
    layers = layers_of(parts, camera)
    image = render(parts, camera, size, splatter="none", layers=layers)
    arrays += [sample(parts, camera, size, splatter=None, layers=layers).depth, image]
    host = [np.asarray(engine_of(x).to_numpy(engine_of(x).stop_gradient(x))) for x in arrays]
    text = repr((size, [(p.cull, type(p.surface).__qualname__) for p in parts], fingerprint(host)))
    return hashlib.sha256(text.encode()).hexdigest()[:20]


@cache
def library_key() -> str:
    """A hash of the library's source files on which measurements depend."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        spec = find_spec(package)
        for folder in (spec.submodule_search_locations or []) if spec is not None else []:
            for path in sorted(p for p in Path(folder).rglob("*") if p.suffix in (".py", ".cpp", ".h")):
                if not any(part in path.as_posix() for part in WITHOUT_EFFECT):
                    digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def plugin_key(group: str, name: str) -> str:
    """A hash of a foreign plugin's source file; "" for the library's own, without a file, or for the name ""."""
    if not name:
        return ""
    loaded = plugin(group, name)
    kind = loaded if isinstance(loaded, type) else type(loaded)
    try:
        path = inspect.getfile(kind)
        if kind.__module__.partition(".")[0] in PACKAGES:
            return ""
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:12]
    except (OSError, TypeError):
        return ""
