"""One thread that owns one headless OpenGL context: only the thread that made a context may use it."""

from __future__ import annotations

import atexit
import contextlib
import os
import queue
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any

import moderngl

from rts.errors import PluginError

VERSION = 330
HINT = (
    "on Debian install the packages libegl1 and libgl1-mesa-dri (or your vendor's driver); the variable "
    "GLCONTEXT_DEVICE_INDEX chooses among several devices; or use the sampler 'raster'"
)
LESS = "render a smaller image, or use the sampler 'raster'"
FORKED = (
    "OpenGL was in use before the process was forked, and its threads do not live on in the child; "
    "start processes with the method 'spawn', or use the sampler 'raster'"
)
MOST_ERRORS = 32
"""Errors read at most at once: a lost context may report one for ever."""

_process: int | None = None
"""The process that first used OpenGL. The driver's own threads are lost in its children, for new contexts too."""


class Worker:
    """A thread that runs functions of its context, one at a time. The context is made when needed, released at exit."""

    def __init__(self) -> None:
        self._tasks: queue.SimpleQueue[tuple[Callable, tuple, Future] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._start = threading.Lock()
        self.context: moderngl.Context | None = None

    def __reduce__(self) -> tuple:
        """Pickle as a new worker: a copy, or one in another process, has a thread and a context of its own."""
        return Worker, ()

    def call(self, function: Callable, *args: Any) -> Any:
        """The result of `function(context, *args)`, run on the worker's thread; its exception is raised here.

        Raises:
            PluginError: the process was forked after OpenGL was in use, the thread has ended, or OpenGL reports an
                error.
        """
        global _process
        if _forked():
            raise PluginError(FORKED)
        _process = os.getpid()
        future: Future = Future()
        with self._start:
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._run, name="rts-opengl", daemon=True)
                self._thread.start()
                atexit.register(self.close)
            thread = self._thread
            self._tasks.put((function, args, future))
        while not wait([future], timeout=1).done:
            if not thread.is_alive() and not future.done():
                raise PluginError("the thread of the sampler 'opengl' has ended; call again to start another")
        return future.result()

    def later(self, function: Callable, *args: Any) -> None:
        """Run `function(context, *args)` in the thread without waiting for it, for clean-up.

        Nothing is done if the thread has not begun, or has ended, or in a forked child.
        """
        if not _forked() and self._thread is not None and self._thread.is_alive():
            self._tasks.put((function, args, Future()))

    def close(self) -> None:
        """Release the context and end the thread; do nothing in a forked child, whose context is its parent's."""
        if _forked():
            return
        with self._start:
            if self._thread is not None and self._thread.is_alive():
                self._tasks.put(None)
                self._thread.join(timeout=5)

    def _run(self) -> None:
        while (task := self._tasks.get()) is not None:
            function, args, future = task
            try:
                if self.context is None:
                    self.context = _create()
                result = function(self.context, *args)
                if errors := _errors(self.context):
                    raise PluginError(f"OpenGL reports {errors[0]} on {self.context.info['GL_RENDERER']}; {HINT}")
                future.set_result(result)
            except moderngl.Error as error:
                self._drop()
                refusal = PluginError(f"OpenGL failed ({' '.join(str(error).split())}); {LESS}")
                refusal.__cause__ = error
                future.set_exception(refusal)
                del refusal
            except PluginError as error:
                self._drop()
                future.set_exception(error)
            except BaseException as error:
                future.set_exception(error)
                if self.context is not None:
                    with contextlib.suppress(Exception):
                        _errors(self.context)  # Errors are cleared here, so that the next task does not find them.
            del task, function, args, future
        if self.context is not None:
            self.context.release()
            self.context = None

    def _drop(self) -> None:
        """Release a context that is perhaps lost; the next call makes another."""
        lost, self.context = self.context, None
        if lost is not None:
            with contextlib.suppress(Exception):
                lost.release()


def _forked() -> bool:
    return _process not in (None, os.getpid())


def _errors(context: moderngl.Context) -> list[str]:
    """The errors that the context has recorded, at most `MOST_ERRORS`; reading them clears them."""
    errors: list[str] = []
    while len(errors) < MOST_ERRORS and (error := context.error) != "GL_NO_ERROR":
        errors.append(error)
    return errors


def _create() -> moderngl.Context:
    options: dict[str, Any] = {"backend": "egl"} if sys.platform.startswith("linux") else {}
    try:
        return moderngl.create_context(require=VERSION, standalone=True, **options)
    except Exception as error:  # moderngl raises bare Exceptions.
        raise PluginError(f"no headless OpenGL {VERSION / 100:.1f} context can be made ({error}); {HINT}") from error
