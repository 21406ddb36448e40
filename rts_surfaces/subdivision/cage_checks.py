"""Cages that users give, checked before anything crosses into C++."""

from __future__ import annotations

from itertools import chain
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rts import InputError, engine_of
from rts.errors import EngineError
from rts.plugin_api.arrays import shape_of
from rts.plugin_api.checks import check_numbers, quoted
from rts_surfaces.subdivision.cage import REPAIR, Cage, edge_key, half_edge_ends, sorted_edges, twins_of

INFINITE = 10
"""The least sharpness of a crease or corner that OpenSubdiv treats as infinitely sharp."""


MOST, MOST_AROUND = 256, 2000
"""Limits: the most corners of a face and faces at a vertex; and the most corners of all faces that touch a face. With
ten times as many, OpenSubdiv takes minutes, or ends the process."""


def checked_cage(faces: Any, scheme: str, creases: Any = (), corners: Any = (), holes: Any = ()) -> Cage:
    """The cage of these faces, after all checks.

    Args:
        faces: lists of vertex numbers, counter-clockwise seen from outside; or an array (F, n).
        scheme: "catmark" or "loop".
        creases: rows (a, b, sharpness), an edge by its vertices.
        corners: rows (vertex, sharpness).
        holes: numbers of faces.

    Raises:
        InputError: an argument is malformed, or OpenSubdiv could not compute the cage's limit surface; one line names
            the fault and its place.
    """
    if not isinstance(scheme, str) or scheme not in ("catmark", "loop"):
        raise InputError(f"scheme is {quoted(scheme)}; expected 'catmark' or 'loop'")
    sizes, indices = checked_lists("faces", faces)
    first = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
    none = np.zeros(0, np.int32)
    tagged = none.reshape(0, 2), none.astype(np.float32), none, none.astype(np.float32)
    cage = Cage(scheme, sizes, first, indices, none, *tagged, _checked_holes(holes, len(sizes)))
    _check_faces(cage)
    order, keys = sorted_edges(cage)
    cage = cage._replace(twins=twins_of(cage, order, keys))
    _check_pairs(cage)
    _check_fans(cage)
    _check_sizes(cage)
    edges, crease_sharpness = _tags("creases", creases, ("a", "b", "sharpness"))
    marked, corner_sharpness = _tags("corners", corners, ("vertex", "sharpness"))
    _check_tags(cage, keys, edges, marked[:, 0])
    cage = cage._replace(
        creases=edges.astype(np.int32),
        crease_sharpness=crease_sharpness,
        corners=marked[:, 0].astype(np.int32),
        corner_sharpness=corner_sharpness,
    )
    for table in cage[1:]:
        table.flags.writeable = False
    return cage


def checked_lists(name: str, lists: Any) -> tuple[np.ndarray, np.ndarray]:
    """Lengths (F,) of lists of indices, and their indices (H,), one list after the other; both int32.

    Raises:
        InputError: there is no list, all lists are empty, one holds other than integers from 0 to 2**27 − 1, an array
            has other than two axes, or values are traced.
    """
    wrong = InputError(f"{name} is {quoted(lists)}; expected lists of integers, one for each face, or an array (F, n)")
    if isinstance(lists, (list, tuple)):
        try:
            sizes = np.fromiter(map(len, lists), np.int64, len(lists))
            flat = np.array(list(chain.from_iterable(lists)))
        except Exception:  # Numbers in place of lists, texts, traced values, lists within lists.
            raise wrong from None
    else:
        flat = _known(name, lists, wrong)
        if flat.ndim != 2:
            raise InputError(f"{name} has shape {flat.shape}; expected (F, n), or lists of indices")
        sizes, flat = np.full(len(flat), flat.shape[1]), flat.reshape(-1)
    if not len(sizes):
        raise InputError(f"{name} is empty; expected at least one face")
    if not flat.size:
        raise InputError(f"{name} has {len(sizes)} faces without corners; expected at least 3 corners a face")
    if flat.ndim != 1 or not np.issubdtype(flat.dtype, np.integer):
        raise InputError(f"{name} holds {quoted(flat.reshape(-1)[0])}; expected integers that name rows")
    for bad, expected in ((flat.min(), "indices count from 0"), (flat.max(), "expected less than 2**27")):
        if not 0 <= bad < 2**27:
            raise InputError(f"{name} holds the index {bad}; {expected}")
    return sizes.astype(np.int32), flat.astype(np.int32)


