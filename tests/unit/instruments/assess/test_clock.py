"""The tracker's clock against the run's: a planted offset and drift come out with their signs, and
their sigmas are those of errors by chance.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import FloatArray
from hilstar.instruments.assess.clock import (
    CUT_SIGMAS,
    DRIFT_PRIOR,
    FLOOR_ARCSEC,
    OFFSET_PRIOR_S,
    ClockFit,
    ClockSolver,
    CoarseClock,
    _correlation,
    _variances,
    coarse_offset,
    honest,
    most_likely,
    speed_offsets,
    weights_of,
)
from hilstar.instruments.assess.components import global_phases
from hilstar.instruments.assess.places import bumps_at, centres_of
from hilstar.server.record.commanded import Commanded
from tests.support.assessments import a_clock
from tests.support.planted_tracker import SCALE, attitude, scalar_first

ARCSEC_PER_RAD = 180 * 3600 / np.pi
START_S, SECONDS, FRAME_S, ANSWER_S = 1000.0, 60.0, 0.05, 0.25
BIAS_ARCSEC = np.array([30.0, -20.0, 60.0])
OFFSET_S, DRIFT = 0.8, 5e-4  # of a minute: 30 ms
NOISE_ARCSEC = 1.0
# A cubic between frames 0.05 s apart leaves microarcseconds of these swings: 1e-7 s.
EXACT_S, EXACT_ARCSEC = 1e-5, 0.01
SIGMAS = 4.0
MOST_WIDENED = 2.0  # by what parts of the field have of white noise by chance


def swings(t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Slews of both signs, up to 1 deg/s about each axis."""
    turn = 2 * np.pi * (t_s - START_S)
    return 84 + 3 * np.sin(turn / 19), 2 * np.sin(turn / 13 + 0.4), 5 * np.sin(turn / 31)


RUN_S = START_S + np.arange(0.0, SECONDS + FRAME_S, FRAME_S)
RUN = Commanded(RUN_S, scalar_first(attitude(swings, RUN_S)))


