"""The air over `[site]` against Astropy's refraction, own quadrature, and Young's law of
scintillation.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.time import Time
from astropy.utils import iers
from msgspec import structs
from scipy.optimize import brentq

from hilstar.attitude.logs.earth import q_icrs_to_enu
from hilstar.basics.rotation import from_radec_roll_deg, rotate
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.site import Ground, site_glow_e_per_s_sr, site_refraction
from hilstar.server.bench.star_light import bench_sources, bench_stars, site_air
from hilstar.server.bench.star_rates import bench_channels
from hilstar.sky.air import SiteAir, air_mass, extinction_curve, scintillation
from hilstar.sky.electrons import Photometry, library_electrons_per_s, load_library
from hilstar.sky.spectrum import TEMPERATURE_SCALES, Curve
from hilstar.sky.stars import unit_vectors_icrs
from tests.authority.integrals import integral, read
from tests.support.claims import holds
from tests.support.commands import run_hilstar_here
from tests.support.spectra import write_curve

SURE = 5.0  # standard deviations
# Of refraction from 400 to 850 nm, which changes by 3 %: ERFA's own dispersion is Owens's.
DISPERSION = 1e-3
BENCH = """[tracker]
aperture_mm = 18.4
focal_length_mm = 35.0
pixel_pitch_um = 6.9
resolution_px = [512, 384]
quantum_efficiency = "ccd47-20"
exposure_s = 0.2
[monitor]
resolution_px = [640, 480]
pixel_pitch_um = 265.5
[collimator]
focal_length_mm = 1000.0
[sky]
epoch_utc = "2026-11-21T22:00:00Z"
faintest_v_mag = 7.5
{sky}
[site]
latitude_deg = 45.5
longitude_deg = 9.2
height_m = 1200
pressure_hpa = 880
temperature_c = 5
humidity = 0.3
{site}
"""
# Astropy's refraction is ERFA's too. It is given no distances, so parallaxes of up to 20 mas are
# left.
FAR_MAS = 20.0
# hilstar's rates are a fit over V-I, whose errors at two air masses nearly cancel: over the Pickles
# library the rms grows with the air mass; the reddened and the hottest stars are furthest off.
AIR_MASSES = (1.25, 2.5, 6.0)
# A black body's rate is tabulated to 1e-11: left are the straight lines between air masses;
# measured 0.003.
BLACK_BODY_LIMIT_MAG = 0.005
GLOW_LIMIT = 1e-4


def site_bench(folder: Path, site: str = "", sky: str = ""):
    return bench_file_of(folder / "site.toml", BENCH.format(site=site, sky=sky))


@cache
def stars_and_sky():
    file = site_bench(Path())
    sources = bench_sources(file.config, file.folder)
    stars = bench_stars(file.config, file.folder, sources.moving)
    return file, stars, sources.moving


def test_stars_stand_where_astropy_has_them_in_altitude_and_azimuth():
    file, stars, moving = stars_and_sky()
    t_ns = 1234 * 10**9
    seen = moving.seen(moving.among(stars), t_ns)
    utc_ns = moving.utc_ns(t_ns)
    far = stars.catalog.parallax_mas[stars.row] < FAR_MAS
    which = np.flatnonzero(far & (seen.air.altitude_rad(stars.vectors) > math.radians(5)))[::100]
    enu = rotate(q_icrs_to_enu(np.array([utc_ns]), 45.5, 9.2)[0], seen.directions(which))
    wavelength_nm = mean_wavelength_nm(file)
    frame = AltAz(
        obstime=Time(utc_ns / 1e9, format="unix"),
        location=EarthLocation.from_geodetic(9.2, 45.5, 1200),
        pressure=880 * u.hPa,
        temperature=5 * u.deg_C,
        relative_humidity=0.3,
        obswl=wavelength_nm * u.nm,
    )
    x, y, z = unit_vectors_icrs(
        stars.catalog.taken(stars.row[which]), file.config.sky.epoch_jyear
    ).T
    with warnings.catch_warnings(), iers.conf.set_temp("auto_download", False):
        warnings.simplefilter("ignore")
        table = iers.IERS_A.read(iers.IERS_A_FILE)
        with iers.earth_orientation_table.set(table):
            theirs = SkyCoord(np.arctan2(y, x) * u.rad, np.arcsin(z) * u.rad).transform_to(frame)
    alt, az = theirs.alt.rad, theirs.az.rad
    wanted = np.stack([np.cos(alt) * np.sin(az), np.cos(alt) * np.cos(az), np.sin(alt)], axis=1)
    off_arcsec = np.degrees(np.linalg.norm(enu - wanted, axis=1)) * 3600
    assert len(which) > 50
    holds("site-places", off_arcsec.max())
    bent_arcsec = (
        np.degrees(
            np.linalg.norm(
                seen.directions(which) - replace(seen, air=None).directions(which), axis=1
            )
        )
        * 3600
    )
    assert bent_arcsec.max() > 300


def mean_wavelength_nm(file) -> float:
    nm, qe = read("ccd47-20")
    weight = qe * nm
    return integral(lambda w: float(np.interp(w, nm, weight)) * w, nm) / integral(
        lambda w: float(np.interp(w, nm, weight)), nm
    )


def dimmed(file, masses: float, v_mag, bv_mag, vi_mag) -> np.ndarray:
    """How many magnitudes the air of `[site]` takes of stars of these colours."""
    catalog = replace(
        stars_and_sky()[1].catalog.taken(np.arange(len(bv_mag))),
        v_mag=v_mag,
        bv_mag=bv_mag,
        vi_mag=vi_mag,
    )
    air = site_air(file.config, file.folder, catalog)
    altitude = brentq(lambda a: float(air_mass(np.array([a]))[0]) - masses, 0.01, math.pi / 2)
    return -2.5 * np.log10(air.shares(np.arange(len(bv_mag)), np.full(len(bv_mag), altitude))[0])


@pytest.mark.parametrize("masses", AIR_MASSES)
def test_extinction_is_that_of_each_stars_own_spectrum(masses: float):
    file, library = stars_and_sky()[0], load_library()
    optics = bench_channels(file.config.tracker, file.folder)[0]
    nm, extinction = np.arange(300.0, 1050.5, 0.5), extinction_curve("lick")
    through = Curve(
        nm,
        optics.transmission(nm)
        * 10 ** (-0.4 * masses * np.interp(nm, extinction.wavelength_nm, extinction.value)),
    )
    own = [
        library_electrons_per_s(library, one, Photometry())
        for one in (replace(optics, transmission=through), optics)
    ]
    usual = library.vi_mag < 2.0
    mag = dimmed(file, masses, np.zeros(len(usual)), library.bv_mag, library.vi_mag)[usual]
    off = mag + 2.5 * np.log10(own[0] / own[1])[usual]
    holds(f"extinction-{masses:g}", math.sqrt((off**2).mean()))
    holds("extinction-largest", np.abs(off).max())
    assert np.ptp(mag) > 0.08 * masses  # by colour


def test_extinction_of_a_black_body_is_its_integral(tmp_path):
    knots, mag = read_columns("extinction", 4)
    write_curve(tmp_path / "k.csv", knots, mag)
    file = site_bench(tmp_path, 'extinction = "k.csv"', 'spectrum = "blackbody"')
    nm, qe = read("ccd47-20")
    temperature_k = 7000.0
    bv = brentq(
        lambda b: float(TEMPERATURE_SCALES["ballesteros2012"](np.array([b]))[0]) - temperature_k,
        -0.2,
        1.5,
    )

    def rate(masses: float) -> float:
        def light(w: float) -> float:
            spectrum = w**-4 / np.expm1(1.438776877e7 / (w * temperature_k))
            return (
                float(np.interp(w, nm, qe))
                * spectrum
                * 10 ** (-0.4 * masses * float(np.interp(w, knots, mag)))
            )

        return integral(light, np.union1d(nm, knots[(knots > nm[0]) & (knots < nm[-1])]))

    for masses in (1.25, 2.5, 6.0):
        wanted = -2.5 * math.log10(rate(masses) / rate(0.0))
        found = dimmed(file, masses, *np.array([[0.0], [bv], [0.5]]))[0]
        assert found == pytest.approx(wanted, abs=BLACK_BODY_LIMIT_MAG)


def read_columns(name: str, column: int) -> tuple[np.ndarray, np.ndarray]:
    rows = read(name)
    return rows[0], rows[column]


def test_the_skys_glow_is_the_integral_of_its_spectrum():
    file = site_bench(Path(), "sky_v_mag_arcsec2 = 20.5")
    glow = site_glow_e_per_s_sr(
        file.config, file.folder, bench_channels(file.config.tracker, file.folder)[0]
    )
    nm, qe = read("ccd47-20")
    knots, flux = read("night_sky")

    def spectrum(w: float) -> float:
        return float(np.interp(w, knots, flux, left=0, right=0))

    inside = knots[(knots > nm[0]) & (knots < nm[-1])]
    v_nm = read("johnson-v")[0]
    visible = np.union1d(v_nm, knots[(knots > v_nm[0]) & (knots < v_nm[-1])])
    response = read("johnson-v")[1]
    mean = plain(lambda w: spectrum(w) * np.interp(w, v_nm, response), visible) / plain(
        lambda w: np.interp(w, v_nm, response), visible
    )
    per_joule = 1e-9 / (6.62607015e-34 * 299792458)
    electrons = per_joule * plain(
        lambda w: spectrum(w) * np.interp(w, nm, qe) * w, np.union1d(nm[nm > knots[0]], inside)
    )
    area_m2 = math.pi / 4 * 0.0184**2
    wanted = (
        3.631e-2
        * 10 ** (-0.4 * 20.5)
        / mean
        * electrons
        * 1e-9
        * area_m2
        * (180 * 3600 / math.pi) ** 2
    )
    assert glow == pytest.approx(wanted, rel=GLOW_LIMIT)


def plain(function, knots_nm: np.ndarray) -> float:
    """Simpson's rule between knots, exact for products of three straight lines."""
    a, b = knots_nm[:-1], knots_nm[1:]
    values = [np.array([function(w) for w in part]) for part in (a, (a + b) / 2, b)]
    return float(((b - a) / 6 * (values[0] + 4 * values[1] + values[2])).sum())


