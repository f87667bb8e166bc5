"""What telemetry carries beside the attitude, judged against a run's ledger: planted errors of
rates and of single stars come out, and rates in another convention are named.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.telemetry import Telemetry
from hilstar.basics.arrays import FloatArray
from hilstar.instruments.assess import report
from hilstar.instruments.assess.assessment import (
    Assessment,
    AssessSettings,
    assess_files,
    read_answers,
)
from hilstar.instruments.assess.bounded_figures import TooFewCases
from hilstar.instruments.assess.components import Component
from hilstar.instruments.assess.further import (
    END,
    FurtherFigures,
    add_jitter,
    add_rates,
    add_stars,
    rate_notes,
)
from hilstar.instruments.assess.rate_figures import _near_rates, _refuse_other_units
from hilstar.instruments.assess.star_figures import StarTable, _near, star_figure, without_turns
from hilstar.server.answers.answer import ReportedStar
from hilstar.server.answers.stars import LitStars, StarResiduals
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.star_light import bench_stars
from hilstar.server.record.commanded import Commanded
from hilstar.server.record.ledger_records import AnswerRecord
from tests.support.assessments import a_budget, a_clock
from tests.support.benches import bench_text
from tests.support.planted_run import write_ledger
from tests.support.planted_tracker import attitude, rate_rad_s, scalar_first

ARCSEC_PER_RAD = 180 * 3600 / np.pi
SECONDS, FRAME_S, ANSWER_S = 120.0, 0.05, 0.2
# a display that covers the whole field of a pinhole of 5000 px
BENCH = bench_text({"tracker": {"focal_length_mm": 65, "pixel_pitch_um": 13}})
FOCAL_PX, MIDDLE_PX, SIDE_PX = 5000.0, 511.5, 1024
MARGIN_PX = 70.0  # of the detector's sides, which the display does not cover
RATE_BIAS_DEG_S, RATE_SCALE, RATE_LAG_S, RATE_NOISE_DEG_S = 0.02, -0.03, 0.2, 0.005
STAR_NOISE_PX, STAR_FIELD_PX, STAR_COLOUR, STAR_LIMIT_MAG = 0.1, 0.3, 0.1, 5.5
FALSE_STARS, MAG_NOISE = 3.0, 0.02
# found within 10 %, or within three standard errors where those are larger
SHARE, SIGMAS = 0.1, 3.0
TO_SIGMA = 2 * 1.96  # a 95 % interval's width


def motion(t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A scan of two degrees to and fro, which rolls: up to 0.5 deg/s, 0.1 deg/s2."""
    turn = 2 * np.pi * t_s
    return 84 + 2 * np.sin(turn / 37), -1.2 + 2 * np.sin(turn / 27 + 0.4), 12 * np.sin(turn / 53)


class Sky:
    """The bench's stars as a pinhole sees them, written out here."""

    def __init__(self, folder: Path) -> None:
        file = bench_file_of(folder / "bench.toml", BENCH)
        stars = bench_stars(file.config, folder)
        bright = stars.v_mag < STAR_LIMIT_MAG + 1
        self.vectors = stars.vectors[bright]
        self.v_mag, self.bv_mag = stars.v_mag[bright], stars.bv_mag[bright]
        self.electrons_per_s = stars.electrons_per_s[bright]

    def reported(self, to_cam: Rotation, rng: np.random.Generator) -> list[list[float | None]]:
        """What a tracker reports, every other star without its signal."""
        x, y, z = to_cam.apply(self.vectors).T
        place_px = MIDDLE_PX + FOCAL_PX * np.stack([x, y]) / np.where(z > 0.5, z, np.nan)
        within = np.abs(place_px - MIDDLE_PX).max(axis=0) < SIDE_PX / 2 - MARGIN_PX
        seen = np.flatnonzero(within & (self.v_mag < STAR_LIMIT_MAG))
        error_px = np.sqrt(2) * STAR_FIELD_PX * np.sin(2 * np.pi * place_px[:, seen] / SIDE_PX)
        error_px += STAR_NOISE_PX * rng.standard_normal(error_px.shape)
        off_mag = STAR_COLOUR * self.bv_mag[seen] + MAG_NOISE * rng.standard_normal(len(seen))
        dn = self.electrons_per_s[seen] * 10 ** (-0.4 * off_mag)
        rows: list[list[float | None]] = []
        for k, (x_px, y_px) in enumerate((place_px[:, seen] + error_px).T.tolist()):
            rows.append([x_px, y_px, float(dn[k]) if k % 2 else None])
        for _ in range(rng.poisson(FALSE_STARS)):
            rows.append([*rng.uniform(2 * MARGIN_PX, SIDE_PX - 2 * MARGIN_PX, 2).tolist(), None])
        return rows


