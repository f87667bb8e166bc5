"""Pages in one file as their reader sees them: each card's lines, and the figures that are drawn."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from html.parser import HTMLParser
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from hilstar.basics import charts

CELL = " | "
LINE_ENDS = frozenset({"tr", "p", "li", "summary", "h1", "h2", "strong", "small", "div"})
HIDDEN = frozenset({"style", "script", "title"})
BAND = "band"  # what stands above the first card


class _Lines(HTMLParser):
    """Collects the lines of each card."""

    def __init__(self) -> None:
        super().__init__()
        self.cards: dict[str, list[str]] = {BAND: []}
        self._title = BAND
        self._text = ""
        self._hidden = 0
        self._in_title = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._hidden += tag in HIDDEN
        if tag in {"section", "small"}:
            self._end_line()
        self._in_title |= tag == "h2"

    def handle_data(self, data: str) -> None:
        if not self._hidden:
            self._text += data

    def handle_endtag(self, tag: str) -> None:
        self._hidden -= tag in HIDDEN
        if tag == "h2":
            self._title = self._text.strip()
            self._text = ""
            self.cards[self._title] = []
        elif tag in {"td", "th"}:
            self._text += CELL
        elif tag in LINE_ENDS:
            self._end_line()
        elif tag == "section":
            self._end_line()
            self._title = BAND

    def _end_line(self) -> None:
        line = self._text.strip()
        if line:
            self.cards[self._title].append(line.removesuffix(CELL.strip()).strip())
        self._text = ""


def card_lines(page: str) -> dict[str, list[str]]:
    """The lines of each card by its title, cells between CELL; those above all cards in BAND."""
    lines = _Lines()
    lines.feed(page)
    lines.close()
    return lines.cards


@contextmanager
def drawn_figures() -> Iterator[list[Figure]]:
    """The figures of pages and charts, neither laid out nor written: that takes a second each."""
    drawn: list[Figure] = []

    def kept(figure: Figure, path: Path | None = None) -> str:
        drawn.append(figure)
        return "<svg/>"

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(charts, "svg", kept)
        patch.setattr(charts, "save", kept)
        patch.setattr(charts, "finish", lambda figure: None)
        yield drawn
