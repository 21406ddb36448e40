"""Arrays in the trees of glTF that tests write."""

import base64

COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


def viewed(tree, content):
    """The number of a view of bytes, which get a buffer of their own in the tree."""
    buffers, views = (tree.setdefault(name, []) for name in ("buffers", "bufferViews"))
    buffers.append({"uri": "data:;base64," + base64.b64encode(content).decode(), "byteLength": len(content)})
    views.append({"buffer": len(buffers) - 1, "byteLength": len(content)})
    return len(views) - 1


def stored(tree, rows, **more):
    """The number of an accessor of rows, (N,) or (N, C); `more` are further entries of the accessor."""
    kind = {"count": len(rows), "componentType": COMPONENTS[rows.dtype.str[1:]]}
    kind["type"] = "SCALAR" if rows.ndim == 1 else TYPES[rows.shape[1]]
    accessors = tree.setdefault("accessors", [])
    accessors.append({"bufferView": viewed(tree, rows.tobytes()), **kind, **more})
    return len(accessors) - 1
