"""A companion: a process that compiles kernels beside this one, from the last that this one will need on.

numba's compiler has one lock a process. So where kernels are not on disk, the first that is missing starts another
process, which finds out what such a call needs (`rts.rehearsal`), begins at the end of it, and goes on until the two
meet. This process tells which kernels it misses; who compiles which is settled by locks on single bytes of a nameless
file. Nothing waits for the companion but a kernel that it is about to finish, and it ends with this process.
"""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO, Any

from rts.threads import thread_count

try:
    import fcntl
except ImportError:  # Not on Windows; there each process compiles for itself.
    fcntl = None

SWITCH = "RTS_COMPILE_AHEAD"
"""The environment variable that, if it is 0, keeps this process from starting a companion."""

PATIENCE = 30.0
"""Seconds after which a companion without anything to do ends."""

_state: _Companion | None | bool = None
"""The companion of this process; None before one was needed, False where there is none."""


def begin(key: int) -> bool:
    """Say that a kernel is missing on disk; whether another process has compiled it meanwhile, perhaps."""
    global _state
    if _state is None:
        _state = _started() if _may_start() else False
    return isinstance(_state, _Companion) and _state.begin(key)


def end(key: int) -> None:
    """Say that a kernel is on disk now."""
    if isinstance(_state, _Companion):
        _state.claims.drop(key)


def _may_start() -> bool:
    return (
        fcntl is not None
        and os.environ.get(SWITCH) != "0"
        and thread_count() > 1
        # Where others do the same work, there are no idle cores.
        and "PYTEST_XDIST_WORKER" not in os.environ
        and multiprocessing.parent_process() is None
        # Elsewhere the program is not Python: one that embeds it, or that was packed with it.
        and not getattr(sys, "frozen", False)
        and Path(sys.executable or "").name.lower().startswith(("python", "pypy"))
    )


def _started() -> _Companion | bool:
    try:
        return _Companion()
    except (OSError, RuntimeError):  # No more processes, files, or threads; or the interpreter is about to end.
        return False


class Claims:
    """Which kernel each of several processes compiles: locks on bytes of a file, which end with their process."""

    def __init__(self, file: IO[bytes]):
        self.file = file

    def take(self, key: int) -> bool:
        """Claim a kernel, unless another process has it."""
        try:
            fcntl.lockf(self.file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, key)
        except OSError:
            return False
        return True

    def wait(self, key: int) -> None:
        """Claim a kernel, once nobody else has it."""
        with contextlib.suppress(OSError):
            fcntl.lockf(self.file, fcntl.LOCK_EX, 1, key)

    def drop(self, key: int) -> None:
        """Give a claim back, if there is one."""
        with contextlib.suppress(OSError):
            fcntl.lockf(self.file, fcntl.LOCK_UN, 1, key)


def process(claims: Claims, everything: bool = False, **options: Any) -> subprocess.Popen:
    """Start a process that compiles: what it is told is missing, and what goes with it, or everything.

    It ends when its standard input does.
    """
    number = claims.file.fileno()
    command = [sys.executable, "-P", "-c", f"from rts.companion import serve; serve({number}, {everything})"]
    own = {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p), "RTS_NUM_THREADS": "1", SWITCH: "0"}
    return subprocess.Popen(
        command,
        env=os.environ | own,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        pass_fds=[number],
        start_new_session=True,  # What interrupts this process is not for it.
        **options,
    )


class _Companion:
    """The other process, as this one sees it."""

    def __init__(self) -> None:
        self.claims = Claims(tempfile.TemporaryFile(buffering=0))
        self._process = process(self.claims, stderr=open("/tmp/cold/err.txt","w"), bufsize=0)
        atexit.register(self.stop)
        os.register_at_fork(after_in_child=self._forget)

    def begin(self, key: int) -> bool:
        """See `begin`."""
        stdin = self._process.stdin
        assert stdin is not None
        try:
            if not stdin.closed:
                stdin.write(b"%d\n" % key)
        except OSError:  # It has ended.
            self.stop()
        if not self.claims.take(key):
            self.claims.wait(key)
        return True  # It may have been done before it was asked for.

    def stop(self) -> None:
        """End it, at once."""
        stdin = self._process.stdin
        assert stdin is not None
        if stdin.closed:
            return
        stdin.close()
        try:
            self._process.wait(2)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _forget(self) -> None:
        """In a fork of this process: the companion is not its own."""
        global _state
        _state = False
        atexit.unregister(self.stop)
        stdin = self._process.stdin
        assert stdin is not None
        stdin.close()
        self._process.returncode = 0  # Not to be waited for.


# ------------------------------------------------------------------------------------------- within the other process


def serve(number: int, everything: bool) -> None:
    """Compile, one kernel after another, until there is nothing more to do or the standard input ends.

    Args:
        number: of the file of the claims.
        everything: whether to compile all that is known, and let errors through; else what goes with the kernels
            whose numbers come in.
    """
    missed: SimpleQueue[int] = SimpleQueue()
    threading.Thread(target=_listen, args=(missed,), daemon=True).start()
    claims = Claims(os.fdopen(number, "r+b", buffering=0))
    for key, need in _all() if everything else _asked(missed):
        if claims.take(key):
            with contextlib.nullcontext() if everything else contextlib.suppress(Exception):
                need.kernel.compile(need.types)
            claims.drop(key)


def _listen(missed: SimpleQueue[int]) -> None:
    from rts.compiling import saving

    # Without a buffer, whose lock a thread that waits would hold as the interpreter ends.
    for line in os.fdopen(sys.stdin.fileno(), "rb", buffering=0, closefd=False):
        missed.put(int(line))
    with saving:
        os._exit(1)


def _all() -> Iterator[tuple[int, Any]]:
    from rts import rehearsal

    done: set[int] = set()
    for route in rehearsal.routes():
        yield from ((key, need) for key, need in route.items() if key not in done)
        done |= route.keys()


def _asked(missed: SimpleQueue[int]) -> Iterator[tuple[int, Any]]:
    """What to compile next, with its number: of the first route that has all that was missed, from its end."""
    from rts import rehearsal

    ahead, known = rehearsal.routes(), []
    seen: list[int] = []
    done: set[int] = set()
    idle = False
    while True:
        try:
            while True:
                seen.append(missed.get(timeout=PATIENCE) if idle else missed.get_nowait())
                idle = False
        except Empty:
            if idle:
                return
        route = _route(seen, known, ahead)
        key = next((key for key in reversed(route) if key not in done and key not in seen), None)
        if key is None:
            idle = True
            continue
        done.add(key)
        yield key, route[key]


def _route(seen: list[int], known: list[dict[int, Any]], ahead: Iterator[dict[int, Any]]) -> dict[int, Any]:
    """The first of all routes that has all that was seen, or else most; `known` grows as `ahead` is walked."""
    for route in known:
        if route.keys() >= set(seen):
            return route
    for route in ahead:
        known.append(route)
        if route.keys() >= set(seen):
            return route
    return max(known, key=lambda route: len(route.keys() & set(seen)))
