"""The tree is as the documentation says: what imports what, and which file is where."""

import ast
import re
import subprocess
import sys
import tomllib
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import pytest

import rts
import rts.testing
from benchmarks.defects import planted, run

pytestmark = pytest.mark.core

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("rts", *sorted(path.name for path in ROOT.glob("rts_*") if path.is_dir()))
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
}

APPS = {
    f"{path.parent.name}.{path.stem}": path
    for path in sorted([*(ROOT / "apps").glob("*/rts_*/*.py"), *(ROOT / "apps").glob("*/*.py")])
    if path.name != "__init__.py"
}


def imports(path, types=False):
    """The modules of the library that a file imports anywhere; for the sake of types only if asked for."""
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if not types and isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = []
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            full = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in FILES else node.module for name in full}
    return {name for name in found if name in FILES}


def test_no_file_imports_in_a_circle():
    graph = {name: imports(path, types=True) - {name} for name, path in FILES.items()}
    assert sum(map(len, graph.values())) > 200
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" → ".join(error.args[1]))


def rooms():
    """The rooms of `rts`, each with its place in the table of docs/architecture.md, which names all."""
    table = (ROOT / "docs/architecture.md").read_text().partition("## The rooms")[2].partition("## The tree")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    return {name: n for n, row in enumerate(rows) for name in re.findall(r"`(\w+)(?:/|\.py)`", row)}


def test_rooms_import_from_those_above_them():
    order = rooms()
    for name, path in FILES.items():
        package, _, rest = name.partition(".")
        if package == "rts" and rest not in ("", "__main__"):
            others = {other.split(".")[1] for other in imports(path, types=True) if other.startswith("rts.")}
            assert all(order[other] <= order[rest.partition(".")[0]] for other in others), name


def test_the_core_never_imports_a_package_beside_it():
    assert len(PACKAGES) > 4
    for name, path in FILES.items():
        if name.partition(".")[0] == "rts":
            assert not {n for n in imports(path, types=True) if n.partition(".")[0] != "rts"}, name


def toolkit():
    """The names of each submodule of `rts.plugin_api`."""
    return {name: import_module(name).__all__ for name in FILES if name.startswith("rts.plugin_api.")}


def private(path, public):
    """Imports of a file from inside `rts` that are not among the public names of its modules, and such attributes."""
    tree = ast.parse(path.read_text())
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names if a.name.startswith("rts.") and a.name not in public}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "rts":
            found |= {f"{node.module}.{a.name}" for a in node.names if a.name not in public.get(node.module, ())}
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "rts":
            found |= {f"rts.{node.attr}"} - {f"rts.{name}" for name in public["rts"]}
    return found


def test_plugins_import_public_names_alone():
    api = toolkit()
    public = {"rts": [*rts.__all__, "errors"], "rts.plugin_api": [name.rpartition(".")[2] for name in api], **api}
    public["rts.errors"] = defined(FILES["rts.errors"])
    own = [path for name, path in FILES.items() if name.startswith(("rts_backends", "rts_surfaces"))]
    assert len(own) > 80
    for path in own:
        assert not private(path, public), path
    public["rts"] = [*rts.__all__, "errors", "splatting", *rts.registry.built_in_attributes()]
    public["rts.testing"] = rts.testing.__all__
    others = [p for folder in ("plugin_example", "second_plugin") for p in (ROOT / "tests" / folder).rglob("*.py")]
    assert len(others) > 5
    for path in others:
        assert not private(path, public), path


def defined(path):
    """The public names that a file defines at its top level, or lists as its own."""
    top = ast.parse(path.read_text()).body
    names = {n.name for n in top if isinstance(n, (ast.FunctionDef, ast.ClassDef))}
    names |= {t.id for n in top if isinstance(n, ast.Assign) for t in n.targets if isinstance(t, ast.Name)}
    return [name for name in names if not name.startswith("_")]


def test_tools_import_public_names_alone():
    tools = [name for name in FILES if name.startswith("rts.tool_api.")]
    listed = (*tools, "rts.regularizers", "rts.results", "rts.shading", "rts.shadows", "rts.testing")
    public = {"rts.errors": defined(FILES["rts.errors"])} | toolkit()
    public |= {name: import_module(name).__all__ for name in listed}
    public["rts"] = [*rts.__all__, *rts._PLACES, *rts._MODULES, "__version__", "errors"]
    public["rts"] += rts.registry.built_in_attributes()
    assert sum(len(public[name]) for name in tools) <= 47
    for package in ("rts_cli", "rts_compare", "rts_diagnostics", "rts_testing"):
        own = [path for name, path in FILES.items() if name.startswith(package)]
        assert len(own) > 10
        for path in own:
            assert not private(path, public), path
    assert len(APPS) > 10
    for path in APPS.values():
        assert not private(path, public), path


