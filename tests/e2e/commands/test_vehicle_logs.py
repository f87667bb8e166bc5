"""Bags of ROS, and what is stated of them, through the commands that read logs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.basics.rotation import from_radec_roll_deg, propagate
from tests.support.commands import assert_refused, run_hilstar_here, typed
from tests.support.sources import ros_bags
from tests.support.sources.ros_bags import START_NS, Make, write_bag2
from tests.support.tables import csv_rows

RATE = np.radians([0.3, -0.2, 2.0])
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
    options = typed(
        f"--reference icrs --headless --speed max --step 0.5 -o {tmp_path}/out --explain"
    )
    result = run_hilstar_here("replay", small_bench_file, bag, *options)
    assert result.returncode == 0, result.stderr
    assert "the reference is taken as the ICRS, as stated" in result.stderr
    assert "scalar last (x, y, z, w)" in result.stderr
    rows = csv_rows(tmp_path / "out" / "frames.csv")
    assert len(rows) == 5
    for k, row in enumerate(rows):
        found = Rotation.from_quat(
            [float(row[name]) for name in ("qw", "qx", "qy", "qz")], scalar_first=True
        )
        wanted = Rotation.from_quat(propagate(ORION, RATE, k / 2), scalar_first=True)
        assert (found * wanted.inv()).magnitude() < 1e-12


def test_a_bag_is_converted_and_looked_at(tmp_path, bag):
    wanted = ("--reference", "icrs", "--mounting", "1,0,0,0")
    assert "21 attitudes" in run_hilstar_here("convert", bag, tmp_path / "a.csv", *wanted).stdout
    looked = run_hilstar_here("attitude", bag, "--reference", "icrs")
    assert "RA 84.0000, Dec -1.0000" in looked.stdout, looked.stderr


def test_a_bag_that_leaves_its_frame_open_is_refused_in_one_line(tmp_path, bag):
    assert_refused(
        run_hilstar_here("convert", bag, tmp_path / "a.csv"),
        2,
        "do not say which frame",
        "--reference icrs",
    )
