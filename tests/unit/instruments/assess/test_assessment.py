"""hilstar assess over files: what it finds of a planted tracker, and what it refuses."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from hilstar.basics import charts
from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import NS_PER_S
from hilstar.instruments.assess import report
from hilstar.instruments.assess.assessment import (
    AssessSettings,
    _glass_notes,
    assess_files,
    lock_of,
    read_ledger,
)
from hilstar.instruments.assess.bench_effects import display_cost, slices_of, turn_between
from hilstar.instruments.simulate.glass import split_errors
from hilstar.instruments.simulate.noise import field_stars
from hilstar.optics.glass.psf_file import glass_of, write_glass
from hilstar.server.answers.pairing import LitFrame, LitFrames
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.cameras import tracker_camera
from hilstar.server.bench.star_light import bench_stars
from hilstar.server.record.commanded import Commanded
from hilstar.server.record.ledger_records import AnswerRecord, FrameRecord
from tests.support.assessments import an_assessment
from tests.support.benches import SMALL_BENCH, bench_text
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.figures import assert_legible
from tests.support.glass import SIDE_PX, stack
from tests.support.planted_run import write_ledger, write_records, write_run, write_telemetry
from tests.support.planted_tracker import Planted, Sizes, attitude, plant, scalar_first, scan, still
from tests.support.refusals import refusal

SIZES = Sizes(wild=5, offset_s=0.02)


@pytest.fixture(scope="module")
def planted() -> Planted:
    return plant(scan, SIZES, np.random.default_rng(11), seconds=240.0)


@pytest.fixture(scope="module")
def by_file(
    tmp_path_factory: pytest.TempPathFactory, planted: Planted
) -> tuple[dict[str, Any], Path, list[Figure]]:
    """What the command says of the planted tracker's telemetry, its folder, and the figures that
    it drew.
    """
    folder, drawn = tmp_path_factory.mktemp("assess"), []
    with pytest.MonkeyPatch.context() as patch:
        svg = charts.svg
        patch.setattr(charts, "svg", lambda figure: drawn.append(figure) or svg(figure))
        ledger, telemetry = write_run(folder, planted)
        run = run_hilstar_here(
            "assess", ledger, telemetry, "-o", folder / "out", "--json", "--display-attitudes", "0"
        )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout), folder / "out", drawn


def budget(ledger: Path, telemetry: Path | None = None) -> tuple[dict[str, Any], list[str]]:
    """The budget and its notes without the page, which takes half of the command's time."""
    found = assess_files(ledger, telemetry, AssessSettings(display_attitudes=0))
    assert repr(found).startswith(f"<hilstar assessment: {len(found.t_s)} answers, noise ")
    return msgspec.json.decode(msgspec.json.encode(report.budget_of(found))), found.notes


