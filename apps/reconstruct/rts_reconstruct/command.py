"""The command `rts reconstruct`. Slow modules are imported as it runs, so that `rts --help` is quick."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

import rts


def reconstruct(
    views: Annotated[
        Path,
        typer.Argument(
            help="Pictures with cameras: transforms.json, COLMAP, LLFF, cameras.json; or photographs alone."
        ),
    ],
    out: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")] = Path("reconstruction"),
    start: Annotated[
        str | None,
        typer.Option(help="ball, hull (of alpha or masks), points (COLMAP's), or a file.", show_default=False),
    ] = None,
    surface: Annotated[str, typer.Option(help="mesh; isosurface: holes may open; or subdivision: smooth.")] = "mesh",
    steps: Annotated[int | None, typer.Option(help="Steps of the shape; 1300.", show_default=False)] = None,
    size: Annotated[
        int | None,
        typer.Option(help="Longer side of pictures, at most; 256, and for a texture 512.", show_default=False),
    ] = None,
    batch: Annotated[int, typer.Option(help="Pictures in a step.")] = 4,
    texture: Annotated[
        int | None, typer.Option(help="Texels a side; 1024. 0 for vertex colours.", show_default=False)
    ] = None,
    held_out: Annotated[int, typer.Option(help="Hold out every so many views, to measure only; 0 for none.")] = 8,
    fit_cameras: Annotated[bool, typer.Option("--fit-cameras", help="Fit poses and focal length, too.")] = False,
    light: Annotated[
        bool, typer.Option("--light", help="Tell light from colours, and write colours as in even light.")
    ] = False,
    trim: Annotated[bool, typer.Option("--trim", help="Cut away the surface that no picture sees.")] = False,
    background: Annotated[
        str | None, typer.Option(help="R,G,B from 0 to 1, of pictures without alpha and masks; else that of borders.")
    ] = None,
    masks: Annotated[
        str, typer.Option(help="object: white where it is; ignore: black does not count; or a folder of mended ones.")
    ] = "object",
    region: Annotated[
        str | None, typer.Option(help="X,Y,Z,RADIUS of a ball that the object is in; else as COLMAP's points tell.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A first look: small pictures, few steps and faces.")] = False,
    seed: Annotated[int, typer.Option(help="Of the order of pictures.")] = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where an interrupted run was.")] = False,
    watched: Annotated[bool, typer.Option("--watch", help="Show the fit in the browser, by apps/viewer.")] = False,
    port: Annotated[int, typer.Option(help="The port of that page.")] = 8080,
) -> None:
    """Fit a textured mesh to photographs with cameras.

    Writes mesh.obj, mesh.glb, turntable.gif, views.csv and report.html. Ends with a verdict; status 3 says that the
    mesh does not look like the pictures.

    Example: rts reconstruct photos/ -o out/thing --quick && open out/thing/report.html
    """
    from rts_reconstruct.job import first
    from rts_reconstruct.reconstruction import reconstruct as reconstructed

    watch = _viewer(port) if watched and first() else None
    try:
        found = reconstructed(
            views,
            out,
            start=start,
            surface=surface,
            steps=steps,
            size=size,
            batch=batch,
            texture=texture,
            held_out=held_out,
            fit_cameras=fit_cameras,
            light=light,
            trim=trim,
            background=None if background is None else _numbers("--background", background, "three", "1,1,1"),
            masks=masks,
            region=None if region is None else _numbers("--region", region, "four", "0,0,0,1"),
            quick=quick,
            seed=seed,
            resume=resume,
            watch=watch,
        )
    except KeyboardInterrupt:
        kept = f"{out / 'mesh.obj'} is of the last stage" if (out / "mesh.obj").is_file() else "no stage has ended"
        typer.echo(f"rts: interrupted; {kept}, and the same command with --resume goes on", err=True)
        raise typer.Exit(130) from None
    if first():
        names = ", ".join(file.name for file in found.files)
        _say(f"{found!r}: {names} in {out}")
        _say(str(found.verdict))
    if watch is not None:
        _say(f"{watch.url} shows the result until “close” is pressed there, or Ctrl-C here")
        watch.wait()
    if found.verdict.blob:
        raise typer.Exit(3)


def cameras(
    photos: Annotated[Path, typer.Argument(help="Folder of photographs of one thing that stands still.")],
    out: Annotated[Path, typer.Option("--output", "-o", help="Folder for the data set.")] = Path("cameras"),
    size: Annotated[int, typer.Option(help="Longer side, in pixels, in which features are looked for.")] = 1600,
) -> None:
    """Find the cameras of photographs, by COLMAP.

    Writes a folder that rts reconstruct and other tools read: images, and sparse/0.

    Example: rts cameras photos/ -o thing && rts reconstruct thing/ -o out/thing
    """
    from rts_reconstruct.cameras import find_cameras

    _say(f"{find_cameras(photos, out, size=size)}; {out} is a data set of COLMAP")


def _say(text: str) -> None:
    Console(soft_wrap=True, highlight=False).print(escape(text))


def _viewer(port: int) -> Any:
    """A page in the browser, whose address is printed."""
    try:
        from rts_viewer import Watch
    except ImportError:
        raise rts.errors.PluginError("--watch needs the distribution rts-viewer: pip install ./apps/viewer") from None
    watch = Watch(port=port)
    _say(f"{watch.url} shows the fit")
    return watch


def _numbers(option: str, text: str, count: str, example: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise rts.InputError(f"{option} is {text!r:.60}; expected {count} numbers, such as {example}") from None
