"""The study of stability: hilstar is right at every place, the methods named there are not, and a verdict can be wrong."""

from __future__ import annotations

import json
import math
from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.special import erf

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.rotation import direction_of
from hilstar.scene.camera import Camera
from hilstar.sky.electrons import tabulate
from hilstar.study.stability import FailureCase, Figures
from hilstar.study.stability import field as stability_field
from hilstar.study.stability import image as stability_image
from hilstar.study.stability import run as stability
from hilstar.study.stability import sky as stability_sky
from tests.support.commands import run_hilstar_here
from tests.support.pictures import assert_drawn, table


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """The command's folder and output, and the cases that it measured."""
    folder, measured = tmp_path_factory.mktemp("stability"), []

    def keep(directory):
        measured.extend(run(directory))
        return measured

    run = stability.run
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stability, "run", keep)
        result = run_hilstar_here("study", "stability", "-o", folder, "--json")
    assert result.returncode == 0, result.stderr
    return folder, json.loads(result.stdout), measured


@pytest.mark.parametrize("number", range(len(stability.CASES)), ids=lambda number: stability.CASES[number].__name__)
def test_hilstar_is_right_where_the_method_named_there_is_not(study, number):
    case = study[2][number]
    assert case.right, case
    assert not case.figures.fault <= case.figures.tolerance, case
    assert all((case.case, case.method, case.fails, case.happens, case.why))
    theirs = replace(case, figures=replace(case.figures, error=case.figures.fault))
    assert not theirs.right


def test_the_table_has_every_case_and_the_curves_have_charts(study):
    folder, printed, measured = study
    assert printed["right"] is True and len(printed["findings"]) == len(measured)
    rows = table(folder / "stability.csv")
    assert [row["case"] for row in rows] == [case.case for case in measured]
    for row in rows:
        assert row["verdict"] == "right" and row["failing method"] and row["its failure"] and row["why"]
        assert float(row["error"]) <= float(row["tolerance"])
        assert not float(row["its error"]) <= float(row["tolerance"])
    for stem in ("narrow_stars", "weak_perspective", "popping", "turns"):
        assert_drawn(folder / f"{stem}.png")
        assert len(table(folder / f"{stem}.csv")) > 25


def test_what_is_no_number_is_not_right():
    assert not FailureCase("c", "m", "f", "h", "w", Figures(math.nan, math.nan, 1.0)).right


def rendered_by(method):
    return lambda on: nullcontext(partial(method, on))


class WeakCamera(Camera):
    """One depth for every star."""

    def project(self, image_vectors):
        x, y = (image_vectors[:, axis] * self.focal_length_px + self.principal_point_px[axis] for axis in (0, 1))
        return x, y


def weak_camera(resolution_px, pixel_pitch_um, focal_length_mm, _alignment):
    middle = ((resolution_px[0] - 1) / 2, (resolution_px[1] - 1) / 2)
    return WeakCamera(resolution_px, focal_length_mm * 1e3 / pixel_pitch_um, middle, np.eye(3))


def by_right_ascension(catalog, epoch_jyear):
    """Eq. 2.1 as it stands."""
    years = epoch_jyear - stability_field.HIPPARCOS_EPOCH_JYEAR
    ra_deg = catalog.ra_deg + catalog.pm_ra_cosdec_mas_yr * years / 3.6e6
    dec_deg = catalog.dec_deg + catalog.pm_dec_mas_yr * years / 3.6e6
    return direction_of(ra_deg, dec_deg)


def averaged(_model, optics, photometry):
    return tabulate("ags", optics, photometry)


code_fluxes = stability_field.moving_code_fluxes


def rounded(_quantisation):
    return code_fluxes("round")


def rounded_codes(scene):
    return stability_image.codes_of(scene, "round")


JUDGED_CODES = (
    stability_image.stars_half_off,
    stability_image.stars_a_pixel_apart,
    stability_image.narrow_codes,
    stability_image.uneven_panel,
    stability_image.two_bits,
    stability_image.sixteen_bits,
)


def taken_as_it_is(_message):
    return AttitudeSample(1, stability_field.START)


# What a place would say if hilstar did as the method that fails there: the module's road is replaced by it.
WRONG_ROADS = (
    (stability_field.two_signs, "slerp", stability_field.arccos_slerp),
    (stability_field.antipodal, "slerp", stability_field.arccos_slerp),
    (stability_field.half_turn, "slerp", stability_field.straight_line),
    (stability_field.not_a_number, "decode", taken_as_it_is),
    (stability_field.motion_at_pole, "unit_vectors_icrs", by_right_ascension),
    (stability_field.stars_behind, "monitor_camera", weak_camera),
    (stability_field.weak_perspective, "monitor_camera", weak_camera),
    (stability_image.narrow_star, "by_renderer", rendered_by(stability_image.point_sampled)),
    (stability_field.popping, "by_renderer", rendered_by(stability_image.point_sampled)),
    (stability_image.wide_star, "by_renderer", rendered_by(stability_image.half_float)),
    (stability_image.negative_wings, "by_renderer", rendered_by(stability_image.bare_polynomial)),
    (stability_image.star_on_pixel_edge, "by_renderer", rendered_by(stability_image.nearest_pixel)),
    (stability_image.star_on_image_edge, "by_renderer", rendered_by(stability_image.nearest_pixel)),
    (stability_field.popping_codes, "moving_code_fluxes", rounded),
    *((visit, "exact_codes", rounded_codes) for visit in JUDGED_CODES),
    (stability_sky.temperature_range, "tabulate", averaged),
    (stability_sky.nan_pixel, "find_stars", len),
)


@pytest.mark.parametrize(("visit", "name", "method"), WRONG_ROADS, ids=lambda value: getattr(value, "__name__", ""))
def test_a_verdict_is_wrong_where_hilstar_goes_the_failing_way(visit, name, method, monkeypatch):
    monkeypatch.setitem(visit.__globals__, name, method)
    place = visit()
    assert not place.right, place


def test_the_polynomial_of_the_shader_is_the_shader_s():
    x = np.linspace(-5, 5, 20_001)
    # float32 rounds the inputs too: 2e-7 at 4, where erf is flat, and 6e-8 at 1.
    assert np.abs(stability_image.erf_float32(x) - erf(x)).max() <= stability_image.ERF_ERROR + 6e-8


def test_the_chart_of_popping_shows_what_its_title_says(study):
    rows = table(study[0] / "popping.csv")
    assert len(rows) == stability_field.STEPS
    spread = {
        name: np.ptp([float(row[f"{name} [mag]"]) for row in rows]) for name in ("linear image", "codes, exact", "codes, round")
    }
    assert spread["linear image"] <= stability_field.RIPPLE < spread["codes, exact"] < spread["codes, round"]


def test_weak_perspective_errs_by_half_the_angle_cubed():
    """tan - sin = angle^3 / 2 + angle^5 / 8 ..., so 0.1 % at 3 degrees."""
    off_px, off_arcsec = stability_field.weak_perspective_error(np.array([3.0]))
    angle = math.radians(3.0)
    assert off_px[0] == pytest.approx(-350e3 / 57.65 * angle**3 / 2, rel=2e-3)
    assert off_arcsec[0] == pytest.approx(-math.degrees(angle**3 / 2) * 3600, rel=6e-3)
