import inspect
import json
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers import crooked_block
from PIL import Image
from typer.testing import CliRunner

import rts
from rts.errors import InputError, PluginError
from rts.files import lit_models
from rts.files.srgb import decode_srgb
from rts.scene.default_camera import Bounds, bounds_of, orbit
from rts_cli import demo, plugin_tables, tried_versions
from rts_cli import main as cli
from rts_cli import pose_fit as pose

pytestmark = pytest.mark.files


def run(*arguments):
    with warnings.catch_warnings():
        warnings.simplefilter("default")  # As in a program; the tests' own filter makes errors of warnings.
        return CliRunner().invoke(cli.app, [str(a) for a in arguments])


def succeed(*arguments):
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    return " ".join(result.output.split())


def fail(*arguments, code=1):
    result = run(*arguments)
    assert result.exit_code == code, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("rts: ") and result.stderr.count("\n") == 1
    return result.stderr.removesuffix("\n")


@pytest.fixture
def model(tmp_path):
    return crooked_block(tmp_path)


# ------------------------------------------------------------------------------------------------- program


def test_help_shows_examples_for_every_command():
    assert "rts fit-pose bunny.obj photo.png -o found" in succeed("--help")
    for command in ("render", "fit-pose", "export", "demo"):
        assert f"Example: rts {command}" in succeed(command, "--help").replace(
            "rts render bunny.obj -o mask", "rts fit-pose"
        )
    assert "engines, surfaces, samplers" in succeed("plugins", "--help")


def test_version():
    assert re.fullmatch(r"rts \d+\.\d+.*", succeed("--version"))


def test_the_installed_program_reports_an_error_in_one_line_and_the_traceback_on_request():
    def installed(*arguments):
        code = "import sys; from rts_cli.main import main; sys.argv[0] = 'rts'; main()"
        return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)

    short = installed("render", "gone.obj")
    assert short.returncode == 1 and short.stdout == ""
    assert short.stderr.startswith("rts: no file gone.obj; check the path") and short.stderr.count("\n") == 1
    for arguments in (["--debug", "render", "gone.obj"], ["render", "--debug", "gone.obj"]):
        long = installed(*arguments)
        assert long.returncode == 1
        assert "Traceback" in long.stderr and "InputError: no file gone.obj" in long.stderr
    usage = installed("render", "--sise", "3", "gone.obj")
    assert usage.returncode == 2 and usage.stdout == ""
    assert usage.stderr.startswith("rts: No such option: --sise") and usage.stderr.count("\n") == 1


@pytest.mark.parametrize("place", range(3))
def test_debug_may_stand_anywhere(place):
    arguments = ["render", "gone.obj"]
    arguments.insert(place, "--debug")
    assert isinstance(run(*arguments).exception, InputError)
    assert "No such option: --debug" not in fail("render", "--", "--debug")


def program(*arguments, cwd=None):
    command = [sys.executable, "-m", "rts", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd)


@pytest.mark.thorough
def test_as_a_module_it_is_the_same_program(tmp_path):
    shown = program("render", "--help").stdout
    assert "Usage: rts render [OPTIONS]" in shown and "-m" not in shown and "__main__" not in shown
    assert "Usage: rts [OPTIONS]" in program().stdout
    wrong = program("render", "--sise", "3", "gone.obj")
    assert wrong.returncode == 2 and wrong.stdout == ""
    assert wrong.stderr.startswith("rts: No such option: --sise") and "try 'rts render --help'" in wrong.stderr


QUAD = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def test_warnings_are_lines_like_errors_in_the_installed_program(tmp_path):
    (tmp_path / "m.obj").write_text(f"mtllib gone.mtl\n{QUAD}f 1 2 3 4\n")
    done = program("render", "m.obj", "-o", "a.png", "--size", "8", cwd=tmp_path)
    assert done.returncode == 0 and "wrote a.png" in done.stdout
    [line] = done.stderr.splitlines()
    assert line.startswith("rts: warning: m.obj names the material library 'gone.mtl', but there is no file")


def test_what_a_file_says_cannot_command_the_terminal(tmp_path):
    (tmp_path / "m.obj").write_text(f"mtllib \x1b[2J.mtl\n{QUAD}f 1 2 \x1b[31m\n")
    result = run("render", tmp_path / "m.obj")
    assert result.exit_code == 1 and "\x1b" not in result.stderr and result.stderr.count("\n") == 1
    (tmp_path / "m.obj").write_text(f"mtllib \x1b[2J.mtl\n{QUAD}f 1 2 3\n")
    result = run("render", tmp_path / "m.obj", "-o", tmp_path / "a.png", "--size", 8)
    assert result.exit_code == 0 and "\x1b" not in result.stderr and r"\x1b[2J.mtl" in result.stderr


