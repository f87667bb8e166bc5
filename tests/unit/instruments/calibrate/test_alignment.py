"""The alignment from quaternions: planted rotations, noise, wild ones, other conventions, and
what no rotation explains.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import f_oneway

from hilstar.basics.rotation import (
    angle_between_rad,
    conjugate,
    from_rotation_vector,
    from_rotation_vectors,
    multiply,
    normalise,
    to_matrix,
    to_rotation_vector,
)
from hilstar.basics.units import ARCSEC_PER_RAD, MAD_TO_SIGMA
from hilstar.display.geometry import load_notes, monitor_camera
from hilstar.display.identity import MonitorIdentity
from hilstar.instruments.calibrate.alignment import (
    AxesArcsec,
    Residual,
    _causes,
    _explained,
    align,
    corrected,
    groups_of,
    lines_of,
    remarks_of,
    residual_of,
    summary_of,
    write_alignment,
)
from hilstar.instruments.calibrate.attitude_pairs import (
    COMMANDED,
    Pairs,
    RotationFit,
    _angles_to,
    _weights,
    pair_with_ledger,
)
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.benches import bench_text
from tests.support.planted_run import write_ledger
from tests.support.refusals import refusal

CAMERA = monitor_camera(
    (1920, 1080), 57.65, 350.0, normalise(np.array([1.0, 0.001, -0.002, 0.003]))
)
PLANTED_ARCSEC = np.array([820.0, -310.0, 2400.0])
NOISE_ARCSEC = np.array([5.0, 5.0, 40.0])
# A mean of n is off by noise / sqrt(n); 1 in 10^4 is further off than four of these in any of three
# axes.
SIGMAS = 4.0
EXACT_ARCSEC = 1e-6


def commanded_of(rng: np.random.Generator, count: int) -> np.ndarray:
    return normalise(rng.normal(size=(count, 4)))


def turned_by(
    rng: np.random.Generator, commanded: np.ndarray, noise_arcsec: np.ndarray = NOISE_ARCSEC
) -> np.ndarray:
    """What a tracker with noise reports: the planted rotation after the commanded attitude."""
    noise = rng.normal(size=(len(commanded), 3)) * noise_arcsec / ARCSEC_PER_RAD
    planted = from_rotation_vector(PLANTED_ARCSEC / ARCSEC_PER_RAD)
    return multiply(from_rotation_vectors(noise), multiply(planted, commanded))


def pairs_of(commanded: np.ndarray, reported: np.ndarray, rate: np.ndarray | None = None) -> Pairs:
    return Pairs(
        Path("pairs.csv"), np.arange(len(commanded)) + 2, commanded, reported, rate_rad_s=rate
    )


def test_a_rotation_vector_comes_back(rng):
    vectors = rng.normal(size=(500, 3)) * 10.0 ** rng.uniform(-12, 0, (500, 1))
    back = to_rotation_vector(from_rotation_vectors(vectors))
    assert np.abs(back - vectors).max() < 1e-15 + 1e-14 * np.linalg.norm(vectors, axis=1).max()
    assert np.allclose(
        from_rotation_vectors(vectors)[0], from_rotation_vector(vectors[0]), atol=1e-16
    )


@pytest.mark.parametrize(
    ("count", "wild_share"), [(3, 0), (30, 0.1), (400, 0.01), (400, 0.1), (400, 0.4)]
)
def test_the_planted_rotation_is_found_within_its_own_sigma_whatever_is_wild(
    rng, count, wild_share
):
    commanded = commanded_of(rng, count)
    reported = turned_by(rng, commanded)
    wild = np.sort(rng.permutation(count)[: int(wild_share * count)])
    reported[wild] = commanded_of(rng, len(wild))
    reported *= rng.choice([-1.0, 1.0], (count, 1))  # q and -q are one attitude
    found = align(pairs_of(commanded, reported), CAMERA)
    good = count - len(wild)
    assert np.abs(np.array(found.rotation_arcsec) - PLANTED_ARCSEC).max() < SIGMAS * NOISE_ARCSEC[
        2
    ] / np.sqrt(good)
    assert np.abs(np.array(found.rotation_arcsec) - PLANTED_ARCSEC)[
        :2
    ].max() < SIGMAS * NOISE_ARCSEC[0] / np.sqrt(good)
    assert set(wild + 2) <= set(found.wild)
    assert len(found.wild) == len(wild)
    if count >= 30:
        assert np.array(found.sigma_arcsec) == pytest.approx(NOISE_ARCSEC / np.sqrt(good), rel=0.5)
        assert found.residual.rms.cross == pytest.approx(NOISE_ARCSEC[0], rel=0.3)
        assert found.residual.rms.roll == pytest.approx(NOISE_ARCSEC[2], rel=0.3)


def test_wild_ones_a_few_arcminutes_off_are_named_and_change_nothing(rng):
    commanded = commanded_of(rng, 200)
    reported = turned_by(rng, commanded)
    clean = align(pairs_of(commanded, reported), CAMERA)
    off = from_rotation_vector(np.array([300.0, 200.0, 0.0]) / ARCSEC_PER_RAD)
    reported[5:200:10] = multiply(off, reported[5:200:10])
    found = align(pairs_of(commanded, reported), CAMERA)
    assert found.wild == tuple(range(7, 202, 10))
    assert (
        np.abs(np.subtract(found.rotation_arcsec, clean.rotation_arcsec))[:2].max()
        < NOISE_ARCSEC[0] / 4
    )


def test_the_sigma_covers_the_error(rng):
    """Of 100 sets the squared error over sigma is 1 on average, within the spread of a chi
    square of 300.
    """
    ratios = []
    for _ in range(100):
        commanded = commanded_of(rng, 25)
        found = align(pairs_of(commanded, turned_by(rng, commanded)), CAMERA)
        ratios.append(np.subtract(found.rotation_arcsec, PLANTED_ARCSEC) / found.sigma_arcsec)
    assert 0.7 < np.mean(np.square(ratios)) < 1.6


def test_one_attitude_determines_the_rotation_and_the_summary_says_what_it_cannot_tell(rng):
    commanded = np.repeat(commanded_of(rng, 1), 20, axis=0)
    found = align(pairs_of(commanded, turned_by(rng, commanded)), CAMERA)
    assert np.abs(
        np.subtract(found.rotation_arcsec, PLANTED_ARCSEC) / NOISE_ARCSEC
    ).max() < SIGMAS / np.sqrt(20)
    assert any("one attitude" in note for note in remarks_of(found.residual))


def test_what_goes_with_attitude_is_told_from_noise_by_repeats(rng):
    """Each of 40 attitudes has an error of its own, as a distorted screen gives it; each is
    taken five times.
    """
    attitudes = commanded_of(rng, 40)
    own = from_rotation_vectors(rng.normal(size=(40, 3)) * [30.0, 30.0, 100.0] / ARCSEC_PER_RAD)
    commanded = np.repeat(attitudes, 5, axis=0)
    reported = multiply(np.repeat(own, 5, axis=0), turned_by(rng, commanded))
    found = align(pairs_of(commanded, reported), CAMERA)
    assert found.residual.repeat.cross == pytest.approx(5.0, rel=0.2)
    assert found.residual.unexplained.cross == pytest.approx(30.0, rel=0.35)
    assert found.residual.unexplained.roll == pytest.approx(100.0, rel=0.35)
    assert any(
        "a rotation does not explain" in note and "dots" in note
        for note in remarks_of(found.residual)
    )
    assert not found.residual.causes
    assert min(found.sigma_arcsec) > 30 / np.sqrt(40) / 1.5  # the attitudes count, not the pairs


def test_noise_alone_is_no_more_than_a_rotation(rng):
    for _ in range(20):
        commanded = np.repeat(commanded_of(rng, 20), 4, axis=0)
        found = align(pairs_of(commanded, turned_by(rng, commanded)), CAMERA)
        assert (found.residual.unexplained.cross, found.residual.unexplained.roll) == (0.0, 0.0)
        assert found.residual.causes == ()


def test_a_reference_frame_of_date_is_named(rng):
    commanded = commanded_of(rng, 60)
    precession = from_rotation_vector(np.array([0.0, 520.0, 1190.0]) / ARCSEC_PER_RAD)
    found = align(pairs_of(commanded, multiply(turned_by(rng, commanded), precession)), CAMERA)
    assert any(
        "reference frame" in cause and "1.3e+03 arcsec" in cause for cause in found.residual.causes
    )


@pytest.mark.parametrize(("attitudes", "repeats"), [(5, 1), (6, 1), (5, 4), (6, 4)])
def test_a_cause_is_named_from_six_attitudes_on_however_often_each_is_repeated(
    rng, attitudes, repeats
):
    """A reference frame that is turned by 1000 arcsec, without noise."""
    commanded = np.repeat(commanded_of(rng, attitudes), repeats, axis=0)
    group = np.repeat(np.arange(attitudes), repeats)
    turn_rad = np.array([0.0, 600.0, 800.0]) / ARCSEC_PER_RAD
    residual_rad = np.stack([to_matrix(q) @ turn_rad for q in commanded])
    place = np.linspace(-0.5, 0.5, len(commanded))
    causes = _causes(commanded, None, residual_rad, np.array([1.0, 0.0, 0.0, 0.0]), group, place)
    assert any("turned by 1e+03 arcsec" in cause for cause in causes) == (attitudes == 6)


def test_a_drift_is_named_with_its_size_though_its_ends_are_left_out(rng):
    commanded = commanded_of(rng, 60)
    drift = from_rotation_vectors(
        np.linspace(-0.5, 0.5, 60)[:, None] * np.array([200.0, 0, 0]) / ARCSEC_PER_RAD
    )
    found = align(pairs_of(commanded, multiply(drift, turned_by(rng, commanded))), CAMERA)
    assert {2, 61} < set(found.wild)
    (cause,) = (cause for cause in found.residual.causes if "drift" in cause)
    assert float(cause.split()[3]) == pytest.approx(200.0, rel=0.02)


@pytest.mark.parametrize("is_across", [True, False])
def test_a_cause_counts_by_the_scatter_of_its_own_axes(rng, is_across):
    """A drift across the boresight explains two thirds of two axes and a noisy roll, and one of
    the roll a third: less than half.
    """
    along = np.linspace(-0.5, 0.5, 60)[:, None]
    noise_rad = np.array([1e-6, 1e-6, 1e-3])
    drift_rad = np.array([3e-4, -2e-4, 0.0])
    if not is_across:
        noise_rad = np.array([1e-3, 1e-3, 1e-6])
        drift_rad = np.array([0.0, 0.0, 3e-1])
    residual_rad = along * drift_rad + noise_rad * rng.normal(size=(60, 3))
    found = _explained(residual_rad, along[:, :, None] * np.eye(3))
    if is_across:
        assert found is not None
        assert found[:2] == pytest.approx(drift_rad[:2], rel=0.02)
    else:
        assert found is None


def test_a_late_clock_is_named_with_its_offset(rng):
    commanded = commanded_of(rng, 60)
    rate = rng.normal(size=(60, 3)) * np.radians(1.0)
    late = multiply(from_rotation_vectors(-rate * 0.05), commanded)  # 0.05 s further along the turn
    found = align(pairs_of(commanded, turned_by(rng, late), rate), CAMERA)
    (cause,) = found.residual.causes
    # Of 60 rows at 1.7 deg/s, with 5 arcsec across and 40 about the boresight: 1 ms and less.
    assert float(cause.split()[3]) == pytest.approx(0.05, abs=0.002)


def test_a_late_clock_is_named_whichever_way_the_tracker_is_turned(rng):
    """Rates are about the axes of what was commanded, a third of a turn from the tracker's."""
    commanded = commanded_of(rng, 60)
    rate = rng.normal(size=(60, 3)) * np.radians(1.0)
    late = multiply(from_rotation_vectors(-rate * 0.05), commanded)
    turn = from_rotation_vector(np.array([0.0, 0.0, 2 * np.pi / 3]))
    found = align(pairs_of(commanded, multiply(turn, late), rate), CAMERA)
    (cause,) = found.residual.causes
    assert float(cause.split()[3]) == pytest.approx(0.05, rel=1e-6)


