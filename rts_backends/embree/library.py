"""Embree's C interface through ctypes: the library that ships inside the embreex wheel, or the system's.

Only functions for a scene of one triangle mesh are declared. Buffers are shared: Embree reads our arrays in place.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import glob
import sys
import threading
import weakref
from pathlib import Path

import embreex
import numpy as np

from rts.errors import PluginError

GEOMETRY_TRIANGLES = 0
BUFFER_INDEX, BUFFER_VERTEX = 0, 1
FORMAT_UINT3, FORMAT_FLOAT3 = 0x5003, 0x9003
SCENE_DYNAMIC, SCENE_ROBUST = 1, 4
QUALITY_LOW, QUALITY_MEDIUM, QUALITY_REFIT = 0, 1, 3

_POINTER, _UINT, _SIZE = ctypes.c_void_p, ctypes.c_uint, ctypes.c_size_t
_SIGNATURES = {
    "rtcNewDevice": (_POINTER, [ctypes.c_char_p]),
    "rtcGetDeviceError": (ctypes.c_int, [_POINTER]),
    "rtcNewScene": (_POINTER, [_POINTER]),
    "rtcSetSceneFlags": (None, [_POINTER, ctypes.c_int]),
    "rtcSetSceneBuildQuality": (None, [_POINTER, ctypes.c_int]),
    "rtcCommitScene": (None, [_POINTER]),
    "rtcReleaseScene": (None, [_POINTER]),
    "rtcNewGeometry": (_POINTER, [_POINTER, ctypes.c_int]),
    "rtcSetSharedGeometryBuffer": (
        None,
        [_POINTER, ctypes.c_int, _UINT, ctypes.c_int, _POINTER, _SIZE, _SIZE, _SIZE],
    ),
    "rtcUpdateGeometryBuffer": (None, [_POINTER, ctypes.c_int, _UINT]),
    "rtcSetGeometryBuildQuality": (None, [_POINTER, ctypes.c_int]),
    "rtcCommitGeometry": (None, [_POINTER]),
    "rtcAttachGeometry": (_UINT, [_POINTER, _POINTER]),
    "rtcReleaseGeometry": (None, [_POINTER]),
    "rtcIntersect1": (None, [_POINTER, _POINTER, _POINTER]),
}

_library: ctypes.CDLL | None = None
_device: int | None = None
_first_use = threading.Lock()


def _find() -> str:
    package = Path(embreex.__file__).parent
    patterns = {
        "darwin": [package / ".dylibs" / "libembree4*", package.parent / "embreex.dylibs" / "libembree4*"],
        "win32": [package.parent / "embreex.libs" / "embree4*.dll", package / "embree4*.dll"],
    }.get(sys.platform, [package.parent / "embreex.libs" / "libembree4*"])
    paths = [path for pattern in patterns for path in sorted(glob.glob(str(pattern)))]
    found = paths[0] if paths else ctypes.util.find_library("embree4")
    if found is None:
        raise PluginError(
            "the sampler 'embree' needs Embree 4's shared library, which wheels of the package embreex hold: "
            "pip install --force-reinstall embreex, or install the system's libembree4"
        )
    return found


PATH = _find()
"""Path or name of Embree 4's shared library. Without one this module, and so the sampler, cannot be imported."""


def load() -> ctypes.CDLL:
    """The library with its signatures, loaded once.

    Raises:
        PluginError: Embree gives no device.
    """
    global _library, _device
    with _first_use:
        if _library is None:
            library = ctypes.CDLL(PATH)
            for name, (result, arguments) in _SIGNATURES.items():
                function = getattr(library, name)
                function.restype, function.argtypes = result, arguments
            _device = library.rtcNewDevice(None)
            if not _device:
                raise PluginError("Embree gives no device on this machine; use the sampler 'raster'")
            _library = library
    return _library


class Scene:
    """The acceleration structure of one triangle mesh. Released when garbage-collected.

    Args:
        vertices: (V + 1, 3) float32, read in place; the last row is padding, since Embree reads 16 bytes a vertex.
        faces: (T, 3) int32, read in place.

    Raises:
        PluginError: Embree reports an error, such as too little memory.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        library = load()
        self._library, self.vertices, self.faces = library, vertices, faces
        self.handle = library.rtcNewScene(_device)
        library.rtcSetSceneFlags(self.handle, SCENE_ROBUST | SCENE_DYNAMIC)
        # With this the geometry gets a structure and a quality of its own. Only such a structure can be refitted (25
        # times faster than built), and rays are no slower in it.
        library.rtcSetSceneBuildQuality(self.handle, QUALITY_LOW)
        self._geometry = library.rtcNewGeometry(_device, GEOMETRY_TRIANGLES)
        share = library.rtcSetSharedGeometryBuffer
        share(self._geometry, BUFFER_VERTEX, 0, FORMAT_FLOAT3, vertices.ctypes.data, 0, 12, len(vertices) - 1)
        share(self._geometry, BUFFER_INDEX, 0, FORMAT_UINT3, faces.ctypes.data, 0, 12, len(faces))
        weakref.finalize(self, _release, library, self.handle, self._geometry)
        library.rtcSetGeometryBuildQuality(self._geometry, QUALITY_MEDIUM)
        library.rtcCommitGeometry(self._geometry)
        library.rtcAttachGeometry(self.handle, self._geometry)
        library.rtcCommitScene(self.handle)
        self._check()

    def move(self, *, rebuild: bool) -> None:
        """Follow the vertices given to `Scene`, changed in place: build the structure anew (`rebuild`) or refit it."""
        library = self._library
        library.rtcSetGeometryBuildQuality(self._geometry, QUALITY_MEDIUM if rebuild else QUALITY_REFIT)
        library.rtcUpdateGeometryBuffer(self._geometry, BUFFER_VERTEX, 0)
        library.rtcCommitGeometry(self._geometry)
        library.rtcCommitScene(self.handle)
        self._check()

    def _check(self) -> None:
        code = self._library.rtcGetDeviceError(_device)
        if code:
            raise PluginError(
                f"Embree refuses {len(self.faces)} triangles with error {code} (4 is out of memory); "
                f"use the sampler 'raster'"
            )

    @property
    def intersect(self) -> int:
        """Address of rtcIntersect1, for compiled code."""
        return ctypes.cast(self._library.rtcIntersect1, ctypes.c_void_p).value or 0


def _release(library: ctypes.CDLL, scene: int, geometry: int) -> None:
    library.rtcReleaseGeometry(geometry)
    library.rtcReleaseScene(scene)
