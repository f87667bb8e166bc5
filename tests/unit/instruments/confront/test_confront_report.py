"""Figures, words and limits of a confrontation, each against what was put in."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hilstar.instruments.confront import report
from hilstar.instruments.confront.background import FixedPattern
from hilstar.instruments.confront.judge import DatedBy, Fainter, SourceRow, Verdict
from hilstar.instruments.confront.session import Session
from hilstar.sky.air import SiteAir
from tests.support.confrontations import a_confrontation, a_session, a_shot, a_verdict

PX_PER_ARCSEC = 4000 * math.pi / 180 / 3600
AT_LIMITS = {"counted": 5, "rms_px": 0.15, "rms_mag": 0.2}


def test_figures_of_photographs_are_their_own() -> None:
    confrontation = a_confrontation()
    session = confrontation.session
    odd, plain = confrontation.figures["images"]
    skies = []
    for level_dn, offset_mag in ((200.0, -12.0), (400.0, -12.25)):
        per_arcsec2_mag = -2.5 * math.log10(level_dn * PX_PER_ARCSEC**2)
        skies.append(per_arcsec2_mag - offset_mag - session.sky_mag())
    for number, image in enumerate((odd, plain)):
        assert image.pop("sky_v_mag_arcsec2") == pytest.approx(skies[number])
        q_icrs_to_cam = session.camera.pointings[number].q_icrs_to_cam
        assert image.pop("q_icrs_to_cam") == q_icrs_to_cam.tolist()
    # a zenith at tangents of 1, and of 1 and 3/4
    altitudes_deg = [odd.pop("altitude_deg"), plain.pop("altitude_deg")]
    assert altitudes_deg == pytest.approx([45.0, 90 - math.degrees(math.atan(1.25))])
    assert odd == {
        "file": "p0.fits",
        "stars": 2,
        "stars_seen": 5,
        "rms_px": 0.25,
        "rms_mag": 0.5,
        "background_chi2": 0.75,
        "star_chi2": 3.5,
        "unexplained": 2,
        "missing": 1,
        "fainter_than_catalogue": {
            "complete_v_mag": 8.25,
            "reached_v_mag": 9.75,
            "expected": 1.0,
        },
        "dim": ["lower left: dim"],
        "offset_mag": -12.0,
        "air_mass": 1.5,
        "date_off_years": -9.5,
        "date_sigma_years": 0.75,
    }
    changed = ("stars", "stars_seen", "unexplained", "missing", "offset_mag", "air_mass")
    assert [plain[key] for key in changed] == [17, 1, 0, 0, -12.25, 1.125]


def test_figures_of_a_camera_are_those_of_its_fits() -> None:
    figures = a_confrontation().figures
    camera = figures["camera"]
    widths_px = []
    psf = a_session().psf
    for x_px in np.linspace(0, 799, 5):
        at = np.full(5, x_px), np.linspace(0, 599, 5)
        widths_px.append(psf.fwhm_px(*at))
    assert camera.pop("psf_fwhm_px") == pytest.approx(np.median(widths_px))
    assert camera == {
        "focal_length_px": 4000.0,
        "principal_point_px": [410.0, 290.0],
        "distortion": {"k1": 0.125, "k2": -0.5, "p1": 0.01, "p2": -0.02},
        "model": "k1",
        "held_out_px": {"pinhole": 0.5, "k1": 0.0625},
        "gain_e_per_dn": 2.0,
        "read_noise_e": 6.0,
        "pedestal_dn": 100.0,
        "saturation_dn": 4095.0,
        "zero_point_mag": 14.5,
        "colour_term": -0.21,
        "colour_terms": {"r": -0.4, "b": 0.3},
        "vignetting_mag": [0.375, 0.125],
        "extinction_mag_per_air_mass": 0.31,
        "linearity_power": 1.01,
        "tone_curve": False,
        # of offsets and rows 0: they are within four of their errors
        "fixed_pattern": {"response": 0.02, "offsets_dn": 0.0, "columns_dn": 0.5, "rows_dn": 0.0},
        "hot_pixels": 3,
        "dead_pixels": 1,
        "sigma": {
            "focal_length_px": 2.0,
            "principal_point_px": [1.5, 2.5],
            "k1": 0.03,
            "linearity": 0.004,
            "colour_term": 0.02,
            "zero_point_mag": 0.03,
            "extinction_mag_per_air_mass": 0.015,
            "gain_e_per_dn": 0.03,
            "read_noise_e": 0.4,
            "pedestal_dn": None,
        },
    }
    del figures["camera"], figures["images"]
    assert figures == {
        "excess": {
            "stars": 19,
            "rms_px": 0.0625,
            "rms_mag": 0.0375,
            "light_mag": {"noise": 0.0125, "scintillation by law": None},
            "places_px": {"seeing": 0.05},
        },
        "fixed": False,
        "passed": False,
        "failures": ["p0.fits: too few", "p0.fits: too dim"],
        "notes": ["a note of a test"],
        "written": ["out/index.html", "out/stars.csv"],
    }


def test_what_was_not_fitted_has_no_figure() -> None:
    session = a_session(power=0.5)
    camera = replace(session.camera.camera, lens=None)
    pixels = replace(session.pixels, pattern=FixedPattern())
    light = replace(session.light, extinction_mag=None, zero_point_mag=math.nan)
    fit = replace(session.camera, camera=camera, sigma={})
    session = replace(session, camera=fit, pixels=pixels, light=light)
    figures = a_confrontation(session=session, excess=None, failures=()).figures
    camera_figures = figures["camera"]
    assert camera_figures["distortion"] == dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)
    nothing = ("fixed_pattern", "extinction_mag_per_air_mass", "zero_point_mag")
    assert [camera_figures[key] for key in nothing] == [None] * 3
    assert camera_figures["sigma"]["focal_length_px"] is None
    assert camera_figures["sigma"]["principal_point_px"] == [None, None]
    # the curve that was undone times what is left of it
    assert camera_figures["linearity_power"] == pytest.approx(0.5 * 1.01)
    assert camera_figures["tone_curve"] is True
    assert (figures["excess"], figures["passed"]) == (None, True)


def test_lines_have_the_camera_the_sky_and_what_is_odd_in_words() -> None:
    confrontation = a_confrontation()
    session = confrontation.session
    lines = report.lines_of(
        session, confrontation.verdicts, confrontation.excess, confrontation.defects
    )
    psf, sky = lines.pop(1), lines.pop(5)
    narrow, wide = psf.split(", ")[2].split(" px")[0].split(" to ")
    median = confrontation.figures["camera"]["psf_fwhm_px"]
    assert psf.startswith(f"PSF: {median:.2f} px full width at half maximum, pixel included")
    assert float(narrow) < median < float(wide)
    skies_mag = [image["sky_v_mag_arcsec2"] for image in confrontation.figures["images"]]
    assert sky == (
        f"sky: V {min(skies_mag):.2f} to {max(skies_mag):.2f} mag/arcsec2, if its spectrum is that"
        " of [site] sky_spectrum"
    )
    assert skies_mag[0] > skies_mag[1]
    # two sigmas of a square are the limit of what is not told: 0.04 + 2 * 0.02, 2 * 0.0001
    assert lines == [
        "lens: 4000.00 px of focal length, k1 = 0.1250 (k1)",
        "detector: 2 +- 0.03 e- a DN, 8 a step of 4 DN, read noise 6.00 e-, pedestal 100 DN",
        "fixed pattern: response of pixels 2 +- 0.04 %, offsets of pixels under 0.28 DN, of columns"
        " 0.5 +- 0.01 DN, of rows under 0.014 DN",
        "light: zero point 14.50 mag, colour term -0.210 (B-V), r -0.400, b +0.300; DN go as light"
        " to the power 1.010 +- 0.004: no tone curve",
        "extinction: 0.310 +- 0.015 mag an air mass, over 1.12 to 1.50 of them",
        "pixels: 3 hot and 1 dead, in most of the photographs",
        "p0.fits: lower left: dim",
        "p0.fits: 2 sources unexplained; about 1 stars fainter than the catalogue's limit are to be"
        " expected: it is complete to V = 8.2, the image reaches 9.8",
        "p0.fits: its date is off: its stars stand -9.5 +- 0.8 years from it",
        "scatter of 19 stars: 0.062 px an axis, 0.037 mag",
    ]
    assert report.words_of(confrontation.verdicts[0]) == (
        "2 stars to V = 6.5 within 0.250 px and 0.500 mag, background chi2 0.750, 2 sources"
        " unexplained, 1 stars missing"
    )


def test_a_fixed_camera_has_words_of_the_air_alone_and_no_defects_none() -> None:
    session = a_session(fixed=True)
    light = replace(session.light, extinction_mag=None)
    lines = report.lines_of(replace(session, light=light), [], None, (0, 0))
    assert [line.partition(":")[0] for line in lines] == ["lens", "PSF", "detector", "air", "sky"]
    assert lines[3] == "air: +0.25, +0.00 mag dimmer than the clearest"


def lines_about(start: str, session: Session) -> list[str]:
    lines = report.lines_of(session, [], None, (0, 1))
    return [line for line in lines if start in line]


@pytest.mark.parametrize(
    ("power", "linearity", "sigma", "words"),
    [
        (0.5, 1.0, 0.004, "a tone curve: DN go as light to the power 0.500 (gamma 2.00)"),
        (1.0, 1.039, 0.004, "power 1.039 +- 0.004: no tone curve"),
        (1.0, 0.955, 0.004, "power 0.955 +- 0.004: a tone curve that is no power"),
        (1.0, 1.07, 0.02, "power 1.070 +- 0.020: no tone curve"),
        (1.0, 1.09, 0.02, "power 1.090 +- 0.020: a tone curve that is no power"),
    ],
)
def test_a_tone_curve_is_stated_beyond_four_hundredths_and_four_sigmas(
    power: float, linearity: float, sigma: float, words: str
) -> None:
    light = replace(a_session().light, linearity=linearity, sigma={"linearity": sigma})
    light = replace(light, extinction_mag=None)
    (line,) = lines_about("light:", a_session(power=power, light=light))
    assert words in line


def test_extinction_is_the_site_s_table_of_sunlight_for_one_air_mass_and_what_offsets_add() -> None:
    """Of a first channel and a second, 0, 1 and 2 masses, a star and sunlight."""
    dimming_mag = np.arange(12.0).reshape(2, 3, 2) / 8
    air = SiteAir(lambda t_ns: np.zeros(3), (0.0, 0.0), 0.0, 20.0, dimming_mag)
    session = a_session()
    assert report.extinction_of(session) == 0.31
    assert report.extinction_of(replace(session, air=air)) == pytest.approx(0.31 + 3 / 8)
    untold = replace(session, air=air, light=replace(session.light, extinction_mag=None))
    assert report.extinction_of(untold) is None


@pytest.mark.parametrize("level_dn", [100.0, 99.0])
def test_a_sky_that_is_not_above_the_pedestal_has_no_magnitude(level_dn: float) -> None:
    shot = a_shot(0)
    dark = replace(shot.level, level=np.full_like(shot.level.level, level_dn))
    session = a_session(shots=(replace(shot, level=dark), a_shot(1)))
    assert report.sky_v_mag(session, 0) is None
    (line,) = lines_about("sky:", session)
    v_mag = report.sky_v_mag(session, 1)
    assert line.startswith(f"sky: V {v_mag:.2f} to {v_mag:.2f} mag/arcsec2")


def words_about(**changes: Any) -> list[str]:
    """What is said of one photograph, without its name."""
    verdict = a_verdict(a_shot(0), 0, **changes)
    words = []
    for line in report.lines_of(a_session(), [verdict], None, (0, 0)):
        if line.startswith("p0.fits: "):
            words.append(line.removeprefix("p0.fits: "))
    return words


@pytest.mark.parametrize(
    ("years", "sigma", "words"),
    [
        (1.25, 0.125, "its date is off: its stars stand +1.2 +- 0.1 years from it"),
        (-1.25, 0.125, "its date is off: its stars stand -1.2 +- 0.1 years from it"),
        (0.9, 0.1, None),
        (4.5, 1.0, None),
        (9.0, 2.5, "no star in it is fast enough to check its year (+- 2 years)"),
        (0.0, 2.0, None),
    ],
)
def test_a_date_is_off_by_over_a_year_and_five_sigmas(
    years: float, sigma: float, words: str | None
) -> None:
    dated = DatedBy(years, sigma)
    assert words_about(dated=dated) == ([] if words is None else [words])
    shot = a_shot(0)
    undated = a_verdict(replace(shot, photo=replace(shot.photo, t_ns=None)), 0, dated=dated)
    assert not any("p0" in line for line in report.lines_of(a_session(), [undated], None, (0, 0)))


def test_stars_beyond_the_catalogue_are_told_where_one_is_expected_and_sources_are_left() -> None:
    source = [SourceRow(1.0, 2.0, 9.0, "")]
    (words,) = words_about(sources=source, fainter=Fainter(8.0, 9.0, 1.0))
    assert words.startswith("1 sources unexplained; about 1 stars fainter")
    assert words_about(sources=source, fainter=Fainter(8.0, 9.0, 0.9)) == []
    assert words_about(fainter=Fainter(8.0, 9.0, 5.0)) == []


@pytest.mark.parametrize("chi2", [0.8, 1.25])
def test_a_photograph_at_all_limits_passes(chi2: float) -> None:
    assert report.failures_of([a_verdict(a_shot(0), 0, background_chi2=chi2, **AT_LIMITS)]) == []


@pytest.mark.parametrize(
    ("changes", "failure"),
    [
        ({"counted": 4}, "4 clean stars to V = 6.5 are too few to judge by"),
        ({"rms_px": 0.151}, "places are 0.151 px rms off, over 0.15"),
        ({"rms_mag": 0.201}, "light is 0.201 mag rms off, over 0.2"),
        ({"background_chi2": 0.79}, "background chi2 0.79 is outside 0.8 to 1.25"),
        ({"background_chi2": 1.26}, "background chi2 1.26 is outside 0.8 to 1.25"),
        ({"background_chi2": math.nan}, "background chi2 nan is outside 0.8 to 1.25"),
        ({"dim": ["a", "b"]}, "a"),
    ],
)
def test_one_figure_beyond_its_limit_is_named_with_its_photograph(
    changes: dict[str, Any], failure: str
) -> None:
    passed: Verdict = a_verdict(a_shot(0), 0, **AT_LIMITS)
    failures = report.failures_of([passed, a_verdict(a_shot(1), 1, **(AT_LIMITS | changes))])
    assert failures[0] == f"p1.fits: {failure}"
    assert len(failures) == len(changes.get("dim", [1]))
