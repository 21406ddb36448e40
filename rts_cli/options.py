"""Options that commands share, and how their texts are read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from rts import Camera, InputError


def layers_of(text: str) -> Any:
    """The `layers` written as "4" or "auto"."""
    if text != "auto" and not text.lstrip("-").isdecimal():
        raise typer.BadParameter(
            f"{text!r} is no number of layers; expected an integer, or auto", param_hint="'--layers'"
        )
    return text if text == "auto" else int(text)


def view_of(text: str) -> tuple[float, ...]:
    """Azimuth, elevation and optional distance, from comma-separated numbers."""
    try:
        numbers = tuple(float(x) for x in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (2, 3):
        raise typer.BadParameter(f'{text!r} is no camera; expected "azimuth,elevation" or "azimuth,elevation,distance"')
    return numbers


def file_camera_of(text: str) -> str | None:
    """The name or number of a file's camera, written as "file:NAME", "" for "file"; None for angles."""
    kind, _, name = text.partition(":")
    return name if kind == "file" else None


def chosen_camera(cameras: Sequence[Camera], names: Sequence[str], wanted: str, path: Path) -> Camera:
    """The camera of a file by its name or its number, from 0 on; the first one for "".

    Args:
        cameras: the file's cameras.
        names: the name of each.
        wanted: the name or number.
        path: the file, for messages.

    Raises:
        InputError: there is no such camera, or several have this name.
    """
    if names and not wanted:
        return cameras[0]
    numbers = [str(i) for i in range(len(names))]
    if names.count(wanted) == 1:
        return cameras[names.index(wanted)]
    if wanted in numbers:
        return cameras[numbers.index(wanted)]
    if not names:
        raise InputError(f"{path} has no camera; expected angles, such as --camera 30,20")
    there = ", ".join(f"{i} ({name!r})" if name else i for i, name in zip(numbers, names, strict=True))
    raise InputError(f"{wanted!r} is no camera of {path}; expected the name of one, or its number: {there}")


def color_of(text: str) -> tuple[float, ...] | None:
    """The linear colour (3,), 0 to 1, of a colour's name or "#rrggbb"; None for "none", which is transparent."""
    from PIL import ImageColor

    from rts.tool_api.pictures import decode_srgb

    if text == "none":
        return None
    try:
        return tuple(decode_srgb(np.array(ImageColor.getrgb(text)[:3]) / 255))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no colour; expected a name, #rrggbb, or none") from None


def environment_of(path: Path, up: str) -> Any:
    """The light of a picture of all that surrounds a scene, as θ["light"]["environment"], its top `up`, y or z."""
    import rts
    from rts.shading import prefiltered, turned_environment

    image = rts.load_image(path)[..., :3]
    if image.shape[1] != 2 * image.shape[0]:
        raise rts.InputError(
            f"{path} is {image.shape[1]} wide and {image.shape[0]} high; expected a picture of all directions "
            "(equirectangular), which is twice as wide as high"
        )
    if up == "z":  # A direction (x, y, z) is (x, z, −y) in the picture.
        image = turned_environment(image, np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float32))
    return prefiltered(image)


def sunlight(camera: Any, light: dict[str, Any] | None) -> dict[str, Any]:
    """θ["light"] with a distant light above the camera's left shoulder, beside light from all around."""
    from rts.tool_api.scenes import DEFAULT_LIGHT

    around = {"ambient": np.array(DEFAULT_LIGHT["ambient"], np.float32)} if light is None else light
    direction = np.asarray(camera.to_world(DEFAULT_LIGHT["direction"]), np.float32)
    return {**around, "direction": direction, "color": np.full(3, DEFAULT_LIGHT["color"], np.float32)}


def is_given(context: typer.Context, option: str) -> bool:
    """True if an option was given, and not left at its default."""
    source = context.get_parameter_source(option)
    return source is not None and source.name != "DEFAULT"


def refuse_beside(option: str, context: typer.Context, others: Sequence[str]) -> None:
    """Refuse other options that were given beside one that says the same."""
    for other in others:
        if is_given(context, other):
            raise typer.BadParameter(f"--{other} beside {option}, which says it already; leave one of them out")


def refuse_without_light(options: dict[str, Any], shader: str) -> None:
    """Refuse options that set the light, those whose value is true, beside a shader that no light falls on."""
    from rts import plugin

    given = [option for option, value in options.items() if value]
    reads = None if shader == "auto" or not given else plugin("rts.shaders", shader)().reads
    if reads is not None and "light" not in reads:
        raise typer.BadParameter(f"{given[0]} sets the light, and the shader {shader} has none; try lambert or pbr")


SurfaceName = Annotated[
    str, typer.Option(help="Name of the surface that reads the model: mesh, or such as bezier for patches.")
]


OrbitAngles = Annotated[
    str,
    typer.Option(
        "--camera",
        help="Azimuth,elevation[,distance] about the middle of the object: degrees, and world units. "
        "Without a distance the whole object is in view.",
    ),
]


ViewOfModel = Annotated[
    str,
    typer.Option(
        "--camera",
        help="Azimuth,elevation[,distance] about the middle of the object: degrees, and world units. "
        "Without a distance the whole object is in view. Or a camera of a GLB or glTF, which is never taken unasked: "
        "file for its first, file:NAME or file:NUMBER, from 0 on; without --size the picture then has its ratio.",
    ),
]


FieldOfView = Annotated[float, typer.Option(help="Vertical field of view in degrees.")]


UpAxis = Annotated[str, typer.Option(help="The axis that is upright: y or z.")]


Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error; may stand anywhere.")]
