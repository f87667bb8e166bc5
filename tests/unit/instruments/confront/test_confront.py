"""Photographs confronted: real ones of ESA's star tracker camera, and planted ones by another
renderer.
"""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from skyfield.api import EarthSatellite, wgs84

from hilstar.attitude.logs.earth import q_icrs_to_enu
from hilstar.basics.rotation import conjugate, rotate
from hilstar.cli import confront as cli_confront
from hilstar.instruments.confront import page
from tests.support.claims import holds
from tests.support.commands import run_hilstar_here
from tests.support.planted_sky import (
    HEIGHT,
    NOTHING_WRONG,
    SKY,
    WIDTH,
    Extras,
    Planted,
    photograph,
    rotation_of,
    write_bench,
)
from tests.support.skies import STATION_TLE, skyfield
from tests.support.tables import csv_rows

RAW = sorted((Path(__file__).parents[3] / "data" / "confront").glob("*.tiff"))
RAW_BENCH = """[tracker]
aperture_mm = 18.4
focal_length_mm = 37.0
pixel_pitch_um = 6.9
resolution_px = [1024, 768]
quantum_efficiency = 0.5
exposure_s = 0.2
"""
# The aims for this camera, which was measured apart: 16 DN a step, 2.64 e- a step, 5114 px
# by 40.33 arcsec/px.
MAX_RMS_PX = 0.07
HELD_OUT = 1.3
SIGMAS = 3.0
HOT = ((100, 200), (300, 50), (400, 600))
FALSE_STARS = ((150.3, 400.2, 9000.0), (500.7, 60.4, 20000.0))
NEAR_PX = 1.0
WRONG = Extras(false_stars=FALSE_STARS, trail_px=((60, 60), (200, 110)), cloud_mag=1.5)


