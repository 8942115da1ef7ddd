"""The manual's links, pictures and names of buttons."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MANUAL = ROOT / "docs" / "manual"
PAGES = sorted(MANUAL.glob("*.md"))
LARGEST = 300_000
WORDS = {"Capture", "Mask", "Reconstruction", "Splat", "Floater", "X", "+"}
"""Bold words that are not the text of a button: those of the glossary, and symbols."""


def links_of(text: str) -> list[str]:
    return [link for link in re.findall(r"\]\(([^)]+)\)", text) if "://" not in link]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_and_pictures_exist(page):
    for link in links_of(page.read_text(encoding="utf-8")):
        path, _, anchor = link.partition("#")
        target = page.parent / path
        assert target.is_file(), link
        if anchor:
            headings = re.findall(r"^#+ (.+)$", target.read_text(encoding="utf-8"), re.M)
            assert anchor in {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}, link


def test_pictures_are_used_and_small():
    used = {MANUAL / link for page in PAGES for link in links_of(page.read_text(encoding="utf-8"))}
    pictures = set((MANUAL / "images").iterdir())
    assert pictures <= used
    assert all(picture.stat().st_size < LARGEST for picture in pictures)


def test_web_page_is_that_of_the_pages_and_has_all_that_it_links_to():
    check = [sys.executable, str(MANUAL.parent / "build_manual.py"), "--check"]
    assert subprocess.run(check, check=False).returncode == 0
    page = (MANUAL / "manual.html").read_text(encoding="utf-8")
    anchors = re.findall(r' id="([^"]+)"', page)
    assert len(anchors) == len(set(anchors))
    links = re.findall(r' href="([^"]+)"', page)
    assert {link for link in links if "://" not in link} <= {f"#{anchor}" for anchor in anchors}
    assert len(links) > 50
    pictures = {MANUAL / path for path in re.findall(r' src="([^"]+)"', page)}
    assert pictures == set((MANUAL / "images").iterdir())


def test_every_page_is_in_the_contents():
    links = links_of((MANUAL / "index.md").read_text(encoding="utf-8"))
    assert {page.name for page in PAGES} - {"index.md", "store.md"} <= set(links)


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "store.md"], ids=lambda page: page.stem)
def test_buttons_have_these_names(page):
    sources = "\n".join(
        path.read_text(encoding="utf-8")
        for folder in ("operators", "objectgs_addon")
        for path in (ROOT / folder).rglob("*.py")
    )
    names = set(re.findall(r"\*\*([^*]+)\*\*", page.read_text(encoding="utf-8").replace("\n", " ")))
    assert not {name for name in names - WORDS if f'"{name}"' not in sources and f'"{name}...' not in sources}
