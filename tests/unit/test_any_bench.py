"""The tool that tries benches by chance: what it draws, how it judges, and that it goes on where
it was stopped.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict

import numpy as np
import pytest

from hilstar.instruments.calibrate.first_light.image_sources import on_screen
from hilstar.optics.scan import Orientation
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.any_bench import judge, run
from tests.support.any_bench.draw import (
    FOCAL_MM,
    PIXEL_RATIOS,
    PSF_PX,
    SEEN,
    TRACKER_FIELD_DEG,
    TRACKER_PITCH_UM,
    drawn_bench,
    true_light,
    write_bench,
)
from tests.support.any_bench.judge import (
    ASSESS,
    FIRST_LIGHT,
    SERVE,
    VERIFY,
    CommandResult,
    Comparison,
    SeenScreen,
    in_image,
    in_screen,
    outcome_of,
)

DRAWN = 60
WIDE = "a star is 6.5 times as wide as the sky's (limit [verify] star_sigma_ratio = 2)"
OFF = "centroids are 0.121 px off at 95 % (limit 0.1)"
BY_CODES = "the codes alone cost 0.013 mag and 0.120 px at 95 %"
# The plant is read back from files whose numbers are written in full.
EXACT = 1e-6


def test_a_bench_is_the_same_whatever_else_is_drawn_and_lies_within_what_labs_have():
    for number in range(DRAWN):
        bench = drawn_bench(5, number)
        assert bench == drawn_bench(5, number)
        assert PSF_PX[0] <= bench.detector.psf_px <= PSF_PX[1]
        assert FOCAL_MM[0] <= bench.detector.focal_mm <= FOCAL_MM[1]
        assert TRACKER_PITCH_UM[0] <= bench.detector.pitch_um <= TRACKER_PITCH_UM[1]
        assert SEEN[0] <= bench.seen <= SEEN[1]
        assert PIXEL_RATIOS[0] <= bench.pixel_ratio <= PIXEL_RATIOS[1]
        assert 2 * math.degrees(math.atan(bench.detector.tangents[0])) <= TRACKER_FIELD_DEG[1]
        assert (np.diff(true_light(bench.panel)) > 0).all()
    assert drawn_bench(5, 0) != drawn_bench(6, 0)


def test_a_black_level_is_planted_relative_to_white_above_it():
    """Relative to white with black in it, one of 7e-4 was 3 of its errors from where it was."""
    for number in range(DRAWN):
        panel = drawn_bench(5, number).panel
        assert judge.planted_black(panel) == pytest.approx(panel.black, rel=EXACT)


def small(seed, *, turned):
    """The first bench of a seed on a small screen, mounted upright or by a quarter turn."""
    for number in range(200):
        bench = drawn_bench(seed, number)
        if bench.panel.kind == "microdisplay" and (bench.mounting.rotate_deg % 180 != 0) == turned:
            return bench
    raise AssertionError(seed)


@pytest.mark.parametrize("turned", [False, True])
def test_the_truth_compared_with_itself_is_off_by_nothing_and_the_bench_file_by_what_was_planted(
    tmp_path, turned
):
    bench = small(3, turned=turned)
    file, truth = map(read_bench_file, write_bench(bench, tmp_path))
    itself = SeenScreen.of(truth, truth)
    assert np.abs(itself.off_px).max() < EXACT
    assert np.abs(itself.off_mag).max() < EXACT
    assert len(itself.off_px) > 100
    seen = SeenScreen.of(file, truth)
    # mounting, tilt and focal length are other than the file's
    assert np.nanmedian(seen.off_px) > 1.0


@pytest.mark.parametrize("flip_x", [False, True])
@pytest.mark.parametrize("rotate_deg", [0, 90, 180, 270])
def test_pixels_go_to_the_screen_as_the_image_does(flip_x, rotate_deg):
    """Against the turn of a whole image, which the virtual bench's is."""
    image = np.arange(30, dtype=np.uint16).reshape(5, 6)
    screen = on_screen(image, Orientation(flip_x, False, rotate_deg // 90))

    class Mounted:
        resolution_px = (6, 5)
        flip_y = False

    Mounted.flip_x, Mounted.rotate_deg = flip_x, rotate_deg
    y, x = (part.ravel().astype(float) for part in np.mgrid[0:5, 0:6])
    there = in_screen(Mounted, x, y)
    columns, rows = (np.asarray(part, dtype=int) for part in there)
    assert (screen[rows, columns] == image.ravel()).all()
    back = in_image(Mounted, *there)
    assert np.array_equal(back, (x, y))


def result(found=None, code=0, stderr="", memory_mb=500.0, load=math.nan):
    return CommandResult(code, 1.0, 1.0, memory_mb, json.dumps(found or {}), stderr, load)


def session_of(**verdicts):
    return {
        "steps": [
            {"name": name, "verdict": verdict, "line": f"{name} said so"}
            for name, verdict in verdicts.items()
        ]
    }


DARK = session_of(orientation="failed")
DARK["steps"][0]["line"] = "a black screen fills the tracker to 100% of its range"
DONE = session_of(geometry="done", verify="done")
GONE = result(code=3, stderr="gone")
PASSED = {"passed": True, "reasons": []}


@pytest.mark.parametrize(
    ("results", "compared", "outcome", "words"),
    [
        ({FIRST_LIGHT: result(DONE), VERIFY: result(PASSED)}, {}, judge.VERIFIED, ""),
        (
            {FIRST_LIGHT: result(code=2, stderr="hilstar: no such lens\n")},
            {},
            judge.REFUSED,
            "no such lens",
        ),
        (
            {FIRST_LIGHT: result(code=-9, stderr="hilstar: 3 s: begins\n")},
            {},
            judge.FAILED,
            "ended with -9",
        ),
        (
            {
                FIRST_LIGHT: result(
                    code=1, stderr="Traceback (most recent call last):\nValueError: x\n"
                )
            },
            {},
            judge.TRACEBACK,
            "x",
        ),
        ({FIRST_LIGHT: result(session_of(focus="failed"), 1)}, {}, judge.FAILED, "focus said so"),
        (
            {
                FIRST_LIGHT: result(session_of(verify="failed"), 1),
                VERIFY: result({"reasons": [WIDE]}),
            },
            {},
            judge.TOO_WIDE,
            "star_sigma_ratio",
        ),
        (
            {
                FIRST_LIGHT: result(session_of(verify="failed"), 1),
                VERIFY: result({"reasons": [WIDE, "flux is off"]}),
            },
            {},
            judge.FAILED,
            "verify said so",
        ),
        (
            {
                FIRST_LIGHT: result(session_of(verify="failed"), 1),
                VERIFY: result({"reasons": [OFF, BY_CODES, WIDE]}),
            },
            {},
            judge.TOO_WIDE,
            "star_sigma_ratio",
        ),
        (
            {
                FIRST_LIGHT: result(session_of(verify="failed"), 1),
                VERIFY: result({"reasons": [OFF, WIDE]}),
            },
            {},
            judge.FAILED,
            "verify said so",
        ),
        (
            {FIRST_LIGHT: result(DONE), VERIFY: result({"reasons": ["flux is off"]})},
            {},
            judge.NOT_VERIFIED,
            "flux is off",
        ),
        ({FIRST_LIGHT: result(DONE, memory_mb=2500)}, {}, judge.HEAVY, "2500 MB"),
        (
            {FIRST_LIGHT: result(DONE)},
            {"focus": Comparison(0.15, 0.55, -40.0)},
            judge.WRONG,
            "focus 0.15, not 0.55: -40.0 sigmas",
        ),
        (
            {
                FIRST_LIGHT: result(DONE),
                VERIFY: result(PASSED),
                SERVE: result(code=3, stderr="gone"),
            },
            {},
            judge.LATER,
            "serve: gone",
        ),
        (
            {
                FIRST_LIGHT: result(DONE),
                VERIFY: result(PASSED),
                SERVE: result({"missed_frames": 300}, load=13.7),
                ASSESS: result(code=2, stderr="hilstar: the run missed so many frames that 9"),
            },
            {},
            judge.BUSY,
            "missed so many frames that 9 (the machine's load was 13.7 on",
        ),
        (
            {
                FIRST_LIGHT: result(DONE),
                VERIFY: result(PASSED),
                SERVE: result({"missed_frames": 0}),
                ASSESS: result(code=2, stderr="hilstar: 23 valid answers, and 30 are needed"),
            },
            {},
            judge.LATER,
            "23 valid answers",
        ),
        (
            {FIRST_LIGHT: result(DARK, 1)},
            {},
            judge.REFUSED,
            "a black screen fills the tracker",
        ),
    ],
)
def test_an_outcome_is_the_worst_that_happened_in_its_own_words(results, compared, outcome, words):
    found, told = outcome_of(results, compared)
    assert found == outcome
    assert words in told


def test_what_has_ended_is_not_run_again(tmp_path, monkeypatch):
    """Stopped after its session: the next run takes the session from its file, and a finished
    bench its row.
    """
    ran = []

    def ended(folder, limit_s, commands):
        ran.extend(commands)
        return [result(code=2, stderr="hilstar: refused") for _ in commands]

    monkeypatch.setattr(run, "_ended", ended)
    folder = tmp_path / "0000"
    (folder / run.RESULTS).mkdir(parents=True)
    before = CommandResult(2, 1.0, 1.0, 10.0, "", "hilstar: said before")
    (folder / run.RESULTS / f"{FIRST_LIGHT}.json").write_text(json.dumps(asdict(before)))
    row = run.run_bench(3, 0, folder)
    assert ran == []
    assert (row["outcome"], row["words"]) == (judge.REFUSED, "hilstar: said before")
    assert run.run_bench(3, 0, folder) == json.loads((folder / run.ROW).read_text())
    other = run.run_bench(3, 1, tmp_path / "0001")
    assert ran == [FIRST_LIGHT]
    assert other["words"] == "hilstar: refused"