def test_a_private_import_is_found(tmp_path):
    path = tmp_path / "plugin.py"
    path.write_text(
        "import rts\nimport rts.compiling\nfrom rts import Part, compiling\nfrom rts.arrays.trees import Array\n"
    )
    expected = {"rts.compiling", "rts.arrays.trees.Array"}
    assert private(path, {"rts": rts.__all__}) == expected
    path.write_text("import rts\nrts.render(rts.compiling.threads)\n")
    assert private(path, {"rts": rts.__all__}) == {"rts.compiling"}


def test_the_toolkit_is_small_and_documented():
    names = {name: import_module(place) for place, listed in toolkit().items() for name in listed}
    assert len(names) == sum(map(len, toolkit().values()))
    mirrored = set(names) & set(rts.__all__)  # The bases, so that a plugin has one home to import from.
    assert mirrored == {*import_module("rts.plugin_api.bases").__all__, "engine_of", "namespace"} - {"Unlit"}
    assert all(getattr(names[name], name) is getattr(rts, name) for name in mirrored)
    # The last one, `differences`, saves textured meshes a tenth of a step.
    assert len(names) - len(mirrored) <= 47
    text = (ROOT / "docs/plugins.md").read_text()
    for place, listed in toolkit().items():
        row = re.search(rf"^\| `{place.rpartition('.')[2]}` \|.*$", text, re.MULTILINE)
        for name in listed:
            assert row and re.search(rf"`{name}[`(]", row[0]), f"{place}.{name}"


def test_old_names_tell_where_they_are():
    for place, names in rts._MOVED.items():
        for name in names.split():
            assert hasattr(import_module(place), name)
            with pytest.warns(DeprecationWarning, match=f"^rts.{name} is deprecated .*; take {place}.{name}$") as told:
                assert getattr(rts, name) is getattr(import_module(place), name)
            assert [w.filename for w in told] == [__file__]


def test_names_that_are_deprecated_go_in_the_version_that_they_told():
    now = tuple(map(int, rts.__version__.split(".")[:2]))
    versions = []
    for path in [*FILES.values(), *APPS.values()]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] == "warn_deprecated":
                [until] = [ast.literal_eval(k.value) for k in node.keywords if k.arg == "until"]
                versions.append(tuple(map(int, until.split("."))))
    assert versions and all(now < until for until in versions)


def test_numba_is_imported_when_something_is_computed():
    program = "import sys, rts; rts.Mesh, rts.fit, rts.load; print([n for n in sys.modules if 'numba' in n])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "[]\n"


def test_a_docstring_says_by_itself_what_it_speaks_of():
    for path in [*FILES.values(), *(ROOT / "benchmarks").rglob("*.py"), *(ROOT / "tests").rglob("*.py")]:
        for start in re.findall(r'"""(The same |Of )', path.read_text().replace('r\'"""', "")):
            pytest.fail(f"{path.relative_to(ROOT)} has a docstring that begins with {start!r}")


def test_the_architecture_has_a_line_for_every_file():
    text = (ROOT / "docs/architecture.md").read_text()
    named = in_tree(text[text.index("## The tree") :].split("```")[1])
    assert not [path for path in named if not (ROOT / path).is_file()]
    own = [path for path in (FILES | APPS).values() if path.name != "__init__.py" or path == FILES["rts"]]
    assert not {str(path.relative_to(ROOT)) for path in own} - named


def in_tree(tree):
    """Paths of the files that a tree of folders names. A folder's line ends its name in "/", before any remark."""
    folders, paths = [(-1, Path())], set()
    for line in tree.splitlines():
        indent, (first, _, rest) = len(line) - len(line.lstrip()), line.strip().partition(" ")
        if indent < REMARKS:
            while folders[-1][0] >= indent:
                folders.pop()
            is_folder = first.endswith("/")
            folders.append((indent, folders[-1][1] / (first if is_folder else "")))
            line = rest if is_folder else line
        files = re.findall(r"(?<![*>\w])\w+\.(?:py|cpp|h|html|sh)\b", line)
        paths |= {str(folders[-1][1] / name) for name in files}
    return paths


REMARKS = 24
"""Column from which on lines of the tree hold remarks alone."""


def test_a_tree_is_read_folder_by_folder():
    tree = (
        f"a/      b.py; c.py: two\n  d.py    one (d_loops.py,\n{28 * ' '}e.h)\n  f/\n    g.py  *_loops.py\nh/   i.sh\n"
    )
    assert in_tree(tree) == {"a/b.py", "a/c.py", "a/d.py", "a/d_loops.py", "a/e.h", "a/f/g.py", "h/i.sh"}


def long_lines(text):
    """Numbers of the lines of Markdown over 120 characters, outside of tables and fenced code."""
    fence, numbers = "", []
    for number, line in enumerate(text.splitlines(), start=1):
        mark = re.match(r"\s*(```+|~~~+)", line)
        if mark and (not fence or mark[1].startswith(fence)):
            fence = "" if fence else mark[1]
        elif not fence and len(line) > 120 and not line.lstrip().startswith("|"):
            numbers.append(number)
    return numbers


