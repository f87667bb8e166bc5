"""Charts of tests that look at none: neither laid out nor drawn, which takes a third of a
calibration's time.

Their axes and texts are made, so that a product that cannot make them fails. Commands that are
`Started` meanwhile (tests/support/forks.py) draw none either.
"""

from __future__ import annotations

import base64
import sys
from typing import TYPE_CHECKING, Any
from unittest import mock

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CHARTS = "hilstar.basics.charts"
SVG = "<svg></svg>"
# one grey pixel
PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGNoAAAAggCBd81ytgAAAABJRU5ErkJggg=="
)


def charts_left_out() -> mock._patch[Any]:
    """A context within which no chart is laid out, and each picture of one is empty; `start`
    begins it for good.
    """
    return mock.patch.multiple(CHARTS, finish=lay_nothing_out, svg=empty_svg, png=empty_png)


def are_charts_left_out() -> bool:
    """Whether this process draws none now."""
    charts = sys.modules.get(CHARTS)
    return getattr(charts, "finish", None) is lay_nothing_out


def lay_nothing_out(figure: Figure) -> None:
    """In the place of `charts.finish`."""


def empty_svg(figure: Figure) -> str:
    """In the place of `charts.svg`."""
    return SVG


def empty_png(figure: Figure) -> bytes:
    """In the place of `charts.png`."""
    return PNG
