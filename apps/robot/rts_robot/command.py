"""The command `rts calibrate`. Slow modules are imported as it runs, so that `rts --help` is quick."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

POOR = 0.7
"""An IoU below which a view is likely to be wrong."""


def calibrate(
    urdf: Annotated[Path, typer.Argument(help="The robot's URDF.", show_default=False)],
    masks: Annotated[
        Path, typer.Option(help="Folder of masks, in the order of their names: white where the robot is, or alpha.")
    ],
    joints: Annotated[
        Path,
        typer.Option(
            help="Values of joints in each view, radians and metres: .json, a list of {joint: value}, or an object of "
            "these by the masks' names; or .csv, a row of joints' names, then a row for each mask."
        ),
    ],
    intrinsics: Annotated[
        str | None, typer.Option(help="fx,fy,cx,cy in pixels, as OpenCV has them.", show_default=False)
    ] = None,
    fov: Annotated[
        float | None,
        typer.Option(help="Vertical field of view in degrees, in place of --intrinsics.", show_default=False),
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option(
            help="JSON with a rough camera_to_base, such as an earlier calibration.json; else it is looked for."
        ),
    ] = None,
    offsets: Annotated[
        str, typer.Option(help="Joints to whose values an unknown number is added: names with commas, or all.")
    ] = "",
    loss: Annotated[
        str, typer.Option(help="cauchy, huber or soft_l1, where masks are wrong in part or hidden; or linear.")
    ] = "cauchy",
    f_scale: Annotated[
        float | None,
        typer.Option(help="The difference, of 1, beyond which a robust loss counts less; 0.5.", show_default=False),
    ] = None,
    packages: Annotated[
        Path | None, typer.Option(help="Folder of the packages that package:// names.", show_default=False)
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the search for a start.")] = 0,
    out: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")] = Path("calibration"),
) -> None:
    """Find where a camera stands that looks at a robot, from masks and joint values.

    Writes calibration.json (camera_to_base, its covariance, offsets of joints, IoU of each view) and report.html.

    Example: rts calibrate panda.urdf --masks masks/ --joints joints.json --fov 45 -o out/camera
    """
    import rts
    from rts_robot.calibration import calibrate as calibrated
    from rts_robot.inputs import read_intrinsics, read_joints, read_masks, read_start
    from rts_robot.report import write_json, write_page
    from rts_robot.robot import load_urdf

    names, pictures = read_masks(masks)
    matrix = read_intrinsics(intrinsics, fov, pictures[0].shape)
    rows, begin = read_joints(joints, names), None if start is None else read_start(start)
    robot = load_urdf(urdf, packages)
    wanted = robot.names if offsets == "all" else [name.strip() for name in offsets.split(",") if name.strip()]
    if out.exists() and not out.is_dir():
        raise rts.InputError(f"{out} is a file; expected a folder for the results, which is made if it is missing")
    found = calibrated(
        robot, pictures, rows, matrix, start=begin, offsets=wanted, loss=loss, f_scale=f_scale, seed=seed
    )
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "calibration.json", found, names, matrix)
    write_page(out / "report.html", robot, found, names, pictures)
    say = Console(soft_wrap=True, highlight=False).print
    say(escape(f"{found!r}; {found.seconds:.1f} s; wrote calibration.json and report.html in {out}"))
    for name, value in found.offsets.items():
        say(escape(f"  {name}: {value:+.5f} ± {found.offset_deviations[name]:.2g}"))
    poor = [name for name, iou in zip(names, found.ious, strict=True) if iou < POOR]
    if poor:
        say(
            escape(
                f"  poor fit: {', '.join(poor)} overlap with an IoU below {POOR}; is it this robot, are joints in the "
                f"masks' order, and is the camera's lens right?"
            )
        )
        raise typer.Exit(3)
