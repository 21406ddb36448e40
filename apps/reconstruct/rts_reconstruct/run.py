"""A reconstruction that runs, stage by stage, and its outcome."""

from __future__ import annotations

import functools
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

import rts
from rts.tool_api.files import writing
from rts_reconstruct import detail, files, job, measures, pictures, posing, sight, stages, texturing
from rts_reconstruct.exposures import evened, exposures
from rts_reconstruct.light import decoded
from rts_reconstruct.model import Model
from rts_reconstruct.report import write_report
from rts_reconstruct.saved import Saved
from rts_reconstruct.untangling import untangled
from rts_reconstruct.verdict import Verdict, verdict

PAUSE_S = 0.5
"""The least time between two calls of a viewer."""


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
        verdict: whether the mesh looks like the pictures, what is wrong, and what to try.
    """

    model: Model
    pictures: pictures.Pictures
    measures: list[measures.Measured]
    psnr: float
    seconds: float
    files: list[Path]
    verdict: Verdict

    def __repr__(self) -> str:
        kind = "held-out views" if self.pictures.held_out else "fitted views"
        kind += ", their cameras fitted" if any(m.held_out and m.camera == "fitted" for m in self.measures) else ""
        faces = f"{len(self.model.faces)} faces"
        return f"PSNR {self.psnr:.1f} dB ({kind}), {faces}, {self.seconds:.0f} s"


class Run:
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
        finer: Callable[[], pictures.Pictures],
    ):
        self.pictures, self.settings, self.saved, self.watch = shots, settings, saved, watch
        self._taken = shots  # As they are, in whatever exposure.
        self._read_finer = finer
        self.model, self.folder, self.first = model, folder, first
        self.losses: list[list[float]] = []
        self.files: list[Path] = []
        self.stopped, self.seconds = False, 0.0
        self._looked, self._started = -PAUSE_S, time.perf_counter()

    def begin(self, resume: bool) -> None:
        """Read what an earlier run has kept, or forget it."""
        if resume and (kept := job.shared(self.saved.read)) is not None:
            self.model, self.losses, self.seconds, found = kept
            self.pictures = evened(self._taken, found)
        elif not resume and self.first:
            self.saved.forget()
        self._started = time.perf_counter() - self.seconds
        if self.watch is not None:
            self.watch.begin([_linear(view) for view in self.pictures.views])

    def shape(self, number: int, stage: stages.Stage, steps: int) -> None:
        """A stage of shape and colours, unless an earlier run made it."""
        if number < len(self.losses) or self.stopped:
            return
        settings = self.settings._replace(robust=self.settings.robust and number > 0)  # At first all is far off.
        fit, losses = stages.fitted(self.model, self.pictures, stage, steps, settings, *self._reporting(number))
        fit = fit._replace(vertices=job.shared(lambda: untangled(fit.vertices, fit.faces)))
        if self.settings.cameras:
            fit = posing.refined(fit, self.pictures, self.settings)
        # Exposures of pictures, as the model tells them, are taken out of what is fitted next.
        self.pictures = evened(self._taken, job.shared(lambda: exposures(fit, self._taken)))
        self._keep(fit, losses)

    def texture(self, number: int, size: int, steps: int) -> None:
        """The stage of the texture, unless an earlier run made it; one that was stopped is baked alone."""
        if number < len(self.losses):
            return
        known = job.shared(lambda: sight.seen(self.model, self.pictures))
        model = texturing.baked(sight.filled(self.model, known), size)
        if self.stopped:
            self._keep(model, [])
            return
        self._keep(*texturing.fitted(model, known, self._finer, steps, self.settings, *self._reporting(number)))

    @functools.cached_property
    def _finer(self) -> pictures.Pictures:
        """Larger pictures, if there are any, for the texture: its shape is known."""
        shots = self.pictures
        if all(a.size == b.size for a, b in zip(shots.given, shots.views, strict=False)):
            return shots
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rts.errors.RtsWarning)  # The smaller ones have warned.
            return evened(self._read_finer(), shots.exposures)

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
                self.saved.write(model, self.losses, self.seconds, self.pictures.exposures)

    def finish(self, light: bool, trim: bool) -> Reconstruction:
        """Add detail, tell light from colours and cut the unseen away if asked to, measure views, write the rest."""
        if self.settings.cameras and self.pictures.held_out:
            held_out = range(len(self.pictures.views), len(self.pictures.numbers))
            self.model = posing.posed(self.model, self.pictures, self.settings, held_out)
        known = job.shared(lambda: sight.seen(self.model, self.pictures))
        if self.model.atlas is None:
            self.model = sight.filled(self.model, known)
        else:
            self.model = job.shared(lambda: detail.detailed(self.model, self._finer))
        if light:
            self.model = job.shared(lambda: texturing.in_even_light(self.model))
        unseen, cut = sight.unseen_share(self.model, known), 0.0
        if trim:
            self.model, known, cut = job.shared(lambda: sight.trimmed(self.model, known))
        rows = job.shared(lambda: measures.measured(self.model, self.pictures))  # The verdict's fits follow from them.
        told = verdict(self.model, self.pictures, rows, self.losses, unseen, self.settings, cut)
        psnr = measures.mean_of(rows, "psnr", bool(self.pictures.held_out))
        assert psnr is not None
        found = Reconstruction(self.model, self.pictures, rows, psnr, self.seconds, [], told)
        if not self.first:
            return found
        with writing(self.folder):
            self.files = files.write_mesh(self.folder, self.model, self.pictures)
            self.files += files.write_light(self.folder / "light.json", self.model)
            if self.model.atlas is not None:
                self.files += files.write_unseen(self.folder / "unseen.png", self.model, known)
            if self.settings.cameras:
                self.files += files.write_cameras(self.folder, self.model, self.pictures)
            table, turning, report = (self.folder / name for name in ("views.csv", "turntable.gif", "report.html"))
            files.write_table(table, rows)
            files.write_turntable(turning, self.model, self.pictures)
            write_report(report, self.model, self.pictures, rows, self.losses, repr(found), told)
        return found._replace(files=[*self.files, table, turning, report])


def _linear(view: rts.View) -> rts.View:
    """The view with a linear image, read when it is needed."""

    def image() -> np.ndarray:
        encoded = view.image
        return np.concatenate([decoded(encoded[..., :3]), encoded[..., 3:]], axis=-1)

    return rts.View(view.camera, image, view.size, name=view.name)