@pytest.fixture(scope="module")
def ledger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ledger of a run along `motion`."""
    frames_s = np.arange(0.0, SECONDS, FRAME_S)
    frames_q = scalar_first(attitude(motion, frames_s))
    path = tmp_path_factory.mktemp("further") / "run.mcap"
    return write_ledger(path, frames_s, frames_q, start_ns=0, bench=BENCH)


def assessed(ledger: Path, sky: Sky) -> Assessment:
    """An assessment of telemetry with planted errors."""
    rng = np.random.default_rng(5)
    t_s = np.arange(1.0, SECONDS - 1, ANSWER_S)
    true = attitude(motion, t_s)
    noise_rad = rng.normal(0, 2.0, (len(t_s), 3)) / ARCSEC_PER_RAD
    q = scalar_first(Rotation.from_rotvec(noise_rad) * true)
    acceleration = (rate_rad_s(motion, t_s + 0.01) - rate_rad_s(motion, t_s - 0.01)) / 0.02
    rate = (1 + RATE_SCALE) * rate_rad_s(motion, t_s) - RATE_LAG_S * acceleration
    rate += np.radians([RATE_BIAS_DEG_S, 0.0, 0.0])
    rate += np.radians(RATE_NOISE_DEG_S) * rng.standard_normal(rate.shape)
    lines = []
    for k, at_s in enumerate(t_s.tolist()):
        answer: dict[str, Any] = {"t_ns": round(at_s * 1e9), "q": q[k].tolist(), "valid": True}
        if k % 3:  # a tracker that has no rate in every third answer
            answer["rate"] = rate[k].tolist()
        answer["centroids"] = sky.reported(true[k], rng)
        lines.append(json.dumps(answer))
    telemetry = ledger.with_name("telemetry.jsonl")
    telemetry.write_text("\n".join(lines) + "\n")
    return assess_files(ledger, telemetry, AssessSettings(display_attitudes=0))


def test_planted_rates_and_stars_come_out_of_telemetry(ledger: Path) -> None:
    found = assessed(ledger, Sky(ledger.parent))
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
        ("star noise", ""): STAR_NOISE_PX,
        ("star field error", ""): STAR_FIELD_PX,
        ("star colour", ""): STAR_COLOUR,
        ("star limit", ""): STAR_LIMIT_MAG,
        ("false stars a frame", ""): FALSE_STARS,
    }
    rows = {(row.quantity, row.axis): row for row in found.further.rows}
    assert list(rows) == list(planted)
    for key, row in rows.items():
        assert row.value is not None and row.low_95 is not None and row.high_95 is not None, key
        sigma = (row.high_95 - row.low_95) / TO_SIGMA
        assert abs(row.value - planted[key]) <= max(SHARE * planted[key], SIGMAS * sigma), key
    assert not any("reported rates" in note for note in found.notes)
    listed = report.budget_of(found)["further"]
    assert [(each["quantity"], each["axis"]) for each in listed] == list(planted)
    assert {each["why"] for each in listed} == {""}


@pytest.mark.parametrize(
    "factor, order, told",
    [
        (180 / np.pi, (0, 1, 2), "they are in deg/s"),
        (-1.0, (0, 1, 2), "they have the wrong sign"),
        (1.0, (2, 0, 1), "their axes are in another order"),
        (1.0, (0, 1, 2), ""),
        (1.05, (0, 1, 2), ""),
    ],
)
def test_rates_of_another_convention_are_named(
    factor: float, order: tuple[int, int, int], told: str, rng: np.random.Generator
) -> None:
    t_s = np.arange(1.0, SECONDS / 2, ANSWER_S)
    noise_rad = rng.normal(0, 2.0, (len(t_s), 3)) / ARCSEC_PER_RAD
    q = scalar_first(Rotation.from_rotvec(noise_rad) * attitude(motion, t_s))
    rates = rate_rad_s(motion, t_s) + np.radians(RATE_NOISE_DEG_S) * rng.standard_normal(
        (len(t_s), 3)
    )
    rates = factor * rates[:, order]
    rates[::7] = np.nan
    notes = list(rate_notes(np.rint(1e9 * t_s).astype(np.int64), q, rates))
    assert len(notes) == bool(told)
    assert all("not the turn of the reported attitudes" in note and told in note for note in notes)


# Within a tenth of a unit's factor, of either sign.
@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1.0, ""),
        (0.5, ""),
        (-0.5, ""),
        (-1.0, "as in rad/s of the opposite sign"),
        (-1.09, "as in rad/s of the opposite sign"),
        (-1.11, ""),
        (1.09 * math.degrees(1), "as in deg/s;"),
        (0.91 * math.degrees(1), "as in deg/s;"),
        (1.11 * math.degrees(1), ""),
        (-math.degrees(1), "as in deg/s of the opposite sign"),
        (-1e3, "as in mrad/s of the opposite sign"),
    ],
)
def test_rates_in_another_unit_are_refused_whatever_their_sign(factor, words, rng):
    rates = rng.normal(0, 0.01, (50, 3))
    if not words:
        _refuse_other_units(rates, factor * rates)
        return
    with pytest.raises(TooFewCases, match=re.escape(words)):
        _refuse_other_units(rates, factor * rates)


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_wild_value_is_wild_on_either_side_and_wherever_the_others_are(sign):
    """Of sizes 1 the scatter is 1.4826; eight of them are 11.86, five 7.41."""
    rates = sign * np.ones((60, 2))
    rates[3, 0] = 11.8 * sign
    rates[4, 1] = -11.9 * sign
    rates[5, 0] = 11.9 * sign
    assert np.flatnonzero(~_near_rates(rates)).tolist() == [4, 5]
    rates[:9, 0] = 99.0 * sign
    assert _near_rates(rates).all()  # 15 % are what the tracker does
    stars = sign * np.array([1.0, 1.0, 1.0, 7.4, 7.5, -7.4, -7.5])
    assert _near(stars, 5.0, stars[:3]).tolist() == [True] * 4 + [False, True, False]
    assert _near(stars[:5], 5.0).tolist() == [True] * 4 + [False]


def test_a_turn_that_all_stars_share_is_not_a_stars_noise(rng: np.random.Generator) -> None:
    """Answers of 20 stars each, which a time that is off moves by 2 px an axis and rolls by 0.2
    deg, one sigma.
    """
    answers, stars = 200, 20
    answer = np.repeat(np.arange(answers), stars)
    x_px, y_px = rng.uniform(0, SIDE_PX - 1, (2, len(answer)))
    shift_px = rng.normal(0, 2.0, (2, answers))[:, answer]
    roll_rad = rng.normal(0, np.radians(0.2), answers)[answer]
    shift_px += roll_rad * np.stack([MIDDLE_PX - y_px, x_px - MIDDLE_PX])
    dx_px, dy_px = shift_px + rng.normal(0, STAR_NOISE_PX, (2, len(answer)))
    zeros = np.zeros(len(answer))
    table = StarTable(answer, x_px, y_px, zeros, zeros, dx_px, dy_px, zeros, zeros)
    resolution_px = (SIDE_PX, SIDE_PX)
    free = without_turns(table, answer, resolution_px)
    figure = star_figure("star-noise", free, resolution_px, END, rng)
    # of 8000 places a sigma is known to 0.8 %; four times that
    assert figure.value == pytest.approx(STAR_NOISE_PX, rel=0.032)
    assert figure.low <= STAR_NOISE_PX <= figure.high


def test_a_ledger_s_own_answers_have_rates_and_stars(tmp_path: Path) -> None:
    """Of two answers the first has neither."""
    frames_s = np.arange(0.0, 2.0, 0.5)
    frames_q = scalar_first(attitude(motion, frames_s))
    q = tuple(frames_q[0].tolist())
    plain = AnswerRecord(host_ns=1, raw="", t_ns=1, q=q, verdict="right")
    whole = AnswerRecord(
        host_ns=2, raw="", t_ns=2, q=q, verdict="right", rate=(0.1, 0.2, 0.3),
        centroids=((1.0, 2.0, None, 26311),),
    )  # fmt: skip
    path = tmp_path / "run.mcap"
    write_ledger(path, frames_s, frames_q, start_ns=0, records=[plain, whole])
    told = read_answers(path, "middle")
    assert told.telemetry.rate_cam_rad_s is not None
    assert np.isnan(told.telemetry.rate_cam_rad_s[0]).all()
    assert told.telemetry.rate_cam_rad_s[1].tolist() == [0.1, 0.2, 0.3]
    assert list(told.centroids) == [[], [ReportedStar(1.0, 2.0, None, 26311)]]


def slewing(count: int, taken: float) -> Any:
    """A budget of answers in slews along x and y of both signs, with residuals along them alone, of
    which a fit of the field took so many numbers.
    """
    found = a_budget()
    sense = np.tile([1.0, -1.0], count // 2)
    rate_rad_s = np.radians([0.3, -0.4, 0.0]) * sense[:, None]
    late_s = 0.01 * np.sqrt(2) * np.sin(np.arange(count))
    left = ARCSEC_PER_RAD * rate_rad_s * late_s[:, None]
    none = np.zeros_like(left)
    components = replace(
        found.components,
        left=left,
        fov=Component(np.zeros(3), none, taken),
        pixel=Component(np.zeros(3), none, 0.0),
    )
    return replace(found, components=components, rate_rad_s=rate_rad_s, row=np.arange(count))


def figures_of_rates(t_s: FloatArray, off_rad_s: FloatArray) -> FurtherFigures:
    """What a slewing tracker's rates of these times (n,) give, off by `off_rad_s` (n, 3)."""
    count = len(t_s)
    run_s = np.arange(0.0, 90.0, 0.05)
    commanded = Commanded(run_s, scalar_first(attitude(motion, run_s)))
    moments = commanded.at(t_s)
    found = replace(
        slewing(count, 0.0),
        clock=replace(a_clock(), t_s=t_s),
        rate_rad_s=moments.rate_rad_s,
        commanded_q=moments.q,
    )
    telemetry = Telemetry(
        Path("t.csv"),
        np.round(1e9 * t_s).astype(np.int64),
        moments.q,
        np.ones(count, dtype=bool),
        np.arange(count) + 2,
        rate_cam_rad_s=moments.rate_rad_s + off_rad_s,
    )
    further = FurtherFigures()
    add_rates(further, telemetry, commanded, found)
    return further


