"""What a pupil lets through: its spiders, and the light of a tilted chief ray."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.optics.glass import zernike
from hilstar.optics.glass.zernike import (
    MAX_STEP_WAVES,
    PUPIL,
    Pupil,
    PupilField,
    Term,
    aperture,
    diffracted,
)
from tests.support.refusals import refusal

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


SEIDEL = {
    "W020": lambda h, x, y: x**2 + y**2,
    "W040": lambda h, x, y: (x**2 + y**2) ** 2,
    "W131": lambda h, x, y: h * (x**2 + y**2) * y,
    "W222": lambda h, x, y: h**2 * y**2,
    "W220": lambda h, x, y: h**2 * (x**2 + y**2),
}


@pytest.mark.parametrize("kind", SEIDEL)
@pytest.mark.parametrize("h", [0.25, 1.0])
def test_a_wavefront_is_hopkins_s_of_its_coefficient(kind, h):
    """W_klm h^k rho^l cos(phi)^m (Hopkins 1950), h the field over its edge, phi from the direction
    of the field; a coefficient changes by `per_nm` for each nm over the reference's.
    """
    size = (1001, 1201)
    term = Term(kind=kind, nm=90.0, per_nm=0.2)
    pupil = Pupil(**FAST | {"resolution_px": size, "terms": (term,), "reference_nm": 500.0})
    field = PupilField(pupil)(np.array([0.0, h * np.hypot(*size) / 2]), 550.0, 0.0)
    at = zernike.pupil_places(zernike.PUPIL)
    x, y = np.meshgrid(at, at)
    lit = np.abs(field) > 0
    wave_nm = (90.0 + 0.2 * 50.0) * SEIDEL[kind](h, x, y)[lit]
    np.testing.assert_allclose(np.angle(field[lit]) * 550.0 / (2 * np.pi), wave_nm, atol=1e-9)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("along", [(1.0, 0.0), (0.0, 1.0)], ids=["right", "down"])
def test_a_wavefront_too_steep_for_the_pupil_s_samples_is_refused_either_way(sign, along):
    """Coma at the field's edge, rho^2 y: along the field it changes by at most 3 of its
    coefficient a radius, all one way, and by a third of that across.
    """
    waves_a_coefficient = 3 * 2 / PUPIL  # from one sample to the next
    size = (1001, 1201)
    edge_px = np.array(along) * np.hypot(*size) / 2

    def field_of(step_waves: float):
        nm = sign * step_waves / waves_a_coefficient * 550.0
        pupil = Pupil(**FAST | {"resolution_px": size, "terms": (Term(kind="W131", nm=nm),)})
        return PupilField(pupil)

    line = refusal(field_of(1.2 * MAX_STEP_WAVES), edge_px, 550.0, 0.0)
    assert "waves from one of 256 pupil samples to the next" in line
    field = field_of(0.9 * MAX_STEP_WAVES)(edge_px, 550.0, 0.0)
    assert np.isfinite(field).all()
