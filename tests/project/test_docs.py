"""The code in README and docs runs, and does what the text beside it says."""

import re
import shlex
import subprocess
import tomllib
import warnings
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree
from sybil import Sybil
from sybil.parsers.markdown import PythonCodeBlockParser
from typer.testing import CliRunner

import rts
from rts import registry
from rts_cli.demo import knot
from rts_cli.main import app

pytestmark = pytest.mark.docs

ROOT = Path(__file__).resolve().parents[2]
PAGES = ["README.md", *(str(p.relative_to(ROOT)) for p in sorted((ROOT / "docs").rglob("*.md"))), "CONTRIBUTING.md"]
COMING_FROM = [page for page in PAGES if page.startswith("docs/coming-from/")]
ELSEWHERE = {
    "rts demo": "make wheel",
    "rts view model.obj": "make apps",
    "rts plugins --matrix": "test_compatibility.py",
    "rts compare model.obj --quick -o out/compare": "make wheel",
    "rts tune model.obj --tolerance 0.1 --mode translation": "make wheel",
    "rts render model.glb --shader pbr --environment room.hdr --exposure 0.5 --background white -o picture.png": (
        "test_cli.py"
    ),
    "rts render scene.glb --camera file -o scene.png": "test_own_light_and_view.py",
    "rts render scene.glb --camera file --exposure -2 -o scene.png": "test_own_light_and_view.py",
    "rts render man.glb --clip walk --time 0.4 -o man.png": "test_cli.py",
    "rts render man.glb --clip 0 -o man.gif": "test_cli.py",
    "rts reconstruct photos/ -o out/thing --quick": "make apps",
    "rts cameras photos/ -o thing": "make apps",
    "rts calibrate panda.urdf --masks masks/ --joints joints.json --fov 45 -o out/camera": "make apps",
    "rts reconstruct photos/ -o out/thing --region=-0.94,0.08,5.1,3.5": "make apps",
    "rts reconstruct photos/ -o out/thing --masks out/thing/masks": "make apps",
}
"""Commands that take long, or need files of their own, and who runs them."""


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL)


@pytest.fixture
def model(tmp_path, monkeypatch):
    """An empty folder to work in, with a model of which no view is symmetric."""
    part = knot(rings=90, sides=10)
    rows = [f"v {x} {y} {z}" for x, y, z in 0.45 * part.theta["vertices"]]
    rows += [f"f {a} {b} {c}" for a, b, c in part.surface.faces + 1]
    (tmp_path / "model.obj").write_text("\n".join(rows))
    monkeypatch.chdir(tmp_path)


def run(page, **names):
    """Run a page's Python, block after block: the names there are in the end, and what each name first was."""
    document, first = Sybil([PythonCodeBlockParser()]).parse(ROOT / page), {}
    document.namespace.update(names)
    for example in document.examples():
        example.evaluate()
        first = document.namespace | first
    return document.namespace, first


GUIDES = [page for page in PAGES if page.startswith(("docs/guides/", "docs/start/")) and "many_views" not in page]


@pytest.mark.thorough
@pytest.mark.parametrize("page", [page for page in GUIDES if blocks(page, "python")])
def test_the_python_of_a_guide_runs(page, tmp_path, monkeypatch):
    pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    names, _ = run(page)
    for path in tmp_path.glob("*.png"):
        assert np.ptp(rts.load_image(path)) > 0.1, path.name
    if page.endswith("first_gradient.md"):
        assert names["radii"].grad.min() > 0
        np.testing.assert_allclose(names["fit"].parameters, names["truth"], atol=0.01)
    if page.endswith("guides/gradients.md"):
        assert {reason.kind for reason in names["check"].reasons} == {"constant"}
        assert str(names["check"]).splitlines()[1] in "".join(blocks(page, "text"))