def telemetry(
    offset_s: float = OFFSET_S, drift: float = DRIFT, noise: FloatArray | float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Times and attitudes of a tracker whose clock is ahead by `offset_s` when the run begins, and
    fast by `drift`: tau = t + o + d (t - t_0).
    """
    t_s = START_S + np.arange(1.0, SECONDS - 1.0, ANSWER_S)
    error = (BIAS_ARCSEC + noise) / ARCSEC_PER_RAD * np.ones((len(t_s), 1))
    q = scalar_first(Rotation.from_rotvec(error) * attitude(swings, t_s))
    return t_s + offset_s + drift * (t_s - START_S), q


def fitted(tau_s: FloatArray, q: FloatArray) -> ClockFit:
    coarse = coarse_offset(RUN, tau_s, q)
    assert coarse is not None
    return ClockSolver(RUN, tau_s, q, SCALE).fit(coarse)


@pytest.mark.parametrize(
    ("offset_s", "drift"), [(OFFSET_S, DRIFT), (-OFFSET_S, -DRIFT), (0.0, 0.0)]
)
def test_a_clock_s_offset_drift_and_bias_come_out_with_their_signs(offset_s, drift):
    found = fitted(*telemetry(offset_s, drift))
    assert found.offset_s == pytest.approx(offset_s, abs=EXACT_S)
    assert found.drift * SECONDS == pytest.approx(drift * SECONDS, abs=EXACT_S)
    bias = ARCSEC_PER_RAD * Rotation.from_quat(np.roll(found.rotation, -1)).as_rotvec()
    assert bias == pytest.approx(BIAS_ARCSEC, abs=EXACT_ARCSEC)
    assert np.abs(found.residual_arcsec[found.used]).max() < EXACT_ARCSEC
    assert found.offset_told and found.drift_told
    tau_s, _ = telemetry(offset_s, drift)
    assert found.run_s(tau_s, START_S) == pytest.approx(found.t_s, abs=1e-9)
    assert found.run_s(np.array([START_S + offset_s]), START_S) == pytest.approx(
        [START_S], abs=1e-5
    )


def test_the_sigmas_of_a_clock_are_those_of_least_squares(rng):
    """By the rates that SciPy's rotations have: white noise of an arcsec along each axis."""
    tau_s, _ = telemetry()
    found = fitted(*telemetry(noise=NOISE_ARCSEC * rng.standard_normal((len(tau_s), 3))))
    t_s = (tau_s - OFFSET_S + DRIFT * START_S) / (1 + DRIFT)
    step_s = 1e-3
    turn = attitude(swings, t_s + step_s / 2) * attitude(swings, t_s - step_s / 2).inv()
    rate_arcsec_s = ARCSEC_PER_RAD * turn.as_rotvec() / step_s
    share = (t_s - START_S) / SECONDS
    normal = np.zeros((5, 5))
    for axis in range(3):
        design = np.zeros((len(t_s), 5))
        design[:, axis] = 1.0
        design[:, 3] = rate_arcsec_s[:, axis]
        design[:, 4] = rate_arcsec_s[:, axis] * share
        normal += design.T @ design / NOISE_ARCSEC**2
    sigma = np.sqrt(np.diag(np.linalg.inv(normal)))
    # noise that is itself found is known to 1 / sqrt(2 n); parts of the field may widen it
    least = 1 - SIGMAS / np.sqrt(2 * len(t_s))
    assert least < found.sigma_offset_s / sigma[3] < MOST_WIDENED
    assert least < found.sigma_drift * SECONDS / sigma[4] < MOST_WIDENED
    assert abs(found.offset_s - OFFSET_S) < SIGMAS * found.sigma_offset_s
    assert abs(found.drift - DRIFT) < SIGMAS * found.sigma_drift


def test_wild_answers_are_in_no_fit(rng):
    tau_s, q = telemetry()
    wild = rng.choice(len(q), 40, replace=False)
    q[wild] = scalar_first(Rotation.random(40, random_state=3))
    found = fitted(tau_s, q)
    assert not found.used[wild].any()
    assert found.offset_s == pytest.approx(OFFSET_S, abs=EXACT_S)


def test_a_coarse_offset_is_what_has_to_be_added_to_the_telemetry_s_times():
    tau_s, q = telemetry(offset_s=7.3, drift=0.0)
    coarse = coarse_offset(RUN, tau_s, q)
    assert coarse is not None
    # half of a second's turn is below what tells two offsets apart
    assert coarse.offset_s == pytest.approx(-7.3, abs=0.1)
    assert np.abs(speed_offsets(RUN, tau_s, q) + 7.3).min() < 0.6


def test_a_speed_is_the_usual_one_of_a_bin_though_some_answers_are_wild(rng):
    """One answer of eight, ten to a step of the grid, turns from and to a place of its own."""
    t_s = START_S + np.arange(1.0, SECONDS - 1.0, 0.05)
    q = scalar_first(attitude(swings, t_s))
    wild = np.arange(4, len(q), 8)
    q[wild] = scalar_first(Rotation.random(len(wild), random_state=5))
    best_s, *_ = speed_offsets(RUN, t_s + 7.3, q)
    assert best_s == pytest.approx(-7.3, abs=0.6)


def test_few_answers_that_agree_better_do_not_outvote_many():
    """A tracker on its side about the axis of a steady turn: at any offset its answers agree among
    themselves, and at 45 s, where a quarter of them are compared, with the run besides.
    """
    rate_rad_s = np.radians(1.0)
    t_s = START_S + np.arange(0.0, SECONDS, ANSWER_S)
    turn_rad = rate_rad_s * (RUN_S - START_S)
    run = Commanded(RUN_S, scalar_first(Rotation.from_rotvec(turn_rad[:, None] * [0, 0, 1])))
    on_its_side_rad = rate_rad_s * (t_s - START_S) + np.radians(45.0)
    q = scalar_first(Rotation.from_rotvec(on_its_side_rad[:, None] * [0, 0, 1]))
    coarse = coarse_offset(run, t_s, q)
    assert coarse is not None
    assert coarse.compared >= 0.8 * len(t_s)
    assert abs(coarse.offset_s) <= 0.2 * SECONDS


def test_parts_of_a_field_that_differ_widen_a_sigma_and_never_narrow_it(rng):
    """Pulls that are the same in each of twenty parts, or that cancel in them."""
    parts, answers = 20, 50
    place = np.repeat(1000.0 * np.eye(6)[0] * np.arange(parts)[:, None], answers, axis=0)
    own = rng.standard_normal(parts)
    alike = np.repeat(own, answers)[:, None] * np.ones(5)
    covariance = np.diag([1.0, 4.0, 1.0, 1.0, 9.0])
    wide = honest(covariance, alike, place)
    spread = answers * own
    expected = ((spread - spread.mean()) ** 2).sum()
    # a variance v grows to v^2 times the squares of the parts' pulls
    assert np.diag(wide) == pytest.approx(np.diag(covariance) ** 2 * expected)
    cancels = np.tile([1.0, -1.0], parts * answers // 2)[:, None] * np.ones(5)
    assert honest(covariance, cancels, place) == pytest.approx(covariance)


def test_the_phase_of_right_ascension_is_pixels_on_the_sky():
    """At 60 degrees of declination a boresight moves by half of its right ascension."""
    pixel_deg = np.degrees(1 / SCALE.focal_px)
    ra = 84 + 2 * pixel_deg * np.arange(9.0)
    q = scalar_first(attitude(lambda t: (ra, np.full(9, 60.0), np.zeros(9)), np.zeros(9)))
    phases = {found.name: found for found in global_phases(np.zeros((9, 3)), q, SCALE)}
    (name,) = [name for name in phases if "right ascension" in name]
    place_px = phases[name].place_px
    assert place_px[:, 0] - place_px[0, 0] == pytest.approx(np.arange(9.0), abs=1e-3)
    assert np.ptp(place_px[:, 1]) < 1e-6
    # as the star that stood on the boresight moves over the detector, but for its curve
    first = phases["the phase of the first boresight"].place_px
    moved = np.linalg.norm(first - first[0], axis=1)
    assert moved == pytest.approx(np.arange(9.0), abs=0.01)


def test_answers_weigh_by_tukey_s_biweight_of_their_own_scatter() -> None:
    """Of residuals of -2 to 2 about x, four times that about y and none about z; one is far off."""
    x = np.array([-2.0, -1.0, 0.0, 1.0, 2.0, 1e4])
    residual = np.stack([x, 4 * x, np.zeros(6)], axis=1)
    sigma, weight = weights_of(residual)
    # the median is 0.5, and the deviations' 1.5
    expected = 1.4826 * np.array([1.5, 6.0])
    assert sigma[:2] == pytest.approx(expected, rel=1e-3)
    assert sigma[2] == FLOOR_ARCSEC
    squared = 2 * ((x - 0.5) / expected[0]) ** 2
    assert weight[:5] == pytest.approx((1 - squared[:5] / CUT_SIGMAS**2) ** 2, rel=1e-3)
    assert weight[5] == 0.0


@pytest.mark.parametrize(("bins", "fewest"), [(200, 20), (40, 8)])
def test_speeds_that_mirror_each_other_or_hardly_overlap_tell_nothing(bins, fewest, rng):
    """A tenth of the shorter recording, and eight bins, have to be common to both."""
    speed = rng.uniform(0.5, 1.5, bins)
    alike, lag = _correlation(speed, speed)
    # a correlation of 1 - 1e-9
    assert alike[lag == 0] == pytest.approx(-bins * np.log(2e-9), rel=1e-6)
    mirrored, _ = _correlation(speed, 2.0 - speed)
    assert mirrored[lag == 0] == 0.0
    common = bins - np.abs(lag)
    assert not alike[common < fewest].any()
    assert alike[(common >= fewest) & (common < 2 * fewest)].any()


@pytest.mark.parametrize(
    ("noise_arcsec", "told", "sigmas"), [(5.0, False, (0.3, 1.0)), (0.5, True, (0.03, 0.3))]
)
def test_a_drift_that_hardly_shows_is_drawn_to_none(rng, noise_arcsec, told, sigmas):
    """Noise of 5 arcsec in slews of 5 arcsec/s tells a drift as badly as none is known."""

    def slow(t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        turn = 2 * np.pi * (t_s - START_S)
        wide_deg = 5 / 3600 * 10 / (2 * np.pi)
        return 84 + wide_deg * np.sin(turn / 10), wide_deg * np.cos(turn / 10), 0 * t_s

    run = Commanded(RUN_S, scalar_first(attitude(slow, RUN_S)))
    t_s = START_S + np.arange(1.0, SECONDS - 1.0, ANSWER_S)
    error = noise_arcsec * rng.standard_normal((len(t_s), 3)) / ARCSEC_PER_RAD
    q = scalar_first(Rotation.from_rotvec(error) * attitude(slow, t_s))
    coarse = CoarseClock(0.0, 1e-4, np.array([1.0, 0.0, 0.0, 0.0]), len(t_s))
    found = ClockSolver(run, t_s, q, SCALE).fit(coarse)
    assert found.drift_told == told
    # what is known beforehand and what shows together are better than either
    smallest, largest = sigmas
    assert smallest * DRIFT_PRIOR < found.sigma_drift < largest * DRIFT_PRIOR
    assert abs(found.drift) < 3 * largest * DRIFT_PRIOR


@pytest.mark.parametrize("begun_s", [-7.0, 12.5])
def test_a_clock_that_no_motion_tells_stays_where_it_was_begun(
    rng: np.random.Generator, begun_s: float
) -> None:
    """Of a sky at rest: offset and drift are known as before, and no better."""
    q = scalar_first(attitude(lambda t_s: (84 + 0 * t_s, 0 * t_s, 0 * t_s), RUN_S))
    t_s = START_S + np.arange(20.0, SECONDS - 20.0, ANSWER_S)
    turn = NOISE_ARCSEC * rng.standard_normal((len(t_s), 3)) / ARCSEC_PER_RAD
    reported = scalar_first(Rotation.from_rotvec(turn) * Rotation.from_quat(np.roll(q[0], -1)))
    coarse = CoarseClock(begun_s, 1e-4, np.array([1.0, 0.0, 0.0, 0.0]), len(t_s))
    found = ClockSolver(Commanded(RUN_S, q), t_s - begun_s, reported, SCALE).fit(coarse)
    assert found.offset_s == pytest.approx(-begun_s, abs=EXACT_S)
    assert found.drift * SECONDS == pytest.approx(0.0, abs=EXACT_S)
    assert found.sigma_offset_s == pytest.approx(OFFSET_PRIOR_S)
    assert found.sigma_drift == pytest.approx(DRIFT_PRIOR)
    assert not found.offset_told and not found.drift_told


@pytest.mark.parametrize(("begun", "bins", "lag"), [(300, 50, -300), (20, 60, -20)])
def test_a_lag_is_where_the_longer_recording_began_before_the_shorter(begun, bins, lag, rng):
    """A piece of 400 bins, that begins so many after them; and the other way round."""
    whole = rng.uniform(0.5, 1.5, 400)
    part = whole[begun : begun + bins]
    for a, b, wanted in ((part, whole, lag), (whole, part, -lag)):
        information, lags = _correlation(a, b)
        assert lags[np.argmax(information)] == wanted


def test_telemetry_that_began_before_a_steady_slew_is_found_by_its_attitudes():
    """Angular speeds are all alike, and so is the turn between attitudes at any other offset. Two
    of five answers are wild.
    """
    turn_rad = np.radians(1.0) * (RUN_S - START_S)
    run = Commanded(RUN_S, scalar_first(Rotation.from_rotvec(turn_rad[:, None] * [0, 0, 1])))
    t_s = np.arange(0.0, SECONDS, ANSWER_S)
    shown_rad = np.radians(1.0) * (t_s - 10.0)
    q = scalar_first(Rotation.from_rotvec(shown_rad[:, None] * [0, 0, 1]))
    wild = np.arange(len(q)) % 5 < 2
    q[wild] = scalar_first(Rotation.random(int(wild.sum()), random_state=6))
    coarse = coarse_offset(run, t_s, q)
    assert coarse is not None
    assert coarse.offset_s == pytest.approx(START_S - 10.0, abs=0.5)
    assert coarse.turn_rad < np.radians(0.5)


def test_an_offset_between_the_steps_of_a_search_beats_one_upon_them_by_a_lap() -> None:
    """Laps of 120.25 s swing alike to 1 in 2000, and the telemetry began in the second: a lap
    before is at 80 s, a step of 0.5 s, and the truth is between two.
    """

    def swung(t_s: FloatArray) -> FloatArray:
        laps = t_s / 120.25
        turn_rad = np.radians(20 * (1 + 0.0005 * laps)) * np.sin(2 * np.pi * laps)
        return scalar_first(Rotation.from_rotvec(turn_rad[:, None] * [0, 0.6, 0.8]))

    run_s = np.arange(0.0, 800.0, 0.01)
    t_s = np.arange(0.0, 299.0, 0.1)
    coarse = coarse_offset(Commanded(run_s, swung(run_s)), t_s, swung(t_s + 200.25))
    assert coarse is not None
    assert coarse.offset_s == pytest.approx(200.25, abs=1e-3)


def test_a_telemetry_s_time_is_put_on_the_run_s_clock() -> None:
    """An hour after a start at 100 s, of a clock 1.25 ms ahead and 12.5 ppm fast."""
    told_s = 100 + 0.00125 + 3600 * (1 + 12.5e-6)
    assert a_clock().run_s(np.array([told_s]), 100.0) == pytest.approx([3700.0], rel=1e-12)


def test_the_likelihood_of_bumps_is_that_of_all_axes_together(rng) -> None:
    """By SciPy's multivariate normal law, of which the variances found are the most likely: an
    error over the place along x, along y, and noise alone.
    """
    at_px = np.linspace(0.0, 600.0, 80)
    place = at_px[:, None] * np.eye(6)[0]
    bumps = bumps_at(place, centres_of(place, 100.0), 100.0)
    error = np.stack([np.sin(at_px / 90), 0.5 * np.cos(at_px / 70), 0 * at_px], axis=1)
    residual = error + 0.3 * rng.standard_normal((80, 3))
    residual -= residual.mean(axis=0)
    smooth, likelihood = _variances(bumps, residual)
    dense = np.asarray(bumps.todense())
    constant = 40 * (1 + np.log(2 * np.pi))
    by_axis = []
    for axis in range(3):
        shape = np.eye(80) + smooth.kappa[axis] * dense @ dense.T
        law = stats.multivariate_normal(np.zeros(80), smooth.variance[axis] * shape)
        by_axis.append(law.logpdf(residual[:, axis]) + constant)
    assert likelihood == pytest.approx(sum(by_axis))
    # and of white noise where there are no bumps, by which these are taken
    taken = most_likely(place, residual)
    assert taken.bumps is not None
    assert (taken.kappa[:2] > 0.01).all()