def _known(name: str, table: Any, wrong: InputError) -> np.ndarray:
    try:
        known = np.asarray(table) if isinstance(table, np.ndarray) else engine_of(table).known(table)
    except EngineError:
        raise wrong from None
    if known is None or known.shape != shape_of(table):
        raise InputError(f"{name} is traced, and topology must be known while Python runs; give it NumPy indices")
    if known.ndim == 0:
        raise wrong
    return known


def _check_faces(cage: Cage) -> None:
    """Refuse faces of fewer than 3 corners, for Loop of more than 3, and with a vertex at two corners."""
    least, most = cage.sizes.min(), cage.sizes.max()
    if least < 3:
        f = int(cage.sizes.argmin())
        raise InputError(f"face {f} of the cage has {least} corners; expected at least 3: {REPAIR}")
    if cage.scheme == "loop" and most > 3:
        f = int(cage.sizes.argmax())
        raise InputError(f"face {f} has {most} corners, and Loop needs triangles; cut it, or use scheme='catmark'")
    keys = cage.faces() * (int(cage.indices.max()) + 1) + cage.indices
    keys.sort()
    same = np.flatnonzero(keys[1:] == keys[:-1])
    if len(same):
        f, vertex = divmod(int(keys[same[0]]), int(cage.indices.max()) + 1)
        raise InputError(f"face {f} of the cage has the vertex {vertex} at two corners; expected each once: {REPAIR}")


def _check_pairs(cage: Cage) -> None:
    """Refuse cages with two faces that share more than one edge: around a vertex between them, or elsewhere."""
    owner, inner = cage.faces(), cage.twins >= 0
    pairs = owner * len(cage.sizes) + np.where(inner, owner[cage.twins], 0)
    pairs, count = np.unique(pairs[inner], return_counts=True)
    twice = np.flatnonzero(count > 1)
    if not len(twice):
        return
    f, g = divmod(int(pairs[twice[0]]), len(cage.sizes))
    valence = np.bincount(cage.indices)
    outer = np.zeros(len(valence), bool)
    for ends in half_edge_ends(cage):
        outer[ends[~inner]] = True
    inner_vertices = cage.indices[(owner == f) & (valence[cage.indices] == 2) & ~outer[cage.indices]]
    if len(inner_vertices):
        raise InputError(
            f"only faces {f} and {g} meet at vertex {inner_vertices[0]}, which is inside the cage; expected 3 faces or "
            f"more there: leave the vertex out"
        )
    raise InputError(f"faces {f} and {g} share {count[twice[0]]} edges; expected at most one: divide one of them")


def _check_fans(cage: Cage) -> None:
    """Refuse cages with a vertex whose faces are not all connected through edges at this vertex."""
    count = len(cage.indices)
    h = np.flatnonzero(cage.twins >= 0)
    # Go around a vertex: from the half edge that leaves the vertex in a face to the one that does in the next face.
    beside = cage.next()[cage.twins[h]]
    graph = coo_array((np.ones(len(h), bool), (h, beside)), shape=(count, count))
    _, fan = connected_components(graph, directed=False)
    fans = np.unique(cage.indices.astype(np.int64) * count + fan) // count
    twice = np.flatnonzero(fans[1:] == fans[:-1])
    if len(twice):
        vertex = int(fans[twice[0]])
        raise InputError(
            f"vertex {vertex} joins {int((fans == vertex).sum())} fans of faces that share no edge there; expected "
            f"one: give each fan a vertex of its own"
        )


