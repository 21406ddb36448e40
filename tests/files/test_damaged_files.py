"""Damaged files are never read as another shape without a word, but for those of which nobody could tell.

A share of the damages is tried. `RTS_DAMAGES=1` tries all of them.
"""

import os
import re
import warnings

import numpy as np
import pytest
from binary_damages import byte_cases, header_cases
from gltf_damages import tree_cases
from sheets import TRIANGLES, sound
from text_damages import line_cases, number_cases, whole_cases

import rts

pytestmark = pytest.mark.files

CASES = (number_cases, line_cases, whole_cases, header_cases, byte_cases, tree_cases)
STEP = int(os.environ.get("RTS_DAMAGES", "12"))
TOLERANCE = 0.02
"""Positions as bytes are off by so much."""
PLACE = re.compile(
    r"(line|row|face|triangle|accessor|bufferView|buffer|mesh|node|scene) \d|its (tree|scene|header)| holds "
    r"|it (begins|does not begin|promises|requires|is of|has no)|part of it|first part|neither as binary|NaN, infinite"
    r"| are no counts"
)
"""How an error says where."""
OF_FACES = re.compile(r"faces (have the corners of another one|are wound against their neighbours)")
"""What is said of faces, which may be a word where none is expected, but takes the place of no other one."""


def shape_of(parts):
    """Triangles in the scene, each from its least corner on, in order; coordinates are multiples of a quarter."""
    found = []
    for part in parts:
        vertices = part.theta["vertices"].astype(np.float64)
        if part.transform is not None:
            vertices = vertices @ part.transform[:3, :3].T + part.transform[:3, 3]
        found.append(vertices[part.surface.faces])
    return canonical(np.concatenate(found))


def canonical(triangles):
    near = np.round(4 * triangles) / 4 + 0.0
    rows = np.where(np.abs(near - triangles) <= TOLERANCE, near, triangles).tolist()
    return sorted(min(t[i:] + t[:i] for i in range(3)) for t in rows)


SHAPE = canonical(TRIANGLES)


def outcome(folder, files, **options):
    """Says "refused", "same" or "other", and whether a warning was given; anything else fails."""
    for name, data in files.items():
        (folder / name).write_bytes(data)
    path = folder / next(iter(files))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = "same" if shape_of(rts.load(path, **options)) == SHAPE else "other"
        except rts.InputError as error:
            found, said = "refused", str(error)
            assert str(path) in said and "\n" not in said and "Traceback" not in said and len(said) < 600
            assert PLACE.search(said.replace(str(path), "")), said
    for warning in caught:
        assert issubclass(warning.category, rts.errors.FileWarning) and str(path) in str(warning.message), (
            warning.message
        )
    told = [note for warning in caught for note in str(warning.message).split("; ") if not OF_FACES.search(note)]
    return found, bool(told)


@pytest.mark.parametrize("kind", list(sound()))
def test_what_is_damaged_below_is_sound_before(tmp_path, kind):
    assert outcome(tmp_path, sound()[kind]) == outcome(tmp_path, sound()[kind], merge=True) == ("same", False)


@pytest.mark.parametrize("cases", CASES)
def test_damages_are_refused_or_warned_of_or_make_no_difference(tmp_path, cases):
    wrong = {}
    for number, case in enumerate(cases()):
        if number % STEP:
            continue
        try:
            one, merged = (outcome(tmp_path, case.files, merge=merge) for merge in (False, True))
        except Exception as error:
            wrong[case.name] = f"{type(error).__name__}: {error}"
            continue
        silent = one == ("other", False) or merged == ("other", False)
        # Merged, faces of several parts may turn out to be there twice.
        if (one != merged and not case.reason) or silent != bool(case.reason):
            wrong[case.name] = (one, merged, case.reason)
    assert not wrong
    assert number > 100


