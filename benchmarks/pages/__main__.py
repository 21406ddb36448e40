"""Bring docs/results, and marked tables of other pages of docs, up to date with the files of benchmarks/results.

A page holds prose and marked tables. A mark is a line `<!-- table: NAME -->`; the table, or list, reaches to the line
`<!-- end -->`. This command fills each of them anew and draws the charts of the first page. Prose is left as it is:

    python -m benchmarks.pages                                       # tables and charts
    python -m benchmarks.pages --check                               # changes nothing; ends with 1 if anything is stale
    python -m benchmarks.pages --take out/large_steps.md large-steps # the tables that a script printed, to their page
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from benchmarks.pages import charts, measured
from benchmarks.pages.headline import HEADLINES
from benchmarks.pages.paper import PAPER
from benchmarks.pages.tables import TABLES

DOCS = Path(__file__).parents[2] / "docs"
MARKED = re.compile(r"<!-- table: ([\w/-]+) -->\n.*?<!-- end -->", re.DOTALL)


def filled(text: str, tables: Mapping[str, Callable[[], str]]) -> str:
    """A page with all marked tables made anew.

    Args:
        text: the page.
        tables: name of a mark → a function that makes its table.

    Raises:
        KeyError: a mark has a name that no table has.
    """
    return MARKED.sub(lambda mark: f"<!-- table: {mark[1]} -->\n\n{tables[mark[1]]().strip()}\n\n<!-- end -->", text)


def marks() -> dict[str, Callable[[], str]]:
    """Names of marks → functions that make their tables."""
    return TABLES | HEADLINES | PAPER | measured.marks()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="change nothing, tell what is out of date")
    parser.add_argument("--take", nargs=2, metavar=("FILE", "PAGE"), help="take tables of a Markdown file for a page")
    args = parser.parse_args()
    check, stale = args.check, []
    if args.take:
        print(f"took {measured.take(Path(args.take[0]).read_text(), args.take[1])} tables")
    for page in sorted(DOCS.rglob("*.md")):
        text = page.read_text()
        new = filled(text, marks())
        if new != text:
            stale.append(page.name)
            if not check:
                page.write_text(new)
    for name, chart in charts.CHARTS.items():
        if charts.out_of_date(name):
            stale.append(f"{name}.svg")
            if not check:
                chart.draw(charts.IMAGES / f"{name}.svg")
    print("\n".join(stale) or "all pages are up to date")
    sys.exit(int(check and bool(stale)))


if __name__ == "__main__":
    main()
