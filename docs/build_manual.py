"""The manual and the guide as one web page with pictures, which the extension contains and its question mark opens.

python docs/build_manual.py            write docs/manual/manual.html
python docs/build_manual.py --check    fail if it is not that of the present pages
"""

from __future__ import annotations

import argparse
import html
import itertools
import posixpath
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from markdown_it import MarkdownIt
from markdown_it.token import Token

DOCS = Path(__file__).resolve().parent
MANUAL = DOCS / "manual"
OUT = MANUAL / "manual.html"
INDEX, GUIDE = "manual/index.md", "guide.md"

STYLE = """
:root { color-scheme: light dark; --line: #8884; --link: #2b6cb0; --code: #8882; }
@media (prefers-color-scheme: dark) { :root { --link: #7ab8f5; } }
body { margin: 0; font: 16px/1.55 system-ui, "Segoe UI", Roboto, sans-serif; }
a { color: var(--link); text-decoration: none; }
a:hover { text-decoration: underline; }
nav { padding: 1rem 1.5rem; border-bottom: 1px solid var(--line); font-size: 0.9rem; }
nav ol, nav ul { margin: 0; padding: 0; list-style: none; }
nav ul { padding-left: 1rem; }
nav > ol > li { margin: 0.3rem 0; }
main { max-width: 50rem; padding: 0 1.5rem 6rem; }
section { padding-top: 1px; border-bottom: 1px solid var(--line); }
img { max-width: 100%; height: auto; border-radius: 4px; }
table { border-collapse: collapse; display: block; overflow-x: auto; }
th, td { padding: 0.3rem 0.7rem; border: 1px solid var(--line); text-align: left; vertical-align: top; }
code { padding: 0.1em 0.3em; border-radius: 3px; background: var(--code); font-size: 0.88em; }
pre { padding: 0.8rem; border-radius: 4px; background: var(--code); overflow-x: auto; }
pre code { padding: 0; background: none; }
@media (min-width: 60rem) {
  nav { position: fixed; inset: 0 auto 0 0; width: 15rem; overflow-y: auto; }
  nav { border: 0; border-right: 1px solid var(--line); }
  main { margin-left: 18rem; }
}
"""


class Page(NamedTuple):
    """A page: its title, the headings of its sections with their anchors, and its content as HTML."""

    key: str
    title: str
    sections: list[tuple[str, str]]
    content: str


def build() -> str:
    """Return the web page of all pages, in the order of the contents."""
    names = [INDEX, *(f"manual/{name}" for name in re.findall(r"\]\(([\w-]+\.md)\)", _text(INDEX))), GUIDE]
    pages = [_page(name, names) for name in names]
    contents = "\n".join(_contents(page) for page in pages)
    sections = "\n".join(f'<section id="{page.key}">\n{page.content}</section>' for page in pages)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(pages[0].title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f"<nav>\n<ol>\n{contents}\n</ol>\n</nav>\n<main>\n{sections}\n</main>\n</body>\n</html>\n"
    )


def _text(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def _key(name: str) -> str:
    return Path(name).stem


def _slug(heading: str) -> str:
    """Return the anchor that GitHub gives a heading."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def _contents(page: Page) -> str:
    """Return the entry of a page in the table of contents."""
    items = "".join(f'<li><a href="#{anchor}">{html.escape(heading)}</a></li>' for heading, anchor in page.sections)
    inner = f"<ul>{items}</ul>" if items else ""
    return f'<li><a href="#{page.key}">{html.escape(page.title)}</a>{inner}</li>'


def _page(name: str, names: Sequence[str]) -> Page:
    parser = MarkdownIt("commonmark").enable("table")
    tokens = parser.parse(_text(name))
    title, sections = "", []
    for token, following in itertools.pairwise(tokens):
        if token.type == "heading_open":
            heading = "".join(child.content for child in following.children or ())
            anchor = f"{_key(name)}.{_slug(heading)}"
            token.attrSet("id", anchor)
            if token.tag == "h1":
                title = heading
            elif token.tag == "h2":
                sections.append((heading, anchor))
    for token in tokens:
        if token.children:
            token.children = _linked(token.children, name, names)
    return Page(_key(name), title, sections, parser.renderer.render(tokens, parser.options, {}))


def _linked(tokens: list[Token], name: str, names: Sequence[str]) -> list[Token]:
    """Return the tokens of a line with links to anchors of the page; what it does not contain is not linked."""
    kept, open_links = [], []
    for token in tokens:
        if token.type == "link_open":
            target = _target(str(token.attrGet("href")), name, names)
            open_links.append(target)
            if target is None:
                continue
            token.attrSet("href", target)
        elif token.type == "link_close":
            if open_links.pop() is None:
                continue
        elif token.type == "image":
            path = posixpath.normpath(posixpath.join(posixpath.dirname(name), str(token.attrGet("src"))))
            if not path.startswith("manual/images/"):
                continue
            token.attrSet("src", path.removeprefix("manual/"))
        kept.append(token)
    return kept


def _target(href: str, name: str, names: Sequence[str]) -> str | None:
    """Return where a link of a page leads in the web page; None if that does not contain it."""
    if "://" in href:
        return href
    path, _, anchor = href.partition("#")
    page = posixpath.normpath(posixpath.join(posixpath.dirname(name), path)) if path else name
    if page not in names:
        return None
    return f"#{_key(page)}.{anchor}" if anchor else f"#{_key(page)}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only compare with the file")
    if not parser.parse_args().check:
        OUT.write_text(build(), encoding="utf-8", newline="\n")
        return 0
    if OUT.is_file() and OUT.read_text(encoding="utf-8") == build():
        return 0
    print(f"{OUT} is not that of the present pages; run `make manual`.", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
