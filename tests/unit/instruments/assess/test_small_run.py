"""Half a minute of a run whose tracker is written out here, assessed whole by the ledger's own
answers: each figure against what was planted.

The tracker's clock is another than the sender's, and that another than the host's. Its detector is
no square, its answers are stamped at the start of their exposures and late by a latency.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.instruments.assess.assessment import Assessment, AssessSettings, assess_files
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.star_light import bench_stars
from hilstar.server.record.ledger_records import AnswerRecord
from tests.support.benches import bench_text
from tests.support.planted_run import NS_PER_S, write_ledger
from tests.support.planted_tracker import attitude, rate_rad_s, scalar_first

ARCSEC_PER_RAD = 180 * 3600 / np.pi
WIDTH_PX, HEIGHT_PX, FOCAL_PX = 1200, 700, 5000.0
EXPOSURE_S, LATENCY_S, CYCLE_S, SECONDS = 0.2, 0.3, 0.125, 30.0
START_NS = 5 * NS_PER_S  # the sender's clock at the first frame
HOST_AHEAD_NS, OWN_AHEAD_NS = 2 * NS_PER_S, 10**15  # of the sender's clock
LIVE_OFF_NS, LATE_NS = 20_000_000, 150_000_000  # of a run's estimate; of an arrival
FAINTEST_V_MAG = 5.5
BENCH = bench_text(
    {
        "tracker": {
            "resolution_px": [WIDTH_PX, HEIGHT_PX],
            "focal_length_mm": 65,
            "exposure_s": EXPOSURE_S,
        },
        "sky": {"faintest_v_mag": FAINTEST_V_MAG},  # all are reported: their limit is not sought
    }
)
BIAS_ARCSEC = np.array([12.0, -16.0, 40.0])
NOISE_ARCSEC = np.array([2.0, 2.0, 6.0])
RATE_BIAS_DEG_S, RATE_SCALE, RATE_LAG_S, RATE_NOISE_DEG_S = 0.02, -0.03, 0.1, 0.005
DISTORTION_PX, COLOUR_PX, STAR_NOISE_PX = 0.6, 0.2, 0.05
STAR_COLOUR, MAG_NOISE = 0.1, 0.02
WILD = {40: 25.0, 41: 70.0, 150: 33.0}  # the answer's number, and how far it is off, deg
SILENT = range(80, 91)
STARS_EACH = 2  # every other answer has stars
UNJUDGED = range(100, 110)
# 220 answers know a sigma to 5 %; three times that
SIGMA_WITHIN = 0.15
SIGMAS = 4.0
TO_SIGMA = 2 * 1.96  # a 95 % interval's width


def motion(t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Two degrees to and fro, which rolls: up to 1.5 deg/s."""
    turn = 2 * np.pi * t_s
    return 84 + 2 * np.sin(turn / 12.3), -1.2 + 2 * np.sin(turn / 9 + 0.4), 12 * np.sin(turn / 17.7)


@dataclass(frozen=True)
class Sky:
    """The bench's stars as a pinhole sees them, written out here."""

    vectors: FloatArray
    v_mag: FloatArray
    bv_mag: FloatArray
    electrons_per_s: FloatArray
    hip: IntArray

    def places_px(self, to_cam: Rotation) -> FloatArray:
        """Where all stars (2, n) are seen; NaN behind the camera."""
        x, y, z = to_cam.apply(self.vectors).T
        ahead = np.where(z > 0.5, z, np.nan)
        middle_px = np.array([[WIDTH_PX - 1], [HEIGHT_PX - 1]]) / 2
        return np.asarray(middle_px + FOCAL_PX * np.stack([x, y]) / ahead)

    def inside(self, places_px: FloatArray) -> BoolArray:
        """Which places (2, n) are on a pixel of the detector."""
        x_px, y_px = np.rint(places_px)
        across = (x_px >= 0) & (x_px < WIDTH_PX)
        return np.asarray(across & (y_px >= 0) & (y_px < HEIGHT_PX))


