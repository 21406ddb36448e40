"""Depth peeling with OpenGL ≥ 3.3, headless.

Each pass draws the triangles beyond those of the pass before and keeps the nearest, into an integer target: the
triangle and its quantised depth. The order (depth, triangle) is total, so coplanar triangles peel one by one. Hardware
snaps vertices to fractions of a pixel; so each hit is then decided in float64 by the edge functions of
`rts_backends.triangles`, and passed on to the neighbour that truly covers the pixel's centre, or dropped.

Hardware computes in float32. That is too coarse for triangles that are very large beside a pixel, or reach from very
near to very far, such as a ground from the camera to the horizon: the sampler "raster" draws such views.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import moderngl
import numpy as np

from rts import Camera, InputError, TriangleSampler, errors
from rts.plugin_api.records import Fragments, Proxy
from rts.plugin_api.threads import parallel
from rts_backends.exact_hits import SeenTriangles, corner_lists, correct, places
from rts_backends.opengl.worker import LESS, Worker
from rts_backends.raster.sampler import Raster
from rts_backends.triangles import bounding_sphere, pixel_matrix

TARGETS = 4
"""The most image sizes for which framebuffers are kept."""

DEPTH_STEPS = 2**22
"""Number of quantised depths; the 24 bits of a depth buffer hold each exactly."""

MOST_RATIO, MOST_ROUNDING = 1e4, 0.1
"""Limits of float32: how many times as wide a pixel may be at the farthest point as at the nearest; and how many pixels
rounding may move a vertex. Beyond them hits are lost."""

VERTEX = """
#version 330
uniform mat4 clip_from_unit;
in vec3 position;
void main() { gl_Position = clip_from_unit * vec4(position, 1.0); }
"""
FRAGMENT = f"""
#version 330
uniform isampler2D last;
uniform bool peeling;
out ivec2 found;
void main() {{
    int depth = int(gl_FragCoord.z * {DEPTH_STEPS}.0);
    if (peeling) {{
        ivec2 before = texelFetch(last, ivec2(gl_FragCoord.xy), 0).xy;
        if (before.x < 0 || depth < before.y || (depth == before.y && gl_PrimitiveID <= before.x)) discard;
    }}
    found = ivec2(gl_PrimitiveID, depth);
    gl_FragDepth = (float(depth) + 0.5) / {DEPTH_STEPS}.0;
}}
"""
EMPTY_VERTEX = """
#version 330
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 1.0, 1.0); }
"""
EMPTY_FRAGMENT = """
#version 330
out ivec2 found;
void main() { found = ivec2(-1, 0); }
"""


class Device:
    """A proxy's OpenGL objects, and the one context in which they may be used; none may be touched once it is lost."""

    context: moderngl.Context | None = None
    objects: tuple[Any, ...] = ()


class Buffers:
    """A proxy on the device, its vertices moved and scaled to the unit sphere; released when garbage-collected.

    Lists of the triangles around each corner (`exact_hits`) stay on the host.
    """

    def __init__(self, worker: Worker, proxy: Proxy):
        faces = np.ascontiguousarray(proxy.faces, np.int32)
        self.proxy = proxy = proxy._replace(vertices=np.ascontiguousarray(proxy.vertices, np.float32), faces=faces)
        *center, self.radius = bounding_sphere(proxy.vertices, proxy.faces)
        self.center = np.array(center)
        around = places(proxy.vertices, proxy.faces)
        self.corners = around, *corner_lists(around, len(proxy.vertices))
        self.device = Device()
        weakref.finalize(self, worker.later, _forget, self.device)
        worker.call(_upload, self)