def test_each_warning_is_shown_once_and_in_one_line_whoever_warns(tmp_path, monkeypatch):
    (tmp_path / "m.obj").write_text(f"{QUAD}f 1 2 3 4\n")
    load = lit_models.load

    def warning(path, **options):
        for number in (1, 2, 1, 2):
            warnings.warn(f"odd\n  thing {number}", RuntimeWarning, stacklevel=number)
        np.float32(1e30) * np.float32(1e30)
        return load(path)

    monkeypatch.setattr(lit_models, "load", warning)
    before = warnings.showwarning
    result = run("render", tmp_path / "m.obj", "-o", tmp_path / "a.png", "--size", 8)
    assert result.exit_code == 0 and warnings.showwarning is before
    lines = result.stderr.splitlines()
    assert lines[:2] == ["rts: warning: odd thing 1", "rts: warning: odd thing 2"]
    assert len(lines) == 3 and re.fullmatch("rts: warning: overflow encountered in .*", lines[2])


def test_without_arguments_there_is_the_help():
    assert succeed() == succeed("--help")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["rendr"], r"No such command 'rendr'.*; try 'rts --help'"),
        (["--verbose"], r"No such option: --verbose.*; try 'rts --help'"),
        (["--debug"], r"Missing command; try 'rts --help'"),
        (["render"], r"Missing argument 'model'; try 'rts render --help'"),
        (["fit-pose", "model.obj"], r"Missing argument 'target'; try 'rts fit-pose --help'"),
        (["demo", "extra"], r"unexpected extra argument.*; try 'rts demo --help'"),
        (["render", "m.obj", "--camera", "up"], r"'up' is no camera.*; try 'rts render --help'"),
        (["render", "m.obj", "--camera"], r"'--camera' requires an argument; try 'rts render --help'"),
        (["fit-pose", "m.obj", "t.png", "--camera", "up"], r"'up' is no camera.*; try 'rts fit-pose --help'"),
    ],
)
def test_wrong_usage_is_one_line_that_names_the_help(arguments, expected):
    assert re.search(expected, fail(*arguments, code=2), re.IGNORECASE)


