"""Links in README.md, CONTRIBUTING.md and docs/ lead to a file, and to a heading or mark in it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from helpers.tracking import ROOT

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def marks(page: Path) -> set[str]:
    """The anchors of a page, headings as GitHub names them."""
    text = page.read_text(encoding="utf-8")
    headings = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.M)
    named = {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in headings}
    return named | set(re.findall(r'id="([\w-]+)"', text))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for file, mark in re.findall(r"\]\(([^)#\s]*)#?([^)\s]*)\)", page.read_text(encoding="utf-8")):
        if file.startswith("http"):
            continue
        target = page.parent / file if file else page
        assert target.exists(), file
        assert not mark or mark in marks(target), f"{file}#{mark}"
