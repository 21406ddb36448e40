"""The page in the browser: viser's server behind `Front`, and the meshes and cameras that it shows."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import rich

import rts
from rts_viewer.address import check_address, url
from rts_viewer.front import Front, hidden_address
from rts_viewer.glb import Triangles, glb
from rts_viewer.pictures import small

PICTURE = 128
"""The most pixels along a side of a picture on a frustum."""
FRUSTUM = 0.12
"""Size of frustums over the distance of cameras from their middle."""
DISTANCE = 2.4
"""Distance of the first look from an object over the radius of the object."""


class Page:
    """A page in the browser, on a server of its own, which runs until `close`.

    Args:
        port: the port of the server.
        host: the address that it listens at; "0.0.0.0" lets other machines see the page. Pages of other sites do not.
        label: the title of the panel.

    Attributes:
        url: the address to open.
        gui: viser's panel of buttons.

    Raises:
        InputError: there can be no server at this address, such as where the port is in use.
        PluginError: viser is not installed.
    """

    def __init__(self, port: int, host: str, label: str):
        try:
            import viser
            from viser.transforms import SO3
        except ImportError as error:
            raise rts.errors.PluginError(f"the viewer needs viser ({error}): pip install ./apps/viewer") from error
        check_address(host, port)
        before, (address, free) = set(threading.enumerate()), hidden_address()
        with _quiet():
            self._server = viser.ViserServer(host=address, port=free, label=label, verbose=False)
        self._threads, self._front = set(threading.enumerate()) - before, None
        self._turn = SO3.from_matrix
        self.url, self.gui = url(host, port), self._server.gui
        self._meshes: dict[str, Any] = {}
        self._frustums: list[Any] = []
        self._lock = threading.Lock()
        self._up = np.array([0.0, 1.0, 0.0])
        self._sphere: tuple[np.ndarray, float] | None = None
        try:
            self._front = Front(host, port, (address, self._server.get_port()))
        except OSError:  # Taken since it was tried.
            self.close()
            check_address(host, port)
            raise rts.InputError(f"port {port} of {host} is in use; give another port (--port)") from None
        # No button that would send the scene to a server elsewhere.
        self.gui.configure_theme(show_logo=False, show_share_button=False)
        self.turn_up(self._up)
        self._server.on_client_connect(self._place)

    def close(self) -> None:
        """End the server; browsers show that the connection is lost."""
        with self._lock:  # Frustums that are still to come are left out: a server that has ended takes none.
            self._frustums = []
        with _quiet():
            if any(thread.is_alive() for thread in self._threads):
                self._server.stop()
            for thread in self._threads:
                thread.join(timeout=5)
        if self._front is not None:
            self._front.close()

    def turn_up(self, direction: np.ndarray) -> None:
        """Show a direction (3,) of world space upright."""
        self._up = np.asarray(direction, np.float64) / np.linalg.norm(direction)
        self._server.scene.set_up_direction(self._up)

    def show(self, name: str, mesh: Triangles) -> None:
        """Show a mesh; it takes the place of an earlier one of this name."""
        data = glb(mesh)
        if name in self._meshes:
            self._meshes[name].glb_data = data
        else:
            self._meshes[name] = self._server.scene.add_glb(f"/{name}", data, cast_shadow=False, receive_shadow=False)

    def hide(self) -> None:
        """Take all meshes and cameras off the page."""
        with self._lock:
            for handle in (*self._meshes.values(), *self._frustums):
                handle.remove()
            self._meshes, self._frustums = {}, []

    def look(self, vertices: np.ndarray) -> None:
        """Turn all browsers, and those that come, to the object of these vertices (V, 3), from the right and above."""
        low, high = vertices.min(axis=0).astype(np.float64), vertices.max(axis=0).astype(np.float64)
        center = (low + high) / 2
        self._sphere = center, float(np.linalg.norm(vertices - center, axis=1).max()) or 1.0
        for client in self._server.get_clients().values():
            self._place(client)

    def _place(self, client: Any) -> None:
        """Place a browser's camera."""
        if self._sphere is None:
            return
        center, radius = self._sphere
        front = np.array([0.0, 0, 1]) if abs(self._up[2]) < 0.9 else np.array([0.0, -1, 0])
        front -= (front @ self._up) * self._up
        front /= np.linalg.norm(front)
        right = np.cross(self._up, front)
        back = 0.81 * front + 0.47 * right + 0.34 * self._up  # 30° to the right, 20° above.
        client.camera.up_direction = self._up
        client.camera.position = center + DISTANCE * radius * back
        client.camera.look_at = center
        client.camera.near, client.camera.far = radius / 100, 1000 * radius

    def cameras(self, views: Sequence[rts.View]) -> None:
        """Show the cameras of views as frustums, upright on the whole; their pictures follow as they are read.

        Raises:
            InputError: a camera is orthographic.
        """
        if not views:
            return
        poses = []
        for view in views:
            K, R, t = (np.asarray(x, np.float64) for x in view.camera.to_opencv(view.size))
            poses.append((K, R, -R.T @ t))
        up = -np.mean([R[1] for _, R, _ in poses], axis=0)
        if np.linalg.norm(up) > 0.3:  # Else the cameras do not agree.
            self.turn_up(up)
        places = np.stack([place for _, _, place in poses])
        spread = np.median(np.linalg.norm(places - places.mean(axis=0), axis=1))
        scale = FRUSTUM * float(spread or np.linalg.norm(places[0]) or 1)
        arguments = list(views), poses, scale, self._frustums
        threading.Thread(target=self._add_frustums, args=arguments, daemon=True).start()

    def _add_frustums(self, views: Sequence[rts.View], poses: Sequence[tuple], scale: float, own: list[Any]) -> None:
        width: Any = {"thickness": 2.0, "thickness_units": "screen"}
        for number, (view, (K, R, place)) in enumerate(zip(views, poses, strict=True)):
            height, across = view.size
            fov, turn = 2 * np.arctan(height / (2 * K[1, 1])), self._turn(R.T).wxyz
            aspect = across / height * K[1, 1] / K[0, 0]
            shape = {"fov": float(fov), "aspect": float(aspect), "scale": scale, "wxyz": turn, "position": place}
            try:
                picture = small(np.asarray(view.image), PICTURE)
            except rts.InputError:  # The picture is gone; where it was taken from is known.
                picture = None
            with self._lock:
                if own is not self._frustums:  # Hidden, or closed, meanwhile.
                    return
                own.append(self._server.scene.add_camera_frustum(f"/cameras/{number}", **shape, image=picture, **width))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Hold back what viser prints, by `rich`, in the block."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