def test_plugins_lists_each_plugin_and_why_one_does_not_load(monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    output = succeed("plugins")
    for name in (
        n for group in ("engines", "surfaces", "samplers", "shaders", "splatters") for n in rts.plugins(group)
    ):
        assert f"│ {name} │" in output
    broken = [rts.results.PluginInfo("rts.samplers", "odd", "odd 1.0", "needs [odd]: pip install odd")]
    monkeypatch.setattr(plugin_tables, "survey", lambda: broken)
    assert "│ samplers │ odd │ odd 1.0 │ needs [odd]: pip install odd │ │" in succeed("plugins")
    able = {"triangles": True, "rays": False, "layers": 1, "reads": ("uv", "normal"), "reach": None}
    partly = [rts.results.PluginInfo("rts.samplers", "odd", "odd 1.0", None, ("dd",), "odd[odd]", able)]
    monkeypatch.setattr(plugin_tables, "survey", lambda: partly)
    ready = "ready, but without dd: pip install 'odd[odd]'"
    assert f"│ {ready} │ triangles, layers 1, reads uv normal │" in succeed("plugins")


def test_plugins_names_installed_packages_that_are_newer_than_any_tried(monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    known = {name: f"{newest}.9" for name, newest in tried_versions.NEWEST.items()}
    monkeypatch.setattr(tried_versions, "installed", lambda: known)
    assert "untried" not in succeed("plugins")
    minor = tried_versions.NEWEST["torch"].partition(".")[2]
    monkeypatch.setattr(tried_versions, "installed", lambda: known | {"torch": f"2.{int(minor) + 1}.0+cpu"})
    _, _, line = succeed("plugins").partition("untried, though nothing forbids it: ")
    assert line == f"torch 2.{int(minor) + 1}.0+cpu (newest tried: 2.{minor})"


def test_the_pinned_versions_are_no_newer_than_those_tried():
    pinned = dict(
        line.lower().split("==")
        for line in (Path(__file__).parents[2] / "constraints.txt").read_text().split()
        if "==" in line
    )
    for name, newest in tried_versions.NEWEST.items():
        if name != "python":
            assert not tried_versions._newer(name, pinned[name]), f"{name} {pinned[name]}, newest tried {newest}"


# -------------------------------------------------------------------------------------------------- render


def test_render_frames_the_whole_object(model, tmp_path):
    output = succeed("render", model, "-o", tmp_path / "new" / "a.png", "--size", "80x48")
    assert "Mesh(12 faces), 80 x 48 pixels" in output and "a.png" in output
    alpha = rts.load_image(tmp_path / "new" / "a.png")[..., 3]
    assert alpha.shape == (48, 80)
    assert alpha.max() == 1
    assert max(alpha[0].max(), alpha[-1].max(), alpha[:, 0].max(), alpha[:, -1].max()) == 0


def test_a_size_of_unequal_sides_says_which_is_the_height_until_0_4(model, tmp_path):
    assert rts.__version__ < "0.4", "the line goes"
    for size, line in (("80x48", "size 80x48 is 80 wide and 48 high; before rts 0.3 the height came first"), ("9", "")):
        result = run("render", model, "-o", tmp_path / "a.png", "--size", size)
        assert result.exit_code == 0 and result.stderr == (line and f"rts: warning: {line}\n")


def test_the_field_of_view_is_that_of_the_library():
    defaults = [inspect.signature(f).parameters for f in (rts.Camera.look_at, rts.Camera.perspective, orbit)]
    angles = {(p.get("fov_y") or p["fov"]).default for p in defaults}
    assert angles == {inspect.signature(f).parameters["fov"].default for f in (cli.render, cli.fit_pose)} == {45.0}


def test_render_counts_the_parts_of_a_scene(model, tmp_path):
    block = trimesh.load(model)
    trimesh.Scene([block, block.copy().apply_translation([3, 0, 0])]).export(tmp_path / "two.glb")
    assert "2 parts, 16 x 16 pixels" in succeed("render", tmp_path / "two.glb", "-o", tmp_path / "a.png", "--size", 16)


@pytest.mark.parametrize("engine", ["torch", "jax"])
def test_engines_render_the_same(model, tmp_path, engine):
    pytest.importorskip(engine)
    common = ["--size", 32, "--layers", 1, "--splatter", "single", "--shader", "normals", "--sampler", "raster"]
    succeed("render", model, "-o", tmp_path / "a.png", *common)
    succeed("render", model, "-o", tmp_path / "b.png", *common, "--engine", engine)
    np.testing.assert_allclose(rts.load_image(tmp_path / "a.png"), rts.load_image(tmp_path / "b.png"), atol=0.01)


def test_render_writes_outputs_beside_the_picture_or_as_arrays(model, tmp_path):
    from PIL import Image

    names = "color,depth,normal,part,alpha"
    said = succeed("render", model, "-o", tmp_path / "a.png", "--size", 32, "--outputs", names, "--profile")
    succeed("render", model, "-o", tmp_path / "a.npz", "--size", 32, "--outputs", f"{names},position")
    known = np.load(tmp_path / "a.npz")
    assert set(known) == {*names.split(","), "position"} and "Most time" in said
    pictures = {name: np.asarray(Image.open(tmp_path / f"a.{name}.png")) for name in ("depth", "normal", "part")}
    most = float(said.partition("depth, 65535 is ")[2].split()[0])
    np.testing.assert_allclose(pictures["depth"] * most / 65535, known["depth"][..., 0], atol=1e-3)
    np.testing.assert_array_equal(pictures["part"], known["part"][..., 0] + 1)
    there = known["alpha"][..., 0] > 0.5
    np.testing.assert_allclose(pictures["normal"][there] / 127.5 - 1, known["normal"][there], atol=0.005)
    assert "one .npz" in fail("render", model, "-o", tmp_path / "a.png", "--outputs", "position", code=2)
    alone = succeed("render", model, "-o", tmp_path / "b.png", "--size", 32, "--outputs", "depth")
    assert "b.depth.png" in alone and "wrote b.png" not in alone.replace(f"{tmp_path}/", "")
    assert not (tmp_path / "b.png").exists()


@pytest.mark.parametrize("up", ["y", "z"])
def test_render_is_lit_by_an_environment_and_exposed(model, tmp_path, up):
    above = np.zeros((16, 32, 3), np.float32)
    above[:4] = (0.0, 4.0, 0.0)
    rts.save_image(tmp_path / "sky.hdr", above)
    common = "render", model, "--size", 24, "--up", up, "--camera", "30,60", "--environment", tmp_path / "sky.hdr"
    succeed(*common, "-o", tmp_path / "a.hdr")
    image = rts.load_image(tmp_path / "a.hdr")
    assert image[..., 1].max() > 0.5 and image[..., 0].max() == 0
    succeed(*common, "-o", tmp_path / "a.png", "--exposure", "-3", "--shader", "pbr")
    assert 0 < rts.load_image(tmp_path / "a.png")[..., 1].max() < 0.3
    assert "--exposure is for a .png" in fail(*common, "-o", tmp_path / "a.hdr", "--exposure", "1", code=2)
    rts.save_image(tmp_path / "sky.hdr", above[:, :16])
    assert "16 wide and 16 high; expected a picture of all directions" in fail(*common, "-o", tmp_path / "a.hdr")


def test_render_casts_shadows(tmp_path):
    corners = [(x, y, z) for y, s in ((0, 1.0), (0.4, 0.3)) for x, z in ((-s, -s), (-s, s), (s, s), (s, -s))]
    lines = [*(f"v {x} {y} {z}" for x, y, z in corners), "f 1 2 3 4", "f 5 6 7 8"]
    (tmp_path / "card.obj").write_text("\n".join(lines))
    pictures = []
    for options in ((), ("--shadows",)):
        succeed("render", tmp_path / "card.obj", "-o", tmp_path / "a.hdr", "--size", 48, "--camera", "0,70", *options)
        pictures.append(rts.load_image(tmp_path / "a.hdr")[..., 0])
    darker = pictures[0] - pictures[1]
    assert darker.min() > -0.01 and 0.005 < (darker > 0.3).mean() < 0.05


@pytest.mark.parametrize("option", [["--shadows"], ["--environment", "sky.hdr"]])
def test_light_beside_a_shader_without_is_refused(model, option):
    told = fail("render", model, "-o", "a.png", "--shader", "silhouette", *option, code=2)
    assert f"{option[0]} sets the light, and the shader silhouette has none; try lambert or pbr" in told


def test_render_options_reach_the_picture(model, tmp_path):
    def picture(*options):
        succeed("render", model, "-o", tmp_path / "a.png", "--size", 32, *options)
        return rts.load_image(tmp_path / "a.png")

    plain = picture()
    single = "--shader", "silhouette", "--splatter", "single"
    assert np.abs(picture(*single, "--supersample", "4") - picture(*single)).max() > 0.1
    assert np.abs(picture("--camera=-60,20") - plain).max() > 0.1
    assert np.abs(picture("--up", "z") - plain).max() > 0.1
    assert picture("--camera", "30,20,20")[..., 3].sum() < plain[..., 3].sum() / 2
    assert picture("--fov", "60", "--camera", "30,20,4")[..., 3].sum() < picture("--camera", "30,20,4")[..., 3].sum()
    np.testing.assert_allclose(picture("--background", "#ff8000")[0, 0], [1, 0.2158605, 0, 1], atol=1e-5)
    # A camera amid the object sees the inside of its far walls, unless those are culled.
    amid = "--camera", "30,20,0.01"
    assert picture(*amid)[..., 3].mean() == 1
    assert picture(*amid, "--cull", "back")[..., 3].mean() == 0
    assert picture(*amid, "--cull", "file")[..., 3].mean() == 1  # An OBJ does not say.
    trimesh.load_mesh(model).export(tmp_path / "one_sided.glb")
    succeed("render", tmp_path / "one_sided.glb", "-o", tmp_path / "a.png", "--size", 32, *amid, "--cull", "file")
    assert rts.load_image(tmp_path / "a.png")[..., 3].mean() == 0


@pytest.mark.thorough
def test_a_clip_is_a_picture_or_an_animation(data, tmp_path):
    from PIL import Image

    common = "render", data / "gltf" / "AnimatedMorphCube.glb", "--size", 24, "--clip"
    for time in (0, 2):
        succeed(*common, "Square", "--time", time, "-o", tmp_path / f"{time}.png")
    first, later = (rts.load_image(tmp_path / f"{time}.png")[..., 3] for time in (0, 2))
    # One camera sees all of the clip; the cube gets thinner.
    assert 0 < later.sum() < 0.8 * first.sum()
    assert "84 frames" in succeed(*common, "0", "-o", tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as animation:
        assert animation.n_frames == 84
    assert "its index: 0 ('Square')" in fail(*common, "Circle", "-o", tmp_path / "a.png")
    assert "give --clip" in fail(*common[:-1], "-o", tmp_path / "a.gif", code=2)
    assert "--time is for a clip" in fail(*common[:-1], "--time", 1, "-o", tmp_path / "a.png", code=2)
    assert "--surface beside --clip" in fail(*common, 0, "--surface", "bezier", "-o", tmp_path / "a.png", code=2)


def test_the_depth_shader_covers_the_range_of_the_object(model, tmp_path):
    succeed("render", model, "-o", tmp_path / "a.png", "--shader", "depth", "--size", 64, "--splatter", "none")
    image = rts.load_image(tmp_path / "a.png")
    depth = image[image[..., 3] == 1][:, 0]
    assert 0.05 < depth.min() < 0.6 and depth.min() + 0.1 < depth.max() < 0.95


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--camera", "north"], "'north' is no camera"),
        (["--camera", "1"], "'1' is no camera"),
        (["--background", "blurple"], "'blurple' is no colour"),
        (["--layers", "two"], "Invalid value for '--layers'"),
        (["--colour"], "No such option"),
    ],
)
def test_wrong_usage_exits_with_2(model, options, expected):
    assert expected in fail("render", model, *options, code=2)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--camera", "0,91"], "elevation 91.0"),
        (["--camera", "0,0,-1"], "distance is -1.0"),
        (["--camera", "nan,0"], "azimuth is nan"),
        (["--camera", "0,nan"], "elevation nan"),
        (["--camera", "inf,0"], "azimuth is inf"),
        (["--camera", "0,0,nan"], "distance is nan"),
        (["--camera", "0,0,inf"], "distance is inf"),
        (["--camera", "0,0,1e300"], "distance is 1e+300, and the object's radius"),
        (["--camera", "0,0,1e-300"], "distance is 1e-300, and the object's radius"),
        (["--fov", "1e-300"], "give another distance, or a wider field of view"),
        (["--fov", "-3"], "fov is -3.0"),
        (["--fov", "nan"], "fov is nan"),
        (["--size", "0"], "'0' is no size; expected a number of pixels, or WIDTHxHEIGHT"),
        (["--size", "4x5x6"], "'4x5x6' is no size"),
        (["--size", "100000000"], "100000000 x 100000000 pixels"),
        (["--size", f"{10**40}"], "choose a smaller size"),
        (["--splatter", "multi", "--layers", f"{10**20}"], "choose a smaller size"),
        (["--supersample", f"{10**12}"], "choose a smaller size"),
        (["--supersample", "0"], "supersample is 0"),
        (["--supersample", "adaptive:4"], "Splatter 'edges', the default, finds outlines with 1"),
        (["--sampler", ""], "no sampler named ''"),
        (["--engine", "../numpy"], "no engine named '../numpy'"),
        (["--fov", "180"], "fov is 180.0"),
        (["--up", "x"], "up is 'x'"),
        (["--layers", "0"], "layers is 0"),
        (["--cull", "front"], "cull is 'front'"),
        (["--shader", "lambart"], "did you mean 'lambert'"),
        (["--shader", "textured"], "needs theta['texture']"),
        (["--sampler", "rastar"], "did you mean 'raster'"),
        (["--splatter", "malti"], "did you mean 'multi'"),
        (["--engine", "tensorflow"], "no engine named 'tensorflow'"),
        (["-o", "a.jpg"], "ending in .png"),
    ],
)
def test_wrong_values_exit_with_1(model, options, expected):
    assert expected in fail("render", model, "--size", 16, *options)


