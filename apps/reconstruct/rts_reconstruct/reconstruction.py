"""Photographs with cameras in, a mesh out: `reconstruct`."""

from __future__ import annotations

import functools
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import rts
from rts.tool_api.files import output_folder, writing
from rts_reconstruct import files, job, outlining, picture_files, pictures, refining, stages
from rts_reconstruct.arguments import check_counts, check_other_folder, checked_masks, checked_region
from rts_reconstruct.cameras import with_cameras
from rts_reconstruct.contradictions import INEXACT, consistency, contradictions
from rts_reconstruct.model import Model
from rts_reconstruct.run import Reconstruction, Run, Watch
from rts_reconstruct.saved import Saved
from rts_reconstruct.starts import start as starting_mesh

STEPS, SIZE, TEXTURE = 1300, 256, 1024
QUICK = {"steps": 240, "size": 128, "texture": 512, "faces": 0.25}
"""What `quick` makes of the defaults; `faces` is a factor."""
FINER = 2
"""Pixels of pictures that the texture is fitted to, along each side, for one of those of the shape."""
TEXTURE_SHARE = 0.2
"""Steps of the texture, as a share of those of the shape."""
GREY = 0.5
GAIN = 0.03
"""By how much more refined masks must overlap with pictures of what they have in common, to be taken."""


def reconstruct(
    views: Any,
    out: Any,
    *,
    start: Any = None,
    surface: str = "mesh",
    steps: int | None = None,
    size: int | None = None,
    batch: int = 4,
    texture: int | None = None,
    held_out: int = 8,
    fit_cameras: bool = False,
    light: bool = False,
    trim: bool = False,
    background: Any = None,
    masks: Any = "object",
    region: Any = None,
    quick: bool = False,
    seed: int = 0,
    resume: bool = False,
    watch: Watch | None = None,
    progress: bool | None = None,
) -> Reconstruction:
    """Fit a mesh with colours to photographs with cameras, and write it.

    Three stages fit the shape and its colours, or two that start from points. Each has a finer mesh, which is moved
    apart where it passes through itself. A last one fits a texture, to which the pictures as they are add detail.
    Colours have the light of the pictures in them, unless `light` is True. The mesh is written after each stage, so
    that an interruption leaves the last one. A verdict says in the end what is wrong.

    Where pictures have alpha, it tells where the object is. Where they have masks alone, these do. Where they have
    neither, COLMAP's points do: what lies before them is empty, and a solid of what lies behind them gives outlines and
    the start. Without points a plain background is needed; colours alone are compared then.

    Under torchrun processes share the pictures of a step, and the first one writes.

    Args:
        views: file or folder, as `rts.load_views` takes it; a folder of photographs alone, whose cameras are
            looked for; or a list of views with sRGB-encoded images.
        out: the folder to write into.
        start: "ball"; "hull", the visual hull of alpha or masks; "points", a solid of COLMAP's points; or the path of a
            mesh in the world of the cameras. None for "points" where these tell the outlines, else "ball".
        surface: "mesh"; "isosurface", for stages that fit values on a lattice, whose surface may change its topology,
            and a last one that fits the mesh of it; or "subdivision", for stages that fit the cage of a Loop
            subdivision surface, which is smooth between its fewer control points. The files hold a fine mesh of it.
        steps: the steps of all stages of the shape, by default 1300; the texture takes a fifth as many on top.
        size: pixels; longer sides of pictures are made at most so long, by default 256, and twice so for the texture.
        batch: the number of pictures in a step.
        texture: texels a side, by default 1024; 0 for vertex colours.
        held_out: every so many views, one is held out and only measured; 0 for none.
        fit_cameras: True to fit the poses of cameras, too, and a factor on their focal lengths, and to write them;
            together they stay where they were given, as large. Poses of views held out are fitted to the
            finished mesh, since fitted cameras and mesh may have moved together.
        light: True to tell light and colours apart in the end, and write colours as in even light, and the light. It is
            one environment, of spherical harmonics to the second order, whose mean irradiance is 1, since pictures do
            not tell bright light from bright colours. Near points are taken to be of one material, but for edges.
        trim: True to cut away the surface that no picture which is fitted sees; it is filled from beside otherwise.
            Patches of less than a thousandth of the surface stay, so that creases get no holes.
        background: (3,) encoded colour of pictures without alpha and masks; None for that of their borders.
        masks: "object" for masks that are white where the object is; "ignore" for masks that are black where pixels do
            not count, as COLMAP has them; or a folder of masks such as this function writes, white, black, and grey.
        region: x, y, z and radius of a ball that the object is in, world of the cameras; None for the ball about the
            densest of COLMAP's points that half of the cameras look at.
        quick: True for a first look: smaller defaults, and a quarter of the faces.
        seed: of the order of pictures.
        resume: True to go on where an interrupted reconstruction in `out` was.
        watch: a viewer, or None.
        progress: True for progress bars; None for only on a terminal.

    Returns:
        The mesh, measures of all views, and the files.

    Raises:
        InputError: an argument of the wrong kind; pictures that cannot be read, are too few, or tell no object; a start
            that no view sees; or a folder to write into that cannot be written, or has the pictures.
    """
    defaults: dict[str, Any] = QUICK if quick else {"steps": STEPS, "size": SIZE, "texture": TEXTURE, "faces": 1}
    steps = int(defaults["steps"]) if steps is None else steps
    size = int(defaults["size"]) if size is None else size
    texture = int(defaults["texture"]) if texture is None else texture
    check_counts(
        steps=(steps, 3), size=(size, 8), batch=(batch, 1), texture=(texture, 0), held_out=(held_out, 0), seed=(seed, 0)
    )
    if surface not in ("mesh", "subdivision", "isosurface"):
        raise rts.InputError(f"surface is {surface!r:.60}; expected 'mesh', 'subdivision' or 'isosurface'")
    rts.plugin("surfaces", surface)  # Refused now where OpenSubdiv is missing.
    if 0 < texture < 16:
        raise rts.InputError(f"texture is {texture}; expected at least 16 texels a side, or 0 for vertex colours")
    folder = output_folder(out)
    check_other_folder(folder, views)
    first = job.join()
    views = job.shared(lambda: with_cameras(views, folder / "photographs"))
    masks, region = checked_masks(masks), checked_region(region)
    read = functools.partial(
        pictures.read, views, held_out=held_out, background=background, masks=masks, region=region, start=start
    )
    shots = read(size=size)
    contradiction = job.shared(lambda: contradictions(shots))
    shots = pictures.without(shots, contradiction.liars)
    before = after = job.shared(lambda: consistency(shots))
    refine = False
    if before < INEXACT and shots.by_masks and job.shared(refining.is_installed):
        refined = pictures.without(_refined(read, size), contradiction.liars)
        found = job.shared(lambda: consistency(refined)) if refined.outlined else 0.0
        refine = found > before + GAIN
        shots, after = (refined, found) if refine else (shots, before)
    mesh = starting_mesh(start, shots)
    grey = np.full((len(mesh.vertices), 3), GREY, np.float32)
    poses = np.zeros((len(shots.numbers), 6), np.float32)
    model = Model(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32), grey, poses)
    settings = stages.Settings(batch, seed, fit_cameras, surface, progress, robust=after < INEXACT)
    near = mesh is shots.solid  # Which the first stage's few faces would make coarser.
    plan = [
        (s._replace(faces=int(defaults["faces"] * s.faces)), max(1, round(s.share * steps)))
        for s in stages.STAGES[near:]
    ]
    with writing(folder):
        (folder / "checkpoint").mkdir(parents=True, exist_ok=True)
        if first:
            files.forget_unfinished(folder)
            if shots.by_points and shots.solid is not None:
                outlining.write_masks(folder / "masks", shots.given, shots.numbers, shots.solid, shots.world)
            elif refine:
                outlining.write_alphas(folder / "masks", shots.given, shots.numbers)
    if first:
        for note in _notes(shots, folder, contradiction.lines, before, after):
            print(f"rts: {note}", file=sys.stderr)
    identity = {"steps": steps, "size": size, "batch": batch, "seed": seed, "start": str(start), "views": shots.numbers}
    identity |= {"texture": texture, "cameras": fit_cameras, "quick": quick, "surface": surface}
    identity |= {"masks": str(masks), "region": region, "refined": refine}
    saved = Saved(folder / "checkpoint", identity)
    run = Run(
        shots,
        settings,
        saved,
        watch if first else None,
        model,
        folder,
        first,
        lambda: pictures.without(read(size=FINER * size, refine=refine), contradiction.liars),
    )
    run.begin(resume)
    try:
        for number, (stage, count) in enumerate(plan):
            run.shape(number, stage, count)
        if texture:
            run.texture(len(plan), texture, max(1, round(TEXTURE_SHARE * steps)))
    finally:
        if run.watch is not None:
            run.watch.end()
    return run.finish(light, trim)


