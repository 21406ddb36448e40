"""Triangles as a camera sees them: neighbours, sides, and the gaps between centres that meet silhouettes."""

import numpy as np
import pytest
from helpers import icosphere

import rts
from rts.compiling.threads import read_only
from rts.contracts.records import Proxy
from rts.outlines import seen_mesh, spans_loops
from rts.outlines.gaps import Gaps, Hits
from rts.outlines.seen_mesh import SeenMesh
from rts.outlines.silhouettes_loops import ANY_SIZE, BLOCK
from rts.scene.camera import Camera

pytestmark = pytest.mark.sampling

SIZE = (8, 8)
CAMERA = Camera.orthographic((0, 0, 5), (0, 0, 0), height=8.0, near=0.1, far=10)
"""A cell is one unit; the centre of the image's first cell is at (−3.5, 3.5)."""
TWO = np.array([(0, 1, 2), (1, 0, 3)], np.int32)
THREE = np.array([(0, 1, 2), (1, 0, 3), (0, 1, 4)], np.int32)


def of(corners, faces):
    """The patches of triangles with these corners, x and y in cells from the upper left corner, at depth 5."""
    x, y = np.asarray(corners, float).T
    vertices = np.column_stack([x - 4, 4 - y, 0 * x]).astype(np.float32)
    return SeenMesh.of(Proxy(vertices, np.asarray(faces, np.int32)), CAMERA, SIZE, "none")


def test_two_triangles_are_neighbours_beyond_the_edge_opposite_their_third_corners():
    np.testing.assert_array_equal(seen_mesh._adjacent(TWO), [(-1, -1, 1), (-1, -1, 0)])


def test_an_edge_that_three_triangles_share_has_no_neighbours():
    np.testing.assert_array_equal(seen_mesh._adjacent(THREE), np.full((3, 3), -1))


def test_neighbours_are_kept_for_faces_that_nobody_writes_alone():
    fixed, free = TWO.copy(), TWO.copy()
    fixed.flags.writeable = False
    assert seen_mesh._adjacent(fixed) is seen_mesh._adjacent(fixed)
    assert seen_mesh._adjacent(free)[0, 2] == 1
    free[1] = (1, 4, 3)
    np.testing.assert_array_equal(seen_mesh._adjacent(free), np.full((2, 3), -1))


def apart(vertices, faces):
    """The triangles with vertices of their own."""
    return vertices[faces].reshape(-1, 3), np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3)


def test_triangles_that_meet_are_neighbours_where_colours_do_not_tell():
    vertices, faces = icosphere(1)
    proxy, size = Proxy(*apart(vertices.astype(np.float32), faces)), (8, 8)
    np.testing.assert_array_equal(SeenMesh.of(proxy, CAMERA, size, "none").adjacent, seen_mesh._adjacent(faces))
    assert (SeenMesh.of(proxy, CAMERA, size, "none", seams=True).adjacent == -1).all()
    # A triangle that is moved away has no neighbours, though the others were known before; zeros have no sign.
    moved = proxy.vertices.copy()
    moved[:3] += 1
    moved[moved == 0] = -0.0
    adjacent = SeenMesh.of(proxy._replace(vertices=moved), CAMERA, size, "none").adjacent
    assert (adjacent[0] == -1).all() and (adjacent == -1).sum() == 6


def test_welds_are_kept_for_faces_that_nobody_writes_while_they_hold():
    vertices, faces = apart(*icosphere(0))
    faces = faces.copy()
    faces.flags.writeable = False
    found = seen_mesh._welded(vertices, faces)
    assert found is not faces and seen_mesh._welded(vertices + 1, faces) is found
    vertices[0] += 1
    assert len(np.unique(seen_mesh._welded(vertices, faces))) == len(np.unique(found)) + 1
    scattered = np.random.default_rng(0).normal(size=vertices.shape)
    assert seen_mesh._welded(scattered, faces) is faces
    shared, own = icosphere(1)
    assert seen_mesh._welded(shared, own) is own