def test_unreadable_and_unwritable_files(model, tmp_path):
    assert "no file" in fail("render", tmp_path / "gone.obj")
    assert "is a folder" in fail("render", tmp_path)
    for name in ("m.obj", "m.ply", "m.stl", "m.glb", "m.gltf", "m.off", "m.3mf", "m.xyz", "m.dae", "m"):
        (tmp_path / name).write_bytes(b"")
        assert name in fail("render", tmp_path / name)
    assert "(File name too long)" in fail("render", f"{'a' * 999}.obj")
    assert "(File name too long)" in fail("render", model, "-o", f"{'a' * 999}.png")
    assert "ending in .png" in fail("render", model, "-o", "")


def test_a_file_that_cannot_be_written_in_the_end_is_one_line(model, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", full)
    said = fail("render", model, "--size", 8, "-o", tmp_path / "a.png")
    assert "a.png cannot be written (No space left on device)" in said


def test_a_lack_of_memory_is_one_line(model, tmp_path, monkeypatch):
    def large(*_, **__):
        raise MemoryError

    monkeypatch.setattr("rts.render", large)
    assert "not enough memory" in fail("render", model, "--size", 8, "-o", tmp_path / "a.png")


def test_names_that_cannot_be_written_are_refused_before_any_work(model, tmp_path, monkeypatch):
    def work(*_, **__):
        raise AssertionError

    readers, fits = ("rts.load", "rts.files.lit_models.load"), ("rts_cli.pose_fit.fit_pose", "rts_cli.demo.fit_pose")
    for name in ("rts.render", *readers, *fits):
        monkeypatch.setattr(name, work)
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.png").mkdir()
    for output, expected in {
        "a.jpg": "'a.jpg'; expected a name ending in .png",
        "folder.png": "folder.png is a folder",
        "file/a.png": "file is a file; expected a folder",
        "file/deeper/a.png": "file is a file; expected a folder",
    }.items():
        assert expected in fail("render", model, "-o", tmp_path / output)
    for command in (["fit-pose", model, model], ["demo"]):
        for output in ("file", "file/new"):
            assert "file is a file; expected a folder" in fail(*command, "-o", tmp_path / output)

    def refused(*_, **__):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("tempfile.TemporaryFile", refused)
    for command in (["render", model, "-o", tmp_path / "a.png"], ["fit-pose", model, model, "-o", tmp_path / "new"]):
        assert f"nothing can be written into {tmp_path} (Read-only file system)" in fail(*command)
    assert "(Read-only file system)" in fail("demo", "-o", tmp_path / "new" / "deeper")
    assert not (tmp_path / "new").exists()


# ---------------------------------------------------------------------------------------------------- pose


def test_fit_pose_finds_the_turn_of_a_rendered_target(model, tmp_path):
    pytest.importorskip("torch")
    mask = "--shader", "silhouette", "--splatter", "single", "--layers", 1
    succeed("render", model, "-o", tmp_path / "target.png", "--size", 96, "--camera", "42,14", *mask)
    output = succeed("fit-pose", model, tmp_path / "target.png", "-o", tmp_path / "found", "--engine", "torch")
    assert "pose.json" in output and "animation.gif" in output
    names = {p.name for p in (tmp_path / "found").iterdir()}
    assert {"pose.json", "before.png", "after.png", "target.png", "animation.gif"} <= names
    found = json.loads((tmp_path / "found" / "pose.json").read_text())
    assert found["loss"] < 2e-3 and found["iterations"] > 3 and found["seconds"] > 0
    bounds = bounds_of(rts.load(model))
    views = [orbit(bounds, (96, 96), *v).view for v in ((30, 20), (42, 14))]
    np.testing.assert_allclose(np.array(found["matrix"]), np.linalg.inv(views[0]) @ views[1], atol=0.03)
    rigid = rts.rigid(np.array(found["axis_angle"] + found["translation"]), found["center"])
    np.testing.assert_allclose(rigid, found["matrix"], atol=1e-6)
    with Image.open(tmp_path / "found" / "animation.gif") as file:
        assert file.n_frames > 3


def test_fit_pose_with_adam_lowers_the_loss(model, tmp_path):
    pytest.importorskip("torch")
    white_on_black = "--shader", "silhouette", "--background", "black"
    succeed("render", model, "-o", tmp_path / "t.png", "--size", 48, "--camera", "36,20", *white_on_black)
    arguments = model, tmp_path / "t.png", "-o", tmp_path / "o", "--method", "adam", "--steps", 30
    output = succeed("fit-pose", *arguments)
    before, after = (float(x) for x in re.search(r"loss (\S+) → (\S+) in 60 steps", output).groups())
    assert after < before / 4


def test_fit_pose_takes_a_robust_loss(model, tmp_path):
    pytest.importorskip("torch")
    mask = "--shader", "silhouette", "--splatter", "single", "--layers", 1
    succeed("render", model, "-o", tmp_path / "t.png", "--size", 48, "--camera", "40,20", *mask)
    target, parts = rts.load_image(tmp_path / "t.png")[..., 3], rts.load(model)
    dark = [part.replace(shader="silhouette") for part in parts]
    image = rts.render(dark, orbit(bounds_of(parts), (48, 48), 30, 20), (48, 48), splatter="single", layers=1)
    for loss in ("linear", "cauchy"):
        options = "--steps", 1, "--loss", loss, *(("--f-scale", 0.2) if loss == "cauchy" else ())
        result = run("fit-pose", model, tmp_path / "t.png", "-o", tmp_path / loss, *options)
        assert result.exit_code == 3, result.output  # After one step, the fit is poor.
        output = " ".join(result.output.split())
        expected = float(rts.Loss(loss, 0.2)(image[..., 3] - target))
        assert float(re.search(r"loss (\S+) → ", output).group(1)) == pytest.approx(expected, rel=5e-3)


def test_fit_pose_says_how_many_steps_it_made_where(model, tmp_path):
    pytest.importorskip("torch")
    succeed("render", model, "-o", tmp_path / "t.png", "--size", 48, "--shader", "silhouette")
    output = succeed("fit-pose", model, tmp_path / "t.png", "-o", tmp_path / "o", "--steps", 3, "--camera", "45,30")
    assert "in 6 steps, 3 + 3 from coarse and blurred pixels to fine, " in output
    assert "s (at the finest, all 3 steps made); wrote" in output


def test_fit_pose_says_which_extra_draws_the_plot(model, tmp_path, monkeypatch):
    pytest.importorskip("torch")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    succeed("render", model, "-o", tmp_path / "t.png", "--size", 32)
    output = succeed("fit-pose", model, tmp_path / "t.png", "-o", tmp_path / "o", "--steps", 1)
    assert "pip install 'rasterize-then-splat[plots]'" in output
    assert not (tmp_path / "o" / "convergence.png").exists()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--method", "newton"], "method is 'newton'"),
        (["--engine", "numpy"], "'numpy', which has no derivatives"),
        (["--engine", "torsh"], "did you mean 'torch'"),
        (["--loss", "square"], "loss is 'square'; expected one of linear, soft_l1, huber, cauchy"),
        (["--loss", "huber", "--f-scale", "0"], "f_scale is 0.0; expected a positive"),
    ],
)
def test_fit_pose_refuses(model, tmp_path, options, expected):
    succeed("render", model, "-o", tmp_path / "t.png", "--size", 32)
    assert expected in fail("fit-pose", model, tmp_path / "t.png", *options)


