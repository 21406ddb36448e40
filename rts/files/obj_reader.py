"""Reading Wavefront OBJ files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rts.errors import InputError
from rts.files import polygons
from rts.files.damaged_files import contents, is_plain, lines_of, warn, without_comment
from rts.files.images import read_image
from rts.files.model_pieces import Piece
from rts.files.mtl_reader import MtlMaterial, read_mtl
from rts.files.paths import inside
from rts.files.srgb import decode_srgb

LENGTHS = {"v": {3, 4, 6, 7}, "vt": {1, 2, 3}, "vn": {3}}
"""Counts of numbers in a row: a position may have a weight, or a colour, which may have an alpha."""
FACES = ("f", "fo")
"""Statements of faces; "fo" is the older name of "f"."""
LEFT_OUT = frozenset(
    "vp deg bmat step cstype p l curv curv2 surf parm trim hole scrv sp end con g s mg o bevel c_interp d_interp lod "
    "shadow_obj trace_obj ctech stech call csh maplib usemap bzp bsp cdc cdp res".split()
)
"""Statements of the format that say nothing about polygons."""
_MISSING = "pictures that are not there, and is loaded without them"
_WORD = re.compile(r"[A-Za-z_][A-Za-z_0-9]*")
_NAMES = {"v": "vertices", "vt": "texture coordinates", "vn": "normals"}
_FAR = 2**40
"""More rows than there may be."""
_NUMERIC = re.compile(r"[-+./eE\s]*\d[-+./eE\d\s]*")


class _Lines:
    """The statements of an OBJ file, by kind.

    Attributes:
        path: the file.
        values: "v", "vt", "vn" → the numbers of all rows, one row after the other.
        lengths: "v", "vt", "vn" → how many numbers each row has.
        lines: "v", "vt", "vn" → line numbers of these.
        corners: zero-based indices of position, uv and normal of all faces' corners; −1 where one is not given.
        faces: (line number, number of corners, index of the material) of each face.
        tags: (line number, text) of the statements "t".
        libraries: names of files of materials.
        materials: name → index, in order of first use; None, for faces before any "usemtl", is 0.
        unknown: unknown keys, each with its first line.
    """

    def __init__(self, path: Path):
        self.path = path
        self.values: dict[str, list[float]] = {key: [] for key in LENGTHS}
        self.lengths: dict[str, list[int]] = {key: [] for key in LENGTHS}
        self.lines: dict[str, list[int]] = {key: [] for key in LENGTHS}
        self.corners: list[tuple[int, ...]] = []
        self.faces: list[tuple[int, int, int]] = []
        self.tags: list[tuple[int, str]] = []
        self.libraries: list[str] = []
        self.materials: dict[str | None, int] = {}
        self.unknown: dict[str, int] = {}

    def read(self) -> _Lines:
        """Read the file, and sort its statements by kind. Returns itself."""
        material = self.materials.setdefault(None, 0)
        lines = lines_of(contents(self.path))
        plain = is_plain("".join(lines))
        known: dict[str, tuple[int, ...]] = {}
        for number, line in _statements(lines):
            key, _, rest = without_comment(line).replace("\t", " ").strip(" \f\v").partition(" ")
            row = key in LENGTHS or key in FACES
            # Python takes 1_0 for 10.
            if (row and "_" in rest) or (not plain and (row or key == "t") and not is_plain(rest)):
                raise self.fail(number, f"{rest.strip()[:60]!r} are not numbers")
            if key in LENGTHS:
                self._read_row(key, rest.split(), number)
            elif row:
                words = rest.split()
                if len(words) < 3:
                    raise self.fail(number, f"a face has {len(words)} corners; expected at least 3")
                for word in words:
                    if word not in known or "-" in word:
                        known[word] = self._corner(word, number)
                    self.corners.append(known[word])
                self.faces.append((number, len(words), material))
            elif key == "t":
                self.tags.append((number, rest))
            elif key == "usemtl":
                material = self.materials.setdefault(rest.strip(), len(self.materials))
            elif key == "mtllib":
                # The whole line: names may hold spaces and, however unwisely, "#".
                self.libraries.append(line.strip()[len("mtllib") :].strip())
            elif key and key not in LEFT_OUT:
                self._check_key(key, rest, number)
        if self.unknown:
            keys = ", ".join(f"{key[:20]!r} (line {number})" for key, number in list(self.unknown.items())[:5])
            warn(f"{self.path} has statements that are not known, and left out: {keys}")
        return self

    def _read_row(self, key: str, words: list[str], number: int) -> None:
        if len(words) not in LENGTHS[key]:
            expected = " or ".join(map(str, sorted(LENGTHS[key])))
            raise self.fail(number, f"{key!r} has {len(words)} numbers; expected {expected}")
        try:
            self.values[key] += map(float, words)
        except ValueError:
            raise self.fail(number, f"{' '.join(words)[:60]!r} are not numbers") from None
        self.lengths[key].append(len(words))
        self.lines[key].append(number)

    def _check_key(self, key: str, rest: str, number: int) -> None:
        """Refuse an unknown key that may be a damaged one: of letters v, t, n, f only, or no word before numbers.

        Other keys are noted in `unknown`.
        """
        letters = {c for c in key.lower() if "a" <= c <= "z"}
        if letters and letters <= set("vtnf") or not _WORD.fullmatch(key) and _NUMERIC.fullmatch(rest or key):
            raise self.fail(number, f"it begins with {key[:20]!r}; expected v, vt, vn or f, and a space after it")
        self.unknown.setdefault(key, number)

    def fail(self, number: int, what: str) -> InputError:
        """The error of a line."""
        return InputError(f"{self.path}, line {number}: {what}; the file may be cut short or damaged: export it again")

    def _corner(self, word: str, number: int) -> tuple[int, ...]:
        """The indices of a corner such as "1/2/3"; negative ones count back from the latest row."""
        parts = word.split("/")
        if len(parts) > 3:
            raise self.fail(number, f"{word[:60]!r} has {len(parts)} indices; expected at most 3 a corner")
        indices = []
        for part, (key, rows) in zip([*parts, "", ""], self.lengths.items(), strict=False):
            try:
                index = int(part) if part or key == "v" else None
            except ValueError:
                raise self.fail(number, f"{part[:60]!r} is no index") from None
            if index is not None and key != "v" and not (-len(rows) <= index < _FAR and index):
                indices.append(_FAR)  # It is absent; `polygons` warns of it.
                continue
            if index is not None and index < -len(rows):
                raise self.fail(number, f"the index {part[:60]} counts back further than the {len(rows)} rows so far")
            if index is not None and not 0 != index < _FAR:
                raise self._beyond(number, part[:60], key)
            indices.append(-1 if index is None else index - 1 if index > 0 else len(rows) + index)
        return tuple(indices)

    def _beyond(self, number: int, index: Any, key: str) -> InputError:
        count = len(self.lengths[key])
        return self.fail(number, f"a face refers to number {index} of {count} {_NAMES[key]} (indices count from 1)")

    def array(self, key: str, widths: tuple[int, ...]) -> np.ndarray:
        """The rows (N, C) of one kind, float64.

        The result has the largest of `widths` columns that every row fills. If a row is shorter than all `widths`,
        there are as many columns as the first says, filled up with zeros.
        """
        lengths = set(self.lengths[key]) or {widths[0]}
        width = max((w for w in widths if w <= min(lengths)), default=widths[0])
        if key == "v" and {3, 4} <= lengths:
            number = self.lines[key][self.lengths[key].index(4)]
            warn(f"{self.path}, line {number}: 'v' has 4 numbers and others 3; the fourth, a weight, is not used")
        if max(widths) > width and max(lengths) >= max(widths):
            warn(f"{self.path}: some {key!r} have {max(lengths)} numbers and some {min(lengths)}; colours are left out")
        values, ends = np.array([*self.values[key], 0.0]), np.cumsum(self.lengths[key], dtype=np.int64)[:, None]
        places = ends - np.array(self.lengths[key], np.int64)[:, None] + np.arange(width)
        return values[np.where(places < ends, places, -1)]

    def polygons(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Indices of position, uv and normal (H, 3) of all corners; corner count, and material, of each face (F,).

        An index that is not given is −1. So is, with a warning, that of a uv or normal which is not there; indices of
        positions beyond the rows are refused.
        """
        table, faces = np.array(self.corners, np.int64), np.array(self.faces, np.int64)
        for key, indices in zip(LENGTHS, table.T, strict=True):
            beyond = np.flatnonzero(indices >= len(self.lengths[key]))
            if not len(beyond):
                continue
            of = np.unique(np.searchsorted(np.cumsum(faces[:, 1]), beyond, side="right"))
            if key == "v":
                raise self._beyond(faces[of[0], 0], indices[beyond[0]] + 1, key)
            indices[beyond] = -1
            warn(
                f"{self.path}, line {faces[of[0], 0]}: {len(of)} of {len(faces)} faces refer to {_NAMES[key]} that are "
                f"not among the {len(self.lengths[key])} of the file, and are read without these"
            )
        return table, faces[:, 1], faces[:, 2]