def test_a_run_gives_the_budget_on_one_page_and_names_each_wrong_answer(
    planted: Planted, by_file
) -> None:
    found, out, drawn = by_file
    errors = ("bias_arcsec", "fov_arcsec", "pixel_arcsec", "noise_arcsec", "limit_arcsec")
    counts = ("availability", "wrong", "missed", "out_of_order")
    assert set(found) == {*errors, *counts, "clock", "further"}
    assert found["noise_arcsec"]["cross"] == pytest.approx(1.0, rel=0.1)
    assert found["pixel_arcsec"]["roll"] == pytest.approx(2.4, rel=0.15)
    assert found["clock"]["offset_ms"] == pytest.approx(20.0, abs=4 * found["clock"]["sigma_ms"])
    assert found["clock"]["sigma_ms"] < 50
    lines = (planted.wild + 2).tolist()
    assert [each["row"] for each in found["wrong"]] == lines
    with (out / "wrong.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["row"]) for row in rows] == lines
    assert [float(row["t_s"]) for row in rows] == pytest.approx(
        (planted.tau_s[planted.wild] + 5).tolist(), abs=1e-8
    )
    # Gaps, and wild answers: what is left of one answer each 100 ms.
    due = (planted.tau_s[-1] - planted.tau_s[0]) / 0.1 + 1
    assert found["availability"] == pytest.approx((len(planted.tau_s) - 5) / due, abs=2e-3)
    text = (out / "budget.html").read_text()
    # five minutes that come back to few places
    assert "come back to the same places" in text
    assert (
        text.count("data:image/svg+xml;base64,") == len(drawn) == 4
        and "prefers-color-scheme: dark" in text
    )
    assert not re.search(r"(src|href)=.(https?:)?//|<td>1</td>", text)
    for figure in drawn:
        assert_legible(figure)
    with (out / "budget.csv").open() as file:
        table = {(row["quantity"], row["axis"]): row for row in csv.DictReader(file)}
    row = table["noise", "cross"]
    assert float(row["low_95"]) < 1.0 < float(row["high_95"])
    assert (out / "slices.csv").read_text().count("rate_deg_s") == 5


def test_a_ledgers_own_answers_give_the_budget_of_a_file_of_them(
    tmp_path: Path, planted: Planted, by_file
) -> None:
    own_s, epoch_ns, late_ns = planted.tau_s, 10**15, 150_000_000
    records = []
    for k, (tau_s, q) in enumerate(zip(own_s.tolist(), planted.reported.tolist(), strict=True)):
        middle_ns = round((tau_s + 5) * 1e9)  # as a live run knows it, 20 ms off
        records.append(
            AnswerRecord(host_ns=middle_ns + late_ns, raw="00", t_ns=middle_ns + epoch_ns, q=tuple(q), verdict="right",
                         middle_ns=middle_ns, light_ns=None if k in planted.wild else middle_ns)
        )  # fmt: skip
    records.insert(
        50,
        AnswerRecord(
            host_ns=records[50].host_ns, raw="", t_ns=records[49].t_ns, valid=False, middle_ns=0
        ),
    )
    ledger = write_ledger(
        tmp_path / "own.mcap", planted.frames_s, planted.frames_q, records=records
    )
    (found, notes), expected = budget(ledger), by_file[0]
    assert not any("do not overlap" in note for note in notes)
    for key in ("bias_arcsec", "fov_arcsec", "noise_arcsec"):
        assert found[key] == pytest.approx(expected[key], rel=1e-3)
    assert found["clock"]["drift_ppm"] == pytest.approx(expected["clock"]["drift_ppm"], rel=1e-3)
    # The telemetry's clock is that of the run in the file, and its own in the ledger.
    assert found["clock"]["offset_ms"] == pytest.approx(
        expected["clock"]["offset_ms"] + epoch_ns / 1e6, abs=0.01
    )
    assert [each["row"] for each in found["wrong"]] == (
        planted.wild + 1 + (planted.wild >= 50)
    ).tolist()
    empty = write_ledger(tmp_path / "empty.mcap", planted.frames_s[:9], planted.frames_q[:9])
    assert_refused(
        run_hilstar_here("assess", empty, "-o", tmp_path / "c"),
        2,
        "no answers of a tracker",
        "give its telemetry",
    )


@pytest.mark.usefixtures("without_charts")
def test_a_bench_with_a_glass_is_told_what_each_correction_would_leave(tmp_path: Path) -> None:
    """By the file of the PSF: lateral colour and coma in closed form, most of which a distortion
    takes, and colour besides.
    """
    planted = plant(scan, SIZES, np.random.default_rng(11), seconds=60.0)
    write_glass(tmp_path / "psf.fits", glass_of(stack()))
    tracker = {"resolution_px": [SIDE_PX, SIDE_PX], "focal_length_mm": 12, "transmission": None}
    ledger, telemetry = write_run(
        tmp_path, planted, bench_text({"tracker": tracker, "tracker.optics": {"psf": "psf.fits"}})
    )
    run = run_hilstar_here(
        "assess", ledger, telemetry, "-o", tmp_path / "out", "--json", "--display-attitudes", "0"
    )
    glass = json.loads(run.stdout)["glass"]
    px = glass["rms_px"]
    assert glass["stars"] > 200 and glass["centroider"] == "window"
    assert px["total"] > 1.5 * px["without_distortion"] > 1.5 * px["without_both"] > 0
    assert px["without_colour"] < px["total"]
    assert glass["fov_arcsec"]["total"]["cross"] > glass["fov_arcsec"]["without_both"]["cross"] > 0
    assert "glass without colour,roll," in (tmp_path / "out" / "budget.csv").read_text()
    assert (
        glass["source"] == "PSF file"
        and "hold only attitudes" in (tmp_path / "out" / "budget.html").read_text()
    )
    # Answers that name their stars tell it by these, whatever the file says: here 0.3 px of
    # distortion and 0.1 px a mag of B-V.
    bench = bench_file_of(
        tmp_path / "bench.toml",
        bench_text({"tracker": tracker, "tracker.optics": {"psf": "psf.fits"}}),
    )
    stars, camera, rng = (
        bench_stars(bench.config, tmp_path),
        tracker_camera(bench.config.tracker, tmp_path),
        np.random.default_rng(3),
    )
    records, whole = [], field_stars(stars, camera, planted.reported[0])
    for number, (tau_s, q) in enumerate(
        zip(planted.tau_s.tolist(), planted.reported.tolist(), strict=True)
    ):
        rows = whole[:0] if number % 20 else field_stars(stars, camera, np.array(q))[:20]
        u = (rows["x_px"] - SIDE_PX / 2) / (SIDE_PX / 2)
        x = rows["x_px"] + 0.3 * u**3 + 0.1 * rows["bv"] + rng.normal(0, 0.02, len(rows))
        named = [
            (*place, 1.0, hip)
            for *place, hip in zip(
                x.tolist(), rows["y_px"].tolist(), rows["hip"].tolist(), strict=True
            )
        ]
        at_ns = round((tau_s + 5) * 1e9)
        records.append(
            AnswerRecord(
                host_ns=at_ns,
                raw="",
                t_ns=at_ns,
                q=tuple(q),
                middle_ns=at_ns,
                light_ns=at_ns,
                centroids=named,
            )
        )
    ledger = write_ledger(
        tmp_path / "own.mcap", planted.frames_s, planted.frames_q, bench=bench.text, records=records
    )
    glass = budget(ledger)[0]["glass"]
    assert glass["source"] == "answers' stars" and glass["stars"] > 200
    px = glass["rms_px"]
    # the noise, and the planted attitudes' own error of 6 arcsec
    assert 0.02 < px["without_both"] < 0.04
    assert px["total"] > 1.3 * px["without_distortion"] > 2 * px["without_both"]
    assert glass["fov_arcsec"]["total"]["cross"] > glass["fov_arcsec"]["without_both"]["cross"]


def test_a_note_says_why_a_glass_is_told_by_its_file() -> None:
    by_file = an_assessment().glass
    assert by_file is not None and by_file.source == "PSF file"
    by_stars = replace(by_file, source="answers' stars")
    why = []
    for has_stars in (False, True):
        why += _glass_notes(by_file, has_stars=has_stars)
        assert _glass_notes(by_stars, has_stars=has_stars) == []
        assert _glass_notes(None, has_stars=has_stars) == []
    told = "what the glass costs is told by the PSF file"
    assert why == [
        f"the answers hold only attitudes, which cannot tell colour from distortion: {told}",
        f"the answers name too few stars: {told}",
    ]


def test_a_split_finds_what_was_put_together() -> None:
    rng = np.random.default_rng(5)
    places, bv = rng.uniform(0, 256, (400, 2)), rng.uniform(-0.3, 1.8, 400)
    u = (places - 127.5) / 128
    distortion, colour = (
        0.3 * u * (u**2).sum(axis=1, keepdims=True),
        0.1 * (bv - bv.mean())[:, None] * u,
    )
    rest = rng.normal(0, 0.01, (400, 2))
    split = split_errors(places, bv, distortion + colour + rest, (256, 256))
    assert split.distortion == pytest.approx(distortion, abs=0.01)
    assert split.colour == pytest.approx(colour, abs=0.01)
    assert split.rms_px()["psf"] == pytest.approx(np.sqrt((rest**2).sum(axis=1).mean()), rel=0.05)


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([], "has no row"),
        (["1,nan,0,0,1,1"], "qw = 'nan' is not a finite number"),
        (["1,2,0,0,1,1"], "norm of qw,qx,qy,qz is 2.23607"),
        (["1,0.5,0,0,0,1"], "norm of qw,qx,qy,qz is 0.5"),
        (["2,1,0,0,0,1", "1,1,0,0,0,1"], "time does not increase"),
        (["1,1,0,0,0,0"], "none of them valid"),
        (["1,1,0,0,0,2"], "valid = '2'"),
        (["x,1,0,0,0,1"], "t_s = 'x' is no time"),
        (["1,1,0,0,0,1"], "1 valid answers, and 30 are needed"),
    ],
)
def test_telemetry_that_is_wrong_is_refused_in_one_line(
    tmp_path: Path, planted: Planted, rows: list[str], said: str
) -> None:
    ledger = write_ledger(tmp_path / "run.mcap", planted.frames_s[:50], planted.frames_q[:50])
    telemetry = tmp_path / "telemetry.csv"
    telemetry.write_text("\n".join(["t_s,qw,qx,qy,qz,valid", *rows]) + "\n")
    check_refused(ledger, telemetry, said)