def wild_half(rng: np.random.Generator, reported: np.ndarray) -> np.ndarray:
    return np.concatenate([commanded_of(rng, 20), reported[20:]])


def half_off(rng: np.random.Generator, reported: np.ndarray) -> np.ndarray:
    """The first half is off by a quarter of a degree, each to a side of its own."""
    sides = rng.normal(size=(20, 3))
    sides *= np.radians(0.25) / np.linalg.norm(sides, axis=1, keepdims=True)
    off = from_rotation_vectors(sides)
    return np.concatenate([multiply(off, reported[:20]), reported[20:]])


TOP = from_rotation_vector(np.array([0.0, np.pi / 2, 0.0]))  # a frame whose z is no boresight
# What becomes of 40 commanded attitudes and of what a tracker reports of them.
REFUSED = [
    (lambda c, t: (c, conjugate(t)), ("inverse", "-tx")),
    (lambda c, t: (c, np.roll(t, -1, axis=1)), ("scalar last",)),
    (lambda c, t: (c, np.roll(conjugate(t), -1, axis=1)), ("scalar last", "inverse")),
    (lambda c, t: (c, t * [1, 1, -1, -1]), ("mirrored in x",)),
    (lambda c, t: (c, t * [1, -1, -1, 1]), ("mirrored in z",)),
    (lambda c, t: (conjugate(c), conjugate(t)), ("both", "inverse")),
    (lambda c, t: (np.roll(c, -1, axis=1), np.roll(t, -1, axis=1)), ("both", "scalar last")),
    (lambda c, t: (np.roll(c, -1, axis=1), t), ("commanded", "scalar last")),
    (lambda c, t: (c[[0] * 5], conjugate(t[[0] * 5])), ("inverse",)),
    (lambda c, t: (c, wild_half(np.random.default_rng(2), t)), ("half or more",)),
    (lambda c, t: (c, half_off(np.random.default_rng(2), t)), ("half or more", "20 of 40 agree")),
    # by the inverse one rotation would do, but for which the screen is out of view
    (lambda c, t: (c, conjugate(multiply(TOP, c))), ("half or more",)),
    (lambda c, t: (c, multiply(TOP, c)), ("90 degrees off the boresight",)),
    (lambda c, t: (c[:2], c[:2]), ("2 pairs and 3 are needed",)),
]


