"""What a chart of the brightness models says."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """A chart, by the stem of its files, and what it says."""

    figure: str
    text: str
