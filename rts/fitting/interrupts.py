"""Ctrl-C in a fit."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def interrupts_held_back() -> Iterator[None]:
    """Have Ctrl-C interrupt only after the computation in the block; a second Ctrl-C interrupts at once.

    Python raises KeyboardInterrupt between any two lines, also of torch and jax. Raised in torch, it may leave forward
    mode switched on, and all derivatives fail from then on. A compiled program of jax that calls Python cannot pass it
    on: the program fails with an error of jax's, or goes on. A step is short, and between steps everything is whole.

    The interrupt then goes to the signal handler that was set before. Nothing changes in threads other than the main
    one, which are never interrupted, and where no Python handler is set.
    """
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        yield
        return
    held, raised = False, None

    def hold_back(number: int, frame: Any) -> None:
        nonlocal held, raised
        if not held:
            held = True
            return
        try:
            handler(number, frame)
        except BaseException as error:
            raised = error
            raise

    try:
        signal.signal(signal.SIGINT, hold_back)
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if raised is not None:
            raise raised from None
        if held:
            signal.raise_signal(signal.SIGINT)