QUANTIZED = "('extensionsUsed', 'extensionsRequired')"
SOUND = [
    *(f"{kind}: {end}" for kind in ("obj", "ply", "off", "stl") for end in ("CR", "CR LF", "CR from the middle on")),
    *(f"{kind}: a header with {end}" for kind in ("ply", "little.ply", "big.ply") for end in ("CR", "CR LF")),
    *("ply: 'element vertex +9'", "little.ply: 'element face +8'", "off: '9 +8 0'", "off: begins with 'off'"),
    "off: counts joined with the first word",
    *("obj: a mark", "off: a mark", "stl: a mark", "obj: a comment that ends in a backslash"),
    *("obj: a form feed in a comment", "plain.obj: 'f' of line 14 is 'fo 1 2 5'", "stl: two solids", "off: comments"),
    *(
        f"{form}: {kind} {whole} {QUANTIZED}"
        for form in ("glb", "gltf")
        for kind in ("i1", "u1", "i2", "u2")
        for whole in (None, True)
    ),
    *(
        "glb: KHR_materials_unlit required",
        "gltf: data too long",
        "glb: a node that shows nothing, of no size",
        "glb: 'rotation' of a node [0, 0, 0, -1]",
    ),
]
REFUSED = {
    "plain.obj: 'f' of line 14 is 'F 1 2 5'": "line 14: it begins with 'F'; expected v, vt, vn or f, and a space",
    "plain.obj: 'f' of line 14 is 'ff 1 2 5'": "line 14: it begins with 'ff'",
    "plain.obj: 'f' of line 14 is 'f11 2 5'": "line 14: it begins with 'f11'",
    "plain.obj: 'v' of line 4 is 'V 0 0 0.2'": "line 4: it begins with 'V'",
    "plain.obj: four of a corner, word 1 of line 17": "line 17: '5/1/1/1' has 4 indices; expected at most 3",
    "obj: arabic digits, word -1 of line 19": "line 19: .* are not numbers",
    "obj: a no-break space inside, word 1 of line 12": "line 12: .* are not numbers",
    "off: arabic digits, word 1 of line 15": "line 15, .* is not of numbers",
    "obj: 1.#QNAN, word -1 of line 7": "line 7: .* are not numbers",
    "stl: a thin space inside, word -1 of line 11": "line 9, 'facet normal",
    "little.ply: 'element vertex \u0669'": "line 4 of its header",
    "binary.stl: shifted by 1 from triangle 0": "triangle 0 has the coordinate .*: bytes before it are missing",
    "binary.stl: shifted by -1 from triangle 6": "triangle 6 has the coordinate",
    "glb: byteStride of view 0 8": "accessor 0 .*rows of 12 bytes, 8 bytes apart",
    "glb: byteStride of view 0 16": r"POSITION \(accessor 0\) and NORMAL \(accessor 1\) of mesh 0 share bytes",
    "gltf: byteStride of view 2 4": "accessor 2 ",
    "glb: componentType of POSITION 5123": "POSITION of mesh 0, accessor 0, is of numbers 5123 .* without the exten",
    "glb: componentType of indices 5122": "indices of mesh 0, accessor 2, is of numbers 5122",
    "gltf: 'scale' of a node [0, 0, 0]": "the transform of node 2 is singular",
    "glb: a matrix singular": "the transform of node 1 is singular",
    "glb: a matrix of 1e300": "the transform of node 1 is too large",
    "glb: a matrix transposed": "the transform of node 1 has the last row",
    "glb: 'mesh' of a node 7": "node 2 is of mesh 7, and there are 2",
    "gltf: KHR_unknown required": "it requires the extension 'KHR_unknown', which is not read",
    "glb: an index too large": "accessor 5, the indices of mesh 1, refers to vertex 9 of 9",
}
WARNED = {
    "plain.obj: 'f' of line 14 is 'face 1 2 '": r"statements that are not known, and left out: 'face' \(line 14\)$",
    "plain.obj: one number more, line 4": "line 4: 'v' has 4 numbers and others 3; the fourth, a weight, is not used",
    "glb: byteOffset of view 0 24": "POSITION of mesh 0 go from .* min and max of accessor 0 are",
    "glb: mesh of a node misspelt": "properties that glTF does not know, and that are left out: 'mesx' of nodes 2",
    "gltf: mode 1": "mesh 0 is of lines, which are left out",
    "glb: a skin of a node": "skins, which are left out",
}


@pytest.fixture(scope="module")
def named():
    """All damaged models by their names."""
    return {case.name: case.files for cases in CASES for case in cases()}


def test_what_can_be_read_rightly_is(tmp_path, named):
    found = {name: outcome(tmp_path, named[name]) for name in SOUND}
    assert found == dict.fromkeys(SOUND, ("same", False))


@pytest.mark.parametrize("name", REFUSED)
def test_errors_name_the_line_or_the_accessor(tmp_path, named, name):
    assert outcome(tmp_path, named[name]) == ("refused", False)
    with pytest.raises(rts.InputError, match=REFUSED[name]):
        rts.load(tmp_path / next(iter(named[name])))


@pytest.mark.parametrize("name", WARNED)
def test_warnings_name_what_is_left_out_once(tmp_path, named, name):
    assert outcome(tmp_path, named[name])[1]
    with pytest.warns(rts.errors.FileWarning) as caught:
        rts.load(tmp_path / next(iter(named[name])))
    assert len(caught) == 1 and re.search(WARNED[name], str(caught[0].message))
