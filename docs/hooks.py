"""Work of `make docs` beside mkdocs: pages from elsewhere in the repository, the command line, checks of the site.

Every complaint is a warning, which ends a strict build.
"""

import logging
import posixpath
import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from mkdocs.structure.files import File, InclusionLevel

ROOT = Path(__file__).resolve().parent.parent
LINK = re.compile(r"(?<=\]\()([^)\s#]+)(?=[)#])")
log = logging.getLogger("mkdocs.hooks.rts")
BOOSTS = {
    "start/": 2,
    "guides/": 2,
    "reference/": 0.5,
    **dict.fromkeys(("results/", "benchmarks/", "architecture", "CHANGELOG", "CONTRIBUTING"), 0.1),
}
"""Beginning of a page's place → factor on its rank in the search: what people ask for first is in the guides."""


def on_files(files, config):
    """Add the page of the command line, and all files of the repository that pages link to."""
    files.append(File.generated(config, "reference/commands.md", content=commands()))
    pages = [Path(file.abs_src_path) for file in files if file.src_uri.endswith(".md") and file.abs_src_path]
    pages += [ROOT / page for page in listed(config["nav"]) if (ROOT / page).is_file()]
    seen = set()
    while pages:
        page = pages.pop().resolve()
        outside = not page.is_relative_to(ROOT / "docs")
        if page in seen or not page.is_file():
            continue
        seen.add(page)
        if outside:
            uri = page.relative_to(ROOT).as_posix()
            files.append(File.generated(config, uri, abs_src_path=str(page), inclusion=InclusionLevel.INCLUDED))
        if page.suffix == ".md":
            links = [target for target in LINK.findall(page.read_text()) if not urlsplit(target).scheme]
            pages += [page.parent / target for target in links]
    return files


def listed(nav):
    """The pages that the navigation names."""
    if isinstance(nav, str):
        return [nav]
    return [page for item in (nav.values() if isinstance(nav, dict) else nav) for page in listed(item)]


def commands():
    """A page in Markdown: each command of `rts`, with its options, as `--help` has them."""
    import typer
    from rts_cli.main import app
    from typer.cli import get_docs_for_click

    group = typer.main.get_command(app)
    text = get_docs_for_click(obj=group, ctx=typer.Context(group), name="rts")
    head = (
        "# The command line\n\nEvery command with its options. "
        "The [guide](../guides/command_line.md) shows them at work.\n\n"
    )
    return head + re.sub(r"^(#+) ", r"#\1 ", text, flags=re.MULTILINE).replace("```console", "```text")


def on_page_markdown(markdown, page, config, files):
    """Lead links that leave `docs/` to this site's copies; see that a guide shows something."""
    uri = page.file.src_uri
    if not uri.endswith(".md"):
        return markdown
    if boost := next((value for start, value in BOOSTS.items() if uri.startswith(start)), None):
        page.meta["search"] = {"boost": boost}
    shows = "```python" in markdown or "](../images/" in markdown
    if re.match(r"guides/(?!index)|coming-from/", uri) and not shows:
        log.warning("%s has neither a picture nor code that runs", uri)
    if page.file.generated_by and not page.file.abs_src_path:
        return markdown
    source = Path(page.file.abs_src_path).resolve()
    return LINK.sub(lambda link: relocated(link[1], source, uri), markdown)


def place(target, source):
    """The path on the site of a file that a page links to; None if it is not in the repository."""
    path = (source.parent / target).resolve()
    if urlsplit(target).scheme or not path.is_relative_to(ROOT):
        return None
    return path.relative_to(ROOT / "docs" if path.is_relative_to(ROOT / "docs") else ROOT).as_posix()


def relocated(target, source, uri):
    """The link of a page, from its place on the site to that of the target."""
    found = place(target, source)
    return posixpath.relpath(found, posixpath.dirname(uri) or ".") if found else target


def on_page_content(html, page, config, files):
    """Give an executed tutorial the theme's looks, and mend its links to pages."""
    if not page.file.src_uri.endswith(".py"):
        return html
    if "<img" not in html:
        log.warning("%s shows no picture", page.file.src_uri)

    def address(link):
        target = files.get_file_from_path(place(link[1], Path(page.file.abs_src_path)) or "")
        return f'href="{target.url_relative_to(page.file)}' if target else link[0]

    return re.sub(r'href="([^"#:]+\.(?:md|py))(?=["#])', address, in_the_theme(html))


def in_the_theme(html):
    """The cells of a notebook without Jupyter's styles and scripts, some of which load others from elsewhere."""
    for gone in (
        r"<(script|style)\b.*?</\1>",
        r"<!--.*?-->",
        r'<div class="zeroclipboard-container">.*?</clipboard-copy>\s*</div>',
        r'<div class="clipboard-copy-txt".*?</div>',
        r'<div class="jp-Collapser.*?</div>',
    ):
        html = re.sub(gone, "", html, flags=re.DOTALL)
    code = r'<div class="highlight-ipynb hl-python"><pre><span></span>(.*?)</pre>'
    html = re.sub(code, r'<div class="language-python highlight"><pre><code>\1</code></pre>', html, flags=re.DOTALL)
    output = r'(data-mime-type="(?:text/plain|application/vnd.jupyter.std\w+)"[^>]*>\s*)<pre>(.*?)</pre>'
    html = re.sub(output, r'\1<pre class="output"><code>\2</code></pre>', html, flags=re.DOTALL)
    return html.replace('class="anchor-link"', 'class="headerlink" title="Permanent link"')


def on_post_build(config):
    """Follow every link within the site, and look for what a page would fetch from elsewhere."""
    site = Path(config["site_dir"])
    pages = {path.resolve(): Page(path) for path in sorted(site.rglob("*.html"))}
    for path, page in pages.items():
        name = path.relative_to(site.resolve()).as_posix()
        for address in page.assets:
            if urlsplit(address).netloc:
                log.warning("%s fetches %s", name, address)
        for address in [*page.links, *page.assets]:
            if problem := dead(address, path, pages, site.resolve()):
                log.warning("%s: the link %s leads nowhere: %s", name, address, problem)
    log.info("checked the links of %d pages", len(pages))


def dead(address, path, pages, site):
    """The reason why a link within the site leads nowhere; None if it leads somewhere, or elsewhere."""
    parts = urlsplit(address)
    if parts.scheme or parts.netloc or path.name == "404.html":
        return None
    place = unquote(parts.path)
    target = site / place.lstrip("/") if place.startswith("/") else path.parent / place
    target = (target if place else path).resolve()
    target = target / "index.html" if target.is_dir() else target
    if not target.is_file():
        return "no such file"
    fragment = unquote(parts.fragment)
    if fragment and target in pages and fragment not in pages[target].names:
        return "no such place in the page"
    return None


class Page(HTMLParser):
    """The links of a page, the files that it loads, and the names of its places."""

    def __init__(self, path):
        super().__init__()
        self.links, self.assets, self.names = set(), set(), {"__top", ""}
        self.feed(path.read_text())

    def handle_starttag(self, tag, attrs):
        """Sort one tag's attributes."""
        values = dict(attrs)
        self.names |= {values[key] for key in ("id", "name") if values.get(key)}
        if tag == "a" and values.get("href"):
            self.links.add(values["href"])
        elif tag == "link" and values.get("href") and values.get("rel") not in ("canonical", "next", "prev"):
            self.assets.add(values["href"])
        elif tag in ("script", "img", "iframe", "source", "video") and values.get("src"):
            if not values["src"].startswith("data:"):
                self.assets.add(values["src"])
