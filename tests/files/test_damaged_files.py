"""Files that were damaged: what is no longer what it says is refused or warned of; whatever is left does no harm."""

import json
import re
import struct
import tracemalloc
import warnings

import numpy as np
import pytest
import trimesh

import rts

pytestmark = pytest.mark.files

SEEDS = range(30)


def grid(quads):
    """A wavy square of 4 x 4 cells: vertices (25, 3), and triangles, or quads as well."""
    i, j = (x.reshape(-1) for x in np.indices((4, 4)))
    corners = np.stack([5 * i + j, 5 * i + j + 5, 5 * i + j + 6, 5 * i + j + 1], axis=1)
    y, x = np.indices((5, 5)) / 4.0
    vertices = np.stack([x, y, np.round(0.1 * np.sin(5 * x + 3 * y), 4)], axis=2).reshape(-1, 3)
    triangles = np.concatenate([corners[8 * quads :, [0, 1, 2]], corners[8 * quads :, [0, 2, 3]]])
    return vertices, [*corners[: 8 * quads].tolist(), *triangles.tolist()]


def rows(values):
    return "".join(" ".join(f"{x:g}" for x in row) + "\n" for row in values)


def ply_header(layout, vertices, faces):
    return (
        f"ply\nformat {layout} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    )


def made(kind):
    """The bytes of a sound file."""
    vertices, faces = grid(quads=kind in ("obj", "ply ascii", "ply binary", "off"))
    counted = [[len(f), *f] for f in faces]
    if kind == "obj":
        lines = [f"v {x:g} {y:g} {z:g}\n" for x, y, z in vertices]
        return "".join(lines + ["f " + " ".join(str(i + 1) for i in f) + "\n" for f in faces]).encode()
    if kind == "ply ascii":
        return (ply_header("ascii", len(vertices), len(faces)) + rows(vertices) + rows(counted)).encode()
    if kind == "ply binary":
        header = ply_header("binary_little_endian", len(vertices), len(faces)).encode()
        lists = b"".join(struct.pack(f"<B{len(f)}i", len(f), *f) for f in faces)
        return header + vertices.astype("<f4").tobytes() + lists
    if kind == "off":
        return f"OFF\n{len(vertices)} {len(faces)} 0\n{rows(vertices)}{rows(counted)}".encode()
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if kind == "gltf":
        files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh), embed_buffers=True)
        return files["model.gltf"]
    data = mesh.export(file_type={"stl ascii": "stl_ascii"}.get(kind, kind))
    return data.encode() if isinstance(data, str) else data


KINDS = ["obj", "ply ascii", "ply binary", "off", "stl", "stl ascii", "glb", "gltf"]
SOUND = {kind: made(kind) for kind in KINDS}


def loaded(folder, kind, data):
    """The parts, or None where they were refused, and the warnings; nothing else may happen."""
    path = folder / f"m.{kind.partition(' ')[0]}"
    path.write_bytes(data)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            parts = rts.load(path)
        except rts.InputError as error:
            parts = None
            assert "\n" not in str(error) and str(path) in str(error)
    for warning in caught:
        assert issubclass(warning.category, UserWarning) and str(path) in str(warning.message), warning.message
    for part in parts or []:
        part.surface.check(part.theta)
        assert all(np.isfinite(values).all() for values in part.theta.values())
    return parts, [str(w.message) for w in caught]


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_damaged_below_loads_when_it_is_not(tmp_path, kind):
    parts, said = loaded(tmp_path, kind, SOUND[kind])
    assert len(parts[0].surface.faces) == 32 and len(parts[0].theta["vertices"]) == 25 and not said


# --------------------------------------------------------------------------------------- damage to the structure


def any_of(random, values):
    return values[random.integers(len(values))]


def split_lines(data, pattern):
    """The lines of a text, and the places of those that begin with the pattern."""
    lines = data.decode().splitlines(keepends=True)
    return lines, [i for i, line in enumerate(lines) if re.match(pattern, line)]


ROW = {"obj": "[vf] ", "ply ascii": r"[-\d]", "off": r"[-\d]", "stl ascii": r"vertex"}


def without_a_number(random, kind, data):
    """A row that lacks its last number; in an OBJ a triangle, since a quad would become one."""
    pattern = r"v |f( \d+){3}$" if kind == "obj" else ROW[kind]
    lines, places = split_lines(data, pattern)
    if kind == "off":  # The count of edges may be missing.
        places = places[1:]
    place = any_of(random, places)
    lines[place] = lines[place].rsplit(None, 1)[0] + "\n"
    return "".join(lines).encode()


