"""Files that promise more than they hold: no memory is taken for what is not there.

Other damages are those of `test_damaged_files.py` and `test_file_invariants.py`.
"""

import json
import struct
import tracemalloc

import pytest
import trimesh

import rts

pytestmark = pytest.mark.files

MANY = 4_000_000_000
BOX = trimesh.creation.box()


def ply_header(layout, vertices, faces):
    return (
        f"ply\nformat {layout} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    )


def glb_of_many_rows(data):
    """A GLB whose first accessor has many rows, and no data."""
    [length] = struct.unpack_from("<I", data, 12)
    tree = json.loads(data[20 : 20 + length])
    tree["accessors"][0] = {"componentType": 5125, "type": "SCALAR", "count": MANY}
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def promising(kind):
    """Files that promise some milliards of rows, or of entries in a list, or name no data for them."""
    if kind == "ply":
        lists = ply_header("binary_little_endian", 3, 1).replace("uchar int", "uint int").encode()
        vertices, faces = ply_header("binary_little_endian", MANY, 1), ply_header("ascii", 3, MANY)
        return [vertices.encode() + bytes(100), faces.encode() + b"0 0 0\n" * 4, lists + bytes(36) + b"\xff" * 8]
    if kind == "off":
        return [b"OFF\n4000000000 1 0\n0 0 0\n", b"OFF\n1 1 0\n0 0 0\n4000000000 0 0 0\n"]
    if kind == "stl":
        return [bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(100)]
    data, most = BOX.export(file_type="glb"), b"\xff\xff\xff\xff"
    return [glb_of_many_rows(data), data[:12] + most + data[16:], data[:8] + most + data[12:]]


@pytest.mark.parametrize("kind", ["ply", "off", "stl", "glb"])
def test_what_a_file_promises_is_not_believed_before_it_is_seen(tmp_path, kind):
    path = tmp_path / f"m.{kind}"
    BOX.export(path)
    rts.load(path)  # What is imported for it takes memory, too.
    for data in promising(kind):
        path.write_bytes(data)
        tracemalloc.start()
        with pytest.raises(rts.InputError) as error:
            rts.load(path)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert "\n" not in str(error.value) and str(path) in str(error.value) and peak < 10_000_000
