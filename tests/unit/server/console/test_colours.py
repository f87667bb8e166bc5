"""The page's colours can be told apart and read: contrast by WCAG 2.2, and for who sees two
colours (Viénot 1999).
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from hilstar.basics.palette import THEMES, colours_of

TEXT, GRAPHIC = 4.5, 3.0  # WCAG 2.2, 1.4.3 (AA) and 1.4.11
MIN_CURVES_APART = 12.0  # CIE 1976 dE of two curves in a chart; 2.3 is just seen, side by side
READ = [
    *(
        (ink, ground)
        for ink in ("text", "muted", "accent", "ok", "warn", "bad")
        for ground in ("ground", "panel", "raised")
    ),
    ("ok", "ok-ground"),
    ("text", "ok-ground"),
    ("bad-text", "bad-ground"),
    ("on-accent", "accent"),
    ("sky-text", "sky-ground"),
]
SEEN = [
    *((ink, "panel") for ink in ("series-1", "series-2", "series-3", "ok", "warn", "bad", "edge")),
    *((ink, "sky-ground") for ink in ("sky-field", "sky-star", "sky-moving")),
]
# Linear sRGB as a protanope and a deuteranope see it: Viénot, Brettel and Mollon 1999, as
# normalised for sRGB by DaltonLens.
DICHROMATS = {
    "protan": [[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]],
    "deutan": [[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]],
    "all cones": np.eye(3).tolist(),
}
# sRGB, IEC 61966-2-1
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def themes() -> dict[str, dict[str, np.ndarray]]:
    """Linear sRGB of each plain colour of the palette, by theme."""
    plain = {}
    for theme in THEMES:
        colours = colours_of(theme).items()
        plain[theme] = {
            name: linear(colour[1:]) for name, colour in colours if colour.startswith("#")
        }
    # The light theme has every colour of the dark one: what it lacked would stay dark.
    assert plain["dark"].keys() == plain["light"].keys()
    return plain


def linear(value: str) -> np.ndarray:
    part = np.array([int(value[k : k + 2], 16) / 255 for k in (0, 2, 4)])
    return np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)


def contrast(a: np.ndarray, b: np.ndarray) -> float:
    light, dark = sorted((float(TO_XYZ[1] @ one) for one in (a, b)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def lab(colour: np.ndarray) -> np.ndarray:
    x, y, z = np.cbrt(TO_XYZ @ np.clip(colour, 0, 1) / TO_XYZ.sum(axis=1))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_text_and_curves_stand_out_from_what_is_behind_them(theme):
    colours = themes()[theme]
    weak = {
        f"{ink} on {ground}": round(ratio, 2)
        for pairs, wanted in ((READ, TEXT), (SEEN, GRAPHIC))
        for ink, ground in pairs
        if (ratio := contrast(colours[ink], colours[ground])) < wanted
    }
    assert not weak


@pytest.mark.parametrize("theme", ["dark", "light"])
@pytest.mark.parametrize("sight", DICHROMATS)
def test_curves_of_a_chart_are_told_apart_by_everyone(theme, sight):
    colours = themes()[theme]
    seen = [lab(np.array(DICHROMATS[sight]) @ colours[f"series-{k}"]) for k in (1, 2, 3)]
    apart = [round(float(np.linalg.norm(a - b)), 1) for a, b in combinations(seen, 2)]
    assert min(apart) > MIN_CURVES_APART, apart
