"""Without each optional package all else works and the error says what to install; the same without a display."""

import shutil
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from helpers import icosphere

import rts
from rts import InputError, Part
from rts.errors import PluginError
from rts.scene.camera import perspective
from rts_testing.compatibility import BORDER

pytestmark = pytest.mark.core

SIZE = (96, 120)
CAMERA = rts.Camera(rts.Camera.look_at((1, 2, 3), (0, 0, 0)).view, perspective(50.0, 1.25, 0.5, 9.0))
Mesh = rts.plugin("surfaces", "mesh")

HIDE = """
import sys

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == {package!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Hidden())
import numpy as np
import rts

vertices = np.array([(-1, -1, 0), (1, -1, 0), (0, 1, 0)], np.float32)
part = rts.Part(rts.plugin("surfaces", "mesh")([(0, 1, 2)]), {{"vertices": vertices}})
camera, size = rts.Camera.look_at((0, 0, 3), (0, 0, 0)), (12, 15)
expected = rts.render(part, camera, size)
assert 0.05 < expected[..., 3].mean() < 0.95

def agrees(image):
    np.testing.assert_allclose(np.asarray(image), expected, atol=1e-5)

def error(call):
    try:
        call()
    except rts.errors.PluginError as problem:
        print("PluginError:", problem)
    else:
        raise AssertionError("no error")

for sampler in {samplers}:
    agrees(rts.render(part, camera, size, sampler=sampler))
if {torch}:
    import torch
    pose = torch.zeros(6, requires_grad=True)
    image = rts.render(part.replace(transform=rts.rigid(pose)), camera, size)
    agrees(image.detach())
    image.sum().backward()
    assert pose.grad.abs().max() > 0
if {jax}:
    import jax
    def image(pose):
        return rts.render(part.replace(transform=rts.rigid(pose)), camera, size)
    pose = jax.numpy.zeros(6)
    agrees(image(pose))
    assert abs(jax.jit(jax.grad(lambda p: image(p).sum()))(pose)).max() > 0
"""


def without(package, code, *, samplers=("raster", "reference"), torch=False, jax=False):
    """The output of a program that cannot import a package."""
    script = HIDE.format(package=package, samplers=samplers, torch=torch, jax=jax) + textwrap.dedent(code)
    done = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


# ------------------------------------------------------------------------------------------ packages missing


def test_without_embreex_the_rest_works_and_auto_passes_embree_by():
    pytest.importorskip("torch")
    printed = without(
        "embreex",
        """
        error(lambda: rts.render(part, camera, size, sampler="embree"))
        from rts.sampling import auto
        auto.STATIC_FACES = 1
        (choice,) = rts.explain(part.replace(transform=rts.rigid(pose)), camera)
        print(choice.sampler, "since", choice.reason)
        agrees(rts.render(rts.prepare(part), camera, size))
        agrees(rts.render(part.replace(transform=rts.rigid(pose.detach())), camera, size, sampler="auto"))
        """,
        torch=True,
    )
    first, second = printed.splitlines()
    assert (
        first.startswith("PluginError:")
        and "'embreex'" in first
        and "pip install 'rasterize-then-splat[embree]'" in first
    )
    assert second.startswith("raster since") and "pip install 'rasterize-then-splat[embree]'" in second


def test_without_moderngl_the_rest_works():
    printed = without("moderngl", "error(lambda: rts.render(part, camera, size, sampler='opengl'))")
    assert "'moderngl'" in printed and "pip install 'rasterize-then-splat[opengl]'" in printed


def test_without_torch_numpy_and_jax_work():
    pytest.importorskip("jax")
    printed = without("torch", "error(lambda: rts.plugin('engines', 'torch'))", jax=True)
    assert "'torch'" in printed and "pip install 'rasterize-then-splat[torch]'" in printed


def test_without_jax_numpy_and_torch_work():
    pytest.importorskip("torch")
    printed = without("jax", "error(lambda: rts.plugin('engines', 'jax'))", torch=True)
    assert "'jax'" in printed and "pip install 'rasterize-then-splat[jax]'" in printed


def test_without_optax_jax_renders():
    pytest.importorskip("jax")
    without("optax", "", jax=True)


@pytest.mark.parametrize("package", ["typer", "rich"])
def test_without_the_packages_of_the_command_the_library_works_and_the_command_says_what_it_needs(package):
    printed = without(
        package,
        """
        from rts_cli.__main__ import main
        try:
            main()
        except SystemExit as stop:
            print(stop.code)
        from rts.terminal import shows_bar
        assert not shows_bar(None) and not shows_bar(False)
        if package == "rich":
            error(lambda: shows_bar(True))
        """.replace("package", repr(package)),
    )
    needs = f"error: the command rts needs the package {package!r}: pip install 'rasterize-then-splat[cli]'"
    assert printed.splitlines()[0] == needs
    assert package == "typer" or "PluginError: progress=True needs the package 'rich'" in printed


