"""From the ICRS to a level frame on the Earth, against Astropy's frames and the matrix that the
IERS publishes.
"""

from __future__ import annotations

import warnings
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import GCRS, ITRS, AltAz, CartesianRepresentation, EarthLocation, SkyCoord
from astropy.time import Time
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs import earth
from hilstar.attitude.logs.earth import (
    EARTH_RATE_RAD_S,
    Reference,
    beyond_table,
    earth_rate_ned_rad_s,
    q_icrs_to_enu,
    q_icrs_to_itrs,
    q_icrs_to_ned,
    stated_reference,
    to_icrs,
    utc_ns_of,
)
from hilstar.attitude.logs.entries import LogEntry, Stated
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import conjugate, multiply, to_matrix, to_rotation_vector
from hilstar.basics.units import NS_PER_S
from tests.support.claims import holds

pytestmark = pytest.mark.usefixtures("iers_of_package")
MAS = np.radians(1 / 3.6e6)
# AltAz has the light's aberration of the Earth's turning (0.32 arcsec at the equator), which is no
# part of an attitude.
DIURNAL_ARCSEC = 0.33
# the farthest that the pole of rotation is from the Earth's third axis
POLE_RAD = np.radians(0.6 / 3600)
PLACES_DEG = [
    (0.0, 0.0),
    (48.1, 11.6),
    (-33.9, 151.2),
    (89.999, 12.0),
    (-89.999, -170.0),
    (90.0, 0.0),
    (-90.0, 180.0),
]
DATES = [
    "1975-03-01T12:34:56",
    "1999-12-31T23:59:59",
    "2016-12-31T23:30:00",
    "2024-02-29T06:00:00.25",
    "2026-11-22T10:00:00",
]


def utc_array(text: str) -> np.ndarray:
    return np.array([utc_ns_of(text, "--epoch-utc")])