@pytest.mark.parametrize(("change", "words"), REFUSED, ids=["".join(row[1]) for row in REFUSED])
def test_what_no_rotation_explains_is_refused_with_its_cure(rng, change, words):
    commanded = commanded_of(rng, 40)
    line = refusal(align, pairs_of(*change(commanded, turned_by(rng, commanded))), CAMERA)
    for word in words:
        assert word in line


@pytest.mark.parametrize("axis", np.eye(3)[:2], ids=["x", "y"])
@pytest.mark.parametrize("angle_deg", [12.0, -40.0, 90.0])
@pytest.mark.parametrize("attitudes", [1, 40])
def test_one_rotation_that_turns_the_screen_out_of_view_is_said_with_its_angle(
    rng, axis, angle_deg, attitudes
):
    """Of one attitude, another convention may lead to it, too: that is no more than another cure."""
    commanded = np.resize(commanded_of(rng, attitudes), (40, 4))
    turned = multiply(from_rotation_vector(np.radians(angle_deg) * axis), commanded)
    line = refusal(align, pairs_of(commanded, turned), CAMERA)
    assert f"{abs(angle_deg):.3g} degrees off the boresight" in line
    assert "no one rotation" not in line


def test_telemetry_columns_are_named_in_the_cure(rng):
    commanded = commanded_of(rng, 10)
    pairs = pairs_of(commanded, conjugate(turned_by(rng, commanded)))
    assert "write qw,-qx,-qy,-qz" in refusal(align, replace(pairs, names=COMMANDED), CAMERA)


