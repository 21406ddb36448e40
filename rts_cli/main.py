"""The command line: `rts plugins`, `render`, `fit-pose`, `export`, `new`, `demo`, `warmup`, and installed commands."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape

from rts import Part, __version__
from rts.plugin_api.arrays import map_leaves
from rts_cli.command_group import CommandGroup
from rts_cli.options import (
    Debug,
    FieldOfView,
    OrbitAngles,
    SurfaceName,
    UpAxis,
    ViewOfModel,
    chosen_camera,
    color_of,
    environment_of,
    file_camera_of,
    is_given,
    layers_of,
    refuse_beside,
    refuse_without_light,
    sunlight,
    view_of,
)

EXAMPLES = """
Examples:

    rts demo

    rts render bunny.obj -o bunny.png --size 640x480 --camera 30,20 --shader normals

    rts fit-pose bunny.obj photo.png -o found
"""


app = typer.Typer(
    cls=CommandGroup,
    help="Differentiable surface rendering by rasterize-then-splat.\n" + EXAMPLES,
    rich_markup_mode="markdown",
    add_completion=False,
    pretty_exceptions_enable=False,
)


def main() -> None:
    """The entry point `rts`."""
    app(prog_name="rts")


def _say(text: str) -> None:
    Console(soft_wrap=True, highlight=False).print(text)


def _say_written(files: list[Path]) -> None:
    for file in files:
        _say(f"  {escape(str(file))}")


# ------------------------------------------------------------------------------------------------- options


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"rts {__version__}")
        raise typer.Exit


@app.callback()
def _global(
    debug: Debug = False,
    show_version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    pass


# ------------------------------------------------------------------------------------------------ commands


@app.command()
def plugins(
    matrix: Annotated[
        bool,
        typer.Option(
            "--matrix",
            help="Try each surface with each sampler and engine. ok: the image is that of the sampler 'reference' "
            "(for triangles; else finite and not empty), and its gradient is finite and not zero.",
        ),
    ] = False,
    only: Annotated[
        list[str] | None,
        typer.Option(help="With --matrix: a surface, sampler or engine to try; may be repeated.", show_default=False),
    ] = None,
) -> None:
    """List every plugin: engines, surfaces, samplers, shaders and splatters, and whether each one loads."""
    from rts_cli.plugin_tables import plugin_table, print_matrix
    from rts_cli.tried_versions import untried

    if matrix:
        print_matrix(Console(), only or ())
    elif only:
        raise typer.BadParameter("goes with --matrix", param_hint="--only")
    else:
        Console().print(plugin_table())
        if newer := untried():
            _say(escape(newer))


@app.command(epilog="Example: rts render bunny.obj -o bunny.png --size 640x480 --camera 30,20 --cull back")
def render(
    context: typer.Context,
    model: Annotated[Path, typer.Argument(help="OBJ, PLY, STL, GLB, glTF, OFF, …", show_default=False)],
    *,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="The picture to write: .png, .hdr or .exr; a .npz of arrays; with --clip a .gif or .mp4.",
        ),
    ] = Path("out.png"),
    outputs: Annotated[
        str,
        typer.Option(
            help="What to write, such as color,depth,normal; all but color as out.depth.png (16 bits) beside out.png. "
            "rts.render says which there are."
        ),
    ] = "color",
    surface: SurfaceName = "mesh",
    size: Annotated[str, typer.Option(help="Pixels: 256, or WIDTHxHEIGHT.")] = "256",
    camera: ViewOfModel = "30,20",
    fov: FieldOfView = 45.0,
    up: UpAxis = "y",
    sampler: Annotated[str, typer.Option(help="Name of a sampler, see `rts plugins`.")] = "auto",
    engine: Annotated[str, typer.Option(help="numpy, torch or jax.")] = "numpy",
    layers: Annotated[str, typer.Option(help="Layers kept at each pixel, or auto.")] = "auto",
    shader: Annotated[str, typer.Option(help="Name of a shader; auto is the model's own.")] = "auto",
    splatter: Annotated[str, typer.Option(help="Name of a splatter: edges, multi, single or none.")] = "auto",
    supersample: Annotated[str, typer.Option(help="Samples along each side of a pixel, such as 2.")] = "1",
    background: Annotated[str, typer.Option(help="A colour's name, #rrggbb, or none: transparent.")] = "none",
    cull: Annotated[
        str, typer.Option(help="none; back, to leave out triangles seen from behind; or file: where a glTF says so.")
    ] = "none",
    environment: Annotated[
        Path | None,
        typer.Option(
            help="A picture of all that surrounds the model, and lights it: .hdr, .exr or .png, twice as wide as high. "
            "Without it, and without --shadows, a GLB or glTF is lit by its own lights, if it has any."
        ),
    ] = None,
    shadows: Annotated[
        bool,
        typer.Option("--shadows", help="Light from above the camera's left shoulder, which casts shadows."),
    ] = False,
    exposure: Annotated[
        float | None,
        typer.Option(help="Stops by which a .png is made brighter; bright colours are then compressed, not clipped."),
    ] = None,
    pose: Annotated[
        Path | None,
        typer.Option(
            help="The pose.json of `rts fit-pose`, for its pose and camera, and its size unless --size is given."
        ),
    ] = None,
    clip: Annotated[
        str | None, typer.Option(help="A clip of a GLB or glTF, by its name or its number, from 0 on.")
    ] = None,
    time_: Annotated[
        float | None,
        typer.Option("--time", help="Seconds of the clip; 0 by default. A .gif shows all of it.", show_default=False),
    ] = None,
    profile: Annotated[
        bool, typer.Option("--profile", help="Show where the time goes, stage by stage, and what would help.")
    ] = False,
) -> None:
    """Render a model to a picture, or a clip of it to an animation."""
    import rts
    from rts.tool_api.files import load_lit, output_file
    from rts.tool_api.options import size_of, supersample_of
    from rts.tool_api.pictures import PICTURES, check_exposure
    from rts.tool_api.scenes import bounds_of, orbit
    from rts_cli.clip_frames import ANIMATIONS, FPS, check_animation, frames_of
    from rts_cli.output_files import check_names, names_of, write_outputs
    from rts_cli.pose_file import posed, read_pose

    shape, own_camera, color = size_of(size), file_camera_of(camera), color_of(background)
    view = view_of(camera) if own_camera is None else ()
    names = names_of(outputs)
    check_animation(output, clip, time_, names)
    output_file(output, "picture", (*PICTURES, ".npz", *(ANIMATIONS if clip is not None else ())))
    check_names(names, output)
    if exposure is not None and output.suffix.lower() != ".png":
        raise typer.BadParameter("--exposure is for a .png; .hdr and .exr hold colours of any brightness")
    check_exposure(exposure or 0.0)
    refuse_without_light({"--shadows": shadows, "--environment": environment}, shader)
    light: Any = None if environment is None else {"environment": environment_of(environment, up)}
    engine_object = rts.plugin("rts.engines", engine)()
    own_light = environment is None and not shadows
    if clip is None:
        loaded = load_lit(model, surface=surface, cull=cull, lights=own_light, cameras=own_camera is not None)
        frames = [loaded.parts]
        bounds = bounds_of(frames[0])
    else:
        refuse_beside("--clip", context, ("pose", "surface"))
        frames, bounds, loaded = frames_of(model, clip, time_, output.suffix.lower() in ANIMATIONS, cull)
    if own_light and loaded.lights:
        light = loaded.lights
    if pose is not None:
        refuse_beside("--pose", context, ("camera", "fov", "up"))
        matrix, seen, pose_size = read_pose(pose)
        shape = shape if is_given(context, "size") else pose_size
        frames = [posed(frames[0], matrix)]
        bounds = bounds_of(frames[0])
    elif own_camera is None:
        seen = orbit(bounds, shape, *view, fov=fov, up=up)
    else:
        refuse_beside(f"--camera {camera}", context, ("fov", "up") if environment is None else ("fov",))
        seen = chosen_camera(loaded.cameras, loaded.camera_names, own_camera, model)
        if isinstance(seen.aspect, float) and not is_given(context, "size"):
            shape = shape[0], max(round(shape[0] * seen.aspect), 1)
    distance = float(np.linalg.norm(np.linalg.inv(seen.view)[:3, 3] - bounds.center))
    extent = np.array([max(distance - bounds.radius, 0), distance + bounds.radius], np.float32)

    if shadows:
        light = sunlight(seen, light)

    def prepared(part: Part) -> Part:
        theta = {**part.theta, "depth_range": extent} if shader == "depth" else part.theta
        theta = theta if light is None else {**theta, "light": light}
        return part.replace(
            theta=map_leaves(engine_object.constant, theta),
            shader=part.shader if shader == "auto" else shader,
        )

    def lit(parts: list[Part]) -> list[Part]:
        scene = [prepared(part) for part in parts]
        if not shadows:
            return scene
        return rts.shadows.with_shadows(scene, light, size=2 * max(shape), bounds=bounds, sampler=sampler)

    options: dict[str, Any] = {"sampler": sampler, "splatter": splatter, "layers": layers_of(layers)}
    options["supersample"] = supersample_of(supersample)
    start = time.perf_counter()
    lines: list[str] = []
    parts = next(filter(None, frames))
    if output.suffix.lower() in ANIMATIONS:
        empty = np.full((*shape, 4), (0, 0, 0, 0) if color is None else (*color, 1), np.float32)
        images = (rts.render(lit(f), seen, shape, **options, background=color) if f else empty for f in frames)
        rts.save_animation(output, images, FPS)
    else:
        found = rts.render(lit(parts), seen, shape, **options, background=color, outputs=names)
        lines = write_outputs(output, {name: engine_object.to_numpy(x) for name, x in found.items()}, exposure)
    seconds = time.perf_counter() - start
    what = repr(parts[0].surface) if len(parts) == 1 else f"{len(parts)} parts"
    what += f", {len(frames)} frames" if len(frames) > 1 else ""
    lines = lines if names != ("color",) else []
    wrote = "wrote" if lines else f"wrote {output}"
    _say(escape(f"{what}, {shape[1]} x {shape[0]} pixels, {seconds * 1e3:.0f} ms; {wrote}"))
    for line in lines:
        _say(escape(f"  {line}"))
    if profile:
        typer.echo(rts.profile(lit(parts), seen, shape, **options))


@app.command(
    "fit-pose",
    epilog="Example: rts render bunny.obj -o mask.png --shader silhouette --splatter single --layers 1 "
    "--camera 45,30 && rts fit-pose bunny.obj mask.png -o found",
)
def fit_pose(
    model: Annotated[Path, typer.Argument(help="The model, seen by the camera in roughly the right pose.")],
    target: Annotated[
        Path,
        typer.Argument(help="The picture: its alpha is the silhouette, or its brightness where it is opaque."),
    ],
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")] = Path("pose"),
    surface: SurfaceName = "mesh",
    engine: Annotated[str, typer.Option(help="torch or jax; auto is whichever is installed.")] = "auto",
    method: Annotated[str, typer.Option(help="lm (Levenberg–Marquardt), adam or sgd.")] = "lm",
    steps: Annotated[int | None, typer.Option(help="At most so many at each stage.")] = None,
    camera: OrbitAngles = "30,20",
    fov: FieldOfView = 45.0,
    up: UpAxis = "y",
    fit_fov: Annotated[bool, typer.Option("--fit-fov", help="Fit the field of view, too; --fov is the start.")] = False,
    loss: Annotated[
        str,
        typer.Option(
            help="linear: the mean square of the difference. Where part of the mask is wrong, such as something in "
            "front, a robust one: soft_l1, huber or cauchy."
        ),
    ] = "linear",
    f_scale: Annotated[
        float | None,
        typer.Option(help="The difference, of 1, beyond which a robust loss counts less than its square: 0.1."),
    ] = None,
) -> None:
    """Find the turn and shift of a model that make its silhouette match a picture's: coarse, blurred pixels first.

    Writes pose.json (axis-angle, translation, 4x4 matrix; camera, size, field of view; loss, iterations, seconds;
    intersection over union and verdict), before.png, after.png, target.png, animation.gif and convergence.png.
    `rts render MODEL --pose pose.json` draws the model so.
    """
    import rts
    from rts.tool_api.files import output_folder
    from rts.tool_api.scenes import bounds_of, orbit
    from rts_cli.pose_fit import fit_pose as fit
    from rts_cli.pose_fit import silhouette_of
    from rts_cli.pose_report import write_report
    from rts_cli.pose_verdict import judged

    if f_scale is not None and loss == "linear":
        raise typer.BadParameter("--f-scale is for a robust --loss: soft_l1, huber or cauchy")
    view = view_of(camera)
    output_folder(output)
    parts = rts.load(model, surface=surface)
    picture = rts.load_image(target)
    mask = silhouette_of(picture)
    bounds = bounds_of(parts)
    seen = orbit(bounds, mask.shape, *view, fov=fov, up=up)
    engine_name = None if engine == "auto" else engine
    options: dict[str, Any] = {"method": method, "steps": steps, "fit_fov": fit_fov, "loss": loss, "f_scale": f_scale}
    result = fit(parts, mask, seen, bounds, engine=engine_name, **options)
    found = result.fit
    verdict = judged(result.pose, parts, mask, picture, robust=loss != "linear")
    files = write_report(output, result, verdict, parts, mask)
    _say(
        f"loss {result.first_loss:.3g} → {found.loss:.3g} in {len(found.history)} steps, {_sum(found.stages)} from "
        f"coarse and blurred pixels to fine, {found.seconds:.1f} s (at the finest, {found.reason}); wrote"
    )
    _say_written(files)
    _say_skipped_plot(files)
    seen_by = f", field of view {result.pose.fov_y:.1f} degrees" if fit_fov else ""
    _say(f"{verdict.word}: IoU {verdict.iou:.3f}{seen_by}")
    for note in verdict.notes:
        _say(escape(f"  {note}"))
    if not verdict.good:
        raise typer.Exit(3)


@app.command(epilog="Example: rts export teapot.txt --surface bezier -o teapot.obj --tolerance 0.0005")
def export(
    model: Annotated[Path, typer.Argument(help="The model.", show_default=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help="The mesh: .obj, .ply, .stl, .glb or .off.")] = Path(
        "mesh.obj"
    ),
    surface: SurfaceName = "mesh",
    tolerance: Annotated[
        float, typer.Option(help="How far triangles may be off the surface, as a share of the object's radius.")
    ] = 1e-3,
) -> None:
    """Make a mesh of a model's surface, its positions and triangles, and write it."""
    import rts
    from rts.tool_api.files import output_file
    from rts.tool_api.scenes import bounds_of
    from rts_cli.mesh_export import FORMATS, write_mesh

    output_file(output, "mesh", FORMATS)
    if not (np.isfinite(tolerance) and tolerance > 0):
        raise typer.BadParameter(f"the tolerance is {tolerance}; expected a positive share of the radius")
    parts = rts.load(model, surface=surface)
    vertices, faces = write_mesh(output, parts, tolerance * bounds_of(parts).radius)
    _say(escape(f"{vertices} vertices and {faces} triangles; wrote {output}"))