class Polygons(NamedTuple):
    """The faces of an OBJ file as polygons, all materials in one.

    Attributes:
        vertices: (V, 3) float64.
        colors: (V, 3) float64 in [0, 1], linear, or None.
        uv: (A, 2) float64.
        sizes: (F,) int64, the number of corners of each face.
        corners: (H, 3) int64, position, uv and normal of the corners of all faces; −1 where one is not given.
        tags: the statements "t", as OpenSubdiv's files have them, each with the number of its line.
        materials: the number of materials of faces.
        color: (3,) or (4,) in [0, 1], linear, of the only material; None if there is none, or are several.
        texture: (h, w, 3 or 4) float32 in [0, 1], linear, of that material; or None.
    """

    vertices: np.ndarray
    colors: np.ndarray | None
    uv: np.ndarray
    sizes: np.ndarray
    corners: np.ndarray
    tags: list[tuple[int, str]]
    materials: int
    color: np.ndarray | None
    texture: np.ndarray | None


def read_polygons(path: Path) -> Polygons:
    """The faces of an OBJ file, not cut into triangles.

    Raises:
        InputError: the file is damaged, or holds no faces.
    """
    lines = _Lines(path).read()
    v, vt, _ = _rows(lines)
    used = {material for _, _, material in lines.faces}
    materials = [material for name, material in _materials(lines).items() if lines.materials.get(name) in used]
    material = materials[0] if len(used) == len(materials) == 1 else MtlMaterial()
    corners, sizes, _ = lines.polygons()
    if material.missing:
        warn(f"{path} has {_MISSING}: {_some(list(material.missing))}")
    texture = None if material.texture is None else read_image(material.texture)
    linear = (None if x is None else decode_srgb(x) for x in (_colors(v), material.color, texture))
    colors, color, texture = linear
    return Polygons(v[:, :3], colors, vt, sizes, corners, lines.tags, len(used), color, texture)