def test_a_tracker_turned_by_half_a_turn_is_no_mistake(rng):
    commanded = commanded_of(rng, 40)
    half = from_rotation_vector(np.array([0.0, 0.0, np.pi]))
    found = align(pairs_of(commanded, multiply(half, commanded)), CAMERA)
    assert found.rotation_arcsec[2] == pytest.approx(
        np.pi * ARCSEC_PER_RAD, abs=EXACT_ARCSEC
    ) or found.rotation_arcsec[2] == pytest.approx(-np.pi * ARCSEC_PER_RAD, abs=EXACT_ARCSEC)


def test_repeats_are_of_one_attitude_whatever_their_sign(rng):
    attitudes = commanded_of(rng, 30)
    group = groups_of(np.concatenate([attitudes, -attitudes]))
    assert len(np.unique(group)) == 30
    assert (group[:30] == group[30:]).all()


def test_the_corrected_alignment_has_the_tracker_report_what_is_commanded(rng):
    """What is shown for a command is turned by Q; a tracker that reports M more needs Q' M = Q."""
    q, turn = normalise(rng.normal(size=(2, 4)))
    assert angle_between_rad(multiply(corrected(q, turn), turn), q) < 1e-12
    assert corrected(q, turn)[0] >= 0


def test_the_residual_s_rms_has_the_freedom_that_the_rotation_took():
    """Of two pairs a rotation takes half."""
    commanded = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    off_rad = np.array([[1.0, -1.0, 2.0], [-1.0, 1.0, -2.0]]) / ARCSEC_PER_RAD
    found = residual_of(commanded, None, off_rad, commanded[0], np.array([-0.5, 0.5])).rms
    assert (found.cross, found.roll) == pytest.approx((np.sqrt(2), 2 * np.sqrt(2)))


