"""PX4's logs: a vehicle that moves over the turning Earth, written by the format's specification, with Astropy's truth."""

from __future__ import annotations

import functools
import io
import re
import warnings

import numpy as np
import pytest
import pyulog
from astropy.coordinates import GCRS, ITRS, CartesianRepresentation
from astropy.time import Time
from astropy.utils import iers
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import open_log
from hilstar.attitude.wire.source import CHECK_RADEC_DEG, Mounting
from hilstar.errors import InputError, MachineError
from hilstar.rotation import to_radec_roll_deg
from tests.support.sources.ulog_files import FORMATS, OLD, ULogWriter

ARCSEC = np.radians(1 / 3600)
# q is in single precision: each component is rounded by 2^-25 at most, the angle by four of twice that (0.05 arcsec).
SINGLE_ARCSEC = 0.05
# Positions of old receivers are in 1e-7 deg: 0.0004 arcsec. UTC in microseconds: 1.5e-5 arcsec.
COUNT, STEP_US, BOOT_US = 12, 50_000, 7_000_000
BOOT_UTC, BOOT_UTC_US = "2024-07-01T11:59:50", 1_719_835_190_000_000
RATE = np.array([0.11, -0.07, 0.05])
TIMES_US = BOOT_US + STEP_US * np.arange(COUNT)


@functools.lru_cache
def icrs_to_earth(utc_us: int) -> Rotation:
    """Astropy's rotation, from the axes of ITRS seen in GCRS."""
    time = Time(utc_us // 10**6, utc_us % 10**6 / 1e6, format="unix", scale="utc")
    with iers.conf.set_temp("auto_download", False), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with iers.earth_orientation_table.set(iers_table()):
            axes = [ITRS(CartesianRepresentation(*axis), obstime=time).transform_to(GCRS(obstime=time)) for axis in np.eye(3)]
    return Rotation.from_matrix(np.array([axis.cartesian.xyz.value for axis in axes]))


@functools.lru_cache
def iers_table():
    return iers.IERS_A.read(iers.IERS_A_FILE)


def earth_to_ned(latitude_deg: float, longitude_deg: float) -> Rotation:
    """The directions of north, east and down, as rows."""
    phi, lam = np.radians([latitude_deg, longitude_deg])
    north = [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)]
    east = [-np.sin(lam), np.cos(lam), 0.0]
    return Rotation.from_matrix([north, east, np.cross(north, east)])


def icrs_to_body(t_us: int, seed: int = 4) -> Rotation:
    """A vehicle that turns at RATE (body components) with respect to the stars."""
    return Rotation.from_rotvec(-RATE * (t_us - BOOT_US) / 1e6) * Rotation.random(rng=np.random.default_rng(seed))


def place_deg(t_us: int, begin: tuple[float, float]) -> tuple[float, float]:
    """An aeroplane that goes east at about 0.001 deg (100 m) a second."""
    return begin[0], begin[1] + (t_us - BOOT_US) * 1e-9


def ned_from_body(t_us: int, begin: tuple[float, float], seed: int = 4) -> Rotation:
    return earth_to_ned(*place_deg(t_us, begin)) * icrs_to_earth(BOOT_UTC_US + t_us) * icrs_to_body(t_us, seed).inv()


def first(rotation: Rotation) -> list[float]:
    return rotation.as_quat(scalar_first=True).tolist()


