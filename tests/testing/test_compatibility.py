"""Every surface with every sampler in every engine, on the example of each surface."""

import functools
import io

import numpy as np
import pytest
from analytic import Ellipsoid
from rich.console import Console
from typer.testing import CliRunner

import rts
from rts_cli import plugin_tables
from rts_cli.main import app
from rts_cli.plugin_tables import print_matrix
from rts_surfaces.implicit.fields import swept_sphere
from rts_testing import compatibility

pytestmark = pytest.mark.plugins


class OwnEllipsoid(Ellipsoid):
    """A surface without triangles, as none is registered."""

    @classmethod
    def example(cls):
        theta = {"center": np.array([0.1, 0.0, 0.1], np.float32), "radii": np.array([1.0, 0.7, 0.8], np.float32)}
        return rts.Part(cls(), theta, shader="lambert")


def example(name):
    """A surface's example, or why there is none."""
    try:
        return compatibility.example(name) or "the surface gives no example"
    except rts.errors.PluginError as error:
        return str(error)


def torus(**options):
    """An isosurface of a function."""
    if isinstance(example("isosurface"), str):
        return example("isosurface")
    surface = rts.plugin("surfaces", "isosurface")(BOUNDS, f=swept_sphere, shape=(41, 17, 41), **options)
    return rts.Part(surface, {"radii": np.array([0.9, 0.4], np.float32)}, "normals")


BOUNDS = ((-1.41, -0.53, -1.4), (1.4, 0.52, 1.43))
EXAMPLES = {name: example(name) for name in rts.plugins("surfaces")} | {
    "ellipsoid": OwnEllipsoid.example(),
    "isosurface of a function": torus(),
    "isosurface with a table": torus(table=True, motion="edge", lipschitz=1.0),
}


def works(surface, sampler):
    """True if a pair should work: samplers other than "auto" and "rays" need triangles."""
    return sampler == "auto" or hasattr(surface, "intersect" if sampler == "rays" else "proxy")


@functools.cache
def shown(surface, sampler):
    """The image of an example by a sampler, in NumPy."""
    return compatibility.attempt(EXAMPLES[surface], sampler, "numpy")


PAIRS = [(sampler, "numpy") for sampler in rts.plugins("samplers")]
PAIRS += [("auto", engine) for engine in rts.plugins("engines") if engine != "numpy"]
"""Samples are NumPy arrays whatever the engine, so that each sampler with one engine tells as much as with all."""


@pytest.mark.parametrize("sampler, engine", PAIRS)
@pytest.mark.parametrize("surface", EXAMPLES)
def test_a_pair_shows_the_surface_or_says_why_not(surface, sampler, engine):
    part = EXAMPLES[surface]
    if isinstance(part, str):
        pytest.skip(part)
    if not works(part.surface, sampler):
        with pytest.raises(rts.InputError, match=r"\A[^\n]*; use a sampler of [^\n]*\Z"):
            compatibility.attempt(part, sampler, engine)
        return
    try:
        image = compatibility.attempt(part, sampler, engine)
    except rts.errors.PluginError as error:
        pytest.skip(str(error))
    of_rays = sampler == "rays" or not hasattr(part.surface, "proxy")
    expected = shown(surface, "rays" if of_rays else "reference")
    differing = (np.abs(image - expected) > 1e-4).any(axis=-1)
    assert expected[..., 3].mean() > 0.1 and differing.mean() < 0.01