def confronted(
    bench: Path, images: list[Path], output: Path, *options: str, charts: bool = False
) -> dict[str, Any]:
    """What the command finds. The page's charts are a third of its time: raw photographs have
    them.
    """
    with pytest.MonkeyPatch.context() as patch:
        if not charts:
            patch.setattr(page, "_charts", lambda *given: [])
        done = run_hilstar_here("confront", bench, *images, "-o", output, "--json", *options)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The camera of two raw frames, lost in space with a focal length 5 % off; `percents` are what
    its bar showed.
    """
    folder = tmp_path_factory.mktemp("raw")
    bench = folder / "guess.toml"
    bench.write_text(RAW_BENCH)
    percents: list[int] = []

    @contextlib.contextmanager
    def bar(what: str, total: float) -> Iterator[Callable[[int], None]]:
        assert total == 100
        yield percents.append

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli_confront, "progress", bar)
        found = confronted(bench, RAW[::2], folder / "out", charts=True)
    return folder, found | {"percents": percents}


def test_raw_frames_give_the_camera_that_was_measured_apart(
    raw: tuple[Path, dict[str, Any]],
) -> None:
    _, found = raw
    camera = found["camera"]
    assert abs(206264.8 / camera["focal_length_px"] - 40.33) < 0.05  # arcsec a pixel
    assert 0.06 < camera["distortion"]["k1"] < 0.13
    # 2.64 e- were measured with the pixels' response as if it were photon noise; it is 0.5 % here,
    # and told apart
    assert abs(16 * camera["gain_e_per_dn"] - 2.64) < 0.2
    assert 0.004 < camera["fixed_pattern"]["response"] < 0.007
    assert camera["colour_term"] == pytest.approx(-0.22, abs=0.06)
    assert camera["linearity_power"] == pytest.approx(1.0, abs=0.04)
    assert not camera["tone_curve"]
    # names of the files say 40 and 60 deg: refraction alone told it
    assert [image["altitude_deg"] for image in found["images"]] == pytest.approx([40, 60], abs=6)


def test_a_bar_shows_what_is_done(raw: tuple[Path, dict[str, Any]]) -> None:
    percents = raw[1]["percents"]
    assert percents == sorted(percents) and percents[-1] == 100
    steps = np.diff([0, *percents])
    # two photographs, three fits, the simulator, two verdicts and the page
    assert len(set(percents)) >= 8 and steps.max() <= 25


def test_the_page_has_the_stars_first_by_the_names_of_the_sky(
    raw: tuple[Path, dict[str, Any]],
) -> None:
    text = (raw[0] / "out" / "index.html").read_text()
    titles = re.findall("<h2>(.*?)</h2>", text)
    assert titles[:2] == [path.name for path in RAW[::2]] and titles[-1] == "Notes"
    named = re.findall("<text [^>]*>(.*?)</text>", text)
    assert {"\N{GREEK SMALL LETTER BETA} Cas", "\N{GREEK SMALL LETTER SIGMA} Cas"} < set(named)
    assert len(named) == 2 * page.MAX_NAMED


def test_a_picture_that_is_made_smaller_keeps_its_stars() -> None:
    image = np.zeros((50, 101))
    image[49, 100] = image[7, 20] = 9.0
    small = page.brightest(image, 40)
    assert small.shape == (17, 34) and small.sum() == 18.0
    assert small[16, 33] == small[2, 6] == 9.0
    assert page.brightest(image, 101) is image


def test_raw_frames_agree_within_the_aims(raw: tuple[Path, dict[str, Any]]) -> None:
    _, found = raw
    holds("confronted-places", found["excess"]["rms_px"])
    holds("confronted-light", found["excess"]["rms_mag"])
    assert all(0.9 <= image["background_chi2"] <= 1.1 for image in found["images"])


def test_a_frame_that_was_held_out_agrees_as_well(raw: tuple[Path, dict[str, Any]]) -> None:
    folder, fitted = raw
    tracker = folder / "out" / "tracker.toml"
    found = confronted(tracker, RAW[1:2], folder / "held", "--fixed", "--strict")
    image = found["images"][0]
    assert image["rms_px"] < HELD_OUT * fitted["excess"]["rms_px"]
    assert image["rms_mag"] < HELD_OUT * fitted["excess"]["rms_mag"]
    assert 0.9 <= image["background_chi2"] <= 1.1
    assert not (folder / "held" / "tracker.toml").exists()


def test_frame_and_simulate_take_the_tracker_file(raw: tuple[Path, dict[str, Any]]) -> None:
    folder, found = raw
    tracker, q = (
        folder / "out" / "tracker.toml",
        ",".join(map(str, found["images"][0]["q_icrs_to_cam"])),
    )
    done = run_hilstar_here(
        "simulate", tracker, f"--quaternion={q}", "--dn-png", folder / "like.png"
    )
    assert done.returncode == 0, done.stderr
    assert (
        run_hilstar_here(
            "frame", tracker, f"--quaternion={q}", "--preview", folder / "frame.png"
        ).returncode
        == 0
    )
    levels = [
        float(np.median(np.asarray(Image.open(path)))) for path in (folder / "like.png", RAW[0])
    ]
    # two skies of 3161 and 2032 DN have one mean
    assert levels[0] == pytest.approx(levels[1], rel=0.35)


def photographs(folder: Path, camera: Planted) -> list[Path]:
    """Planted photographs, with WRONG in the first."""
    rng = np.random.default_rng(7)
    paths = []
    for number, pointing in enumerate(SKY.pointings):
        image = photograph(camera, pointing, rng, WRONG if number == 0 else NOTHING_WRONG)
        paths.append(folder / f"planted_{number}.png")
        Image.fromarray(image).save(paths[-1], compress_level=1)
    return paths


def test_a_planted_camera_comes_back_within_its_errors_and_what_was_planted_is_named(
    tmp_path: Path,
) -> None:
    camera = Planted(hot=HOT)
    bench = write_bench(tmp_path / "guess.toml")
    found = confronted(bench, photographs(tmp_path, camera), tmp_path / "out")
    figures = found["camera"]
    sigma = figures["sigma"]
    assert abs(figures["focal_length_px"] - camera.focal_px) < SIGMAS * sigma["focal_length_px"]
    assert abs(figures["distortion"]["k1"] - camera.k1) < SIGMAS * sigma["k1"]
    for value, true, error in zip(
        figures["principal_point_px"], camera.centre_px, sigma["principal_point_px"], strict=True
    ):
        assert abs(value - true) < SIGMAS * error
    assert abs(figures["gain_e_per_dn"] - camera.gain_e_per_dn) < SIGMAS * sigma["gain_e_per_dn"]
    assert figures["colour_term"] == pytest.approx(camera.colour, abs=0.02)
    assert figures["vignetting_mag"][0] == pytest.approx(camera.vignetting_mag, abs=0.03)
    assert figures["hot_pixels"] == len(HOT)
    assert found["images"][0]["dim"][0].startswith("lower right")
    assert not any(image["dim"] for image in found["images"][1:])
    others = [
        r
        for r in csv_rows(tmp_path / "out" / "sources.csv")
        if r["image"] and not r["explained_by"].startswith("HIP ")
    ]
    named = [r for r in others if float(r["snr"]) >= 8]
    words = {r["explained_by"].rstrip("0123456789 pxlong,") for r in named} - {
        "light of a bright star"
    }
    assert sorted(words) == ["", "a hot pixe", "a trai"]
    unexplained = [(float(r["x_px"]), float(r["y_px"])) for r in named if not r["explained_by"]]
    assert len(unexplained) == len(FALSE_STARS)
    for x, y, _ in FALSE_STARS:
        assert min(np.hypot(x - a, y - b) for a, b in unexplained) < NEAR_PX


SITE = """[site]
latitude_deg = 40.0
longitude_deg = 10.0
height_m = 0
extinction = 0.15
"""
TIMES = ("20T20:00:00", "20T23:00:00", "21T01:00:00")  # of September 2020


def test_a_site_tells_air_mass_and_extinction(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # as where photographs are more than memory holds
    monkeypatch.setattr("hilstar.instruments.confront.run.MEMORY_PX", 0)
    camera, rng, paths, wanted = Planted(), np.random.default_rng(8), [], []
    for time in TIMES:
        t_ns = np.datetime64(f"2020-09-{time}", "ns").astype(np.int64)
        up = rotate(
            conjugate(q_icrs_to_enu(np.array([t_ns]), 40.0, 10.0)[0]), np.array([[0.0, 0.0, 1.0]])
        )[0]
        extras = Extras(zenith=tuple(up), k_mag=0.25)
        wanted.append(1 / float(rotation_of(*SKY.pointings[2])[2] @ up))
        paths.append(tmp_path / f"night_2020-09-{time.replace(':', '-')}.png")
        Image.fromarray(photograph(camera, SKY.pointings[2], rng, extras)).save(
            paths[-1], compress_level=1
        )
    found = confronted(write_bench(tmp_path / "guess.toml", more=SITE), paths, tmp_path / "out")
    figures = found["camera"]
    sigma = figures["sigma"]["extinction_beyond_table_mag_per_air_mass"]
    assert abs(figures["extinction_mag_per_air_mass"] - 0.25) < SIGMAS * sigma
    assert sigma < 0.03
    # aberration
    assert (
        abs(figures["focal_length_px"] - camera.focal_px)
        < SIGMAS * figures["sigma"]["focal_length_px"] + 0.3
    )
    masses = [image["air_mass"] for image in found["images"]]
    assert masses == pytest.approx(wanted, abs=0.01)
    assert all(image["rms_px"] < MAX_RMS_PX for image in found["images"])
    # 600 e- in 68.75 arcsec squared, where 6e6 are V = 0; a night sky of that V has more red light
    # than such a star
    assert 19.18 < found["images"][0]["sky_v_mag_arcsec2"] < 19.6
    done = run_hilstar_here(
        f"simulate {tmp_path}/out/tracker.toml --radec 310,40,110 -o {tmp_path}/a.fits"
    )
    assert done.returncode == 0, done.stderr


def test_a_gamma_of_1_8_is_found_and_undone(tmp_path: Path) -> None:
    images = photographs(tmp_path, Planted(gamma=1.8))[1:]
    found = confronted(write_bench(tmp_path / "guess.toml"), images, tmp_path / "out")
    assert found["camera"]["tone_curve"]
    assert 1 / found["camera"]["linearity_power"] == pytest.approx(1.8, abs=0.02)


@pytest.mark.parametrize(
    ("name", "extras", "says"),
    [
        ("empty", Extras(stars=False), "0 sources stand out of its noise"),
        ("focus", Extras(blur_px=9.0), "px wide; focus the lens"),
        ("trailed", Extras(smear_px=30.0), "are trails of about 30 px"),
        ("bright", Extras(sky_times=200.0), "100% of its pixels are saturated at 65535"),
    ],
)
def test_a_photograph_that_cannot_be_used_is_refused_with_what_to_do(
    tmp_path: Path, name: str, extras: Extras, says: str
) -> None:
    image = photograph(Planted(), SKY.pointings[1], np.random.default_rng(3), extras)
    assert_image_refused(tmp_path, image, f"{name}.png", says)


def assert_image_refused(folder: Path, image: np.ndarray[Any, Any], name: str, says: str) -> None:
    Image.fromarray(image).save(folder / name, compress_level=1)
    done = run_hilstar_here(
        "confront", write_bench(folder / "guess.toml"), folder / name, "-o", folder / "out"
    )
    assert done.returncode == 2
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (folder / "out").exists()


def test_mirrored_cropped_and_coloured_photographs_are_told_apart(tmp_path: Path) -> None:
    image = photograph(Planted(), SKY.pointings[1], np.random.default_rng(3))
    assert_image_refused(
        tmp_path, np.ascontiguousarray(image[:, ::-1]), "mirrored.png", "is mirrored"
    )
    assert_image_refused(
        tmp_path, image[:300, :400].copy(), "cropped.png", "write resolution_px = [400, 300]"
    )
    colours = np.stack([image >> 4, image >> 5, image >> 6], axis=2).clip(0, 255).astype(np.uint8)
    assert_image_refused(tmp_path, colours, "rgb.png", "three colours for each pixel")
    rng = np.random.default_rng(9)
    false = tuple(
        (rng.uniform(5, WIDTH - 5), rng.uniform(5, HEIGHT - 5), 10 ** rng.uniform(3.2, 5))
        for _ in range(60)
    )
    other = photograph(Planted(), SKY.pointings[1], rng, Extras(stars=False, false_stars=false))
    assert_image_refused(tmp_path, other, "other.png", "no part of the sky fits them")


def test_what_is_no_image_is_refused_in_one_line(tmp_path: Path) -> None:
    bench = write_bench(tmp_path / "guess.toml")
    (tmp_path / "words.png").write_text("no image")
    shutil.copy(RAW[0], tmp_path / "cut.tiff")
    (tmp_path / "cut.tiff").write_bytes((tmp_path / "cut.tiff").read_bytes()[:5000])
    for name, says in (
        ("words.png", "is no image"),
        ("cut.tiff", "is no image"),
        ("none.fits", "cannot be read"),
    ):
        done = run_hilstar_here("confront", bench, tmp_path / name, "-o", tmp_path / "out")
        assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
        assert says in done.stderr
    done = run_hilstar_here(
        "confront", bench, RAW[0], "-o", tmp_path / "out", "--taken", "yesterday"
    )
    assert done.returncode == 2
    assert "write one such as" in done.stderr


def test_a_date_that_is_ten_years_off_is_told_by_a_fast_star(tmp_path: Path) -> None:
    """61 Cygni moves 5.3 arcsec a year: 0.077 px of the planted camera."""
    pointing = (316.7, 38.7, 40.0)
    image = photograph(Planted(epoch_jyear=2020.0), pointing, np.random.default_rng(2))
    Image.fromarray(image).save(tmp_path / "cygnus.png", compress_level=1)
    bench, by_it = write_bench(tmp_path / "guess.toml"), tmp_path / "2020" / "tracker.toml"
    for file, year, off, options in ((bench, "2020", 0.0, ()), (by_it, "2010", 10.0, ("--fixed",))):
        taken = ("--taken", f"{year}-01-01T00:00:00")
        found = confronted(file, [tmp_path / "cygnus.png"], tmp_path / year, *taken, *options)
        image_figures = found["images"][0]
        assert image_figures["date_off_years"] == pytest.approx(
            off, abs=max(3 * image_figures["date_sigma_years"], 0.5)
        )


def test_a_trail_has_the_name_of_the_satellite_that_passed_there(tmp_path: Path) -> None:
    """The station of 2008, seen from a place beside its path; where it is, Skyfield says."""
    with skyfield() as (times, kernel):
        station = EarthSatellite(*STATION_TLE.splitlines()[1:3], "ISS", times)
        hours = (times.utc(2008, 9, 20, hour) for hour in range(24))
        when = next(t for t in hours if station.at(t).is_sunlit(kernel))
        below = wgs84.subpoint(station.at(when))
        latitude, longitude = below.latitude.degrees - 3, below.longitude.degrees
        seen = station - wgs84.latlon(latitude, longitude)
        ends = [
            seen.at(times.tt_jd(when.tt + seconds / 86400)).radec()[:2]
            for seconds in (-1.0, 0.0, 1.0)
        ]
    places = [np.radians([ra.hours * 15, dec.degrees]) for ra, dec in ends]
    vectors = np.array(
        [(np.cos(d) * np.cos(r), np.cos(d) * np.sin(r), np.sin(d)) for r, d in places]
    )
    pointing = (*np.degrees(places[1]), 0.0)
    x, y, z = rotation_of(*pointing) @ vectors.T
    camera = Planted(epoch_jyear=2008.7, vignetting_mag=0.0)
    trail = [
        (camera.centre_px[0] + 3000 * a / c, camera.centre_px[1] + 3000 * b / c)
        for a, b, c in zip(x, y, z, strict=True)
    ]
    utc = when.utc_datetime().strftime("%Y-%m-%dT%H:%M:%S")
    t_ns = np.datetime64(utc, "ns").astype(np.int64)
    up = rotate(
        conjugate(q_icrs_to_enu(np.array([t_ns]), latitude, longitude)[0]),
        np.array([[0.0, 0.0, 1.0]]),
    )[0]
    extras = Extras(trail_px=(trail[0], trail[2]), zenith=tuple(up))
    Image.fromarray(photograph(camera, pointing, np.random.default_rng(4), extras)).save(
        tmp_path / "pass.png", compress_level=1
    )
    (tmp_path / "tles.txt").write_text(STATION_TLE)
    keys = f"[site]\nlatitude_deg = {latitude}\nlongitude_deg = {longitude}\n"
    keys += '[sky]\nepoch_utc = "2008-09-20T12:00:00Z"\n[sky.bodies]\nsatellites = "tles.txt"\n'
    keys += "moon = true\n"
    bench = write_bench(tmp_path / "guess.toml", more=keys)
    found = confronted(bench, [tmp_path / "pass.png"], tmp_path / "out", "--taken", utc)
    trails = [
        row["explained_by"]
        for row in csv_rows(tmp_path / "out" / "sources.csv")
        if " px long" in row["explained_by"]
    ]
    assert trails
    assert all(text.startswith("ISS (ZARYA), ") for text in trails)
    # the file is one that simulate takes: it has the date that bodies need, and no gain, which one
    # photograph does not tell, but the bench file's
    assert found["camera"]["sigma"].get("gain_e_per_dn") is None
    given = tomllib.loads(bench.read_text())["tracker"].get("detector", {}).get("gain_e_per_dn")
    written = tomllib.loads((tmp_path / "out" / "tracker.toml").read_text())
    assert written["tracker"]["detector"].get("gain_e_per_dn") == given
    assert str(written["sky"]["epoch_utc"]).startswith("2008-09-20")
    radec = ",".join(map(str, pointing))
    words = ("simulate", tmp_path / "out" / "tracker.toml", f"--radec={radec}")
    done = run_hilstar_here(*words, "-o", tmp_path / "a.fits")
    assert done.returncode == 0, done.stderr
