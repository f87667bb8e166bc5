"""Satellites in a bench's frames and its virtual tracker: names, streaks and light in the truth,
and what is said of them.
"""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.instruments.campaign.display_tracker import DisplayTracker
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.optics.layers.view import View
from hilstar.optics.trails import DiscTrail, hidden
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.build import load
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.star_light import bench_moving
from hilstar.sky.bodies.disc import Disc
from hilstar.sky.bodies.passes import Cone
from tests.support.benches import bench_text
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.refusals import refusal
from tests.support.satellites import element_set, some_orbits
from tests.support.skies import STATION_TLE, STATION_UTC
from tests.support.stars import sprites_at

pytestmark = pytest.mark.gpu
S_NS = 10**9
AT_S = 4000
NORTH = np.array([0.0, 0.0, 1.0])
TABLE = "norad,standard_mag\n" + "".join(f"{10_000 + k},{3}\n" for k in range(60))


@pytest.fixture
def tle_bench(tmp_path, rng) -> Path:
    (tmp_path / "tles.txt").write_text(
        some_orbits(rng, 60) + "OLD\n" + element_set(5, (10.0, 0.0, 0.0, 0.0), 0.001, 18.0)
    )
    (tmp_path / "station.tle").write_text(STATION_TLE)
    (tmp_path / "seen.csv").write_text(TABLE)
    path = tmp_path / "bench.toml"
    more = {
        "sky": {"epoch_utc": STATION_UTC},
        "sky.bodies": {"satellites": "tles.txt", "satellite_magnitudes": "seen.csv"},
        "spacecraft": {"orbit": "station.tle"},
        "tracker": {"exposure_s": 0.5},
    }
    path.write_text(bench_text(more))
    return path


def brightest(bench: Bench, t_ns: int) -> tuple[str, tuple[float, float], float]:
    """The name of a bright and fast satellite at a moment, its right ascension and declination,
    and its rate.
    """
    seen = bench.moving.passing(Cone(NORTH, np.pi, 0.0), t_ns)
    now = np.zeros(len(seen))
    rates = seen.rates_e_per_s(np.arange(len(seen)), now, now)
    k = int(np.argmax(rates * seen.speeds_rad_s()))
    x, y, z = seen.directions(slice(None), now)[k]
    place = float(np.degrees(np.arctan2(y, x))) % 360, float(np.degrees(np.arcsin(z)))
    return bench.moving.satellites.names[seen.index[k]], place, float(rates[k])


def test_a_frame_its_truth_and_a_run_s_frame_have_the_same_satellite(tle_bench):
    with load(tle_bench) as bench:
        t_ns = AT_S * S_NS
        name, place, rate = brightest(bench, t_ns)
        q = from_radec_roll_deg(*place, 20.0)
        shot = bench.frame(q, t_ns=t_ns)
        (row,) = shot.truth[shot.truth["name"] == name]
        assert (row["hip"], row["drawn"]) == (0, True)
        assert row["electrons_per_s"] == pytest.approx(rate, rel=1e-4)
        middle = [(size - 1) / 2 for size in bench.camera.resolution_px]
        # 200 arcsec a px; 10 by the velocity since
        assert (row["x_px"], row["y_px"]) == pytest.approx(middle, abs=0.1)
        assert (
            len(np.unique(shot.truth["name"][shot.truth["hip"] == 0]))
            == (shot.truth["hip"] == 0).sum()
        )
        wide = shot.linear[
            int(row["y_px"]) - 12 : int(row["y_px"]) + 13,
            int(row["x_px"]) - 12 : int(row["x_px"]) + 13,
        ]
        assert wide.sum() >= 0.999 * row["electrons_per_s"]
        drawn = bench.draw(q, t_ns=t_ns)
        assert np.array_equal(drawn.levels, shot.levels)
        sprites = bench.light(bench.view(q, np.array([0.0, 0.02, 0.0]), t_ns))
        first = len(bench.shown_stars) - len(bench.shown_stars.bodies)
        assert (
            bench.shown_stars.names(np.unique(sprites.star[sprites.star >= first])).count(name) == 1
        )