def _rows(lines: _Lines) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (V, 3), or (V, 6) with a colour each; texture coordinates (A, 2); and normals (B, 3).

    A file without faces is refused.
    """
    v, vt, vn = lines.array("v", (3, 6)), lines.array("vt", (2,)), lines.array("vn", (3,))
    if not lines.faces:
        what = f"{len(v)} vertices but no faces" if len(v) else "neither vertices nor faces"
        raise InputError(f"{lines.path} holds {what}; expected a mesh with triangles or polygons")
    return v, vt, vn


def _colors(v: np.ndarray) -> np.ndarray | None:
    """The colours (V, 3) in [0, 1] of positions (V, 6), from 0 to 1 or to 255; None if these are (V, 3)."""
    return v[:, 3:] / (255 if v[:, 3:].max() > 1 else 1) if v.shape[1] == 6 else None


def _some(names: list[str]) -> str:
    """The first three names, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def read_obj(path: Path) -> list[Piece]:
    """One piece a material, in order of first use. See `rts.files.models.read_pieces`."""
    lines = _Lines(path).read()
    materials = _materials(lines)
    used = {material for _, _, material in lines.faces}
    looks = {name: materials.get(name, MtlMaterial()) for name, index in lines.materials.items() if index in used}
    textures = {name: read_image(look.texture) for name, look in looks.items() if look.texture is not None}
    read = {name: look.entries() for name, look in looks.items()}
    unread = [f"{key} of {name!r}" for name, look in looks.items() for key in look.unread]
    options = [f"{option} of {name!r}" for name, look in looks.items() for option in look.options]
    missing = [f"{what} of {name!r}" for name, look in looks.items() for what in look.missing]
    mistaken = [f"that of {name!r}" for name, (_, taken) in read.items() if taken]
    kinds = (
        (_MISSING, missing),
        ("maps that are not read", unread),
        ("options of maps that are not followed", options),
        ("bump maps that are taken for normal maps, by their colours", mistaken),
    )
    notes = [f"{what}: {_some(names)}" for what, names in kinds if names]
    if notes:
        warn(f"{path} has {'; and '.join(notes)}")
    v, vt, vn = _rows(lines)
    # One array, shared by all pieces, so that merging need not repeat it.
    vertices = v[:, :3]
    table, sizes, of_face = lines.polygons()
    cut, owner, forced = polygons.cut(vertices, table[:, 0], sizes)
    if forced:
        warn(f"{path}: {forced} polygons cross themselves and may be cut wrongly; export triangles to be sure")
    corners, owner = table[cut], of_face[owner]
    _warn_of_gaps(path, table, sizes, of_face)
    pieces = []
    for name, index in lines.materials.items():
        if index not in used:
            continue
        faces, uv, normals = np.moveaxis(corners[owner == index], 2, 0)
        attributes: dict[str, Any] = {}
        if (uv >= 0).any():
            attributes["uv"] = (np.concatenate([vt, np.zeros((1, 2))]), np.where(uv >= 0, uv, len(vt)))
        if (normals >= 0).all():
            attributes["normals"] = (vn, normals)
        colors = _colors(v)
        if colors is not None:
            attributes["colors"] = (colors, faces)
        pieces.append(Piece(vertices, faces, attributes, textures.get(name), looks[name].color, entries=read[name][0]))
    return pieces