def flight(begin=(48.1, 11.6), gps=True, position=True, instances=(0,), name="vehicle_attitude") -> ULogWriter:
    log = ULogWriter(BOOT_US)
    for instance in instances:
        log.topic(name, instance)
    for topic in ("vehicle_angular_velocity", "vehicle_global_position", "vehicle_gps_position"):
        log.topic(topic)
    for k, t_us in enumerate(TIMES_US.tolist()):
        for at_us in (t_us - 20_000, t_us + 5_000):
            log.add("vehicle_angular_velocity", timestamp=at_us + 500, timestamp_sample=at_us, xyz=RATE)
        for instance in instances:
            q = first(ned_from_body(t_us, begin, 4 + instance))
            log.add(name, instance, timestamp=t_us + 800, timestamp_sample=t_us, q=q, quat_reset_counter=k // 6)
        if position and (k % 4 == 0 or k == COUNT - 1):
            add_position(log, t_us, begin)
        if gps and (k % 4 == 1 or k in {0, COUNT - 1}):
            add_fix(log, t_us, begin)
    return log


def add_position(log, t_us, begin):
    latitude_deg, longitude_deg = place_deg(t_us, begin)
    wrapped_deg = (longitude_deg + 180) % 360 - 180
    log.add("vehicle_global_position", timestamp=t_us, timestamp_sample=t_us, lat=latitude_deg, lon=wrapped_deg)


def add_fix(log, t_us, begin):
    """A receiver's message, which comes 0.12 s after what it says."""
    latitude_deg, longitude_deg = place_deg(t_us, begin)
    utc = {"timestamp": t_us + 120_000, "time_utc_usec": BOOT_UTC_US + t_us, "timestamp_time_relative": -120_000}
    log.add("vehicle_gps_position", latitude_deg=latitude_deg, longitude_deg=longitude_deg, fix_type=3, **utc)


@pytest.fixture
def written(tmp_path):
    def write(log):
        path = tmp_path / "log.ulg"
        path.write_bytes(log.data if isinstance(log, ULogWriter) else log)
        return path

    return write


def worst_arcsec(log, seed=4):
    q = Rotation.from_quat([sample.q_icrs_to_cam for sample in log.samples], scalar_first=True)
    truth = Rotation.concatenate([icrs_to_body(sample.t_ns // 1000, seed) for sample in log.samples])
    return (q * truth.inv()).magnitude().max() / ARCSEC


def test_the_writer_here_writes_what_pyulog_reads():
    log = pyulog.ULog(io.BytesIO(flight().data))
    assert not log.file_corruption
    attitude = log.get_dataset("vehicle_attitude").data
    assert attitude["timestamp_sample"].tolist() == TIMES_US.tolist()
    assert [attitude[f"q[{i}]"][3] for i in range(4)] == pytest.approx(
        first(ned_from_body(int(TIMES_US[3]), (48.1, 11.6))), abs=1e-7
    )


@pytest.mark.parametrize("begin", [(48.1, 11.6), (-33.9, 179.99999), (0.0, -70.0), (89.99, 20.0), (-89.99, -120.0)])
def test_a_flight_is_where_astropy_has_it(written, begin):
    log = open_log(written(flight(begin)))
    assert [sample.t_ns for sample in log.samples] == (TIMES_US * 1000).tolist()
    assert worst_arcsec(log) < SINGLE_ARCSEC
    assert log.conventions.of_body


def test_what_pyulog_writes_is_read(written):
    rewritten = io.BytesIO()
    pyulog.ULog(io.BytesIO(flight().data)).write_ulog(rewritten)
    assert worst_arcsec(open_log(written(rewritten.getvalue()))) < SINGLE_ARCSEC


def test_the_rate_is_the_bodys_with_respect_to_the_stars(written):
    log = open_log(written(flight()))
    for sample in log.samples:
        assert sample.rate_cam_rad_s == pytest.approx(RATE, rel=1e-6)  # single precision, and the same at every time
    before, after = (Rotation.from_quat(log.samples[k].q_icrs_to_cam, scalar_first=True) for k in (0, -1))
    seconds = (TIMES_US[-1] - TIMES_US[0]) / 1e6
    turned = -(after * before.inv()).as_rotvec() / seconds
    assert turned == pytest.approx(RATE, abs=2 * SINGLE_ARCSEC * ARCSEC / seconds)


def test_rates_at_other_times_are_between_their_neighbours_and_unknown_in_gaps(written):
    log = ULogWriter()
    log.topic("vehicle_attitude")
    log.topic("vehicle_angular_velocity")
    for t_us in (100, 200, 300, 400, 5000):
        log.add("vehicle_angular_velocity", timestamp=t_us, timestamp_sample=t_us, xyz=(t_us / 1e6, 0, 0))
    for t_us in (50, 150, 375, 3000, 6000):
        log.add("vehicle_attitude", timestamp=t_us, q=(1, 0, 0, 0))
    rates = [sample.rate_cam_rad_s for sample in open_log(written(log), Stated(epoch_utc=BOOT_UTC, place=(1, 2, 3))).samples]
    assert [rate is None for rate in rates] == [True, False, False, True, True]
    assert [rates[1][0], rates[2][0]] == pytest.approx([150e-6, 375e-6], rel=1e-6)


def test_a_reset_of_the_estimate_is_a_discontinuity(written):
    log = open_log(written(flight()))
    assert [k for k, sample in enumerate(log.samples) if sample.discontinuity] == [6]


def test_old_logs_have_rates_beside_the_attitude_and_positions_in_whole_numbers(written):
    log, begin = ULogWriter(formats=FORMATS | OLD), (48.1, 11.6)
    log.topic("vehicle_attitude")
    log.topic("vehicle_gps_position")
    for t_us in TIMES_US.tolist():
        rate = dict(zip(("rollspeed", "pitchspeed", "yawspeed"), RATE, strict=True))
        log.add("vehicle_attitude", timestamp=t_us, q=first(ned_from_body(t_us, begin)), **rate)
        whole = [round(degrees * 1e7) for degrees in place_deg(t_us, begin)]
        log.add(
            "vehicle_gps_position", timestamp=t_us, time_utc_usec=BOOT_UTC_US + t_us, lat=whole[0], lon=whole[1], fix_type=3
        )
    read = open_log(written(log))
    assert worst_arcsec(read) < SINGLE_ARCSEC
    assert read.samples[5].rate_cam_rad_s == pytest.approx(RATE, rel=1e-6)


# What the log does not say


def test_without_utc_it_is_stated(written):
    path = written(flight(gps=False))
    with pytest.raises(InputError, match=r"has no UTC \(no GPS fix with a time\); give --epoch-utc TIME, the UTC at boot"):
        open_log(path)
    assert worst_arcsec(open_log(path, Stated(epoch_utc=BOOT_UTC))) < SINGLE_ARCSEC


def test_without_a_position_it_is_stated(written):
    log = flight(position=False, gps=False)
    with pytest.raises(InputError, match="has no position; give the place with --place LAT,LON,HEIGHT"):
        open_log(written(log), Stated(epoch_utc=BOOT_UTC))
    middle = place_deg(int(TIMES_US[COUNT // 2]), (48.1, 11.6))
    log = open_log(written(log), Stated(epoch_utc=BOOT_UTC, place=(*middle, 0.0)))
    moved_arcsec = 1e-9 * STEP_US * COUNT / 2 * 3600  # the place stays, the vehicle went on
    assert worst_arcsec(log) < SINGLE_ARCSEC + moved_arcsec


def test_a_receiver_without_a_fix_gives_neither_place_nor_time(written):
    log = flight(gps=False, position=False)
    log.topic("sensor_gps")
    for t_us in TIMES_US.tolist():
        log.add("sensor_gps", timestamp=t_us, time_utc_usec=0, latitude_deg=0.0, longitude_deg=0.0, fix_type=0)
    with pytest.raises(InputError, match="has no UTC"):
        open_log(written(log))
    with pytest.raises(InputError, match="has no position"):
        open_log(written(log), Stated(epoch_utc=BOOT_UTC))


def test_a_stated_utc_that_the_log_contradicts_is_said(written):
    log = open_log(written(flight()), Stated(epoch_utc="2024-07-01T11:59:53"))
    assert "--epoch-utc is +3 s from the log's own GPS time at boot" in dict(log.told)["log-utc"]
    assert 40 < worst_arcsec(log) < 50  # three seconds of the Earth's turning


def test_gps_times_that_disagree_are_said_in_arcsec(written):
    log = ULogWriter()
    log.topic("vehicle_attitude")
    log.topic("vehicle_gps_position")
    for k, t_us in enumerate(TIMES_US.tolist()):
        log.add("vehicle_attitude", timestamp=t_us, q=(1, 0, 0, 0))
        where = {"latitude_deg": 1.0, "longitude_deg": 2.0, "fix_type": 3}
        log.add("vehicle_gps_position", timestamp=t_us, time_utc_usec=BOOT_UTC_US + t_us + (k % 3) * 10**6, **where)
    assert "GPS times differ by 2 s; the sky may be turned by 15 arcsec" in dict(open_log(written(log)).told)["log-utc"]


def test_of_several_instances_one_is_chosen(written):
    path = written(flight(instances=(0, 1), name="estimator_attitude"))
    with pytest.raises(InputError, match="has no topic vehicle_attitude; it has estimator_attitude:0, estimator_attitude:1"):
        open_log(path)
    with pytest.raises(InputError, match="several instances: estimator_attitude:0, estimator_attitude:1; choose one with"):
        open_log(path, Stated(topic="estimator_attitude"))
    for instance in (0, 1):
        log = open_log(path, Stated(topic=f"estimator_attitude:{instance}"))
        assert worst_arcsec(log, seed=4 + instance) < SINGLE_ARCSEC
    with pytest.raises(InputError, match="has no topic estimator_attitude:7"):
        open_log(path, Stated(topic="estimator_attitude:7"))


def test_a_simulators_truth_is_read_by_name(written):
    log = flight(name="vehicle_attitude_groundtruth", position=False)
    log.topic("vehicle_angular_velocity_groundtruth")
    for t_us in TIMES_US.tolist():
        log.add("vehicle_angular_velocity_groundtruth", timestamp=t_us, xyz=2 * RATE)
    read = open_log(written(log), Stated(topic="vehicle_attitude_groundtruth"))
    assert worst_arcsec(read) < SINGLE_ARCSEC
    assert read.samples[3].rate_cam_rad_s == pytest.approx(2 * RATE, rel=1e-6)


def test_other_frames_are_refused(written):
    with pytest.raises(InputError, match="refer to north, east, down; leave out --reference icrs"):
        open_log(written(flight()), Stated(reference="icrs"))
    assert worst_arcsec(open_log(written(flight()), Stated(reference="NED"))) < SINGLE_ARCSEC


def test_attitudes_before_the_estimator_ran_are_left_out_and_said(written):
    log = ULogWriter()
    log.topic("vehicle_attitude")
    for t_us, q in ((10, (0, 0, 0, 0)), (20, (np.nan,) * 4), (30, (1, 0, 0, 0)), (40, (1, 0, 0, 0))):
        log.add("vehicle_attitude", timestamp=t_us, q=q)
    stated = Stated(epoch_utc=BOOT_UTC, place=(1, 2, 3))
    read = open_log(written(log), stated)
    assert [sample.t_ns for sample in read.samples] == [30_000, 40_000]
    assert "2 attitudes from before the estimator ran" in dict(read.told)["log-start"]
    log.add("vehicle_attitude", timestamp=50, q=(0, 0, 0, 0))
    with pytest.raises(InputError, match=r"attitude 3: .*norm is 0|attitude 3: .*not finite"):
        open_log(written(log), stated)


def test_the_self_check_points_where_it_says(written):
    mounting = Mounting((0.5, 0.5, 0.5, 0.5))
    stated = Stated(mounting, epoch_utc=BOOT_UTC, place=(48.1, 11.6, 0))
    line = open_log(written(flight(gps=False, position=False)), stated).conventions.lines(mounting)[-1]
    q = [float(number) for number in re.search(r"q = \((.*?)\) at 7\.000000 s", line)[1].split(",")]
    log = ULogWriter()
    log.topic("vehicle_attitude")
    log.add("vehicle_attitude", timestamp=BOOT_US, q=q)
    shown = open_log(written(log), stated).samples[0].q_icrs_to_cam
    assert to_radec_roll_deg(shown)[:2] == pytest.approx(
        CHECK_RADEC_DEG, abs=np.degrees(4e-7)
    )  # seven digits, and single precision


def test_without_pyulog_one_line_says_what_to_install(written, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "pyulog", None)  # as Python has it where a package is not installed
    with pytest.raises(MachineError, match=r"a ULog of PX4; reading it needs pyulog: pip install 'hilstar\[px4\]'"):
        open_log(written(flight()))
