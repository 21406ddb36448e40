"""Paths that callers and files give, checked before any work is done for them.

A model file may refer to others (materials, textures, buffers), but only to those inside its own folder, so that a
model from elsewhere cannot read the rest of the disk.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path, PureWindowsPath
from typing import Any
from urllib.parse import unquote

import platformdirs

from rts.errors import InputError
from rts.files.damaged_files import contents


def as_path(path: Any) -> Path:
    """A path from a string or path object; an InputError where no file can have that name."""
    try:
        result = Path(os.fspath(path))
    except TypeError:
        raise InputError(f"the path is a {type(path).__name__}; expected a string or pathlib.Path") from None
    try:
        result.lstat()
    except ValueError:
        raise InputError(f"the path is {str(path)[:60]!r}, which no file can be called; choose another name") from None
    except OSError as error:
        if error.errno in (errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL):
            shown = str(path) if len(str(path)) <= 60 else f"{str(path)[:57]}..."
            raise InputError(f"the path {shown!r} is no good ({error.strerror}); choose another name") from None
    return result


def output_file(path: Any, what: str, extensions: tuple[str, ...]) -> Path:
    """The path of a file to write.

    Raises:
        InputError: another extension, a folder of that name, a file where a folder ought to be, or no permission to
            write there.
    """
    path = as_path(path)
    if path.suffix.lower() not in extensions:
        expected = " or ".join(filter(None, (", ".join(extensions[:-1]), extensions[-1])))
        raise InputError(f"the {what} is to be called {path.name!r}; expected a name ending in {expected}")
    if path.is_dir():
        raise InputError(f"{path} is a folder; expected the name of a file to write")
    if not path.exists():
        output_folder(path.parent)
    elif not os.access(path, os.W_OK):
        raise InputError(
            f"{path} cannot be written (Permission denied); change its permissions, or choose another name"
        )
    return path


def output_folder(path: Any) -> Path:
    """The path of a folder to write into, which need not exist; an InputError where it cannot be made or written to."""
    path = as_path(path)
    existing = next(p for p in (path, *path.parents, Path(".")) if os.path.lexists(p))
    if not existing.is_dir():
        raise InputError(f"{existing} is a file; expected a folder to write into")
    try:  # Permissions do not tell everything, of file systems that are read only for example.
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise InputError(f"nothing can be written into {existing} ({error.strerror}); choose another folder") from error
    return path


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn errors in the block, which writes a file or the folders above it, into an InputError of one line."""
    try:
        yield
    except (OSError, MemoryError, struct.error, OverflowError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path} cannot be written ({reason}); choose another name or folder") from error


def inside(folder: Path, name: str, referrer: Path, start: Path | None = None) -> Path:
    """The path of a file that `referrer` names; refused if outside `folder`.

    Args:
        folder: the model's folder.
        name: as written in the file; either slash.
        referrer: the file that names it.
        start: the folder that the name is relative to; None for that of `referrer`.

    Raises:
        InputError: an absolute path, or one that leads out of the folder, symbolic links followed; or a name that no
            file can have.
    """
    plain = name.replace("\\", "/")
    refused = InputError(
        f"{referrer} refers to {name[:60]!r}, outside its own folder, which is refused; copy that file beside "
        f"the model and name it without a path"
    )
    if plain.startswith("/") or PureWindowsPath(plain).drive:
        raise refused
    try:
        target = as_path((start or referrer.parent) / plain).resolve()
    except (InputError, RuntimeError):  # Of links that lead to one another.
        raise InputError(f"{referrer} refers to {name[:60]!r}, which no file can be called; repair the file") from None
    if not target.is_relative_to(folder.resolve()):
        raise refused
    return target


def beside(path: Path, name: str) -> bytes:
    """The bytes of a file that a model names, perhaps with its spaces and other characters as in a URI.

    Raises:
        InputError: see `inside`; or there is no such file, or it cannot be read.
    """
    target = inside(path.parent, name.strip(), path)
    if not target.is_file():
        target = inside(path.parent, unquote(name.strip()), path)
    if not target.is_file():
        raise InputError(f"{path} refers to {name!r}, but there is no file {target}; put it there")
    return contents(target)


def cache_folder() -> Path:
    """The folder, which may not exist yet, of files that are costly to make, such as compiled libraries.

    Later processes read them. Without a home folder, it is a folder of this process alone.
    """
    try:
        folder = platformdirs.user_cache_path("rts", appauthor=False)
    except RuntimeError:  # There is no home.
        return Path(own_folder().name)
    return folder if folder.is_absolute() else Path(own_folder().name)  # Older platformdirs leave "~" as it is.


@functools.cache
def own_folder() -> tempfile.TemporaryDirectory:
    """A folder of this process alone, which is removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="rts-")