@dataclass(frozen=True)
class Planted:
    """The tracker's answers: their run times, and the errors of the places of stars, a list of
    (n, 2) for each.
    """

    t_s: FloatArray
    sky: Sky
    records: list[AnswerRecord]
    star_errors_px: list[FloatArray]
    star_bv_mag: list[FloatArray]


def sky_of(folder: Path) -> Sky:
    file = bench_file_of(folder / "bench.toml", BENCH)
    stars = bench_stars(file.config, folder)
    hip = stars.catalog.hip[stars.row]
    return Sky(stars.vectors, stars.v_mag, stars.bv_mag, stars.electrons_per_s, hip)


def planted_run(folder: Path) -> Planted:
    """Answers with all of the errors above."""
    rng = np.random.default_rng(3)
    sky = sky_of(folder)
    t_s = np.arange(1.0, SECONDS - 1, CYCLE_S)
    true = attitude(motion, t_s)
    mounted = Rotation.from_rotvec(BIAS_ARCSEC / ARCSEC_PER_RAD) * true
    noise_rad = NOISE_ARCSEC * rng.standard_normal((len(t_s), 3)) / ARCSEC_PER_RAD
    q = scalar_first(Rotation.from_rotvec(noise_rad) * mounted)
    for k, off_deg in WILD.items():
        wild = Rotation.from_rotvec([[np.radians(off_deg), 0, 0]])
        q[k] = scalar_first(wild * mounted[k])[0]
    acceleration = (rate_rad_s(motion, t_s + 0.01) - rate_rad_s(motion, t_s - 0.01)) / 0.02
    rates = (1 + RATE_SCALE) * rate_rad_s(motion, t_s) - RATE_LAG_S * acceleration
    rates += np.radians([RATE_BIAS_DEG_S, 0.0, 0.0])
    rates += np.radians(RATE_NOISE_DEG_S) * rng.standard_normal(rates.shape)
    records = []
    errors_px = []
    colours_mag = []
    for k, at_s in enumerate(t_s.tolist()):
        places_px = sky.places_px(mounted[k])
        seen = np.flatnonzero(sky.inside(places_px))
        u = (places_px[:, seen] - [[WIDTH_PX / 2], [HEIGHT_PX / 2]]) / (WIDTH_PX / 2)
        error_px = DISTORTION_PX * u**3
        error_px[0] += COLOUR_PX * sky.bv_mag[seen]
        error_px += STAR_NOISE_PX * rng.standard_normal(error_px.shape)
        errors_px.append(error_px.T)
        colours_mag.append(sky.bv_mag[seen])
        off_mag = STAR_COLOUR * sky.bv_mag[seen] + MAG_NOISE * rng.standard_normal(len(seen))
        dn = sky.electrons_per_s[seen] * 10 ** (-0.4 * off_mag)
        x_px, y_px = places_px[:, seen] + error_px
        columns = (x_px.tolist(), y_px.tolist(), dn.tolist(), sky.hip[seen].tolist())
        named = zip(*columns, strict=True)
        stars = () if k % STARS_EACH else tuple(named)
        if k not in SILENT:
            records.append(record_of(k, at_s, q[k], rates[k], stars))
    return Planted(t_s, sky, records, errors_px, colours_mag)


