"""[sky.bodies] and [spacecraft] through the commands: who is in the truth table, where, and what
is refused.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from hilstar.basics.rotation import conjugate, from_radec_roll_deg
from hilstar.instruments.simulate.budget import not_drawn
from hilstar.instruments.simulate.star_finder import faintest_e_per_s
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.build import load
from tests.support.commands import run_hilstar_here
from tests.support.skies import STATION_TLE, STATION_UTC, skyfield, utc_ns
from tests.support.sources.aem_messages import kvn
from tests.support.sources.oem_messages import oem, segment
from tests.support.tables import csv_rows

DATED = '[sky]\nepoch_utc = "2026-11-21T00:00:00Z"\n'
BODIES = DATED + "[sky.bodies]\nplanets = true\nmoon = true\nsun = true\n"
JUPITER, MOON = "148.387,13.6125,0", "7.557,7.141,0"
COARSE = '[render]\nquantisation = "round"\nflux_at_white_e_per_s = 5e8\n'
PLACE_ARCSEC = 0.1  # the limit; the header's WCS is exact for a pinhole


@pytest.fixture
def bodies_file(small_bench_file: Path) -> Path:
    small_bench_file.write_text(small_bench_file.read_text() + BODIES)
    return small_bench_file


def read_rows(path: Path) -> list[dict[str, str]]:
    return csv_rows(path)


def frame_of_radec(bench_file: Path, radec: str, *more: str) -> tuple[dict, list[dict[str, str]]]:
    folder = bench_file.parent
    done = run_hilstar_here(
        f"frame {bench_file} --radec {radec} --truth {folder}/t.csv -o {folder}/f.fits --json",
        *more,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), read_rows(folder / "t.csv")


@pytest.mark.parametrize("at_s", [0, 86_400])
def test_planets_in_the_truth_table_are_where_skyfield_has_them(bodies_file, at_s):
    summary, rows = frame_of_radec(bodies_file, JUPITER, "--at", str(at_s))
    named = {row["name"]: row for row in rows if row["name"]}
    assert {"Jupiter", "Mars"} <= set(named)
    assert {row["hip"] for row in named.values()} == {"0"}
    assert "Jupiter" in summary["clipped"]
    assert summary["clipped_mag"]["Jupiter"] > 0.5
    sky = WCS(fits.getheader(bodies_file.parent / "f.fits"))
    with skyfield() as (scale, kernel):
        now = kernel["earth"].at(scale.utc(2026, 11, 21, 0, 0, at_s))
        for name in ("Jupiter", "Mars"):
            ra, dec, _ = now.observe(kernel[f"{name.lower()} barycenter"]).apparent().radec()
            seen = sky.pixel_to_world_values(float(named[name]["x_px"]), float(named[name]["y_px"]))
            off_deg = (seen[0] - ra._degrees) * np.cos(dec.radians), seen[1] - dec.degrees
            assert np.hypot(*off_deg) * 3600 < PLACE_ARCSEC


@pytest.mark.parametrize("at_s", [0, 86_400])
def test_an_attitude_s_brightest_star_is_a_planet_where_it_is_at_the_log_s_time(
    bodies_file, tmp_path, at_s
):
    q = from_radec_roll_deg(*map(float, JUPITER.split(",")))
    rows = [f"{t_s},{','.join(map(repr, q.tolist()))}" for t_s in (0, 86_400)]
    (tmp_path / "log.csv").write_text("\n".join(["t_s,qw,qx,qy,qz", *rows]))
    options = ("--time", at_s, "--bench", bodies_file, "--json")
    done = run_hilstar_here("attitude", tmp_path / "log.csv", *options)
    brightest = json.loads(done.stdout)["stars"][0]
    assert brightest["name"] == "Jupiter"
    with skyfield() as (scale, kernel):
        now = kernel["earth"].at(scale.utc(2026, 11, 21, 0, 0, at_s))
        ra, dec, _ = now.observe(kernel["jupiter barycenter"]).apparent().radec()
    off_deg = (
        (brightest["ra_deg"] - ra._degrees) * np.cos(dec.radians),
        (brightest["dec_deg"] - dec.degrees),
    )
    assert np.hypot(*off_deg) * 3600 < PLACE_ARCSEC


def test_wide_bodies_are_said_to_be_discs(bodies_file):
    done = run_hilstar_here(
        "frame", bodies_file, "--radec", MOON, "--codes", bodies_file.parent / "c.png", "--explain"
    )
    assert "Moon: 1897" in done.stderr and "drawn as a disc" in done.stderr
    assert "Neptune" not in done.stderr
    assert "clipped: Moon by" in done.stdout


def test_the_virtual_tracker_sees_the_same_bodies(bodies_file):
    folder = bodies_file.parent
    done = run_hilstar_here(
        "simulate", bodies_file, "--radec", MOON, "-o", folder / "s.fits", "--json"
    )
    assert json.loads(done.stdout)["clipped"] == ["Moon"]
    truth = fits.getdata(folder / "s.fits", extname="TRUTH")
    assert truth["name"][truth["hip"] == 0].tolist() == ["Moon"]


def test_the_sun_in_view_overflows_nothing(bodies_file):
    """1.6e18 electrons/s in one point: a detector's wells are full, the screen is white, and
    both say so.
    """
    for path, command in (("s.fits", ("simulate", "-o")), ("c.png", ("frame", "--codes"))):
        done = run_hilstar_here(
            f"{command[0]} {bodies_file} --radec 236.056,-19.779,0 {command[1]} "
            f"{bodies_file.parent}/{path} --json"
        )
        assert done.returncode == 0, done.stderr
        assert "Sun" in json.loads(done.stdout)["clipped"]


def test_verify_knows_bodies_and_says_which_are_discs(bodies_file):
    done = run_hilstar_here("verify", bodies_file, "--fields", "2", "--json")
    discs = json.loads(done.stdout)["drawn_as_discs"]
    assert [line.split(":")[0] for line in discs][:2] == ["Sun", "Moon"]


def test_a_frame_s_time_moves_bodies_and_comes_back_bit_for_bit(bodies_file):
    q = from_radec_roll_deg(7.557, 7.141, 0.0)
    with load(bodies_file) as bench:
        first = bench.draw(q, t_ns=5_000_000_000).levels.copy()
        later = bench.draw(q, t_ns=600_000_000_000).levels.copy()
        assert np.array_equal(bench.draw(q, t_ns=5_000_000_000).levels, first)
        assert not np.array_equal(first, later)
        # 0.49 to 0.66 arcsec/s for 595 s, at 198 arcsec to a pixel, both middles within 0.1 px
        middle = [np.argwhere(levels == levels.max()).mean(axis=0) for levels in (first, later)]
        assert 1.37 < np.linalg.norm(middle[1] - middle[0]) < 2.1


def test_shares_of_light_are_the_stars_own(bodies_file):
    """The Sun's light is that of all stars many times over, and faint Neptune lights no pixel
    beside so bright a white.
    """
    text = bodies_file.read_text() + COARSE
    bodies_file.write_text(text)
    with load(bodies_file) as bench:
        with_bodies = not_drawn(bench.stars, bench.drive, bench.faintest_shown_e_per_s)
        assert (
            faintest_e_per_s(bench)
            >= bench.faintest_shown_e_per_s
            > bench.stars.electrons_per_s.min()
        )
    bodies_file.write_text(
        text.split("[sky.bodies]")[0] + '[spacecraft]\norbit = "geocentre"\n' + COARSE
    )
    with load(bodies_file) as bench:
        without = not_drawn(bench.stars, bench.drive, bench.faintest_shown_e_per_s)
    assert without == with_bodies
    assert with_bodies.stars > 0


def test_a_run_s_ledger_replays_bodies_bit_for_bit_and_summaries_name_what_clips(bodies_file):
    """From a log of ten minutes that looks at the Moon: it crosses 300 arcsec, one and a half
    pixels.
    """
    folder = bodies_file.parent
    q = from_radec_roll_deg(7.557, 7.141, 0.0)
    rows = [f"{t},{','.join(map(repr, q.tolist()))}" for t in range(0, 601, 60)]
    (folder / "log.csv").write_text("\n".join(["t_s,qw,qx,qy,qz", *rows]) + "\n")
    more = ("--headless", "--speed", "max", "--json")
    first = run_hilstar_here(
        f"replay {bodies_file} {folder}/log.csv --step 60 --ledger {folder}/run.mcap -o {folder}/a",
        *more,
    )
    assert first.returncode == 0, first.stderr
    assert "brighter than white" in first.stderr and "Sun" in first.stderr
    summary = json.loads(first.stdout)
    assert (summary["frames"], summary["clipped"]) == (
        11,
        {"max": 2, "hip": [], "bodies": ["Moon", "Saturn"]},
    )
    assert (
        run_hilstar_here(
            "replay", bodies_file, folder / "run.mcap", "-o", folder / "b", *more
        ).returncode
        == 0
    )
    frames = [sorted((folder / name).glob("*.png")) for name in "ab"]
    assert len(frames[0]) == 11
    assert [path.read_bytes() for path in frames[0]] == [path.read_bytes() for path in frames[1]]
    assert frames[0][0].read_bytes() != frames[0][-1].read_bytes()


def test_attitude_names_the_bodies_in_view(bodies_file):
    folder = bodies_file.parent
    q = from_radec_roll_deg(7.557, 7.141, 0.0)
    (folder / "log.csv").write_text("t_s,qw,qx,qy,qz\n0," + ",".join(map(repr, q.tolist())) + "\n")
    done = run_hilstar_here("attitude", folder / "log.csv", "--bench", bodies_file)
    assert "Moon, V -11.51, in Pisces" in done.stdout, done.stderr


def test_a_bench_s_hash_covers_its_elements(bodies_file):
    (bodies_file.parent / "station.tle").write_text(STATION_TLE)
    bodies_file.write_text(bodies_file.read_text() + '[spacecraft]\norbit = "station.tle"\n')
    before = read_bench_file(bodies_file).sha256
    (bodies_file.parent / "station.tle").write_text(STATION_TLE.replace("ISS", "Mir"))
    assert read_bench_file(bodies_file).sha256 != before


def test_from_a_low_orbit_the_moon_is_elsewhere(bodies_file):
    (bodies_file.parent / "station.tle").write_text(STATION_TLE)
    text = bodies_file.read_text().replace("2026-11-21T00:00:00Z", "2008-09-20T12:30:00Z")
    bodies_file.write_text(text)
    from_the_middle = load(bodies_file)
    bodies_file.write_text(text + '[spacecraft]\norbit = "station.tle"\n')
    with from_the_middle, load(bodies_file) as bench:
        moon = bench.stars.bodies.index("Moon") - len(bench.stars.bodies)
        apart_deg = np.degrees(
            np.linalg.norm(bench.stars.vectors[moon] - from_the_middle.stars.vectors[moon])
        )
        assert 0.1 < apart_deg < 1.1


def test_an_oem_of_the_same_orbit_shows_the_same_moon(bodies_file):
    (bodies_file.parent / "station.tle").write_text(STATION_TLE)
    (bodies_file.parent / "station.oem").write_text(oem(segment(range(0, 600, 60))))
    text = bodies_file.read_text().replace("2026-11-21T00:00:00Z", STATION_UTC)
    places = []
    for orbit in ("station.tle", "station.oem"):
        bodies_file.write_text(text + f'[spacecraft]\norbit = "{orbit}"\n')
        with load(bodies_file) as bench:
            places.append(
                bench.stars.vectors[
                    bench.stars.bodies.index("Moon") - len(bench.stars.bodies)
                ].copy()
            )
    # a microarcsecond; metres in their distance
    assert places[0] == pytest.approx(places[1], abs=5e-12)


def test_an_aem_s_dates_and_an_oem_alongside_that_covers_minutes_of_its_day(bodies_file):
    folder = bodies_file.parent
    (folder / "station.oem").write_text(oem(segment(range(0, 600, 60))))
    (folder / "station.aem").write_text(
        kvn(["2008-09-20T12:31:00 0 0 0 1", "2008-09-20T12:32:00 0 0 0 1"])
    )
    text = bodies_file.read_text().replace("2026-11-21T00:00:00Z", "source")
    bodies_file.write_text(text + '[spacecraft]\norbit = "station.oem"\n')
    done = run_hilstar_here(
        "attitude", folder / "station.aem", "--bench", bodies_file, "--time", "30"
    )
    # how the tracker is mounted
    assert (done.returncode, done.stderr.count("\n")) == (0, 1), done.stderr


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("[sky.bodies]\nmoon = true\n", "need a date; write [sky] epoch_utc"),
        ('[spacecraft]\norbit = "geocentre"\n', "need a date; write [sky] epoch_utc"),
        (DATED + "epoch_jyear = 2026.0\n", "has epoch_utc and epoch_jyear; write one of them"),
        ('[sky]\nepoch_utc = "yesterday"\n', "epoch_utc = yesterday: write a UTC such as"),
        (
            DATED + "observer_velocity_km_s = [0, 29.8, 0]\n[sky.bodies]\nmoon = true\n",
            "follows from the ephemeris; leave it out",
        ),
        (DATED + '[spacecraft]\norbit = "none.tle"\n', "none.tle: cannot be read"),
        (
            DATED + "[sky.bodies]\nearth = true\n",
            "from its centre no Earth is seen; write [spacecraft] orbit =",
        ),
        (
            DATED + '[sky.bodies]\nearth = true\n[spacecraft]\norbit = "geocentre"\n',
            "from its centre no Earth is seen",
        ),
        (
            DATED + '[spacecraft]\norbit = "source"\n',
            'only "vizard" (Basilisk) sends the spacecraft\'s place',
        ),
        (
            DATED + '[spacecraft]\norbit = "source"\n[attitude]\nsource = "vizard"\nuse_velocity ='
            " false\n",
            "takes the source's place and velocity; leave use_velocity out",
        ),
        (
            '[sky]\nepoch_utc = "1850-01-01T00:00:00Z"\n[sky.bodies]\nmoon = true\n',
            "the ephemeris covers 1899-07-30 to",
        ),
    ],
)
def test_keys_that_make_no_sky_are_refused_in_one_line(small_bench_file, more, words):
    small_bench_file.write_text(small_bench_file.read_text() + more)
    done = run_hilstar_here(
        "frame", small_bench_file, "--radec", MOON, "--truth", small_bench_file.parent / "t.csv"
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert words in done.stderr and done.stderr.count("\n") == 1


def test_a_time_for_a_sky_that_stands_still_is_refused(small_bench_file):
    for command in (("frame", "--truth", "t.csv"), ("simulate", "-o", "s.fits")):
        done = run_hilstar_here(
            command[0], small_bench_file, "--radec", MOON, *command[1:], "--at", "3"
        )
        assert done.returncode == 2
        assert "nothing moves in this sky" in done.stderr


def test_without_the_extra_the_machine_lacks_something(bodies_file, monkeypatch):
    monkeypatch.setitem(sys.modules, "skyfield_data", None)
    done = run_hilstar_here(
        "frame", bodies_file, "--radec", MOON, "--truth", bodies_file.parent / "t.csv"
    )
    assert done.returncode == 3
    assert "pip install 'hilstar[bodies]'" in done.stderr


def test_a_bench_without_bodies_has_no_name_in_its_table(small_bench_file):
    _, rows = frame_of_radec(small_bench_file, MOON)
    assert {row["name"] for row in rows} == {""}


def test_a_date_alone_places_the_stars_of_that_year(small_bench_file):
    plain = small_bench_file.read_text()
    small_bench_file.write_text(plain + DATED)
    with load(small_bench_file) as bench:
        dated = bench.stars.vectors
        assert bench.moving is None
        assert bench.config.sky.epoch_jyear == pytest.approx(
            2000 + (utc_ns("2026-11-21") / 86_400e9 - 10_957.5) / 365.25
        )
    small_bench_file.write_text(
        plain + f"[sky]\nepoch_jyear = {2000 + (20778 - 10957.5) / 365.25!r}\n"
    )
    with load(small_bench_file) as bench:
        assert np.array_equal(bench.stars.vectors, dated)


# TAI and GPS are 37 and 18 s ahead of UTC, TT 69.184 s and TDB within 2 ms of it.
SCALES = {"UTC": 0.0, "TAI": 37.0, "GPS": 18.0, "TT": 69.184, "TDB": 69.184}


def moon_message(path: Path, scale: str) -> Path:
    """An AEM of a minute from 2026-11-21 0:00 UTC on, with the Moon on the boresight."""
    epochs = [
        str(np.datetime64(round((second + SCALES[scale]) * 1e9) + utc_ns("2026-11-21"), "ns"))
        for second in (0, 60)
    ]
    q = conjugate(from_radec_roll_deg(7.557, 7.141, 0.0))
    rows = [f"{epoch} {' '.join(map(repr, np.roll(q, -1).tolist()))}" for epoch in epochs]
    keys = {
        "REF_FRAME_B": "CAM",
        "TIME_SYSTEM": scale,
        "START_TIME": epochs[0],
        "STOP_TIME": epochs[1],
    }
    path.write_text(kvn(rows, **keys))
    return path


def moon_px(*arguments: str | Path) -> tuple[float, float]:
    """Where `hilstar attitude` has the Moon in the tracker's image."""
    done = run_hilstar_here("attitude", *arguments, "--json")
    assert done.returncode == 0, done.stderr
    moon = json.loads(done.stdout)["stars"][0]
    assert moon["name"] == "Moon"
    return moon["x_px"], moon["y_px"]


