"""Files: meshes and pictures come back as they were written, and what is damaged is refused or loads."""

import re
import warnings
from fractions import Fraction

import numpy as np
import pytest
import trimesh
from helpers import moved, samples_at
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image
from strategies import PROPERTIES, examples, reals, sizes, steps, table

import rts
from rts.files.srgb import decode_srgb, encode_srgb

pytestmark = pytest.mark.files

FEW, MANY = examples(0.25), examples(2)
HALF = 0.5 / 255 + 1e-6
"""By how much eight bits are off."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder that all examples write into, again and again."""
    return tmp_path_factory.mktemp("files")


def at_corners(part):
    """The G-buffer at the corners of each triangle, (T, 3, C) each."""
    tables = part.surface.proxy(part.theta["vertices"], None, (1, 1)).ids.reshape(len(part.surface.faces), -1, 3)
    # Barycentrics of zero give the last corner exactly.
    ids = np.stack([np.roll(tables, 2 - i, axis=2) for i in range(3)], axis=1).reshape(3 * len(tables), -1)
    gbuffer = part.surface.evaluate(part.theta, samples_at(ids, np.zeros((len(ids), 2), np.float32)))
    return {name: gbuffer[name].reshape(len(tables), 3, -1) for name in gbuffer}


def as_set(triangles):
    """Triangles (T, ...) in any order; those that repeat are counted."""
    return sorted(map(tuple, (np.asarray(triangles, np.float32) + 0.0).reshape(len(triangles), -1).tolist()))