def record_of(
    k: int, at_s: float, q: FloatArray, rate: FloatArray, named: tuple[tuple, ...]
) -> AnswerRecord:
    """An answer as a run records it: its live estimate of the middle is off, and what was not
    judged has none.
    """
    true_ns = START_NS + round(at_s * NS_PER_S)
    middle_ns = true_ns + HOST_AHEAD_NS + LIVE_OFF_NS
    host_ns = middle_ns + LATE_NS
    stamp_ns = true_ns + OWN_AHEAD_NS + round((LATENCY_S - EXPOSURE_S / 2) * NS_PER_S)
    is_judged = k not in UNJUDGED
    return AnswerRecord(
        host_ns=host_ns,
        raw="",
        t_ns=stamp_ns,
        q=tuple(q.tolist()),
        rate=tuple(rate.tolist()),
        centroids=named,
        verdict="right" if is_judged else "unjudged",
        middle_ns=middle_ns if is_judged else host_ns,
        light_ns=middle_ns - HOST_AHEAD_NS if is_judged else None,
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Planted, Assessment]:
    folder = tmp_path_factory.mktemp("small")
    planted = planted_run(folder)
    frames_s = np.arange(0.0, SECONDS + 3, 0.05)  # until the host's clock shows the last answer
    frames_q = scalar_first(attitude(motion, frames_s))
    ledger = write_ledger(
        folder / "run.mcap",
        frames_s,
        frames_q,
        start_ns=START_NS,
        bench=BENCH,
        records=planted.records,
    )
    settings = AssessSettings(stamp="start", latency_s=LATENCY_S, display_attitudes=0)
    return planted, assess_files(ledger, None, settings)


def right_answers() -> list[int]:
    """The numbers of the answers that came and are attitudes of this sky."""
    return [k for k in range(len(all_s())) if k not in SILENT and k not in WILD]


def all_s() -> FloatArray:
    """The run times of all answers that were due."""
    return np.arange(1.0, SECONDS - 1, CYCLE_S)


def test_a_tracker_s_own_clock_is_that_much_ahead_whatever_a_run_took_it_for_live(run) -> None:
    """A stamp is the exposure's start, later by the latency; the run's estimates are 20 ms off."""
    found = run[1]
    sigma_s = found.found.clock.sigma_offset_s
    assert sigma_s < 1e-3
    ahead_s = OWN_AHEAD_NS / NS_PER_S
    assert found.offset_s == pytest.approx(ahead_s, abs=SIGMAS * sigma_s)
    came_s = np.delete(all_s(), list(SILENT))
    assert found.t_s == pytest.approx(came_s, abs=SIGMAS * sigma_s)


def test_a_bias_has_its_signs_and_noise_its_axes(run) -> None:
    found = run[1].found
    low, high = found.intervals.bias
    sigma_arcsec = (high - low) / TO_SIGMA
    assert (np.abs(found.bias_arcsec - BIAS_ARCSEC) < SIGMAS * sigma_arcsec).all()
    assert run[1].noise_arcsec.cross == pytest.approx(NOISE_ARCSEC[0], rel=SIGMA_WITHIN)
    assert run[1].noise_arcsec.roll == pytest.approx(NOISE_ARCSEC[2], rel=SIGMA_WITHIN)
    assert found.fov_arcsec.cross < 1.0
    assert found.pixel_arcsec.cross < 1.0


def test_each_wrong_answer_has_its_row_its_two_times_and_its_error(run) -> None:
    found = run[1].wrong
    expected = []
    for k, off_deg in WILD.items():
        before = sum(silent < k for silent in SILENT)
        at_s = float(all_s()[k])
        expected.append((k + 1 - before, at_s, off_deg))
    assert [each.row for each in found] == [row for row, _, _ in expected]
    for each, (_, at_s, off_deg) in zip(found, expected, strict=True):
        assert each.run_s == pytest.approx(at_s, abs=1e-3)
        stamp_s = (START_NS + OWN_AHEAD_NS) / NS_PER_S + at_s + LATENCY_S - EXPOSURE_S / 2
        assert each.t_s == pytest.approx(stamp_s, abs=1e-6)
        # within the planted noise
        assert each.off_deg == pytest.approx(off_deg, abs=0.01)


def test_a_silence_loses_the_lock_and_wrong_answers_are_outages(run) -> None:
    lock = run[1].lock
    due = len(all_s())
    assert lock.cycle_s == pytest.approx(CYCLE_S, rel=1e-4)
    assert (lock.due, lock.right) == (due, due - len(SILENT) - len(WILD))
    assert lock.availability == pytest.approx(lock.right / due)
    outages = [(each.start_s, each.length_s) for each in lock.outages]
    assert np.array(outages) == pytest.approx(
        np.array([(6.0, 0.25), (11.0, 1.375), (19.75, 0.125)]), abs=2e-3
    )
    assert [(each.lost, each.rows, each.wrong) for each in lock.outages] == [
        (False, 2, 2),
        (True, 0, 0),
        (False, 1, 1),
    ]
    waits_s = [each.wait_s for each in lock.acquisitions]
    assert waits_s == pytest.approx([0.0, 1.375], abs=2e-3)


