"""An OEM's orbit against SGP4, which wrote it, between its epochs and in every time scale; and
what is refused.
"""

from __future__ import annotations

import logging
import re

import numpy as np
import pytest

from hilstar.sky.bodies.oem import OemOrbit
from tests.support.refusals import refusal
from tests.support.skies import utc_ns
from tests.support.sources.oem_messages import START_NS, STATION, oem, segment

MINUTES = range(0, 1260, 60)
# SGP4's velocity is the derivative of its place within 2e-5 km/s (measured), which makes 4e-4 km of
# a place between epochs; the polynomial itself (h = 60 s: (9/16 h^2)^4 r n^8 / 8! = 1e-11 km) is
# held to its degree below. A second's error is 7.5 km. No full hour is crossed, where the axes of
# TleOrbit turn by 0.2 m.
PLACE_KM = 1e-3
VELOCITY_KM_S = 1e-4
NS = 10**9


def station(text: str) -> OemOrbit:
    return OemOrbit(text, "a.oem", START_NS)


def test_between_epochs_the_orbit_is_that_of_the_program_that_wrote_it(rng):
    orbit = station(oem(segment(MINUTES)))
    for second in rng.uniform(0, 1200, size=40):
        t_ns = START_NS + round(second * NS)
        (place, velocity), (true_place, true_velocity) = orbit.state(t_ns), STATION.state(t_ns)
        assert place == pytest.approx(true_place, abs=PLACE_KM)
        assert velocity == pytest.approx(true_velocity, abs=VELOCITY_KM_S)


@pytest.mark.parametrize(
    ("scale", "ahead_s"),
    [("UTC", 0.0), ("TAI", 33.0), ("TT", 65.184), ("TDB", 65.184), ("GPS", 14.0)],
)
@pytest.mark.parametrize("day_of_year", [False, True])
def test_every_time_scale_tells_the_same_moment(scale, ahead_s, day_of_year):
    """In September 2008 TAI was 33 s ahead of UTC."""
    orbit = station(oem(segment(MINUTES, ahead_s, day_of_year, TIME_SYSTEM=scale)))
    at_ns = START_NS + 615 * NS
    assert orbit.state(at_ns)[0] == pytest.approx(STATION.state(at_ns)[0], abs=PLACE_KM)


def test_the_last_day_of_a_leap_year_is_its_366th():
    """Places at the same moments of two days are the same where the file says so."""
    text = oem(segment(MINUTES))
    end_ns = utc_ns("2008-12-31T12:30:00Z")
    for date in ("2008-366", "2008-12-31"):
        orbit = OemOrbit(text.replace("2008-09-20T1", f"{date}T1"), "a.oem", end_ns)
        for seconds in (0, 615):
            wanted_km = STATION.state(START_NS + seconds * NS)[0]
            assert orbit.state(end_ns + seconds * NS)[0] == pytest.approx(wanted_km, abs=PLACE_KM)


def test_segments_are_not_joined_and_covariances_and_accelerations_are_passed_over():
    first = (
        segment(MINUTES)
        + "COVARIANCE_START\nEPOCH = 2008-09-20T00:00:00\n1.0\n1.0 2.0\nCOVARIANCE_STOP\n"
    )
    second = "\n".join(
        line + " 0 0 0" if line.startswith("2008") else line
        for line in segment([1200, 1300, 1400]).splitlines()
    )
    orbit = station(oem(first, second, version="3.0"))
    for second_s in (30, 1199, 1250, 1399):
        t_ns = START_NS + second_s * NS
        assert orbit.state(t_ns)[0] == pytest.approx(STATION.state(t_ns)[0], abs=PLACE_KM)


@pytest.mark.parametrize(("beyond_s", "end_s"), [((1201, 9000), 1200), ((-1, -9000), 0)])
def test_beyond_its_epochs_the_nearest_place_is_held_and_told_once(caplog, beyond_s, end_s):
    orbit = station(oem(segment(MINUTES)))
    with caplog.at_level(logging.WARNING):
        beyond = [orbit.state(START_NS + s * NS)[0] for s in beyond_s]
    assert beyond[0] == pytest.approx(STATION.state(START_NS + end_s * NS)[0], abs=PLACE_KM)
    assert beyond[1].tolist() == beyond[0].tolist()
    assert len(caplog.records) == 1 and "is held" in caplog.text


@pytest.mark.parametrize("seconds", [-1, 11])
def test_an_orbit_of_seconds_is_told_where_it_ends(caplog, seconds):
    """Stars are placed for START_NS, where frames are shown from the start: no two minutes about
    it go untold.
    """
    with caplog.at_level(logging.WARNING):
        station(oem(segment([0, 5, 10]))).state(START_NS + seconds * NS)
    assert len(caplog.records) == 1 and "is held" in caplog.text


def test_the_moment_for_which_stars_are_placed_need_not_be_covered(caplog):
    """With the dates of a source that is the beginning of its day."""
    with caplog.at_level(logging.WARNING):
        orbit = OemOrbit(oem(segment(MINUTES)), "a.oem", START_NS - 12 * 3600 * NS, day=True)
        assert orbit.state(START_NS - 12 * 3600 * NS)[0] == pytest.approx(
            STATION.state(START_NS)[0], abs=PLACE_KM
        )
        assert orbit.state(START_NS + 60 * NS)[0] == pytest.approx(
            STATION.state(START_NS + 60 * NS)[0], abs=PLACE_KM
        )
    assert not caplog.records


