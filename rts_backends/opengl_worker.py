"""One thread that owns one headless OpenGL context: contexts belong to the thread that made them."""

from __future__ import annotations

import atexit
import contextlib
import queue
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import moderngl

from rts.errors import PluginError

VERSION = 330
HINT = (
    "on Debian install the packages libegl1 and libgl1-mesa-dri (or your vendor's driver); the variable "
    "GLCONTEXT_DEVICE_INDEX chooses among several devices; or use the sampler 'raster'"
)


class Worker:
    """Runs functions of the context, one at a time. The context is made when first needed and released at exit."""

    def __init__(self) -> None:
        self._tasks: queue.SimpleQueue[tuple[Callable, tuple, Future] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._start = threading.Lock()
        self.context: moderngl.Context | None = None

    def call(self, function: Callable, *args: Any) -> Any:
        """`function(context, *args)` on the worker's thread; its result, or its exception."""
        with self._start:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="rts-opengl", daemon=True)
                self._thread.start()
                atexit.register(self.close)
        future: Future = Future()
        self._tasks.put((function, args, future))
        return future.result()

    def later(self, function: Callable, *args: Any) -> None:
        """The same without waiting, for clean-up; nothing where the worker has ended."""
        if self._thread is not None and self._thread.is_alive():
            self._tasks.put((function, args, Future()))

    def close(self) -> None:
        """Release the context and end the thread."""
        if self._thread is not None and self._thread.is_alive():
            self._tasks.put(None)
            self._thread.join(timeout=5)
        self._thread = None

    def _run(self) -> None:
        while (task := self._tasks.get()) is not None:
            function, args, future = task
            try:
                if self.context is None:
                    self.context = _create()
                result = function(self.context, *args)
                if (error := self.context.error) != "GL_NO_ERROR":
                    raise PluginError(f"OpenGL reports {error} on {self.context.info['GL_RENDERER']}; {HINT}")
                future.set_result(result)
            except BaseException as error:
                future.set_exception(error)
                if isinstance(error, PluginError) and self.context is not None:
                    lost, self.context = self.context, None  # Perhaps: the next call makes another.
                    with contextlib.suppress(Exception):
                        lost.release()
                    del lost
            del task, function, args, future
        if self.context is not None:
            self.context.release()
            self.context = None


def _create() -> moderngl.Context:
    options = {"backend": "egl"} if sys.platform.startswith("linux") else {}
    try:
        return moderngl.create_context(require=VERSION, standalone=True, **options)
    except Exception as error:  # moderngl raises bare Exceptions.
        raise PluginError(f"no headless OpenGL {VERSION / 100:.1f} context can be made ({error}); {HINT}") from error
