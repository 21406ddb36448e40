"""The pages of results say what the files of measurements say."""

import re
from pathlib import Path

import pytest

from benchmarks.pages import charts, measured
from benchmarks.pages.__main__ import DOCS, MARKED, filled, marks
from benchmarks.pages.headline import ratio
from benchmarks.pages.kept import kept, number

pytestmark = pytest.mark.docs

ROOT = Path(__file__).resolve().parents[2]
PAGES = DOCS / "results"
MARKS = marks()
ADVICE = "Run `python -m benchmarks.pages`."


def test_tables_of_results_are_those_of_the_files():
    pages = sorted(DOCS.rglob("*.md"))
    assert sum(bool(MARKED.search(page.read_text())) for page in pages) > 4
    assert not [page.name for page in pages if filled(page.read_text(), MARKS) != page.read_text()], ADVICE


def test_each_table_stands_on_a_page():
    marks = [name for page in PAGES.glob("*.md") for name in MARKED.findall(page.read_text())]
    assert set(MARKS) == set(marks)


@pytest.mark.parametrize("name", charts.CHARTS)
def test_charts_of_results_are_drawn_of_these_numbers(name):
    assert not charts.out_of_date(name), ADVICE


def test_a_changed_figure_is_noticed():
    text = "Before.\n\n<!-- table: a -->\n\n| 1 |\n\n<!-- end -->\n\nAfter.\n"
    assert filled(text, {"a": lambda: "| 1 |\n"}) == text
    assert "| 2 |" in filled(text, {"a": lambda: "| 2 |\n"})


UNKEPT = ("history", "index")
"""Pages whose tables are prose: what was measured once with code that is gone, and the list of the pages."""


def test_every_table_of_results_is_kept():
    for page in PAGES.glob("*.md"):
        if page.stem not in UNKEPT:
            assert not list(measured.in_markdown(MARKED.sub("", page.read_text()))), page.name


def test_tables_that_a_script_prints_replace_those_of_its_page(tmp_path, monkeypatch):
    monkeypatch.setattr(measured, "FOLDER", tmp_path)
    first, second = measured.Measured(["a", "b"], [["1", "[2], \\| 3"]]), measured.Measured(["c"], [["4"], ["5"]])
    measured.keep("page", [first, second, first])
    assert measured.kept("page") == [first, second, first]
    changed = measured.Measured(["a", "b"], [["6", "7"], ["8", "9"]])
    assert measured.take(f"Before\n{changed}\nbetween\n\n{first}\n", "page") == 2
    assert measured.kept("page") == [changed, second, first]
    assert measured.marks()["page/2"]() == str(second)
    with pytest.raises(ValueError, match=r"no table of page has the columns \['d'\]"):
        measured.take("| d |\n|---|\n| 1 |\n", "page")


def test_ratios_are_of_the_fastest_other():
    assert ratio(2.0, [None, 10.0, 6.0]) == "×3"
    assert ratio(None, [1.0]) == "others alone" and ratio(1.0, [None]) == "ours alone"


def test_numbers_are_read_off_cells():
    assert [number(cell) for cell in ("4.35 (4.21–4.53)", "2,464", "**57.6**")] == [4.35, 2464, 57.6]


def test_all_ways_to_fail_are_counted():
    table = kept("stability")
    for counts in charts.verdicts().values():
        assert sum(counts.values()) == len(table["rows"]) == 40


def test_the_first_page_names_every_page():
    named = set(re.findall(r"\]\(([\w-]+)\.md\)", (PAGES / "index.md").read_text()))
    assert named == {page.stem for page in PAGES.glob("*.md")} - {"index"}


def test_old_links_to_results_lead_somewhere():
    text = (ROOT / "benchmarks/RESULTS.md").read_text()
    for page in (ROOT / "README.md", ROOT / "benchmarks/README.md"):
        for anchor in re.findall(r"RESULTS\.md#([\w-]+)", page.read_text()):
            assert f'<a id="{anchor}">' in text, anchor
    for target in re.findall(r"\]\(([^)#]+)", text):
        assert (ROOT / "benchmarks" / target).exists(), target