def test_stars_twinkle_by_youngs_law(tmp_path):
    """Measured over 60 exposures of one field: the scatter of each star's light, by altitude."""
    file = site_bench(tmp_path)
    with Simulator(file) as simulator:
        moving = simulator.moving
        air = moving.air.above(moving.utc_ns(None))
        q = facing(air.up, 40.0)
        view = simulator.view(q, np.zeros(3))
        steady = simulator.expose(view, None)
        light = []
        for seed in range(60):
            truth = simulator.expose(view, np.random.default_rng(seed)).truth
            light.append(truth["electrons_per_s"] / steady.truth["electrons_per_s"])
        again = simulator.expose(view, np.random.default_rng(59)).truth["electrons_per_s"]
    light = np.array(light)
    assert np.array_equal(again, light[-1] * steady.truth["electrons_per_s"])
    assert len(steady.truth) > 10
    masses = 1 / math.sin(math.radians(40))
    sigma = 0.09 * 1.84 ** (-2 / 3) * masses**1.75 * math.exp(-1200 / 8000) / math.sqrt(2 * 0.2)
    freedom = 59 * light.shape[1]
    # The field is 6 degrees high: X^1.75 changes by a tenth over it. 4 sigmas of the scatter's own
    # error beside that.
    assert light.std(ddof=1, axis=0).mean() == pytest.approx(
        sigma, rel=0.1 + 4 / math.sqrt(2 * freedom)
    )
    correlation = np.corrcoef(light.T)[np.triu_indices(light.shape[1], 1)]
    assert abs(correlation.mean()) < 4 / math.sqrt(60 * len(correlation))  # each by itself
    # and no warning
    assert scintillation(18.4, np.array([1.0, 2.0]), 0.0, exposure_s=0.0).tolist() == [1.0, 1.0]