def test_a_satellite_has_the_sun_s_light_whatever_else_the_sky_shows(tle_bench):
    file = read_bench_file(tle_bench)
    rates = []
    for moon in (False, True):
        bodies = structs.replace(file.config.sky.bodies, moon=moon)
        sky = structs.replace(file.config.sky, bodies=bodies)
        moving = bench_moving(structs.replace(file.config, sky=sky), file.folder)
        seen = moving.passing(Cone(NORTH, np.pi, 0.0), AT_S * S_NS)
        now = np.zeros(len(seen))
        rates.append(seen.rates_e_per_s(np.arange(len(seen)), now, now))
    assert np.nanmax(rates[0]) > 0
    np.testing.assert_allclose(*rates, rtol=1e-9)


@pytest.mark.parametrize(("share", "is_drawn"), [(0.99, True), (1.01, False)])
def test_a_run_s_frame_has_no_satellite_fainter_than_the_monitor_shows(tle_bench, share, is_drawn):
    with load(tle_bench) as bench:
        t_ns = AT_S * S_NS
        name, place, rate = brightest(bench, t_ns)
        view = bench.view(from_radec_roll_deg(*place, 20.0), None, t_ns)
        of_monitor = replace(bench, faintest_shown_e_per_s=share * rate)
        drawn = np.unique(of_monitor.light(view).star)
        assert (name in bench.shown_stars.names(drawn)) is is_drawn


def test_each_frame_of_an_exposure_has_the_satellites_of_its_own_time(tle_bench, monkeypatch):
    """Six frames of 60 Hz in a tenth of a second, about its middle."""
    drawn = []
    draw = Bench.draw

    def seen(bench, q, frame, t_ns):
        drawn.append(t_ns - AT_S * S_NS)
        return draw(bench, q, frame, t_ns=t_ns)

    monkeypatch.setattr(Bench, "draw", seen)
    text = tle_bench.read_text().replace("[1024, 1024]", "[64, 64]")
    tle_bench.write_text(text.replace("[sky]", "[sky]\nfaintest_v_mag = 3.0"))
    display = DisplayTracker(read_bench_file(tle_bench))
    q = from_radec_roll_deg(84.0, 0.0, 0.0)
    display.expose(View.exposure(q, np.zeros(3), 0.1, AT_S * S_NS), None)
    display.close()
    assert np.array(drawn) / S_NS * 120 == pytest.approx([-5, -3, -1, 1, 3, 5], abs=1e-6)


@pytest.mark.parametrize(("name", "limit_mb"), [("tles.txt", 20), ("seen.csv", 5)])
def test_a_list_of_satellites_and_a_table_of_them_have_their_limits(tle_bench, name, limit_mb):
    path = tle_bench.with_name(name)
    os.truncate(path, limit_mb * 10**6 + 1)
    file = read_bench_file(tle_bench)
    line = refusal(bench_moving, file.config, file.folder)
    assert line.startswith(f"{path}: ") and f"and at most {limit_mb} MB are read" in line


def fast_moment(bench: Bench) -> int:
    """A time at which a lit satellite is faster than half a degree a second."""
    for t_ns in range(0, 20_000 * S_NS, 40 * S_NS):
        seen = bench.moving.passing(Cone(NORTH, np.pi, 0.0), t_ns)
        name = brightest(bench, t_ns)[0]
        if (
            seen.speeds_rad_s()[[bench.moving.satellites.names[k] for k in seen.index].index(name)]
            > 0.009
        ):
            return t_ns
    raise AssertionError("there is none")


