"""The pages of results say what the files of measurements say."""

import re
from pathlib import Path

import pytest

from benchmarks.pages import charts
from benchmarks.pages.__main__ import DOCS, MARKED, filled
from benchmarks.pages.headline import HEADLINES, ratio
from benchmarks.pages.kept import kept, number
from benchmarks.pages.paper import PAPER
from benchmarks.pages.tables import TABLES

pytestmark = pytest.mark.docs

ROOT = Path(__file__).resolve().parent.parent
PAGES = DOCS / "results"
MARKS = TABLES | HEADLINES | PAPER
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
