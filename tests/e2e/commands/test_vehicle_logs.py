"""Bags of ROS and logs of PX4, and what is stated of them, through the commands that read logs."""

from __future__ import annotations

import csv
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.rotation import from_radec_roll_deg, propagate
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.sources import ros_bags
from tests.support.sources.ros_bags import START_NS, Make, write_bag2
from tests.support.sources.ulog_files import ULogWriter

RATE = np.radians([0.3, -0.2, 2.0])
# By 2026 the pole of date is 27 years of 20.04 arcsec from that of the ICRS.
PRECESSION_DEG = 27 * 20.04 / 3600
ORION = from_radec_roll_deg(84, -1, 0)


@pytest.fixture
def bag(tmp_path):
    """Two seconds of a camera that slews, at 10 Hz: an Imu in an unnamed frame."""
    make = Make("humble")

    def sent():
        for k in range(21):
            w, x, y, z = propagate(ORION, RATE, k / 10).tolist()
            t_ns = START_NS + k * 10**8
            yield "/imu", ros_bags.IMU, t_ns, make.imu(t_ns, "cam", (w, -x, -y, -z), RATE)

    return write_bag2(tmp_path / "bag", sent(), "humble")


def test_a_bag_is_replayed_with_what_is_stated(tmp_path, small_bench_file, bag):
    options = ("--reference", "icrs", "--headless", "--speed", "max", "--step", "0.5", "-o", tmp_path / "out", "--explain")
    result = run_hilstar_here("replay", small_bench_file, bag, *options)
    assert result.returncode == 0, result.stderr
    assert "the reference is taken as the ICRS, as stated" in result.stderr
    assert "scalar last (x, y, z, w)" in result.stderr
    with (tmp_path / "out" / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5
    for k, row in enumerate(rows):
        found = Rotation.from_quat([float(row[name]) for name in ("qw", "qx", "qy", "qz")], scalar_first=True)
        wanted = Rotation.from_quat(propagate(ORION, RATE, k / 2), scalar_first=True)
        assert (found * wanted.inv()).magnitude() < 1e-12


def test_a_bag_is_converted_and_looked_at(tmp_path, bag):
    wanted = ("--reference", "icrs", "--mounting", "1,0,0,0")
    assert "21 attitudes" in run_hilstar_here("convert", bag, tmp_path / "a.csv", *wanted).stdout
    looked = run_hilstar_here("attitude", bag, "--reference", "icrs")
    assert "RA 84.0000, Dec -1.0000" in looked.stdout, looked.stderr


def test_a_bag_that_leaves_its_frame_open_is_refused_in_one_line(tmp_path, bag):
    assert_refused(run_hilstar_here("convert", bag, tmp_path / "a.csv"), 2, "do not say which frame", "--reference icrs")


def test_a_log_of_px4_is_converted_and_explained(tmp_path):
    log = ULogWriter()
    log.topic("vehicle_attitude")
    for k in range(5):
        log.add("vehicle_attitude", timestamp=1000 * (k + 1), q=(1, 0, 0, 0))
    (tmp_path / "log.ulg").write_bytes(log.data)
    assert_refused(run_hilstar_here("convert", tmp_path / "log.ulg", tmp_path / "a.aem"), 2, "has no UTC", "--epoch-utc TIME")
    stated = ("--epoch-utc", "2026-11-22T10:00:00", "--place=48.1,11.6,500")
    result = run_hilstar_here("convert", tmp_path / "log.ulg", tmp_path / "a.aem", *stated)
    assert "5 attitudes" in result.stdout, result.stderr
    result = run_hilstar_here("attitude", tmp_path / "log.ulg", *stated, "--explain")
    assert "front, right, down" in result.stdout
    declination_deg = float(re.search(r"^RA .* Dec (\S+),", result.stdout, re.MULTILINE)[1])
    assert declination_deg == pytest.approx(-48.1, abs=PRECESSION_DEG)  # the body's z is down