@pytest.mark.parametrize("scale", SCALES)
def test_the_dates_of_a_message_place_bodies_on_its_own_time_scale(bodies_file, scale):
    q = ",".join(map(repr, from_radec_roll_deg(7.557, 7.141, 0.0).tolist()))
    (bodies_file.parent / "log.csv").write_text(f"t_s,qw,qx,qy,qz\n0,{q}\n")
    stated = moon_px(bodies_file.parent / "log.csv", "--bench", bodies_file)
    bodies_file.write_text(bodies_file.read_text().replace("2026-11-21T00:00:00Z", "source"))
    dated = moon_px(moon_message(bodies_file.parent / "log.aem", scale), "--bench", bodies_file)
    # 2 ms of the Moon are 0.0012 arcsec, 3e-5 px; a microsecond of rounding is nothing
    assert np.hypot(*np.subtract(stated, dated)) < 4e-5


def test_a_message_with_dates_is_replayed_on_them(bodies_file):
    bodies_file.write_text(bodies_file.read_text().replace("2026-11-21T00:00:00Z", "source"))
    log = moon_message(bodies_file.parent / "log.aem", "TAI")
    done = run_hilstar_here(
        f"replay {bodies_file} {log} --headless --speed max --step 30 --json --explain"
    )
    assert done.returncode == 0, done.stderr
    assert "Moon: 1897" in done.stderr
    assert json.loads(done.stdout)["clipped"]["bodies"] == ["Moon", "Saturn"]


