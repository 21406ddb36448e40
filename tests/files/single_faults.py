"""Files with a fault each, by seeds: JSON trees, lines of text, binary tables, and archives of arrays."""

import copy
import io
import json
import pickle
import struct

import numpy as np

NUMBERS = [0, -1, 5e-324, 1e-300, 1e300, -1e300, 10**19, 10**400, -(10**400), float("nan"), float("inf"), 1.5, True]
OTHERS = [None, "x", "1", "", [], {}, [[1]], "\ud800", "a\nb", "\0", "../x", "x" * 300, [None], {"a": 1}, False]
WORDS = [
    *("x", "nan", "-inf", "1e300", "-1e300", "5e-324", "1" + 19 * "0", "1" + 400 * "0", "-1", "1.5", "1_0", "\u0663"),
    *("a\u2028b", "\0", "0x10", "1" + 5000 * "0", "..", "é" * 200, "0"),
]
MARK = "\n"
"""Folders' names hold a line break: no message may have one."""


def any_of(random, values):
    return values[int(random.integers(len(values)))]


def deep(random):
    """A value that JSON may hold and that is of no use: of another type, or a number that is too large or small."""
    tree = []
    for _ in range(900):
        tree = [tree]
    return any_of(random, [*NUMBERS, *NUMBERS, *OTHERS, tree])


def places(tree, above=()):
    """The ways to all values of a JSON tree."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in entries:
        yield (*above, key)
        yield from places(value, (*above, key))


def tampered_tree(random, tree):
    """A copy of a JSON tree with one value replaced, left out, repeated or renamed."""
    tree = copy.deepcopy(tree)
    *ways, last = any_of(random, list(places(tree)))
    there = tree
    for way in ways:
        there = there[way]
    kind = random.integers(10)
    if kind < 7:
        there[last] = deep(random)
    elif kind == 7:
        del there[last]
    elif isinstance(there, list):
        there.insert(last, copy.deepcopy(there[last]))
    else:
        there[f"{last}x" if kind == 8 else "a\nb\ud800"] = there.pop(last)
    return tree


def tampered_bytes(random, data):
    """Bytes cut short, turned, overwritten or repeated."""
    place = int(random.integers(len(data)))
    size = int(random.integers(1, 16))
    match random.integers(5):
        case 0:
            return data[:place]
        case 1:
            return data[:place] + bytes([data[place] ^ 1 << int(random.integers(8))]) + data[place + 1 :]
        case 2:
            return data[:place] + data[place + size :]
        case 3:
            return data[:place] + data[place : place + size] + data[place:]
    packed = any_of(
        random,
        [
            *(struct.pack("<d", x) for x in (5e-324, 1e300, -1e300, float("nan"), float("inf"))),
            *(struct.pack("<Q", x) for x in (2**64 - 1, 2**63, 2**32, 0)),
            b"\n\n\xff\r",
        ],
    )
    return data[:place] + packed + data[place + len(packed) :]


def tampered_json(random, tree):
    """The bytes of a JSON file, with a fault of its tree or, one time in five, of its bytes."""
    if random.integers(5):
        return json.dumps(tampered_tree(random, tree)).encode()
    return tampered_bytes(random, json.dumps(tree).encode())


def tampered_lines(random, text):
    """The bytes of a text of words, with a fault of a word or a line, or of its bytes."""
    lines = text.split("\n")
    rows = [i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")]
    row = any_of(random, rows)
    words = lines[row].split(" ")
    word = int(random.integers(len(words)))
    match random.integers(8):
        case 0 | 1 | 2 | 3:
            words[word] = any_of(random, WORDS)
        case 4:
            del words[word]
        case 5:
            words.insert(word, words[word])
        case 6:
            lines[row:row] = [lines[row]] if random.integers(2) else []
            words = words if random.integers(2) else []
        case 7:
            return tampered_bytes(random, text.encode())
    lines[row] = " ".join(words)
    return "\n".join(lines).encode()


def archive(arrays):
    """The bytes of an archive of NumPy's; arrays of objects become pickles."""
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def unpacked(data):
    """The arrays of an archive."""
    with np.load(io.BytesIO(data)) as file:
        return {name: file[name] for name in file.files}


