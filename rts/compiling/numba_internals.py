"""Private names of numba: loops on disk that several processes may write, and a line where compiling takes long.

Where kept code is damaged, it is dropped and compiled anew. A numba without these names raises an ImportError here;
loops are then kept by numba's public `cache=True`.
"""

from __future__ import annotations

import gc
import os
import pickle
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import IO, Any

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.event import Listener, register
from numba.core.serialize import dumps

from rts.compiling.uninterrupted import uninterrupted

try:
    import fcntl
except ImportError:  # Windows.
    fcntl = None

TOLD_AFTER = 1.0
"""Seconds of compilation, summed over a process, after which a message appears on the terminal."""

LOCK_SECONDS = 20.0
"""Seconds after which a process goes on without a folder whose lock another process holds, which takes thousandths."""


def kept(function: Callable, options: dict[str, Any]) -> Any:
    """The compiled function, kept on disk; with compilation switched off, the function itself.

    It is compiled, or loaded from disk, where no signal interrupts; calls for types that are compiled do not notice.
    """
    made: Any = numba.njit(**options)(function)
    if made is function:
        return function
    if not (hasattr(made, "_cache") and hasattr(made, "_compile_for_args")):
        return numba.njit(cache=True, **options)(function)
    made._cache = _Cache(function)
    made._compile_for_args = _uninterrupted(made._compile_for_args, function.__module__)
    return made


def _uninterrupted(compile_for: Callable, module: str) -> Callable:
    """The function by which numba compiles a loop for the types of some arguments: in a thread of its own.

    It stays in the thread that holds the compiler's lock, for which another would wait; and while the loop's module is
    being imported, which to load a loop imports: the other thread would wait for that, too.
    """

    def compile_(*args: Any, **kwargs: Any) -> Any:
        spec = getattr(sys.modules.get(module), "__spec__", None)
        if global_compiler_lock.is_locked() or getattr(spec, "_initializing", False):
            return compile_for(*args, **kwargs)
        return uninterrupted(partial(compile_for, **kwargs), *args)

    return compile_


@contextmanager
def alone(folder: str, writes: bool = True) -> Iterator[bool]:
    """A context that holds the lock of a folder of loops: one process writes at a time, while nobody reads.

    Without effect where the system or the file system has no locks, or the lock cannot be opened. Not to be nested.
    Nothing that waits for another lock belongs in it: all processes would wait as well.

    It gives True; False after `LOCK_SECONDS` without the lock. The process says so, and from then on leaves the folder.

    numba reads a function's index, chooses a name for the code, and writes both, one after the other. Two processes
    that do so at once, for different types, may choose the same name: one type's calls would then run the other's code.

    Args:
        folder: the folder of the loops.
        writes: False to only read, and share the lock with other readers.
    """
    file = _lock_file(folder)
    if fcntl is None or file is None:
        yield True
        return
    with file:
        if not _locked(file, folder, fcntl.LOCK_EX if writes else fcntl.LOCK_SH):
            yield False
            return
        try:
            yield True
        finally:
            with suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_UN)  # A child forked meanwhile has the file open, too.


_left: set[str] = set()
"""Folders that this process has left, since it did not get their lock."""


def _locked(file: IO[bytes], folder: str, how: int) -> bool:
    """Wait for the lock of a folder's file; False where the process leaves the folder."""
    assert fcntl is not None
    end, pause = time.monotonic() + LOCK_SECONDS, 0.001
    while folder not in _left:
        try:
            fcntl.flock(file, how | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            pass
        except OSError:  # The file system has no locks.
            return True
        if time.monotonic() > end:
            _left.add(folder)
            _tell(f"rts: another process holds the lock of compiled loops in {folder}; compiling without them …")
            return False
        time.sleep(pause)
        pause = min(2 * pause, 0.05)
    return False


def _lock_file(folder: str) -> IO[bytes] | None:
    for mode in ("ab", "rb"):  # Another user's file is readable only.
        with suppress(OSError):
            return open(os.path.join(folder, ".lock"), mode)
    return None


class _Checked(CompileResultCacheImpl):
    """The form in which code is kept: with a checksum, since damaged machine code may run, and compute anything."""

    def reduce(self, cres: Any) -> Any:
        """The code's checksum, and its bytes."""
        code = dumps(super().reduce(cres))
        return zlib.crc32(code), code

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """The code of what `reduce` made; None for the form of earlier versions, which have no checksum."""
        if len(payload) != 2:
            return None
        checksum, code = payload
        if zlib.crc32(code) != checksum:
            raise ValueError("these are not the bytes that were written")
        return super().rebuild(target_context, pickle.loads(code))


class _Files:
    """numba's files of a loop, read and written under the lock of their folder, which is held no longer than that."""

    def __init__(self, files: Any, folder: str) -> None:
        self._files, self._folder = files, folder

    def load(self, key: Any) -> Any:
        """The value kept under a key; None if there is nothing, or the process has left the folder."""
        with alone(self._folder, writes=False) as locked:
            return self._files.load(key) if locked else None

    def save(self, key: Any, data: Any) -> None:
        """Keep data under a key."""
        with alone(self._folder) as locked:
            if locked:
                self._files.save(key, data)

    def flush(self) -> None:
        """Drop what is kept."""
        with alone(self._folder) as locked:
            if locked:
                self._files.flush()


class _Cache(FunctionCache):
    """The compiled code of a loop on disk, safe while other processes write, and dropped where it is damaged."""

    _impl_class = _Checked
    _told = False

    def __init__(self, function: Callable) -> None:
        super().__init__(function)
        if hasattr(self, "_cache_file"):  # Otherwise nothing is locked.
            self._cache_file = _Files(self._cache_file, self.cache_path)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load compiled code for some types of arguments; None if there is none yet, or it was damaged."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # Each kind of damage has an error of its own.
            self._drop()
            return None

    def _drop(self) -> None:
        """Drop the code that is kept of a loop, and say so once a process."""
        try:
            self.flush()
        except OSError:  # Nothing can be written there.
            self.disable()
        if not _Cache._told:
            _Cache._told = True
            _tell(f"rts: compiled loops in {self.cache_path} are damaged; what is damaged is compiled anew …")


class _Watch(Listener):
    """Listener to the compilation of the library's loops and their helpers. The compiler holds its lock meanwhile.

    It prints one message once all compilations together have taken `TOLD_AFTER` seconds. It also pauses garbage
    collection, which would take a tenth of the time, since compilation makes many objects.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._depth, self._since, self._told, self._paused = 0, 0.0, False, False

    def on_start(self, event: Any) -> None:
        """Note that the compilation of a function starts, or of one that it calls."""
        if self._depth == 0:
            self._since = time.perf_counter()
            self._paused = _is_ours(event) and gc.isenabled()
            if self._paused:
                gc.disable()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """Note that the compilation of a function ends, in success or not."""
        self._depth -= 1
        if self._depth:
            return
        if self._paused:
            gc.enable()
        if _is_ours(event):
            self.seconds += time.perf_counter() - self._since
            if self.seconds > TOLD_AFTER and not self._told:
                self._told = True
                if sys.stderr is not None and sys.stderr.isatty():
                    _tell("rts: compiling loops (once for each installation; `rts warmup` does it ahead) …")


def _is_ours(event: Any) -> bool:
    return isinstance(getattr(event.data["dispatcher"], "_cache", None), _Cache)


def _tell(line: str) -> None:
    stream = sys.stderr
    if stream is not None:
        with suppress(UnicodeEncodeError):
            stream.write(line + "\n")
            stream.flush()


register("numba:compile", _Watch())
