"""Pages and tables that are made by a script are what the script makes now."""

from __future__ import annotations

import importlib
import re

import pytest

import hilstar
from tests.support.benches import ROOT
from tests.support.readme import blocks


@pytest.fixture
def pages(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools")
    return importlib.import_module("make_pages").PAGES


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "results")
    return importlib.import_module("tables")


def test_a_generated_page_is_what_the_generator_makes(pages):
    """`python tools/make_pages.py` has nothing to change."""
    assert pages
    for name, make in pages.items():
        assert (ROOT / "docs" / name).read_text() == make(), (
            f"docs/{name} is old; run python tools/make_pages.py"
        )


def test_the_tables_are_those_of_the_results(tables):
    """`python results/tables.py` has nothing to change, and each table is on some page."""
    texts = [path.read_text() for path in tables.pages()]
    for path, text in zip(tables.pages(), texts, strict=True):
        assert tables.with_tables(text) == text, (
            f"{path} has old tables; run python results/tables.py"
        )
    for name in tables.TABLES:
        assert any(f"<!-- table: {name} -->\n| " in text for text in texts)
    marks = sum(text.count("<!-- table: ") for text in texts)
    filled = sum(
        text.count(f"<!-- table: {name} -->\n| ") for text in texts for name in tables.TABLES
    )
    assert marks == filled


def test_the_citation_names_this_version_and_the_authors_of_the_licence():
    text = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {hilstar.__version__}\n" in text
    assert "the hilstar authors" in text and "the hilstar authors" in (ROOT / "LICENSE").read_text()


def test_the_image_of_the_examples_is_made_as_readme_s_first_command_says():
    """What README has installed by apt and pip, the Dockerfile installs, and no more by apt."""
    readme = blocks("sh")[0]
    packages = re.search(r"apt-get install -y ([^;]+);", readme)
    text = (ROOT / "examples" / "Dockerfile").read_text()
    assert (
        packages is not None
        and f"apt-get install -y --no-install-recommends {packages[1]} " in text
    )
    assert 'CMD ["hilstar", "demo"]' in text and "hilstar demo" in readme
    workflow = (ROOT / "examples" / "ci-github.yml").read_text()
    assert packages[1] in workflow and "verify project/bench.toml --strict" in workflow