def test_fit_pose_takes_a_scale_with_a_robust_loss_alone(model):
    output = fail("fit-pose", model, "t.png", "--f-scale", "0.2", code=2)
    assert "--f-scale is for a robust --loss: soft_l1, huber or cauchy" in output


def bright(path):
    """A picture of a white square on black."""
    rts.save_image(path, np.pad(np.ones((8, 8)), 4))
    return path


def test_targets_without_a_silhouette_are_refused(model, tmp_path):
    rts.save_image(tmp_path / "t.png", np.zeros((8, 8)))
    assert "the target's silhouette lies between 0 and 0" in fail("fit-pose", model, tmp_path / "t.png")
    assert "no picture" in fail("fit-pose", model, tmp_path / "gone.png")
    assert "cannot be read as an image" in fail("fit-pose", model, model)
    (tmp_path / "empty.png").write_bytes(b"")
    assert "empty.png cannot be read as an image" in fail("fit-pose", model, tmp_path / "empty.png")
    assert "is a folder; expected a picture" in fail("fit-pose", model, tmp_path)
    for steps in (0, -1):
        assert f"steps is {steps}" in fail("fit-pose", model, bright(tmp_path / "b.png"), "--steps", steps)


def test_the_silhouette_is_the_alpha_or_else_the_brightness():
    image = np.zeros((2, 2, 4), np.float32)
    image[0, 0] = 0.7
    image[0, 1, 3] = 1
    np.testing.assert_allclose(pose.silhouette_of(image), [[0.7, 1], [0, 0]], rtol=1e-6)
    image[..., 3] = 1
    image[0, 0, :3] = decode_srgb(np.full(3, 0.7))  # A mask of 8 bits counts as it is written.
    np.testing.assert_allclose(pose.silhouette_of(image), [[0.7, 0], [0, 0]], rtol=1e-6)