class Harmful:
    """An object whose pickle calls a function when it is read."""

    def __reduce__(self):
        return (print, ("a pickle was run",))


def tampered_array(random, array):
    """An array of another type, shape or value."""
    array = np.asarray(array)
    changed = np.array(array)
    match random.integers(9):
        case 0:
            return changed.astype(any_of(random, ["float16", "float64", "int64", "bool", "complex64", "S3", "U3"]))
        case 1:
            return np.append(changed.reshape(-1), changed.reshape(-1)[:1])
        case 2:
            return changed.reshape(-1)[:-1]
        case 3:
            return changed[None]
        case 4:
            return np.array(any_of(random, [None, "x", [Harmful()], {"a": 1}]), object)
        case 5:
            return np.array(any_of(random, [0, 1e300, "x", "\ud800\n", True, b"\0"]))
    if changed.dtype.kind == "f" and changed.size:
        changed.reshape(-1)[random.integers(changed.size)] = any_of(random, [np.nan, np.inf, -np.inf])
        return changed
    return np.full(array.shape, array.max(initial=0), array.dtype) if array.dtype.kind in "iu" else changed[None, None]


def tampered_archive(random, data):
    """An archive one of whose arrays is another, left out or renamed; or whose bytes are damaged."""
    arrays = unpacked(data)
    name = any_of(random, sorted(arrays))
    match random.integers(6):
        case 0:
            return tampered_bytes(random, data)
        case 1:
            del arrays[name]
        case 2:
            arrays[name + "x"] = arrays.pop(name)
        case _:
            arrays[name] = tampered_array(random, arrays[name])
    return archive(arrays)


def tampered_checkpoint(random, data, tampered_state):
    """A checkpoint of `rts.fit` with a fault in its arrays, its numbers, its optimiser's state, or its bytes.

    Args:
        random: a generator of random numbers.
        data: a sound one.
        tampered_state: random, bytes → the state of the method, with a fault.
    """
    kind = random.integers(10)
    arrays = unpacked(data)
    if kind < 3:
        return tampered_archive(random, data)
    if kind < 7:
        tree = json.loads(arrays["about"].tobytes())
        arrays["about"] = np.frombuffer(tampered_json(random, tree), np.uint8)
    elif kind < 9:
        arrays["method"] = np.frombuffer(tampered_state(random, arrays["method"].tobytes()), np.uint8)
    else:
        return any_of(
            random, [b"", pickle.dumps(Harmful()), pickle.dumps({"a": 1}), b"PK\x03\x04", arrays["method"].tobytes()]
        )
    return archive(arrays)


def tampered_torch_state(random, state):
    """The state of an optimiser of torch with a fault in its tree, its tensors or its bytes."""
    import torch

    if not random.integers(3):
        return any_of(random, [tampered_bytes(random, state), b"", pickle.dumps(Harmful()), archive({"a": 1})])
    tree = torch.load(io.BytesIO(state), weights_only=True)
    entries = [
        (there, key) for there in _containers(tree) for key in (there if isinstance(there, dict) else range(len(there)))
    ]
    there, key = any_of(random, entries)
    value = there[key]
    if random.integers(4) == 0:
        del there[key]
    elif isinstance(value, torch.Tensor) and random.integers(2):
        there[key] = any_of(
            random, [value * float("nan"), torch.zeros(7), value.to(torch.int64), value[None], value.double()]
        )
    else:
        there[key] = any_of(random, [*NUMBERS, None, "x", "\ud800", [], {}, {"a": 1}])
    file = io.BytesIO()
    torch.save(tree, file)
    return file.getvalue()


def _containers(tree):
    if isinstance(tree, (dict, list)) and len(tree):
        yield tree
        for value in tree.values() if isinstance(tree, dict) else tree:
            yield from _containers(value)