def test_what_repeats_do_not_explain_is_the_variance_between_attitudes_of_several_counts():
    """By the analysis of variance of three attitudes that were taken two, two and five times."""
    counts = [2, 2, 5]
    roll_arcsec = [[40.0, 43.0], [-21.0, -19.0], [3.0, 5.0, 1.0, 4.0, 2.0]]
    off_rad = np.zeros((9, 3))
    off_rad[:, 2] = np.concatenate(roll_arcsec) / ARCSEC_PER_RAD
    commanded = np.repeat(np.eye(4)[:3], counts, axis=0)
    found = residual_of(commanded, None, off_rad, np.eye(4)[0], np.linspace(-0.5, 0.5, 9))
    squares_within = sum(len(part) * np.var(part) for part in roll_arcsec)
    repeat = np.sqrt(squares_within / (9 - 3))
    assert found.repeat.roll == pytest.approx(repeat)
    usual_count = (9 - (2**2 + 2**2 + 5**2) / 9) / (3 - 1)
    ratio = f_oneway(*roll_arcsec).statistic
    assert found.unexplained.roll == pytest.approx(repeat * np.sqrt((ratio - 1) / usual_count))
    assert (found.repeat.cross, found.unexplained.cross) == (0.0, 0.0)


@pytest.mark.parametrize(("pairs", "is_told"), [(5, False), (6, True)])
def test_three_pairs_more_than_attitudes_tell_how_well_one_repeats(rng, pairs, is_told):
    commanded = np.resize(np.eye(4)[:3], (pairs, 4))
    off_rad = 1e-5 * rng.normal(size=(pairs, 3))
    found = residual_of(commanded, None, off_rad, np.eye(4)[0], np.linspace(-0.5, 0.5, pairs))
    assert (found.repeat is not None, found.unexplained is not None) == (is_told, is_told)