@pytest.mark.parametrize(
    ("step_s", "told"), [(60, False), (1100, False), (1800, True), (3600, True)]
)
def test_epochs_too_far_apart_for_the_polynomial_are_told(caplog, step_s, told):
    """At 18 minutes it is good to 0.4 km; at half an hour, a third of the orbit, to 15 km."""
    with caplog.at_level(logging.WARNING):
        orbit = station(oem(segment(range(0, 9 * step_s, step_s))))
    assert ("between its epochs the orbit is off" in caplog.text) == told
    t_ns = START_NS + round(3.5 * step_s) * NS
    off_km = np.linalg.norm(orbit.state(t_ns)[0] - STATION.state(t_ns)[0])
    assert (off_km > 1.0) == told
    if told:  # the figure is that of the worst epoch, by the first term that is left out
        told_km = float(re.search(r"off by some ([\d.e+]+) km", caplog.text)[1])
        assert off_km / 8 < told_km < 3 * off_km


GOOD = oem(segment([0, 60, 120]))
ROW = next(line for line in GOOD.splitlines() if line.startswith("2008"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (oem(), "contains no segment"),
        (oem(segment([0])), "a segment has 1 states"),
        (
            oem(segment([90_000, 90_060])),
            "no orbit within a day of 2008-09-20T12:30:00 UTC; it has 2008-09-21T13:30:00 to",
        ),
        (oem(segment([0, 60], REF_FRAME="ITRF")), "REF_FRAME is ITRF and CENTER_NAME EARTH"),
        (oem(segment([0, 60], CENTER_NAME="MARS BARYCENTER")), "CENTER_NAME MARS BARYCENTER"),
        (oem(segment([0, 60], REF_FRAME=None)), "REF_FRAME is missing"),
        (oem(segment([0, 60], TIME_SYSTEM="MET")), "TIME_SYSTEM is MET"),
        (oem(segment([0, 60, 60])), "the epoch is not after the one before it"),
        (GOOD.replace(ROW, ROW.rsplit(" ", 1)[0]), "write an epoch, X Y Z"),
        (GOOD.replace(ROW, ROW.replace("2008-09-20", "2008-09-31")), "the epoch is '2008-09-31"),
        (GOOD.replace(ROW, ROW.replace("2008-09-20", "9999-09-20")), "the epoch is '9999-09-20"),
        (GOOD.replace(ROW, ROW.replace("2008-09-20", "2007-366")), "the epoch is '2007-366"),
        (GOOD.replace(ROW, ROW.replace("2008-09-20", "2008-000")), "the epoch is '2008-000"),
        (
            GOOD.replace(ROW, ROW.split(" ")[0] + " nan 0 0 0 0 0"),
            "write km from the Earth's centre",
        ),
        (GOOD.replace(ROW, ROW.split(" ")[0] + " 1 1 1 0 0 0"), "write km from the Earth's centre"),
        (
            GOOD.replace(ROW, ROW.split(" ")[0] + " 7000 1e308 0 0 7.5 0"),
            "write km from the Earth's centre",
        ),
        (
            GOOD.replace(ROW, ROW.split(" ")[0] + " 7000e3 0 0 0 7.5e3 0"),
            "write km from the Earth's centre",
        ),
        (
            GOOD.replace(ROW, ROW.split(" ")[0] + " -7000e6 0 0 0 7.5 0"),
            "write km from the Earth's centre",
        ),
        (
            GOOD.replace(ROW, ROW.split(" ")[0] + " 7000 0 0 0 -7.5e3 0"),
            "write km from the Earth's centre",
        ),
        (
            GOOD.replace(ROW, ROW.split(" ")[0] + " 7000 0 0 0 7.5e3 0"),
            "write km from the Earth's centre",
        ),
        (GOOD[: GOOD.index("META_STOP")], "ends in the metadata"),
        (GOOD.replace("META_STOP", "META_STOP\nanything"), "'anything'"),
    ],
)
def test_what_is_no_orbit_about_the_earth_is_refused_in_one_line(text, words):
    line = refusal(station, text)
    assert words in line
    assert line.startswith("a.oem")


def test_where_two_segments_meet_the_later_one_holds():
    """The second begins with the states of ten seconds later, as after a manoeuvre."""
    later = segment([1210, 1310, 1410], -10.0)
    orbit = station(oem(segment(MINUTES[:21]), later))
    before_ns, at_ns = START_NS + 1199 * NS, START_NS + 1200 * NS
    assert orbit.state(before_ns)[0] == pytest.approx(STATION.state(before_ns)[0], abs=PLACE_KM)
    assert orbit.state(at_ns)[0] == pytest.approx(STATION.state(at_ns + 10 * NS)[0], abs=PLACE_KM)


def test_the_age_of_elements_is_from_their_epoch_s_fraction_of_a_day_on():
    """The epoch, 08264.51782528, is that part of the 264th day of 2008."""
    first_day_ns = utc_ns("2008-01-01T00:00:00")
    epoch_ns = first_day_ns + round(263.51782528 * 86400e9)
    assert STATION.age_days(epoch_ns) == pytest.approx(0.0, abs=1e-8)
    assert STATION.age_days(epoch_ns - 86400 * NS) == pytest.approx(-1.0, abs=1e-8)