class OpenGL(TriangleSampler):
    """Depth peeling on a device that the system's EGL offers, or on Mesa's llvmpipe."""

    def __init__(self) -> None:
        self._worker = Worker()
        self._warned = False

    def prepare(self, proxy: Proxy) -> Buffers:
        """Copy the triangles to the device."""
        return Buffers(self._worker, super().prepare(proxy))

    def rasterize(self, prepared: Buffers, camera: Camera, size: tuple[int, int], layers: int, cull: str) -> Fragments:
        """See `TriangleSampler.rasterize`. Views beyond float32 are drawn by the sampler "raster", with one warning."""
        height, width = size
        if _beyond_float32(camera, prepared, size):
            self._warn()
            return Raster().rasterize(prepared.proxy, camera, size, layers, cull)
        keep = camera.kept_sign(cull)
        clip = _tight(camera.projection, camera.view, prepared) @ camera.view
        # Read from below, the image has its top row first.
        clip = np.diag([1.0, -1.0, 1.0, 1.0]) @ clip
        denormalize = np.diag([prepared.radius] * 3 + [1.0])
        denormalize[:3, 3] = prepared.center
        triangle_ids = self._worker.call(_peel, prepared, clip @ denormalize, size, layers, keep)
        fragments = Fragments(
            np.ascontiguousarray(triangle_ids),
            np.empty((layers, height, width, 2), np.float32),
            np.empty((layers, height, width), np.float32),
        )
        proxy = prepared.proxy
        lens = pixel_matrix(camera, size), -camera.view[2], keep
        seen = SeenTriangles(*lens, proxy.vertices, proxy.faces, *prepared.corners)
        parallel(correct, height, seen, fragments)
        return fragments

    def _warn(self) -> None:
        """Warn, once, that the sampler 'raster' draws instead."""
        if not self._warned:
            self._warned = True
            errors.warn(
                f"triangles reach from the camera to more than {MOST_RATIO:g} times as far, or are too large beside a "
                "pixel, for OpenGL's float32: the sampler 'raster' draws such views instead of 'opengl'; move the near "
                "plane away from the camera, or choose 'raster'",
                errors.SamplerWarning,
            )


def _depths(camera: Camera, prepared: Buffers) -> tuple[float, float]:
    """First and last depth between which an object may be seen; if it is out of view, not first < last."""
    near, far = (float(z) for z in camera.depth_range())
    middle = -(camera.view[2, :3] @ prepared.center + camera.view[2, 3])
    reach = 1.01 * prepared.radius * np.linalg.norm(camera.view[2, :3])
    first, last = max(near, middle - reach), min(far, middle + reach)
    if first < last and _ratio(camera, first, last) > MOST_RATIO:
        # The sphere around an object reaches farther than the object: its corners are worth a look.
        depth = (prepared.proxy.vertices @ -camera.view[2, :3] - camera.view[2, 3])[prepared.proxy.faces]
        first, last = max(first, float(depth.min())), min(last, float(depth.max()))
        reach = max(1e-3 * (last - first), 1e-3 * abs(first))
        first, last = max(near, first - reach), min(far, last + reach)
    return first, last


def _ratio(camera: Camera, near: float, far: float) -> float:
    """The width of a pixel at depth `far` over that at `near`; infinity where it is not positive at `near`."""
    first, last = (camera.projection[3, 3] - camera.projection[3, 2] * z for z in (near, far))
    return float(last / first) if first > 0 else np.inf


def _beyond_float32(camera: Camera, prepared: Buffers, size: tuple[int, int]) -> bool:
    """True if hardware would lose hits of a view, see `MOST_RATIO`.

    False if the object is out of view, and for slanted near and far planes, which have no depth.
    """
    p = camera.projection
    if p[2, 0] or p[2, 1] or p[3, 0] or p[3, 1]:
        return False
    near, far = _depths(camera, prepared)
    if not near < far:
        return False
    width, by_depth = camera.spread(size)
    rounding = prepared.radius * np.finfo(np.float32).eps / 2
    return _ratio(camera, near, far) > MOST_RATIO or rounding > MOST_ROUNDING * float(abs(width + by_depth * near))


def _tight(projection: np.ndarray, view: np.ndarray, prepared: Buffers) -> np.ndarray:
    """The projection with its planes drawn close around the object, so that depth is quantised finely.

    Slanted planes, and those of views that do not show the object, stay.
    """
    p = projection.copy()
    if p[2, 0] or p[2, 1] or p[3, 0] or p[3, 1]:
        return p
    near, far = _depths(Camera(view, projection), prepared)
    if not near < far:
        return projection
    # Row 2 so that z = −w at depth near and z = w at depth far.
    w_near, w_far = p[3, 3] - p[3, 2] * near, p[3, 3] - p[3, 2] * far
    p[2, 2] = -(w_far + w_near) / (far - near)
    p[2, 3] = -w_near + p[2, 2] * near
    return p


# --------------------------------------------------------------------------------- on the worker's thread