@app.command(epilog="Example: rts new surface blob && pip install -e 'rts-blob[test]' && pytest rts-blob")
def new(
    kind: Annotated[str, typer.Argument(help="surface, sampler, shader or splatter", show_default=False)],
    name: Annotated[str, typer.Argument(help="The plugin's name.", show_default=False)],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder to make; rts-NAME by default.", show_default=False)
    ] = None,
    triangles: Annotated[
        bool, typer.Option("--triangles", help="A surface that is sampled by triangles; else by rays.")
    ] = False,
) -> None:
    """Write a distribution that adds a plugin: its entry point, its class, and a test that passes as it is."""
    from rts_cli.new_plugin import write_plugin

    files = write_plugin(kind, name, output, triangles)
    _say("wrote")
    _say_written(files)


@app.command(epilog="Example: rts demo -o out && open out/summary.md")
def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")] = Path("out"),
    engine: Annotated[str, typer.Option(help="torch or jax; auto is whichever is installed.")] = "auto",
) -> None:
    """Recover the pose of a knot from its silhouette: no input needed, pictures and a summary written."""
    from rts.tool_api.files import output_folder
    from rts_cli.demo import run

    output_folder(output)
    result, files = run(output, None if engine == "auto" else engine)
    _say(f"pose found in {len(result.fit.history)} steps, {result.fit.seconds:.1f} s; wrote")
    _say_written(files)
    _say_skipped_plot(files)


@app.command(epilog="Example: rts warmup --processes 4")
def warmup(
    processes: Annotated[int, typer.Option(min=0, help="Processes at once; 0 is as many as there are cores.")] = 0,
) -> None:
    """Compile ahead the loops of ordinary renders and fits, in several processes. Otherwise first use compiles them."""
    import rts

    _say("compiling what is not on disk yet, up to a minute")
    _say(f"compiled and kept on disk, {rts.warmup(processes or None):.0f} s")


def _sum(counts: Iterable[int]) -> str:
    return " + ".join(map(str, counts))


def _say_skipped_plot(files: list[Path]) -> None:
    if not any(f.name == "convergence.png" for f in files):
        _say("no convergence.png, which needs matplotlib: pip install 'rasterize-then-splat\\[plots]'")
