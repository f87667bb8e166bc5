"""Natural mistakes with the Python API: each gets one line that says what to write."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from scipy.spatial.transform import Rotation

import hilstar
from hilstar import rotation
from tests.support.senders import free_port

TABLES = {
    "tracker": {
        "aperture_mm": 30,
        "focal_length_mm": 70,
        "pixel_pitch_um": 13,
        "resolution_px": [64, 64],
        "quantum_efficiency": "ccd47-20",
    },
    "monitor": {"resolution_px": [96, 54], "pixel_pitch_um": 1153},
    "collimator": {"focal_length_mm": 350},
}
Q = [0.6987226, 0.7135120, -0.0370377, 0.0362700]
PLACE = SkyCoord(84.057, -1.2, unit="deg")


@pytest.fixture(scope="module")
def bench():
    with hilstar.load(TABLES) as opened:
        yield opened


@pytest.fixture(scope="module")
def frame(bench):
    return bench.frame(Q)


@pytest.fixture
def opened_udp_sender():
    with hilstar.Sender(f"udp://127.0.0.1:{free_port()}") as opened:
        yield opened


def refused(said):
    """One line with these words."""
    return pytest.raises(hilstar.InputError, match=rf"(?-s:^.*{said}.*$)\Z")


@pytest.mark.parametrize(
    ("attitude", "said"),
    [
        (None, "attitude None: write a unit quaternion"),
        (84.0, "attitude 84.0: .*from_radec_roll_deg"),
        ([84, -1.2, 0], "attitude of 3 numbers: .*from_radec_roll_deg"),
        ("Vega", "attitude 'Vega': write a unit quaternion"),
        ([1, 1, 1, 1], "its norm is 2"),
        (np.eye(3), r"attitude of shape \(3, 3\)"),
        (Rotation.identity(3), "holds 3 rotations"),
    ],
)
def test_what_is_no_attitude(bench, attitude, said):
    with refused(said):
        bench.frame(attitude)


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        (lambda bench: bench.frame(Q, faults="faults.toml"), "hilstar frame --scenario FILE.toml"),
        (lambda bench: bench.frame(Q, t_ns=1.5), "t_ns 1.5: write whole nanoseconds"),
        (lambda bench: bench.frame(Q, roll_deg=3), "roll_deg: is for a SkyCoord"),
        (lambda bench: bench.frame(PLACE, 30), "number 30 beside a SkyCoord: write the roll as"),
        (lambda bench: bench.draw(PLACE, 30), "frame 30 beside a SkyCoord: write the roll as"),
        (lambda bench: bench.frame(PLACE, 3 * u.deg), "number <Quantity 3. deg> beside a SkyC"),
        (lambda bench: bench.draw(Q, rate_cam_rad_s=[1, 2, 3] * u.deg), "in deg: write three"),
        (lambda bench: bench.simulate(Q, noise="some"), "noise 'some': write full or none"),
        (lambda bench: bench.simulate(Q, seed=-1), "seed -1: write a whole number from 0 on"),
        (lambda bench: bench.verify("3"), "fields '3': write a whole number from 1 to 100000"),
        (lambda bench: bench.verify(10**12), "write a whole number from 1 to 100000"),
        (lambda bench: bench.budget("windw"), "centroider 'windw': write one of moment"),
    ],
)
def test_a_bench_asked_wrongly(bench, mistake, said):
    with refused(said):
        mistake(bench)


def test_a_frame_has_its_number_beside_a_roll(bench):
    assert bench.frame(PLACE, 3, roll_deg=0).q_icrs_to_cam == pytest.approx(Q, abs=1e-6)
    assert bench.draw(PLACE, 3, roll_deg=0).levels.shape == (54, 96)


@pytest.mark.parametrize("what", ["frame", "draw", "simulate"])
def test_a_closed_bench_draws_nothing(what):
    closed = hilstar.load(TABLES)
    closed.close()
    closed.close()
    with refused(f"{what}: the bench is closed; open it again with hilstar.load"):
        getattr(closed, what)(Q)
    with refused("budget: the bench is closed"):
        closed.budget()


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        (lambda frame: frame.save(None), "save None: write the path of a file"),
        (lambda frame: frame.save("sky.jpg"), "sky.jpg: write .fits"),
        (lambda frame: hilstar.compare(frame, frame, flux_mag="x"), "flux_mag = 'x'; write a numb"),
        (lambda frame: hilstar.compare(frame, frame, centroid_px=None), "centroid_px = None"),
        (lambda frame: hilstar.compare(frame, frame, flux_mag=-1), "flux_mag = -1"),
        (lambda frame: hilstar.compare(frame, frame, truth=[1]), r"truth \[1\]; give a Frame's"),
        (lambda frame: hilstar.compare(frame, frame.codes), "not its codes"),
    ],
)
def test_a_frame_used_wrongly(frame, mistake, said):
    with refused(said):
        mistake(frame)


def test_an_assert_of_a_comparison_or_a_verdict_can_fail(bench, frame):
    """`assert hilstar.compare(a, b)`, without `.same`."""
    assert hilstar.compare(frame, frame)
    assert not hilstar.compare(bench.frame(PLACE, roll_deg=10), frame)
    verdict = bench.verify(1)
    assert bool(verdict) == verdict.passed
    assert bool(replace(verdict, reasons=[])) and not replace(verdict, reasons=["too dark"])


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        (lambda: hilstar.assess(None), "ledger None: write the path of a file"),
        (lambda: hilstar.assess("run.mcap", 3), "telemetry 3: write the path of a file"),
        (lambda: hilstar.assess("run.mcap", stamp="mid"), "stamp 'mid': write start, middle or"),
        (lambda: hilstar.assess("run.mcap", latency_s=1 * u.m), "latency_s in m: write a number"),
        (lambda: hilstar.load(3), "load 3: give the path of a bench file"),
        (lambda: hilstar.load({"tracker": "x"}), "table is wanted"),
    ],
)
def test_files_that_are_none(mistake, said):
    with refused(said):
        mistake()


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        (lambda: hilstar.Sender(5560), "to 5560: write a road such as tcp://127.0.0.1:5560"),
        (lambda: hilstar.Sender("udp://127.0.0.1:9", clock=5), "clock 5: write a function"),
        (lambda: hilstar.Sender("udp://127.0.0.1:9", sender="a"), "sender 'a': write a whole"),
        (lambda: hilstar.Sender("udp://127.0.0.1:9", sender=300), "sender 300: write 1 to 254"),
    ],
)
def test_a_sender_that_cannot_be(mistake, said):
    with refused(said):
        mistake()


def test_a_sender_used_wrongly(opened_udp_sender):
    with refused("timeout_s '3': write a number of seconds"):
        opened_udp_sender.wait("3")
    with refused("its norm|norm is 2"):
        opened_udp_sender.send([1, 1, 1, 1])
    opened_udp_sender.close()
    with refused("send: the sender is closed"):
        opened_udp_sender.send(Q)


def test_a_clock_in_seconds_is_refused_and_not_searched_for():
    """A fraction is in no range of whole numbers, which Python walks through to say so."""
    to = f"udp://127.0.0.1:{free_port()}"
    with (
        hilstar.Sender(to, clock=lambda: 1.5) as opened_udp_sender,
        refused("clock 1.5: write whole nanoseconds"),
    ):
        opened_udp_sender.send(Q)


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        (lambda: rotation.from_radec_roll_deg("84", 0, 0), "ra_deg '84': write a number of deg"),
        (lambda: rotation.from_radec_roll_deg(1 * u.m, 0, 0), "ra_deg in m: write a number"),
        (lambda: rotation.to_radec_roll_deg([1, 2, 3]), r"\(3,\): write an array \(..., 4\)"),
        (lambda: rotation.multiply(Q, None), r"b of shape \(\): write an array"),
        (lambda: rotation.rotate(Q, [0, 0, 1]), r"vectors of shape \(3,\): write an array \(n, 3"),
        (lambda: rotation.from_matrix(np.eye(2)), r"matrix of shape \(2, 2\)"),
        (lambda: rotation.propagate(Q, [1, 2], 1), r"rate_cam_rad_s of shape \(2,\)"),
        (lambda: rotation.slerp(Q, Q, "half"), "fraction 'half': write a number"),
    ],
)
def test_a_rotation_of_something_else(mistake, said):
    with refused(said):
        mistake()


def test_a_declination_beyond_the_pole_is_refused():
    for dec_deg in (95, -95):
        said = f"dec_deg = {dec_deg}: a declination is from -90 to 90"
        with pytest.raises(hilstar.InputError, match=said):
            rotation.from_radec_roll_deg(84, dec_deg, 0)
    assert rotation.from_radec_roll_deg(84, -90, 0).shape == (4,)


def test_an_exposure_is_an_array_of_its_dn(bench):
    exposure = bench.simulate(Q)
    assert np.array_equal(np.asarray(exposure), exposure.dn)
    assert np.asarray(exposure).dtype == np.uint16


def test_rotations_take_lists_scipy_and_quantities():
    q = rotation.from_radec_roll_deg(84.057 * u.deg, (-1.2 * 60) * u.arcmin, 0.0)
    assert q == pytest.approx(Q, abs=1e-7)
    assert q.tolist() == rotation.from_radec_roll_deg(84.057, -1.2, 0).tolist()
    turned = Rotation.from_quat(q[[1, 2, 3, 0]])
    assert rotation.to_matrix(turned) == pytest.approx(turned.as_matrix(), abs=1e-15)
    assert rotation.slerp(Q, Q, 0.5) == pytest.approx(Q, abs=1e-7)
    assert rotation.rotate(Q, [[1, 0, 0]]).shape == (1, 3)
    by_quantity = rotation.propagate(q, [0, 0, 1] * u.deg / u.s, 2000 * u.ms)
    assert by_quantity == pytest.approx(rotation.propagate(q, np.radians([0, 0, 1]), 2), abs=1e-15)


TURN_RAD = [0.1, -0.2, 0.3]


@pytest.mark.parametrize(
    ("function", "given", "plain"),
    [
        (
            rotation.direction_of,
            ([5, 6] * u.hourangle, [-72, 30] * u.arcmin),
            ([75, 90], [-1.2, 0.5]),
        ),
        (rotation.frame_turns, (2, [30, -200] * u.mrad), (2, [0.03, -0.2])),
        (rotation.from_rotation_vector, (np.degrees(TURN_RAD) * u.deg,), (TURN_RAD,)),
        (rotation.from_rotation_vectors, (np.degrees([TURN_RAD]) * u.deg,), ([TURN_RAD],)),
        (rotation.rotate, (Q, [[30, 20, 10]] * u.percent), (Q, [[0.3, 0.2, 0.1]])),
        (rotation.slerp, (Q, Q[::-1], 25 * u.percent), (Q, Q[::-1], 0.25)),
        (rotation.rate_between_rad_s, (Q, Q[::-1], 20 * u.ms), (Q, Q[::-1], 0.02)),
        (
            rotation.propagate,
            (Q, [9, 0, 3] * u.deg / u.s, 1 * u.min),
            (Q, np.radians([9, 0, 3]), 60),
        ),
        (
            rotation.from_radec_roll_deg,
            (5 * u.hourangle, -72 * u.arcmin, 0.5 * u.rad),
            (75, -1.2, np.degrees(0.5)),
        ),
    ],
)
def test_a_quantity_is_what_its_number_in_the_parameter_s_unit_is(function, given, plain):
    assert function(*given) == pytest.approx(function(*plain), abs=1e-14)


def test_a_name_that_hilstar_lacks_is_answered_with_the_nearest():
    with pytest.raises(AttributeError, match="no attribute 'Sendr'; did you mean Sender"):
        _ = hilstar.Sendr
    assert not hasattr(hilstar, "__wrapped__")


def test_a_missing_argument_names_its_function():
    with pytest.raises(TypeError, match=r"from_radec_roll_deg\(\) missing .*'roll_deg'"):
        rotation.from_radec_roll_deg(84.057, -1.2)


def test_a_path_may_be_either(tmp_path, frame):
    for path in (tmp_path / "a.csv", str(tmp_path / "b.csv")):
        assert frame.save(path) == Path(path)
