"""What people call bright stars: Bayer's letters, Flamsteed's numbers and proper names, by HIP number."""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path
from typing import NamedTuple

STAR_NAMES = Path(__file__).resolve().parent / "data" / "star_names.csv"


class StarName(NamedTuple):
    """A star's designation ("α Ori", "51 Peg") and its proper name ("Betelgeuse"), each "" where it has none."""

    designation: str
    name: str


@cache
def star_names() -> dict[int, StarName]:
    """The designations and names of 3300 stars by HIP number (see `data/make_star_names.py`)."""
    with STAR_NAMES.open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(line for line in file if not line.startswith("#"))
        return {int(row["hip"]): StarName(row["designation"], row["name"]) for row in rows}


def label_of(hip: int) -> str:
    """What a chart writes beside a star: its designation, else its name, else its HIP number; "" without one."""
    designation, name = star_names().get(hip, ("", ""))
    return designation or name or (f"HIP {hip}" if hip else "")
