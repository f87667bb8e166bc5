"""What a pupil lets through: its spiders, and the light of a tilted chief ray."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.optics.glass import zernike
from hilstar.optics.glass.zernike import Pupil, aperture, diffracted

# the pupil's samples are finer at its edge; measured 2e-4
AREA = 2e-3
FAST = {
    "aperture_mm": 30.0,
    "focal_length_mm": 50.0,
    "pixel_pitch_um": 10.0,
    "resolution_px": (2001, 1),
    "wavelengths_nm": (550.0,),
    "half_px": 2,
}


def test_a_spider_s_arms_shade_their_width_from_the_middle_to_the_edge():
    """Three arms of 1.5 mm over a radius of 15 mm, but for where they meet."""
    open_share = aperture(Pupil(**FAST)).mean()
    assert open_share == pytest.approx(math.pi / 4, rel=AREA)
    shaded = aperture(Pupil(**FAST, spiders=3, spider_width_mm=1.5)).mean()
    across = 1.5 / 30.0  # of the pupil's diameter, which is 1 here
    arms = 3 * across * 0.5
    meeting = 3 * across**2 / 4
    assert open_share - shaded == pytest.approx(arms, abs=meeting + AREA)


def test_light_falls_by_the_fourth_power_of_the_cosine_of_the_field_angle(monkeypatch):
    """1000 px of 10 um behind 50 mm: 11.3 degrees. Without the diffraction, which takes seconds."""
    monkeypatch.setattr(zernike, "PupilField", lambda pupil: lambda *at: None)
    monkeypatch.setattr(zernike, "psf_of", lambda *of: (np.ones((3, 3)), 0.0))
    stack = diffracted(Pupil(**FAST, points=2), per_px=16)
    assert set(stack.at[:, 0]) == {0.0, 2000.0}
    np.testing.assert_allclose(stack.facts[:, 0], np.cos(np.arctan(10.0 / 50.0)) ** 4)
