"""Calls that no signal interrupts: numba's import, and all that compiles or loads code.

Python raises KeyboardInterrupt in the main thread, between any two lines. Raised within numba, it leaves a module half
imported, or the lock of LLVM locked, for which every thread then waits for ever. In other threads it is never raised.
"""

from __future__ import annotations

import _thread
import threading
from collections.abc import Callable
from typing import Any


def uninterrupted(function: Callable, *args: Any) -> Any:
    """Call a function where no signal interrupts it: for the main thread, which waits, in a thread of its own.

    An interrupt is raised here as soon as the function is done. If it were raised before, a second one, while both
    threads import, could leave Python's own lock of imports locked.

    Args:
        function: what to call. It must not import a module that the main thread is importing.
        *args: passed on.

    Returns:
        What the function returns.
    """
    if threading.current_thread() is not threading.main_thread():
        return function(*args)
    ended: list[tuple[Any, BaseException | None]] = []
    going = threading.Lock()
    going.acquire()

    def call() -> None:
        try:
            ended.append((function(*args), None))
        except BaseException as error:
            ended.append((None, error))
        finally:
            going.release()

    raised: BaseException | None = None
    try:
        _thread.start_new_thread(call, ())  # `Thread.start` waits for the thread, and could be interrupted there.
    except RuntimeError:  # The system gives no more threads, or Python is about to exit.
        call()
    except BaseException as error:  # Python looks for signals once the thread has started.
        raised = error
    while not ended:
        try:
            going.acquire()
        except BaseException as error:  # Whether or not it is acquired.
            raised = error
    result, error = ended.pop()
    failure = error if raised is None else raised
    try:
        if failure is not None:
            raise failure
        return result
    finally:
        raised = error = failure = None  # Their tracebacks lead back to them.