def angle_mas(matrix: np.ndarray) -> float:
    """The angle of a rotation matrix that is nearly 1."""
    return float(
        np.linalg.norm(
            [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
        )
        / 2
        / MAS
    )


@pytest.mark.parametrize("date", DATES)
def test_the_earths_axes_are_astropys(date):
    ours = to_matrix(q_icrs_to_itrs(utc_array(date))[0])
    time = Time(date, scale="utc")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        columns = [
            ITRS(CartesianRepresentation(*axis), obstime=time).transform_to(GCRS(obstime=time))
            for axis in np.eye(3)
        ]
    itrs_to_gcrs = np.array([column.cartesian.xyz.value for column in columns]).T
    # Astropy interpolates the same table: s' (0.01 mas), the hour's interpolation and the rounding
    # of a Time are left.
    holds("itrs-astropy", angle_mas(ours @ itrs_to_gcrs))


def test_the_earths_axes_are_those_that_the_iers_published():
    """From hpiers.obspm.fr/eop-pc/products/matrice/matrice.php, with nutation, UT1 and pole
    switched on.
    """
    itrf_to_icrf = np.array(
        [
            [-0.600054079259, -0.799958492301, 0.001229861818],
            [0.799959080231, -0.600054555381, -0.000022838411],
            [0.000756253967, 0.000970134847, 0.999999243459],
        ]
    )
    ours = to_matrix(q_icrs_to_itrs(utc_array("2012-05-20T16:33:13"))[0])
    # The IERS's own parameters of that day were rapid ones: UT1 to 0.13 ms, the pole to 0.4 mas.
    holds("itrs-iers", angle_mas(ours @ itrf_to_icrf))


@pytest.mark.parametrize("place", PLACES_DEG)
@pytest.mark.parametrize("date", ["1999-12-31T23:59:59", "2026-11-22T10:00:00"])
def test_a_star_stands_where_astropys_horizon_has_it(date, place):
    # a direction without parallax
    star = SkyCoord(213.9, 19.2, unit="deg", frame=GCRS(obstime=Time(date, scale="utc")))
    latitude_deg, longitude_deg = place
    site = EarthLocation.from_geodetic(longitude_deg, latitude_deg, 100.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        seen = (
            star.transform_to(AltAz(obstime=star.obstime, location=site))
            .represent_as("unitspherical")
            .to_cartesian()
        )
    north, east, up = seen.xyz.value
    ned = Rotation.from_quat(
        q_icrs_to_ned(utc_array(date), latitude_deg, longitude_deg)[0], scalar_first=True
    )
    enu = Rotation.from_quat(
        q_icrs_to_enu(utc_array(date), latitude_deg, longitude_deg)[0], scalar_first=True
    )
    direction = star.cartesian.xyz.value
    for ours, theirs in (
        (ned.apply(direction), (north, east, -up)),
        (enu.apply(direction), (east, north, up)),
    ):
        assert np.linalg.norm(ours - theirs) < np.radians(DIURNAL_ARCSEC / 3600)


@pytest.mark.parametrize("latitude_deg", [-89.0, -30.0, 0.0, 45.0, 90.0])
def test_a_level_frame_turns_by_the_earths_rate(latitude_deg):
    """v' = -omega x v."""
    begin, end = q_icrs_to_ned(
        utc_array("2026-11-22T10:00:00") + np.array([0, 10**9]), latitude_deg, 11.0
    )
    turned = -to_rotation_vector(multiply(end, conjugate(begin)))
    assert turned == pytest.approx(
        earth_rate_ned_rad_s(latitude_deg), abs=EARTH_RATE_RAD_S * POLE_RAD
    )


def test_a_leap_second_does_not_turn_the_earth_back():
    """UTC repeats no second here: 2017 begins two seconds of the Earth after 23:59:59 of 2016."""
    q = q_icrs_to_itrs(
        np.concatenate(
            [
                utc_array("2016-12-31T23:59:58"),
                utc_array("2016-12-31T23:59:59"),
                utc_array("2017-01-01T00:00:00"),
            ]
        )
    )
    first, over = (
        np.linalg.norm(to_rotation_vector(multiply(b, conjugate(a)))) for a, b in pairwise(q)
    )
    assert first == pytest.approx(EARTH_RATE_RAD_S, rel=1e-6)
    assert over == pytest.approx(2 * EARTH_RATE_RAD_S, rel=1e-6)


def test_beyond_the_table_the_user_is_told_by_how_much():
    assert (
        beyond_table(
            int(utc_array("1980-01-01T00:00:00")[0]), int(utc_array("2026-01-01T00:00:00")[0])
        )
        is None
    )
    line = beyond_table(
        int(utc_array("2026-01-01T00:00:00")[0]), int(utc_array("2060-01-01T00:00:00")[0])
    )
    assert line is not None
    assert "beyond it UT1 is guessed" in line
    end = np.datetime64(line.split(" to ")[1][:10])
    for days, years in ((1, 1.0), (300, 1.0), (3653, 10.0)):
        begin_ns, end_ns = (
            int(day.astype("datetime64[ns]").astype(np.int64)) for day in (end, end + days)
        )
        line = beyond_table(begin_ns, end_ns)
        assert line is not None
        off_arcsec = float(line.split("turned by ")[1].split()[0])
        # UT1 parts from UTC by 1.1 s a year, and 1 s is 15.041 arcsec
        assert off_arcsec == pytest.approx(15.041 * 1.1 * years, abs=0.5 + 15.041 * 1.1 / 365.25)
    assert np.isfinite(q_icrs_to_itrs(utc_array("2060-01-01T00:00:00"))).all()


def test_before_the_table_the_user_is_told_by_how_much():
    """It begins on 1973-01-02; ten years earlier UT1 may be off by 11 s."""
    begin_ns, end_ns = (
        int(utc_array(text)[0]) for text in ("1963-01-03T00:00:00", "1990-01-01T00:00:00")
    )
    line = beyond_table(begin_ns, end_ns)
    assert line is not None and " goes from 1973-01-02 to " in line
    off_arcsec = float(line.split("turned by ")[1].split()[0])
    assert off_arcsec == pytest.approx(15.041 * 1.1 * 10, abs=0.5 + 15.041 * 1.1 / 365.25)


@pytest.mark.parametrize(
    ("seconds", "is_told"),
    [
        ([-1000, -1, 0, 1, 2], True),  # the first attitudes alone are before the table
        ([0, 1, 2, 3, 4, 10**8], False),
        ([0, 1, 2, 3, 4, 3 * 10**9], True),  # the last one alone is beyond it
    ],
)
def test_a_log_is_told_to_leave_the_table_at_either_end(monkeypatch, seconds, is_told):
    monkeypatch.setattr(earth, "BATCH", 2)
    begin_ns = int(utc_array("1973-01-02T00:00:00")[0])
    entries = [
        LogEntry("", AttitudeSample(int(second * NS_PER_S), np.array([1.0, 0.0, 0.0, 0.0])))
        for second in seconds
    ]
    told: list[tuple[str, str]] = []
    reference = Reference("ned", (48.1, 11.6), begin_ns)
    turned = list(to_icrs(entries, reference, False, told))
    assert [entry.event.t_ns for entry in turned] == [entry.event.t_ns for entry in entries]
    assert [kind for kind, _ in told] == ["log-earth"] * is_told


@pytest.mark.parametrize(
    ("epoch_utc", "last_ns", "refused"),
    [
        ("1677-09-21T00:12:43", 1, "--epoch-utc 1677-09-21T00:12:43: UTC goes from 1677-09-22 to"),
        ("1677-09-21T00:12:44", 1, ""),
        ("2262-04-11T23:47:16", 854_775_807, ""),
        ("2262-04-11T23:47:16", 854_775_808, "t_s 0.854775808 with --epoch-utc: UTC goes from"),
        ("2262-04-11T23:47:17", 1, "--epoch-utc 2262-04-11T23:47:17: UTC goes from 1677-09-22 to"),
    ],
)
def test_a_utc_that_64_bits_do_not_hold_is_refused(epoch_utc, last_ns, refused):
    """-2^63 ns is 1677-09-21T00:12:43.145224192, and 2^63 - 1 is 2262-04-11T23:47:16.854775807."""
    stated = Stated(reference="ned", place=(48.1, 11.6, 0.0), epoch_utc=epoch_utc)
    unit = np.array([1.0, 0.0, 0.0, 0.0])
    entries = [LogEntry("", AttitudeSample(t_ns, unit)) for t_ns in (0, last_ns, 1)]

    def turned() -> list[LogEntry]:
        reference = stated_reference(Path("log.csv"), "ned", stated, 0)
        return list(to_icrs(entries, reference, False, []))

    if refused:
        with pytest.raises(InputError, match=f"^{refused}"):
            turned()
    else:
        assert len(turned()) == len(entries)


def test_a_level_frame_is_described_with_its_latitude_before_its_longitude():
    turned = (
        "turned to the ICRS with the Earth (IAU 2006/2000A; 15 arcsec for each second that its"
        " UTC is off)"
    )
    assert Reference("ned", (48.1, -11.6)).words == (
        f"north, east, down at latitude 48.1, longitude -11.6, {turned}"
    )
    assert Reference("enu", (-33.9, 151.2)).words == (
        f"east, north, up at latitude -33.9, longitude 151.2, {turned}"
    )
    assert Reference("icrs").words == "the ICRS"


@pytest.mark.parametrize(
    "text",
    ["", "yesterday", "2026-13-01T00:00:00", "2026-11-22", "2026-11-22T25:00:00", "9" * 4000],
)
def test_a_text_that_is_no_utc_is_refused(text):
    with pytest.raises(InputError, match="write a UTC such as"):
        utc_ns_of(text, "--epoch-utc")


def test_a_utc_is_read_to_the_nanosecond():
    assert utc_ns_of("2001-09-09T01:46:40.000000001Z", "--epoch-utc") == 10**18 + 1