def _check_sizes(cage: Cage) -> None:
    """Refuse faces and vertices above the limits `MOST` and `MOST_AROUND`."""
    valence = np.bincount(cage.indices)
    if cage.sizes.max() > MOST:
        f = int(cage.sizes.argmax())
        raise InputError(f"face {f} has {cage.sizes[f]} corners; expected at most {MOST}: divide it")
    if valence.max() > MOST:
        v = int(valence.argmax())
        raise InputError(f"{valence[v]} faces meet at vertex {v}; expected at most {MOST}: divide the faces around it")
    far = np.repeat(cage.sizes - 2, cage.sizes)
    beyond = np.bincount(cage.indices, far)[cage.indices] - far
    around = cage.sizes + np.bincount(cage.faces(), beyond)
    if around.max() > MOST_AROUND:
        f = int(around.argmax())
        raise InputError(
            f"the faces that touch face {f} have {int(around[f])} corners; expected at most {MOST_AROUND}: divide it"
        )


def _tags(name: str, rows: Any, columns: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The rows of creases or corners, a column each of `columns`: all but the last as indices, the last as sharpness.

    Returns:
        (n, len(columns) − 1) int64 and (n,) float32, at most `INFINITE`; n is 0 for an empty list or array.

    Raises:
        InputError: traced rows, rows of another width, numbers that are not finite, indices that are not whole numbers
            from 0 on, or a negative sharpness.
    """
    expected = f"rows ({', '.join(columns)})"
    if shape_of(rows)[:1] == (0,) or (isinstance(rows, (list, tuple)) and not rows):
        return np.zeros((0, len(columns) - 1), np.int64), np.zeros(0, np.float32)
    try:
        shape = shape_of(rows) or np.shape(rows)
    except Exception:  # Rows of different lengths, and of traced values.
        shape = ()
    if len(shape) != 2 or shape[1] != len(columns):
        raise InputError(f"{name} is {quoted(rows)}; expected {expected}")
    values = check_numbers(name, rows, shape)
    if values is None:
        raise InputError(f"{name} is traced, and topology must be known while Python runs; give it numbers")
    indices, sharpness = values[:, :-1].astype(np.float64), values[:, -1].astype(np.float64)
    wrong = ((indices != np.floor(indices)) | (indices < 0) | (indices >= 2**31)).any(axis=1)
    if wrong.any():
        raise InputError(f"{name} name the vertices {indices[wrong][0].tolist()}; expected {expected}, whole numbers")
    if sharpness.min() < 0:
        raise InputError(f"{name} have the sharpness {sharpness.min():g}; expected 0 or more, 10 for infinitely sharp")
    return indices.astype(np.int64), np.minimum(sharpness, INFINITE).astype(np.float32)


def _checked_holes(holes: Any, faces: int) -> np.ndarray:
    """Numbers of faces (E,) int32, each once, in increasing order, from a list or array of them.

    Raises:
        InputError: values are traced, or other than integers from 0 to `faces` − 1.
    """
    if isinstance(holes, (list, tuple)) and not holes:
        return np.zeros(0, np.int32)
    wrong = InputError(f"holes is {quoted(holes)}; expected numbers of faces, from 0 to {faces - 1}")
    try:
        known = _known("holes", np.asarray(holes) if isinstance(holes, (list, tuple)) else holes, wrong)
    except (TypeError, ValueError):  # Lists of different lengths, traced values in lists.
        raise wrong from None
    if known.ndim != 1 or (known.size and not np.issubdtype(known.dtype, np.integer)):
        raise wrong
    if known.size and not 0 <= known.min() <= known.max() < faces:
        raise wrong
    return np.unique(known).astype(np.int32)


def _check_tags(cage: Cage, keys: np.ndarray, edges: np.ndarray, corners: np.ndarray) -> None:
    """Refuse sharp edges (n, 2) and sharp vertices (m,) that the cage lacks; `keys` are the cage's sorted edge keys."""
    count = int(cage.indices.max()) + 1
    wanted = edge_key(edges[:, 0], edges[:, 1], count)
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    missing = (keys[place] != wanted) | (edges.max(axis=1, initial=0) >= count)
    if missing.any():
        a, b = edges[missing][0]
        raise InputError(f"creases name the edge of vertices {a} and {b}, but no face has it; name edges of the cage")
    unknown = corners[~np.isin(corners, cage.indices)]
    if len(unknown):
        raise InputError(f"corners name the vertex {unknown[0]}, but no face has it; name vertices of the cage")