def loaded(path, **options):
    """The parts of a file, and True if faces were left out or turned over."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        parts = rts.load(path, **options)
    told = [str(w.message) for w in caught]
    for text in told:
        assert re.search("faces (have the corners|are wound against|have no (texture coordinates|normals))", text), text
    return parts, any(re.search("have the corners|are wound against", text) for text in told)


def assert_same(found, expected, changed):
    """That triangles (T, 3, C) are as expected; if `changed`, in any direction, and once where several coincide."""
    found, expected = as_set(found), as_set(expected)
    if changed:
        found, expected = (
            {tuple(sorted(map(tuple, np.reshape(t, (3, -1)).tolist()))) for t in triangles}
            for triangles in (found, expected)
        )
    assert found == expected


def assert_sound(parts):
    """That nothing in the parts is NaN, and that faces refer to what is there."""
    assert parts
    for part in parts:
        part.surface.check(part.theta)
        for name, values in part.theta.items():
            assert np.isfinite(values).all(), name
        assert part.transform is None or np.isfinite(part.transform).all()


# --------------------------------------------------------------------------------------------------- OBJ

KINDS = {"v": 3, "vt": 2, "vn": 3}
STYLES = [("v",), ("v", "vt"), ("v", "vn"), ("v", "vt", "vn")]
EIGHTHS = st.integers(-40, 40).map(lambda n: f"{n / 8:g}")
NUMBERS = EIGHTHS | reals(-1e6, 1e6).map(repr) | st.sampled_from(["-0", "+.5", "1e-3", "1.0001"])
ASIDES = [
    "",
    "# f 1 2 3",
    "#",
    "o name",
    "g a b",
    "s 1",
    "\t ",
    "vp 0.5",
    "l 1 2",
    "usemtl a",
    "usemtl b",
    "curv 0 1 2",
]


@st.composite
def corners_in_words(draw, corner, counts):
    """A corner of a face, whose indices count from the first row or from the last so far."""
    v, vt, vn = (
        str(draw(st.sampled_from([corner[n] + 1, corner[n] - counts[n]]))) if n in corner else "" for n in KINDS
    )
    if vn:
        return f"{v}/{vt}/{vn}"
    return f"{v}/{vt}" if vt else draw(st.sampled_from([v, v + "/", v + "//"]))


@st.composite
def objs(draw, spaces=(" ", "  ", "\t", " \\\n")):
    """An OBJ as lines, the kinds of rows that all corners refer to, and its triangles: (T, 3, C) of each kind."""
    # Of few numbers, so that rows often coincide, or nearly so.
    numbers = st.sampled_from(draw(st.lists(NUMBERS, min_size=1, max_size=4)))
    space, extra = draw(st.sampled_from(spaces)), draw(st.sampled_from([[], ["1"]]))
    styles = draw(st.sampled_from([[style] for style in STYLES] + [STYLES]))
    rows, lines = {kind: [] for kind in KINDS}, []
    found, everywhere = {kind: [] for kind in KINDS}, set(KINDS)
    for _ in range(draw(st.integers(1, 4))):
        for kind, width in KINDS.items():
            for _ in range(draw(st.integers(0 if rows[kind] else 1, 3))):
                row = draw(st.lists(numbers, min_size=width, max_size=width))
                rows[kind].append([np.float32(x) for x in row])
                lines.append(space.join([kind, *row, *(extra if kind != "vn" else [])]))
        size, first = draw(st.integers(3, 6)), len(rows["v"])
        if size > 3:  # On a parabola, in order: any fan of these is right.
            for x in sorted(draw(st.lists(st.integers(-9, 9), min_size=size, max_size=size, unique=True))):
                rows["v"].append([np.float32(x), np.float32(x * x), np.float32(1)])
                lines.append(space.join(["v", f"{x}", f"{x * x}", "1", *extra]))
        lines.append(draw(st.sampled_from(ASIDES)))
        style, counts = draw(st.sampled_from(styles)), {kind: len(rows[kind]) for kind in KINDS}
        everywhere &= set(style)
        polygon = [{kind: draw(st.integers(0, counts[kind] - 1)) for kind in style} for _ in range(size)]
        if size > 3:
            polygon = [{**corner, "v": first + i} for i, corner in enumerate(polygon)]
        words = [draw(corners_in_words(corner, counts)) for corner in polygon]
        lines.append(space.join(["f", *words]) + draw(st.sampled_from(["", " ", " # end"])))
        for pair in zip(polygon[1:], polygon[2:], strict=False):
            for kind, values in found.items():
                values.append([rows[kind][corner[kind]] if kind in style else None for corner in (polygon[0], *pair)])
    return lines, everywhere, {kind: found[kind] for kind in everywhere}


def text_of(lines, end, last):
    """The lines as bytes, with ends of lines of one kind; the last may have none."""
    return (end.join(line.replace("\n", end) for line in lines) + last * end).encode()


def vertices_in(lines):
    return sum(line.split()[:1] == ["v"] for line in lines)


ENDS = st.sampled_from(["\n", "\r\n"]), st.booleans()
GAPS = pytest.mark.filterwarnings("ignore:.*faces have no (texture coordinates|normals)")
WOUND = pytest.mark.filterwarnings("ignore:across .* its triangles are wound against one another")


@GAPS
@WOUND
@MANY
@given(obj=objs(), end=ENDS[0], last=ENDS[1])
def test_an_obj_gives_its_triangles_however_it_is_written(folder, obj, end, last):
    lines, everywhere, expected = obj
    path = folder / "m.obj"
    path.write_bytes(text_of(lines, end, last))
    parts, changed = loaded(path)
    assert_sound(parts)
    found = [at_corners(part) for part in parts]
    assert_same(np.concatenate([f["position"] for f in found]), expected["v"], changed)
    for kind, (entry, name) in {"vt": ("uv", "uv"), "vn": ("normals", "normal")}.items():
        if kind in everywhere:
            both = [np.concatenate([f["position"], f[name]], axis=2) for f in found]
            wanted = np.concatenate([expected["v"], expected[kind]], axis=2)
            assert changed or as_set(np.concatenate(both)) == as_set(wanted)
        elif len(parts) == 1:
            # Faces without uv take (0, 0) where others have some.
            some = kind == "vt" and any(re.search(r"\d/-?\d", line) for line in lines if line.startswith("f"))
            assert (entry in parts[0].theta) == some


@GAPS
@WOUND
@PROPERTIES
@given(obj=objs(), end=ENDS[0], last=ENDS[1])
def test_merged_or_not_welded_the_triangles_of_an_obj_are_the_same(folder, obj, end, last):
    lines, _, expected = obj
    path = folder / "m.obj"
    path.write_bytes(text_of(lines, end, last))
    [merged], changed = loaded(path, merge=True)
    assert_same(at_corners(merged)["position"], expected["v"], changed)
    parts, changed = loaded(path, weld=False)
    for part in parts:
        assert part.theta["vertices"].shape == (vertices_in(lines), 3)
    assert_same(np.concatenate([at_corners(part)["position"] for part in parts]), expected["v"], changed)


@GAPS
@WOUND
@PROPERTIES
@given(obj=objs())
def test_no_two_vertices_of_a_welded_mesh_are_the_same_and_all_are_used(folder, obj):
    path = folder / "m.obj"
    path.write_bytes(text_of(obj[0], "\n", True))
    for part in loaded(path)[0]:
        vertices = part.theta["vertices"]
        assert len(set(map(tuple, vertices.tolist()))) == len(vertices)
        np.testing.assert_array_equal(np.unique(part.surface.faces), np.arange(len(vertices)))


@pytest.mark.parametrize("wrong", ["f 1 2", "f 0 1 1", "f 1 1 {last}", "f 1 1 -{first}", "f 1 1 x", "v 1 2", "v 1 2 x"])
@FEW
@given(obj=objs(), place=st.integers(0, 99))
def test_a_wrong_line_is_named_by_its_number(folder, wrong, obj, place):
    lines = obj[0]
    place %= len(lines) + 1
    number = 1 + sum(1 + line.count("\n") for line in lines[:place])
    path = folder / "m.obj"
    # Indices that are beyond the last row by one, or before the first.
    wrong = wrong.format(last=vertices_in(lines) + 1, first=vertices_in(lines[:place]) + 1)
    path.write_bytes(text_of([*lines[:place], wrong, *lines[place:]], "\n", True))
    with pytest.raises(rts.InputError) as error:
        rts.load(path)
    assert re.search(rf"m\.obj, line {number}: ", str(error.value))


# ---------------------------------------------------------------------------------------------- other formats


@st.composite
def meshes(draw):
    """Vertices (V, 3) that any format can hold, of which some may coincide, and faces (T, 3)."""
    count = draw(st.integers(3, 8))
    vertices = draw(steps((count, 3), -1, 1, step=Fraction(1, 2), dtype=np.float64))
    return vertices, draw(table(np.int64, (draw(st.integers(1, 8)), 3), st.integers(0, count - 1)))


def exported(mesh, kind):
    """The bytes of a file."""
    extension, _, encoding = kind.partition(" ")
    options = {"encoding": encoding} if extension == "ply" else {}
    extension = "stl_ascii" if kind == "stl ascii" else extension
    data = trimesh.Trimesh(*mesh, process=False).export(file_type=extension, **options)
    return data.encode() if isinstance(data, str) else data


FORMATS = ["ply ascii", "ply binary", "off", "stl", "stl ascii", "glb"]


def written(folder, kind, data):
    path = folder / f"m.{kind.partition(' ')[0]}"
    path.write_bytes(data)
    return path


@WOUND
@pytest.mark.parametrize("kind", FORMATS)
@FEW
@given(mesh=meshes())
def test_files_of_other_formats_give_their_triangles(folder, kind, mesh):
    parts, changed = loaded(written(folder, kind, exported(mesh, kind)))
    assert_sound(parts)
    vertices, faces = mesh
    assert_same(np.concatenate([at_corners(part)["position"] for part in parts]), vertices[faces], changed)
    if kind.startswith(("ply", "off")):
        [whole], _ = loaded(folder / f"m.{kind[:3]}", weld=False)
        np.testing.assert_array_equal(whole.theta["vertices"], vertices)


PLACED = st.tuples(meshes(), steps(3, -2, 2), st.sampled_from([-2.0, 0.5, 1.0]))


@WOUND
@PROPERTIES
@given(given=st.lists(PLACED, min_size=2, max_size=3))
def test_the_meshes_of_a_scene_are_where_it_puts_them_also_when_they_are_merged(folder, given):
    scene, expected = trimesh.Scene(), []
    for (vertices, faces), shift, scale in given:
        transform = np.diag([1, scale, 1, 1.0])
        transform[:3, 3] = shift
        scene.add_geometry(trimesh.Trimesh(vertices, faces, process=False), transform=transform)
        # What is mirrored is turned, so that its outside stays outside.
        expected.append((vertices * [1, scale, 1] + shift)[faces[:, ::-1] if scale < 0 else faces])
    [merged], changed = loaded(written(folder, "glb", scene.export(file_type="glb")), merge=True)
    assert_same(at_corners(merged)["position"], np.concatenate(expected), changed)
    parts, changed = loaded(folder / "m.glb")
    assert len(parts) == len(given)
    found = [moved(p.transform, x) if p.transform is not None else x for p in parts for x in at_corners(p)["position"]]
    unturned = [t[:, ::-1] if scale < 0 else t for t, (_, _, scale) in zip(expected, given, strict=True)]
    assert_same(found, np.concatenate(unturned), changed)


def test_merged_a_single_mesh_is_in_the_coordinates_of_the_scene(folder):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(), transform=trimesh.transformations.translation_matrix([2, 0, 0]))
    [part] = rts.load(written(folder, "glb", scene.export(file_type="glb")), merge=True)
    assert part.transform is None
    np.testing.assert_array_equal(np.unique(part.theta["vertices"][:, 0]), [1.5, 2.5])


# ------------------------------------------------------------------------------------------------- damage

OBJ = b"""# a mesh
mtllib m.mtl
v 0 0 0 1 0 0
v 1.5 0 0 0 1 0
v 1 1e0 0 0 0 1
v -1 .25 2 1 1 1
vt 0 0
vt 1 0.5
vn 0 0 1
usemtl a
f 1/1/1 2/2/1 3/-1/-1 4/1/1
usemtl b
f -4/1/1 -3/1/1 4/2/1
"""
MTL = b"newmtl a\nKd 0.5 0.25 1\nd 0.5\nnewmtl b\nmap_Kd -s 1 1 1 t.png\nTr 0.1\nbump -bm 0.5 t.png\n"
TWO = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0.5)], [(0, 1, 2), (1, 3, 2)]
SOUND = {kind: exported(TWO, kind) for kind in FORMATS}
RUNS = [
    b"nan",
    b"inf",
    b"1e99",
    b"-9",
    b"9",
    b".",
    b"/",
    b" ",
    b"\n",
    b"\\",
    b"#",
    b"\xff\xff\xff\x7f",
    b"\0\0\x80\x7f",
]


def damages(length):
    """Damages of a file: (cut at, [(place, bytes to put there), ...])."""
    places, runs = st.integers(0, length - 1), st.sampled_from(RUNS) | st.binary(min_size=1, max_size=4)
    return st.tuples(st.just(length) | places, st.lists(st.tuples(places, runs), max_size=4))


def damaged(data, damage):
    cut, replaced = damage
    data = bytearray(data)
    for place, run in replaced:
        data[place : place + len(run)] = run
    return bytes(data[:cut])


def assert_refused_or_sound(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # Of a material library that is not there.
        try:
            parts = rts.load(path, **options)
        except rts.InputError as error:
            assert "\n" not in str(error) and str(path.parent) in str(error)
            return
    assert_sound(parts)


@MANY
@given(damage=damages(len(OBJ)), of_materials=damages(len(MTL)), merge=st.booleans())
def test_a_damaged_obj_is_refused_or_loads(folder, damage, of_materials, merge):
    (folder / "m.mtl").write_bytes(damaged(MTL, of_materials))
    Image.new("RGB", (2, 2)).save(folder / "t.png")
    assert_refused_or_sound(written(folder, "obj", damaged(OBJ, damage)), merge=merge)


@pytest.mark.parametrize("kind", FORMATS)
@PROPERTIES
@given(data=st.data())
def test_a_damaged_file_is_refused_or_loads(folder, kind, data):
    damage = data.draw(damages(len(SOUND[kind])))
    assert_refused_or_sound(written(folder, kind, damaged(SOUND[kind], damage)))


@pytest.mark.parametrize("value", [b"nan", b"-inf", b"1e12"])
@pytest.mark.parametrize("kind", ["obj", "mtl", "ply ascii", "off", "stl ascii"])
def test_a_file_with_any_number_too_large_or_none_is_refused_or_loads(folder, kind, value):
    texts = {"obj": OBJ, "mtl": MTL, **SOUND}
    for number in re.finditer(rb"(?<=[ \n])[-+.\de]*\d(?=\s)", texts[kind]):
        changed = {**texts, kind: texts[kind][: number.start()] + value + texts[kind][number.end() :]}
        (folder / "m.mtl").write_bytes(changed["mtl"])
        Image.new("RGB", (2, 2)).save(folder / "t.png")
        read = "obj" if kind == "mtl" else kind
        assert_refused_or_sound(written(folder, read, changed[read]))


@pytest.mark.parametrize("rest, material", [(" 1e30 0 0", "0 0 0"), ("", "1e30 0 0"), ("", "0 1e200 0")])
def test_colours_too_large_for_float32_are_refused(folder, rest, material):
    (folder / "m.mtl").write_text(f"newmtl a\nKd {material}\n")
    rows = "".join(f"v {x}{rest}\n" for x in ("0 0 0", "1 0 0", "0 1 0"))
    path = written(folder, "obj", f"mtllib m.mtl\n{rows}usemtl a\nf 1 2 3\n".encode())
    for options in ({}, {"merge": True}, {"weld": False}):
        with pytest.raises(rts.InputError, match=r"m.obj: row 0 of colors?, as linear float32, is NaN or infinite"):
            rts.load(path, **options)


@MANY
@given(data=st.data(), picture=st.integers(0, 9))
def test_a_damaged_picture_is_refused_or_loads(folder, data, picture):
    path = folder / "damaged.png"
    rts.save_image(path, np.random.default_rng(picture).random((3, 4, 4)))
    whole = path.read_bytes()
    path.write_bytes(damaged(whole, data.draw(damages(len(whole)))))
    try:
        image = rts.load_image(path)
    except rts.InputError as error:
        assert "\n" not in str(error)
        return
    assert image.ndim == 3 and image.shape[2] == 4 and np.isfinite(image).all()


# ----------------------------------------------------------------------------------------------- pictures


@st.composite
def pictures(draw, channels):
    """(H, W, C), linear, from 0 to 1; premultiplied where there is alpha."""
    shape = *draw(sizes(5)), channels
    image = draw(hnp.arrays(draw(st.sampled_from([np.float32, np.float64])), shape, elements=st.floats(0, 1, width=32)))
    if channels == 4:
        image[..., :3] *= image[..., 3:]
    return image


def straight(image):
    """sRGB and alpha (H, W, 4) of a premultiplied linear image; black where alpha is zero."""
    alpha = image[..., 3:].astype(np.float64)
    color = np.divide(image[..., :3], alpha, out=np.zeros((*alpha.shape[:2], 3)), where=alpha > 0)
    return np.concatenate([encode_srgb(color), alpha], axis=2)


@PROPERTIES
@given(image=st.sampled_from([1, 3]).flatmap(pictures))
def test_opaque_pictures_come_back_to_half_a_step_of_eight_bits(folder, image):
    rts.save_image(folder / "a.png", image)
    found = rts.load_image(folder / "a.png")
    assert found.shape == (*image.shape[:2], 4) and found.dtype == np.float32
    expected = np.broadcast_to(image, (*image.shape[:2], 3))
    np.testing.assert_allclose(encode_srgb(found[..., :3]), encode_srgb(expected), rtol=0, atol=HALF)
    np.testing.assert_array_equal(found[..., 3], 1)


@PROPERTIES
@given(image=pictures(4))
def test_pictures_with_alpha_come_back_to_half_a_step_of_eight_bits(folder, image):
    rts.save_image(folder / "a.png", image)
    found, expected = straight(rts.load_image(folder / "a.png")), straight(image)
    np.testing.assert_allclose(found[..., 3], expected[..., 3], rtol=0, atol=HALF)
    seen = found[..., 3] > 0  # Where alpha rounds to zero, nothing is left of the colour.
    np.testing.assert_allclose(found[seen], expected[seen], rtol=0, atol=HALF)


@PROPERTIES
@given(image=st.sampled_from([3, 4]).flatmap(pictures))
def test_what_was_loaded_is_saved_as_the_same_picture(folder, image):
    rts.save_image(folder / "a.png", image)
    rts.save_image(folder / "b.png", rts.load_image(folder / "a.png"))
    first, second = (np.array(Image.open(folder / f"{name}.png").convert("RGBA")) for name in "ab")
    seen = first[..., 3] > 0
    np.testing.assert_array_equal(second[seen], first[seen])
    np.testing.assert_array_equal(second[..., 3], first[..., 3])


@PROPERTIES
@given(image=st.sampled_from([1, 3]).flatmap(pictures), beyond=reals(0, 1e6), seed=st.integers(0, 9))
def test_what_is_out_of_range_is_saved_as_black_or_white(folder, image, beyond, seed):
    side = np.random.default_rng(seed).integers(-1, 2, image.shape)
    rts.save_image(folder / "a.png", image + side * (1 + beyond))
    rts.save_image(folder / "b.png", np.where(side < 0, 0.0, np.where(side > 0, 1.0, image)))
    assert (folder / "a.png").read_bytes() == (folder / "b.png").read_bytes()


# ------------------------------------------------------------------------------------------------- sRGB

LINEAR = hnp.arrays(np.float64, st.tuples(st.integers(1, 5), st.integers(1, 4)), elements=reals(0, 4))


@PROPERTIES
@given(LINEAR)
def test_decoding_is_the_inverse_of_encoding(linear):
    encoded = np.concatenate([encode_srgb(linear[..., :3]), linear[..., 3:]], axis=-1)
    # The two pieces of the curve of the standard meet to 1e-7 only.
    np.testing.assert_allclose(decode_srgb(encoded), linear, rtol=1e-12, atol=1e-7)


@PROPERTIES
@given(LINEAR)
def test_brighter_is_encoded_as_brighter_and_one_as_one(linear):
    values = np.append(np.unique(linear), 5.0)
    assert (np.diff(encode_srgb(values)) >= 0).all()
    np.testing.assert_allclose(encode_srgb(np.array([0.0, 1.0])), [0, 1], atol=1e-12)
    np.testing.assert_array_equal(encode_srgb(values) <= 1, values <= 1)