def test_scintillation_is_young_s_for_an_aperture_in_centimetres():
    """0.09 D^(-2/3) X^1.75 exp(-h / 8 km) / sqrt(2 t) (Young 1967), and never above MAX_TWINKLE."""
    masses = np.array([1.0, 1.6])
    wanted = 0.09 * 1.84 ** (-2 / 3) * masses**1.75 * math.exp(-1200 / 8000) / math.sqrt(2 * 0.2)
    np.testing.assert_allclose(scintillation(18.4, masses, 1200.0, 0.2), wanted)


def test_stars_twinkle_and_bodies_do_not(rng):
    _, stars, moving = stars_and_sky()
    among = moving.among(stars)
    seen = replace(among, bodies=("Moon", "Jupiter"))
    twinkled = moving.air.twinkling(seen, moving.utc_ns(0), 0.2, rng)
    share = twinkled.electrons_per_s / seen.electrons_per_s
    assert (share[-2:] == 1.0).all()
    assert (share[:-2] != 1.0).all()


def test_a_star_that_twinkles_has_its_light_in_the_mean_and_young_s_scatter(rng):
    """Over n draws a mean of 1 is known to sigma / sqrt(n), and a normal scatter of 1 to
    1 / sqrt(2 n); a light of mean 1 has a normal logarithm of mean -s^2 / 2.
    """
    _, stars, moving = stars_and_sky()
    among = moving.among(stars)
    exposure_s = 2e-3  # Young's 0.81 for a star at the zenith
    share = []
    for _ in range(20):
        twinkled = moving.air.twinkling(among, moving.utc_ns(0), exposure_s, rng)
        share.append(twinkled.electrons_per_s / among.electrons_per_s)
    high = moving.air.above(moving.utc_ns(0)).altitude_rad(among.vectors) > math.radians(60)
    drawn = np.array(share)[:, high]
    count = drawn.size
    assert count > 1000
    masses = air_mass(moving.air.above(moving.utc_ns(0)).altitude_rad(among.vectors)[high])
    sigma = scintillation(18.4, masses, 1200.0, exposure_s)
    assert drawn.mean() == pytest.approx(1.0, abs=SURE * sigma.max() / math.sqrt(count))
    # s^2 = ln(1 + sigma^2)
    wanted = np.sqrt(np.log1p(sigma**2))
    scatter = (np.log(drawn) + wanted**2 / 2) / wanted
    assert scatter.std() == pytest.approx(1.0, abs=SURE / math.sqrt(2 * count))