@pytest.mark.thorough
def test_the_python_of_the_readme_does_what_it_says(model):
    pytest.importorskip("torch")
    found, _ = run("README.md")
    drawn = rts.load_image("view.png")[..., 3]
    assert 0.02 < drawn.mean() < 0.5 and drawn[[0, -1]].max() == drawn[:, [0, -1]].max() == 0
    assert found["vertices"].grad.abs().max() > 0
    assert found["fit"].loss < 1e-5 and found["fit"].parameters.abs().max() < 5e-3  # From 0.1.


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().split()) <= 900
    [code] = blocks("README.md", "python")
    assert len([line for line in code.splitlines() if line.strip()]) <= 22


GUIDE = {
    "loft": "third_plugin/rts_third_plugin/loft.py",
    "ring": "third_plugin/rts_third_plugin/ring.py",
    "caster": "third_plugin/rts_third_plugin/caster.py",
    "toon": "third_plugin/rts_third_plugin/toon.py",
    "gauss5": "second_plugin/gauss5.py",
}
"""Plugins that the guide shows; the conformance kit tests these files."""


@pytest.mark.parametrize("name", GUIDE)
def test_the_guide_shows_plugins_that_are_tested(name):
    assert (ROOT / "tests" / GUIDE[name]).read_text() in blocks("docs/plugins.md", "python")


def test_the_python_of_the_guide_to_plugins_does_what_it_says(tmp_path, monkeypatch):
    torch = pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(ROOT / "tests/third_plugin")
    entry = EntryPoint("loft", "rts_third_plugin.loft:Loft", "rts.surfaces")
    surfaces = {**registry._entries("rts.surfaces"), "loft": [entry]}
    monkeypatch.setitem(registry._entry_points, "rts.surfaces", surfaces)
    names, _ = run("docs/plugins.md")
    assert issubclass(names["TestLoft"], rts.testing.SurfaceConformance)
    # The first picture shows the loft, and its gradient is that of the covered area.
    assert 0.02 < rts.load_image("loft.png")[..., 3].mean() < 0.5
    part, camera, step = names["part"], names["camera"], 0.02

    def area(scale):
        theta = {"curves": scale * part.theta["curves"]}
        return rts.render(part.replace(theta=theta), camera, (256, 256), supersample=4)[..., 3].mean()

    slope = (names["curves"].grad * names["curves"].detach()).sum()
    assert float(slope) == pytest.approx((area(1 + step) - area(1 - step)) / (2 * step), rel=0.1)
    # The sampler sees what others see, and the splatter has the derivative of a ramp that moves.
    images = [rts.render(part, camera, (64, 64), sampler=s) for s in (names["Caster"](), "reference")]
    np.testing.assert_allclose(*images, atol=1e-4)
    y, x = np.indices((12, 12))
    positions = torch.tensor(np.stack([x + 0.5, y + 0.5, np.ones_like(x)], -1).reshape(-1, 3), dtype=torch.float64)
    row = torch.arange(144, dtype=torch.int32).reshape(1, 12, 12)
    ramp = torch.tensor((x / 12.0).reshape(-1, 1)).expand(-1, 4)
    along = torch.zeros_like(positions)
    along[:, 0] = 1
    splat = names["Gauss5"]().splat
    image, slope = torch.func.jvp(lambda p: splat(p, ramp, row), (positions,), (along,))
    np.testing.assert_allclose(image[4:-4, 4:-4, 3], x[4:-4, 4:-4] / 12, atol=1e-6)
    np.testing.assert_allclose(slope[4:-4, 4:-4, 3], -1 / 12, rtol=1e-2)


@pytest.mark.thorough
def test_the_python_of_the_guide_to_many_views_does_what_it_says(tmp_path, monkeypatch):
    pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    names, first = run("docs/guides/many_views.md")
    shape, cameras = first["fit"], names["fit"]
    assert shape.loss < 0.3 * shape.validated[0][1] and (tmp_path / "fit.npz").is_file()
    assert [step for step, _ in shape.validated] == [0, 10, 20, 30, 40, 50, 59]
    away = [KDTree(v).query(names["truth"])[0].mean() for v in (names["start"], names["vertices"].numpy())]
    assert away[1] < 0.6 * away[0]
    np.testing.assert_allclose(cameras.parameters["gain"], 1, atol=0.02)
    assert cameras.loss < 0.3 * cameras.history[0]


