"""hilstar attitude: where a log or a stream points, against Astropy and SciPy."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord
from scipy.spatial.transform import Rotation

from hilstar.sky.catalog import load_catalog
from tests.support.benches import SMALL_BENCH, attitude_table, bench_text
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.senders import free_port, publisher, talking
from tests.support.sources.aem_messages import kvn, rows_of

# A catalogue place is of 1991.25 and this of the bench's epoch: Hipparcos' fastest star moves by 10
# arcsec a year.
MOTION_DEG = 0.2
ROUNDING_DEG = 1e-9


def log_of(tmp_path: Path, rows: list[tuple[float, list[float]]]) -> Path:
    path = tmp_path / "log.csv"
    lines = [f"{t_s},{','.join(map(repr, q))}" for t_s, q in rows]
    path.write_text("\n".join(["t_s,qw,qx,qy,qz", *lines]))
    return path


def told_attitude(*arguments: object) -> dict:
    result = run_hilstar_here("attitude", *arguments, "--json")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def test_an_attitude_of_a_log_s_gap_is_said_to_be_held(tmp_path, small_bench_file):
    q = [0.5, 0.5, -0.5, 0.5]
    log = log_of(tmp_path, [(t_s, q) for t_s in (0.0, 1.0, 2.0, 3.0, 60.0, 61.0)])
    between, in_gap = (
        told_attitude(log, "--time", t_s, "--bench", small_bench_file) for t_s in (1.5, 30)
    )
    assert (between["held"], in_gap["held"]) == (False, True)
    (tmp_path / "wide.toml").write_text(bench_text({"tracker": {"resolution_px": [1200, 800]}}))
    told = run_hilstar_here("attitude", log, "--time", "30", "--bench", tmp_path / "wide.toml")
    assert "the log has 1 gap, the longest 57 s" in told.stderr
    first, place, *stars = told.stdout.splitlines()
    assert first.endswith("(held: in a gap of the log)") and place.startswith("RA ")
    assert len(stars) == 3 and all(" of 1200 x 800 px, " in star for star in stars)


def test_the_rate_between_a_log_s_samples_is_in_degrees_about_the_camera_s_axes(
    tmp_path, small_bench_file
):
    # A sky that turns by -2 degrees about z as the camera sees it: the camera turns by 2.
    turns = Rotation.from_euler("z", [[0.0], [-2.0]], degrees=True)
    rows = [(float(t_s), q) for t_s, q in enumerate(turns.as_quat(scalar_first=True).tolist())]
    found = told_attitude(log_of(tmp_path, rows), "--time", 0.5, "--bench", small_bench_file)
    assert found["rate_deg_s"] == pytest.approx([0.0, 0.0, 2.0], abs=ROUNDING_DEG)


@pytest.mark.parametrize("seed", range(4))
def test_boresight_and_stars_are_those_that_an_independent_rotation_finds(
    tmp_path, small_bench_file, seed
):
    turn = Rotation.random(rng=np.random.default_rng(seed))
    q = turn.as_quat(scalar_first=True).tolist()
    found = told_attitude(log_of(tmp_path, [(0.0, q), (1.0, q)]), "--bench", small_bench_file)
    boresight = SkyCoord(*turn.inv().apply([0.0, 0.0, 1.0]), representation_type="cartesian")
    boresight.representation_type = "unitspherical"
    looked = SkyCoord(found["ra_deg"], found["dec_deg"], unit="deg")
    assert looked.separation(boresight).deg < ROUNDING_DEG
    catalog = load_catalog("hipparcos")
    assert len(found["stars"]) == 3
    assert [s["v_mag"] for s in found["stars"]] == sorted(s["v_mag"] for s in found["stars"])
    for star in found["stars"]:
        row = int(np.flatnonzero(catalog.hip == star["hip"])[0])
        place = SkyCoord(catalog.ra_deg[row], catalog.dec_deg[row], unit="deg")
        seen = SkyCoord(star["ra_deg"], star["dec_deg"], unit="deg")
        assert place.separation(seen).deg < MOTION_DEG
        assert seen.separation(looked).deg == pytest.approx(
            star["from_boresight_deg"], abs=ROUNDING_DEG
        )
        cam = turn.apply(seen.cartesian.xyz.to_value(units.one))
        side = (
            np.array([star["x_px"], star["y_px"]])
            - (np.array(found["tracker"]["resolution_px"]) - 1) / 2
        )
        # on the same side
        assert side @ cam[:2] == pytest.approx(np.hypot(*side) * np.hypot(*cam[:2]), rel=1e-6)


def test_a_time_within_a_log_may_be_seconds_or_a_date(tmp_path):
    turns = [
        Rotation.from_euler("z", angle, degrees=True).as_quat(scalar_first=True).tolist()
        for angle in (0, 2, 4)
    ]
    rows = [(1_700_000_000.0 + 10 * k, q) for k, q in enumerate(turns)]
    log = log_of(tmp_path, rows)
    by_seconds, by_date = (
        told_attitude(log, "--time", "15"),
        told_attitude(log, "--time", "2023-11-14T22:13:35"),
    )
    assert by_seconds == by_date
    assert by_seconds["t_ns"] == 1_700_000_015 * 10**9
    expected = Rotation.from_euler("z", 3, degrees=True)
    found = Rotation.from_quat(by_seconds["q_icrs_to_cam"], scalar_first=True)
    assert (found * expected.inv()).magnitude() < 1e-12
    for wrong in ("21", "-1", "2023-11-14T22:13:41", "noon", "nan"):
        assert_refused(run_hilstar_here("attitude", log, f"--time={wrong}"), 2, f"--time {wrong}")


def test_a_log_of_boot_time_has_no_dates(tmp_path):
    log = log_of(tmp_path, [(5.0, [1.0, 0.0, 0.0, 0.0]), (6.0, [1.0, 0.0, 0.0, 0.0])])
    result = run_hilstar_here("attitude", log, "--time", "2026-11-22T10:00:00.5")
    assert_refused(
        result, 2, "1 s long, and its times are no dates; write seconds after its first sample\n"
    )


def test_a_live_stream_is_awaited(tmp_path):
    bench = tmp_path / "bench.toml"
    with publisher() as (sender, port), talking(sender, q=(0.5, 0.5, -0.5, 0.5)):
        bench.write_text(SMALL_BENCH + attitude_table(port))
        other = tmp_path / "other.toml"
        other.write_text(SMALL_BENCH)
        found = told_attitude(bench, "--bench", other)
    assert (found["ra_deg"], found["dec_deg"]) == pytest.approx((0, 0), abs=ROUNDING_DEG)
    # whose stars are told
    assert found["tracker"]["file"] == "other.toml"


def test_a_mounting_may_be_given_without_a_bench_file(tmp_path):
    """As the notice of a body's attitude says: here the body's z is the pole and the camera
    looks along its x.
    """
    (tmp_path / "log.aem").write_text(kvn(rows_of([0, 0, 0, 1])))
    assert told_attitude(tmp_path / "log.aem")["dec_deg"] == pytest.approx(90, abs=ROUNDING_DEG)
    found = told_attitude(tmp_path / "log.aem", "--mounting", "0.5,-0.5,-0.5,-0.5")
    turn = Rotation.from_quat([-0.5, -0.5, -0.5, 0.5])
    ra_deg = np.degrees(np.arctan2(*turn.inv().apply([0.0, 0.0, 1.0])[1::-1]))
    assert (found["ra_deg"], found["dec_deg"]) == pytest.approx((ra_deg, 0), abs=ROUNDING_DEG)


def test_what_is_stated_of_a_log_is_refused_for_a_live_stream(tmp_path):
    """A log's mounting and convention have keys in the bench file; the rest a stream has not."""
    (tmp_path / "bench.TOML").write_text(SMALL_BENCH)
    for flag, value, words in (
        ("--mounting", "1,0,0,0", "bench.TOML as [tracker] q_body_to_cam"),
        ("--convention", "scalar=last", "bench.TOML as [attitude] convention"),
        ("--reference", "enu", "names a live stream; leave it out"),
        ("--place", "1,2,3", "names a live stream; leave it out"),
        ("--epoch-utc", "2026-11-21T00:00:00Z", "names a live stream; leave it out"),
        ("--topic", "/attitude", "names a live stream; leave it out"),
    ):
        result = run_hilstar_here("attitude", tmp_path / "bench.TOML", flag, value)
        assert_refused(result, 2, f"{flag} {value}: ", words)


def test_silence_and_wrong_uses_are_refused_in_one_line(tmp_path):
    bench = tmp_path / "bench.toml"
    bench.write_text(SMALL_BENCH + attitude_table(free_port()))
    assert_refused(
        run_hilstar_here("attitude", bench, "--wait", "0.2"), 2, "no attitude within 0.2 s"
    )
    assert_refused(run_hilstar_here("attitude", bench, "--time", "3"), 2, "--time 3")
    bench.write_text(SMALL_BENCH + attitude_table(free_port(), "lockstep = true"))
    assert_refused(run_hilstar_here("attitude", bench), 2, "lockstep")
