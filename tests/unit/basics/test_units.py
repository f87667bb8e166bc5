"""Magnitudes and fluxes: Pogson's law, both ways, of a number and of an array."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.basics.units import COMPUTE_VERSION, GL_VERSIONS, flux_ratio, magnitude


def test_five_magnitudes_are_a_hundredth_and_no_light_has_none():
    for mag, ratio in ((0.0, 1.0), (5.0, 0.01), (-2.5, 10.0)):
        assert flux_ratio(mag) == pytest.approx(ratio)
        assert magnitude(ratio) == pytest.approx(mag)
    assert magnitude(0.0) == math.inf
    assert magnitude(np.array([0.01, 0.0])).tolist() == [5.0, math.inf]


def test_the_newest_opengl_is_asked_for_first_and_compute_shaders_are_of_one_of_them():
    """From 4.3 on OpenGL has compute shaders (Khronos' registry)."""
    assert list(GL_VERSIONS) == sorted(GL_VERSIONS, reverse=True)
    assert COMPUTE_VERSION == 430
    assert divmod(COMPUTE_VERSION // 10, 10) in GL_VERSIONS