def shifted_loss(image, target, part, camera, pose, step):
    """The loss of a pose shifted along x, area-sampled."""
    shifted = part.replace(transform=np.asarray(rts.rigid(np.array([*pose[:3], pose[3] + step, *pose[4:]]))))
    return float(((rts.render(shifted, camera, image.shape[:2], supersample=8)[..., 3] - target) ** 2).mean())


def test_pages_for_users_of_others_show_one_task_and_its_gradient(model):
    torch = pytest.importorskip("torch")
    assert len(COMING_FROM) == 4
    [_] = {tuple(blocks(page, "python")) for page in COMING_FROM}
    found, _ = run(COMING_FROM[0])
    target, pose = np.asarray(found["target"]), found["pose"].detach().numpy().astype(np.float64)
    losses = [
        shifted_loss(np.asarray(found["image"].detach()), target, found["part"], found["camera"], pose, step)
        for step in (-0.05, 0.05)
    ]
    assert float(found["pose"].grad[3]) == pytest.approx((losses[1] - losses[0]) / 0.1, rel=0.05)
    for other in ("deodr", "mitsuba"):
        page = " ".join((ROOT / f"docs/coming-from/{other}.md").read_text().split())
        assert f"by ours {float(found['loss'].detach()):.4f}, and" in page
    # The others that are installed agree, as far as their pages say.
    ours, slope = float(found["loss"].detach()), float(found["pose"].grad[3])
    pytest.importorskip("deodr")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        exec(*blocks("docs/coming-from/deodr.md", "py"), names := {})
    assert float(((names["image"] - names["target"]) ** 2).mean()) == pytest.approx(ours, rel=0.07)
    assert float(names["pose"].grad[3]) == pytest.approx(slope, rel=0.07)
    assert torch.is_tensor(names["pose"])


def test_the_task_in_mitsuba_runs_and_agrees(model):
    from rts_compare.other_renderers.mitsuba_renderer import mitsuba

    try:
        mitsuba()
    except ImportError as error:
        pytest.skip(str(error))
    exec(*blocks("docs/coming-from/mitsuba.md", "py"), names := {})
    assert float(names["loss"].array[0]) == pytest.approx(0.091, rel=0.02)
    assert float(names["dr"].grad(names["shift"])[0][0]) == pytest.approx(-0.272, rel=0.05)


def test_the_project_file_of_the_guide_is_that_of_the_example():
    [block] = blocks("docs/plugins.md", "toml")
    written = tomllib.loads(block)["project"]
    real = tomllib.loads((ROOT / "tests/third_plugin/pyproject.toml").read_text())["project"]
    points = written.pop("entry-points")
    assert points and {name: real["entry-points"][name] for name in points} == points
    assert {name: real[name] for name in written} == written


@pytest.mark.parametrize("page", PAGES)
@pytest.mark.thorough
def test_every_command_line_works(page, model):
    pytest.importorskip("torch")
    lines = [line.partition("#")[0].strip() for block in blocks(page, "sh") for line in block.splitlines()]
    for line in lines:
        if line.startswith("rts ") and line not in ELSEWHERE:
            done = CliRunner().invoke(app, shlex.split(line)[1:])
            assert done.exit_code == 0, f"{line}: {done.output}"
        elif line.startswith("make "):
            subprocess.run(["make", "--dry-run", *line.split()[1:]], cwd=ROOT, check=True, capture_output=True)


@pytest.mark.parametrize("page", PAGES)
def test_every_link_within_the_repository_leads_somewhere(page):
    folder = (ROOT / page).parent
    for target in re.findall(r"\]\(([^)#]*)(?:#[^)]*)?\)", (ROOT / page).read_text()):
        made = (folder / target).resolve() == ROOT / "docs/reference/commands.md"  # Written as the site is built.
        assert not target or made or target.startswith("http") or (folder / target).exists(), f"{page}: {target}"
