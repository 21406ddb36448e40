"""A companion: a process that compiles loops beside this one, from the last that this one will need on.

numba's compiler has one lock a process. So the first loop that is missing on disk, or that comes to where none is
kept, starts another process (`rts.accompanying`), which finds out what such a call needs, begins in the last half of
it, and goes on until the two meet. This process tells which loops it misses; who compiles which is settled by locks
on single bytes of a nameless file. Nothing waits for the companion but a loop that it has begun, and it ends with
this process.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import threading
import zlib
from pathlib import Path
from typing import IO, Any

from rts.threads import cores, thread_count

if sys.platform != "win32":  # There each process compiles for itself.
    import fcntl

SWITCH = "RTS_COMPILE_AHEAD"
"""The environment variable that, if it is 0, keeps this process from starting a companion."""

SHARED = sys.platform != "win32"
"""Whether processes can tell one another what they compile."""

LEAST_SQUARES, LEAST_SQUARES_OF_MASKS = "least squares", "least squares of masks"
"""Kinds of calls that can be expected."""

_state: _Companion | None | bool = None
"""The companion of this process; None before one was needed, False where there is none."""

_expected: list[str] = []
_starting = threading.Lock()


def _renew() -> None:
    """In a fork nobody is starting one."""
    global _starting
    _starting = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)


def number(name: str) -> int:
    """A number for a name, the same in all processes."""
    return zlib.crc32(name.encode())


def expect(kind: str) -> None:
    """Say what kind of call is going on, where its first loops do not tell."""
    if kind not in _expected:
        _expected.append(kind)
        if isinstance(_state, _Companion):
            _state.tell(number(kind))


def prepare() -> None:
    """Start the companion of this process, if it may have one, since a loop will be missing."""
    global _state
    with _starting:
        if _state is None:
            _state = _started() if _may_start() else False


def begin(key: int) -> bool:
    """Say that a loop is missing on disk; whether another process has compiled it meanwhile, perhaps."""
    global _state
    prepare()
    if isinstance(_state, _Companion) and not _state.goes_on():
        _state = False
    return isinstance(_state, _Companion) and _state.begin(key)


def end(key: int) -> None:
    """Say that a loop is on disk now."""
    if isinstance(_state, _Companion):
        _state.claims.drop(key)


def _may_start() -> bool:
    return (
        SHARED
        and os.environ.get(SWITCH) != "0"
        and thread_count() > 1
        # Where others do the same work, there are no idle cores.
        and "PYTEST_XDIST_WORKER" not in os.environ
        and not _is_child()
        # Elsewhere the program is not Python: one that embeds it, or that was packed with it.
        and not getattr(sys, "frozen", False)
        and Path(sys.executable or "").name.lower().startswith(("python", "pypy"))
    )


def _is_child() -> bool:
    """Whether multiprocessing has started this process; it is imported there."""
    module = sys.modules.get("multiprocessing.process")
    return module is not None and module.parent_process() is not None


def _started() -> _Companion | bool:
    try:
        return _Companion()
    except (OSError, RuntimeError):  # No more processes, files, or threads; or the interpreter is about to end.
        return False


class Claims:
    """Which loop each of several processes compiles: locks on bytes of a file, which end with their process."""

    def __init__(self, file: IO[bytes]):
        self.file = file

    def take(self, key: int) -> bool:
        """Claim a loop, unless another process has it."""
        try:
            fcntl.lockf(self.file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, key)
        except (BlockingIOError, PermissionError):
            return False
        except OSError:  # Where files have no locks, each compiles for itself.
            return True
        return True

    def wait(self, key: int) -> None:
        """Claim a loop, once nobody else has it."""
        with contextlib.suppress(OSError):
            fcntl.lockf(self.file, fcntl.LOCK_EX, 1, key)

    def drop(self, key: int) -> None:
        """Give a claim back, if there is one."""
        with contextlib.suppress(OSError):
            fcntl.lockf(self.file, fcntl.LOCK_UN, 1, key)


def process(claims: Claims | None, everything: bool = False, stdin: Any = subprocess.PIPE, **options: Any) -> Any:
    """Start a process (`subprocess.Popen`) that compiles: what it is told is missing, and what goes with it, or all.

    It ends when its standard input does.
    """
    descriptor = -1 if claims is None else claims.file.fileno()
    command = [sys.executable, "-P", "-c", f"from rts.accompanying import serve; serve({descriptor}, {everything})"]
    # An empty entry of the path is the working directory.
    path = [p or os.getcwd() for p in sys.path if isinstance(p, str)]
    own = {"PYTHONPATH": os.pathsep.join(path), "RTS_NUM_THREADS": "1", SWITCH: "0"}
    if kept := getattr(getattr(sys.modules.get("numba"), "config", None), "CACHE_DIR", ""):
        own["NUMBA_CACHE_DIR"] = str(kept)
    return subprocess.Popen(
        command,
        env=os.environ | own,
        stdin=stdin,
        stdout=subprocess.DEVNULL,
        pass_fds=[] if claims is None else [descriptor],
        start_new_session=True,  # What interrupts this process is not for it.
        **options,
    )


class _Companion:
    """The other process, as this one sees it."""

    def __init__(self) -> None:
        self.claims = Claims(tempfile.TemporaryFile(buffering=0))
        try:
            self._start()
        except BaseException:
            self.claims.file.close()
            raise
        atexit.register(self._end)
        os.register_at_fork(after_in_child=self._forget)

    def goes_on(self) -> bool:
        """Whether there is one, again if it has ended since it had nothing to do for long."""
        if self._process.poll() != 0:
            return True
        self.stop()
        try:
            self._start()
        except (OSError, RuntimeError):
            atexit.unregister(self._end)
            return False
        return True

    def begin(self, key: int) -> bool:
        """See `begin`."""
        self.tell(key)
        if not self.claims.take(key):
            self.claims.wait(key)
        return True  # It may have been done before it was asked for.

    def tell(self, key: int) -> None:
        """Hand it a number; where it has failed, this process is alone."""
        with contextlib.suppress(OSError):
            # A program that lets broken pipes end it is not to be ended by this one.
            self._to.send(b"%d\n" % key, getattr(socket, "MSG_NOSIGNAL", 0))

    def stop(self) -> None:
        """End it, at once."""
        self._to.close()
        try:
            self._process.wait(2)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _start(self) -> None:
        self._to, end = socket.socketpair()
        try:
            with end:
                self._process = process(self.claims, stdin=end.fileno(), stderr=subprocess.DEVNULL)
        except BaseException:
            self._to.close()
            raise
        if sys.platform == "linux":
            with contextlib.suppress(OSError):
                os.sched_setaffinity(self._process.pid, cores())  # A helper that asks may be kept off one.
        self._to.settimeout(1)  # It reads whatever comes, unless it hangs.
        for kind in _expected:
            self.tell(number(kind))

    def _end(self) -> None:
        """At the end of this process, after which some thread or handler may miss a loop yet."""
        global _state
        _state = False
        self.stop()

    def _forget(self) -> None:
        """In a fork of this process: the companion is not its own."""
        global _state
        _state = False
        atexit.unregister(self._end)
        self._to.close()
        self._process.returncode = 0  # Not to be waited for.