def test_a_camera_that_follows_a_satellite_has_it_as_a_point_and_stars_as_streaks(tle_bench):
    """In the virtual tracker, over half a second; at rest it is the other way round, with the
    same light.
    """
    with load(tle_bench) as bench, Simulator(read_bench_file(tle_bench)) as tracker:
        t_ns = fast_moment(bench)
        name, place, _ = brightest(bench, t_ns)
        q = from_radec_roll_deg(*place, 0.0)
        before, after = (brightest(bench, t_ns + k)[1] for k in (-S_NS // 4, S_NS // 4))
        ways = [
            np.array([np.cos(d) * np.cos(r), np.cos(d) * np.sin(r), np.sin(d)])
            for r, d in np.radians([before, after])
        ]
        turn = np.cross(ways[0], ways[1]) * 2  # rad/s about ICRS axes
        rate = to_matrix(q) @ turn
        found = [tracker.expose(tracker.view(q, one, t_ns), None) for one in (rate, np.zeros(3))]
        rows = [shot.truth[shot.truth["name"] == name][0] for shot in found]
        assert rows[0]["electrons_per_s"] == pytest.approx(rows[1]["electrons_per_s"], rel=1e-3)
        peaks = [shot.mean_e[509:515, 509:515].sum() for shot in found]
        assert peaks[0] == pytest.approx(0.5 * rows[0]["electrons_per_s"], rel=0.02)
        assert peaks[1] < 0.8 * peaks[0]
        assert (rows[0]["x_px"], rows[0]["y_px"]) == pytest.approx(
            (511.5, 511.5), abs=0.3
        )  # 38 arcsec a px; 10 by the velocity since


SIZE_M = 20_000


def test_one_with_a_size_is_a_disc_with_its_light_which_hides_stars(tle_bench):
    """Against the same one as a point: the same light, half of it dark, its width that of its
    size and distance.
    """
    with load(tle_bench) as bench:
        t_ns = fast_moment(bench)
        name, place, _ = brightest(bench, t_ns)
        number = bench.moving.satellites._satellites[
            bench.moving.satellites.names.index(name)
        ].number
    (tle_bench.parent / "seen.csv").write_text(f"norad,standard_mag,size_m\n{number},3,{SIZE_M}\n")
    tle_bench.write_text(tle_bench.read_text().replace("[sky]", "[sky]\nfaintest_v_mag = 2.5"))
    q = from_radec_roll_deg(*place, 0.0)
    with load(tle_bench) as bench:
        shot = bench.frame(q, t_ns=t_ns)
        (disc,) = bench.discs(bench.view(q, None, t_ns))
        assert disc.name == name
        (row,) = shot.truth[shot.truth["name"] == name]
        lit = shot.linear.astype(np.float64)
        bench.moving.satellites.sized = False  # as a point
        point = bench.frame(q, t_ns=t_ns)
        (as_point,) = point.truth[point.truth["name"] == name]
        assert row["electrons_per_s"] == pytest.approx(as_point["electrons_per_s"], rel=1e-3)
        assert lit.sum() - point.linear.sum(dtype=np.float64) == pytest.approx(
            0, abs=0.005 * row["electrons_per_s"]
        )
        width_px = 2 * disc.radius_rad * bench.camera.focal_length_px
        assert width_px > 3
        near = lit[80:160, 120:200]  # 320 x 240
        seen = np.argwhere(near > 0.05 * near.max())
        # of 24, along the terminator, blurred
        assert np.abs(np.ptp(seen, axis=0) - width_px).min() < 3
        assert (row["x_px"], row["y_px"]) == pytest.approx(
            (as_point["x_px"], as_point["y_px"]), abs=1.5
        )
    with Simulator(read_bench_file(tle_bench)) as tracker:
        found = tracker.expose(tracker.view(q, np.zeros(3), t_ns), None)
        (of_exposure,) = found.truth[found.truth["name"] == name]
        whole_e = found.mean_e.sum()
        assert whole_e > 0.45 * of_exposure["electrons_per_s"]


def test_stars_behind_a_disc_lose_the_share_of_the_time_in_which_it_is_before_them():
    disc = Disc("s", NORTH, 100.0, 1.0, 1.0, NORTH, -NORTH, "lambert")
    aside = replace(disc, direction=np.array([0.0, np.sin(0.1), np.cos(0.1)]))
    trail = DiscTrail(0, 1.0, NORTH, (disc, disc, aside, aside), np.full(4, 0.25), (), 0.0)
    three = np.array([NORTH, aside.direction, [0.0, np.sin(0.05), np.cos(0.05)]])
    left = hidden(sprites_at(np.zeros((3, 2)), np.array([8.0, 4.0, 2.0]), 5), three, trail)
    assert left.data["electrons_per_s"].tolist() == [4.0, 2.0, 2.0]
    gone = DiscTrail(0, 1.0, NORTH, (disc,), np.ones(1), (), 0.0)
    assert hidden(left, three, gone).star.tolist() == [1, 2]


def test_frame_explains_them_and_attitude_and_verify_know_them(tle_bench):
    with load(tle_bench) as bench:
        name, place, _ = brightest(bench, 0)
    radec = f"{place[0]:.5f},{place[1]:.5f},0"
    done = run_hilstar_here(
        "frame", tle_bench, "--radec", radec, "--truth", tle_bench.parent / "t.csv", "--explain"
    )
    assert done.returncode == 0, done.stderr
    assert (
        "satellites: 60 of 61 have a place by their elements; 60 are in [sky.bodies]"
        " satellite_magnitudes" in done.stderr
    )
    assert done.stderr.count("OLD") == 1
    assert name in (tle_bench.parent / "t.csv").read_text()
    assert run_hilstar_here("verify", tle_bench, "--fields", "1", "--json").returncode == 0
    budget = run_hilstar_here("budget", tle_bench, "--json")
    assert budget.returncode == 0, budget.stderr
    # by stars: of satellites elsewhere no magnitude is known
    assert json.loads(budget.stdout)["clips_v_mag"] < 3


def assert_frame_refused(bench, words):
    done = run_hilstar_here("frame --radec 0,0,0", bench, "--truth", bench.parent / "t.csv")
    assert_refused(done, 2, words)


@pytest.mark.parametrize(
    ("named", "text", "said"),
    [
        ("tles.txt", None, "tles.txt: cannot be read"),
        (
            "tles.txt",
            STATION_TLE.replace("2927", "2928"),
            "tles.txt:2: its digits add up to 7, not 8",
        ),
        ("tles.txt", "SIMPLE  =  T", "tles.txt: cannot be read (it is a FITS file)"),
        ("seen.csv", "norad,mag\n1,2\n", "seen.csv:1: no column 'mag' is known"),
        ("seen.csv", None, "seen.csv: cannot be read"),
    ],
)
def test_a_wrong_file_is_one_line_and_exit_code_2(tle_bench, named, text, said):
    path = tle_bench.parent / named
    path.unlink()
    if text is not None:
        path.write_text(text)
    assert_frame_refused(tle_bench, said)


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("satellites =", 'satellite_magnitudes is of no satellites; write satellites = "tles.txt"'),
        ("epoch_utc", "need a date"),
    ],
)
def test_a_table_without_a_list_and_satellites_without_a_date_are_refused(tle_bench, key, said):
    tle_bench.write_text(tle_bench.read_text().replace(key, f"# {key}"))
    assert_frame_refused(tle_bench, said)


