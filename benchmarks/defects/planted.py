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
        tests: names of files of tests that are likely to notice, without "test_" and ".py".
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
        "operations",
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
    Defect(
        "the second centre of a gap does not count",
        "rts/outlines/spans_loops.py",
        "_range(box[2 * axis] - 1.5, box[2 * axis + 1] - 0.5, count - 1)",
        "_range(box[2 * axis] - 0.5, box[2 * axis + 1] - 0.5, count - 1)",
        "edges edges_bodies",
    ),
    Defect(
        "the farther of two surfaces ends at a crossing",
        "rts/outlines/first_hits_loops.py",
        "(0 if z < deep else 1)\n",
        "(1 if z < deep else 0)\n",
        "edges edges_bodies",
    ),
    Defect(
        "surfaces cross at the mirrored place",
        "rts/outlines/first_hits_loops.py",
        "at = low + (high - low) * before / (before - after)",
        "at = low + (high - low) * after / (after - before)",
        "edges edges_bodies",
    ),
    Defect(
        "an edge that three triangles share joins two of them",
        "rts/outlines/seen_mesh_loops.py",
        "if m == n + 2:",
        "if m >= n + 2:",
        "seen_mesh edges_soups edges",
    ),
    Defect(
        "a walk that leaves a patch by another triangle joins it",
        "rts/outlines/seen_mesh_loops.py",
        "joined[axis, y, x] = end == s\n",
        "joined[axis, y, x] = end >= 0\n",
        "seen_mesh edges_soups edges",
    ),
    Defect(
        "folds are no silhouettes",
        "rts/outlines/silhouettes_loops.py",
        "if s >= 0 and (sides[s] * sides[t] > 0 or",
        "if s >= 0 and (sides[s] * sides[t] != 0 or",
        "seen_mesh edges",
    ),
    Defect(
        "triangles count as four times smaller than they are",
        "rts/outlines/silhouettes_loops.py",
        "wide = max(x1 - x0, y1 - y0) + more",
        "wide = max(x1 - x0, y1 - y0) / 4 + more",
        "seen_mesh edges_soups",
    ),
    Defect(
        "what ends is on the wrong side of a stack",
        "rts/outlines/stacks_loops.py",
        "if kind == 1 - side and (m == at or m == partner):",
        "if kind == side and (m == at or m == partner):",
        "edges_glass",
    ),
    Defect(
        "layers that cross keep their order",
        "rts/outlines/stacks_loops.py",
        "stack[m], stack[m + 1] = stack[m + 1], stack[m]",
        "stack[m], stack[m + 1] = stack[m], stack[m + 1]",
        "edges_glass",
    ),
    Defect(
        "outlines run the wrong way",
        "rts/outlines/segments_loops.py",
        "if not (sign > 0 or (sign == 0 and (back < 0",
        "if not (sign < 0 or (sign == 0 and (back < 0",
        "segments edges",
    ),
    Defect(
        "the lower side of a dual cell is counted from the left",
        "rts/outlines/segments_loops.py",
        "(3 - x if side == 2 else 4 - y)",
        "(2 + x if side == 2 else 4 - y)",
        "segments edges edges_soups",
    ),
    Defect(
        "outlines that turn have no corners",
        "rts/outlines/corners_loops.py",
        "x, y = x + alone * (sharp[0] - x), y + alone * (sharp[1] - y)",
        "x, y = x + 0.0, y + 0.0",
        "edges edges_bodies",
    ),
    Defect(
        "the crossings before a segment are swapped",
        "rts/outlines/segments_loops.py",
        "found[s, (1 - far) if e == 0 else 2 + far]",
        "found[s, far if e == 0 else 2 + far]",
        "segments edges edges_bodies",
    ),
    Defect(
        "the boundary term along y has the sign of that along x",
        "rts/outlines/areas_loops.py",
        "terms[s, k, i, r, 1] -= rate * way[0]",
        "terms[s, k, i, r, 1] += rate * way[0]",
        "stencil edges edges_bodies",
    ),
    Defect(
        "outlines of glass do not cross",
        "rts/outlines/corners_loops.py",
        "crosses = (low < clock[s, 0] < high) != (low < clock[s, 1] < high)",
        "crosses = False",
        "edges_meetings",
    ),
    Defect(
        "outlines that end at another one move with it all the way",
        "rts/outlines/areas_loops.py",
        "(1 - share if r == 1 else (share if r == 2 else 0.0))",
        "pull[h, r]",
        "stencil edges_meetings",
    ),
    Defect(
        "lines of intersection do not know of depth",
        "rts/outlines/stencil_loops.py",
        "moves[b, i, 2, a] = sign\n",
        "moves[b, i, 2, a] = 0 * sign\n",
        "edges edges_bodies edges_glass",
    ),
    Defect(
        "colours are taken of a region that has none",
        "rts/outlines/stencil_loops.py",
        "taken = min(taken, max(weight[at], 0.0)) if at < several else 0.0",
        "taken = taken + 0.0",
        "stencil edges_centres edges_soups",
    ),
    Defect(
        "gradients of colours forget the areas beside outlines",
        "rts/splatting/stencil_loops.py",
        "g_colors[n, c] += share * color_weight[e] * g[row, at, c]",
        "g_colors[n, c] += share * g[line // side, j // side, c]",
        "edges_operations",
    ),
    Defect(
        "columns of a Jacobian leave out colours beside outlines",
        "rts/splatting/stencil_loops.py",
        "out[t, i, c] += color_weight[e] * _of(t_colors[t], color_sample[e], c)",
        "out[t, i, c] += 0 * color_weight[e] * _of(t_colors[t], color_sample[e], c)",
        "image_residuals",
    ),
    Defect(
        "gradients of opacity forget the light that passes",
        "rts/splatting/layers_loops.py",
        "g_rgba[n, alpha] -= light * behind",
        "g_rgba[n, alpha] -= behind",
        "edges_operations",
    ),
    Defect(
        "composites behind a layer are those behind the next",
        "rts/splatting/layers_loops.py",
        "behind[k, c] = rgba[n, c] + passed * behind[k + 1, c]",
        "behind[k, c] = passed * behind[k + 1, c]",
        "edges_operations edges_glass",
    ),
    Defect(
        "what ends beside a crossing moves as layers that go on",
        "rts/outlines/stencil_loops.py",
        "stays |= stack[b, 1 - i, other] == there",
        "stays |= stack[b, i, other] == there",
        "edges_glass",
    ),
    Defect(
        "merging leaves triangles where they were",
        "rts/sampling/merging_loops.py",
        "triangle[n, y, x] = triangle[n - 1, y, x]",
        "triangle[n, y, x] = told",
        "merging_invariants",
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
        "textures have green for blue",
        "rts/operations/texels_loops.py",
        "out[n, 0], out[n, 1], out[n, 2] = red, green, blue",
        "out[n, 0], out[n, 1], out[n, 2] = red, blue, green",
        "shading mipmaps",
    ),
    Defect(
        "a footprint's sides tell half of how the mean changes",
        "rts/operations/texels_loops.py",
        "by = share * (of_a if i < sides else of_b)",
        "by = 0.5 * share * (of_a if i < sides else of_b)",
        "mipmaps",
    ),
    Defect(
        "odd sizes of textures lose their last line",
        "rts/shading/mipmaps.py",
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
        "else len(rows) + index)",
        "else len(rows) + index - 1)",
        "files file_invariants",
    ),
    Defect(
        "a material's transparency is taken for opacity",
        "rts/files/mtl_reader.py",
        "values[0] if of_meshlab or values[0] >= 1 else 1 - values[0]",
        "values[0]",
        "files damaged_files",
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
    Defect(
        "neighbours of faces that may be written are kept",
        "rts/outlines/seen_mesh.py",
        "kept, key = not faces.flags.writeable and faces.flags.owndata, id(faces)",
        "kept, key = True, id(faces)",
        "seen_mesh edges",
    ),
    Defect(
        "the farther of two layers moves a crossing",
        "rts/outlines/halving.py",
        "(depths[1] < depths[0]).astype(np.int32)",
        "(depths[1] > depths[0]).astype(np.int32)",
        "field_outlines crossings_of_fields",
    ),
    Defect(
        "slopes are taken beyond a crossing",
        "rts/outlines/halving.py",
        "inward, across = way * BESIDE * step,",
        "inward, across = -way * BESIDE * step,",
        "crossings_of_fields",
    ),
    Defect(
        "rows beside outlines of earlier parts are not counted",
        "rts/outlines/of_scene.py",
        "        first += whole.ids.shape[-2]\n",
        "        first += count\n",
        "edges_fields bezier isosurface",
    ),
    Defect(
        "cells move by the rows of their own part",
        "rts/outlines/of_scene.py",
        "shifts = self.centres - np.cumsum(self.counts) + self.counts",
        "shifts = self.centres - np.cumsum(self.counts)",
        "edges_fields bezier isosurface",
    ),
    Defect(
        "of several passes the farther is in front",
        "rts/sampling/merging_loops.py",
        "(depths[k, y, x], triangles[k, y, x]) < (z, t)",
        "(depths[k, y, x], triangles[k, y, x]) > (z, t)",
        "many_parts",
    ),
    Defect(
        "parts without a row share one with the next",
        "rts/sampling/packing_loops.py",
        "total = max(n, total + 1)",
        "total = n",
        "many_parts",
    ),
    Defect(
        "of parts behind an opaque one samples are kept",
        "rts/outlines/samples_loops.py",
        "hidden[x] |= own >= 0 and opaque[own]",
        "hidden[x] |= own >= 0 and not opaque[own]",
        "edges_glass many_parts",
    ),
    Defect(
        "slopes of layers add to what is behind them",
        "rts/splatting/layers.py",
        "(slope - slope[..., -1:] * behind[-1 - k])",
        "(slope + slope[..., -1:] * behind[-1 - k])",
        "edges_operations",
    ),
    Defect(
        "merging counts rows of the part before twice",
        "rts/sampling/merging.py",
        "firsts = np.cumsum(sizes) - sizes\n    rows =",
        "firsts = np.cumsum(sizes)\n    rows =",
        "merging_invariants",
    ),
    Defect(
        "views are placed as if they were square",
        "rts/sampling/picture.py",
        "np.stack([across * self.view[1], down * self.view[0]], axis=1)",
        "np.stack([across * self.view[0], down * self.view[0]], axis=1)",
        "render_views edges_views",
    ),
    Defect(
        "the first row of a table stays",
        "rts/sampling/picture.py",
        "xp.where(rows >= start, rows + shift, moved)",
        "xp.where(rows > start, rows + shift, moved)",
        "render_views edges_views",
    ),
    Defect(
        "outlines of later views move with those of the first",
        "rts/sampling/picture.py",
        '"motion_sample": moved("motion_sample")}',
        '"motion_sample": whole("motion_sample")}',
        "edges_views",
    ),
    Defect(
        "cells of later views show samples of the first",
        "rts/views/sampled_views.py",
        "- total + starts - first_rows",
        "- total - first_rows",
        "edges_views",
    ),
]
"""Elsewhere."""

DEFECTS = [*LOOPS, *ARRAYS]