def _refined(read: Callable[..., pictures.Pictures], size: int) -> pictures.Pictures:
    """The pictures with refined masks; what their reading warns of has been said of the pictures as they are."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rts.errors.RtsWarning)
        return read(size=size, refine=True)


def _notes(shots: pictures.Pictures, folder: Path, told: Sequence[str], before: float, after: float) -> list[str]:
    """Lines on what the points and masks tell, before the fit."""
    notes = [*picture_files.turned(shots.given), *picture_files.repeated(shots.given), *told]
    seen = folder / "masks"
    if after > before:
        notes.append(
            "outlines of masks were moved to edges of the pictures, which makes masks overlap with pictures of what "
            f"they have in common by {after:.2f} in the median, not {before:.2f}; look at {seen}, and mend them with "
            f"--masks {seen}"
        )
    if after < INEXACT:
        lacking = shots.by_masks and not refining.is_installed()
        notes.append(
            f"masks overlap with pictures of what they have in common by {after:.2f} in the median, where right ones "
            "do by some 0.9: they are inexact, or cameras are off, for which there is --fit-cameras; large differences "
            "count less in the fit" + ("; with OpenCV (the extra photos) masks are refined by the pictures" * lacking)
        )
    if shots.by_points and shots.region is not None:
        ball = ",".join(f"{x:.4g}" for x in (*shots.region.center, shots.region.unit))
        notes.append(
            f"the pictures have neither alpha nor masks: COLMAP's points tell the object; look at {seen}, "
            f"and mend them with --masks {seen}, or the region with --region={ball} (x,y,z,radius)"
        )
    return notes
