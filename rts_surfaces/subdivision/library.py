"""The C++ part of subdivision surfaces: compiled on first use, and kept in the user's cache.

So the package stays pure Python, and the compiled library always fits the installed OpenSubdiv. Its name in the cache
is a hash of the sources, the version of the headers and the compiler.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
import threading
from pathlib import Path
from typing import NamedTuple

from rts.errors import PluginError
from rts.plugin_api.files import cache_folder

SOURCES = ("opensubdiv.cpp", "cage.h", "newton.h")
PREFIXES = ("/usr", "/usr/local", "/opt/homebrew", "/usr/local/opt/opensubdiv")
COMPILERS = ("c++", "g++", "clang++")
FLAGS = ("-std=c++17", "-O2", "-fPIC", "-shared")
OLDEST = (3, 5)
"""The first version of OpenSubdiv with Bfr, its module that evaluates limit surfaces."""

HELP = (
    "install OpenSubdiv and a C++ compiler: Debian's packages libosd-dev and g++, or opensubdiv of conda-forge or "
    "Homebrew; RTS_OPENSUBDIV names the folder that holds its include and lib"
)

_POINTER, _INT, _LONG = ctypes.c_void_p, ctypes.c_int, ctypes.c_long
_RANGE = [_POINTER, _LONG, _LONG]
_SIGNATURES = {
    "rts_message": (ctypes.c_char_p, []),
    "rts_start": (None, []),
    "rts_cage": (_INT, [_POINTER, _POINTER, _POINTER]),
    "rts_cage_free": (None, [_POINTER]),
    "rts_tables": (_INT, [_POINTER] * 5),
    "rts_stencils_float": (_INT, [_POINTER, _INT, _LONG, _LONG, *[_POINTER] * 5]),
    "rts_stencils_double": (_INT, [_POINTER, _INT, _LONG, _LONG, *[_POINTER] * 5]),
    "rts_points": (_INT, [_POINTER, _POINTER]),
    "rts_points_free": (None, [_POINTER]),
    "rts_move": (_INT, [*_RANGE, _POINTER]),
    "rts_evaluate": (_INT, [*_RANGE, _POINTER, _POINTER, _INT, _POINTER]),
    "rts_newton": (_INT, [*_RANGE, *[_POINTER] * 8]),
}

_first_use = threading.Lock()


class Tools(NamedTuple):
    """The tools that build the library.

    Attributes:
        compiler: the command, perhaps with options.
        prefix: the folder that holds OpenSubdiv's include and lib.
        version: the text of the header with OpenSubdiv's version.
    """

    compiler: tuple[str, ...]
    prefix: Path
    version: str


def find() -> Tools:
    """The compiler and OpenSubdiv.

    Raises:
        PluginError: one is missing, or OpenSubdiv is older than 3.5.
    """
    places = [os.environ.get(name, "") for name in ("RTS_OPENSUBDIV", "CONDA_PREFIX")]
    old = ""
    for prefix in (Path(p) for p in (*places, *PREFIXES) if p):
        try:
            version = (prefix / "include/opensubdiv/version.h").read_text(encoding="utf-8")
        except OSError:
            continue
        if (prefix / "include/opensubdiv/bfr/refinerSurfaceFactory.h").is_file():
            break
        old = f", and that in {prefix} is older than {'.'.join(map(str, OLDEST))}"
    else:
        raise PluginError(f"subdivision surfaces need OpenSubdiv, whose headers are not found{old}; {HELP}")
    compiler = shlex.split(os.environ.get("CXX", ""))
    for command in [compiler] if compiler else [[name] for name in COMPILERS]:
        program = shutil.which(command[0])
        if program:
            return Tools((program, *command[1:]), prefix, version)
    missing = f"that CXX names, {compiler[0]!r}, is not found" if compiler else "is not found"
    raise PluginError(f"subdivision surfaces need a C++ compiler, and one {missing}; {HELP}")


@functools.cache
def load() -> ctypes.CDLL:
    """Load the library with its signatures; compile it if necessary.

    Raises:
        PluginError: a tool is missing, or does not work.
    """
    with _first_use:
        return _opened(find())


def _opened(tools: Tools) -> ctypes.CDLL:
    path = _compiled(tools, cache_folder())
    try:
        library = ctypes.CDLL(str(path))
    except OSError:  # The file is damaged, or was made for an OpenSubdiv that is gone.
        try:
            path.unlink(missing_ok=True)
            path = _compiled(tools, cache_folder())
        except OSError:  # It cannot be removed.
            path = _compiled(tools, Path(_own_folder().name))
        try:
            library = ctypes.CDLL(str(path))
        except OSError as error:
            raise PluginError(
                f"the library of subdivision surfaces does not load ({_line(str(error))}); {HELP}"
            ) from error
    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    library.rts_start()
    return library


def _compiled(tools: Tools, folder: Path) -> Path:
    """The path of the library for these tools: as kept in a folder, or compiled now."""
    name = f"opensubdiv-{_key(tools)}.so"
    kept = folder / name
    if kept.is_file():
        return kept
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle, draft = tempfile.mkstemp(suffix=".so", dir=folder)
    except OSError:  # The cache cannot be written to: each process compiles its own.
        folder = Path(_own_folder().name)
        handle, draft = tempfile.mkstemp(suffix=".so", dir=folder)
    os.close(handle)
    try:
        _compile(tools, Path(draft))
        # In one step: another process that compiles at this moment finds it whole, or not at all.
        os.replace(draft, folder / name)
    except BaseException:
        Path(draft).unlink(missing_ok=True)
        raise
    return folder / name


@functools.cache
def _own_folder() -> tempfile.TemporaryDirectory:
    """A folder of this process alone, removed when it ends."""
    return tempfile.TemporaryDirectory(prefix="rts-")


def _key(tools: Tools) -> str:
    compiler = Path(tools.compiler[0]).resolve()
    stat = compiler.stat()
    known = (*tools.compiler, compiler, stat.st_size, stat.st_mtime_ns, tools.prefix, tools.version, FLAGS)
    known += (platform.node(), platform.system(), platform.release(), platform.version(), platform.machine())
    text = b"".join((Path(__file__).parent / name).read_bytes() for name in SOURCES)
    return hashlib.sha256(repr(known).encode() + text).hexdigest()[:20]


def _compile(tools: Tools, out: Path) -> None:
    library = tools.prefix / "lib"
    command = [*tools.compiler, *FLAGS, f"-I{tools.prefix / 'include'}", str(Path(__file__).parent / SOURCES[0])]
    command += ["-o", str(out), f"-L{library}", f"-Wl,-rpath,{library}", "-losdCPU"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = done.stderr.splitlines()
        # The first error says more than the last lines.
        first = next((line for line in said if "error" in line or "cannot find" in line), said[-1] if said else "")
        raise PluginError(
            f"{tools.compiler[0]} fails to compile the library of subdivision surfaces ({_line(first)}); {HELP}"
        )


def _line(text: str) -> str:
    return " ".join(text.split())[:200]