def test_the_angle_between_rotations_is_scipy_s_from_none_to_half_a_turn(rng):
    """Of either sign of a quaternion; tiny ones are not lost in a cosine's rounding."""
    axes = rng.normal(size=(60, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.concatenate([np.geomspace(1e-9, 1e-2, 20), rng.uniform(0, np.pi, 40)])
    start = Rotation.random(random_state=5)
    turned = Rotation.from_rotvec(angles[:, None] * axes) * start
    signs = rng.choice([-1.0, 1.0], 60)[:, None]
    q = np.roll(start.as_quat(), 1)
    found = _angles_to(signs * np.roll(turned.as_quat(), 1, axis=1), q)
    assert found == pytest.approx(angles, rel=1e-6, abs=1e-15)


def test_a_mean_s_covariance_is_that_of_independent_groups(rng):
    """Of n pairs the sum of squares over n (n - 1); of groups that share an error, of their sums."""
    residual_rad = 1e-5 * rng.standard_normal((12, 3))
    fit = RotationFit(np.array([1.0, 0.0, 0.0, 0.0]), residual_rad, np.ones(12))
    alone, dof = fit.covariance_rad2(np.arange(12))
    assert alone == pytest.approx(residual_rad.T @ residual_rad / (12 * 11))
    assert dof == 11
    group = np.repeat(np.arange(4), 3)
    sums = residual_rad.reshape(4, 3, 3).sum(axis=1)
    together, dof = fit.covariance_rad2(group)
    assert together == pytest.approx(sums.T @ sums * 4 / 3 / 12**2)
    assert dof == 3
    # all of one attitude count as independent, and a wild one not at all
    weight = np.ones(12)
    weight[5] = 0.0
    used = np.delete(residual_rad, 5, axis=0)
    one, dof = RotationFit(fit.q, residual_rad, weight).covariance_rad2(np.zeros(12, dtype=int))
    assert one == pytest.approx(used.T @ used / (11 * 10))
    assert dof == 10


def test_pairs_weigh_by_their_own_residuals_across_and_about_the_boresight():
    """In the medians of those near, about the boresight ten times as wide: half a cut of each
    weighs as half a cut across, a far one not.
    """
    unit = np.array([[1.0, 1.0, 10.0]]) * 1e-4 / MAD_TO_SIGMA
    signs = np.array([[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]])
    usual = np.repeat(signs, 6, axis=0) * unit
    more = np.array([[2e-4, 0, 0], [0, 2e-4, 0], [0, 0, 2e-3], [0, 0, 4.1e-3], [0, 0, 0]])
    residual = np.concatenate([usual, more])
    near = np.ones(len(residual), dtype=bool)
    near[-1] = False
    weights = _weights(residual, near, 4.0)
    half = (1 - 0.25) ** 2
    np.testing.assert_allclose(weights[-5:], [half, half, half, 0.0, 0.0], rtol=1e-9)
    # three squares of a sigma's share each
    np.testing.assert_allclose(weights[:-5], (1 - 3 / MAD_TO_SIGMA**2 / 16) ** 2, rtol=1e-9)
    # where all are beyond the cut, all those that are near count
    np.testing.assert_array_equal(_weights(residual, near, 1e-3), near.astype(float))


@pytest.mark.parametrize(
    ("cross", "roll", "words"),
    [
        (12.5, 0.0, "12.5 arcsec rms across the boresight"),
        (0.0, 70.0, "70 arcsec rms about the boresight"),
        (12.5, 70.0, "12.5 arcsec rms across the boresight and 70 arcsec rms about the boresight"),
    ],
)
def test_what_a_rotation_does_not_explain_is_said_across_and_about_the_boresight(
    cross, roll, words
):
    some = AxesArcsec(1.0, 2.0)
    residual = Residual(some, some, AxesArcsec(cross, roll), 8, ("a cause",))
    remark, cause = remarks_of(residual)
    assert remark.startswith(f"a rotation does not explain {words}: calibrate the geometry")
    assert cause == "a cause"
    explained = Residual(some, some, AxesArcsec(0.0, 0.0), 8, ())
    assert remarks_of(explained) == ()


@pytest.mark.parametrize("skipped", [0, 6])
def test_an_alignment_s_figures_are_alike_in_lines_summary_and_file(tmp_path, rng, skipped):
    commanded = np.repeat(commanded_of(rng, 12), 2, axis=0)
    reported = turned_by(rng, commanded)
    reported[5] = commanded_of(rng, 1)[0]
    found = align(replace(pairs_of(commanded, reported), skipped=skipped), CAMERA)
    summary = summary_of(found)
    counts = [summary[name] for name in ("pairs", "used", "wild", "skipped", "attitudes")]
    assert counts == [24, 23, 1, skipped, 12]
    assert summary["wild_rows"] == (7,)
    for name, axes in (
        ("repeat", found.residual.repeat),
        ("unexplained", found.residual.unexplained),
    ):
        assert summary[f"{name}_arcsec"] == {"cross": axes.cross, "roll": axes.roll}
    lines = {line[:24].strip(): line[24:] for line in lines_of(found)}
    text = "\n".join(lines_of(found))
    assert "23 of 24 used, of 12 attitudes" in text
    assert (f", {skipped} skipped" in text) == (skipped > 0)
    assert "1, on lines 7" in text
    rows = tuple(range(2, 13))
    ten = ", ".join(map(str, rows[:10]))
    for count, named in ((10, f"10, on lines {ten}"), (11, f"11, on lines {ten}, ...")):
        assert f"wild{named:>{len(named) + 20}}" in lines_of(replace(found, wild=rows[:count]))
    x, y, z = summary["rotation_arcsec"]
    of_x, of_y, of_z = summary["sigma_arcsec"]
    assert f"x {x:.2f} +- {of_x:.2f}, y {y:.2f} +- {of_y:.2f}" in text
    assert f"about the boresight {z:.2f} +- {of_z:.2f} arcsec" in text
    assert lines
    bench = tmp_path / "bench.toml"
    bench.write_text(bench_text())
    path = tmp_path / "geometry.toml"
    first, second = (MonitorIdentity(maker="ACM", serial=serial) for serial in ("1", "2"))
    write_alignment(path, found, read_bench_file(bench), first)
    notes = load_notes(path)
    assert notes.identity == first
    # a later alignment stands before the monitor that it sees, or before the file's own
    bench.write_text(bench_text({"collimator": {"geometry": path.name}}))
    filed = read_bench_file(bench)
    for identity, wanted in ((second, second), (None, first)):
        write_alignment(tmp_path / "again.toml", found, filed, identity)
        assert load_notes(tmp_path / "again.toml").identity == wanted
    for name, sigma in zip("xyz", summary["sigma_arcsec"], strict=True):
        assert notes.sigma[f"rotation_{name}_arcsec"] == pytest.approx(sigma, rel=1e-5)
    assert notes.made.rotation_arcsec == pytest.approx((x, y, z), rel=1e-6)
    assert (notes.made.pairs, notes.made.pairs_used, notes.made.wild_rows) == (24, 23, [7])
    residual = summary["residual_arcsec"]
    assert notes.error.alignment_cross_arcsec == pytest.approx(residual["cross"])
    assert notes.error.alignment_roll_arcsec == pytest.approx(residual["roll"])
    np.testing.assert_allclose(
        np.sqrt(np.diag(notes.error.alignment_covariance_arcsec2)), summary["sigma_arcsec"]
    )


def test_telemetry_is_paired_by_time_with_what_a_run_commanded(tmp_path):
    """Frames every 0.1 s for 2 s, turning about y; the tracker's clock is 0.3 s behind. The first
    row is not valid, and the last is after the run.
    """
    t_s = np.arange(21) * 0.1
    turns = Rotation.from_rotvec(np.outer(0.02 * t_s, [0.0, 1.0, 0.0]))
    write_ledger(tmp_path / "run.mcap", t_s, turns.as_quat(scalar_first=True))
    rows = [
        f"{5 + t - 0.3},1,0,0,0,{valid}" for t, valid in ((0.2, 0), (0.5, 1), (1.25, 1), (2.9, 1))
    ]
    (tmp_path / "t.csv").write_text("\n".join(["t_s,qw,qx,qy,qz,valid", *rows]) + "\n")
    pairs = pair_with_ledger(tmp_path / "t.csv", tmp_path / "run.mcap", 0.3)
    assert (pairs.line.tolist(), pairs.skipped, pairs.names) == ([3, 4], 2, COMMANDED)
    wanted = Rotation.from_rotvec(np.outer(0.02 * np.array([0.5, 1.25]), [0.0, 1.0, 0.0]))
    assert pairs.commanded == pytest.approx(wanted.as_quat(scalar_first=True), abs=1e-6)
    assert np.abs(pairs.rate_rad_s) == pytest.approx(np.tile([0.0, 0.02, 0.0], (2, 1)), abs=1e-6)
    line = refusal(pair_with_ledger, tmp_path / "t.csv", tmp_path / "run.mcap", 100.0)
    assert "meet no frame of" in line and "add --offset-s" in line