@pytest.mark.parametrize("parts", [1, 2])
def test_silhouettes_do_not_depend_on_which_vertices_are_shared(parts):
    """Image and gradient are those of the mesh whose triangles share vertices, of one part and of joint ones."""
    torch = pytest.importorskip("torch")
    (vertices, faces), camera, size = icosphere(1), Camera.look_at((1, 2, 3), (0, 0, 0)), (24, 24)
    soup, own = apart(np.arange(len(vertices))[:, None] * [1, 0, 0], faces)
    weights = torch.from_numpy(np.random.default_rng(1).normal(size=(*size, 4)))

    def shown(table, rows):
        x = torch.from_numpy(vertices.copy()).requires_grad_()
        moved = [{"vertices": (x + 0.7 * i)[rows]} for i in range(parts)]
        image = rts.render([rts.Part(rts.Mesh(table), theta, "silhouette") for theta in moved], camera, size)
        (image * weights).sum().backward()
        return image.detach().numpy(), x.grad.numpy()

    for shared, split in zip(shown(faces, slice(None)), shown(own, soup[:, 0]), strict=True):
        np.testing.assert_allclose(split, shared, atol=1e-6 * np.abs(shared).max())


@pytest.mark.parametrize(("wide", "side"), [(0.4, 1), (0.9, 2), (1.6, 3), (4.4, 5), (4.6, 6), (9.0, 6)])
def test_triangles_are_told_apart_by_their_size(wide, side):
    """By the size of the number; its sign tells clockwise from counterclockwise."""
    corners = [(2, 2), (2 + wide, 2), (2, 2.4)]
    there, back = of(corners, [(0, 1, 2)]).sides[0], of(corners, [(0, 2, 1)]).sides[0]
    assert abs(there) == side and there == -back


def quad(left, top, right, bottom):
    return [(left, top), (right, top), (right, bottom), (left, bottom)]


def marked(own, part):
    """The gaps, along rows and along columns, that the silhouettes of some patches meet where `part` is seen."""
    met = np.zeros((2, *SIZE), np.uint8)
    own.mark_silhouettes(Hits(part, 0 * part, 5.0 * np.ones(SIZE)), np.array([1.0, 0.0]), met)
    return {(axis, y, x) for axis, y, x in np.argwhere(met == 2).tolist()}


def test_the_border_of_a_card_meets_the_gaps_that_it_crosses():
    part = np.full(SIZE, -1, np.int32)
    part[2:5, 2:6] = 0
    own = of(quad(2.1, 2.1, 5.9, 4.9), [(0, 1, 2), (0, 2, 3)])
    # Its diagonal is no silhouette.
    expected = {(0, y, x) for y in (2, 3, 4) for x in (1, 5)} | {(1, y, x) for y in (1, 4) for x in (2, 3, 4, 5)}
    assert marked(own, part) == expected


def test_a_fold_is_a_silhouette():
    part = np.full(SIZE, -1, np.int32)
    part[2:5, 2:5] = 0
    # The second triangle lies on the first: the patch turns away at x = 4.7, the edge that both have in common.
    own = of([(4.7, 2.2), (4.7, 4.8), (0.2, 3.5), (1.2, 3.5)], [(0, 1, 2), (1, 0, 3)])
    assert {(0, y, 4) for y in (2, 3, 4)} <= marked(own, part)


@pytest.mark.parametrize("faces", [[(0, 1, 2)], [(0, 2, 1)]])
@pytest.mark.parametrize("wide", [0.4, 1.6, 3.4])
def test_a_span_is_the_chord_of_a_triangle(wide, faces):
    """The chord of a triangle along the gap from (3.5, 3.5) to (4.5, 3.5), wherever the triangle lies on it."""
    marks = np.zeros((2, *SIZE), bool)
    marks[0, 3, 3] = True
    gaps = Gaps.of(marks)
    np.testing.assert_array_equal(gaps.gap, [(3, 3, 1)])
    for shift in np.arange(-wide, 1, 0.23):
        low = 3.5 + shift
        names, spans, _ = of([(low, 3.0), (low + wide, 3.0), (low, 4.0)], faces).spans(gaps, False)
        found = spans[names[:, 0] >= 0]
        if min(shift + wide / 2, 1) - max(shift, 0) < 1e-4:
            assert not len(found)
            continue
        np.testing.assert_allclose(found[:, :2], [(shift, shift + wide / 2)], atol=1e-5)
        a, b, c, d = found[0, 2:]
        np.testing.assert_allclose([a / c, (a + b) / (c + d)], 5, atol=1e-5)


