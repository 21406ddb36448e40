"""The pages of the site: all of them are in its navigation, and the reference has every public name."""

import ast
import re
from importlib import import_module
from importlib.metadata import distribution
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

import rts
import rts.testing
from rts import registry

pytestmark = pytest.mark.docs

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = "\n".join(page.read_text() for page in sorted((ROOT / "docs/reference").glob("*.md")))
ENTRIES = set(re.findall(r"^::: (\S+)$", REFERENCE, re.MULTILINE))
HEADINGS = set(re.findall(r"^ +heading: (\S+)$", REFERENCE, re.MULTILINE))


def attribute(place):
    """The object of a dotted path: the longest part of it that is a module, then attributes."""
    names = place.split(".")
    for count in range(len(names), 0, -1):
        try:
            found = import_module(".".join(names[:count]))
        except ImportError:
            continue
        for name in names[count:]:
            found = getattr(found, name)
        return found
    raise LookupError(place)


OF_THE_LIBRARY = ("warn", "warn_deprecated", "in_one_line")
"""Functions of `rts.errors` that only the library itself calls."""


def public_names():
    """Every name that users and plugins may import, as it is written."""
    yield from (f"rts.{name}" for name in {*rts.__all__, *registry.built_in_attributes()})
    for module in (
        "rts.errors",
        "rts.regularizers",
        "rts.results",
        "rts.shadows",
        "rts.splatting",
        "rts.testing",
        "rts_compare",
    ):
        found = import_module(module)
        own = [name for name, value in vars(found).items() if getattr(value, "__module__", None) == module]
        names = getattr(found, "__all__", [name for name in own if name not in OF_THE_LIBRARY])
        yield from (f"{module}.{name}" for name in names)
    for path in sorted((ROOT / "rts").glob("*_api/[a-z]*.py")):
        module = f"rts.{path.parent.name}.{path.stem}"
        yield from (f"{module}.{name}" for name in import_module(module).__all__)


def same(name):
    """Whether the reference has an entry for what this name is, under whatever path."""
    if name in ENTRIES | HEADINGS:
        return True
    found = attribute(name)
    place = f"{getattr(found, '__module__', '')}.{getattr(found, '__qualname__', '')}"
    last = name.rpartition(".")[2]
    return place in ENTRIES or any(attribute(entry) is found for entry in ENTRIES if entry.endswith(last))


def test_the_reference_has_every_public_name():
    names = sorted(set(public_names()))
    assert len(names) > 100
    assert not [name for name in names if not same(name)]


def test_a_name_without_an_entry_is_found(monkeypatch):
    monkeypatch.setattr(registry, "forgotten", lambda: None, raising=False)
    assert not same("rts.registry.forgotten")


def test_every_entry_of_the_reference_is_there_and_documented():
    assert not [entry for entry in sorted(ENTRIES) if not attribute(entry).__doc__]


def test_the_reference_has_every_built_in_plugin():
    points = distribution("rasterize-then-splat").entry_points
    pages = {kind: (ROOT / f"docs/reference/{kind}.md").read_text() for kind in ("samplers", "shaders", "splatters")}
    for kind, page in pages.items():
        names = [point.name for point in points.select(group=f"rts.{kind}")]
        assert len(names) > 4
        assert not [n for n in names if n != "auto" and f"heading: {n}\n" not in page], kind
    surfaces = {point.value.replace(":", ".") for point in points.select(group="rts.surfaces")}
    assert surfaces <= ENTRIES


def test_the_navigation_has_every_page():
    config = (ROOT / "mkdocs.yml").read_text()
    listed = set(re.findall(r"^ +- (?:.*: )?(\S+\.(?:md|py))$", config, re.MULTILINE)) - {"docs/hooks.py", "hooks.py"}
    pages = {str(p.relative_to(ROOT / "docs")) for p in (ROOT / "docs").rglob("*.md")}
    pages |= {str(p.relative_to(ROOT / "docs")) for p in (ROOT / "docs/tutorials").glob("*.py")}
    assert not pages - listed
    assert not [p for p in listed - pages if not (ROOT / p).is_file() and p != "reference/commands.md"]


def messages():
    """The literal text of each string in the library; holes of f-strings are left out."""
    for package in ("rts", "rts_backends", "rts_surfaces", "rts_cli", "rts_diagnostics", "rts_testing", "rts_compare"):
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.JoinedStr):
                    yield "".join(v.value if isinstance(v, ast.Constant) else "…" for v in node.values)
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    yield node.value


def test_the_messages_of_troubleshooting_are_those_of_the_library():
    page = (ROOT / "docs/guides/troubleshooting.md").read_text()
    quoted = [text for row in re.findall(r"^\| (`.*?) \|", page, re.MULTILINE) for text in re.findall(r"`(.*?)`", row)]
    assert len(quoted) > 15
    literal = "\n".join(messages())
    assert not [text for text in quoted if text not in literal and text not in dir(rts.errors)]


def test_the_build_finds_dead_links_and_what_is_fetched_from_elsewhere(tmp_path, caplog):
    pytest.importorskip("mkdocs")
    spec = spec_from_file_location("hooks", ROOT / "docs/hooks.py")
    hooks = module_from_spec(spec)
    spec.loader.exec_module(hooks)
    page = tmp_path / "a/index.html"
    page.parent.mkdir()
    page.write_text('<p id="here"><a href="#here"><a href="../b.html#there"><a href="https://elsewhere.org"></p>')
    (tmp_path / "b.html").write_text('<h1 id="there"></h1><a href="a/"><img src="data:,"><script src="b.js"></script>')
    (tmp_path / "b.js").touch()
    hooks.on_post_build({"site_dir": str(tmp_path)})
    assert not [record for record in caplog.records if record.levelname == "WARNING"]
    page.write_text('<a href="../c.html"><a href="#gone"><a href="../b.html#gone"><script src="https://cdn.org/x.js">')
    hooks.on_post_build({"site_dir": str(tmp_path)})
    found = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(found) == 4
    assert sum("leads nowhere" in text for text in found) == 3 and sum("cdn.org" in text for text in found) == 1
