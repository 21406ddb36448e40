"""The documentation names what exists: names, files, versions, and each entry of the changelog once."""

import builtins
import re
from collections import Counter
from importlib import import_module
from importlib.metadata import distribution, version
from pathlib import Path

import pytest
from packaging.version import Version

import rts
import rts.testing
from rts import registry

pytestmark = pytest.mark.docs

ROOT = Path(__file__).resolve().parents[2]
DISTRIBUTION = "rasterize-then-splat"
PAST = ("docs/results/history.md",)
"""Pages that name what is gone."""
PAGES = [
    path
    for path in (
        *("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "benchmarks/README.md"),
        *(str(p.relative_to(ROOT)) for p in sorted((ROOT / "docs").rglob("*.md"))),
        *(str(p.relative_to(ROOT)) for p in sorted((ROOT / "docs/tutorials").glob("*.py"))),
    )
    if path not in PAST
]
PACKAGES = ("rts", *sorted(path.name for path in ROOT.glob("rts_*") if path.is_dir()))
FOLDERS = (*PACKAGES, "apps", "benchmarks", "docs", "tests")
FILES = [str(p.relative_to(ROOT)) for f in (*FOLDERS, ".github") for p in (ROOT / f).rglob("*") if p.is_file()]
RECORDS = "rts.contracts.records"
MODULES = (
    *("rts.errors", "rts.regularizers", "rts.results", "rts.shadows", "rts.splatting", "rts.testing", "rts_compare"),
    *(f"rts.{path.parent.name}.{path.stem}" for path in (ROOT / "rts").glob("*_api/[a-z]*.py")),
)
NAME = re.compile(r"(?<![\w./…-])[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*(?![\w/])")


def public():
    """Classes and functions by name, of `rts` and of the modules that plugins and users import."""
    modules = map(import_module, MODULES)
    found = {name: getattr(m, name) for m in modules for name in getattr(m, "__all__", vars(m))}
    return found | {name: getattr(rts, name) for name in {*rts.__all__, *registry.built_in_attributes()}}


PUBLIC = public()
NAMED = vars(import_module(RECORDS)) | PUBLIC


def code(text):
    """Code in backticks, line by line, without fenced blocks, strings, and what a changelog says is gone."""
    text = re.sub(r"^### Moving from .*?(?=^##)", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    return [re.sub(r'"[^"]*"', "", found) for found in re.findall(r"`([^`\n]+)`", text)]


def has(thing, name):
    """True if a module, class or object has an attribute, or a class declares a field, of this name."""
    return hasattr(thing, name) or any(
        name in vars(c).get("__annotations__", {}) for c in getattr(thing, "__mro__", ())
    )


def is_there(path):
    """True if a dotted path leads somewhere: from a package of ours, or from a public name."""
    head, *names = path.split(".")
    thing = import_module(head) if head in PACKAGES else NAMED[head]
    for name in names:
        if not has(thing, name):
            try:
                import_module(f"{thing.__name__}.{name}")
            except (AttributeError, ImportError):
                return False
        thing = getattr(thing, name, None)
    return True


def unknown(text):
    """Dotted names of a text that lead nowhere, of those that begin with a package or with a public class."""
    groups = distribution(DISTRIBUTION).entry_points.groups
    names = {name for found in code(text) for name in NAME.findall(found) if "." in name}
    ours = {n for n in names if n.split(".")[0] in PACKAGES or (n[0].isupper() and n.split(".")[0] in NAMED)}
    return sorted(n for n in ours - set(groups) if not re.search(r"\.(py|md|json)$", n) and not is_there(n))


@pytest.mark.parametrize("page", PAGES)
def test_pages_name_what_the_library_has(page):
    assert not unknown((ROOT / page).read_text())


def test_the_guide_to_plugins_names_no_class_that_plugins_may_not_import():
    text = (ROOT / "docs/plugins.md").read_text()
    words = {word for found in code(text) for word in NAME.findall(found) if re.fullmatch("[A-Z][a-z]+[A-Za-z]*", word)}
    assert len(words) > 20
    assert words - PUBLIC.keys() <= vars(builtins).keys()


def test_a_name_that_is_not_there_is_found():
    text = "`rts.render`, `rts.Mesh`, `Cells.row`, `rts.surfaces`, `Cells.rows`, `rts.rendered(x)`, `rts.errors.None_`"
    assert unknown(text) == ["Cells.rows", "rts.errors.None_", "rts.rendered"]
    assert unknown("### Moving from 0.1\n\n`rts.rendered`\n\n### Mended\n\n`rts.gone`\n") == ["rts.gone"]


def missing(text):
    """Files of Python and Markdown that a text names in backticks, and folders before them, that are not there."""
    named = {name for found in code(text) for name in re.findall(r"(?<![\w*…<>-])[\w./-]+\.(?:py|md)\b", found)}
    ends = {f"/{path}" for path in FILES} | {f"/{path.name}" for path in ROOT.glob("*.*")}
    return sorted(n for n in named if "/" in n and not any(path.endswith("/" + n.lstrip("./")) for path in ends))


@pytest.mark.parametrize("page", PAGES)
def test_pages_name_files_that_are_there(page):
    assert not missing((ROOT / page).read_text())


def test_a_file_that_is_not_there_is_found():
    assert missing("`rts/scene/camera.py`, `scene/view.py`, `sampling/several.py`, `script.py`") == [
        "sampling/several.py"
    ]


@pytest.mark.parametrize("page", ["CHANGELOG.md", "docs/plugins.md"])
def test_words_in_code_are_words_of_the_sources(page):
    sources = [path for path in FILES if path.endswith((".py", ".toml", ".in", ".yml"))]
    words = set(re.findall(r"\w+", "\n".join((ROOT / path).read_text() for path in (*sources, "pyproject.toml"))))
    examples = {"proxykey"}  # A misspelt name, which is refused.
    written = {word for found in code((ROOT / page).read_text()) if "/" not in found for word in NAME.findall(found)}
    assert not {part for word in written for part in word.split(".")} - words - examples


def test_the_changelog_says_each_thing_once():
    entries = re.split(r"\n(?=- )", (ROOT / "CHANGELOG.md").read_text())[1:]
    said = Counter(" ".join(entry.split("\n\n")[0].split()) for entry in entries)
    assert len(said) > 100
    assert not [entry for entry, count in said.items() if count > 1]


def released():
    """The versions that the changelog heads name, the newest first."""
    return re.findall(r"^## (\d\S*)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)


def test_the_changelog_begins_with_what_is_unreleased_and_has_the_newest_release():
    heads = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    own, newest = Version(version(DISTRIBUTION)), Version(released()[0])
    assert heads[0] == "Unreleased" and (own == newest or (own.is_devrelease and own > newest))
    assert re.fullmatch(r"\S+ \(\d{4}-\d\d-\d\d\)", heads[1])


def test_plugins_are_advised_to_declare_the_newest_release():
    major, minor = map(int, released()[0].split(".")[:2])
    text = (ROOT / "docs/plugins.md").read_text()
    assert re.findall(rf"`{DISTRIBUTION}(>=\S+)`", text) == [f">={major}.{minor},<{major}.{minor + 1}"]