@pytest.mark.parametrize(
    "command", [("frame", "--radec", MOON, "--truth"), ("simulate", "--radec", MOON, "-o")]
)
def test_dates_of_a_source_are_refused_where_there_is_none(bodies_file, command):
    bodies_file.write_text(bodies_file.read_text().replace("2026-11-21T00:00:00Z", "source"))
    done = run_hilstar_here(
        command[0],
        bodies_file,
        *command[1:],
        bodies_file.parent / ("t.csv" if "--truth" in command else "s.fits"),
    )
    assert done.returncode == 2
    assert "is for a log that has dates" in done.stderr and done.stderr.count("\n") == 1


def test_a_log_without_dates_gives_none(bodies_file):
    bodies_file.write_text(bodies_file.read_text().replace("2026-11-21T00:00:00Z", "source"))
    (bodies_file.parent / "log.csv").write_text("t_s,qw,qx,qy,qz\n0,1,0,0,0\n1,1,0,0,0\n")
    done = run_hilstar_here("replay", bodies_file, bodies_file.parent / "log.csv", "--headless")
    assert done.returncode == 2
    assert (
        "are no dates in UTC, TAI, TT, TDB or GPS" in done.stderr and done.stderr.count("\n") == 1
    )


def test_without_a_source_s_message_the_earth_is_not_there_and_explain_says_so(small_bench_file):
    source = (
        '[sky.bodies]\nearth = true\n[spacecraft]\norbit = "source"\n[attitude]\nsource ='
        ' "vizard"\n'
    )
    small_bench_file.write_text(small_bench_file.read_text() + DATED + source)
    folder = small_bench_file.parent
    done = run_hilstar_here(
        "frame", small_bench_file, "--radec", MOON, "--truth", folder / "t.csv", "--explain"
    )
    assert done.returncode == 0, done.stderr
    assert "seen from the Earth's centre, without the Earth" in done.stderr
    assert "Earth" not in {row["name"] for row in read_rows(folder / "t.csv")}
    (folder / "station.tle").write_text(STATION_TLE)
    text = (
        small_bench_file.read_text()
        .replace('orbit = "source"', 'orbit = "station.tle"')
        .replace('source = "vizard"', "")
    )
    text = text.replace("2026-11-21T00:00:00Z", STATION_UTC)
    small_bench_file.write_text(text)
    from_orbit = run_hilstar_here(
        "frame", small_bench_file, "--radec", MOON, "--truth", folder / "t.csv", "--explain"
    )
    assert "Earth: 143" in from_orbit.stderr and "drawn as a disc" in from_orbit.stderr, (
        from_orbit.stderr
    )
