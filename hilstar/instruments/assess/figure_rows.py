"""Rows of a table of figures: an error budget's parts and limits, each with its unit."""

from collections.abc import Iterator
from typing import NamedTuple

from hilstar.instruments.assess.budget import Axes, Decomposed

COUNT = "1"  # the unit of counts and shares in the tables
PARTS = {"fov": "field-of-view error", "pixel": "pixel error", "noise": "noise"}


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


def limit_text(limit: Axes | None) -> str:
    """The smallest noise that a tracker's stars allow, in words."""
    if limit is None or limit.cross is None or limit.roll is None:
        return "not known"
    return (
        f"{limit.cross:.3g} arcsec across, {limit.roll:.3g} about the boresight (Cramer-Rao, one"
        " exposure at rest)"
    )