def test_the_bench_s_hash_covers_both_files(tle_bench):
    hashes = {read_bench_file(tle_bench).sha256}
    for name in ("tles.txt", "seen.csv"):
        path = tle_bench.parent / name
        path.write_text(path.read_text() + "\n")
        hashes.add(read_bench_file(tle_bench).sha256)
    assert len(hashes) == 3


def test_a_tracker_before_the_display_sees_the_streak_that_one_before_the_sky_sees(tle_bench):
    """Frame by frame, each with the satellite's path while it is held; the small screen covers a
    part of the detector.
    """
    with load(tle_bench) as bench:
        t_ns = fast_moment(bench)
        name, place, _ = brightest(bench, t_ns)
    text = tle_bench.read_text().replace("[sky]", "[sky]\nfaintest_v_mag = 2.5")
    tle_bench.write_text(text.replace("transmission", "psf_sigma_px = [1.0, 1.0]\ntransmission", 1))
    q, file = from_radec_roll_deg(*place, 0.0), read_bench_file(tle_bench)
    display = DisplayTracker(file)
    with Simulator(file) as tracker:
        of_sky, of_display = (
            one.expose(tracker.view(q, np.zeros(3), t_ns), None) for one in (tracker, display)
        )
    display.close()
    rows = [shot.truth[shot.truth["name"] == name][0] for shot in (of_sky, of_display)]
    assert (rows[0]["x_px"], rows[0]["y_px"]) == pytest.approx(
        (rows[1]["x_px"], rows[1]["y_px"]), abs=0.01
    )
    middles, lengths = [], []
    for shot in (of_sky, of_display):
        light = shot.mean_e[480:544, 480:544] - np.median(shot.mean_e[480:544, 480:544])
        light[light < 0.02 * light.max()] = 0.0
        y, x = np.indices(light.shape)
        at = np.array([(light * x).sum(), (light * y).sum()]) / light.sum()
        minor, major = np.linalg.eigvalsh(
            np.cov(np.stack([x.ravel(), y.ravel()]), aweights=light.ravel())
        )
        middles.append(at)
        lengths.append(np.sqrt(major - minor))  # the screen's sprites are wider, in every direction
    assert middles[1] == pytest.approx(middles[0], abs=0.3)
    assert lengths[1] == pytest.approx(lengths[0], rel=0.1)
    assert lengths[0] > 3