def check_refused(ledger: Path, telemetry: Path, said: str) -> None:
    run = run_hilstar_here("assess", ledger, telemetry, "-o", ledger.parent / "out", "--json")
    assert run.returncode == 2, run.stderr
    assert run.stdout == ""
    assert said in run.stderr
    assert run.stderr.count("\n") == 1
    assert not (ledger.parent / "out").exists()


def left_turned(planted: Planted, left: Rotation) -> FloatArray:
    return scalar_first(left * Rotation.from_quat(np.roll(planted.reported, -1, axis=1)))


@pytest.mark.parametrize(
    ("convention", "said"),
    [
        ("inverse", "are the inverse (cam to ICRS)"),
        ("scalar last", "have the scalar last"),
        ("y up", "y = -y, z = -z of hilstar's"),
        ("another run", "at no offset of its clock"),
    ],
)
def test_other_conventions_and_other_runs_are_told_apart(
    tmp_path: Path, planted: Planted, convention: str, said: str
) -> None:
    ledger, _ = write_run(tmp_path, planted)
    rng = np.random.default_rng(2)
    reported = {
        "inverse": lambda: planted.reported * [1, -1, -1, -1],
        "scalar last": lambda: np.roll(planted.reported, -1, axis=1),
        "y up": lambda: left_turned(planted, Rotation.from_rotvec([np.pi, 0, 0])),
        "another run": lambda: scalar_first(Rotation.random(len(planted.tau_s), random_state=rng)),
    }[convention]()
    telemetry = write_telemetry(tmp_path / "other.csv", planted.tau_s, reported)
    check_refused(ledger, telemetry, said)


