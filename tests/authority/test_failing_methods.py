"""Where a method fails on every machine: hilstar is right, the method named is not, and the
tables that ship say so.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.rotation import direction_of
from hilstar.instruments.study import stability
from hilstar.instruments.study.stability import recorded
from hilstar.optics.camera import Camera
from hilstar.sky.electrons import tabulate
from tests.authority.failing_methods import (
    CATALOGUE_AND_GEOMETRY,
    CURVES,
    DETECTOR_AND_ATTITUDE,
    field,
    sky,
)
from tests.support.claims import holds

CASES = (*CATALOGUE_AND_GEOMETRY, *DETECTOR_AND_ATTITUDE)
# A failing method's figure is no matter of rounding; hilstar's own is, and is held by its
# tolerance.
FAULT_SHARE = 0.01


@pytest.fixture(scope="module")
def tables():
    """The cases that ship, by name."""
    return {
        case.case: case
        for name in ("catalogue_and_geometry", "detector_and_attitude")
        for case in recorded(name)
    }


@pytest.mark.parametrize("measure", CASES, ids=lambda measure: measure.__name__)
def test_hilstar_is_right_where_the_method_named_there_is_not(measure, tables):
    case = measure()
    assert case.right, case
    assert not case.figures.fault <= case.figures.tolerance, case
    assert all((case.case, case.method, case.fails, case.happens, case.why))
    theirs = replace(case, figures=replace(case.figures, error=case.figures.fault))
    assert not theirs.right
    shipped = tables[case.case]
    assert (shipped.method, shipped.why, shipped.right) == (case.method, case.why, True)
    assert shipped.figures.tolerance == case.figures.tolerance
    assert shipped.figures.fault == pytest.approx(case.figures.fault, rel=FAULT_SHARE, nan_ok=True)


def test_the_tables_that_ship_have_every_case(tables):
    assert len(tables) == len(CASES)


@pytest.mark.parametrize("name", CURVES)
def test_the_curves_that_ship_are_those_measured(name):
    """Errors of rounding may differ, those of a method may not."""
    path = Path(stability.__file__).with_name(f"{name}.csv")
    columns = CURVES[name]()
    shipped = np.loadtxt(path, delimiter=",", skiprows=1).T
    assert path.read_text().splitlines()[0] == ",".join(
        f'"{each}"' if "," in each else each for each in columns
    )
    for before, now in zip(shipped, columns.values(), strict=True):
        assert before == pytest.approx(now, rel=FAULT_SHARE, abs=field.ANGLE_ARCSEC)


class WeakCamera(Camera):
    """One depth for every star."""

    def project(self, image_vectors):
        x, y = (
            image_vectors[:, axis] * self.focal_length_px + self.principal_point_px[axis]
            for axis in (0, 1)
        )
        return x, y


def weak_camera(resolution_px, pixel_pitch_um, focal_length_mm, _alignment):
    middle = ((resolution_px[0] - 1) / 2, (resolution_px[1] - 1) / 2)
    return WeakCamera(resolution_px, focal_length_mm * 1e3 / pixel_pitch_um, middle, np.eye(3))


def by_right_ascension(catalog, epoch_jyear):
    """Eq. 2.1 as it stands."""
    years = epoch_jyear - field.HIPPARCOS_EPOCH_JYEAR
    ra_deg = catalog.ra_deg + catalog.pm_ra_cosdec_mas_yr * years / 3.6e6
    dec_deg = catalog.dec_deg + catalog.pm_dec_mas_yr * years / 3.6e6
    return direction_of(ra_deg, dec_deg)


def averaged(_model, optics, photometry):
    return tabulate("ags", optics, photometry)


def taken_as_it_is(_message):
    return AttitudeSample(1, field.START)


# What a place would say if hilstar did as the method that fails there: the module's road is
# replaced by it.
WRONG_ROADS = (
    (field.two_signs, "slerp", field.arccos_slerp),
    (field.antipodal, "slerp", field.arccos_slerp),
    (field.half_turn, "slerp", field.straight_line),
    (field.not_a_number, "decode", taken_as_it_is),
    (field.motion_at_pole, "unit_vectors_icrs", by_right_ascension),
    (field.stars_behind, "monitor_camera", weak_camera),
    (field.weak_perspective, "monitor_camera", weak_camera),
    (sky.temperature_range, "tabulate", averaged),
    (sky.nan_pixel, "find_stars", len),
)


@pytest.mark.parametrize(
    ("visit", "name", "method"), WRONG_ROADS, ids=lambda value: getattr(value, "__name__", "")
)
def test_a_verdict_is_wrong_where_hilstar_goes_the_failing_way(visit, name, method, monkeypatch):
    monkeypatch.setitem(visit.__globals__, name, method)
    place = visit()
    assert not place.right, place


def test_weak_perspective_errs_by_half_the_angle_cubed():
    """tan - sin = angle^3 / 2 + angle^5 / 8 ..., so 0.1 % at 3 degrees."""
    off_px, off_arcsec = field.weak_perspective_error(np.array([3.0]))
    angle = math.radians(3.0)
    assert off_px[0] == pytest.approx(-350e3 / 57.65 * angle**3 / 2, rel=2e-3)
    assert off_arcsec[0] == pytest.approx(-math.degrees(angle**3 / 2) * 3600, rel=6e-3)
    far_px = field.weak_perspective_error(np.array([10.0]))[0][0]
    wide = math.radians(10.0)
    assert far_px == pytest.approx(-350e3 / 57.65 * (math.tan(wide) - math.sin(wide)), rel=1e-9)
    holds("weak-perspective", -far_px)
    holds("weak-perspective-5", -field.weak_perspective_error(np.array([5.0]))[0][0])
