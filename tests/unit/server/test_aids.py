"""What lies over the sky without a screen: the same as a screen's shader makes (tests/screen
holds that to the same oracle).
"""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.display.render.aids import lay_over, level_of_code
from hilstar.display.response import Response
from hilstar.server.operator import PATCHES, SWITCHES, Aids
from tests.support.x11.screens import lines_over

LINE = 96
CROSS_PX = (320, 240)


def levels() -> np.ndarray:
    made = np.zeros((480, 640), dtype=np.uint8)
    made[100, 20:600] = 200  # crosses lines, and is brighter
    made[300, 400] = 30
    return made


@pytest.mark.parametrize("keys", ["g", "c", "gc"])
def test_lines_are_laid_over_levels_and_leave_what_is_brighter(keys):
    aids = Aids()
    for key, name in (("g", "grid"), ("c", "crosshair")):
        aids.set(name, key in keys)
    changed = levels()
    lay_over(changed, aids.overlay, 0, LINE, CROSS_PX)
    wanted = lines_over(np.repeat(levels()[:, :, None], 3, axis=2), keys)[:, :, 0]
    assert np.array_equal(changed, wanted)
    assert changed[100].max() == 200


def test_a_blank_hides_a_patch_and_a_bright_patch_has_dark_lines():
    aids = Aids()
    aids.set("patch", True, 0.5)
    aids.set("crosshair", True)
    changed = levels()
    lay_over(changed, aids.overlay, 128, LINE, CROSS_PX)
    assert set(np.unique(changed)) == {0, 128}
    assert (changed[240] == 0).all() and (changed[:, 320] == 0).all() and changed[0, 0] == 128
    aids.set("blank", True)
    lay_over(changed, aids.overlay, 128, LINE, CROSS_PX)
    assert set(np.unique(changed)) == {0, LINE}


def test_the_level_of_a_grey_code_is_found_among_stolen_bits():
    triples = np.array([[0, 0, 0], [0, 0, 1], [1, 1, 1], [1, 2, 1], [2, 2, 2]], dtype=np.uint16)
    response = Response(8, np.linspace(0, 1, 5), np.linspace(0.1, 0.9, 4), rgb=triples)
    assert [level_of_code(response, code) for code in (0, 1, 2)] == [0, 2, 4]


def test_switches_are_known_by_name_and_in_words():
    aids = Aids()
    for name in SWITCHES:
        aids.set(name, True, 0.5)
    assert all(aids.states().values())
    assert aids.text == "blank, grid, crosshair, patch 50%, pause"
    for name in SWITCHES:
        aids.set(name, False)
    assert aids.text == "" and aids.shows_sky and not aids.overlay


def test_a_patch_steps_through_its_shares_of_white_and_turns_off():
    aids, shown = Aids(), []
    for _ in range(2 * len(PATCHES) + 2):
        aids.toggle("patch")
        shown.append(aids.patch_share if aids.is_on("patch") else None)
    assert shown == [*PATCHES, None] * 2
