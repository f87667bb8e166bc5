"""The stars of a telemetry table: in each row those of an answer, `star1_x_px`, `star1_y_px`,
`star2_x_px`, ...; or one star in each row, `star_x_px`, `star_y_px`, with the rows of one answer
together.

Of a star's other columns none is needed: `_dn`, or `_mag` in its place, `_hip` and `_width_px`. A
file of its own, as telemetry.py is of answers and knows nothing of a star's columns.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hilstar.basics.errors import InputError
from hilstar.basics.text_tables import (
    Chosen,
    TextTable,
    finite_numbers,
    is_no_number,
    plain_name,
)
from hilstar.basics.units import flux_ratio

PARTS = ("x_px", "y_px", "dn", "hip", "width_px")  # of a star, in the order of its row
MAGNITUDE, MAX_MAGNITUDE = "mag", 100.0
SIGNALS = ("dn", "flux", "adu", "counts", "signal", "intensity")  # what people call DN
# a place in another unit is refused; another ending, such as _sigma, is no place
PLACE_COLUMN = re.compile(
    r"(star|centroid)_?(\d*)_[xy](?:_(px|m|mm|um|rad|mrad|deg|arcmin|arcsec))?"
)
ADVICE = "leave the cells of a star blank where an answer has none"


@dataclass(frozen=True, slots=True)
class StarGroup:
    """The columns of a star: PARTS, and the magnitude that may stand for its signal."""

    name: str
    parts: list[Chosen | None]
    magnitude: Chosen | None


class StarColumns:
    """The columns of stars of a table. `one_a_row` is True where each row has one star.

    Raises InputError for a star with one of x and y alone or with a signal and a magnitude, for a
    place in another unit than pixels, for two names of one star, and for numbered stars beside
    unnumbered ones.
    """

    def __init__(self, table: TextTable) -> None:
        self._table = table
        words = set(_words(table))
        numbers = sorted({number for _, number in words}, key=lambda number: int(number or 0))
        self.one_a_row = "" in numbers
        if len(words) > len(numbers):
            raise table.refusal(table.header_line, f"two names of one star ({table.names})")
        if self.one_a_row and len(numbers) > 1:
            fault = f"columns of one star a row beside numbered ones ({table.names})"
            raise table.refusal(table.header_line, fault)
        word_of = {number: word for word, number in words}
        self._groups = [_group_of(table, word_of[number], number) for number in numbers]

    def of_row(self, path: Path, line: int, cells: list[str]) -> list[list[float | None]]:
        """The stars of a row, [x_px, y_px, dn, hip, width_px] with None for what is not known.
        Raises InputError for a cell that is no number, and for one of x and y alone.
        """
        stars = []
        for group in self._groups:
            texts = [self._table.cell(cells, chosen) for chosen in group.parts]
            if all(map(is_no_number, texts[:2])):
                continue
            names = [f"{group.name}_{part}" for part in PARTS]
            star: list[float | None] = [*finite_numbers(path, line, names[:2], texts[:2], ADVICE)]
            for name, text in zip(names[2:], texts[2:], strict=True):
                star.append(_known(path, line, name, text))
            magnitude_text = self._table.cell(cells, group.magnitude)
            magnitude_name = f"{group.name}_{MAGNITUDE}"
            magnitude = _known(path, line, magnitude_name, magnitude_text)
            if magnitude is not None:
                if abs(magnitude) > MAX_MAGNITUDE:
                    fault = f"{magnitude_name} = {magnitude:g} is no magnitude"
                    raise InputError(f"{path}:{line}: {fault}; {ADVICE}")
                star[2] = flux_ratio(magnitude)
            stars.append(star)
        return stars


def _known(path: Path, line: int, name: str, text: str) -> float | None:
    """The number of a cell, None where it has none."""
    if is_no_number(text):
        return None
    return finite_numbers(path, line, [name], [text], ADVICE)[0]


def _words(table: TextTable) -> Iterator[tuple[str, str]]:
    """The word and the number, "" for one a row, of each star whose place a table has. Raises
    InputError for a place that is not in pixels.
    """
    for column in table.columns:
        match = PLACE_COLUMN.fullmatch(plain_name(column.name))
        if match is None:
            continue
        if match[3] not in (None, "px"):
            fault = f"column {column.header} is in {match[3]!r}, and px is wanted"
            raise table.refusal(table.header_line, fault)
        yield match[1], match[2]


def _group_of(table: TextTable, word: str, number: str) -> StarGroup:
    name = f"{word}{number}"

    def part(key: str) -> Chosen | None:
        bare = key.removesuffix("_px")
        # a place on a detector is in pixels, stated or not
        return table.chosen(
            f"{name}_{key}", other_names=(f"{word}_{number}_{bare}",), must_state=False
        )

    signals = [signal for key in SIGNALS if (signal := part(key)) is not None]
    magnitude = table.chosen(f"{name}_{MAGNITUDE}") or table.chosen(f"{word}_{number}_{MAGNITUDE}")
    if len(signals) + (magnitude is not None) > 1:
        fault = f"{name} has several signals; keep one of {', '.join(SIGNALS)} and {MAGNITUDE}"
        raise table.refusal(table.header_line, fault)
    parts = [part(key) for key in PARTS]
    if parts[0] is None or parts[1] is None:
        raise table.refusal(table.header_line, f"of {name} both x and y are needed")
    if signals:
        parts[2] = signals[0]
    return StarGroup(name, parts, magnitude)