def _programs(context: moderngl.Context) -> dict[str, Any]:
    """Programs and framebuffers of a context, made once."""
    if context.extra is None:
        peel = context.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
        empty = context.program(vertex_shader=EMPTY_VERTEX, fragment_shader=EMPTY_FRAGMENT)
        context.extra = {
            "peel": peel,
            "empty": context.vertex_array(empty, []),
            "query": context.query(samples=True),
            "targets": {},
        }
    return context.extra


def _upload(context: moderngl.Context, prepared: Buffers) -> Any:
    """The vertex array of a proxy, made first if this context has none."""
    device = prepared.device
    if device.context is not context:
        program, proxy = _programs(context)["peel"], prepared.proxy
        unit = ((proxy.vertices - prepared.center) / prepared.radius).astype(np.float32)
        vertex_buffer, index_buffer = context.buffer(unit.tobytes()), context.buffer(proxy.faces.tobytes())
        layout = [(vertex_buffer, "3f", "position")]
        array = context.vertex_array(program, layout, index_buffer, index_element_size=4)
        device.context, device.objects = context, (array, vertex_buffer, index_buffer)
    return device.objects[0]


def _forget(context: moderngl.Context, device: Device) -> None:
    if device.context is context:
        _release(device.objects)


def _release(objects: Sequence[Any]) -> None:
    for item in objects:
        item.release()


def _targets(context: moderngl.Context, size: tuple[int, int]) -> list[tuple[Any, Any]]:
    """Two framebuffers of `size`, each with its texture: one is read while the other is drawn.

    Raises:
        InputError: the image is larger than the device draws.
    """
    kept = _programs(context)["targets"]
    if size not in kept:
        limit = context.info["GL_MAX_TEXTURE_SIZE"]
        if max(size) > limit:
            raise InputError(
                f"the image is {size[0]} × {size[1]} pixels (height × width, its border included), but OpenGL on this "
                f"device ({context.info['GL_RENDERER']}) draws at most {limit} × {limit}; {LESS}"
            )
        while len(kept) >= TARGETS:
            for framebuffer, texture, depth in kept.pop(next(iter(kept))):
                _release([framebuffer, texture, depth])
        pairs, objects = [], []
        try:
            for _ in range(2):
                objects.append(texture := context.texture((size[1], size[0]), 2, dtype="i4"))
                objects.append(depth := context.depth_renderbuffer((size[1], size[0])))
                objects.append(framebuffer := context.framebuffer([texture], depth))
                pairs.append((framebuffer, texture, depth))
        except BaseException:
            _release(objects[::-1])
            raise
        kept[size] = pairs
    kept[size] = kept.pop(size)  # The least recently used is first.
    return [(framebuffer, texture) for framebuffer, texture, _ in kept[size]]


def _peel(
    context: moderngl.Context, prepared: Buffers, clip: np.ndarray, size: tuple[int, int], layers: int, keep: float
) -> np.ndarray:
    """(K, H, W) triangle ids, −1 for none, of vertices as hardware rounds them; `exact_hits` corrects them later.

    `clip` (4, 4) leads from the unit sphere to clip space; `keep` is that of `Camera.kept_sign`.
    """
    parts, array = _programs(context), _upload(context, prepared)
    program, query = parts["peel"], parts["query"]
    targets = _targets(context, size)
    ids = np.full((layers, *size), -1, np.int32)
    program["clip_from_unit"].write(clip.T.astype(np.float32).tobytes())
    context.front_face = "ccw" if keep >= 0 else "cw"
    for k in range(layers):
        framebuffer, texture = targets[k % 2]
        framebuffer.use()
        framebuffer.clear(depth=1.0)
        # Clearing sets integers to no known value; a triangle over everything does.
        context.enable_only(moderngl.NOTHING)
        parts["empty"].render(moderngl.TRIANGLES, vertices=3)
        context.enable_only(moderngl.DEPTH_TEST | (moderngl.CULL_FACE if keep else moderngl.NOTHING))
        targets[(k + 1) % 2][1].use(0)
        program["peeling"].value = k > 0
        with query:
            array.render(moderngl.TRIANGLES)
        if query.samples == 0:
            break
        pixels = np.frombuffer(framebuffer.read(components=2, dtype="i4"), np.int32)
        ids[k] = pixels.reshape(*size, 2)[..., 0]
    return ids