def test_shrinking_is_a_box_filter():
    mask = np.arange(32, dtype=np.float32).reshape(4, 8)
    np.testing.assert_allclose(pose.shrunk(mask, 4), mask.reshape(2, 2, 4, 2).mean(axis=(1, 3)))
    assert pose.shrunk(mask, 100) is not None and pose.shrunk(mask, 100).shape == (4, 8)


def test_without_torch_and_jax_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(PluginError, match=r"pip install 'rasterize-then-splat\[torch\]'"):
        pose.available_engine()


# ---------------------------------------------------------------------------------------------------- demo


@pytest.mark.thorough
def test_demo_recovers_the_pose_and_writes_its_report(tmp_path):
    pytest.importorskip("torch")
    output = succeed("demo", "-o", tmp_path / "out", "--engine", "torch")
    for name in ("before.png", "after.png", "animation.gif", "pose.json", "summary.json", "summary.md"):
        assert (tmp_path / "out" / name).stat().st_size > 100
        assert name in output
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["rotation_error_degrees"]["start"] > 20
    assert summary["rotation_error_degrees"]["end"] < 0.5
    assert summary["translation_error_over_radius"]["end"] < 0.02
    assert "![after](after.png)" in (tmp_path / "out" / "summary.md").read_text()


def test_the_knot_is_closed_and_wound_outwards():
    part = demo.knot(rings=60, sides=8)
    solid = trimesh.Trimesh(part.theta["vertices"], part.surface.faces, process=False)
    assert solid.is_watertight and solid.volume > 0


