"""No table of a page is torn: what looks like a row is one."""

import re
from pathlib import Path

import markdown
import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    [
        *ROOT.glob("docs/*.md"),
        *ROOT.glob("*.md"),
        *ROOT.glob("[!.]*/README.md"),
        *ROOT.glob("configs/*.md"),
    ]
)


def torn_rows(text: str) -> list[str]:
    """The paragraphs of a page that begin as a table's row: a blank line before them ended their
    table.
    """
    page = markdown.markdown(text, extensions=["tables", "fenced_code"])
    return re.findall(r"<(?:p|li)>\|[^\n]{0,80}", page)


def test_a_row_behind_a_blank_line_is_found() -> None:
    assert torn_rows("| a | b |\n|---|---|\n| 1 | 2 |\n\n| 3 | 4 |\n") == ["<p>| 3 | 4 |</p>"]
    assert torn_rows("| a | b |\n|---|---|\n| 1 | 2 |\n") == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_no_table_is_torn(page: Path) -> None:
    assert torn_rows(page.read_text()) == []
