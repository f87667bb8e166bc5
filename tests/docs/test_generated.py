"""Pages and tables that are made by a script are what the script makes now."""

from __future__ import annotations

import importlib

import pytest

from tests.support.benches import ROOT


@pytest.fixture
def pages(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    return importlib.import_module("make_pages").PAGES


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "results")
    return importlib.import_module("tables")


def test_a_generated_page_is_what_the_generator_makes(pages):
    """`python docs/make_pages.py` has nothing to change."""
    assert pages
    for name, make in pages.items():
        assert (ROOT / "docs" / name).read_text() == make(), f"docs/{name} is old; run python docs/make_pages.py"


def test_the_tables_are_those_of_the_results(tables):
    """`python results/tables.py` has nothing to change, and each table is on some page."""
    texts = [path.read_text() for path in tables.pages()]
    for path, text in zip(tables.pages(), texts, strict=True):
        assert tables.with_tables(text) == text, f"{path} has old tables; run python results/tables.py"
    for name in tables.TABLES:
        assert any(f"<!-- table: {name} -->\n| " in text for text in texts)
    marks = sum(text.count("<!-- table: ") for text in texts)
    filled = sum(text.count(f"<!-- table: {name} -->\n| ") for text in texts for name in tables.TABLES)
    assert marks == filled
