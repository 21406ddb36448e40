"""Isosurfaces that change topology (section 4.5): from images of a torus, on a lattice of 50³ points.

*Swept*: a sphere swept along a circle, two radii, from almost a ball; seen from the torus's axis, it is trapped.
*Spheres*: the union of 200 spheres, by their centres in the torus's plane and their radii. *Grid*: all values of the
lattice, from a ball, by Adam and by SGD. The loss is the mean absolute error. Written are figures, animations and the
numbers, which are printed as tables, too:

    python -m benchmarks.paper.implicit -o out/implicit
    python -m benchmarks.paper.implicit --quick                      # a third of it, 64², few steps, one engine
    python -m benchmarks.paper.implicit --only grid --engines torch
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rts
from benchmarks.report import table
from rts.arrays.engines import engine_named
from rts_surfaces.implicit.fields import spheres, swept_sphere
from rts_surfaces.implicit.narrow_band import NarrowBand

COUNT, BOUNDS = 50, ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
TORUS, ALMOST_BALL = (0.6, 0.25), (0.05, 0.5)
"""Radii of the circle and of the sphere that is swept along it."""
ROTATED, FRONT = ((0.9, 2.2, 2.4), (0, 1, 0)), ((0, 3.4, 0), (0, 0, -1))
AROUND = ROTATED, *((eye, (0, 1, 0)) for eye in ((-2.4, 2.2, 0.9), (-0.9, -2.2, 2.4), (2.4, -2.2, 0.9)))
"""Views: where the eye is, and what is up."""
COLOR = np.array([0.95, 0.6, 0.3], np.float32)
MOTIONS = ("normal", "edge")
SECTIONS = ("swept", "spheres", "grid")
SWEPT_RATE, SPHERES_RATE, SPHERES = 0.04, 0.003, 200
GRID_RATES = {"adam": (0.001, 0.003, 0.01), "sgd": (100.0, 300.0, 1000.0)}
STEPS, QUICK_STEPS = {"swept": 150, "spheres": 400, "grid": 500}, {"swept": 12, "spheres": 8, "grid": 8}
FRAMES, QUICK_FRAMES = 40, 5
MOMENTS = (0.0, 0.05, 0.2, 0.4, 1.0)
"""When a fit is shown, as shares of its steps."""
FIRST = 5
"""Steps that are told apart from the rest when timed: the first ones compile."""


class Task(NamedTuple):
    """A surface to be fitted.

    Attributes:
        name: of the task.
        field: (θ, points) → levels; None where θ holds the values of the lattice.
        start: θ, without its colour.
        shader: of the images.
        views: what the images are of; each step takes the next one.
        method: "adam" or "sgd".
        rate: of the method.
        decays: whether the rate goes to zero, along a cosine.
        costly: whether the field is worth a table of lattice points.
    """

    name: str
    field: Callable | None
    start: dict[str, np.ndarray]
    shader: str
    views: tuple[tuple, ...]
    method: str
    rate: float
    decays: bool = True
    costly: bool = False

    def part(self, theta: dict[str, Any], motion: str, banded: bool) -> rts.Part:
        """The isosurface; in a narrow band, unless θ is traced."""
        options: dict[str, Any] = {}
        if self.field is not None:
            options = {"f": self.field, "shape": (COUNT,) * 3, "reads": tuple(self.start), "table": self.costly}
            options["band"] = NarrowBand(lipschitz=1.0) if banded else None
        surface = rts.plugin("surfaces", "isosurface")(BOUNDS, motion=motion, **options)
        return rts.Part(surface, {**theta, "color": COLOR}, self.shader)


class Course(NamedTuple):
    """The course of a fit.

    Attributes:
        trail: θ at the start, at some steps, and at the end.
        steps: which steps these are.
        history: the loss of each step.
        times: the seconds of each step.
        traces: how often the step was traced to be compiled; 0 if it is not compiled.
    """

    trail: list[dict[str, np.ndarray]]
    steps: list[int]
    history: list[float]
    times: list[float]
    traces: int


# ------------------------------------------------------------------------------------------------- what is fitted


def swept_tasks() -> list[Task]:
    start = {"radii": np.array(ALMOST_BALL, np.float32)}
    return [
        Task(f"{name}, {shader}", swept_sphere, start, shader, (view,), "adam", SWEPT_RATE)
        for name, view in (("rotated", ROTATED), ("front", FRONT))
        for shader in ("lambert", "silhouette")
    ]


def spheres_tasks() -> list[Task]:
    rng = np.random.default_rng(0)
    start = {"centers": rng.uniform(-0.8, 0.8, (SPHERES, 2)), "radii": rng.uniform(0.04, 0.12, SPHERES)}
    start = {name: x.astype(np.float32) for name, x in start.items()}
    views = ("front", FRONT), ("rotated", ROTATED)
    return [Task(name, spheres, start, "lambert", (view,), "adam", SPHERES_RATE, costly=True) for name, view in views]


def grid_tasks() -> list[Task]:
    start = {"values": torus_on_lattice(ALMOST_BALL)}
    return [
        Task(f"{name}, {method} {rate:g}", None, start, "lambert", views, method, rate, decays=False)
        for name, views in (("one view", (ROTATED,)), ("four views", AROUND))
        for method, rates in GRID_RATES.items()
        for rate in rates
    ]


TASKS = {"swept": swept_tasks, "spheres": spheres_tasks, "grid": grid_tasks}


@cache
def torus_on_lattice(radii: tuple[float, float]) -> np.ndarray:
    axes = [np.linspace(low, high, COUNT) for low, high in zip(*BOUNDS, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    return swept_sphere({"radii": np.array(radii, np.float32)}, points).reshape((COUNT,) * 3)


def camera(eye: Any, up: Any) -> rts.Camera:
    return rts.Camera.look_at(eye, (0, 0, 0), up=up, fov_y=40)


@cache
def target(view: tuple, side: int, shader: str) -> np.ndarray:
    """The image (H, W, 4) of the torus itself, ray-cast with 4 × 4 samples a pixel."""
    torus = rts.plugin("surfaces", "sdf")(swept_sphere, radius=1.2, reads=("radii",))
    part = rts.Part(torus, {"radii": np.array(TORUS, np.float32), "color": COLOR}, shader)
    return rts.render(part, camera(*view), (side, side), splatter="none", supersample=4)


def image(task: Task, theta: dict[str, np.ndarray], view: tuple, side: int, shader: str | None = None) -> np.ndarray:
    part = task._replace(shader=shader or task.shader).part(theta, "normal", banded=True)
    return rts.render(part, camera(*view), (side, side), splatter="none", supersample=2)


# ------------------------------------------------------------------------------------------------------- fitting


def fitted(engine: str, task: Task, motion: str, side: int, steps: int) -> Course:
    """The fit. What is kept of it is dense at first, when most happens."""
    begin = {"torch": torch_steps, "jax": jax_steps}[engine]
    known = engine_named(engine)
    views = [tuple(known.constant(np.asarray(x, np.float32)) for x in view) for view in task.views]
    targets = [known.constant(target(view, side, task.shader)) for view in task.views]
    traced = []

    def loss(theta: Any, view: Any, wanted: Any) -> Any:
        traced.append(engine == "jax")
        part = task.part(theta, motion, banded=engine == "torch")
        # Fronts and backs of what covers half of the image.
        found = rts.render(part, camera(*view), (side, side), capacity=side * side if engine == "jax" else None)
        return abs(found - wanted).mean()

    shown = sorted({round(steps * t**2) for t in np.linspace(0, 1, FRAMES if steps > FRAMES else QUICK_FRAMES)})
    trail, history, times = [dict(task.start)], [], []
    stepping = begin(loss, task, steps)
    next(stepping)
    for i in range(steps):
        begun = time.perf_counter()
        value, theta = stepping.send((views[i % len(views)], targets[i % len(views)]))
        history.append(float(value))
        times.append(time.perf_counter() - begun)
        if i + 1 in shown:
            trail.append({name: np.array(known.to_numpy(x)) for name, x in theta.items()})
    return Course(trail, shown, history, times, sum(traced))


def torch_steps(loss: Callable, task: Task, steps: int) -> Iterator[Any]:
    """Takes a view and its image, gives a loss and θ after the step."""
    import torch

    theta = {name: torch.tensor(x, requires_grad=True) for name, x in task.start.items()}
    optimizer = {"adam": torch.optim.Adam, "sgd": torch.optim.SGD}[task.method](theta.values(), lr=task.rate)
    least = 0.0 if task.decays else task.rate
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=least)
    given = yield
    while True:
        optimizer.zero_grad()
        value = loss(theta, *given)
        value.backward()
        optimizer.step()
        schedule.step()
        given = yield value.detach(), {name: x.detach() for name, x in theta.items()}


def jax_steps(loss: Callable, task: Task, steps: int) -> Iterator[Any]:
    """As `torch_steps`; each step is one compiled program."""
    import jax
    import optax

    rate = optax.cosine_decay_schedule(task.rate, steps) if task.decays else task.rate
    optimizer = {"adam": optax.adam, "sgd": optax.sgd}[task.method](rate)
    theta = {name: jax.numpy.asarray(x) for name, x in task.start.items()}
    state = optimizer.init(theta)

    @jax.jit
    def step(theta: Any, state: Any, view: Any, wanted: Any) -> Any:
        value, slope = jax.value_and_grad(loss)(theta, view, wanted)
        change, state = optimizer.update(slope, state)
        return value, optax.apply_updates(theta, change), state

    given = yield
    while True:
        value, theta, state = step(theta, state, *given)
        given = yield value, theta


# ----------------------------------------------------------------------------------------------------- measuring


def measured(engine: str, task: Task, motion: str, side: int, course: Course) -> dict[str, Any]:
    start, end = course.trail[0], course.trail[-1]
    rest = course.times[FIRST:] or course.times
    found = {
        "task": task.name,
        "engine": engine,
        "motion": motion,
        "steps": len(course.history),
        "seconds": sum(course.times),
        "first_steps_ms": [1e3 * t for t in course.times[:FIRST]],
        "step_ms": 1e3 * float(np.median(rest)),
        "slowest_later_step_ms": 1e3 * max(rest),
        "traces": course.traces,
        "without_room": without_room(task, motion, side, course) if engine == "jax" else 0,
        "loss_start": error(task, start, side, task.views),
        "loss": error(task, end, side, task.views),
        "iou": overlap(task, end, side),
    }
    if "values" in end:
        inside, truth = end["values"] < 0, torus_on_lattice(TORUS) < 0
        losses = smoothed(course, len(task.views))
        found |= {"loss_least": float(losses.min()), "step_of_least": int(losses.argmin())}
        found |= {"iou_inside": float((inside & truth).sum() / (inside | truth).sum())}
        found |= {"area": area(end["values"]) / (4 * np.pi**2 * TORUS[0] * TORUS[1])}
    elif len(end["radii"]) == 2:
        found |= {"radii": end["radii"].tolist()}
    return found


def error(task: Task, theta: dict[str, np.ndarray], side: int, views: tuple) -> float:
    """The mean absolute error of images as they are fitted."""
    part = task.part(theta, "normal", banded=True)
    images = (rts.render(part, camera(*view), (side, side)) - target(view, side, task.shader) for view in views)
    return float(np.mean([np.abs(x).mean() for x in images]))


def overlap(task: Task, theta: dict[str, np.ndarray], side: int) -> float:
    """Intersection over union of the silhouettes with those of the torus, as areas, over all views."""
    found = np.stack([image(task, theta, view, side)[..., 3] for view in task.views])
    wanted = np.stack([target(view, side, task.shader)[..., 3] for view in task.views])
    return float(np.minimum(found, wanted).sum() / np.maximum(found, wanted).sum())


def without_room(task: Task, motion: str, side: int, course: Course) -> int:
    """For how many samples there was no room in compiled steps, of those that are kept."""
    views = [camera(*view) for view in task.views]
    parts = [task.part(theta, motion, banded=True) for theta in course.trail]
    options: dict[str, Any] = {"splatter": "auto", "capacity": side * side}
    return sum(int(rts.sample(part, view, (side, side), **options).overflow) for part in parts for view in views)


def area(values: np.ndarray) -> float:
    extracted = rts.plugin("surfaces", "isosurface")(BOUNDS).extract({"values": values})
    a, b, c = np.moveaxis(extracted.vertices[extracted.faces].astype(np.float64), 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def smoothed(course: Course, views: int) -> np.ndarray:
    """The losses (n,), each the mean of one step for each view."""
    return np.convolve(course.history, np.full(views, 1 / views), mode="valid")


# ------------------------------------------------------------------------------------------------------- tables


def number(name: str, digits: int) -> Callable[[dict[str, Any]], str]:
    return lambda row: f"{row[name]:.{digits}f}"


WHICH = {"task": lambda row: row["task"], "motion": lambda row: row["motion"], "engine": lambda row: row["engine"]}
ENDS = {"error at the start": number("loss_start", 4), "at the end": number("loss", 4)}
TIMES = {
    "steps": number("steps", 0),
    "s": number("seconds", 1),
    "first steps, ms": lambda row: ", ".join(f"{x:.0f}" for x in row["first_steps_ms"]),
    "median of the rest": number("step_ms", 1),
    "slowest of the rest": number("slowest_later_step_ms", 0),
    "traced": number("traces", 0),
    "samples without room": number("without_room", 0),
}
RESULTS = {
    "swept": WHICH
    | {"radii at the end": lambda row: ", ".join(f"{x:.4f}" for x in row["radii"])}
    | ENDS
    | {"IoU": number("iou", 4)},
    "spheres": WHICH | ENDS | {"IoU": number("iou", 4)},
    "grid": WHICH
    | ENDS
    | {
        "least": number("loss_least", 4),
        "at step": number("step_of_least", 0),
        "IoU inside": number("iou_inside", 3),
        "area over the torus's": number("area", 2),
    },
}
"""Columns of tables: header → what it tells of a row."""


def tables(section: str, rows: list[dict[str, Any]]) -> str:
    """Results and times, in Markdown."""
    made = (
        table(told, ([f(row) for f in told.values()] for row in rows)) for told in (RESULTS[section], WHICH | TIMES)
    )
    return "\n".join(made)


# ------------------------------------------------------------------------------------------------------ pictures


def on_white(pixels: np.ndarray) -> np.ndarray:
    """(H, W, 3), for files that know no linear colours."""
    return np.clip(pixels[..., :3] + 1 - pixels[..., 3:], 0, 1) ** (1 / 2.2)


def target_picture(view: tuple, side: int, shader: str) -> np.ndarray:
    """The target, silhouettes in black."""
    found = target(view, side, shader)
    return found * (0, 0, 0, 1) if shader == "silhouette" else found


def show(axes: Any, title: str, pixels: np.ndarray) -> None:
    axes.imshow(on_white(pixels))
    axes.set_title(title, fontsize=9)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_color("0.85")


def draw_rows(path: Path, tasks: list[Task], courses: dict, side: int) -> None:
    """A row a task: the start, some steps, the end, its other side, the target, and the losses."""
    from matplotlib.figure import Figure

    ratios = [1] * (len(MOMENTS) + 2) + [1.5]
    figure = Figure(figsize=(2.1 * sum(ratios), 2.5 * len(tasks)), layout="constrained")
    grid = figure.subplots(len(tasks), len(ratios), squeeze=False, width_ratios=ratios)
    for axes, task in zip(grid, tasks, strict=True):
        course = next(course for (name, *_), course in courses.items() if name == task.name)
        view, other = task.views[0], FRONT if task.views[0] == ROTATED else ROTATED
        steps = np.array(course.steps)
        for one, moment in zip(axes, MOMENTS, strict=False):
            i = int(np.abs(steps - moment * steps[-1]).argmin())
            show(one, f"step {course.steps[i]}", image(task, course.trail[i], view, 2 * side, "lambert"))
        axes[0].set_ylabel(task.name)
        show(axes[-3], "the end, another view", image(task, course.trail[-1], other, 2 * side, "lambert"))
        show(axes[-2], "target", target_picture(view, 2 * side, task.shader))
        for (name, engine, motion), found in courses.items():
            if name == task.name:
                style = "-" if engine == "torch" else "--"
                color = f"C{MOTIONS.index(motion)}"
                axes[-1].semilogy(found.history, style, color=color, label=f"{motion}, {engine}", linewidth=1)
        axes[-1].set_title("mean absolute error", fontsize=9)
        axes[-1].grid(alpha=0.3, which="both")
        axes[-1].tick_params(labelsize=7, which="both")
    grid[0, -1].legend(fontsize=7)
    grid[-1, -1].set_xlabel("step")
    figure.savefig(path, dpi=100)


def draw_grid(path: Path, tasks: list[Task], courses: dict, side: int) -> None:
    """Losses of Adam and SGD, a chart for each number of views and motion; below, what the first motion ends at."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    kinds = list(dict.fromkeys(task.name.partition(",")[0] for task in tasks))
    engine = next(iter(courses))[1]
    motions = list(dict.fromkeys(motion for _, _, motion in courses))
    figure = Figure(figsize=(15, 4.2 + 4.4 * len(kinds)), layout="constrained")
    charts, below = figure.subfigures(2, 1, height_ratios=(4.2, 4.4 * len(kinds)))
    columns = [(kind, motion) for kind in kinds for motion in motions]
    for axes, (kind, motion) in zip(charts.subplots(1, len(columns), squeeze=False)[0], columns, strict=True):
        for task in tasks:
            if task.name.startswith(kind):
                losses = smoothed(courses[task.name, engine, motion], len(task.views))
                shade = 0.4 + 0.25 * GRID_RATES[task.method].index(task.rate)
                color = colormaps["Reds" if task.method == "adam" else "Blues"](shade)
                axes.semilogy(losses, color=color, label=f"{task.method} {task.rate:g}", linewidth=1.3)
        axes.set_title(f"{kind}, motion {motion!r}, {engine}", fontsize=10)
        axes.set(xlabel="step", ylabel="mean absolute error")
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
    grid = below.subplots(2 * len(kinds), len(tasks) // len(kinds) + 1, squeeze=False)
    for k, kind in enumerate(kinds):
        known = [task for task in tasks if task.name.startswith(kind)]
        for i, view in enumerate((ROTATED, FRONT)):
            for axes, task in zip(grid[2 * k + i], known, strict=False):
                course = courses[task.name, engine, motions[0]]
                title = f"{task.method} {task.rate:g}, " + ("first view" if i == 0 else "not fitted")
                show(axes, title, image(task, course.trail[-1], view, 2 * side))
            show(grid[2 * k + i, -1], "target", target(view, 2 * side, "lambert"))
            grid[2 * k + i, 0].set_ylabel(kind)
    figure.savefig(path, dpi=100)


def frames(tasks: list[Task], courses: dict, side: int) -> list[np.ndarray]:
    """A column a task, its first view above another one."""
    made = []
    first = {name: course for (name, *_), course in reversed(courses.items())}
    for i in range(max(len(course.trail) for course in first.values())):
        columns = []
        for task in tasks:
            trail = first[task.name].trail
            theta = trail[min(i, len(trail) - 1)]
            other = FRONT if task.views[0] == ROTATED else ROTATED
            pair = (image(task, theta, view, side, "lambert") for view in (task.views[0], other))
            columns.append(np.concatenate(list(pair)))
        made.append(np.concatenate(columns, axis=1))
    return made + made[-1:] * 12


DRAWN = {"swept": draw_rows, "spheres": draw_rows, "grid": draw_grid}


def run(folder: Path, section: str, quick: bool, engines: list[str], motions: list[str]) -> None:
    side, steps = (64, QUICK_STEPS[section]) if quick else (128, STEPS[section])
    # Every third holds one of each kind.
    tasks, rows, courses = TASKS[section]()[:: 3 if quick else 1], [], {}
    for engine in engines:
        for motion in motions:
            for task in tasks:
                course = courses[task.name, engine, motion] = fitted(engine, task, motion, side, steps)
                rows.append(measured(engine, task, motion, side, course))
                print(line(rows[-1]), flush=True)
    folder.mkdir(parents=True, exist_ok=True)
    kept = [row | {"history": courses[row["task"], row["engine"], row["motion"]].history} for row in rows]
    (folder / f"implicit_{section}.json").write_text(json.dumps(kept, indent=1) + "\n")
    DRAWN[section](folder / f"implicit_{section}.png", tasks, courses, side)
    shown = [task for task in tasks if len(task.views) == 1]
    rts.save_animation(folder / f"implicit_{section}.gif", frames(shown, courses, side), fps=8)
    print("\n" + tables(section, rows), flush=True)


def line(row: dict[str, Any]) -> str:
    radii = f"   radii {row['radii'][0]:.4f}, {row['radii'][1]:.4f}" if "radii" in row else ""
    return (
        f"{row['task']:22}{row['engine']:6}{row['motion']:7}{row['steps']:4} steps {row['seconds']:6.1f} s   error "
        f"{row['loss_start']:.4f} -> {row['loss']:.4f}{radii}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/implicit"))
    parser.add_argument("--engines", nargs="+", choices=("torch", "jax"), default=None, help="default torch and jax")
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=None, help="default both")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args(arguments)
    engines = args.engines or (["torch"] if args.quick else ["torch", "jax"])
    motions = args.motions or list(MOTIONS[:1] if args.quick else MOTIONS)
    for section in args.only:
        run(args.output, section, args.quick, engines, motions)


if __name__ == "__main__":
    main()
