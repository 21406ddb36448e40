"""The experiments of the paper by name: which script runs them, what is read of its results, and the claims."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.paper import claims, surface_claims
from benchmarks.paper.rows import Row


class Experiment(NamedTuple):
    """A figure or table of the paper.

    Attributes:
        place: in the paper.
        script: the module whose `main` takes the arguments below, and `-o` with a folder.
        full: arguments at full size.
        quick: arguments of a quick version.
        numbers: the folder of the script's results → the numbers that rows are made of.
        rows: these numbers → the paper's claims beside them.
        pictures: files that the script writes; the first is shown on the page.
        engine: the option of the script that names the engine; None for a script that knows torch alone.
    """

    place: str
    script: str
    full: tuple[str, ...]
    quick: tuple[str, ...]
    numbers: Callable[[Path], Any]
    rows: Callable[[Any], list[Row]]
    pictures: tuple[str, ...] = ()
    engine: str | None = None


EXPERIMENTS = {
    "derivatives": Experiment(
        "Image derivatives, § 4.1",
        "benchmarks.accuracy.run",
        ("--scenes", "A", "B", "C", "--spp", "4", "16"),
        ("--scenes", "A", "B", "C", "--no-peers"),
        claims.derivative_numbers,
        claims.derivatives,
        ("derivatives.png",),
    ),
    "blur": Experiment(
        "Effect of blur, § 4.1",
        "benchmarks.paper.blur",
        (),
        ("--quick",),
        claims.read("blur.json"),
        claims.blur,
        ("blur.png",),
        "--engine",
    ),
    "silhouettes": Experiment(
        "Poses from silhouettes, figure of § 4.2",
        "benchmarks.pose_recovery",
        (),
        ("--seeds", "2"),
        claims.silhouette_numbers,
        claims.silhouettes,
        ("pose.png",),
        "--engine",
    ),
    "pose-speed": Experiment(
        "Times of pose estimation, table of § 4.2",
        "benchmarks.speed.run",
        ("--only", "pose", "--sizes", "256"),
        ("--only", "pose", "--quick"),
        claims.speed_numbers,
        claims.speed,
        ("pose.png",),
    ),
    "airplane": Experiment(
        "Airplane: Levenberg–Marquardt and Adam, § 4.2",
        "benchmarks.paper.airplane",
        (),
        ("--quick",),
        claims.read("airplane.json"),
        claims.airplane,
        ("airplane.png", "airplane.gif"),
        "--engine",
    ),
    "hand": Experiment(
        "Hand, § 4.3",
        "benchmarks.paper.hand",
        (),
        ("--quick",),
        claims.hand_numbers,
        claims.hand,
        ("hand.png",),
    ),
    "bspline": Experiment(
        "B-spline surface, § 4.4",
        "benchmarks.paper.bspline",
        (),
        ("--quick",),
        surface_claims.bspline_numbers,
        surface_claims.bspline,
        ("bspline.png", "bspline.gif"),
        "--engines",
    ),
    "swept": Experiment(
        "Swept sphere, § 4.5",
        "benchmarks.paper.implicit",
        ("--only", "swept"),
        ("--only", "swept", "--quick"),
        surface_claims.implicit_numbers("swept"),
        surface_claims.swept,
        ("implicit_swept.png",),
        "--engines",
    ),
    "spheres": Experiment(
        "200 spheres, § 4.5",
        "benchmarks.paper.implicit",
        ("--only", "spheres"),
        ("--only", "spheres", "--quick"),
        surface_claims.implicit_numbers("spheres"),
        surface_claims.spheres,
        ("implicit_spheres.png",),
        "--engines",
    ),
    "lego": Experiment(
        "Radiance field, Lego, § 4.6",
        "benchmarks.paper.snerf",
        ("--times",),
        ("--quick",),
        surface_claims.field_numbers,
        surface_claims.lego,
        ("snerf-100.png",),
    ),
    "fern": Experiment(
        "Radiance field, Fern, § 4.6",
        "benchmarks.paper.snerf",
        ("--scene", "fern", "--times"),
        ("--scene", "fern", "--quick", "--factor", "6"),
        surface_claims.field_numbers,
        surface_claims.fern,
        ("snerf-168.png", "snerf-84.png"),
    ),
}
"""In the order of the paper."""
