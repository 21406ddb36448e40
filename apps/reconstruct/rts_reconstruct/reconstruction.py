"""Photographs with cameras in, a mesh out: `reconstruct`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

import rts
from rts.diagnostics.measuring_api import output_folder, writing
from rts_reconstruct import files, job, measures, pictures, posing, stages, texturing
from rts_reconstruct.cameras import with_cameras
from rts_reconstruct.light import decoded
from rts_reconstruct.model import Model
from rts_reconstruct.report import write_report
from rts_reconstruct.saved import Saved
from rts_reconstruct.starts import start as starting_mesh
from rts_reconstruct.untangling import untangled

STEPS, SIZE, TEXTURE = 1300, 256, 1024
QUICK = {"steps": 240, "size": 128, "texture": 512, "faces": 0.25}
"""What `quick` makes of the defaults; `faces` is a factor."""
TEXTURE_SHARE = 0.2
"""Steps of the texture, as a share of those of the shape."""
PAUSE_S = 0.5
"""The least time between two calls of a viewer."""
GREY = 0.5


class Watch(Protocol):
    """A viewer of a running reconstruction."""

    def begin(self, views: list[rts.View]) -> None:
        """Called before the first step, with the views that are fitted, in the world of the vertices of `step`.

        Their images are linear, as those of `rts.load_views` are by default.
        """

    def step(self, number: int, loss: float, vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray) -> bool:
        """Called at most every half second, and may take its time; a true result ends the fit.

        Args:
            number: the number of the step, counted through all stages.
            loss: its loss.
            vertices: (V, 3) float32.
            faces: (T, 3) int32; they change between stages.
            colors: (V, 3) linear.
        """
        ...

    def end(self) -> None:
        """Called when the fit has ended, however it did."""


class Reconstruction(NamedTuple):
    """The outcome of `reconstruct`.

    Attributes:
        model: the mesh and its colours, in the world of `pictures`.
        pictures: the pictures that it was fitted to.
        measures: PSNR, SSIM and IoU of each view.
        psnr: the mean PSNR of the views that were held out, or of all without any, dB.
        seconds: the time of all stages.
        files: the files written.
    """

    model: Model
    pictures: pictures.Pictures
    measures: list[measures.Measured]
    psnr: float
    seconds: float
    files: list[Path]

    def __repr__(self) -> str:
        kind = "held-out views" if self.pictures.held_out else "fitted views"
        kind += ", their cameras fitted" if any(m.held_out and m.camera == "fitted" for m in self.measures) else ""
        faces = f"{len(self.model.faces)} faces"
        return f"PSNR {self.psnr:.1f} dB ({kind}), {faces}, {self.seconds:.0f} s"


def reconstruct(
    views: Any,
    out: Any,
    *,
    start: Any = "ball",
    surface: str = "mesh",
    steps: int | None = None,
    size: int | None = None,
    batch: int = 4,
    texture: int | None = None,
    held_out: int = 8,
    fit_cameras: bool = False,
    light: bool = False,
    background: Any = None,
    quick: bool = False,
    seed: int = 0,
    resume: bool = False,
    watch: Watch | None = None,
    progress: bool | None = None,
) -> Reconstruction:
    """Fit a mesh with colours to photographs with cameras, and write it.

    Three stages fit the shape and its colours, each on a finer mesh, which is moved apart where it passes through
    itself; a last one fits a texture. Colours have the light of the pictures in them, unless `light` is True. The mesh
    is written after each stage, so that an interruption leaves the last one.

    Where pictures have alpha, it tells where the object is. Where they have masks alone, these do. Pictures that have
    neither need a plain background; colours alone are compared then.

    Under torchrun processes share the pictures of a step, and the first one writes.

    Args:
        views: file or folder, as `rts.load_views` takes it; a folder of photographs alone, whose cameras are
            looked for; or a list of views with sRGB-encoded images.
        out: the folder to write into.
        start: "ball"; "hull", the visual hull of alpha or masks; or the path of a mesh in the world of the cameras.
        surface: "mesh"; "isosurface", for stages that fit values on a lattice, whose surface may change its topology,
            and a last one that fits the mesh of it; or "subdivision", for stages that fit the cage of a Loop
            subdivision surface, which is smooth between its fewer control points. The files hold a fine mesh of it.
        steps: the steps of all stages of the shape, by default 1300; the texture takes a fifth as many on top.
        size: pixels; longer sides of pictures are made at most so long, by default 256.
        batch: the number of pictures in a step.
        texture: texels a side, by default 1024; 0 for vertex colours.
        held_out: every so many views, one is held out and only measured; 0 for none.
        fit_cameras: True to fit the poses of cameras, too, and write them; those of views held out are fitted to the
            finished mesh, since fitted cameras and mesh may have moved together.
        light: True to tell light and colours apart in the end, and write colours as in even light, and the light. It is
            one environment, of spherical harmonics to the second order, whose mean irradiance is 1, since pictures do
            not tell bright light from bright colours. Near points are taken to be of one material, but for edges.
        background: (3,) encoded colour of pictures without alpha and masks; None for that of their borders.
        quick: True for a first look: smaller defaults, and a quarter of the faces.
        seed: of the order of pictures.
        resume: True to go on where an interrupted reconstruction in `out` was.
        watch: a viewer, or None.
        progress: True for progress bars; None for only on a terminal.

    Returns:
        The mesh, measures of all views, and the files.

    Raises:
        InputError: an argument of the wrong kind; pictures that cannot be read, are too few, or tell no object; a start
            that no view sees; or a folder that cannot be written.
    """
    defaults: dict[str, Any] = QUICK if quick else {"steps": STEPS, "size": SIZE, "texture": TEXTURE, "faces": 1}
    steps = int(defaults["steps"]) if steps is None else steps
    size = int(defaults["size"]) if size is None else size
    texture = int(defaults["texture"]) if texture is None else texture
    _check(
        steps=(steps, 3), size=(size, 8), batch=(batch, 1), texture=(texture, 0), held_out=(held_out, 0), seed=(seed, 0)
    )
    if surface not in ("mesh", "subdivision", "isosurface"):
        raise rts.InputError(f"surface is {surface!r:.60}; expected 'mesh', 'subdivision' or 'isosurface'")
    rts.plugin("surfaces", surface)  # Refused now where OpenSubdiv is missing.
    if 0 < texture < 16:
        raise rts.InputError(f"texture is {texture}; expected at least 16 texels a side, or 0 for vertex colours")
    folder = output_folder(out)
    first = job.join()
    views = job.shared(lambda: with_cameras(views, folder / "photographs"))
    shots = pictures.read(views, size, held_out, background)
    mesh = starting_mesh(start, shots)
    grey = np.full((len(mesh.vertices), 3), GREY, np.float32)
    poses = np.zeros((len(shots.numbers), 6), np.float32)
    model = Model(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32), grey, poses)
    settings = stages.Settings(batch, seed, fit_cameras, surface, progress)
    plan = [(s._replace(faces=int(defaults["faces"] * s.faces)), max(1, round(s.share * steps))) for s in stages.STAGES]
    with writing(folder):
        (folder / "checkpoint").mkdir(parents=True, exist_ok=True)
    identity = {"steps": steps, "size": size, "batch": batch, "seed": seed, "start": str(start), "views": shots.numbers}
    identity |= {"texture": texture, "cameras": fit_cameras, "quick": quick, "surface": surface}
    saved = Saved(folder / "checkpoint", identity)
    run = _Run(shots, settings, saved, watch if first else None, model, folder, first)
    run.begin(resume)
    try:
        for number, (stage, count) in enumerate(plan):
            run.shape(number, stage, count)
        if texture:
            run.texture(len(plan), texture, max(1, round(TEXTURE_SHARE * steps)))
    finally:
        if run.watch is not None:
            run.watch.end()
    return run.finish(light)


def _linear(view: rts.View) -> rts.View:
    """The view with a linear image, read when it is needed."""

    def image() -> np.ndarray:
        encoded = view.image
        return np.concatenate([decoded(encoded[..., :3]), encoded[..., 3:]], axis=-1)

    return rts.View(view.camera, image, view.size, name=view.name)


def _check(**given: tuple[Any, int]) -> None:
    for name, (value, least) in given.items():
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
            raise rts.InputError(f"{name} is {value!r:.60}; expected a whole number, at least {least}")


class _Run:
    """A reconstruction that runs: the model so far, losses of each stage, the viewer, and the files."""

    def __init__(
        self,
        shots: pictures.Pictures,
        settings: stages.Settings,
        saved: Saved,
        watch: Watch | None,
        model: Model,
        folder: Path,
        first: bool,
    ):
        self.pictures, self.settings, self.saved, self.watch = shots, settings, saved, watch
        self.model, self.folder, self.first = model, folder, first
        self.losses: list[list[float]] = []
        self.files: list[Path] = []
        self.stopped, self.seconds = False, 0.0
        self._looked, self._started = -PAUSE_S, time.perf_counter()

    def begin(self, resume: bool) -> None:
        """Read what an earlier run has kept, or forget it."""
        if resume and (kept := job.shared(self.saved.read)) is not None:
            self.model, self.losses, self.seconds = kept
        elif not resume and self.first:
            self.saved.forget()
        self._started = time.perf_counter() - self.seconds
        if self.watch is not None:
            self.watch.begin([_linear(view) for view in self.pictures.views])

    def shape(self, number: int, stage: stages.Stage, steps: int) -> None:
        """A stage of shape and colours, unless an earlier run made it."""
        if number < len(self.losses) or self.stopped:
            return
        fit, losses = stages.fitted(self.model, self.pictures, stage, steps, self.settings, *self._reporting(number))
        self._keep(fit._replace(vertices=job.shared(lambda: untangled(fit.vertices, fit.faces))), losses)

    def texture(self, number: int, size: int, steps: int) -> None:
        """The stage of the texture, unless an earlier run made it; one that was stopped is baked alone."""
        if number < len(self.losses):
            return
        model = texturing.baked(self.model, size)
        if self.stopped:
            self._keep(model, [])
            return
        self._keep(*texturing.fitted(model, self.pictures, steps, self.settings, *self._reporting(number)))

    def _reporting(self, number: int) -> tuple[Path, Any]:
        """The file of a stage's fit, and its callback."""
        before = sum(map(len, self.losses))

        def report(step: int, loss: float, now: Any) -> bool:
            if self.watch is not None and time.perf_counter() - self._looked >= PAUSE_S:
                vertices, faces, colors = now()
                stop = self.watch.step(before + step, loss, vertices, faces, decoded(colors))
                self._looked = time.perf_counter()
                self.stopped = self.stopped or bool(stop)
            return self.stopped

        return self.saved.running(number), report

    def _keep(self, model: Model, losses: list[float]) -> None:
        """Note the outcome of a stage, and write its mesh."""
        self.model, self.stopped = model, job.shared(lambda: self.stopped)
        self.losses.append(losses)
        self.seconds = time.perf_counter() - self._started
        if self.first:
            with writing(self.folder):
                self.files = files.write_mesh(self.folder, model, self.pictures)
                self.saved.write(model, self.losses, self.seconds)

    def finish(self, light: bool) -> Reconstruction:
        """Tell light from colours, if asked to; measure all views, and write the rest."""
        if self.settings.cameras and self.pictures.held_out:
            self.model = posing.posed(self.model, self.pictures, self.settings)
        if light:
            self.model = job.shared(lambda: texturing.in_even_light(self.model))
        rows = measures.measured(self.model, self.pictures)
        psnr = measures.mean_of(rows, "psnr", bool(self.pictures.held_out))
        assert psnr is not None
        found = Reconstruction(self.model, self.pictures, rows, psnr, self.seconds, [])
        if not self.first:
            return found
        with writing(self.folder):
            self.files = files.write_mesh(self.folder, self.model, self.pictures)
            self.files += files.write_light(self.folder / "light.json", self.model)
            if self.settings.cameras:
                self.files += files.write_cameras(self.folder, self.model, self.pictures)
            table, turning, report = (self.folder / name for name in ("views.csv", "turntable.gif", "report.html"))
            files.write_table(table, rows)
            files.write_turntable(turning, self.model, self.pictures)
            write_report(report, self.model, self.pictures, rows, self.losses, repr(found))
        return found._replace(files=[*self.files, table, turning, report])
