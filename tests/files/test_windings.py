"""Files whose faces are there twice, or are wound in different ways: they are loaded as the clean mesh is."""

import warnings

import numpy as np
import pytest
import trimesh
from helpers import CAMERA, SIZE, icosphere, show

import rts
from rts.errors import FileWarning

pytestmark = pytest.mark.files

RNG = np.random.default_rng(0)
BALL, FACES = icosphere(2)
COUNT = len(FACES)
TURNED = FACES[:, [0, 2, 1]]


def obj(folder, faces, vertices=BALL, more=()):
    rows = [*(f"v {x} {y} {z}" for x, y, z in vertices), *more, *("f " + " ".join(map(str, f + 1)) for f in faces)]
    path = folder / "m.obj"
    path.write_text("\n".join(rows))
    return path


def loaded(path, **options):
    """The only part of a file, and what is said of it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        [part] = rts.load(path, **options)
    return part, [str(w.message) for w in caught if issubclass(w.category, FileWarning)]


def shuffled(*tables):
    return RNG.permutation(np.concatenate(tables))


DOUBLE = {
    "outside first": np.concatenate([FACES, TURNED]),
    "inside first": np.concatenate([TURNED, FACES]),
    "in any order": shuffled(FACES, TURNED),
    "each direction twice": shuffled(FACES, TURNED, FACES[:, [1, 2, 0]], TURNED[:, [2, 0, 1]]),
}


@pytest.mark.parametrize("kind", DOUBLE)
def test_a_ball_with_double_faces_is_the_clean_ball(tmp_path, kind):
    part, [said] = loaded(obj(tmp_path, DOUBLE[kind]))
    assert f"{len(DOUBLE[kind]) - COUNT} of {len(DOUBLE[kind])} faces have the corners of another" in said
    assert "against their neighbours" not in said
    assert len(part.surface.faces) == COUNT
    np.testing.assert_allclose(part.surface.vertex_normals(part.theta["vertices"]), part.theta["vertices"], atol=0.02)


def test_a_picture_of_normals_of_a_ball_with_double_faces_is_that_of_the_clean_ball(tmp_path):
    shown = []
    for faces in (FACES, DOUBLE["in any order"]):
        part, _ = loaded(obj(tmp_path, faces))
        shown.append(show(part.replace(shader="normals"), CAMERA))
    assert (shown[0][..., 3] > 0.5).sum() > 20
    np.testing.assert_allclose(shown[1], shown[0], atol=1e-5)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.7])
@pytest.mark.parametrize("form", ["obj", "ply", "stl", "glb", "off"])
def test_a_ball_with_faces_turned_over_is_wound_as_its_outside(tmp_path, share, form):
    away = RNG.random(COUNT) < share
    faces = np.where(away[:, None], TURNED, FACES)
    path = tmp_path / f"m.{form}"
    trimesh.Trimesh(BALL, faces, process=False).export(path)
    part, [said] = loaded(path)
    assert f"{away.sum()} of {COUNT} faces are wound against their neighbours, and are turned over" in said
    np.testing.assert_allclose(part.surface.vertex_normals(part.theta["vertices"]), part.theta["vertices"], atol=0.02)


@pytest.mark.parametrize("faces", [FACES, TURNED, FACES[::3], FACES[: COUNT // 2]], ids=["out", "in", "some", "half"])
def test_what_is_wound_alike_stays_as_it_is_without_a_warning(tmp_path, faces):
    part, said = loaded(obj(tmp_path, faces), weld=False)
    assert not said
    np.testing.assert_array_equal(part.surface.faces, faces)


def test_each_patch_is_wound_as_its_outside_or_as_most_of_its_faces(tmp_path):
    sheet = np.array([(x, y, 5.0) for y in range(4) for x in range(4)])
    first = np.array([x + 4 * y for y in range(3) for x in range(3)])
    up = np.concatenate([np.stack([first, first + 1, first + 5], 1), np.stack([first, first + 5, first + 4], 1)])
    for wanted, other in ((up, up[:, ::-1]), (up[:, ::-1], up)):
        mixed = np.where((np.arange(18) % 3 == 0)[:, None], other, wanted)
        faces = np.concatenate([mixed + COUNT // 2 + 2, np.where((np.arange(COUNT) < 220)[:, None], TURNED, FACES)])
        part, [said] = loaded(obj(tmp_path, faces, np.concatenate([BALL, sheet])), weld=False)
        assert f"226 of {COUNT + 18} faces are wound against" in said
        a, b, c = np.moveaxis(part.theta["vertices"][part.surface.faces], 1, 0)
        np.testing.assert_array_equal(np.cross(b - a, c - a)[:18, 2], 1 if wanted is up else -1)
        assert (np.linalg.det(np.stack([a, b, c], 1))[18:] > 0).all()


def test_a_surface_with_one_side_stays_as_it_is(tmp_path):
    angle = 2 * np.pi * np.arange(12) / 12
    edges = [
        [(2 + s * np.cos(t / 2)) * np.cos(t), (2 + s * np.cos(t / 2)) * np.sin(t), s * np.sin(t / 2)]
        for t in angle
        for s in (-0.5, 0.5)
    ]
    quads = [(2 * i, 2 * i + 1, 2 * i + 3, 2 * i + 2) for i in range(11)] + [(22, 23, 0, 1)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    part, said = loaded(obj(tmp_path, faces, np.array(edges)), weld=False)
    assert not said
    np.testing.assert_array_equal(part.surface.faces, faces)


def test_normals_of_the_file_tell_the_sides_of_faces(tmp_path):
    normals = [f"vn {x} {y} {z}" for x, y, z in BALL]
    mixed = np.where((np.arange(COUNT) % 2 == 0)[:, None], TURNED, FACES)
    lines = [*(f"v {x} {y} {z}" for x, y, z in BALL), *normals]
    for faces, kept in ((mixed, mixed), (np.concatenate([FACES, mixed]), FACES)):
        path = tmp_path / "m.obj"
        path.write_text("\n".join(lines + ["f " + " ".join(f"{v + 1}//{v + 1}" for v in f) for f in faces]))
        part, said = loaded(path, weld=False)
        np.testing.assert_array_equal(part.surface.faces, kept)
        assert "turned over" not in "".join(said) and len(said) == (len(faces) > COUNT)


def test_faces_that_are_seen_from_their_own_side_alone_keep_their_opposites(tmp_path):
    faces = np.concatenate([FACES, TURNED, FACES])
    part, [said] = loaded(obj(tmp_path, faces), cull="back")
    assert f"{COUNT} of {3 * COUNT} faces have the corners" in said and part.cull == "back"
    assert len(part.surface.faces) == 2 * COUNT
    inside = rts.Camera.look_at((0, 0, 0), (0, 0, 1))
    far, near = (show(part.replace(shader="silhouette"), camera) for camera in (CAMERA, inside))
    assert (far[..., 3] > 0.5).sum() > 20 and (near[..., 3] > 0.99).all()


@pytest.mark.parametrize("form", ["obj", "ply", "off"])
@pytest.mark.parametrize("roll", range(5))
def test_polygons_that_are_there_twice_are_cut_along_the_same_diagonals(tmp_path, form, roll):
    # The two sides of a pentagon, and of polygons with notches.
    pentagon = [(np.cos(t), np.sin(t), 0) for t in 2 * np.pi * np.arange(5) / 5]
    dart, other = (
        [(3, 0, 0), (5, -2, 0), (4, 0, 0), (5, 2, 0)],
        [(8, 0, 0), (9, -3, 0), (8.5, 0, 0), (9, 3, 0), (7, 2, 0)],
    )
    points = [*pentagon, *dart, *other]
    polygons = [[0, 1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12, 13]]
    both = polygons + [np.roll(p, roll)[::-1].tolist() for p in polygons]
    text = {
        "obj": ["v {} {} {}".format(*p) for p in points] + ["f " + " ".join(str(i + 1) for i in p) for p in both],
        "off": ["OFF", f"{len(points)} {len(both)} 0", *("{} {} {}".format(*p) for p in points)]
        + [f"{len(p)} " + " ".join(map(str, p)) for p in both],
    }
    text["ply"] = [
        *["ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property double {x}" for x in "xyz")],
        *[f"element face {len(both)}", "property list uchar int vertex_indices", "end_header", *text["off"][2:]],
    ]
    (tmp_path / f"m.{form}").write_text("\n".join(text[form]) + "\n")
    part, [said] = loaded(tmp_path / f"m.{form}")
    assert "8 of 16 faces have the corners of another" in said and len(part.surface.faces) == 8


def test_what_corners_have_goes_with_them(tmp_path):
    # Each corner has uv of its own, which tell its face and its place there.
    uv = np.stack([np.repeat(np.arange(COUNT), 3), np.tile(np.arange(3), COUNT)], axis=1)
    rows = [f"vt {u} {v}" for u, v in uv]
    corners = np.stack([FACES + 1, np.arange(3 * COUNT).reshape(-1, 3) + 1], axis=2)
    corners[::2] = corners[::2, [0, 2, 1]]
    lines = [*(f"v {x} {y} {z}" for x, y, z in BALL), *rows]
    path = tmp_path / "m.obj"
    path.write_text("\n".join(lines + ["f " + " ".join(f"{v}/{t}" for v, t in f) for f in corners]))
    part, [said] = loaded(path)
    assert "160 of 320 faces are wound against" in said
    proxy = part.surface.proxy(part.theta["vertices"], None, SIZE)
    at = part.theta["uv"][proxy.ids[:, 3:]]
    np.testing.assert_array_equal(at[:, :, 0], np.repeat(np.arange(COUNT)[:, None], 3, axis=1))
    wanted = BALL[FACES[at[:, :, 0].astype(int), at[:, :, 1].astype(int)]]
    np.testing.assert_allclose(part.theta["vertices"][part.surface.faces], wanted, atol=1e-6)


def test_a_ball_with_the_inside_out_and_a_double_face_keeps_its_sides(tmp_path):
    part, [said] = loaded(obj(tmp_path, np.concatenate([TURNED, FACES[:1]])))
    assert f"1 of {COUNT + 1} faces have the corners of another one" in said
    np.testing.assert_array_equal(np.sort(part.surface.faces, 1), np.sort(TURNED, 1))
    normals = part.surface.vertex_normals(part.theta["vertices"])
    np.testing.assert_allclose(normals, -part.theta["vertices"], atol=0.02)


@pytest.mark.parametrize("away", [[4], [4, 5], [0, 7]])
def test_a_room_seen_from_inside_with_some_faces_turned_over_stays_a_room(tmp_path, away):
    """Most of its faces point inwards, so all do, whether the file has triangles or the two of a wall."""
    room = trimesh.creation.box()
    faces = room.faces[:, ::-1].copy()
    mixed = faces.copy()
    mixed[away] = mixed[away][:, ::-1]
    part, [said] = loaded(obj(tmp_path, mixed, room.vertices))
    assert f"{len(away)} of 12 faces are wound against their neighbours" in said
    corners = part.theta["vertices"][part.surface.faces]
    assert (np.linalg.det(corners) <= 0).all() and np.linalg.det(corners).sum() == pytest.approx(-6)
