"""Polygons of model files: triangles that cover them once, in every format."""

import struct

import numpy as np
import pytest
from helpers import rotation
from hypothesis import given
from hypothesis import strategies as st
from strategies import PROPERTIES, examples

import rts
from rts.files.polygons import cut

pytestmark = pytest.mark.files

ARROW = [(2, 2), (1, 0.5), (0, 2), (0, 0), (2, 0)]
"""A square of side 2 with a notch, of area 2.5; its fan about the first corner covers 5.5."""


def normals_of(points, triangles):
    """Normals of triangles, as long as twice their areas."""
    a, b, c = np.moveaxis(np.asarray(points, float)[triangles], 1, 0)
    return np.cross(b - a, c - a)


def area(part):
    return np.linalg.norm(normals_of(part.theta["vertices"], part.surface.faces), axis=1).sum() / 2


def flat(points):
    return np.column_stack([np.asarray(points, float), np.zeros(len(points))])


def one(points):
    """The triangles of one polygon, and whether nothing but a fan was left."""
    triangles, owner, forced = cut(points, np.arange(len(points)), np.array([len(points)]))
    assert (owner == 0).all()
    return triangles, forced


def fan(count):
    return [[0, i, i + 1] for i in range(1, count - 1)]


def winding(polygon, points):
    """Winding numbers of a polygon (n, 2) about points (P, 2)."""
    to = polygon[None] - points[:, None]
    following = np.roll(to, -1, axis=1)
    cross = to[..., 0] * following[..., 1] - to[..., 1] * following[..., 0]
    return np.round(np.arctan2(cross, (to * following).sum(axis=2)).sum(axis=1) / (2 * np.pi)).astype(int)


def assert_covered_once(polygon, triangles, seed=0):
    """Assert that points inside a polygon (n, 2) are in one triangle each, others in none, and all corners are used."""
    assert len(triangles) == len(polygon) - 2
    np.testing.assert_array_equal(np.unique(triangles), np.arange(len(polygon)))
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    points = np.random.default_rng(seed).uniform(low - 0.1, high + 0.1, (200, 2))
    in_triangles = sum(winding(polygon[t], points) for t in triangles)
    np.testing.assert_array_equal(in_triangles, winding(polygon, points))


def stars(random, count):
    """A polygon (n, 2) around the origin, in either direction, from any of its corners."""
    while True:
        angles = np.sort(random.uniform(0, 2 * np.pi, count))
        if np.diff(np.append(angles, angles[0] + 2 * np.pi)).max() < np.pi - 0.1:
            break
    points = random.uniform(0.1, 1, count)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.roll(points, random.integers(count), axis=0)[:: random.choice([1, -1])]


SEEDS = st.integers(0, 10**6)
MANY = examples(3.3)


@MANY
@given(seed=SEEDS, count=st.integers(4, 14))
def test_a_concave_polygon_is_covered_once_whatever_its_direction(seed, count):
    polygon = stars(np.random.default_rng(seed), count)
    triangles, forced = one(flat(polygon))
    assert forced == 0
    assert_covered_once(polygon, triangles, seed)


@MANY
@given(seed=SEEDS, count=st.integers(3, 7))
def test_a_skyline_with_corners_on_its_edges_is_covered_once(seed, count):
    random = np.random.default_rng(seed)
    tops = np.repeat(random.integers(1, 6, count), 2)
    across = np.repeat(np.arange(count + 1), 2)[1:-1]
    ground = [(i, 0) for i in range(count + 1)]
    polygon = np.array([*ground, *zip(across[::-1], tops[::-1], strict=True)], float)
    polygon = np.roll(polygon, random.integers(len(polygon)), axis=0)
    triangles, forced = one(flat(polygon))
    assert forced == 0
    assert_covered_once(polygon, triangles, seed)


@PROPERTIES
@given(seed=SEEDS, count=st.integers(4, 10))
def test_polygons_anywhere_in_space_keep_their_direction(seed, count):
    random = np.random.default_rng(seed)
    polygon = stars(random, count)
    turned = 1e3 * (
        flat(polygon) @ np.asarray(rotation(random.normal(size=3), random.uniform(0, 360))).T + random.normal(size=3)
    )
    triangles, forced = one(turned)
    whole = np.cross(turned - turned[0], np.roll(turned, -1, axis=0) - turned[0]).sum(axis=0)
    assert forced == 0
    towards = normals_of(turned, triangles) @ whole / (whole @ whole)
    assert towards.min() > -1e-9 and towards.sum() == pytest.approx(1)