def test_lines_of_markdown_are_short():
    folders = [ROOT / name for name in ("apps", "docs", "benchmarks", "tests")]
    pages = [*ROOT.glob("*.md"), *(page for folder in folders for page in folder.rglob("*.md"))]
    assert len(pages) > 10
    assert not {str(p.relative_to(ROOT)): long for p in pages if (long := long_lines(p.read_text()))}


def test_a_long_line_of_markdown_is_found():
    long = 60 * "ab "
    assert long_lines(f"{long}\n| {long}|\n```text\n{long}\n```\n- {long}\n") == [1, 6]


def test_files_of_tests_lie_where_what_they_test_is():
    folders = {*rooms(), *(name.removeprefix("rts_") for name in PACKAGES[1:]), "plugins", "project"}
    paths = [p.relative_to(ROOT / "tests") for p in (ROOT / "tests").rglob("test_*.py")]
    assert {p.parts[0] for p in paths} - {"plugin_example"} <= folders
    own = [p.name for p in paths if p.parts[0] != "plugin_example"]
    assert len(own) > 100 and len(own) == len(set(own))  # pytest knows files by their names alone.


def test_every_file_of_tests_has_one_area():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    areas = {line.partition(":")[0] for line in project["tool"]["pytest"]["ini_options"]["markers"]}
    for path in sorted((ROOT / "tests").glob("*/test_*.py")):
        marks = re.findall(r"^pytestmark = pytest\.mark\.(\w+)$", path.read_text(), re.MULTILINE)
        assert len(marks) == 1 and marks[0] in areas, f"{path.name} has the areas {marks}; expected one of {areas}"


def test_the_oldest_versions_are_those_that_are_allowed():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = project["dependencies"] + sum(
        (extras[e] for e in ("torch", "jax", "cli", "embree", "opengl", "plots")), []
    )
    pinned = dict(
        line.lower().split("==") for line in (ROOT / "constraints-oldest.txt").read_text().split() if "==" in line
    )
    for requirement in wanted:
        name, least = requirement.lower().partition(",")[0].split(">=")
        assert pinned[name].startswith(least), f"{requirement}, but constraints-oldest.txt has {pinned[name]}"


def test_the_version_is_that_of_the_distribution():
    assert rts.__version__ == version("rasterize-then-splat")
    released, dev, _ = rts.__version__.partition(".dev")
    [newest, *_] = re.findall(r"^## (\d+\.\d+\.\d+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert f"version: {newest}\n" in (ROOT / "CITATION.cff").read_text()
    numbers = [tuple(map(int, version.split("."))) for version in (newest, released)]
    assert numbers[0] < numbers[1] if dev else numbers[0] == numbers[1]
    assert sys.modules["rts"].__file__ == str(FILES["rts"])


BLOCKS = (ast.For, ast.While, ast.If, ast.With, ast.Try)


def nesting(nodes, depth=0):
    """The depth of nested blocks in statements; `elif` is as deep as its `if`, inner functions count apart."""
    deepest = depth
    for node in nodes:
        if not isinstance(node, BLOCKS):
            continue
        inside = [*node.body, *getattr(node, "finalbody", [])]
        inside += [n for handler in getattr(node, "handlers", []) for n in handler.body]
        beside = getattr(node, "orelse", [])
        follows = isinstance(node, ast.If) and len(beside) == 1 and isinstance(beside[0], ast.If)
        deepest = max(deepest, nesting(inside, depth + 1), nesting(beside, depth if follows else depth + 1))
    return deepest


def test_no_function_nests_deeper_than_four_blocks():
    lines = ("for a in b:", " if a:", "  pass", " elif b:", "  while b:", "   with a:", "    try:", "     b")
    five = ast.parse("\n".join((*lines, "    finally:", "     c")))
    assert nesting(five.body) == 5
    deep = []
    for module, path in FILES.items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and nesting(node.body) > 4:
                deep.append(f"{module}.{node.name}")
    assert not deep


def test_planted_defects_apply_to_the_tree():
    assert len(planted.LOOPS) > 10 and len(planted.ARRAYS) > 10
    assert len({defect.name for defect in planted.DEFECTS}) == len(planted.DEFECTS)
    for defect in planted.DEFECTS:
        assert (ROOT / defect.path).read_text().count(defect.before) == 1, defect.name
        missing = [name for name in defect.tests.split() if not [*(ROOT / "tests").glob(f"*/test_{name}.py")]]
        assert not missing and defect.after != defect.before


def test_a_planted_defect_is_caught_only_by_a_test_that_is_named():
    whole = "=== short test summary info ===\nFAILED tests/test_a.py::test_b[two words] - assert 1 == 2\n1 failed"
    assert run.verdict(1, whole) == "tests/test_a.py::test_b[two words]"
    assert run.verdict(2, "ERROR tests/test_a.py - ImportError: no c\n") == "tests/test_a.py"
    assert run.verdict(0, "ERROR    root:a.py:1 a record of a log\n3 passed") is None
    for code, output in ((4, "ERROR: file or directory not found: tests/test_a.py"), (-11, "Segmentation fault")):
        with pytest.raises(RuntimeError, match=f"pytest ended with {code}"):
            run.verdict(code, output)
