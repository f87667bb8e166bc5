"""The air of a site: whose extinction is taken, and what is none."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.config.sky import SiteSettings
from hilstar.server.bench.site import site_extinction, site_refraction
from hilstar.server.bench.star_light import site_air, star_catalog
from hilstar.sky.electrons import Optics
from hilstar.sky.spectrum import Curve, constant_curve
from tests.support.benches import bench_text
from tests.support.refusals import refusal

NM = np.array([450.0, 550.0])


def site(extinction: float | str) -> SiteSettings:
    return SiteSettings(latitude_deg=-24.6, longitude_deg=-70.4, extinction=extinction)


def test_an_extinction_is_a_number_a_place_s_or_a_file_s(tmp_path):
    (tmp_path / "own.csv").write_text("wavelength_nm,value\n400,10\n600,0.2\n")
    assert site_extinction(site(0.25), tmp_path)(NM) == pytest.approx([0.25, 0.25])
    assert site_extinction(site("own.csv"), tmp_path)(NM) == pytest.approx([7.55, 2.65])
    blue, green = site_extinction(site("paranal"), tmp_path)(NM)
    assert 0.05 < green < blue < 0.3  # Patat et al. 2011: 0.19 and 0.12


@pytest.mark.parametrize(
    ("extinction", "words"),
    [
        (-0.01, "[site] extinction = -0.01: write magnitudes an air mass, 0 to 10"),
        (10.5, "[site] extinction = 10.5: write magnitudes an air mass, 0 to 10"),
        ("paranall", "did you mean paranal"),
        ("thick.csv", "thick.csv"),
    ],
)
def test_what_is_no_extinction_is_refused(tmp_path, extinction, words):
    (tmp_path / "thick.csv").write_text("wavelength_nm,value\n400,10.5\n600,0.2\n")
    assert words in refusal(site_extinction, site(extinction), tmp_path)


def test_refraction_is_that_of_the_site_s_pressure_temperature_and_humidity():
    """ERFA's own test of eraRefco: 800 hPa, 10 C, 90 %, 0.4 um."""
    line = Curve(np.array([399.9, 400.1]), np.ones(2))
    optics = Optics(30.0, line, constant_curve(1.0))
    air = SiteSettings(
        latitude_deg=0, longitude_deg=0, pressure_hpa=800.0, temperature_c=10.0, humidity=0.9
    )
    a, b = site_refraction(air, optics)
    # the dispersion of 0.1 nm at 400 nm is under 1e-5 of it
    assert a == pytest.approx(0.2264949956241415e-3, rel=1e-5)
    assert b == pytest.approx(-0.2598658261729344e-6, rel=1e-5)


def test_the_last_that_the_air_dims_is_sunlight_as_a_star_of_its_colours(tmp_path):
    """B-V 0.65 and V-I 0.70 (Ramirez et al. 2012: 0.653 and 0.702)."""
    (tmp_path / "bench.toml").write_text(bench_text({"sky": {"faintest_v_mag": 2}}))
    file = read_bench_file(tmp_path / "bench.toml")
    catalog = star_catalog(file.config, tmp_path).taken(np.arange(3))
    suns = replace(
        catalog,
        v_mag=np.array([0.0, 0.0, 5.0]),
        bv_mag=np.array([0.65, 0.70, 0.65]),
        vi_mag=np.array([0.70, 0.65, 0.70]),
    )
    config = msgspec.structs.replace(file.config, site=site("lick"))
    alike, swapped, faint, sunlight = site_air(config, tmp_path, suns).dimming_mag.T
    assert sunlight == pytest.approx(alike, abs=1e-6)
    assert faint == pytest.approx(alike, abs=1e-6)
    assert np.abs(swapped - alike).max() > 1e-4