def test_a_ledger_without_attitudes_is_refused(tmp_path: Path, planted: Planted) -> None:
    ledger = write_ledger(tmp_path / "run.mcap", planted.frames_s[:50], None)
    telemetry = write_telemetry(tmp_path / "telemetry.csv", planted.tau_s, planted.reported)
    check_refused(ledger, telemetry, "none of them has an attitude")


def test_a_ledger_that_shows_no_sky_or_no_bench_is_refused_with_what_it_lacks(
    tmp_path: Path,
) -> None:
    """Of frames that an operator changed or a window hid, and of a head without a bench."""
    q = (1.0, 0.0, 0.0, 0.0)
    frames = []
    for number in range(5):
        at_ns = (number + 1) * NS_PER_S
        frame = FrameRecord(
            frame=number, t_ns=at_ns, light_ns=at_ns, draw_ns=at_ns, swap_ns=at_ns, q=q
        )
        frames.append(frame)
    changed = [msgspec.structs.replace(frame, operator="grid") for frame in frames]
    hidden = [msgspec.structs.replace(frame, hidden="minimised") for frame in frames]
    none = [msgspec.structs.replace(frame, q=None) for frame in frames]
    for records, bench, words in (
        (changed, SMALL_BENCH, "5 frames, and operators' keys or a hidden window changed all of"),
        (hidden[:4] + frames[4:], SMALL_BENCH, "5 frames, and operators' keys or a hidden window"),
        (none[:4] + frames[4:], SMALL_BENCH, "5 frames, and none of them has an attitude"),
        (frames, "no TOML", "its head holds no bench file that can be read; give the ledger of"),
    ):
        path = write_records(tmp_path / "run.mcap", records, bench)
        assert words in refusal(read_ledger, path)
    whole = read_ledger(write_records(tmp_path / "run.mcap", frames))
    assert whole.commanded.shown.sum() == 5