@PROPERTIES
@given(seed=SEEDS, count=st.integers(3, 10))
def test_a_convex_polygon_is_the_fan_about_its_first_corner(seed, count):
    random = np.random.default_rng(seed)
    angles = np.sort(random.uniform(0, 2 * np.pi, count))
    round_ = (
        flat(np.stack([np.cos(angles), np.sin(angles)], axis=1))
        @ np.asarray(rotation(random.normal(size=3), random.uniform(0, 360))).T
    )
    assert one(round_)[0].tolist() == fan(count)
    assert one(round_[::-1])[0].tolist() == fan(count)


@pytest.mark.parametrize("count", [4, 5, 9])
def test_what_has_no_area_or_is_bent_or_not_finite_is_a_fan(count):
    line = np.outer(np.arange(count), [1.0, 2, 3])
    assert one(line)[0].tolist() == fan(count)
    assert one(np.ones((count, 3)))[0].tolist() == fan(count)
    for bad in (np.nan, np.inf, 1e200):
        strange = flat(stars(np.random.default_rng(count), count))
        strange[1, 0] = bad
        assert len(one(strange)[0]) == count - 2
    saddle = np.array([(0, 0, 0), (1, 0, 1), (1, 1, 0), (0, 1, 1.0)])
    assert one(saddle)[0].tolist() == fan(4)


def test_a_notch_that_is_bent_out_of_its_plane_has_triangles_that_meet_at_it():
    points = flat(ARROW)
    points[1, 2] = 0.2
    triangles, forced = one(points)
    assert forced == 0
    assert_covered_once(np.array(ARROW, float), triangles)


def test_each_polygon_has_its_triangles_in_its_place():
    points = np.concatenate([flat(ARROW), flat([(0, 0), (1, 0), (1, 1), (0, 1)]) + [5, 5, 5]])
    corners = np.array([5, 6, 7, 8, 0, 1, 2, 3, 4, 6, 7, 8])
    triangles, owner, forced = cut(points, corners, np.array([4, 5, 3]))
    assert owner.tolist() == [0, 0, 1, 1, 1, 2] and forced == 0
    assert triangles[:2].tolist() == [[0, 1, 2], [0, 2, 3]] and triangles[5].tolist() == [9, 10, 11]
    assert_covered_once(np.array(ARROW, float), triangles[2:5] - 4)


# ------------------------------------------------------------------------------------------------- in files


def rows(points):
    return "".join(f"{x} {y} 0\n" for x, y in points)


HEADER = (
    "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    "{}element face {}\nproperty list uchar int vertex_indices\n{}end_header\n"
)


def written(folder, kind, points, faces):
    path = folder / f"m.{kind.partition(' ')[0]}"
    if kind == "obj":
        lines = [f"v {x} {y} 0\n" for x, y in points] + ["f " + " ".join(str(i + 1) for i in f) + "\n" for f in faces]
        path.write_text("".join(lines))
        return path
    listed = "".join(" ".join(map(str, [len(f), *f])) + "\n" for f in faces)
    if kind == "off":
        path.write_text(f"OFF\n{len(points)} {len(faces)} 0\n{rows(points)}{listed}")
    elif kind == "ply ascii":
        path.write_text(HEADER.format("ascii", len(points), "", len(faces), "") + rows(points) + listed)
    else:
        order, layout = (">", "binary_big_endian") if "big" in kind else ("<", "binary_little_endian")
        data = HEADER.format(layout, len(points), "", len(faces), "").encode()
        data += flat(points).astype(order + "f4").tobytes()
        path.write_bytes(data + b"".join(struct.pack(f"{order}B{len(f)}i", len(f), *f) for f in faces))
    return path


FORMATS = ["obj", "ply ascii", "ply binary", "ply big", "off"]


@pytest.mark.parametrize("kind", FORMATS)
def test_a_concave_polygon_of_a_file_has_the_area_that_it_ought_to(tmp_path, kind):
    for shift in range(5):
        face = np.roll(np.arange(5), shift).tolist()
        [part] = rts.load(written(tmp_path, kind, ARROW, [face]))
        assert area(part) == pytest.approx(2.5)
        [turned] = rts.load(written(tmp_path, kind, ARROW, [face[::-1]]))
        assert area(turned) == pytest.approx(2.5)
        up = [normals_of(p.theta["vertices"], p.surface.faces)[:, 2] for p in (part, turned)]
        assert (up[0] > 0).all() and (up[1] < 0).all()


