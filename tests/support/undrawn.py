"""Charts of tests that look at none: neither laid out nor drawn, which takes a third of a
calibration's time.

Their axes and texts are made, so that a product that cannot make them fails. Commands that are
`Started` meanwhile (tests/support/forks.py) draw none either.
"""

from __future__ import annotations

import base64
import sys
from typing import IO, TYPE_CHECKING, Any
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
    """A context within which each chart is empty as it is finished; `start` begins it for good."""
    return mock.patch(f"{CHARTS}.finish", leave_empty)


def are_charts_left_out() -> bool:
    """Whether this process draws none now."""
    charts = sys.modules.get(CHARTS)
    return getattr(charts, "finish", None) is leave_empty


def leave_empty(figure: Figure) -> None:
    """In the place of `charts.finish`: no layout, and a picture of nothing whoever asks for it."""
    vars(figure)["savefig"] = save_nothing


def save_nothing(file: IO[Any], *, format: str, **_: object) -> None:
    """In the place of a figure's `savefig`."""
    if format == "svg":
        file.write(SVG)
    else:
        file.write(PNG)