def test_a_still_run_does_not_invent_a_clock(tmp_path: Path) -> None:
    ledger, telemetry = write_run(
        tmp_path,
        plant(still, Sizes(fov=0.0, pixel=0.0, wild=2), np.random.default_rng(12), seconds=200.0),
    )
    found, notes = budget(ledger, telemetry)
    assert found["clock"]["offset_ms"] is None
    assert found["clock"]["drift_ppm"] is None
    assert found["clock"]["sigma_ms"] > 1000
    assert found["fov_arcsec"] == {"cross": None, "roll": None}
    assert any("no motion that tells the clock" in note for note in notes)
    assert np.linalg.norm(found["bias_arcsec"][:2]) == pytest.approx(20.0, rel=0.05)


def test_gaps_invalid_and_wrong_answers_are_outages_and_longer_ones_lose_the_lock() -> None:
    t_s = np.arange(0.0, 100.0, 0.1)
    commanded = Commanded(t_s, np.tile([1.0, 0.0, 0.0, 0.0], (len(t_s), 1)))
    right, wrong = np.ones(len(t_s), dtype=bool), np.zeros(len(t_s), dtype=bool)
    right[:20] = False  # two seconds to acquire
    right[300:350] = False  # five seconds not valid
    right[500], wrong[500] = False, True
    kept = (t_s < 70) | (t_s > 80.05)  # ten seconds without a row
    lock = lock_of(commanded, t_s[kept], right[kept], wrong[kept])
    assert lock.due == pytest.approx(1000, abs=1)
    assert lock.availability == pytest.approx((1000 - 20 - 50 - 1 - 100) / 1000, abs=2e-3)
    assert [(round(o.start_s, 1), round(o.length_s, 1), o.wrong) for o in lock.outages] == [
        (30.0, 5.0, 0),
        (50.0, 0.1, 1),
        (70.0, 10.1, 0),
    ]
    assert len(lock.lost) == 2
    waits = [each.wait_s for each in lock.acquisitions]
    assert waits == pytest.approx([2.0, 5.0, 10.1], abs=0.01)
    assert lock.acquisition_probability == 1.0


def test_an_outage_of_up_to_three_cycles_keeps_the_lock() -> None:
    """Its length, which is a cycle less than the gap: 2.5 and 4 cycles."""
    t_s = np.arange(0.0, 20.0, 0.1)
    t_s[100:] += 0.05
    right = np.ones(len(t_s), dtype=bool)
    right[98:100] = right[150:154] = False
    commanded = Commanded(t_s, np.tile([1.0, 0.0, 0.0, 0.0], (len(t_s), 1)))
    lock = lock_of(commanded, t_s, right, np.zeros(len(t_s), dtype=bool))
    assert [outage.length_s for outage in lock.outages] == pytest.approx([0.25, 0.4])
    assert [outage.lost for outage in lock.outages] == [False, True]


