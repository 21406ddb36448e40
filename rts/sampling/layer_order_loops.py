"""Rays of packed samples; layers of each cell sorted, equal ones merged and gaps closed. Compiled."""

from __future__ import annotations

from rts.compiling.loops import compiled, loop


@loop
def settle_lines(start, stop, row, depth, limits, out_row, out_depth):
    """Settle lines [start, stop) of the image; see `rts.sampling.layer_order.settle`.

    Args:
        start: the first line.
        stop: the line after the last.
        row: (K, H, W) int32.
        depth: (K, H, W) float32.
        limits: (4,) depths of the near and far plane; and the least difference of the depths of two roots: a constant,
            and a factor of the depth.
        out_row: (K, H, W), to be filled; −1 in empty layers.
        out_depth: (K, H, W), to be filled; 0 in empty layers.
    """
    layers, _, width = row.shape
    near, far, least_gap, gap_by_depth = limits
    for y in range(start, stop):
        for x in range(width):
            count = 0
            for k in range(layers):
                i, z = row[k, y, x], depth[k, y, x]
                if i < 0 or z < near or z > far:
                    continue
                at = count
                while at > 0 and out_depth[at - 1, y, x] > z:
                    out_depth[at, y, x], out_row[at, y, x] = out_depth[at - 1, y, x], out_row[at - 1, y, x]
                    at -= 1
                out_depth[at, y, x], out_row[at, y, x] = z, i
                count += 1
            kept = 0
            for k in range(count):
                z = out_depth[k, y, x]
                if kept == 0 or z - out_depth[kept - 1, y, x] > least_gap + gap_by_depth * abs(z):
                    out_depth[kept, y, x], out_row[kept, y, x] = z, out_row[k, y, x]
                    kept += 1
            for k in range(kept, layers):
                out_depth[k, y, x], out_row[k, y, x] = 0, -1


@compiled
def _ray(x, y, p, inverse, origin, direction):
    """Fill `origin` and `direction` (3,) with the ray through the point (x, y) of NDC. See `rts.Camera.rays`.

    `p` (4, 4) is the camera's projection, `inverse` (4, 4) the inverse of its view.
    """
    a, b, across, lean = p[0, 0] - x * p[3, 0], p[0, 1] - x * p[3, 1], x * p[3, 3] - p[0, 3], p[0, 2] - x * p[3, 2]
    c, d, down, fall = p[1, 0] - y * p[3, 0], p[1, 1] - y * p[3, 1], y * p[3, 3] - p[1, 3], p[1, 2] - y * p[3, 2]
    determinant = a * d - b * c
    right, up = (d * across - b * down) / determinant, (a * down - c * across) / determinant
    toward_x, toward_y = (d * lean - b * fall) / determinant, (a * fall - c * lean) / determinant
    for k in range(3):
        origin[k] = inverse[k, 0] * right + inverse[k, 1] * up + inverse[k, 3]
        direction[k] = inverse[k, 0] * toward_x + inverse[k, 1] * toward_y - inverse[k, 2]


@loop
def rays_of(start, stop, row, size, projection, inverse, origins, directions):
    """Fill the rays of samples in lines [start, stop), counted over layers, as `rts.Camera.rays` gives them.

    Args:
        start: the first line.
        stop: the line after the last.
        row: (K H, W) int32, the sample in each cell, or −1.
        size: (H, W) of the grid.
        projection: (4, 4) float64.
        inverse: (4, 4) float64, of the view.
        origins: (N, 3) float64, to be filled for samples in these lines.
        directions: (N, 3) float64, likewise.
    """
    height, width = size
    for line in range(start, stop):
        y = 1 - (line % height + 0.5) * 2 / height
        for i in range(width):
            n = row[line, i]
            if n >= 0:
                _ray((i + 0.5) * 2 / width - 1, y, projection, inverse, origins[n], directions[n])


@loop
def rays_of_cells(row, lines, columns, size, projection, inverse, origins, directions):
    """Fill the rays of samples in listed cells, as `rts.Camera.rays` gives them; other rows of rays stay.

    Args:
        row: (K, M) int32, the sample in each of M cells, or −1.
        lines: (M,), the line of each cell in the grid.
        columns: (M,), its column.
        size: (H, W) of the grid.
        projection: (4, 4) float64.
        inverse: (4, 4) float64, of the view.
        origins: (N, 3) float64.
        directions: (N, 3) float64.
    """
    height, width = size
    for k in range(len(row)):
        for m in range(len(lines)):
            n, x, y = row[k, m], (columns[m] + 0.5) * 2 / width - 1, 1 - (lines[m] + 0.5) * 2 / height
            if n >= 0:
                _ray(x, y, projection, inverse, origins[n], directions[n])
