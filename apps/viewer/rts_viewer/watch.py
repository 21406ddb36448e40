"""A fit seen in the browser while it runs."""

from __future__ import annotations

import threading
import time
from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np

import rts
from rts.plugin_api.checks import check_numbers, index_table, quoted
from rts_viewer.glb import Triangles
from rts_viewer.history import History, State
from rts_viewer.page import Page
from rts_viewer.pictures import loss_curve

PAUSE = 0.25
"""The least time from one mesh to the next, seconds."""
SHARE = 30
"""The least time from one mesh to the next, in times of making one: a fit loses at most one part in 31 to it."""


class Watch:
    """A page in the browser that shows a fit while it runs, with buttons that pause and stop it.

    `begin` and `step` return at once, but for a fit that is paused: a thread of its own sends the newest mesh, some
    times a second, and leaves out those between. A slider goes back through at most 50 states.

        watch = rts_viewer.Watch()
        watch.begin(views)
        fit = rts.fit(residuals, vertices, callback=lambda step, p, loss: watch.step(step, loss, p, faces, None))
        watch.end()
        watch.wait()  # until "close" is pressed, or Ctrl-C

    Pages of other sites that are open in a browser are refused: they can neither look nor press buttons.

    Args:
        port: the port of the page.
        host: the address that the page is served at. By default only this machine sees it; "0.0.0.0" is for all, who
            then open it by the machine's address or its name.

    Attributes:
        url: the address to open.

    Raises:
        InputError: the port is in use, or the host is no address of this machine.
        PluginError: viser is not installed.
    """

    def __init__(self, port: int = 8080, host: str = "127.0.0.1"):
        self._page = Page(port, host, "rts")
        self.url = self._page.url
        self._changed, self._lock, self._labels = threading.Condition(), threading.Lock(), threading.Lock()
        self._going, self._closing = threading.Event(), threading.Event()
        self._add_controls()
        self._restart()
        self._sender = threading.Thread(target=self._send, daemon=True)
        self._sender.start()

    def _add_controls(self) -> None:
        gui = self._page.gui
        self._text = gui.add_markdown("no step yet")
        self._curve = gui.add_image(loss_curve(np.zeros(0), np.zeros(0)), format="png")
        self._slider = gui.add_slider("step", min=0, max=1, step=1, initial_value=0)
        self._follow = gui.add_checkbox("follow", True)
        self._pause_button, self._stop_button = gui.add_button("pause"), gui.add_button("stop")
        self._slider.on_update(self._slid)
        self._follow.on_update(self._followed)
        self._pause_button.on_click(lambda _: self.go_on() if self.paused else self.pause())
        self._stop_button.on_click(self._pressed_stop)

    def _restart(self) -> None:
        self._history, self._steps, self._losses = History(), array("d"), array("d")
        self._chosen: int | None = None
        self._over = self._stopped = self._turned = self._dirty = False
        self._going.set()

    # ------------------------------------------------------------------------------------------- what fits call

    def begin(self, views: Sequence[rts.View] | None = None) -> None:
        """Begin a fit: forget the last one, and show the cameras of views with their pictures.

        Raises:
            InputError: `views` holds something else, or a camera that is orthographic.
        """
        views = list(views or ())
        for view in views:
            if not isinstance(view, rts.View):
                raise rts.InputError(f"views holds {quoted(view)}; expected rts.View, as rts.load_views gives")
        with self._lock, self._changed:
            self._restart()
            self._page.hide()
            self._page.cameras(views)
        self._label()

    def step(self, number: int, loss: float, vertices: Any, faces: Any, colors: Any = None) -> bool:
        """Show a step of a fit. While the fit is paused, wait.

        Args:
            number: the step; steps are in ascending order.
            loss: its loss.
            vertices: (V, 3), world space; copied.
            faces: (T, 3) integers into the vertices; copied.
            colors: (V, 3) linear, in [0, 1]; copied. None for white.

        Returns:
            True once "stop" was pressed; give it to `rts.fit` as the result of its `callback`.

        Raises:
            InputError: an array of another shape, or with values that are not finite.
        """
        state = self._checked(number, loss, vertices, faces, colors)
        with self._changed:
            self._history.add(state)
            self._steps.append(state.number)
            self._losses.append(state.loss)
            self._dirty = True
            self._changed.notify()
        self._going.wait()
        return self._stopped

    def end(self) -> None:
        """Say that the fit has ended. The page stays, with its slider, until `close` or the end of the process."""
        self._over = True
        self._going.set()
        self._label()

    # ------------------------------------------------------------------------------- what buttons, and users, call

    @property
    def paused(self) -> bool:
        """True while `step` waits."""
        return not self._going.is_set()

    def pause(self) -> None:
        """Have the next `step` wait."""
        if not (self._over or self._stopped):
            self._going.clear()
            self._label()

    def go_on(self) -> None:
        """End a pause."""
        self._going.set()
        self._label()

    def stop(self) -> None:
        """Have `step` return True from now on; a pause ends."""
        self._stopped = True
        self._going.set()
        self._label()

    def wait(self) -> None:
        """Wait until "close" is pressed, which takes the place of "stop" after `end`, or for Ctrl-C; then `close`."""
        try:
            self._closing.wait()
        except KeyboardInterrupt:
            pass
        self.close()

    def close(self) -> None:
        """End the page."""
        with self._labels:  # No button is in the middle of a change.
            self._closing.set()
        self._going.set()
        with self._changed:
            self._changed.notify()
        with self._lock:  # The page is not in the middle of a state, and `_send` shows no other.
            self._page.close()
        self._sender.join(timeout=5)

    # ------------------------------------------------------------------------------------------------ inside

    def _checked(self, number: int, loss: float, vertices: Any, faces: Any, colors: Any) -> State:
        """A state of private copies."""
        count = len(vertices) if np.ndim(vertices) else 0
        points = np.array(check_numbers("vertices", vertices, (count, 3)), np.float32)
        shades = None if colors is None else np.array(check_numbers("colors", colors, (count, 3)), np.float32)
        newest = self._history.newest
        if newest is not None and np.array_equal(faces, newest.faces):
            table = newest.faces  # Kept once.
        else:
            table = index_table("faces", faces, 3)
        if len(table) == 0 or table.max() >= count:
            raise rts.InputError(f"faces {quoted(table)} do not fit {count} vertices; expected indices of these")
        return State(int(number), float(loss), points, table, shades)

    def _label(self) -> None:
        """Say on the buttons what they do, and have the page brought up to date, unless it is closed."""
        with self._labels:
            if self._closing.is_set():
                return
            self._pause_button.label = "go on" if self.paused else "pause"
            self._pause_button.disabled = self._over or self._stopped
            self._stop_button.label = "close" if self._over else "stop"
            if self._chosen is not None:
                self._follow.value = False
        with self._changed:
            self._dirty = True
            self._changed.notify()

    def _slid(self, event: Any) -> None:
        if event.client is not None:  # Else the program moved it.
            self._chosen = int(self._slider.value)
            self._label()

    def _pressed_stop(self, _: Any) -> None:
        if self._over:  # In a thread of its own, since the server waits for that of the button.
            threading.Thread(target=self.close, daemon=True).start()
        else:
            self.stop()

    def _followed(self, event: Any) -> None:
        if event.client is not None:
            self._chosen = None if self._follow.value else int(self._slider.value)
            self._label()

    def _send(self) -> None:
        """Send what is newest, until the page is closed."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._dirty or self._closing.is_set())
                self._dirty = False
                history, newest = self._history, self._history.newest
                shown = newest if self._chosen is None else history.nearest(self._chosen)
                steps, losses = np.array(self._steps), np.array(self._losses)
            if self._closing.is_set():
                return
            start = time.perf_counter()
            with self._lock:
                if self._closing.is_set():
                    return
                if newest is not None and shown is not None and history is self._history:  # No fit began meanwhile.
                    self._show(shown, newest, steps, losses)
            self._closing.wait(max(PAUSE, SHARE * (time.perf_counter() - start)))

    def _show(self, shown: State, newest: State, steps: np.ndarray, losses: np.ndarray) -> None:
        self._page.show("fit", Triangles(shown.vertices, shown.faces, colors=shown.colors))
        if not self._turned:
            self._page.look(shown.vertices)
            self._turned = True
        how = "ended" if self._over else "stopped" if self._stopped else "paused" if self.paused else "running"
        self._text.content = f"**step {shown.number}**, loss {shown.loss:.4g}; {how} at step {newest.number}"
        self._curve.image = loss_curve(steps, losses)
        self._slider.max = max(newest.number, 1)
        if self._chosen is None:
            self._slider.value = newest.number