@pytest.mark.parametrize("kind", FORMATS)
def test_triangles_quads_and_others_may_stand_in_one_file(tmp_path, kind):
    points = [*ARROW, (3, 0), (3, 2), (4, 0)]
    [part] = rts.load(written(tmp_path, kind, points, [[4, 5, 6, 0], [0, 1, 2, 3, 4], [5, 7, 6]]), weld=False)
    assert area(part) == pytest.approx(2 + 2.5 + 1)
    assert part.surface.faces[:2].tolist() == [[4, 5, 6], [4, 6, 0]]
    assert part.surface.faces[5].tolist() == [5, 7, 6]
    np.testing.assert_array_equal(part.theta["vertices"], flat(points))


@pytest.mark.parametrize("kind", FORMATS)
def test_a_polygon_that_crosses_itself_is_warned_of(tmp_path, kind):
    pentagram = [(np.sin(a).round(3), np.cos(a).round(3)) for a in 0.8 * np.pi * np.arange(5)]
    path = written(tmp_path, kind, pentagram, [[0, 1, 2, 3, 4]])
    with pytest.warns(UserWarning, match=r"m\.\w+: 1 polygons cross themselves"):
        [part] = rts.load(path)
    assert len(part.surface.faces) == 3


def test_uv_and_normals_of_an_obj_go_with_the_corners_of_a_polygon(tmp_path):
    corners = "".join(f"v {x} {y} 0\nvt {x / 2} {y / 2}\n" for x, y in ARROW)
    (tmp_path / "m.obj").write_text(corners + "f 1/1 2/2 3/3 4/4 5/5\n")
    [part] = rts.load(tmp_path / "m.obj")
    np.testing.assert_allclose(2 * part.theta["uv"], part.theta["vertices"][:, :2])


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian"])
def test_colours_of_faces_of_a_ply_go_with_their_triangles(tmp_path, layout):
    colors = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    header = HEADER.format(layout, 6, "", 2, colors)
    points, faces = [*ARROW, (3, 2)], [([0, 1, 2, 3, 4], (255, 0, 0)), ([4, 5, 0], (0, 255, 0))]
    if layout == "ascii":
        data = (
            header + rows(points) + "".join(f"{len(f)} {' '.join(map(str, [*f, *c]))}\n" for f, c in faces)
        ).encode()
    else:
        data = header.encode() + flat(points).astype("<f4").tobytes()
        data += b"".join(struct.pack(f"<B{len(f)}i3B", len(f), *f, *c) for f, c in faces)
    (tmp_path / "m.ply").write_bytes(data)
    [part] = rts.load(tmp_path / "m.ply")
    assert area(part) == pytest.approx(2.5 + 1)
    camera = rts.Camera.orthographic((2, 1, 2), (2, 1, 0), height=4.0, far=10.0)
    image = rts.render(part.replace(shader="unlit"), camera, (16, 16), splatter="none")
    # Of each colour there is as much as its faces cover, on a pixel of a quarter.
    assert image[..., 0].sum() / 16 == pytest.approx(2.5, abs=0.4)
    assert image[..., 1].sum() / 16 == pytest.approx(1, abs=0.4)


def test_texture_coordinates_of_the_corners_of_a_ply_go_with_them(tmp_path):
    header = HEADER.format("ascii", 5, "", 1, "property list uchar float texcoord\n")
    uv = " ".join(f"{x / 2} {y / 2}" for x, y in ARROW)
    (tmp_path / "m.ply").write_text(f"{header}{rows(ARROW)}5 0 1 2 3 4 10 {uv}\n")
    [part] = rts.load(tmp_path / "m.ply")
    assert area(part) == pytest.approx(2.5)
    np.testing.assert_allclose(2 * part.theta["uv"], part.theta["vertices"][:, :2])
    (tmp_path / "m.ply").write_text(f"{header}{rows(ARROW)}5 0 1 2 3 4 2 0 0\n")
    with pytest.warns(UserWarning, match="texcoord has not two numbers for each corner"):
        [part] = rts.load(tmp_path / "m.ply")
    assert "uv" not in part.theta