def test_cells_before_a_gap_are_marked():
    cells = np.zeros((11, 12), np.int8)
    spans_loops.around(np.array([(5, 5, 1)], np.int32), cells)
    expected = np.zeros((11, 12), np.uint8)
    for size, away in enumerate((0, 1, 2, 4)):
        expected[5 - away : 6, 5 - away : 7] |= 1 << 2 * size
    np.testing.assert_array_equal(cells.view(np.uint8), expected)


def test_no_triangle_that_meets_a_gap_is_passed_over_for_its_size():
    rng = np.random.default_rng(3)
    corners = rng.uniform(-3, 11, (500, 1, 2)) + rng.normal(size=(500, 3, 2)) * 10 ** rng.uniform(-1, 0.6, (500, 1, 1))
    mesh = of(corners.reshape(-1, 2), np.arange(1500).reshape(-1, 3))
    larger = mesh._replace(sides=np.sign(mesh.sides) * np.int8(ANY_SIZE))
    assert set(np.abs(mesh.sides)) >= {1, 2, 3, 4, 5, 6}
    for axis, y, x in np.argwhere(np.ones((2, *SIZE), bool)[:, :-1, :-1]):
        marks = np.zeros((2, *SIZE), bool)
        marks[axis, y, x] = True
        found = []
        for looked_at in (mesh, larger):
            triangles, most = np.zeros((2, len(mesh.counts), BLOCK), np.int32)
            counts = np.empty(len(mesh.counts), np.int32)
            spans_loops.most_spans(0, len(counts), looked_at, Gaps.of(marks), triangles, most, counts)
            there = np.arange(BLOCK) < counts[:, None]
            assert (most[there] > 0).all()
            found.append((triangles[there], most[there]))
        np.testing.assert_array_equal(*found)


def listed(mesh):
    """The triangles of `on_lines`, and their `lines`."""
    places = np.concatenate([BLOCK * i + np.arange(count) for i, count in enumerate(mesh.counts)])
    return mesh.on_lines[places], mesh.lines[places]


def test_all_triangles_that_meet_a_line_of_centres_are_listed_and_few_others():
    rng = np.random.default_rng(4)
    corners = rng.uniform(-3, 11, (900, 1, 2)) + rng.normal(size=(900, 3, 2)) * 10 ** rng.uniform(-1, 0.6, (900, 1, 1))
    corners[:9, 0] = 1e6, -1e6  # Far outside of the image.
    corners[9:99, 0] += 0.5 - corners[9:99, 0] % 1  # On a line, or a little beside.
    corners[9:99, 1:] = corners[9:99, :1] - rng.uniform(0.1, 0.4, (90, 2, 2))
    corners[700:] = corners[700:, :1]  # Seen edge-on.
    mesh = of(corners.reshape(-1, 2), np.arange(2700).reshape(-1, 3))
    low, high = mesh.seen.reshape(-1, 3, 2).min(1), mesh.seen.reshape(-1, 3, 2).max(1)

    def meets(slack):
        """(T, 2), true for triangles that meet lines of centres of the image along x, or along y, or nearly."""
        first, last = np.maximum(np.ceil(low - 0.5 - slack), 0), np.minimum(np.floor(high - 0.5 + slack), 7)
        return (first <= last)[:, ::-1] & (mesh.sides[:-1] != 0)[:, None]

    triangles, lines = listed(mesh)
    found = np.zeros((900, 2), bool)
    found[triangles] = np.stack([lines & 1, lines >> 1], axis=1)
    assert found[meets(2e-5)].all()
    # Some that lie beyond the image, but not far, are listed, too.
    beyond = ((high < 0.6) | (low > 7.4)).any(1, keepdims=True)
    assert not found[~(meets(0.02) | beyond)].any()
    assert (np.diff(triangles) > 0).all() and 100 < len(triangles) < 600


def test_triangles_that_are_not_kept_are_not_listed():
    vertices, faces = icosphere(2)
    proxy = Proxy(3 * vertices.astype(np.float32), faces)
    both, front = (SeenMesh.of(proxy, CAMERA, SIZE, cull) for cull in ("none", "back"))
    triangles = listed(both)[0]
    np.testing.assert_array_equal(listed(front)[0], triangles[both.sides[triangles] * front.keep[0] > 0])