@pytest.mark.thorough
def test_without_matplotlib_all_works_but_the_plot_which_says_what_it_needs():
    printed = without(
        "matplotlib",
        """
        from pathlib import Path
        from rts_cli import main, pose_report
        fit = rts.results.Fit(None, 0.1, [1.0, 0.1], 2, "", 0.0, (2,), [])
        assert pose_report._plot(Path("convergence.png"), fit) == []
        main._say_skipped_plot([])
        """,
    )
    assert "pip install 'rasterize-then-splat[plots]'" in " ".join(printed.split())


@pytest.mark.thorough
@pytest.mark.parametrize(
    "package, plugin",
    [("embreex", "rasterize-then-splat[embree]"), ("jax", "rasterize-then-splat[jax]")],
)
def test_the_table_of_plugins_says_what_is_missing_and_lists_the_others(package, plugin):
    printed = without(
        package,
        """
        from rts import registry
        for info in registry.survey():
            print(info.group, info.name, "|", info.error)
        """,
        samplers=(),
    )
    lines = printed.splitlines()
    assert any(f"pip install '{plugin}'" in line for line in lines)
    assert "rts.samplers raster | None" in lines and "rts.engines numpy | None" in lines


# ------------------------------------------------------------------------------------------- no OpenGL device


def render(sampler):
    return rts.render(
        Part(Mesh([(0, 1, 2)]), {"vertices": icosphere(0)[0]}),
        CAMERA,
        (9, 12),
        sampler=sampler,
        layers=2,
    )


def opengl_sampler():
    try:
        sampler = rts.plugin("samplers", "opengl")()
        render(sampler)
        return sampler
    except PluginError as error:
        pytest.skip(str(error))


def test_without_a_device_the_error_names_the_packages_that_help(monkeypatch):
    moderngl = pytest.importorskip("moderngl")

    def fail(**_):
        raise Exception("libEGL.so.1 not found in /lib, /usr/lib")

    monkeypatch.setattr(moderngl, "create_context", fail)
    sampler = rts.plugin("samplers", "opengl")()
    with pytest.raises(PluginError) as error:
        render(sampler)
    message = str(error.value)
    for expected in ("libegl1", "libgl1-mesa-dri", "libEGL.so.1 not found", "GLCONTEXT_DEVICE_INDEX", "'raster'"):
        assert expected in message
    # The next call tries again, and does not wait for ever.
    with pytest.raises(PluginError, match="libegl1"):
        render(sampler)
    monkeypatch.undo()
    opengl_sampler()
    np.testing.assert_allclose(render(sampler), render("raster"), atol=1e-5)


class Lost:
    """A context that reports an error once."""

    def __init__(self, context):
        self._context, self.errors = context, ["GL_CONTEXT_LOST"]

    def __getattr__(self, name):
        return getattr(self._context, name)

    def __setattr__(self, name, value):
        if name in ("_context", "errors"):
            object.__setattr__(self, name, value)
        else:
            setattr(self._context, name, value)

    @property
    def error(self):
        return self.errors.pop() if self.errors else self._context.error


def test_after_a_lost_context_the_next_call_works_again():
    sampler = opengl_sampler()
    expected = render(sampler)
    part = Part(Mesh(icosphere(2)[1]), {"vertices": icosphere(2)[0]})
    kept = rts.render(part, CAMERA, SIZE, sampler=sampler)
    handle = rts.prepare(part, sampler)
    sampler._worker.context = Lost(sampler._worker.context)
    with pytest.raises(PluginError) as error:
        render(sampler)
    assert "GL_CONTEXT_LOST" in str(error.value) and "libgl1-mesa-dri" in str(error.value)
    np.testing.assert_array_equal(render(sampler), expected)
    # What was on the device before is moved there again, kept entries and handles alike.
    np.testing.assert_array_equal(rts.render(part, CAMERA, SIZE, sampler=sampler), kept)
    np.testing.assert_array_equal(rts.render(handle, CAMERA, SIZE), kept)


def test_a_closed_worker_starts_again():
    sampler = opengl_sampler()
    expected = render(sampler)
    sampler._worker.close()
    np.testing.assert_array_equal(render(sampler), expected)


def test_a_thread_that_ended_is_not_waited_for():
    sampler = opengl_sampler()
    expected, worker = render(sampler), sampler._worker
    worker.later(lambda context: time.sleep(0.5))
    worker._tasks.put(None)
    with pytest.raises(PluginError, match="has ended"):
        render(sampler)
    np.testing.assert_array_equal(render(sampler), expected)


# ---------------------------------------------------------------------------------- what OpenGL cannot draw


@pytest.mark.parametrize("tall", [False, True], ids=["wide", "tall"])
def test_an_image_beyond_the_device_is_refused_and_the_next_render_works(tall):
    sampler = opengl_sampler()
    expected, context = render(sampler), sampler._worker.context
    limit = context.info["GL_MAX_TEXTURE_SIZE"]
    size = (limit + 1, 1) if tall else (1, limit + 1)
    part = Part(Mesh([(0, 1, 2)]), {"vertices": icosphere(0)[0]})
    for _ in range(2):
        with pytest.raises(InputError) as error:
            rts.render(part, CAMERA, size, sampler=sampler)
        message = str(error.value)
        assert (
            f"{size[0] + 2 * (BORDER + 1)} × {size[1] + 2 * (BORDER + 1)} pixels" in message
            and f"at most {limit} × {limit}" in message
        )
        assert "'raster'" in message and "\n" not in message
        np.testing.assert_array_equal(render(sampler), expected)
    assert sampler._worker.context is context


