"""The command `rts view`; imports are inside it, so that `rts --help` is quick."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape


def view(
    model: Annotated[Path, typer.Argument(help="OBJ, PLY, STL, GLB, glTF, OFF, …", show_default=False)],
    port: Annotated[int, typer.Option(help="The port of the page.")] = 8080,
    host: Annotated[
        str, typer.Option(help="The address that the page is served at: 0.0.0.0 lets other machines see it.")
    ] = "127.0.0.1",
    views: Annotated[
        Path | None, typer.Option(help="A data set of pictures with cameras, as rts.load_views reads it.")
    ] = None,
    surface: Annotated[
        str, typer.Option(help="Name of the surface that reads the model: mesh, or such as bezier for patches.")
    ] = "mesh",
    up: Annotated[
        str, typer.Option(help="The axis that is upright: y or z. Cameras of --views decide otherwise.")
    ] = "y",
) -> None:
    """Show a model in the browser, until Ctrl-C.

    Example: rts view bunny.obj
    """
    import numpy as np

    import rts
    from rts_viewer.address import check_address
    from rts_viewer.model import triangles_of
    from rts_viewer.page import Page

    if up not in ("y", "z"):
        raise typer.BadParameter(f"{up!r} is no axis; expected y or z", param_hint="--up")
    check_address(host, port)
    meshes = [triangles_of(part) for part in rts.load(model, surface=surface)]
    seen = [] if views is None else rts.load_views(views)
    page, stopped = Page(port, host, model.name), []
    # An exception in place of a mark may be lost: where Python has nobody to give it to, as in finalizers.
    before = signal.signal(signal.SIGINT, lambda *_: stopped.append(True))
    try:
        page.turn_up(np.eye(3)["xyz".index(up)])
        page.cameras(seen)
        for number, mesh in enumerate(meshes):
            page.show(f"part {number}", mesh)
        page.look(np.concatenate([mesh.vertices for mesh in meshes]))
        faces = sum(len(mesh.faces) for mesh in meshes)
        what = f"{model.name}, {faces} triangles" + (f", {len(seen)} cameras" if seen else "")
        Console(soft_wrap=True, highlight=False).print(escape(f"{page.url} shows {what}; Ctrl-C ends it"))
        while not stopped:
            time.sleep(0.1)
    finally:
        signal.signal(signal.SIGINT, before)
        page.close()