def test_spans_are_sorted_by_where_they_start():
    rng = np.random.default_rng(5)
    counts = np.array([0, 1, 2, 8, 9, 40, 300, 0, 300])
    begins = np.concatenate([[0], counts.cumsum()])
    starts = rng.uniform(-1, 2, begins[-1])
    starts[-300:] = rng.choice([-5.0, 0.0, 0.3, 1.0], 300)  # The earlier one first.
    starts[-600:-300] = 10.0 ** rng.uniform(-9, 0, 300)
    names = rng.permutation(np.repeat(np.arange(9), counts))
    own, order = spans_loops.by_gap(names.astype(np.int32), 9)
    np.testing.assert_array_equal(own, begins)
    spans_loops.by_start(0, 9, begins, starts, order)
    np.testing.assert_array_equal(order, np.lexsort((np.arange(len(names)), starts, names)))


def test_patches_join_the_centres_between_which_they_go_on():
    part = np.full(SIZE, -1, np.int32)
    part[2:5, 2:6] = 0
    own = of([*quad(2.1, 2.1, 4.1, 4.9), (5.9, 2.1), (5.9, 4.9)], [(0, 1, 2), (0, 2, 3), (1, 4, 5), (1, 5, 2)])
    seen = [(x, y) for y, x in np.argwhere(part == 0) + 0.5]
    triangle = np.full(SIZE, -1, np.int32)
    for x, y in seen:
        left = x < 4.1
        below = (y - 2.1) / 2.8 > ((x - 2.1) / 2 if left else (x - 4.1) / 1.8)
        triangle[int(y), int(x)] = (1 if below else 0) if left else (3 if below else 2)
    met, joined = np.zeros((2, *SIZE), np.uint8), np.zeros((2, *SIZE), bool)
    fronts = Hits(read_only(part), read_only(triangle), read_only(5.0 * np.ones(SIZE)))
    own.mark_silhouettes(fronts, np.array([1.0, 0.0]), met)
    own.join(fronts, met, joined, colors=True)
    both = [(part >= 0) & (np.roll(part, -1, axis) >= 0) for axis in (1, 0)]
    np.testing.assert_array_equal(joined, both)


def test_patches_of_deeper_layers_are_walked_over_as_those_in_front():
    vertices, faces = icosphere(3)
    proxy, sampler = Proxy(3 * vertices.astype(np.float32), faces), rts.plugin("rts.samplers", "reference")()
    seen = sampler.rasterize(sampler.prepare(proxy), CAMERA, SIZE, 2, "none")
    own = SeenMesh.of(proxy, CAMERA, SIZE, "none")

    def joined(layers):
        triangle, depth = (np.concatenate([x[k] for k in layers]) for x in (seen.triangle_ids, seen.depth))
        part = np.where(triangle >= 0, 0, -1).astype(np.int32)
        hits, found = Hits(*map(read_only, (part, triangle, np.float64(depth)))), np.zeros((2, *part.shape), bool)
        own.join(hits, np.zeros((2, *SIZE), np.uint8), found, colors=True)
        return found

    both, front, back = joined([0, 1]), joined([0]), joined([1])
    np.testing.assert_array_equal(both, np.concatenate([front, back], axis=1))
    assert (front.sum(), back.sum()) == pytest.approx((48, 48), abs=8)


@pytest.mark.parametrize("colors", [False, True])
def test_patches_of_a_part_that_intersect_are_told_apart_by_colours_alone(colors):
    far = [(-60, -60), (60, -60), (1, 100)]
    vertices = np.array([(x, y, sign * 0.1 * x) for sign in (1, -1) for x, y in far], np.float32)
    own = SeenMesh.of(Proxy(vertices, np.array([(0, 1, 2), (3, 4, 5)], np.int32)), CAMERA, SIZE, "none")
    right = np.tile(np.arange(8) >= 4, (8, 1))
    fronts = Hits(*map(read_only, (np.zeros(SIZE, np.int32), np.where(right, 0, 1).astype(np.int32), np.ones(SIZE))))
    met, joined = np.zeros((2, *SIZE), np.uint8), np.zeros((2, *SIZE), bool)
    own.mark_silhouettes(fronts, np.array([1.0, 0.0]), met)
    own.join(fronts, met, joined, colors=colors)
    assert not met.any() and joined[1, :-1].all() and not joined[0, :, 7].any()
    np.testing.assert_array_equal(joined[0, :, :7].all(0), [True] * 3 + [not colors] + [True] * 3)