def with_a_number_more(random, kind, data):
    lines, places = split_lines(data, "v " if kind == "obj" else ROW[kind])
    more = " 0 0" if kind == "obj" else " 0"  # One more is a weight.
    # A vertex of an OFF may have other numbers after its coordinates, if all have.
    place = any_of(random, places)
    lines[place] = lines[place].rstrip("\n") + more + "\n"
    return "".join(lines).encode()


def with_another_number(text):
    def change(random, kind, data):
        lines, places = split_lines(data, ROW[kind])
        place = any_of(random, places)
        words = lines[place].split()
        first = 0 if kind in ("ply ascii", "off") else 1
        words[random.integers(first, len(words))] = text
        lines[place] = " ".join(words) + "\n"
        return "".join(lines).encode()

    return change


def with_an_index_beyond(random, kind, data):
    lines, places = split_lines(data, "f ")
    place = any_of(random, places)
    words = lines[place].split()
    words[random.integers(1, len(words))] = any_of(random, ["0", "26", "-26", "99999999999999999999"])
    lines[place] = " ".join(words) + "\n"
    return "".join(lines).encode()


def without_a_line(random, kind, data):
    lines, places = split_lines(data, r"[-\dvefo]" if kind == "stl ascii" else ROW[kind])
    place = any_of(random, places)
    return "".join(lines[:place] + lines[place + 1 :]).encode()


def with_a_line_twice(random, kind, data):
    lines, places = split_lines(data, r"[-\dvefo]" if kind == "stl ascii" else ROW[kind])
    place = any_of(random, places)
    return "".join(lines[: place + 1] + lines[place:]).encode()


def with_another_count(random, kind, data):
    """One of the counts of the header is too high or too low by some."""
    by = int(any_of(random, [-7, -2, -1, 1, 2, 300, 4_000_000_000]))
    if kind == "stl":
        [count] = struct.unpack_from("<I", data, 80)
        return data[:80] + struct.pack("<I", min(count + max(by, -count), 2**32 - 1)) + data[84:]
    end = data.index(b"end_header") if kind.startswith("ply") else 12
    counts = list(re.finditer(rb"(?<=vertex )\d+|(?<=face )\d+|(?<=\n)\d+|(?<=\d )\d+(?= 0\n)", data[:end]))
    found = any_of(random, counts)
    return data[: found.start()] + str(max(int(found[0]) + by, 0)).encode() + data[found.end() :]


def cut_short(random, kind, data):
    """The first part of a file, such that something of what it promises is missing."""
    if kind == "obj":  # It promises nothing: only a line that breaks off can tell.
        lines, places = split_lines(data, r"v |f( \d+){3}$")
        place = any_of(random, places)
        return "".join(lines[:place] + [lines[place].rsplit(None, 1)[0]]).encode()
    end = data.rstrip().rfind(b"\n") if kind in ("ply ascii", "off") else len(data) - 12
    return data[: random.integers(0, end)]


def with_more_at_the_end(random, kind, data):
    return data + bytes(random.integers(1, 255, random.integers(1, 60), dtype=np.uint8)) + b"x"


def packed(random, kind, data):
    """A binary file one of whose indices, coordinates or lengths of lists is none."""
    data = bytearray(data)
    if kind == "stl":
        place, bad = 84 + 50 * random.integers(32) + 12 + 4 * random.integers(9), struct.pack("<f", np.nan)
    elif kind == "ply binary":
        start = data.index(b"end_header\n") + 11
        places = [start + 300 + 17 * i for i in range(8)]  # Those of quads.
        place, bad = any_of(
            random,
            [
                (start + 4 * random.integers(75), struct.pack("<f", np.inf)),
                (
                    any_of(random, places) + 1 + 4 * random.integers(4),
                    struct.pack("<i", any_of(random, [-1, 25, 10**9])),
                ),
                (any_of(random, places), any_of(random, [b"\0", b"\1", b"\2", b"\3", b"\5", b"\xff"])),
            ],
        )
    data[place : place + len(bad)] = bad
    return bytes(data)