def _several(folder: Path, names: str) -> list[Path]:
    """The files of a folder that names between spaces are of; none unless all are."""
    files = [folder / name for name in names.split() if Path(name).name == name]
    return files if len(files) == len(names.split()) and all(file.is_file() for file in files) else []


def _warn_of_gaps(path: Path, table: np.ndarray, sizes: np.ndarray, of_face: np.ndarray) -> None:
    """Warn of faces without texture coordinates or normals, of materials some of whose faces have them."""
    lacks = np.logical_or.reduceat(table[:, 1:] < 0, np.cumsum(sizes) - sizes)
    for column, result in ((0, "take (0, 0)"), (1, "leave their material without normals")):
        own = lacks[:, column]
        count = int(own[np.isin(of_face, of_face[~own])].sum())
        if count:
            what = ("texture coordinates", "normals")[column]
            warn(f"{path}: {count} of {len(own)} faces have no {what}, and {result}")


def _materials(lines: _Lines) -> dict[str | None, MtlMaterial]:
    """The materials of all libraries by name; a warning if a library, or a material that is used, is missing."""
    materials: dict[str | None, MtlMaterial] = {}
    complete = True
    for name in lines.libraries:
        library = inside(lines.path.parent, name, lines.path)
        # A line may name several files, and a name may hold spaces.
        several = [library] if library.is_file() else _several(lines.path.parent, name)
        for file in several:
            materials.update(read_mtl(file, lines.path.parent))
        if not several:
            warn(
                f"{lines.path} names the material library {name!r}, but there is no file {library}; it is "
                "loaded without materials"
            )
            complete = False
    used = {index for _, _, index in lines.faces}
    missing = [name for name, index in lines.materials.items() if name and index in used and name not in materials]
    if missing and complete and lines.libraries:
        names = ", ".join(map(repr, missing[:5]))
        warn(f"{lines.path} uses materials that its libraries lack: {names}; they are loaded as plain ones")
    return materials


def _statements(lines: list[str]) -> Iterator[tuple[int, str]]:
    """Lines with their numbers; a line that ends in a backslash is joined with the next.

    A comment ends with its line: a backslash there is the end of a folder's name.
    """
    start, joined = 0, ""
    for number, line in enumerate(lines, start=1):
        start = start or number
        if line.endswith("\\") and "#" not in line:
            joined += line[:-1] + " "
            continue
        yield start, joined + line
        start, joined = 0, ""
    if joined:
        yield start, joined
