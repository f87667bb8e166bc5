"""A link or a picture in a page leads to a file of the checkout, and to a heading that is there."""

from __future__ import annotations

import pytest

from tests.docs.pages import links_of, slugs_of
from tests.support.benches import ROOT

FOLDERS = ("", "configs", "docs", "examples", "firmware_protocol")
PAGES = sorted(page for folder in FOLDERS for page in (ROOT / folder).glob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_links_lead_somewhere(page):
    for link in links_of(page.read_text()):
        if "://" in link:
            continue
        name, _, heading = link.partition("#")
        target = page.parent / name if name else page
        assert target.exists(), link
        assert ROOT in [
            target.resolve(),
            *target.resolve().parents,
        ], f"{link} leads out of the checkout"
        if heading:
            assert heading in slugs_of(target.read_text()), link


def test_there_are_pages_and_links():
    assert len(PAGES) > 15
    assert sum(len(links_of(page.read_text())) for page in PAGES) > 50