def facing(up: np.ndarray, altitude_deg: float) -> np.ndarray:
    """An attitude towards the north at an altitude."""
    east = np.cross([0.0, 0.0, 1.0], up)
    north = np.cross(up, east / np.linalg.norm(east))
    x, y, z = (
        math.sin(math.radians(altitude_deg)) * up + math.cos(math.radians(altitude_deg)) * north
    )
    return from_radec_roll_deg(math.degrees(math.atan2(y, x)), math.degrees(math.asin(z)), 0.0)


@pytest.mark.parametrize(("altitude_deg", "is_told"), [(-12.1, False), (-11.9, True), (5.0, True)])
def test_a_sun_above_astronomical_night_is_told_once_with_its_altitude(
    altitude_deg, is_told, caplog
):
    _, _, moving = stars_and_sky()
    air = replace(moving.air, told=set())
    utc_ns = moving.utc_ns(0)
    up = air.above(utc_ns).up
    level = np.cross(up, [0.0, 0.0, 1.0])
    level /= np.linalg.norm(level)
    altitude_rad = math.radians(altitude_deg)
    sun_km = 1.5e8 * (math.sin(altitude_rad) * up + math.cos(altitude_rad) * level)
    for _ in range(2):
        air.check_sun(sun_km, utc_ns)
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == is_told
    assert all(f"the Sun stands at {altitude_deg:.1f} degrees" in line for line in told)


def test_below_the_horizon_there_is_neither_star_nor_sky(tmp_path, caplog):
    file = site_bench(tmp_path, "sky_v_mag_arcsec2 = 20.5")
    with Simulator(file) as simulator:
        up = simulator.moving.air.above(simulator.moving.utc_ns(None)).up
        found = [
            simulator.expose(simulator.view(facing(up, altitude), np.zeros(3)), None)
            for altitude in (45.0, 0.0, -20.0)
        ]
    high, level, low = found
    assert len(low.truth) == 0
    assert low.mean_e.max() == 0
    # the lower half of the image is the ground
    assert (np.array([t["y_px"] for t in level.truth]) < 192).all()
    # van Rhijn's: the sky is brighter at the horizon
    assert level.mean_e[:, 256][:150].min() > 2 * high.mean_e.min()
    assert sum("below the horizon" in record.message for record in caplog.records) == 1


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ('extinction = "paranall"', "paranal"),
        ("extinction = -1.0", "0 to 10"),
        ("latitude = 3.0", "latitude_deg"),
    ],
)
def test_a_wrong_site_is_one_line(tmp_path, keys, said):
    (tmp_path / "bench.toml").write_text(BENCH.format(site=keys, sky=""))
    result = run_hilstar_here(
        "frame", tmp_path / "bench.toml", "--radec", "40,45,0", "-o", tmp_path / "frame.fits"
    )
    assert result.returncode == 2
    assert said in result.stderr
    assert result.stderr.count("\n") == 1


