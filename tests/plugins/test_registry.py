"""Plugins by name: what is found, what is loaded, and what the errors say."""

import importlib
import json
import operator
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import rts
from rts import registry
from rts.capabilities import BASES
from rts_cli.main import app

pytestmark = pytest.mark.core

Mesh = rts.plugin("surfaces", "mesh")

HEAVY = set("torch jax numba embreex moderngl trimesh scipy PIL matplotlib optax imageio_ffmpeg".split())

RIVAL = "class Rival: pass"


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install a small distribution in a folder of its own, uninstalled after the test."""
    monkeypatch.setattr(registry, "_entry_points", {})
    monkeypatch.setattr(registry, "_defaults", {})
    modules_before = set(sys.modules)

    def call(name, entry_points, modules, extras=(), version="1.2"):
        root = tmp_path / name
        info = root / f"{name}-{version}.dist-info"
        info.mkdir(parents=True)
        provides = "".join(f"Provides-Extra: {extra}\n" for extra in extras)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n{provides}")
        groups = "".join(
            f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in entries.items())
            for group, entries in entry_points.items()
        )
        (info / "entry_points.txt").write_text(groups)
        for module, source in modules.items():
            (root / f"{module}.py").write_text(source)
        monkeypatch.syspath_prepend(str(root))

    yield call
    for module in set(sys.modules) - modules_before:
        if str(tmp_path) in str(getattr(sys.modules[module], "__file__", "")):
            del sys.modules[module]


def modules_after(code):
    """Names of the modules that a fresh interpreter has loaded after some code."""
    script = f"import json, sys\n{code}\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout))


# ------------------------------------------------------------------------------------------- what is found


@pytest.mark.parametrize(
    "group, names",
    [
        ("rts.engines", ("jax", "numpy", "torch")),
        ("rts.surfaces", ("mesh",)),
        ("rts.samplers", ("raster", "reference")),
        ("rts.shaders", ("blinn_phong", "depth", "lambert", "normals", "pbr", "silhouette", "textured", "unlit")),
        ("rts.splatters", ("edges", "multi", "none", "single")),
    ],
)
def test_built_in_plugins_are_registered_and_listed_in_order(group, names):
    found = rts.plugins(group)
    assert set(names) <= set(found)
    assert found == sorted(found)
    assert rts.plugins(group.removeprefix("rts.")) == found


def test_a_name_or_a_class_gives_one_shared_instance_an_object_itself():
    from rts.splatting import Multi

    assert rts.plugin("rts.splatters", "multi") is rts.plugin("splatters", "multi") is Multi
    shared = registry.instance("rts.splatters", "multi")
    assert isinstance(shared, Multi) and registry.instance("rts.splatters", "multi") is shared
    made = registry.instance("rts.splatters", Multi)
    assert made is shared
    ready = Multi(sigma=0.4)
    assert registry.instance("rts.splatters", ready) is ready


def test_a_plugin_of_another_distribution_is_used_by_its_name(install):
    source = (
        "import rts\n"
        "class White(rts.Splatter):\n"
        "    def image(self, splats):\n"
        "        return 0 * splats.row[0][..., None] + splats.rgba[:1] * 0 + 0.25\n"
    )
    install("flat", {"rts.splatters": {"flat": "flat_plugin:White"}}, {"flat_plugin": source})
    vertices = np.array([(-1, -1, 0), (1, -1, 0), (0, 1, 0)], np.float32)
    mesh = rts.plugin("surfaces", "mesh")([(0, 1, 2)])
    camera = rts.Camera.look_at((0, 0, 3), (0, 0, 0))
    image = rts.render(rts.Part(mesh, {"vertices": vertices}), camera, (4, 5), splatter="flat")
    np.testing.assert_array_equal(image, np.full((4, 5, 4), 0.25))


def test_a_distribution_installed_after_the_first_look_is_found(install):
    assert "late" not in rts.plugins("splatters")
    install("late", {"rts.splatters": {"late": "late_plugin:Late"}}, {"late_plugin": "class Late: pass"})
    assert rts.plugin("splatters", "late").__name__ == "Late"
    assert "late" in rts.plugins("splatters")


def test_a_survey_names_the_distribution_and_why_a_plugin_does_not_load(install):
    install(
        "mixed",
        {"rts.splatters": {"good": "mixed_good:Good", "bad": "mixed_bad:Bad"}},
        {"mixed_good": "import rts\nclass Good(rts.Splatter): pass", "mixed_bad": "raise RuntimeError('no display')"},
        version="3.4",
    )
    lines = {info.name: info for info in registry.survey() if info.group == "rts.splatters"}
    assert lines["good"].error is None and lines["good"].distribution == "mixed 3.4"
    assert "no display" in lines["bad"].error
    assert lines["multi"].error is None and lines["multi"].distribution.startswith("rasterize-then-splat ")


def test_details_say_what_each_plugin_can_do():
    found = {(i.group, i.name): i for g in registry.GROUPS for i in rts.plugins(g, details=True)}
    assert [i.name for i in rts.plugins("samplers", details=True)] == rts.plugins("samplers")

    def able(group, name):
        return found[f"rts.{group}", name].capabilities

    assert able("surfaces", "mesh")["triangles"] and not able("surfaces", "mesh")["rays"]
    assert able("surfaces", "sdf")["rays"] and not able("surfaces", "sdf")["triangles"]
    assert able("splatters", "single")["layers"] == 1 and able("splatters", "multi")["layers"] is None
    assert able("samplers", "raster")["concurrent"] and not able("samplers", "rays")["concurrent"]
    assert able("splatters", "edges")["reads"] == {"outlines"} and not able("splatters", "multi")["reads"]
    assert able("splatters", "edges")["sums"] and not able("splatters", "none")["sums"]
    assert able("engines", "numpy") == {"differentiates": False}
    assert able("shaders", "silhouette")["uniform"] and able("shaders", "textured")["reads"] is not None
    assert found["rts.surfaces", "mesh"].ready and found["rts.surfaces", "mesh"].missing == ()


def test_a_splatter_looks_at_no_more_layers_than_it_says():
    rng = np.random.default_rng(2)
    row = np.arange(2 * 5 * 6, dtype=np.int32).reshape(2, 5, 6)
    y, x = np.indices((5, 6)) + 0.5
    depth = np.cumsum(rng.uniform(1, 3, (2, 5, 6)), axis=0)
    positions = np.stack([*np.broadcast_arrays(x, y, depth)], axis=-1).reshape(-1, 3)
    rgba = rng.uniform(0.1, 0.5, (60, 4))
    for info in (info for info in rts.plugins("splatters", details=True) if info.name != "visible"):  # It warns.
        splatter = rts.plugin("splatters", info.name)()
        one, two = splatter.splat(positions[:30], rgba[:30], row[:1]), splatter.splat(positions, rgba, row)
        assert np.array_equal(one, two) == (info.capabilities["layers"] == 1), info.name


def test_details_say_which_extra_is_missing(install, tmp_path):
    source = (
        "import rts\nclass Odd(rts.Splatter):\n    def image(self, splats): ...\nclass Other:\n    image = Odd.image\n"
    )
    entries = {"odd": "mine_odd:Odd", "even": "mine_gone:Even", "other": "mine_odd:Other"}
    install("mine", {"rts.splatters": entries}, {"mine_odd": source}, ["odd"])
    metadata = next((tmp_path / "mine").glob("*.dist-info")) / "METADATA"
    needs = "Requires-Dist: numpy; extra == 'odd'\nRequires-Dist: qqq-there.is-none>=3; extra == \"odd\"\n"
    metadata.write_text(metadata.read_text() + needs)
    found = {info.name: info for info in rts.plugins("splatters", details=True)}
    assert found["odd"].ready and found["odd"].missing == ("qqq-there.is-none",) and found["odd"].install == "mine[odd]"
    assert found["odd"].capabilities["reach"] == 1 and not found["odd"].capabilities["prunes"]
    assert not found["even"].ready and found["even"].install is None and found["even"].capabilities == {}
    assert found["other"].error.endswith("which is registered in rts.splatters, does not subclass rts.Splatter")
    with pytest.raises(rts.InputError, match="the splatter is .*Other.*whose class subclasses rts.Splatter"):
        rts.render(rts.Mesh.example(), rts.Camera.look_at((0, 0, 3), (0, 0, 0)), (4, 4), splatter="other")


# ---------------------------------------------------------------------------------- surfaces as attributes


def test_surfaces_and_functions_of_the_library_are_attributes_of_it():
    root = Path(__file__).resolve().parents[2]
    entries = tomllib.loads((root / "pyproject.toml").read_text())["project"]["entry-points"]
    expected = {
        path.partition(":")[2]: (group, name)
        for group in ("rts.surfaces", "rts.functions")
        for name, path in entries[group].items()
    }
    assert registry.built_in_attributes() == expected
    assert set(registry.built_in_attributes()) <= set(dir(rts)) and "render" in dir(rts)
    assert rts.Mesh is rts.plugin("surfaces", "mesh") and rts.Sdf is rts.plugin("surfaces", "sdf")
    assert rts.tune is rts.plugin("functions", "tune")


def test_an_attribute_that_is_not_there_is_an_attribute_error_with_a_hint(install):
    for name, hint in {"Mash": "did you mean 'Mesh'", "rendr": "did you mean 'render'", "Heightfield": ""}.items():
        with pytest.raises(AttributeError, match=f"^module 'rts' has no attribute '{name}'.*{hint}"):
            getattr(rts, name)
    assert not hasattr(rts, "qqq") and not hasattr(rts, "Toy")


def test_names_of_earlier_versions_tell_what_there_is_instead():
    with pytest.raises(AttributeError, match="^rts.transforms is gone: rts.Camera.look_at, .perspective"):
        rts.transforms  # noqa: B018
    with pytest.raises(ImportError, match="^rts.transforms is gone: rts.Camera.look_at, .perspective"):
        importlib.import_module("rts.transforms")
    for name, instead in rts._GONE.items():
        assert not hasattr(rts, name)
        for path in re.findall(r"rts\.([\w.]*\w)", instead):
            assert operator.attrgetter(path)(rts) is not None


def test_a_surface_that_cannot_be_loaded_is_an_attribute_error_too(monkeypatch):
    def broken(*_):
        raise rts.errors.PluginError("no compiler")

    monkeypatch.delitem(vars(rts), "Bezier", raising=False)
    monkeypatch.setattr(registry, "plugin", broken)
    with pytest.raises(AttributeError, match="^rts.Bezier cannot be loaded: no compiler"):
        rts.Bezier  # noqa: B018


def test_a_name_that_an_older_installation_lacks_is_refused_by_name():
    with pytest.raises(rts.errors.PluginError, match="^rts.testing has no entry point 'Nobody'; install rasterize-"):
        registry.load_own("rts.testing", "Nobody")


def test_surfaces_and_entry_points_are_left_alone_until_an_attribute_asks_for_them():
    loaded = modules_after("import rts\nassert not rts.registry._entry_points\nassert not hasattr(rts, 'regulrizers')")
    assert not {m for m in loaded if m.startswith("rts_surfaces")}
    loaded = modules_after("import rts\nassert rts.registry._entry_points == {}\nrts.Mesh")
    expected = {"rts_surfaces.parameter_checks", "rts_surfaces.mesh", "rts_surfaces.smooth_normals"}
    assert {m for m in loaded if m.startswith("rts_surfaces.")} == expected


# ------------------------------------------------------------------------------------------ what is loaded


def test_importing_the_library_loads_no_framework_and_no_plugin():
    loaded = modules_after("import rts")
    assert not loaded & set(HEAVY) and not {name for name in loaded if name.startswith("rts_")}
    assert "rts.rendering" in loaded


def test_only_the_plugin_asked_for_is_imported():
    loaded = modules_after("import rts; rts.plugin('samplers', 'reference'); rts.plugin('surfaces', 'mesh')")
    assert {"rts_backends.reference", "rts_surfaces.mesh"} <= loaded
    assert {m for m in loaded if m.startswith(("rts_backends.", "rts_surfaces."))} == {
        "rts_backends.reference",
        "rts_surfaces.parameter_checks",
        "rts_surfaces.mesh",
        "rts_surfaces.smooth_normals",
    }
    assert not loaded & HEAVY


def test_listing_names_imports_no_plugin():
    loaded = modules_after("import rts; [rts.plugins(g) for g in rts.registry.GROUPS]")
    assert not {name for name in loaded if name.startswith("rts_")}


def test_the_help_names_installed_commands_and_imports_none():
    code = (
        "from rts_cli.main import app\n"
        "try:\n    app(['--help'], prog_name='rts')\n"
        "except SystemExit as end:\n    print('ended with', end.code)\n"
        "print('loaded', *(name for name in sys.modules if name.startswith('rts_') and 'rts_cli' not in name))"
    )
    done = subprocess.run([sys.executable, "-c", f"import sys\n{code}"], capture_output=True, text=True, check=True)
    *_, ended, loaded = done.stdout.splitlines()
    assert ended == "ended with 0" and loaded == "loaded"
    for name in rts.plugins("rts.commands"):
        assert f" {name} " in done.stdout
    assert f"Of rasterize-then-splat {rts.__version__}: rts tune --help tells more" in done.stdout


def test_rendering_numpy_arrays_loads_neither_torch_nor_jax():
    loaded = modules_after(
        "import numpy as np, rts\n"
        "mesh = rts.plugin('surfaces', 'mesh')([(0, 1, 2)])\n"
        "part = rts.Part(mesh, {'vertices': np.array([(-1, -1, 0), (1, -1, 0), (0, 1, 0)], np.float32)})\n"
        "camera = rts.Camera.look_at((0, 0, 3), (0, 0, 0))\n"
        "image = rts.render(part, camera, (4, 5), sampler='reference', splatter='none')\n"
        "assert image[2, 2, 3] == 1"
    )
    assert not loaded & (HEAVY - {"numba", "scipy"})  # The one packs the samples, and loads the other.


# -------------------------------------------------------------------------------------- what errors say


def one_line(error):
    message = str(error.value)
    assert "\n" not in message
    return message


def test_a_plugin_whose_options_lack_defaults_is_refused_by_its_name():
    class Foggy(rts.Shader):
        def __init__(self, thickness):
            self.thickness = thickness

    with pytest.raises(
        rts.errors.PluginError, match=r"the shader .*Foggy cannot be made without arguments \(missing .*'thickness'\)"
    ):
        registry.instance("shaders", Foggy)


@pytest.mark.parametrize(
    ("call", "words", "hint"),
    [
        (lambda: rts.plugin("rts.samplers", "rastr"), ("no sampler named 'rastr'", "reference"), "'raster'?"),
        (lambda: rts.plugin("rts.samplers", "qqqqqq"), ("raster", "is its distribution installed"), None),
        (lambda: rts.plugins("sampler"), ("no plugin group 'sampler'", "rts.splatters"), "'rts.samplers'?"),
    ],
)
def test_a_name_that_there_is_not_lists_the_names_and_suggests_one_like_it(call, words, hint):
    with pytest.raises(rts.InputError) as error:
        call()
    message = one_line(error)
    assert all(word in message for word in words)
    assert f"did you mean {hint}" in message if hint else "did you mean" not in message


def test_a_misspelt_shader_is_refused_where_the_part_is_made_and_nothing_is_imported():
    loaded = modules_after("import rts; rts.Part(None, {}, 'lambert').replace(shader='radiance')")
    assert not {m for m in loaded if m.startswith(("rts_backends", "rts_surfaces"))} and not loaded & HEAVY
    part = rts.Part(None, {}, "lambert")
    for make in lambda: rts.Part(None, {}, "lamber"), lambda: part.replace(shader="lamber"):
        with pytest.raises(rts.InputError) as error:
            make()
        assert "no shader named 'lamber'; there are blinn_phong, " in one_line(error)
        assert "did you mean 'lambert'?" in one_line(error)


def test_a_name_claimed_by_two_distributions_is_refused_naming_both(install):
    for name in ("first", "second"):
        install(name, {"rts.splatters": {"same": f"{name}_plugin:Same"}}, {f"{name}_plugin": "class Same: pass"})
    with pytest.raises(rts.errors.PluginError) as error:
        rts.plugin("splatters", "same")
    assert "'same' is claimed by first 1.2 and second 1.2" in one_line(error)
    assert rts.plugin("splatters", "multi").__name__ == "Multi"


@pytest.mark.parametrize(("group", "name"), [("splatters", "multi"), ("engines", "numpy"), ("surfaces", "mesh")])
def test_a_claim_of_another_distribution_on_a_name_of_ours_is_passed_over(install, group, name):
    own = rts.plugin(group, name)
    install(
        "rival", {f"rts.{group}": {name: "rival_plugin:Rival", "rival": "rival_plugin:Rival"}}, {"rival_plugin": RIVAL}
    )
    registry._entry_points.clear()
    with pytest.warns(
        rts.errors.RtsWarning, match=f"'{name}' is the library's; the claim of rival 1.2 is passed over"
    ) as told:
        assert rts.plugin(group, name) is own
    assert registry.attribute("Mesh", rts.__all__) is Mesh  # Of the surfaces, and with NumPy arrays.
    assert rts.plugin(group, "rival").__name__ == "Rival"
    assert len(told) == 1


@pytest.mark.parametrize(
    "damage",
    [
        {"entry_points.txt": bytes(range(256))},
        {"entry_points.txt": b"[rts.samplers]\nno entry\n"},
        {"METADATA": b"\xff"},
    ],
    ids=["binary", "a line without =", "binary metadata"],
)
def test_a_broken_distribution_is_told_in_a_line_and_passed_over(install, tmp_path, damage):
    install("broken", {"rts.samplers": {"beams": "broken_plugin:Beams"}}, {"broken_plugin": "class Beams: pass"})
    install("whole", {"rts.samplers": {"strips": "whole_plugin:Strips"}}, {"whole_plugin": "class Strips: pass"})
    for name, data in damage.items():
        (tmp_path / "broken/broken-1.2.dist-info" / name).write_bytes(data)
    with pytest.warns(rts.errors.RtsWarning) as told:
        assert {"raster", "strips"} < set(rts.plugins("samplers"))
    for group in registry.GROUPS:  # It is told once.
        rts.plugins(group)
    (line,) = (str(x.message) for x in told)
    assert "broken" in line and str(tmp_path / "broken") in line and "passed over; reinstall it" in line
    assert "\n" not in line and "beams" not in rts.plugins("samplers")


def test_of_two_versions_in_the_path_the_first_counts(install):
    for version, source in (("1.0", "class Old: pass"), ("2.0", "class New: pass")):  # The newer one comes first.
        name = source.split()[1].strip(":")
        install(
            "Same_Name" if name == "Old" else "same_name",
            {"rts.shaders": {"s": f"v_{name}:{name}"}},
            {f"v_{name}": source},
            version=version,
        )
    assert rts.plugin("shaders", "s").__name__ == "New"


@pytest.mark.parametrize("extras", [("beams",), ()], ids=["an extra", "none"])
def test_a_missing_package_names_the_pip_command_of_its_extra_or_else_the_distribution(install, extras):
    source = {"needy_plugin": "import a_package_that_is_absent"}
    install("needy", {"rts.samplers": {"beams": "needy_plugin:Rays"}}, source, extras)
    with pytest.raises(rts.errors.PluginError) as error:
        rts.plugin("samplers", "beams")
    message = one_line(error)
    assert "'a_package_that_is_absent'" in message and isinstance(error.value.__cause__, ModuleNotFoundError)
    assert ("pip install 'needy[beams]'" if extras else "needy 1.2") in message
    assert ("pip install" in message) == bool(extras)


@pytest.mark.parametrize(
    "source, words",
    [
        ("raise RuntimeError('driver too old')", ("RuntimeError", "driver too old")),
        ("raise ImportError('libGL.so.1: cannot open shared object file')", ("ImportError", "libGL.so.1")),
        ("def broken(:", ("SyntaxError",)),
        ("class Other: pass", ("AttributeError", "Broken")),
        ("raise SystemExit(3)", ("SystemExit: 3",)),
        ("class Panic(BaseException): pass\nraise Panic('a line\\nand another')", ("Panic: a line and another",)),
    ],
    ids=["raises", "import error", "syntax", "no such attribute", "exit", "panic"],
)
def test_any_other_failure_to_import_shows_its_cause(install, source, words):
    install("faulty", {"rts.samplers": {"broken": "faulty_plugin:Broken"}}, {"faulty_plugin": source})
    with pytest.raises(rts.errors.PluginError) as error:
        rts.plugin("samplers", "broken")
    message = str(error.value)
    for word in ("'broken'", "faulty 1.2", "fails to import", *words):
        assert word in message
    assert error.value.__cause__ is not None


def test_a_plugin_that_explains_itself_is_heard(install):
    source = "from rts.errors import PluginError\nraise PluginError('install libosd-dev, then reinstall')"
    install("polite", {"rts.surfaces": {"polite": "polite_plugin:Polite"}}, {"polite_plugin": source})
    with pytest.raises(rts.errors.PluginError) as error:
        rts.plugin("surfaces", "polite")
    assert one_line(error) == "install libosd-dev, then reinstall"


@pytest.mark.parametrize(
    "source, why",
    [
        ("raise RuntimeError('no display')", "fails to import: RuntimeError: no display"),
        ("import a_package_that_is_absent", "needs the module 'a_package_that_is_absent'"),
        ("draw = 3", "is neither a function of options nor"),
        ("raise SystemExit(3)", "fails to import: SystemExit: 3"),
    ],
)
def test_a_command_that_cannot_be_used_says_why_in_a_line_and_the_others_work(install, source, why):
    install("faulty", {"rts.commands": {"draw": "faulty_command:draw"}}, {"faulty_command": source})
    runner = CliRunner()
    listed = runner.invoke(app, ["--help"])
    assert listed.exit_code == 0 and "draw" in listed.output and "compare" in listed.output
    assert "faulty_command" not in sys.modules
    done = runner.invoke(app, ["draw", "picture.png", "--fast"])
    assert done.exit_code == 1 and why in done.output and done.output.count("\n") == 1
    assert runner.invoke(app, ["plugins"]).exit_code == 0


def test_an_interrupt_is_no_failure_to_import(install):
    install("slow", {"rts.samplers": {"slow": "slow_plugin:Slow"}}, {"slow_plugin": "raise KeyboardInterrupt"})
    with pytest.raises(KeyboardInterrupt):
        rts.plugin("samplers", "slow")


def test_a_command_tells_its_own_help():
    assert "cheapest" in CliRunner().invoke(app, ["tune", "--help"]).output


@pytest.mark.parametrize("group", BASES)
def test_what_the_library_registers_are_classes_of_which_one_object_serves_a_name(group):
    for name in rts.plugins(group):
        try:
            found = rts.plugin(group, name)
        except rts.errors.PluginError:  # An optional package is missing.
            continue
        if found.__module__.partition(".")[0] in ("rts", "rts_backends", "rts_surfaces"):
            assert isinstance(found, type)
        if group not in ("rts.surfaces", "rts.engines"):
            assert registry.instance(group, name) is registry.instance(group, name)
            assert isinstance(registry.instance(group, name), found)