def test_rates_that_are_left_out_are_said_with_how_many(rng: np.random.Generator) -> None:
    """Three of 400 that are 50 sigmas off, as of a field of a few stars close together."""
    off_rad_s = np.radians(0.01) * rng.standard_normal((400, 3))
    off_rad_s[[40, 190, 333]] += np.radians(0.5)
    further = figures_of_rates(2.0 + 0.2 * np.arange(400), off_rad_s)
    noise = {row.axis: row.value for row in further.rows if row.quantity == "rate noise"}
    assert noise == pytest.approx({"cross": 0.01, "roll": 0.01}, rel=0.15)
    said = [note for note in further.notes if "3 of 400 rates left out, beyond 8 sigmas" in note]
    assert [note.partition(":")[0] for note in said] == ["rate noise, cross", "rate noise, roll"]


def test_rates_at_the_ends_of_a_run_count_for_nothing(rng: np.random.Generator) -> None:
    """Their angular acceleration is not known: what was shown before and after is not, either."""
    off_rad_s = np.radians(0.01) * rng.standard_normal((400, 3))
    further = figures_of_rates(np.linspace(0.0, 89.95, 400), off_rad_s)
    bias = {row.axis: row.value for row in further.rows if row.quantity == "rate bias"}
    assert bias == pytest.approx({"cross": 0.0, "roll": 0.0}, abs=0.005)
    lag = {row.axis: row.value for row in further.rows if row.quantity == "rate lag"}
    assert lag == pytest.approx({"cross": 0.0, "roll": 0.0}, abs=0.1)