def with_tree(data, change):
    """A GLB or glTF with a changed tree."""
    if data[:4] != b"glTF":
        tree = json.loads(data)
        change(tree)
        return json.dumps(tree).encode()
    [length] = struct.unpack_from("<I", data, 12)
    tree = json.loads(data[20 : 20 + length])
    change(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def in_the_tree(random, kind, data):
    def change(tree):
        accessor = any_of(random, tree["accessors"])
        view = any_of(random, tree["bufferViews"])
        primitive = tree["meshes"][0]["primitives"][0]
        any_of(
            random,
            [
                lambda: accessor.update(count=accessor["count"] + any_of(random, [1, 2, 300, 2**40])),
                lambda: accessor.update(count=any_of(random, [-1, "3", None, 1.5])),
                lambda: accessor.update(bufferView=7),
                lambda: accessor.update(componentType=1),
                lambda: accessor.update(byteOffset=50),
                lambda: accessor.update(count=2**33) or accessor.pop("bufferView"),
                lambda: view.update(byteLength=view["byteLength"] + any_of(random, [400, 10**12])),
                lambda: view.update(byteOffset=10**6),
                lambda: view.update(buffer=3),
                lambda: primitive.update(indices=9),
                lambda: primitive["attributes"].update(POSITION=primitive["indices"]),
                lambda: tree["nodes"].append({"children": [len(tree["nodes"])]}),
                lambda: tree["buffers"][0].update(byteLength=10**12),
                lambda: tree.pop(any_of(random, ["accessors", "bufferViews", "buffers", "meshes"])),
            ],
        )()

    return with_tree(data, change)


TEXT = [
    without_a_number,
    with_another_number("nan"),
    with_another_number("1e99"),
    with_another_number("x"),
    with_another_number("1_0"),
    with_another_number("1,5"),
    cut_short,
]
PROMISED = [with_a_number_more, without_a_line, with_a_line_twice, with_more_at_the_end]
DAMAGES = {
    "obj": [*TEXT, with_a_number_more, with_an_index_beyond, with_an_index_beyond],
    "ply ascii": [*TEXT, *PROMISED, with_another_count],
    "ply binary": [with_another_count, cut_short, with_more_at_the_end, packed, packed],
    "off": [*TEXT, *PROMISED, with_another_count],
    "stl": [with_another_count, cut_short, with_more_at_the_end, packed],
    "stl ascii": [*TEXT, *PROMISED],
    "glb": [in_the_tree, in_the_tree, in_the_tree, cut_short, with_more_at_the_end],
    "gltf": [in_the_tree, in_the_tree, in_the_tree, cut_short, with_more_at_the_end],
}


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_file_whose_structure_is_damaged_is_refused_or_warned_of(tmp_path, kind, seed):
    random = np.random.default_rng([seed, KINDS.index(kind)])
    damage = DAMAGES[kind][seed % len(DAMAGES[kind])]
    data = damage(random, kind, SOUND[kind])
    assert data != SOUND[kind]
    parts, said = loaded(tmp_path, kind, data)
    assert parts is None or said, damage.__qualname__


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_file_with_bits_turned_is_refused_or_does_no_harm(tmp_path, kind, seed):
    random = np.random.default_rng([seed, 99, KINDS.index(kind)])
    data = np.frombuffer(SOUND[kind], np.uint8).copy()
    for place in random.integers(0, len(data), 1 + seed % 4):
        data[place] ^= 1 << random.integers(8)
    loaded(tmp_path, kind, data.tobytes())


def promising(kind):
    """A file that promises some milliards of rows, or of entries in a list, or names no data for them."""
    vertices, faces = ply_header("binary_little_endian", 4_000_000_000, 1), ply_header("ascii", 3, 4_000_000_000)
    lists = ply_header("binary_little_endian", 3, 1).replace("uchar int", "uint int").encode()

    def change(tree):
        tree["accessors"][0] = {"componentType": 5125, "type": "SCALAR", "count": 4_000_000_000}

    return {
        "ply": [vertices.encode() + bytes(100), faces.encode() + b"0 0 0\n" * 4, lists + bytes(36) + b"\xff" * 8],
        "off": [b"OFF\n4000000000 1 0\n0 0 0\n", b"OFF\n1 1 0\n0 0 0\n4000000000 0 0 0\n"],
        "stl": [bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(100)],
        "glb": [
            with_tree(SOUND["glb"], change),
            SOUND["glb"][:12] + b"\xff\xff\xff\xff" + SOUND["glb"][16:],
            SOUND["glb"][:8] + b"\xff\xff\xff\xff" + SOUND["glb"][12:],
        ],
    }[kind]


@pytest.mark.parametrize("kind", ["ply", "off", "stl", "glb"])
def test_what_a_file_promises_is_not_believed_before_it_is_seen(tmp_path, kind):
    loaded(tmp_path, kind, SOUND.get(kind, SOUND["ply ascii"]))  # What is imported for it takes memory, too.
    for data in promising(kind):
        tracemalloc.start()
        parts, _ = loaded(tmp_path, kind, data)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert parts is None and peak < 10_000_000