def test_the_matrix_names_each_pair_and_why_one_does_not_work(monkeypatch):
    class Bare:
        """Without an example."""

    class Broken(OwnEllipsoid):
        def evaluate(self, theta, samples):
            raise KeyError("lost")

    found = {"mesh": rts.plugin("surfaces", "mesh"), "bare": Bare, "broken": Broken}
    plugin, plugins = rts.plugin, rts.plugins
    names = {"rts.engines": ["numpy"], "rts.samplers": ["raster", "rays"], "rts.surfaces": list(found)}
    for place in (compatibility, plugin_tables):
        monkeypatch.setattr(place, "plugins", lambda group: names.get(group) or plugins(group))
    monkeypatch.setattr(compatibility, "plugin", lambda group, name: found.get(name) or plugin(group, name))
    monkeypatch.setenv("COLUMNS", "300")
    done = CliRunner().invoke(app, ["plugins", "--matrix"])
    assert done.exit_code == 0
    lines = [[cell.strip() for cell in line.split("│")] for line in done.output.splitlines() if "│" in line]
    cells = {(surface, sampler): rest for surface, sampler, *rest in lines}
    assert cells["mesh", "raster"] == ["ok", ""]
    assert cells["mesh", "rays"][0] == "no" and "use a sampler of triangles" in cells["mesh", "rays"][1]
    assert "Mesh(" not in cells["mesh", "rays"][1]
    assert cells["bare", ""] == ["no", "no example"]
    assert cells["broken", "rays"] == ["no", "KeyError: 'lost'"]
    assert "has no triangles" in cells["broken", "raster"][1]


def test_rows_of_the_matrix_come_one_by_one(monkeypatch):
    """Each is written and flushed before the next pair is tried."""
    written, flushed = [], []

    class Pipe(io.StringIO):
        def flush(self):
            flushed.append(self.getvalue().count("mesh"))

    pipe = Pipe()

    def tried(part, sampler, engine):
        written.append(pipe.getvalue().count("mesh"))

    monkeypatch.setattr(compatibility, "attempt", tried)
    print_matrix(Console(file=pipe, width=200), ["mesh", "raster", "rays", "reference", "numpy"])
    assert written == [0, 1, 2] and {1, 2, 3} <= set(flushed)


def test_the_matrix_of_some_plugins(monkeypatch):
    tried = []
    monkeypatch.setattr(compatibility, "attempt", lambda part, sampler, engine: tried.append((sampler, engine)))
    done = CliRunner().invoke(app, ["plugins", "--matrix", "--only", "mesh", "--only", "numpy"])
    assert done.exit_code == 0 and tried == [(sampler, "numpy") for sampler in rts.plugins("samplers")]
    assert "jax" not in done.output and "bezier" not in done.output
    done = CliRunner().invoke(app, ["plugins", "--matrix", "--only", "meshes"])
    assert done.exit_code == 1 and "there is no surface, sampler or engine 'meshes'; expected" in done.stderr
    done = CliRunner().invoke(app, ["plugins", "--only", "mesh"])
    assert done.exit_code == 2 and "goes with --matrix" in done.stderr


@pytest.mark.parametrize(
    "error, said",
    [
        (
            TypeError("got <rts.Odd object at 0x7f00ff12>\nTraceback (most recent call last)\n" + "x " * 500),
            "TypeError: got rts.Odd",
        ),
        (rts.InputError("<odd.Thing object at 0x7f00> does not fit; give another"), "odd.Thing does not fit; give"),
    ],
)
def test_errors_of_others_are_a_short_line(monkeypatch, error, said):
    def fails(*_):
        raise error

    monkeypatch.setattr(compatibility, "attempt", fails)
    (pair,) = compatibility.pairs(["mesh", "raster", "numpy"])
    reason = pair.problems["numpy"]
    assert reason.startswith(said) and "0x" not in reason and "\n" not in reason and len(reason) <= 120


@pytest.mark.filterwarnings("ignore::rts.errors.EmptyImageWarning")
@pytest.mark.parametrize(
    "change, expected",
    [
        ({"center": np.full(3, 50, np.float32)}, "the image is empty"),
        ({"detached": np.ones(3, np.float32)}, "gradient in theta is zero"),
    ],
)
def test_an_example_that_shows_nothing_is_no_success(change, expected):
    pytest.importorskip("torch")

    class Detached(OwnEllipsoid):
        def evaluate(self, theta, samples):
            gbuffer = super().evaluate(theta, samples)
            if "detached" not in theta:
                return gbuffer
            return rts.GBuffer(position=gbuffer["position"].detach(), normal=gbuffer["normal"].detach())

    part = Detached.example()
    with pytest.raises(rts.RtsError, match=expected):
        compatibility.attempt(part.replace(theta={**part.theta, **change}), "rays", "torch")