def test_a_site_needs_a_date_and_tells_of_the_sun(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(BENCH.format(site="", sky="").replace('epoch_utc = "2026-11-21T22:00:00Z"', ""))
    command = "simulate", path, "--radec", "40,45,0", "-o", tmp_path / "frame.fits"
    result = run_hilstar_here(*command)
    assert (result.returncode, "[site] needs a date" in result.stderr) == (2, True)
    path.write_text(BENCH.format(site="", sky="").replace("T22:", "T12:"))
    result = run_hilstar_here(*command)
    assert result.returncode == 0
    assert "the Sun stands at" in result.stderr


def test_the_benchs_hash_covers_the_sites_curves(tmp_path):
    """As it covers every file that makes frames."""
    curve = tmp_path / "air.csv"
    curve.write_text("wavelength_nm,value\n400,0.4\n900,0.1\n")
    keys = 'extinction = "air.csv"\nsky_v_mag_arcsec2 = 21\nsky_spectrum = "air.csv"'
    before = site_bench(tmp_path, keys).sha256
    curve.write_text("wavelength_nm,value\n400,0.5\n900,0.1\n")
    assert site_bench(tmp_path, keys).sha256 != before


def test_a_place_on_the_ground_moves_east_as_the_earth_turns():
    """Its velocity is the slope of its place, 0.326 km/s at 45.5 degrees."""
    ground = Ground(site_bench(Path()).config.site)
    utc_ns = 1_790_000_000 * 10**9
    velocity = ground.state(utc_ns)[1]
    after, before = (ground.state(utc_ns + s * 10**9)[0] for s in (5, -5))
    np.testing.assert_allclose(velocity, (after - before) / 10, atol=1e-4)
    assert np.linalg.norm(velocity) == pytest.approx(0.326, abs=2e-3)


def test_without_a_stated_pressure_it_is_the_standard_one_of_the_height():
    """At 1200 m 877 hPa: refraction goes with it."""
    file = site_bench(Path())
    optics = bench_channels(file.config.tracker, file.folder)[0]
    site = file.config.site
    stated, standard = (
        site_refraction(structs.replace(site, pressure_hpa=hpa), optics)[0] for hpa in (880.0, None)
    )
    assert standard / stated == pytest.approx(877.16 / 880, rel=1e-3)


def dry_air_refractivity(wavelength_um: float) -> float:
    """n - 1 of standard air (Edlen 1966, Metrologia 2, 71)."""
    wave_number2 = wavelength_um**-2
    return 1e-8 * (8342.13 + 2_406_030 / (130 - wave_number2) + 15_997 / (38.9 - wave_number2))


@pytest.mark.parametrize("nm", [400.0, 850.0])
def test_refraction_is_that_of_the_colour_which_the_tracker_sees(nm):
    """The constant of tan z is the air's n - 1, and less by its scale height over the Earth's
    radius, 0.13 %, in all colours alike: so the ratio to 550 nm is that of n - 1.
    """
    file = site_bench(Path())
    optics = bench_channels(file.config.tracker, file.folder)[0]
    site = structs.replace(file.config.site, humidity=0.0)

    def constant_rad(nm: float) -> float:
        line = Curve(np.array([nm - 1, nm, nm + 1]), np.array([0.0, 1.0, 0.0]))
        return site_refraction(site, replace(optics, quantum_efficiency=line))[0]

    ratio = dry_air_refractivity(nm * 1e-3) / dry_air_refractivity(0.55)
    assert constant_rad(nm) / constant_rad(550.0) == pytest.approx(ratio, abs=DISPERSION)


def test_the_skys_glow_is_that_of_the_zenith_and_van_rhijns_with_the_airs_extinction():
    """A layer at 130 km, seen at the zenith distance z: 1 / sqrt(1 - 0.96 sin(z)^2) of its light
    (van Rhijn 1921; Krisciunas and Schaefer 1991, equations 3 and 4), behind as many air masses
    more of 0.25 mag.
    """
    air = SiteAir(
        up_at=lambda utc_ns: np.array([0.0, 0.0, 1.0]),
        refraction_rad=(0.0, 0.0),
        height_m=0.0,
        aperture_mm=30.0,
        dimming_mag=np.zeros((1, 2, 1)),
        v_extinction_mag=0.25,
        glow_e_per_s_sr=np.array([7.0, 9.0]),
    )
    directions = np.array([[0.0, 0.0, 1.0], [0.8, 0.0, 0.6], [0.8, 0.0, -0.6]])
    masses = 1 / math.sqrt(1 - 0.96 * 0.64)
    low = masses * 10 ** (-0.4 * 0.25 * (masses - 1))
    wanted = np.outer([7.0, 9.0], [1.0, low, 0.0])
    np.testing.assert_allclose(air.glow_at(directions, 0), wanted, rtol=1e-12)
