"""Mistakes that a person might make, as replacements of text: do the tests notice?"""

from __future__ import annotations

from typing import NamedTuple


class Defect(NamedTuple):
    """A mistake, planted by replacing a text that occurs once in a file.

    Attributes:
        name: of the mistake.
        path: of the file, from the repository's root.
        before: the right text.
        after: the wrong one.
        tests: names of files in tests/ that are likely to notice, without "test_" and ".py".
    """

    name: str
    path: str
    before: str
    after: str
    tests: str


LOOPS = [
    Defect(
        "packing swaps the barycentrics",
        "rts/sampling/packing_loops.py",
        "params[n, 0], params[n, 1] = a, b",
        "params[n, 0], params[n, 1] = b, a",
        "packing_invariants samplers",
    ),
    Defect(
        "packing loses the last row",
        "rts/sampling/packing_loops.py",
        "n >= len(ids):",
        "n >= len(ids) - 1:",
        "packing_invariants samplers",
    ),
    Defect(
        "merging takes the deeper part first",
        "rts/sampling/merging_loops.py",
        "not z < depth[k, y, x]",
        "z < depth[k, y, x]",
        "merging_invariants rendering",
    ),
    Defect(
        "layer order puts far layers first",
        "rts/sampling/layer_order_loops.py",
        "out_depth[at - 1, y, x] > z:",
        "out_depth[at - 1, y, x] < z:",
        "layer_order layer_order_invariants",
    ),
    Defect(
        "layer order leaves stale layers behind",
        "rts/sampling/layer_order_loops.py",
        "for k in range(kept, layers):",
        "for k in range(kept + 1, layers):",
        "layer_order layer_order_invariants",
    ),
    Defect(
        "forward mode of the projection forgets the depth",
        "rts/operations/projection_loops.py",
        "(change[0] - value[0] * over * deeper) * over",
        "change[0] * over",
        "operations camera",
    ),
    Defect(
        "reverse mode of the projection forgets how depth shrinks",
        "rts/operations/projection_loops.py",
        "c = zero if w == 0 else -(g[n, 0] * u + g[n, 1] * v) * over",
        "c = zero if w == 0 else -(g[n, 0] * u + g[n, 0] * v) * over",
        "operations rendering",
    ),
    Defect(
        "reverse mode of affine maps forgets the translation",
        "rts/operations/linear_loops.py",
        "total[r, 3] += h\n",
        "total[r, 3] += 0 * h\n",
        "operations rigid",
    ),
    Defect(
        "gradients of a row that two samples share do not add up",
        "rts/operations/combine_loops.py",
        "g_rows[ids[n, column + i], c] += w * g[n, c]",
        "g_rows[ids[n, column + i], c] = w * g[n, c]",
        "operations patches subdivision",
    ),
    Defect(
        "a thin triangle misses its last row",
        "rts_backends/raster/drawing.py",
        "for j in range(j0, j1 + 1):",
        "for j in range(j0, j1):",
        "raster samplers",
    ),
    Defect(
        "the far plane does not cut",
        "rts_backends/raster/drawing.py",
        "return near < 0 or far < 0",
        "return near < 0",
        "raster samplers",
    ),
    Defect(
        "a ray crosses a patch's flipped border without the flip",
        "rts_surfaces/patches/ray_patch_loops.py",
        "        t = 1 - t\n",
        "        t = t + 0\n",
        "patches bezier subdivision",
    ),
    Defect(
        "derivatives of a lattice are taken along the wrong step",
        "rts_surfaces/implicit/interpolation_loops.py",
        "return (above - below) / ((up + down) * step[axis])",
        "return (above - below) / ((up + down) * step[0])",
        "interpolation isosurface fields",
    ),
]
"""In compiled loops."""

ARRAYS = [
    Defect(
        "a photograph's principal point is off by half a pixel",
        "rts/scene/camera_converters.py",
        "cx, cy = K[0, 2] + (0.5 - pixel_center), K[1, 2] + (0.5 - pixel_center)",
        "cx, cy = K[0, 2] + pixel_center, K[1, 2] + pixel_center",
        "camera pose_files",
    ),
    Defect(
        "the y axis of a photograph points up",
        "rts/scene/camera_converters.py",
        "xp.reshape(t, (3,))), (1, -1, -1, 1))",
        "xp.reshape(t, (3,))), (1, 1, -1, 1))",
        "camera",
    ),
    Defect(
        "up and down are swapped in a camera's turn",
        "rts/scene/transforms.py",
        "xp.linalg.cross(back, right), back])",
        "xp.linalg.cross(right, back), back])",
        "camera camera_invariants",
    ),
    Defect(
        "textures are read half a texel off",
        "rts/shading/textures.py",
        "x, y = uv[:, 0] * width - 0.5,",
        "x, y = uv[:, 0] * width,",
        "shading mipmaps",
    ),
    Defect(
        "odd sizes of textures lose their last line",
        "rts/shading/textures.py",
        "(part + 1 / n) * x[2::2, ...]",
        "(part + 0 / n) * x[2::2, ...]",
        "mipmaps",
    ),
    Defect(
        "light from behind counts",
        "rts/shading/shaders.py",
        "xp.where(cosine > 0, half**shininess, 0 * half)",
        "half**shininess",
        "shading",
    ),
    Defect(
        "colours are not premultiplied",
        "rts/shading/shaders.py",
        "namespace(color).concat([color * alpha, alpha], axis=1)",
        "namespace(color).concat([color, alpha], axis=1)",
        "shading conformance",
    ),
    Defect(
        "kept structures go by size, not by content",
        "rts/sampling/cache.py",
        "return x.shape, x.dtype.str, xxhash.xxh3_128_intdigest(data)",
        "return x.shape, x.dtype.str, xxhash.xxh3_128_intdigest(data[:64])",
        "cache",
    ),
    Defect(
        "triangles of other faces are refitted",
        "rts/sampling/cache.py",
        "return same_count and (a.faces is b.faces or np.array_equal(a.faces, b.faces))",
        "return same_count",
        "cache",
    ),
    Defect(
        "an OBJ's indices from the end are off by one",
        "rts/files/obj_reader.py",
        "index = counts[i] + 1 + self.integer(part, number)",
        "index = counts[i] + self.integer(part, number)",
        "files file_invariants",
    ),
    Defect(
        "a material's transparency is taken for opacity",
        "rts/files/mtl_reader.py",
        "values[0] if of_meshlab or values[0] >= 1 else 1 - values[0]",
        "values[0]",
        "files misread_files",
    ),
    Defect(
        "a robust loss weighs by the wrong root",
        "rts/fitting/losses.py",
        "return 1 / xp.where(far, ratio, xp.sqrt(1 + near * near))",
        "return 1 / xp.where(far, ratio, 1 + near * near)",
        "losses",
    ),
    Defect(
        "bands of an image begin one row late",
        "rts/rendering/image.py",
        "window = scene.camera.window(size, (top, 0), (rows, size[1]))",
        "window = scene.camera.window(size, (top + 1, 0), (rows, size[1]))",
        "supersampling rendering",
    ),
    Defect(
        "a count of parts that differs is not refused",
        "rts/rendering/image.py",
        "if len(scene.parts) != len(sampled.samples):",
        "if len(scene.parts) > len(sampled.samples):",
        "rendering render_views sampling",
    ),
]
"""Elsewhere."""

DEFECTS = [*LOOPS, *ARRAYS]