def test_slices_are_of_the_rates_and_of_the_field_s_own_light(run) -> None:
    planted, found = run
    t_s = all_s()[right_answers()]
    rates_deg_s = np.degrees(np.linalg.norm(rate_rad_s(motion, t_s), axis=1))
    field_mag = []
    for to_cam in attitude(motion, t_s):
        sky = planted.sky
        inside = sky.inside(sky.places_px(to_cam))
        light = float((10 ** (-0.4 * sky.v_mag[inside])).sum())
        field_mag.append(-2.5 * np.log10(light))
    for slices, values in ((found.by_rate, rates_deg_s), (found.by_magnitude, np.array(field_mag))):
        assert len(slices) == 5
        edges = [slices[0].low, *(each.high for each in slices)]
        # a star on the edge of the field is in it for either of two times
        assert edges == pytest.approx(np.quantile(values, np.linspace(0, 1, 6)), abs=2e-3)
        assert sum(each.answers for each in slices) == len(values)
        for each in slices:
            # 40 answers know a sigma to 11 %, of two axes to 8 %; three times that
            assert each.noise_cross_arcsec == pytest.approx(NOISE_ARCSEC[0], rel=0.25)
            assert each.rms_roll_arcsec == pytest.approx(NOISE_ARCSEC[2], rel=0.35)


def test_what_a_glass_does_to_named_stars_is_split_by_place_and_colour(run) -> None:
    """Of the planted errors a distortion file would take the cubes, and the mean colour's shift."""
    planted, found = run
    rows = [k for k in right_answers() if k % STARS_EACH == 0]
    errors_px = np.concatenate([planted.star_errors_px[k] for k in rows])
    bv_mag = np.concatenate([planted.star_bv_mag[k] for k in rows])
    of_colour = np.zeros_like(errors_px)
    of_colour[:, 0] = COLOUR_PX * (bv_mag - bv_mag.mean())
    noise_px = np.sqrt(2) * STAR_NOISE_PX
    expected = {
        "total": rms(errors_px),
        "without_distortion": np.hypot(rms(of_colour), noise_px),
        "without_colour": rms(errors_px - of_colour),
        "without_both": noise_px,
    }
    assert found.glass is not None
    assert (found.glass.source, found.glass.stars) == ("answers' stars", len(errors_px))
    assert found.glass.attitudes == len(rows)
    assert found.glass.rms_px == pytest.approx(expected, rel=0.02)


def rms(errors_px: FloatArray) -> float:
    return float(np.sqrt((errors_px**2).sum(axis=1).mean()))


def test_rates_and_stars_are_those_planted(run) -> None:
    planted = {
        ("rate bias", "cross"): RATE_BIAS_DEG_S,
        ("rate bias", "roll"): 0.0,
        ("rate noise", "cross"): RATE_NOISE_DEG_S,
        ("rate noise", "roll"): RATE_NOISE_DEG_S,
        ("rate scale", "cross"): -RATE_SCALE,
        ("rate scale", "roll"): -RATE_SCALE,
        ("rate lag", "cross"): RATE_LAG_S,
        ("rate lag", "roll"): RATE_LAG_S,
        ("stamp jitter", ""): 0.0,
        ("star colour", ""): STAR_COLOUR,
        ("false stars a frame", ""): 0.0,
    }
    rows = {(row.quantity, row.axis): row for row in run[1].further.rows}
    for key, value in planted.items():
        row = rows[key]
        assert row.value is not None and row.low_95 is not None and row.high_95 is not None, key
        sigma = (row.high_95 - row.low_95) / TO_SIGMA
        assert abs(row.value - value) <= max(0.05 * value, SIGMAS * sigma), key
