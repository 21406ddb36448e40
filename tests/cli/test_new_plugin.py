"""`rts new`: the distribution that it writes is found, and passes the conformance kit as it is."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rts_cli.main import app
from rts_cli.new_plugin import KINDS, PLACES, TRIANGLES

pytestmark = pytest.mark.plugins

ROOT = Path(__file__).resolve().parents[2]


def run(*arguments, code=0):
    result = CliRunner().invoke(app, ["new", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return " ".join(result.output.split())


def install(folder):
    """Write into a distribution's folder what pip would write elsewhere: it is found where that is in the path."""
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    info = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    groups = project["entry-points"].items()
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in entries.items()) for group, entries in groups]
    (info / "entry_points.txt").write_text("".join(lines))


@pytest.mark.thorough
def test_new_plugins_pass_the_kit_as_they_are(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folders = []
    for number, options in enumerate([*([kind] for kind in KINDS), ["surface", "--triangles"]]):
        said = run(*options, f"wavy-blob-{number}")
        folder, package = tmp_path / f"rts-wavy-blob-{number}", f"rts_wavy_blob_{number}"
        written = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
        files = {"pyproject.toml", "README.md", f"tests/test_wavy_blob_{number}.py"}
        assert written == files | {f"{package}/__init__.py", f"{package}/{options[0]}.py"}
        assert all(name in said for name in written)
        assert not [p for p in folder.rglob("*") if p.is_file() and "$" in p.read_text()]
        install(folder)
        folders.append(str(folder))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*folders, str(ROOT)])}
    # What compiles long, and what jax adds, the kit's own tests have.
    chosen = ["-q", "-p", "no:cacheprovider", "-k", "not jax and not compiled and not agree"]
    command = [sys.executable, "-m", "pytest", *chosen, *folders]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-2000:]
    assert " passed" in done.stdout and "failed" not in done.stdout


def test_what_cannot_be_written_is_refused_before_anything_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("Blob", "2d", "a b", "", "../x", "blob-", "class", "a.b", "ü"):
        assert "is no name for a plugin" in run("surface", "--", name, code=1)
    assert "there is a surface 'mesh' already" in run("surface", "mesh", code=1)
    assert "no template of 'engine'; there is surface, sampler, shader, splatter" in run("engine", "blob", code=1)
    assert "a shader is not made of triangles" in run("shader", "--triangles", "blob", code=1)
    assert "there is a splatter 'multi' already" in run("splatter", "multi", code=1)
    (tmp_path / "rts-blob").mkdir()
    assert "rts-blob exists" in run("surface", "blob", code=1)
    (tmp_path / "file").write_text("")
    assert "is a file" in run("surface", "blob", "-o", "file/new", code=1)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "rts-blob"] and not list(
        (tmp_path / "rts-blob").iterdir()
    )


def test_every_template_has_a_place_and_is_in_the_wheel():
    templates = ROOT / "rts_cli/templates"
    there = {str(p.relative_to(templates)) for p in templates.rglob("*") if p.is_file()}
    assert there == {place.format(template=kind) for place in PLACES for kind in (*KINDS, TRIANGLES)}
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["rts_cli"]
    packed = {p for pattern in data for p in (ROOT / "rts_cli").glob(pattern)}
    assert {p for p in (ROOT / "rts_cli/templates").rglob("*") if p.is_file()} <= packed