def test_a_sky_that_went_before_the_telemetry_or_came_after_it_was_not_to_be_acquired() -> None:
    """Shown from 0, 20, 40 and 60 s for ten seconds each; answers from 25 to 55 s. What is lost from
    27 s on comes between the second sky and the third.
    """
    frames_s = np.arange(0.0, 80.0, 0.1)
    q = np.tile([1.0, 0.0, 0.0, 0.0], (len(frames_s), 1))
    q[frames_s % 20 > 10] = np.nan
    t_s = np.arange(25.0, 55.0, 0.5)
    shown = t_s % 20 < 9.9
    late = ((t_s > 39) & (t_s < 41)) | ((t_s > 26.9) & (t_s < 29.1))
    lock = lock_of(Commanded(frames_s, q), t_s, shown & ~late, np.zeros(len(t_s), dtype=bool))
    waits = [(each.start_s, each.wait_s) for each in lock.acquisitions]
    assert waits == [
        (25.0, 0.0),
        (27.0, 2.5),
        (pytest.approx(40.0), pytest.approx(1.0, abs=0.11)),
    ]


def test_the_displays_error_is_subtracted_only_where_the_answers_show_it() -> None:
    rng = np.random.default_rng(13)
    display = [0.5, 0.5, 4.0] * rng.normal(size=(60, 3))
    noise = [0.8, 0.8, 3.0] * rng.normal(size=(60, 3))
    seen, unseen = display_cost(display, noise + display), display_cost(display, noise)
    assert seen is not None
    assert unseen is not None
    assert seen.seen == pytest.approx(1.0, abs=4 * seen.sigma_seen)
    assert seen.subtracted > 0.5
    assert unseen.subtracted == 0.0
    assert display_cost(np.full((60, 3), np.nan), noise) is None


def test_shifted_stars_are_the_turn_that_shifts_them() -> None:
    rng = np.random.default_rng(14)
    true = np.stack([*rng.uniform(-0.1, 0.1, (2, 20)), np.ones(20)], axis=1)
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    turn = np.array([1e-5, -2e-5, 3e-4])
    found = turn_between(true, Rotation.from_rotvec(turn).apply(true), np.ones(20))
    np.testing.assert_allclose(found, turn, atol=1e-7)  # the square of the turn


def test_slices_by_rate_show_where_the_noise_grows() -> None:
    rng = np.random.default_rng(15)
    rate = rng.uniform(0, 1, 5000)
    left = (1 + rate)[:, None] * rng.normal(size=(5000, 3))
    slices = slices_of(rate, left, left, 0.0)
    assert len(slices) == 5
    assert slices[0].noise_cross_arcsec == pytest.approx(1.1, rel=0.05)
    assert slices[-1].noise_cross_arcsec == pytest.approx(1.9, rel=0.05)
    assert sum(each.answers for each in slices) == 5000


REFRESH_HZ, EXPOSURE_S, NOISE_ARCSEC = 60.0, 0.1, 2.0
LATENCY_S = 0.3  # from an exposure's middle on: all frames that it has are shown by then
BENCH_60_HZ = bench_text(
    {"monitor": {"refresh_hz": REFRESH_HZ}, "tracker": {"exposure_s": EXPOSURE_S}}
)