# --------------------------------------------------------------------------------------------------- views


def test_orbit_looks_from_where_it_says():
    bounds = Bounds(np.array([1.0, 2.0, 3.0]), 1.0)

    def eye(*view, **options):
        return np.linalg.inv(orbit(bounds, (10, 10), *view, **options).view)[:3, 3] - bounds.center

    np.testing.assert_allclose(eye(0, 0, 5.0), [0, 0, 5], atol=1e-12)
    np.testing.assert_allclose(eye(90, 0, 5.0), [5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(eye(0, 90, 5.0), [0, 5, 0], atol=1e-12)
    np.testing.assert_allclose(eye(0, 0, 5.0, up="z"), [0, -5, 0], atol=1e-12)
    np.testing.assert_allclose(eye(90, -90, 5.0, up="z"), [0, 0, -5], atol=1e-12)


@pytest.mark.parametrize("size", [(100, 100), (50, 100), (100, 50)])
def test_the_default_distance_shows_the_whole_sphere(size):
    sphere = trimesh.creation.icosphere(subdivisions=3)
    part = rts.Part(rts.plugin("surfaces", "mesh")(sphere.faces), {"vertices": np.asarray(sphere.vertices)})
    pixels = orbit(bounds_of([part]), size, 30, 20).project(np.asarray(sphere.vertices), size)
    extent = np.abs(pixels[:, :2] - [size[1] / 2, size[0] / 2]).max(axis=0)
    assert min(size) / 2 * 0.9 < extent.max() < min(size) / 2


def test_bounds_follow_transforms_and_refuse_a_point():
    mesh = rts.plugin("surfaces", "mesh")([[0, 1, 2]])
    part = rts.Part(mesh, {"vertices": np.eye(3)}, transform=np.diag([2.0, 2, 2, 1]))
    np.testing.assert_allclose(bounds_of([part]).center, [1, 1, 1])
    with pytest.raises(InputError, match="in one point"):
        bounds_of([part.replace(theta={"vertices": np.zeros((3, 3))})])


# -------------------------------------------------------------------------------------- export, other surfaces


@pytest.fixture
def patches(tmp_path):
    """A cap of one Bézier patch, of about 0.7 in height."""
    t = np.linspace(-1, 1, 4)
    x, y = np.meshgrid(t, t, indexing="ij")
    points = np.stack([x, y, 1.2 - 0.6 * (x * x + y * y)], axis=-1).reshape(16, 3)
    # In files the directions are exchanged, for a normal outside.
    indices = np.arange(16).reshape(1, 4, 4).transpose(0, 2, 1).reshape(1, 16)
    path = tmp_path / "cap.npz"
    np.savez(path, indices=indices, points=points)
    return path


@pytest.mark.thorough
def test_a_surface_of_patches_is_rendered_and_exported(patches, tmp_path):
    (part,) = rts.load(patches, surface="bezier")
    said = succeed("render", patches, "--surface", "bezier", "-o", tmp_path / "cap.png", "--up", "z", "--size", 64)
    assert "Bezier(1 patches), 64 x 64 pixels" in said
    assert rts.load_image(tmp_path / "cap.png")[..., 3].mean() > 0.1
    for tolerance, least in ((0.05, 8), (0.001, 200)):
        out = tmp_path / "new" / "cap.obj"
        said = succeed("export", patches, "--surface", "bezier", "-o", out, "--tolerance", tolerance)
        (mesh,) = rts.load(out)
        assert mesh.surface.face_count >= least
        assert f"{mesh.surface.face_count} triangles; wrote {out}" in said
        radius = bounds_of([part]).radius
        places = mesh.theta["vertices"][mesh.surface.faces].mean(axis=1)
        # The graph over x and y: its points are no farther off along z than along the normal, times its slope.
        fine = part.surface.tessellate(part.theta, 128)[0]
        from scipy.spatial import cKDTree

        height = fine[cKDTree(fine[:, :2]).query(places[:, :2])[1], 2]
        assert np.abs(places[:, 2] - height).max() < 2.5 * tolerance * radius + 0.02


@pytest.mark.parametrize("extension", ["obj", "ply", "stl", "glb", "off"])
def test_a_mesh_is_exported_as_it_is(model, tmp_path, extension):
    out = tmp_path / f"same.{extension}"
    said = succeed("export", model, "-o", out)
    (before,), (after,) = rts.load(model), rts.load(out)
    assert "8 vertices and 12 triangles" in said
    corners = [np.sort(p.theta["vertices"][p.surface.faces].reshape(12, -1), axis=0) for p in (before, after)]
    np.testing.assert_allclose(corners[1], corners[0], atol=1e-6)


def test_a_scene_is_exported_in_its_coordinates_with_mirrored_parts_outside_out(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((1, 1, 1)), transform=np.diag([1.0, 1, -1, 1]) + np.eye(4, k=3) * 2)
    scene.add_geometry(trimesh.creation.icosphere(1), transform=np.diag([0.5, 0.5, 0.5, 1]))
    scene.export(tmp_path / "scene.glb")
    succeed("export", tmp_path / "scene.glb", "-o", tmp_path / "one.ply")
    whole = trimesh.load(tmp_path / "one.ply")
    volumes = sorted(m.volume for m in whole.split())
    sphere = trimesh.creation.icosphere(1).volume / 8
    np.testing.assert_allclose(volumes, sorted([1.0, sphere]), rtol=1e-5)


def test_what_cannot_be_exported_is_one_line(model, patches, tmp_path):
    assert "ending in .obj, .ply, .stl, .glb or .off" in fail("export", model, "-o", tmp_path / "mesh.docx")
    assert "no surface named 'bezzier'" in fail("export", patches, "--surface", "bezzier", "-o", tmp_path / "m.obj")
    assert "BSpline reads no files" in fail("render", patches, "--surface", "bspline", "-o", tmp_path / "m.png")
    for tolerance in ("0", "-1", "nan"):
        assert "tolerance" in fail("export", model, "-o", tmp_path / "m.obj", "--tolerance", tolerance, code=2)