def test_an_error_before_an_exception_is_not_found_by_the_next_render():
    sampler = opengl_sampler()
    expected, context = render(sampler), sampler._worker.context

    def fail(context):
        context.line_width = -1.0
        raise ValueError("after GL_INVALID_VALUE")

    with pytest.raises(ValueError, match="GL_INVALID_VALUE"):
        sampler._worker.call(fail)
    np.testing.assert_array_equal(render(sampler), expected)
    assert sampler._worker.context is context


class Failing:
    """A context whose second framebuffer fails, and what was made of it."""

    def __init__(self, context):
        self.context, self.made = context, []

    def __getattr__(self, name):
        return getattr(self.context, name)

    def _make(self, kind, *args, **kwargs):
        self.made.append(getattr(self.context, kind)(*args, **kwargs))
        return self.made[-1]

    def texture(self, *args, **kwargs):
        return self._make("texture", *args, **kwargs)

    def depth_renderbuffer(self, *args, **kwargs):
        return self._make("depth_renderbuffer", *args, **kwargs)

    def framebuffer(self, *args, **kwargs):
        import moderngl

        if len(self.made) > 3:
            raise moderngl.Error("the framebuffer is not complete\n(FAKE)")
        return self._make("framebuffer", *args, **kwargs)


def test_targets_half_made_are_released_and_the_error_is_ours():
    sampler = opengl_sampler()
    from rts_backends.opengl.sampler import _targets

    expected, kept = render(sampler), []

    def fail(context):
        kept.append(Failing(context))
        _targets(kept[0], (7, 8))

    with pytest.raises(PluginError, match=r"is not complete \(FAKE\).*'raster'"):
        sampler._worker.call(fail)
    assert [type(item.mglo).__name__ for item in kept[0].made] == ["InvalidObject"] * 5
    np.testing.assert_array_equal(render(sampler), expected)


# ---------------------------------------------------------------------------------------- no Embree library


def test_without_embrees_library_auto_passes_embree_by():
    pytest.importorskip("embreex")
    code = """
        import ctypes.util, glob
        glob.glob, ctypes.util.find_library = lambda pattern: [], lambda name: None
        import rts
        from rts.sampling import auto

        auto.STATIC_FACES = 1
        part = rts.Part(rts.Mesh([(0, 1, 2)]), {"vertices": [(0.0, 0, 0), (1, 0, 0), (0, 1, 0)]}, "normals")
        print(auto.choose(part, static=True))
        try:
            rts.render(part, rts.Camera.look_at((0, 0, 3), (0, 0, 0)), (12, 15), sampler="embree")
        except rts.errors.PluginError as error:
            print(error)
    """
    ran = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=120)
    first, second = ran.stdout.splitlines()
    assert "'raster'" in first and "libembree4" in first
    assert second.startswith("the sampler 'embree' needs Embree 4's shared library")


def test_a_broken_framework_that_something_has_imported_is_no_matter_for_numpy():
    code = """
        import sys, types
        import numpy as np
        import rts

        sys.modules["jax"], sys.modules["torch"] = types.ModuleType("jax"), None
        vertices = np.array([(-1, -1, 0), (1, -1, 0), (0, 1, 0)], np.float32)
        part = rts.Part(rts.plugin("surfaces", "mesh")([(0, 1, 2)]), {"vertices": vertices})
        assert rts.render(part, rts.Camera.look_at((0, 0, 3), (0, 0, 0)), (12, 15))[..., 3].max() > 0.9
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=True, timeout=120)


@pytest.mark.thorough
def test_a_folder_named_rts_does_not_hide_an_editable_install(tmp_path):
    pytest.importorskip("setuptools", minversion="77")
    clone, site, beside = (tmp_path / name for name in ("clone", "site", "beside"))
    root = Path(__file__).resolve().parents[2]
    for name in ("rts", *(path.name for path in root.glob("rts_*") if path.is_dir())):
        (clone / name).mkdir(parents=True)
        (clone / name / "__init__.py").write_text('__version__ = "1.2.3"\n')
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(root / name, clone)
    build = f"from setuptools import build_meta; build_meta.build_editable({str(tmp_path)!r})"
    subprocess.run([sys.executable, "-W", "ignore", "-c", build], cwd=clone, capture_output=True, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    shutil.unpack_archive(wheel, site, "zip")
    (beside / "rts").mkdir(parents=True)
    code = f"import site; site.addsitedir({str(site)!r}); import rts; print(rts.__file__, rts.__version__)"
    done = subprocess.run([sys.executable, "-S", "-c", code], cwd=beside, capture_output=True, text=True)
    assert done.stdout.split() == [str(clone / "rts/__init__.py"), "1.2.3"], done.stderr