def swing_rates(t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Up to 1 deg/s across and 0.5 about the boresight: a frame that is missed is up to 60
    arcsec off.
    """
    turn = 2 * np.pi * t_s
    return 84 + 10 * np.sin(turn / 63), 5 * np.sin(turn / 41 + 0.4), 6 * np.sin(turn / 75)


def missing_run(
    folder: Path, missed: int, seed: int, seconds: float = 150.0, wild: int = 0
) -> tuple[Path, Path, FloatArray]:
    """A run that misses frames, and a tracker that answers exactly what was lit, with noise:
    ledger, telemetry, wild rows.
    """
    rng = np.random.default_rng(seed)
    slots = np.arange(int(seconds * REFRESH_HZ))
    left_out: set[int] = set()
    while len(left_out) < missed:
        first = int(rng.integers(5, len(slots) - 20))
        left_out.update(range(first, first + int(rng.integers(1, 8))))
    shown = np.array([slot for slot in slots.tolist() if slot not in left_out])
    frames_s = shown / REFRESH_HZ
    frames_q = scalar_first(attitude(swing_rates, frames_s))
    before = np.diff(shown, prepend=-1) - 1
    ledger = write_ledger(
        folder / "run.mcap", frames_s, frames_q, bench=BENCH_60_HZ, missed_before=before.tolist()
    )
    frames, to_come = (
        LitFrames(1e9 / REFRESH_HZ),
        iter(zip(frames_s.tolist(), frames_q, strict=True)),
    )
    at_s, reported = [], []
    for t_s in np.arange(1.0, seconds - 1.0, 0.2).tolist():
        half_s = EXPOSURE_S / 2
        while frames.newest is None or frames.newest.host_ns < (t_s + LATENCY_S) * 1e9:
            shown_s, q = next(to_come)
            frames.add(LitFrame(0, round(shown_s * 1e9), round(shown_s * 1e9), q))
        lit = frames.over(round((t_s - half_s) * 1e9), round((t_s + half_s) * 1e9))
        if lit is not None:
            at_s.append(t_s)
            reported.append(lit.q)
    noise = Rotation.from_rotvec(rng.normal(0, np.radians(NOISE_ARCSEC / 3600), (len(at_s), 3)))
    answers = scalar_first(noise * Rotation.from_quat(np.roll(np.array(reported), -1, axis=1)))
    wild_rows = np.sort(rng.choice(len(at_s), wild, replace=False))
    turn = Rotation.from_rotvec(np.tile(np.radians([0.0, 3.0, 0.0]), (wild, 1)))
    if wild:
        answers[wild_rows] = scalar_first(
            turn * Rotation.from_quat(np.roll(answers[wild_rows], -1, axis=1))
        )
    return ledger, write_telemetry(folder / "telemetry.csv", np.array(at_s), answers), wild_rows


@pytest.mark.parametrize(("missed", "seed"), [(67, 1), (405, 3)])
def test_missed_frames_are_not_the_trackers_errors(tmp_path: Path, missed: int, seed: int) -> None:
    ledger, telemetry, wild = missing_run(tmp_path, missed, seed, wild=4)
    found, _ = budget(ledger, telemetry)
    rows = len(telemetry.read_text().splitlines()) - 1
    # Held or not, an answer 3 degrees off is wrong, and no other is.
    assert [each["row"] for each in found["wrong"]] == (wild + 2).tolist()
    assert missed <= found["missed"]["frames"] <= missed + 7
    assert 0 < found["missed"]["answers_left_out"] < rows
    # Sigmas of n answers: noise / sqrt(2 n), and a clock by 0.5 deg/s over 150 s.
    kept = rows - found["missed"]["answers_left_out"]
    assert found["noise_arcsec"]["cross"] == pytest.approx(NOISE_ARCSEC, rel=4 / np.sqrt(4 * kept))
    assert found["clock"]["offset_ms"] == pytest.approx(0.0, abs=4 * found["clock"]["sigma_ms"])
    assert found["clock"]["drift_ppm"] == pytest.approx(0.0, abs=4.0)
    assert found["availability"] == pytest.approx(1 - len(wild) / rows, abs=0.01)


@pytest.mark.usefixtures("without_charts")
def test_missed_frames_are_named_on_the_terminal_and_on_the_page(tmp_path: Path) -> None:
    ledger, telemetry, _ = missing_run(tmp_path, 30, 4, seconds=60.0)
    run = run_hilstar_here(
        "assess", ledger, telemetry, "-o", tmp_path / "out", "--display-attitudes", "0"
    )
    (line,) = [line for line in run.stdout.splitlines() if line.startswith("missed frames")]
    said = re.search(
        r"(\d+) \(.*% of refresh periods, up to .* s\); answers that looked while a frame was held"
        r" for them: (\d+)",
        line,
    )
    assert said is not None and 30 <= int(said[1]) <= 37 and int(said[2]) > 0
    page = (tmp_path / "out" / "budget.html").read_text()
    assert line.split(None, 2)[2] in page
    tile = re.search(
        r">(\d+)<small>missed frames, [0-9.]+ % of the refresh periods; (\d+) frames were", page
    )
    assert tile is not None and tile[1] == said[1] and 0 < int(tile[2]) <= int(said[1])
    assert (
        f"answers left out for held frames,,{said[2]},"
        in (tmp_path / "out" / "budget.csv").read_text()
    )


def test_a_run_that_missed_too_many_frames_for_a_budget_is_refused(tmp_path: Path) -> None:
    ledger, telemetry, _ = missing_run(tmp_path, 1200, 5, seconds=30.0)
    refused = run_hilstar_here("assess", ledger, telemetry, "-o", tmp_path / "other")
    assert refused.returncode == 2, refused.stderr
    counts = re.search(
        r"the run missed so many frames that (\d+) of (\d+) answers looked while one was held, and"
        r" 30 others are needed; run it ([0-9.]+) times as long,",
        refused.stderr,
    )
    assert counts is not None, refused.stderr
    free = int(counts[2]) - int(counts[1])
    assert 30 <= free * float(counts[3]) < 30 + 0.1 * free
    check_refused(ledger, telemetry, "the run missed so many frames that")


def own_answers(planted: Planted, share: float, seed: int = 6) -> list[AnswerRecord]:
    """The planted answers as a ledger has them, a share of them overtaken by the next one or
    two.
    """
    rng = np.random.default_rng(seed)
    records = []
    for tau_s, q in zip(planted.tau_s.tolist(), planted.reported.tolist(), strict=True):
        middle_ns = round((tau_s + 5) * 1e9)
        # the ledger ends soon after its last frame
        overtaken = rng.random() < share and tau_s < planted.tau_s[-20]
        late_ns = 150_000_000 + bool(overtaken) * round(rng.uniform(0.11, 0.25) * 1e9)
        records.append(
            AnswerRecord(host_ns=middle_ns + late_ns, raw="", t_ns=middle_ns + 10**15, q=tuple(q), verdict="right",
                         middle_ns=middle_ns, light_ns=middle_ns)
        )  # fmt: skip
    return sorted(records, key=lambda each: each.host_ns)


def test_answers_out_of_order_give_the_budget_of_those_in_order(
    tmp_path: Path, planted: Planted
) -> None:
    shares, budgets = (0.0, 0.01, 0.05), []
    for share in shares:
        ledger = write_ledger(
            tmp_path / f"{share}.mcap",
            planted.frames_s,
            planted.frames_q,
            records=own_answers(planted, share),
        )
        found, notes = budget(ledger)
        budgets.append(found)
        assert found["out_of_order"] == pytest.approx(share * len(planted.tau_s), rel=0.5)
        assert len(found["wrong"]) == 5
        assert not any("clock was set" in note for note in notes)
    in_order, *others = budgets
    for found in others:
        for key in ("bias_arcsec", "noise_arcsec", "fov_arcsec", "availability"):
            assert found[key] == pytest.approx(in_order[key], rel=1e-6)
        drift_ppm = in_order["clock"]["drift_ppm"]
        assert found["clock"]["drift_ppm"] == pytest.approx(drift_ppm, abs=1e-3)


def test_a_trackers_clock_that_was_set_is_said_and_arrivals_count(
    tmp_path: Path, planted: Planted
) -> None:
    records = own_answers(planted, 0.02)
    for record in records[1000:]:
        record.t_ns += 5 * 10**12
    ledger = write_ledger(tmp_path / "c.mcap", planted.frames_s, planted.frames_q, records=records)
    found, notes = budget(ledger)
    assert any("clock was set" in note for note in notes)
    assert (found["out_of_order"], len(found["wrong"])) == (0, 5)
