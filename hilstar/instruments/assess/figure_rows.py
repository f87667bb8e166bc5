"""Rows of a table of figures: an error budget's parts and limits, each with its unit."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from hilstar.basics.pages import key_name, table_of, value_text, within
from hilstar.instruments.assess.budget import Axes, Decomposed

COUNT = "1"  # the unit of counts and shares in the tables
PARTS = {"fov": "field-of-view error", "pixel": "pixel error", "noise": "noise"}


# What the quantities of shares have in their names.
SHARES = ("availability", "share", "probability", "scale")
AXIS_WORDS = {"cross": "across", "roll": "about the boresight", "z": "about the boresight"}


class FigureRow(NamedTuple):
    """A row of budget.csv, here and in a campaign's directory: None is an empty cell."""

    quantity: str
    axis: str
    value: float | int | None
    unit: str = COUNT
    low_95: float | None = None
    high_95: float | None = None


def part_rows(parts: Decomposed | None, noise_arcsec: Axes) -> Iterator[FigureRow]:
    """The rows of bias, field-of-view error, pixel error and noise; without values where `parts`
    is None.
    """
    for k, axis in enumerate("xyz"):
        if parts is None:
            value = None
        else:
            value = float(parts.bias_arcsec[k])
        yield FigureRow(
            "bias",
            axis,
            value,
            "arcsec",
            *([] if parts is None else parts.intervals.bias[:, k].tolist()),
        )
    for part, name in PARTS.items():
        if part == "noise" or parts is None:
            axes = noise_arcsec
        else:
            axes = getattr(parts, f"{part}_arcsec")
        for k, axis in enumerate(("cross", "roll")):
            value = getattr(axes, axis)
            if parts is None or value is None:
                ends = []
            else:
                ends = getattr(parts.intervals, part)[:, k].tolist()
            yield FigureRow(name, axis, value, "arcsec", *ends)


def limit_rows(limit: Axes | None) -> Iterator[FigureRow]:
    """The rows of the smallest noise that the tracker's stars allow."""
    for axis in ("cross", "roll") if limit is not None else ():
        yield FigureRow("limit of the tracker's stars", axis, getattr(limit, axis), "arcsec")


def row_text(row: FigureRow) -> str | None:
    """A row's value with its interval and unit; shares as percent."""
    if row.value is None:
        return None
    is_share = row.unit == COUNT and any(share in row.quantity for share in SHARES)
    if row.low_95 is not None and row.high_95 is not None:
        if is_share:
            return within(100 * row.value, 100 * row.low_95, 100 * row.high_95, "%")
        return within(row.value, row.low_95, row.high_95, row.unit)
    if row.unit != COUNT:
        return value_text(row.value, unit=row.unit)
    if is_share:
        return f"{100 * row.value:.4g} %"
    return value_text(row.value)


def figures_table(rows: Iterable[FigureRow]) -> str:
    """The rows as a page has them: quantity, axis, value with its interval."""
    cells = []
    for row in rows:
        cells.append((key_name(row.quantity), AXIS_WORDS.get(row.axis, row.axis), row_text(row)))
    return table_of(cells, ("quantity", "axis", "value, and its 95 % interval"))


def limit_text(limit: Axes | None) -> str:
    """The smallest noise that a tracker's stars allow, in words."""
    if limit is None or limit.cross is None or limit.roll is None:
        return "not known"
    return (
        f"{limit.cross:.3g} arcsec across, {limit.roll:.3g} about the boresight (Cramer-Rao, one"
        " exposure at rest)"
    )
