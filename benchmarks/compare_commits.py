"""Whether two commits give the same numbers, and which is faster.

Each side is installed into a folder of its own, so that it finds its own plugins by its own entry points, and runs in
processes of its own. A side is any revision that git knows, or "." for the working tree with what is not committed.

    python benchmarks/compare_commits.py results               # HEAD~1 and the working tree
    python benchmarks/compare_commits.py results v0.1.0 HEAD
    python benchmarks/compare_commits.py speed HEAD~5 . --meshes teapot bunny --sizes 256

`results` takes a matrix of surfaces, samplers, splatters, engines and layers, and compares samples, images and
gradients. It ends with exit code 1 if samples differ or anything else is off by more than rounding: 1e-6 of an image's
largest value, 1e-5 of a gradient's norm. `speed` times the iterations of a pose fit, both sides in turn.

With --folder what is installed stays, its compiled kernels too, and is used again as long as its sources are the same.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import importlib
import importlib.metadata
import io
import json
import os
import shutil
import statistics
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # Spinning threads of one side would take the other's cores.

import numpy as np
from rich.console import Console
from rich.table import Table

# `rts` is imported by workers only, inside functions, once they know that it is the right one.

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = "tests/plugin_example"
WORKING_TREE = "."
SETUPTOOLS = 77
"""Builds take an installed setuptools from this version on; else pip fetches one."""

# ------------------------------------------------------------------------------------------------------- installs


def git(*arguments: str) -> bytes:
    done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True)
    if done.returncode:
        raise SystemExit(done.stderr.decode().strip())
    return done.stdout


class Side(NamedTuple):
    """One of the two that are compared.

    Attributes:
        label: of tables.
        site: the folder into which it is installed.
    """

    label: str
    site: Path


def sides_of(revisions: Sequence[str], folder: Path) -> list[Side]:
    """Installs of some revisions; all are made at once, lest one change while another is at work."""
    found = []
    for revision in revisions:
        if revision == WORKING_TREE:
            label = "working tree"
        else:
            short = git("rev-parse", "--short", f"{revision}^{{commit}}").decode().strip()
            label, revision = short if revision.startswith(short) else f"{revision} ({short})", short
        found.append(Side(label, install(revision, folder)))
    return found


def copy_of(revision: str, folder: Path) -> Path:
    """A folder with the files of a revision, or of the working tree: those that git knows or does not ignore."""
    folder.mkdir(parents=True)
    if revision != WORKING_TREE:
        with tarfile.open(fileobj=io.BytesIO(git("archive", "--format=tar", revision))) as archive:
            archive.extractall(folder, filter="data")
        return folder
    for name in git("ls-files", "-z", "--cached", "--others", "--exclude-standard").decode().split("\0"):
        if name and (ROOT / name).is_file():  # What is deleted, but not yet committed, is still listed.
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def digest(copy: Path) -> str:
    """Of the sources that are installed."""
    found = hashlib.sha256(sys.version.encode())
    for path in sorted(copy.rglob("*")):
        name = path.relative_to(copy).as_posix()
        beside = name.startswith(("benchmarks/", "docs/", "tests/")) and not name.startswith(EXAMPLE)
        if path.is_file() and path.suffix != ".md" and not beside:
            found.update(f"{name}\0{path.stat().st_size}\0".encode() + path.read_bytes())
    return found.hexdigest()[:16]


def install(revision: str, folder: Path) -> Path:
    """The folder into which a revision, and its example of a plugin, are installed; those that it needs are not.

    Args:
        revision: what git knows, or "." for the working tree.
        folder: for installs of all revisions; one of the same sources is used again.
    """
    with tempfile.TemporaryDirectory() as scratch:
        copy = copy_of(revision, Path(scratch) / "copy")
        site = folder / digest(copy)
        if not site.exists():
            installed = Path(scratch) / "site"
            projects = [str(p) for p in (copy, copy / EXAMPLE) if (p / "pyproject.toml").exists()]
            command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
            command += ["--no-build-isolation"] if _has_setuptools() else []
            subprocess.run([*command, "--target", str(installed), *projects], check=True)
            folder.mkdir(parents=True, exist_ok=True)
            shutil.move(installed, site)
    return site.resolve()


def _has_setuptools() -> bool:
    try:
        return int(importlib.metadata.version("setuptools").split(".")[0]) >= SETUPTOOLS
    except importlib.metadata.PackageNotFoundError:
        return False


def environment(site: Path) -> dict[str, str]:
    """Variables of a process that is to use an install."""
    paths = [str(site), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def isolate(site: Path) -> None:
    """Make this process use an install, and nothing of an editable one beside it; see `check_origin`."""
    # An editable install would step in for modules that this side lacks.
    sys.meta_path[:] = [f for f in sys.meta_path if not getattr(f, "__module__", "").startswith("__editable___rts")]
    importlib.import_module("rts")
    check_origin(site)


def check_origin(site: Path) -> None:
    """Exit if any module of rts, or of the example of a plugin, was imported from elsewhere."""
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if name.split(".")[0] in ("rts", "rts_backends", "rts_surfaces", "rts_plugin_example") and file:
            if not Path(file).resolve().is_relative_to(site):
                raise SystemExit(f"{name} is {file}; expected one in {site}: is another rts earlier on the path?")


@contextmanager
def folder_of(chosen: Path | None) -> Iterator[Path]:
    """The folder that was chosen, or one that is removed in the end."""
    if chosen is not None:
        chosen.mkdir(parents=True, exist_ok=True)
        yield chosen.resolve()
        return
    with tempfile.TemporaryDirectory(prefix="rts-commits-") as name:
        yield Path(name).resolve()


def worker(site: Path, *arguments: str) -> list[str]:
    """The command of a process of this script that uses an install."""
    return [sys.executable, __file__, "worker", str(site), *arguments]


# ------------------------------------------------------------------------------------------------ results: scenes

SIZE = (28, 36)
LAYERS, USUAL = (1, 2, 4), 2
"""K, and the one that is never left out."""

POSE = (0.11, -0.07, 0.05, 0.02, -0.03, 0.04)
"""At which all is rendered: radians and units."""

NAMED = ("none", "single", "multi", "visible")
DEFAULT = "visible"
IN_ARRAY_CODE = ("Single", "Multi", "Visible")
"""Classes of `rts.splatting`; by name, the same methods are compiled, save "none"."""

SLOW = ("toy",)
"""Samplers that take a hundred times longer than others."""

CULLED = ", culled"
JIT_LAYERS = ("mesh", "silhouette", "split uv")
JIT_SPLATTERS = {"mesh": (*NAMED, *IN_ARRAY_CODE), "heightfield": (DEFAULT, "Visible")}
"""Scenes that are compiled as a whole for every K, and for more splatters than the default: each takes seconds."""


class Ellipsoid:
    """A surface that intersects rays itself: θ["center"] (3,) and θ["radii"] (3,); params (N, 3) on the unit sphere."""

    sample_widths = (0, 3)

    def __repr__(self):
        return "Ellipsoid()"

    def evaluate(self, theta, samples):
        import rts

        gbuffer = rts.GBuffer(position=theta["center"] + samples.params * theta["radii"])
        gbuffer.defer("normal", lambda: _unit(rts.namespace(samples.params), samples.params / theta["radii"]))
        return gbuffer

    def intersect(self, theta, origins, directions, layers):
        import rts

        xp = rts.namespace(origins)
        o, d = (origins - theta["center"]) / theta["radii"], directions / theta["radii"]
        a, b, c = xp.sum(d * d, axis=1), xp.sum(o * d, axis=1), xp.sum(o * o, axis=1) - 1
        square = b * b - a * c
        root = xp.sqrt(xp.where(square > 0, square, 0.0))
        near, far = (-b - root) / a, (-b + root) / a
        seen, outside = square > 0, near >= 0
        distance = xp.stack([xp.where(outside, near, far), far, *[far] * (layers - 2)][:layers])
        hit = xp.stack([seen & (far >= 0), seen & outside, *[seen & ~seen] * (layers - 2)][:layers])
        return rts.RayHits(hit, distance, _unit(xp, o[None] + distance[..., None] * d[None]))


def _unit(xp: Any, vectors: Any) -> Any:
    return vectors / xp.sqrt(xp.sum(vectors * vectors, axis=-1))[..., None]


def torus(around: int = 15, across: int = 8) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (T, 3) of a torus, uv (A, 2) with a seam, and its indices (T, 3)."""
    u, v = (x.reshape(-1) for x in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    a, b = 2 * np.pi * u / around, 2 * np.pi * v / across
    ring = 0.75 + 0.35 * np.cos(b)
    vertices = np.stack([ring * np.cos(a), 0.35 * np.sin(b), -ring * np.sin(a)], axis=-1).astype(np.float32)
    corners = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    cells = (np.stack([u, v], axis=-1)[:, None, None] + corners).reshape(-1, 3, 2)
    faces = cells[..., 0] % around * across + cells[..., 1] % across
    uv = np.stack(np.meshgrid(np.arange(around + 1), np.arange(across + 1), indexing="ij"), axis=-1).reshape(-1, 2)
    return vertices, faces, (uv / [around, across]).astype(np.float32), cells[..., 0] * (across + 1) + cells[..., 1]


def scenes() -> dict[str, list[Any]]:
    """Parts with NumPy θ, by name. All turn with the pose but those that have a transform."""
    import rts

    mesh, random = rts.plugin("surfaces", "mesh"), np.random.default_rng(1)
    vertices, faces, uv, uv_faces = torus()
    light = {"direction": [0.4, 0.8, 0.5], "color": [0.7, 0.6, 0.5], "ambient": [0.2, 0.25, 0.3]}
    theta = {
        "vertices": vertices,
        "uv": uv,
        "texture": random.random((5, 7, 3), np.float32),
        "light": {name: np.array(value, np.float32) for name, value in light.items()},
        "specular": np.array([0.3, 0.2, 0.4], np.float32),
        "shininess": np.array(9.0, np.float32),
    }
    split = rts.Part(mesh(faces, {"uv": uv_faces}), theta, "blinn_phong")
    outline = rts.Part(mesh(faces), {"vertices": vertices}, "silhouette")
    example = mesh.example()
    colors = np.concatenate([example.theta["colors"], random.random((12, 1), np.float32)], axis=1)
    glass = example.replace(
        theta={**example.theta, "colors": colors}, shader=rts.plugin("shaders", "unlit")(opaque=False)
    )
    # A part of its own size, place and turn, which meets the torus.
    moved = np.array(rts.rigid(np.array([0.3, 0.4, -0.2, 0.25, 0.1, -0.15])), np.float32)
    moved[:3, :3] *= 0.7
    ellipsoid = {"center": [0.1, -0.1, 0.05], "radii": [0.9, 0.6, 0.75], "color": [0.8, 0.5, 0.3]}
    ellipsoid = {name: np.array(value, np.float32) for name, value in ellipsoid.items()}
    found = {
        "mesh": [example],
        "split uv": [split],
        "silhouette": [outline],
        "scene": [split, example.replace(transform=moved)],
        "glass": [split, glass.replace(transform=moved)],
        "ellipsoid": [rts.Part(Ellipsoid(), ellipsoid, "lambert")],
    }
    if "heightfield" in rts.plugins("surfaces"):
        found["heightfield"] = [rts.plugin("surfaces", "heightfield").example()]
    for name in ("mesh", "split uv", "silhouette", "scene", "heightfield"):
        if name in found:
            found[name + CULLED] = [part.replace(cull="back") for part in found[name]]
    return found


def camera_of_scenes() -> Any:
    import rts

    return rts.Camera.look_at((0.4, 1.3, 2.6), (0, 0, 0), fov_y=45, aspect=SIZE[1] / SIZE[0])


# ----------------------------------------------------------------------------------------------- results: engines


def map_arrays(function: Callable, tree: Any) -> Any:
    """A tree of dicts and lists with `function` applied to its arrays."""
    if isinstance(tree, dict):
        return {key: map_arrays(function, value) for key, value in tree.items()}
    return [map_arrays(function, x) for x in tree] if isinstance(tree, list) else function(tree)


def named_arrays(tree: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The arrays of a tree of dicts and lists, each with its path."""
    if not isinstance(tree, (dict, list)):
        yield prefix, tree
        return
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        yield from named_arrays(value, f"{prefix}.{key}" if prefix else str(key))


class NumPy:
    """What this script needs of an engine: arrays, samples, and images with their gradients."""

    name, key = "numpy", "numpy"

    def array(self, x: np.ndarray) -> Any:
        return x

    def host(self, x: Any) -> np.ndarray:
        return np.asarray(x)

    def sampled(self, function: Callable, variables: Any) -> Any:
        """The function of arrays of the engine."""
        return function(map_arrays(self.array, variables))

    def image_and_gradient(self, function: Callable, variables: Any, weights: np.ndarray) -> tuple[Any, Any]:
        """Image (H, W, 4), and the gradient of Σ weights · image in the variables, None where there is none."""
        return function(variables), None


class Torch(NumPy):
    """Eager torch."""

    name, key = "torch", "torch"

    def array(self, x):
        import torch

        return torch.from_numpy(np.array(x))

    def host(self, x):
        return x.detach().cpu().numpy()

    def image_and_gradient(self, function, variables, weights):
        import torch

        arrays = map_arrays(lambda x: self.array(x).requires_grad_(True), variables)
        image = function(arrays)
        (image * self.array(weights)).sum().backward()
        return image, map_arrays(lambda x: torch.zeros_like(x) if x.grad is None else x.grad, arrays)


class Jax(NumPy):
    """jax, operation by operation."""

    name, key = "jax", "jax eager"

    def array(self, x):
        import jax.numpy as jnp

        return jnp.asarray(x)

    def compiled(self, function: Callable) -> Callable:
        return function

    def sampled(self, function, variables):
        return self.compiled(function)(map_arrays(self.array, variables))

    def image_and_gradient(self, function, variables, weights):
        import jax

        def total(arrays):
            image = function(arrays)
            return (image * weights).sum(), image

        derived = self.compiled(jax.value_and_grad(total, has_aux=True))
        (_, image), gradient = derived(map_arrays(self.array, variables))
        return image, gradient


class JaxJit(Jax):
    """jax, compiled as a whole."""

    key = "jax jit"

    def compiled(self, function):
        import jax

        return jax.jit(function)


ENGINES = (NumPy(), Torch(), Jax(), JaxJit())


# ------------------------------------------------------------------------------------------------ results: matrix


class Config(NamedTuple):
    """One render. The splatter is a name or a class of `rts.splatting`."""

    engine: NumPy
    scene: str
    sampler: str
    splatter: str
    layers: int

    def key(self, kind: str, leaf: str = "") -> str:
        return "|".join([kind, self.engine.key, self.scene, self.sampler, self.splatter, f"K{self.layers}", leaf])

    @property
    def code(self) -> str:
        return "array code" if self.splatter in ("none", *IN_ARRAY_CODE) else "compiled"


class Recorder:
    """Collects the arrays of one side.

    Attributes:
        arrays: by key, see `Config.key`.
        notes: why something has none, by key.
        camera: of all images.
        scenes: parts by name.
        weights: (H, W, 4) of the image, in the scalar whose gradient is taken.
    """

    def __init__(self):
        self.arrays: dict[str, np.ndarray] = {}
        self.notes: dict[str, str] = {}
        self.camera, self.scenes = camera_of_scenes(), scenes()
        self.weights = np.random.default_rng(0).standard_normal((*SIZE, 4)).astype(np.float32)

    def samplers(self, scene: str) -> list[str]:
        """The registered samplers that take a scene; why the others do not goes to the notes."""
        import rts

        found = []
        for name in rts.plugins("samplers"):
            try:
                rts.sample(self.scenes[scene], self.camera, SIZE, sampler=name)
                found.append(name)
            except rts.RtsError as error:
                self.notes[f"{scene}|{name}"] = " ".join(str(error).split())
        return found

    def parts(self, config: Config, variables: dict) -> list[Any]:
        """The scene with arrays for its θ, where they are among the variables, and for its pose."""
        import rts

        found = self.scenes[config.scene]
        if "theta" in variables:
            found = [part.replace(theta=theta) for part, theta in zip(found, variables["theta"], strict=True)]
        pose = rts.rigid(variables["pose"])
        return [part.replace(transform=pose) if part.transform is None else part for part in found]

    def variables(self, config: Config, *, theta: bool) -> dict:
        """NumPy arrays: the pose (6,) and, if asked for, θ."""
        found: dict[str, Any] = {"pose": np.array(POSE, np.float32)}
        return found | ({"theta": [dict(part.theta) for part in self.scenes[config.scene]]} if theta else {})

    def take(self, key: str, record: Callable[[], None]) -> None:
        """Record something; what goes wrong is a note."""
        try:
            record()
        except Exception as error:
            self.notes[key] = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"

    def samples(self, config: Config, splatter: str | None) -> None:
        """What `rts.sample` gives; with a splatter, only what it needs."""
        import rts

        config = config._replace(splatter=str(splatter))

        def sample(variables: dict) -> Any:
            options = {"sampler": config.sampler, "layers": config.layers, "splatter": splatter}
            return rts.sample(self.parts(config, variables), self.camera, SIZE, **options)

        def record() -> None:
            host = config.engine.host
            sampled = config.engine.sampled(sample, self.variables(config, theta=True))
            for name in ("row", "depth", "overflow"):
                self.arrays[config.key("samples", name)] = host(getattr(sampled, name))
            for n, samples in enumerate(sampled.samples):
                for name in ("row", "depth", "overflow"):
                    self.arrays[config.key("samples", f"{n}.{name}")] = host(getattr(samples, name))
                row = host(samples.row)
                used = np.unique(row[row >= 0])  # Other rows may hold anything.
                for name in ("ids", "params"):
                    self.arrays[config.key("samples", f"{n}.{name}")] = host(getattr(samples, name))[used]

        self.take(config.key("samples"), record)

    def image(self, config: Config, *, theta: bool) -> None:
        """Image and gradients, in θ and the pose or in the pose alone with NumPy θ."""
        import rts

        splatter = config.splatter
        if splatter in IN_ARRAY_CODE:
            splatter = getattr(importlib.import_module("rts.splatting"), splatter)()
        suffix = "" if theta else "θ constant: "

        def render(variables: dict) -> Any:
            options = {"sampler": config.sampler, "layers": config.layers, "splatter": splatter}
            return rts.render(self.parts(config, variables), self.camera, SIZE, **options)

        def record() -> None:
            variables = self.variables(config, theta=theta)
            image, gradient = config.engine.image_and_gradient(render, variables, self.weights)
            self.arrays[config.key(f"images, {config.code}", f"{suffix}image")] = config.engine.host(image)
            for name, x in named_arrays(gradient) if gradient is not None else ():
                host = config.engine.host(x)
                self.arrays[config.key(f"gradients, {config.code}", f"{suffix}{name}")] = host

        self.take(config.key(f"images, {config.code}", suffix), record)

    def scene(self, engine: NumPy, scene: str, samplers: Sequence[str]) -> None:
        """All of a scene by an engine: every combination in NumPy and torch; see `_has_time`."""
        for config in (Config(engine, scene, sampler, DEFAULT, k) for sampler in samplers for k in LAYERS):
            default, usual = config.sampler == "auto", config.layers == USUAL
            jit, jax = engine.key == "jax jit", engine.name == "jax"
            if usual or not (jit or config.sampler in SLOW):
                self.samples(config, DEFAULT)
                if default or not jit:
                    self.samples(config, None)
                if engine.name != "numpy" and (not jax or (default and usual)):
                    self.image(config, theta=False)
            for other in (config._replace(splatter=splatter) for splatter in (*NAMED, *IN_ARRAY_CODE)):
                if _has_time(other):
                    self.image(other, theta=True)


def _has_time(config: Config) -> bool:
    """Whether an image and its gradients are taken: in jax they take seconds, and not all is new there."""
    default, usual = config.splatter == DEFAULT, config.layers == USUAL
    if config.sampler in SLOW:
        return default and usual and config.engine.name != "jax"
    if config.engine.name != "jax":
        return True
    if config.sampler != "auto" or config.scene.endswith(CULLED):
        return default and usual and config.engine.key != "jax jit"
    if config.engine.key == "jax jit":
        wanted = config.splatter in JIT_SPLATTERS.get(config.scene, (DEFAULT,))
        return wanted and usual or default and config.scene in JIT_LAYERS
    return usual or config.scene in JIT_LAYERS or config.code == "compiled"


def record_results(output: Path) -> None:
    """Write all arrays of this side into a folder."""
    recorder = Recorder()
    samplers = {scene: recorder.samplers(scene) for scene in recorder.scenes}
    for engine in ENGINES:
        try:
            importlib.import_module(engine.name)
        except ImportError:
            recorder.notes[engine.key] = f"{engine.name} is not installed"
            continue
        start, before = time.perf_counter(), len(recorder.arrays)
        for scene, names in samplers.items():
            recorder.scene(engine, scene, names)
            if engine.key == "jax jit":  # A compiled program takes some ten megabytes.
                sys.modules["jax"].clear_caches()
        count = len(recorder.arrays) - before
        print(f"  {engine.key}: {count:,} arrays, {time.perf_counter() - start:.0f} s", flush=True)
    output.mkdir(parents=True, exist_ok=True)
    np.savez(output / "arrays.npz", **recorder.arrays)
    (output / "notes.json").write_text(json.dumps(recorder.notes))


# ------------------------------------------------------------------------------------------- results: comparison

TOLERANCES = {"samples": None, "images": 1e-6, "gradients": 1e-5}
"""On differences, see `difference`; None where there are to be none."""


class Difference(NamedTuple):
    """Of one array on both sides: whether they are the same to the bit, and how much they are off, relatively."""

    key: str
    equal: bool
    size: float


def difference(key: str, a: np.ndarray, b: np.ndarray) -> Difference:
    """The largest difference over the largest value; of gradients, the norm of the difference over the norm."""
    if a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes():
        return Difference(key, True, 0.0)
    if a.shape != b.shape or a.dtype != b.dtype or not np.array_equal(np.isfinite(a), np.isfinite(b)):
        return Difference(key, False, float("inf"))
    a, b = (np.where(np.isfinite(x), x, 0).astype(np.float64) for x in (a, b))
    measure = np.linalg.norm if key.startswith("gradients") else lambda x: np.abs(x).max(initial=0)
    off, scale = measure((a - b).reshape(-1)), measure(a.reshape(-1))
    return Difference(key, False, float(off / scale) if scale else float("inf") if off else 0.0)


def verdict(kind: str, found: list[Difference], missing: int) -> tuple[str, bool]:
    """In words, and whether it is good enough."""
    limit = TOLERANCES[kind.split(",")[0]]
    if all(d.equal for d in found):
        text = "equal"
    elif limit is None or any(d.size > limit for d in found):
        text = "different"
    else:
        text = "not bitwise" if kind.endswith("array code") else "rounding"
    return f"{text}, {missing:,} missing" if missing else text, text != "different" and not missing


def compare(before: Path, after: Path, shown: int, console: Console) -> bool:
    """Print how the arrays in two folders differ; whether the second side is as good as the first."""
    sides = [np.load(folder / "arrays.npz") for folder in (before, after)]
    notes = [json.loads((folder / "notes.json").read_text()) for folder in (before, after)]
    groups: dict[tuple[str, ...], tuple[list[Difference], list[str]]] = {}
    for key in sides[0].files:
        found, missing = groups.setdefault(tuple(key.split("|")[:2]), ([], []))
        if key in sides[1]:
            found.append(difference(key, sides[0][key], sides[1][key]))
        else:
            missing.append(key)

    table = Table("what", "engine", "arrays", "bitwise equal", "largest difference", "verdict")
    lines, good = [], True
    for (kind, engine), (found, missing) in sorted(groups.items()):
        text, fine = verdict(kind, found, len(missing))
        good &= fine
        largest = max((d.size for d in found), default=0.0)
        equal = sum(d.equal for d in found)
        style = "red" if not fine else "yellow" if text == "not bitwise" else ""
        counts = f"{len(found):,}", f"{equal:,}"
        table.add_row(kind, engine, *counts, f"{largest:.1e}" if largest else "0", text, style=style)
        if not fine or text == "not bitwise":
            worst = sorted((d for d in found if not d.equal), key=lambda d: -d.size)
            lines += [f"  {d.size:.1e}  {d.key}" for d in worst[:shown]] + ["  …"] * (len(worst) > shown)
        lines += [f"  missing  {key}" for key in missing[:shown]]
    console.print(table)
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    added = set(sides[1].files) - set(sides[0].files)
    if added:
        combinations = sorted({tuple(key.split("|")[2:4]) for key in added})
        console.print(f"only in the second: {len(added):,} arrays, of {'; '.join(map(', '.join, combinations))}")
    _print_notes(*notes, console)
    return good


def _print_notes(before: dict[str, str], after: dict[str, str], console: Console) -> None:
    """What was left out, and why."""
    reasons: dict[str, list[str]] = {}
    for key in before | after:
        one, other = before.get(key, "nothing"), after.get(key, "nothing")
        reasons.setdefault(one if one == other else f"{one} → {other}", []).append(key)
    for reason, keys in reasons.items():
        names = "; ".join(key.strip("|") for key in keys[:6]) + "; …" * (len(keys) > 6)
        console.print(f"left out: {names}: {reason}", markup=False, highlight=False, soft_wrap=True)


def run_results(args: argparse.Namespace, console: Console) -> bool:
    with folder_of(args.folder) as folder:
        outputs = [(args.output or folder / "results") / name for name in ("before", "after")]
        for side, output in zip(sides_of((args.before, args.after), folder / "installs"), outputs, strict=True):
            console.print(f"{side.label}:", highlight=False)
            start = time.perf_counter()
            done = subprocess.run(worker(side.site, "results", str(output)), env=environment(side.site))
            if done.returncode:
                raise SystemExit(f"the worker of {side.label} failed")
            console.print(f"  {time.perf_counter() - start:.0f} s in all", highlight=False)
        good = compare(*outputs, args.shown, console)
    console.print("nothing is off by more than rounding" if good else "[red]not the same")
    return good


# ---------------------------------------------------------------------------------------------------------- speed

MESHES = {
    "teapot_2464": ("teapot_2464", 0),
    "teapot": ("teapot", 0),
    "bunny": ("bunny", 0),
    "spot": ("spot/spot_triangulated", 3),
    "nefertiti": ("nefertiti", 2),
}
"""File and number of midpoint subdivisions: 2.5K, 6K, 69K, 375K and 1.6M faces."""

START = (0.12, -0.15, 0.10, 0.05, -0.04, 0.06)
RATE = 0.01
"""First pose, and the steps of Adam."""

WARM_UP, ROUNDS, CONSECUTIVE = 2, 7, 3
"""Iterations before any is counted; turns of each side; iterations timed in a turn, after one that is not."""

PROCESSES = 3
"""Of each side, one after the other: what one is given of memory and cores makes it faster or slower for life."""


def subdivided(name: str, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32 and faces (T, 3) int32 of one of MESHES, one vertex a place; kept in the folder."""
    path = folder / f"{name}.npz"
    if not path.exists():
        import trimesh
        from scenes import mesh

        file, times = MESHES[name]
        vertices, faces = mesh(file)
        vertices, inverse = np.unique(vertices, axis=0, return_inverse=True)
        faces = inverse.reshape(-1)[faces]
        for _ in range(times):
            vertices, faces = trimesh.remesh.subdivide(vertices, faces)
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(path, vertices=np.asarray(vertices, np.float32), faces=np.asarray(faces, np.int32))
    kept = np.load(path)
    return kept["vertices"], kept["faces"]


class PoseTask:
    """Find the pose of a mesh from its hard silhouette of 4 × 4 samples a pixel, `side` pixels wide, at the zero pose.

    Args:
        vertices: (V, 3).
        faces: (T, 3).
        side: of the image, pixels.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, side: int):
        import rts

        self.size, self.count = (side, side), len(faces)
        self.camera = rts.Camera.look_at((0, 0, 3.2), (0, 0, 0), fov_y=40, near=0.5, far=10)
        self.part = rts.Part(rts.plugin("surfaces", "mesh")(faces), {"vertices": vertices}, "silhouette")
        steps = (np.arange(4) + 0.5) / 4 - 0.5
        self.target = sum(self._hard(x, y) for x in steps for y in steps).astype(np.float32) / 16

    def _hard(self, x: float, y: float) -> np.ndarray:
        """Alpha (H, W, 1) at a point of each pixel, from its centre, pixels right and down."""
        import rts

        shift = np.eye(4)
        shift[0, 3], shift[1, 3] = -2 * x / self.size[1], 2 * y / self.size[0]
        moved = self.camera._replace(projection=shift @ np.asarray(self.camera.projection))
        return rts.render(self.part, moved, self.size, splatter="none", layers=1)[..., 3:]

    def loss(self, pose: Any, target: Any) -> Any:
        """Mean squared difference, of a pose (6,) and the target (H, W, 1)."""
        import rts

        image = rts.render(self.part.replace(transform=rts.rigid(pose)), self.camera, self.size)
        return ((image[..., 3:] - target) ** 2).mean()

    def torch(self) -> Callable[[], object]:
        """One eager iteration a call."""
        import torch

        pose, target = torch.tensor(START, requires_grad=True), torch.from_numpy(self.target)
        optimizer = torch.optim.Adam([pose], lr=RATE)

        def step() -> float:
            optimizer.zero_grad()
            loss = self.loss(pose, target)
            loss.backward()
            optimizer.step()
            return loss.item()

        return step

    def jax(self) -> Callable[[], object]:
        """One iteration a call, all of it compiled."""
        import jax
        import jax.numpy as jnp
        import optax

        pose, target, rule = jnp.asarray(START, jnp.float32), jnp.asarray(self.target), optax.adam(RATE)
        state = rule.init(pose)

        @jax.jit
        def iteration(pose: Any, state: Any) -> tuple:
            loss, gradient = jax.value_and_grad(self.loss)(pose, target)
            updates, state = rule.update(gradient, state)
            return optax.apply_updates(pose, updates), state, loss

        def step() -> float:
            nonlocal pose, state
            pose, state, loss = jax.block_until_ready(iteration(pose, state))
            return loss.item()

        return step


def serve_speed(meshes: Path) -> None:
    """Answer requests, a line of JSON each: a mesh, a side, an engine and a number of iterations; their seconds.

    Args:
        meshes: the folder in which they are kept.
    """
    answers, sys.stdout = sys.stdout, sys.stderr  # What others print is no answer.

    @functools.lru_cache(1)
    def task(mesh: str, side: int) -> PoseTask:
        return PoseTask(*subdivided(mesh, meshes), side)

    @functools.lru_cache(1)
    def iteration(mesh: str, side: int, engine: str) -> Callable[[], object]:
        return getattr(task(mesh, side), engine)()

    for line in sys.stdin:
        mesh, side, engine, count = json.loads(line)
        answer: dict[str, Any] = {"seconds": []}
        try:
            step = iteration(mesh, side, engine)
            answer["faces"] = task(mesh, side).count
            for _ in range(count):
                start = time.perf_counter()
                step()
                answer["seconds"].append(time.perf_counter() - start)
        except (ImportError, SystemExit) as error:  # No such engine, or no such mesh.
            answer = {"missing": str(error)}
        print(json.dumps(answer), file=answers, flush=True)


class Server:
    """A process of one side that lives as long as the comparison.

    Args:
        site: of the install.
        meshes: folder of meshes.
    """

    def __init__(self, site: Path, meshes: Path):
        self.process = subprocess.Popen(
            worker(site, "speed", str(meshes)),
            env=environment(site),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, *request: Any) -> dict:
        """The answer to a request; see `serve_speed`."""
        assert self.process.stdin and self.process.stdout
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"a worker has died, with exit code {self.process.wait()}, when asked for {request}")
        return json.loads(line)

    def close(self) -> None:
        self.process.communicate()


class Times:
    """Of one mesh, size and engine.

    Attributes:
        seconds: of iterations, by pair of processes, then by side.
        faces: of the mesh.
    """

    def __init__(self):
        self.seconds: list[list[list[float]]] = []
        self.faces = 0

    def side(self, n: int) -> list[float]:
        """Of all processes of a side."""
        return [t for pair in self.seconds for t in pair[n]]

    def ratios(self) -> str:
        """The second side's median over that of the first; of all processes, and of each pair."""
        ratios = [statistics.median(b) / statistics.median(a) for a, b in self.seconds]
        whole = statistics.median(self.side(1)) / statistics.median(self.side(0))
        return f"{whole:.2f} ({', '.join(f'{r:.2f}' for r in ratios)})"


def in_turn(servers: Sequence[Server], request: tuple, rounds: int, found: Times) -> str | None:
    """Add the seconds of iterations of each side; why there are none."""
    for server in servers:
        answer = server.ask(*request, WARM_UP)
        if "missing" in answer:
            return answer["missing"]
        found.faces = answer["faces"]
    order = list(range(len(servers)))
    if len(found.seconds) % 2:
        order.reverse()
    found.seconds.append([[] for _ in servers])
    for _ in range(rounds):
        for n in order:
            found.seconds[-1][n] += servers[n].ask(*request, 1 + CONSECUTIVE)["seconds"][1:]
        order.reverse()
    return None


def spread(seconds: list[float]) -> str:
    """Median and quartiles, milliseconds."""
    low, middle, high = (1e3 * x for x in statistics.quantiles(seconds, n=4, method="inclusive"))
    return f"{middle:.2f} ({low:.2f} to {high:.2f})"


def run_speed(args: argparse.Namespace, console: Console) -> bool:
    times = {(m, s, e): Times() for m in args.meshes for s in args.sizes for e in args.engines}
    missing = set()
    with folder_of(args.folder) as folder:
        sides = sides_of((args.before, args.after), folder / "installs")
        for n in range(args.processes):
            load = ", ".join(f"{x:.1f}" for x in os.getloadavg())
            console.print(f"processes {n + 1} of {args.processes}; load of the machine {load}", highlight=False)
            servers = [Server(side.site, folder / "meshes") for side in sides]
            for request, found in times.items():
                missing.add(in_turn(servers, request, args.rounds, found))
            for server in servers:
                server.close()
    table = Table("mesh", "faces", "size", "engine", *(f"{side.label}, ms" for side in sides), "ratio")
    for (mesh, side, engine), found in times.items():
        if found.seconds:
            spreads = spread(found.side(0)), spread(found.side(1))
            table.add_row(mesh, f"{found.faces:,}", f"{side}²", engine, *spreads, found.ratios())
    console.print(table)
    count = args.processes * args.rounds * CONSECUTIVE
    console.print(f"medians (and quartiles) of {count} iterations; ratio: second over first (by pairs of processes)")
    for reason in sorted(missing - {None}):
        console.print(f"left out: {reason}", markup=False, highlight=False)
    return True


# --------------------------------------------------------------------------------------------------- command line


def work(site: Path, kind: str, folder: Path) -> None:
    """A worker's: see `worker`."""
    isolate(site)
    {"results": record_results, "speed": serve_speed}[kind](folder)
    check_origin(site)


def main() -> None:
    if sys.argv[1:2] == ["worker"]:
        site, kind, folder = sys.argv[2:]
        return work(Path(site), kind, Path(folder))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    results = commands.add_parser("results", help="samples, images and gradients of both")
    speed = commands.add_parser("speed", help="iterations of a pose fit by both")
    for command in (results, speed):
        command.add_argument("before", nargs="?", default="HEAD~1")
        command.add_argument("after", nargs="?", default=WORKING_TREE)
        command.add_argument("--folder", type=Path, help="keeps installs, with compiled kernels, and meshes")
    results.add_argument("-o", "--output", type=Path, help="folder that keeps the arrays of both sides")
    results.add_argument("--shown", type=int, default=5, help="arrays to name where a line of the table differs")
    speed.add_argument("--meshes", nargs="+", choices=MESHES, default=list(MESHES))
    speed.add_argument("--sizes", nargs="+", type=int, default=[256, 512])
    speed.add_argument("--engines", nargs="+", choices=("torch", "jax"), default=["torch", "jax"])
    speed.add_argument("--rounds", type=int, default=ROUNDS, help="turns of each process")
    speed.add_argument("--processes", type=int, default=PROCESSES, help="of each side, one after the other")
    args = parser.parse_args()
    run = {"results": run_results, "speed": run_speed}[args.command]
    raise SystemExit(0 if run(args, Console(width=None if sys.stdout.isatty() else 120)) else 1)


if __name__ == "__main__":
    main()
