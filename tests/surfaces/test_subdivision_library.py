"""The C++ part of subdivision surfaces: compiled once, also by two processes; what is said where it cannot be."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import quick

import rts
from rts.errors import PluginError

pytestmark = pytest.mark.sampling

from rts_surfaces.subdivision import library  # noqa: E402

PROGRAM = """
import numpy as np
from rts_surfaces.subdivision import library
from rts_surfaces.subdivision.binding import Limit
from rts_surfaces.subdivision.cage_checks import checked_cage
limit = Limit(checked_cage([[0, 1, 2, 3]], "catmark"))
assert np.allclose(limit.stencils([0], [[0.5, 0.5]]).sum(), 1)
print(library.load()._name)
"""
SURVEY = """
from rts.registry import survey
print(next(info.error for info in survey() if info.name == "subdivision"))
"""


@pytest.fixture
def opensubdiv():
    try:
        return library.find()
    except PluginError as missing:
        pytest.skip(str(missing))


def started(code, **environment):
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-c", code],
        env={**os.environ, **{name: str(value) for name, value in environment.items()}},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def printed(process):
    out, error = process.communicate(timeout=120)
    assert process.returncode == 0, error[-3000:]
    return out.strip()


@pytest.mark.thorough
def test_two_processes_may_compile_at_once(opensubdiv, tmp_path):
    both = [started(PROGRAM, XDG_CACHE_HOME=tmp_path) for _ in range(2)]
    names = {printed(process) for process in both}
    kept = list((tmp_path / "rts").iterdir())
    assert [str(path) for path in kept] == list(names)
    # A third takes what there is.
    before = kept[0].stat().st_mtime_ns
    assert printed(started(PROGRAM, XDG_CACHE_HOME=tmp_path)) in names
    assert kept[0].stat().st_mtime_ns == before and list((tmp_path / "rts").iterdir()) == kept


@pytest.mark.thorough
def test_a_cache_that_cannot_be_written_to_is_done_without(opensubdiv, tmp_path):
    (tmp_path / "file").write_text("no folder")
    path = Path(printed(started(PROGRAM, XDG_CACHE_HOME=tmp_path / "file")))
    assert path.name.startswith("opensubdiv-") and tmp_path not in path.parents
    assert not path.exists()  # It went with its process.


@pytest.mark.thorough
def test_without_a_compiler_the_table_of_plugins_says_what_to_install(opensubdiv, tmp_path):
    for environment in ({"PATH": str(tmp_path), "CXX": ""}, {"CXX": "no-such-compiler -O2"}):
        line = printed(started(SURVEY, **environment))
        for expected in ("C++ compiler", "libosd-dev", "g++", "conda-forge", "Homebrew", "opensubdiv"):
            assert expected in line
        assert "\n" not in line
    assert "'no-such-compiler', is not found" in line


@pytest.mark.thorough
def test_without_headers_the_table_of_plugins_says_what_to_install(tmp_path):
    hide = "from rts_surfaces.subdivision import library; library.PREFIXES = ()"
    line = printed(started(f"{hide}\n{SURVEY}", RTS_OPENSUBDIV=tmp_path, CONDA_PREFIX=""))
    for expected in ("headers are not found", "libosd-dev", "conda-forge", "Homebrew", "RTS_OPENSUBDIV"):
        assert expected in line
    assert "\n" not in line


def test_a_version_without_bfr_is_told_from_none(tmp_path, monkeypatch):
    (tmp_path / "include" / "opensubdiv").mkdir(parents=True)
    (tmp_path / "include" / "opensubdiv" / "version.h").write_text("#define OPENSUBDIV_VERSION v3_4_4")
    monkeypatch.setattr(library, "PREFIXES", (str(tmp_path),))
    monkeypatch.setenv("RTS_OPENSUBDIV", "")
    monkeypatch.setenv("CONDA_PREFIX", "")
    with pytest.raises(PluginError, match="is older than 3.5"):
        library.find()


@pytest.mark.parametrize("compiler", quick(["false", "c++ -nostdinc++", "c++ -lno-such-library"]))
def test_a_compiler_that_fails_is_one_line(opensubdiv, compiler, tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", compiler)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(PluginError, match="fails to compile") as error:
        library._compiled(library.find(), library.cache_folder())
    assert "\n" not in str(error.value) and not list((tmp_path / "rts").iterdir())


@pytest.mark.thorough
def test_a_library_that_is_damaged_is_made_anew(opensubdiv, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path = library._compiled(library.find(), library.cache_folder())
    path.write_bytes(b"cut short")
    assert library._opened(opensubdiv).rts_message() == b""
    assert path.stat().st_size > 10_000


@pytest.mark.thorough
def test_a_damaged_library_that_cannot_be_removed_is_made_elsewhere(opensubdiv, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    library._compiled(library.find(), library.cache_folder()).write_bytes(b"cut short")

    def refused(self, missing_ok=False):
        raise PermissionError("read-only")

    monkeypatch.setattr(Path, "unlink", refused)
    assert library._opened(opensubdiv).rts_message() == b""


def test_without_a_home_the_library_is_made_elsewhere(monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # As Python does without a home.
    assert library.cache_folder().is_dir()


def test_another_compiler_is_another_library(opensubdiv, monkeypatch):
    one = library._key(opensubdiv)
    assert one == library._key(library.find())
    others = [
        opensubdiv._replace(compiler=(*opensubdiv.compiler, "-O1")),
        opensubdiv._replace(version="#define OPENSUBDIV_VERSION v3_6_0"),
        opensubdiv._replace(prefix=Path("/opt")),
    ]
    assert len({one, *map(library._key, others)}) == 4


def test_the_sources_are_beside_the_module():
    for name in library.SOURCES:
        assert (Path(library.__file__).parent / name).is_file()
    assert rts.plugins("surfaces").count("subdivision") == 1
