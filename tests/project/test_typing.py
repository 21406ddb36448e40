"""What editors and type checkers know of `rts`: the stub, names of plugins, scripts of users."""

import ast
import importlib.util
import inspect
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import get_args

import pytest
import stub

import rts
from rts.rendering import arguments

pytestmark = pytest.mark.core

ROOT = Path(__file__).resolve().parents[2]
TREE = ast.parse(stub.PATH.read_text())
LAZY = rts.registry.built_in_attributes()


def test_the_stub_has_the_signatures_and_docstrings_of_the_code():
    same = ast.dump(stub.synced(stub.PATH.read_text())) == ast.dump(TREE)
    assert same, "rts/__init__.pyi falls behind the code; run tests/stub.py"


def test_a_stub_that_falls_behind_is_found():
    text = stub.PATH.read_text()
    right = ast.dump(stub.synced(text))
    for old, new in (
        ("faces: ArrayLike, indices", "faces: Any, indices"),
        ('boundary: str = "edge_and_corner"', 'boundary: str = "edge_only"'),
        ("near: float = 1.0", "near: float = 2.0"),
        ("A triangle mesh.", "A mesh of triangles."),
        ("reasons: list[str]", "reasons: list[int]"),
        ('    "warmup",\n', ""),
    ):
        assert old in text
        assert right != ast.dump(ast.parse(text.replace(old, new, 1)))


def test_the_stub_has_every_name_of_the_library_and_imports_no_plugin():
    declared = {node.name: node for node in TREE.body if isinstance(node, stub.FUNCTIONS)}
    imported = {}
    for node in TREE.body:
        if isinstance(node, ast.ImportFrom):
            assert node.module.partition(".")[0] not in ("rts_backends", "rts_surfaces", "rts_compare")
            imported |= {alias.asname or alias.name: node.module for alias in node.names}
    assert LAZY and not set(LAZY) - set(declared) - set(imported)
    assert not set(rts.__all__) - set(declared) - set(imported)
    for name in set(rts.__all__) - set(declared):
        assert getattr(importlib.import_module(imported[name]), name) is getattr(rts, name)


@pytest.mark.parametrize("name", ["rts.results", "rts.testing"])
def test_stubs_of_modules_import_what_these_find(name):
    module, names = importlib.import_module(name), set()
    for node in ast.parse(Path(module.__file__).with_suffix(".pyi").read_text()).body:
        for alias in node.names if isinstance(node, ast.ImportFrom) else ():
            names.add(alias.name)
            assert getattr(importlib.import_module(node.module), alias.name) is getattr(module, alias.name)
    assert names == set(module.__all__)


def test_what_the_stub_alone_says_of_a_class_is_true():
    """Its bases, its attributes, and the methods of bases that the stub has for itself."""
    classes = {node.name: node for node in TREE.body if isinstance(node, ast.ClassDef)}
    checked = 0
    for name in set(LAZY) & set(classes):
        code = getattr(rts, name)
        example = code.example().surface if hasattr(code, "example") else code(*{"Ndc": [(1.0, 1.0)]}.get(name, []))
        waiting = [classes[name]]
        while waiting:
            node = waiting.pop()
            for base in map(ast.unparse, node.bases):
                waiting += [classes[base]] if base in classes else []
                assert base.startswith("_") or issubclass(code, getattr(rts, base)), f"{name} is no {base}"
            for item in node.body:
                if isinstance(item, ast.AnnAssign):
                    assert hasattr(example, item.target.id), f"{name}.{item.target.id}"
                elif isinstance(item, ast.FunctionDef) and stub.code_of(node.name) is None:
                    method = list(inspect.signature(getattr(code, item.name)).parameters)
                    said = [a.arg for a in item.args.args]
                    assert method == (said[1:] if said[0] == "cls" else said), f"{name}.{item.name}"
                    checked += 1
    assert checked > 20


@pytest.mark.parametrize(
    ("group", "alias"), [("samplers", arguments.SamplerLike), ("splatters", arguments.SplatterLike)]
)
def test_editors_offer_the_built_in_plugins(group, alias):
    names = {name for kind in get_args(alias) for name in get_args(kind) if isinstance(name, str)}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert names == set(project["entry-points"][f"rts.{group}"])


@pytest.mark.thorough
@pytest.mark.skipif(not importlib.util.find_spec("pyright"), reason="needs pyright")
def test_scripts_of_users_pass_pyright_strict_and_mistakes_are_found():
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "tests/typed"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("0 errors"), done.stdout + done.stderr