def test_a_stamp_s_jitter_has_back_what_the_budget_s_fits_took() -> None:
    """10 ms of 400 answers; where a field took 99 numbers, as of 300."""
    values = []
    for taken in (0.0, 99.0):
        further = FurtherFigures()
        add_jitter(further, slewing(400, taken))
        (row,) = further.rows
        assert (row.quantity, row.axis, row.unit) == ("stamp jitter", "", "s")
        values.append(row.value)
    # what the fit of bias and stamp takes of 400 is 3 / n, and is given back here, too
    assert values[0] == pytest.approx(0.01, rel=0.01)
    assert values[1] / values[0] == pytest.approx(math.sqrt(399 / 300))


def test_false_stars_are_counted_by_answers_that_have_stars() -> None:
    """Three of them in every other of 160 answers, whose 20 stars are judged at their own
    attitudes.
    """
    count = 160
    rng = np.random.default_rng(4)
    q = rng.normal(size=(count, 4))
    asked = []

    def judged(reported: Any, attitude_q: FloatArray) -> StarResiduals:
        asked.append((reported[0].hip, attitude_q.tolist()))
        x_px, y_px = rng.uniform(0, [[1199], [699]], (2, 20))
        lit = LitStars(x_px, y_px, np.full(20, 4.0), np.full(20, 0.5), np.full(20, 1e4))
        return StarResiduals(lit, *rng.normal(0, 0.1, (2, 20)), np.zeros(20), false=3)

    centroids = [[ReportedStar(1.0, 2.0, None, k)] if k % 2 else [] for k in range(count)]
    further = FurtherFigures()
    found = replace(a_budget(), commanded_q=q)
    add_stars(further, SimpleNamespace(judged=judged, size_px=(1200, 700)), centroids, found)  # type: ignore[arg-type]
    assert asked == [(k, q[k].tolist()) for k in range(1, count, 2)]
    rows = {row.quantity: row for row in further.rows}
    row = rows["false stars a frame"]
    assert (row.value, row.unit) == (3.0, "a frame")
    # of 240 in all: 3 +- 1.96 sqrt(240) / 80
    half = 1.96 * math.sqrt(240) / 80
    assert (row.low_95, row.high_95) == pytest.approx((3 - half, 3 + half), abs=0.05)
    assert rows["star noise"].value == pytest.approx(0.1, rel=0.1)
    assert further.stars is not None and len(set(further.stars.case.tolist())) == 40
