"""What a user reads of an assessment, of which every number differs: the page and its drawings,
tables, lines and JSON.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from hilstar.basics.pages import BAD, DASH, OK, WARN, figures_of
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.assess import page, report
from hilstar.instruments.assess.assessment import Acquisition, Assessment, WrongAnswer
from hilstar.instruments.assess.budget import Axes
from hilstar.instruments.assess.clock import ClockFit
from hilstar.instruments.assess.figure_rows import FigureRow, figures_table
from hilstar.server.record.commanded_run import CommandedRun
from tests.support.assessments import RIGHT, T_S, VALID, a_run, an_assessment, as_json
from tests.support.card_texts import BAND, card_lines, drawn_figures
from tests.support.certificates import a_certificate
from tests.support.tables import csv_rows

PIXELS_OF_A_DEGREE = np.radians(1.0) * 70e3 / 13
# a place on the tangent plane over the angle: 0.7 degrees from a field's middle
TANGENT = 1e-3
OFF_BY = (
    "certificate H20261126-0a1b2c3d of 2026-11-26, valid until 2027-11-26: the bench itself is off"
    " by at most 4.5 arcsec across and 10 about the boresight (95 %); it could have made 90 % of"
    " the bias across and 91 % of that about"
)
MISSED = (
    "6 (5.7 % of refresh periods, up to 0.188 s about 12.12 s); answers that looked while a frame"
    " was held for them: 1, in no figure but the availability"
)
DISPLAY = (
    "0.38 arcsec across, 1.1 arcsec about the boresight, at 7 attitudes; 81 {}"
    " 12 % of it is in the answers"
)
GLASS = (
    "5.5 arcsec across by the PSF file, as `window` finds 321 stars; distortion corrected 4.5,"
    " colour 3.5, both 2.2"
)
CUBE = (
    "x +0.0010000, y -0.0020000, z +0.9999975 of cube 7, within 4.25 arcsec across and 9.75 about"
    " it (95 %)"
)
LIMIT = "0.312 arcsec across, 1.06 about the boresight (Cramer-Rao, one exposure at rest)"
FURTHER = {
    "rate bias": "0.0125 (0.0100 to 0.0160) deg/s across; not known: too few turns",
    "stamp jitter": "0.0004 s",
    "rate scale": "2.0 (1.0 to 3.0) % across",
}
ANSWERS = "8 right of 10 valid and 12 rows; 3 came out of order, sorted by their stamps"
# quantity, axis, value, unit, low and high
BUDGET_ROWS = """bias,x,-3,arcsec,-3.5,-2.5
bias,y,4,arcsec,3.25,4.75
bias,z,-11,arcsec,-13,-9
field-of-view error,cross,2.5,arcsec,2,3.25
field-of-view error,roll,7.5,arcsec,7,8.5
pixel error,cross,0.75,arcsec,0.5,1
pixel error,roll,1.25,arcsec,1,1.75
noise,cross,0.625,arcsec,0.5,0.75
noise,roll,2.875,arcsec,2.5,3.25
clock offset,,1.75,ms,1.554,1.946
clock drift,,12.5,ppm,8.58,16.42
availability,,0.5625,1,,
answers due,,16,1,,
right answers,,9,1,,
wrong answers,,1,1,,
missed frames,,6,1,,
answers left out for held frames,,1,1,,
answers out of order,,3,1,,
lock lost,,1,1,,
acquisition probability,,0.666666667,1,,
acquisition time; median,,0.3125,s,,
display's own error,cross,0.375,arcsec,,
display's own error,roll,1.125,arcsec,,
display's own error; share seen,,0.8125,1,,
limit of the tracker's stars,cross,0.3125,arcsec,,
limit of the tracker's stars,roll,1.0625,arcsec,,
rate bias,cross,0.0125,deg/s,0.01,0.016
rate bias,roll,,deg/s,,
stamp jitter,,0.0004,s,0.0003,
rate scale,cross,0.02,1,0.01,0.03
glass total,cross,5.5,arcsec,,
glass total,roll,15.5,arcsec,,
glass without distortion,cross,4.5,arcsec,,
glass without distortion,roll,14.5,arcsec,,
glass without colour,cross,3.5,arcsec,,
glass without colour,roll,13.5,arcsec,,
glass without both,cross,2.25,arcsec,,
glass without both,roll,12.5,arcsec,,""".splitlines()


@pytest.fixture(scope="module")
def made() -> Assessment:
    return an_assessment()


@pytest.fixture(scope="module")
def written(
    tmp_path_factory: pytest.TempPathFactory, made: Assessment
) -> tuple[dict[str, list[str]], list[Figure]]:
    """The page's cards, and its figures."""
    path = tmp_path_factory.mktemp("page") / "budget.html"
    with drawn_figures() as drawn:
        page.write_page(path, made)
    return card_lines(path.read_text()), drawn


@pytest.fixture(scope="module")
def cards(written: tuple[dict[str, list[str]], list[Figure]]) -> dict[str, list[str]]:
    return written[0]


def test_the_band_of_a_page_has_the_verdict_and_the_four_counts(cards) -> None:
    assert cards[BAND] == [
        "Error budget: telemetry.csv against run.mcap",
        "The tracker was right in 56.2 % of the answers due",
        "1 wrong answer, 1 lost lock, 6 missed frames.",
        "56.2 %",
        "availability: 9 of 16 answers due, one each 250 ms",
        "1",
        "wrong answer",
        "1",
        "lost lock",
        "6",
        "missed frames, 5.7 % of the refresh periods; 2 frames were held for them",
    ]


def test_the_parts_of_an_error_have_their_own_intervals_and_the_whole_is_their_square_sum(
    cards,
) -> None:
    """The error about the bias is sqrt(2.5^2 + 0.75^2 + 0.625^2), off by the root of the squares
    of size times half width over it; the bias across is 5, off by sqrt(1.5^2 + 3^2) / 5.
    """
    lines = cards["What the error is made of"]
    assert lines[0] == "2.68 \N{PLUS-MINUS SIGN} 0.59 arcsec"
    assert lines[2:7] == [
        "part | across | about the boresight",
        "bias | 5.00 (4.33 to 5.67) arcsec | 11.0 (9.0 to 13.0) arcsec",
        "field-of-view error | 2.50 (2.00 to 3.25) arcsec | 7.50 (7.00 to 8.50) arcsec",
        "pixel error | 0.75 (0.50 to 1.00) arcsec | 1.25 (1.00 to 1.75) arcsec",
        "noise | 0.62 (0.50 to 0.75) arcsec | 2.88 (2.50 to 3.25) arcsec",
    ]
    assert "hilstar calibrate alignment" in lines[-1]
    assert cards["Bias"][0] == "5.00 \N{PLUS-MINUS SIGN} 0.67 arcsec"
    assert cards["Bias"][2:5] == [
        "x | -3.00 (-3.50 to -2.50) arcsec",
        "y | 4.00 (3.25 to 4.75) arcsec",
        "about the boresight | -11.0 (-13.0 to -9.0) arcsec",
    ]
    for title, size, about in (
        ("Field-of-view error", "2.50 \N{PLUS-MINUS SIGN} 0.62", "7.50 (7.00 to 8.50)"),
        ("Pixel error", "0.75 \N{PLUS-MINUS SIGN} 0.25", "1.25 (1.00 to 1.75)"),
        ("Noise", "0.62 \N{PLUS-MINUS SIGN} 0.12", "2.88 (2.50 to 3.25)"),
    ):
        assert cards[title][0] == f"{size} arcsec"
        assert cards[title][2] == f"About the boresight: {about} arcsec."
    assert cards["Noise"][3] == f"Limit of the tracker's stars: {LIMIT}."
    assert cards["Pixel error"][3] == "The phase of a test."


def test_the_other_cards_of_a_page_have_the_assessment_s_own_figures(cards) -> None:
    answers = cards["Answers over the run"]
    assert answers[0] == f"answers | {ANSWERS}"
    assert answers[1:4] == [
        "acquisition | 67 %, median 0.312 s",
        f"missed frames | {MISSED}",
        "wrong | 1, on lines 6",
    ]
    cures = (page.WRONG_CURE, page.LOST_CURE, page.MISSED_CURE)
    assert answers[4] == f"What to do: {' '.join(cures)}"
    assert cards["Wrong answers and outages"] == [
        "1 wrong answer",
        "row | telemetry's time, s | run time, s | off by, deg",
        "6 | 8.016 | 11.02 | 33.25",
        "2 outages",
        "run time, s | length, s | lock lost | rows | wrong",
        "10.5 | 0.625 |  | 3 | 1",
        "11.75 | 1.25 | yes | 5 | 2",
    ]
    assert cards["Clock"][0] == "1.75 \N{PLUS-MINUS SIGN} 0.10 ms"
    rate = "12.5 \N{PLUS-MINUS SIGN} 2.0 ppm"
    assert cards["Clock"][2] == f"Its rate less that of the run: {rate}."
    assert cards["What is not the tracker's"] == [
        f"display | {DISPLAY.format(chr(0xB1))}",
        f"bench | {OFF_BY}",
        f"glass | {GLASS}",
    ]
    assert cards["Cube to tracker's boresight"] == [CUBE]
    rates = cards["Rates, stamps and single stars"]
    assert rates[:3] == [f"{name} | {text}" for name, text in FURTHER.items()]
    assert [line.split(" | ") for line in cards["By rate"][1:3]] == [
        ["0.125 to 0.25", "21", "1.5", "2.5", "3.5", "4.5"],
        ["0.25 to 2", "22", "5.5", "6.5", "7.5", "8.5"],
    ]
    by_magnitude = cards["By the field's magnitude"]
    assert by_magnitude[1] == "3.25 to 4.5 | 43 | 1.25 | 2.25 | 3.25 | 4.25"
    assert cards["All figures"][0] == f"{len(BUDGET_ROWS)} figures"
    assert len(cards["All figures"]) == len(BUDGET_ROWS) + 2
    assert cards["Notes"] == ["a note of a test"]


def test_the_drawing_over_time_has_each_right_answer_at_its_own_moment(written, made) -> None:
    panels = written[1][1].axes
    parts = made.found.components
    for k, axes in enumerate(panels):
        error, repeats = axes.get_lines()
        at_s = T_S[np.flatnonzero(VALID)[RIGHT]]
        assert error.get_xdata() == pytest.approx(at_s)
        whole = parts.fov.fitted[:, k] + parts.pixel.fitted[:, k] + parts.left[:, k]
        assert error.get_ydata() == pytest.approx(whole)
        assert repeats.get_xdata() == pytest.approx(at_s)
        assert repeats.get_ydata() == pytest.approx(parts.fov.fitted[:, k])
        (lost,) = axes.patches
        assert lost.get_extents().transformed(axes.transData.inverted()).intervalx == pytest.approx(
            [11.75, 13.0]
        )
        (wrong,) = axes.collections
        assert wrong.get_offsets().tolist() == [pytest.approx([11.016, page.WRONG_HEIGHT])]


def test_the_map_of_a_field_has_the_field_s_own_places_with_east_at_the_left(written, made) -> None:
    """The boresight went 0.7 degrees east and half a degree north: the field's middle went right,
    and down.
    """
    panels = [axes for axes in written[1][2].axes if axes.get_xlabel() == "star field x [px]"]
    for k, axes in enumerate(panels):
        (field,) = axes.collections
        x_px, y_px = np.asarray(field.get_offsets()).T
        east_px = 0.7 * np.cos(np.radians(1.0)) * PIXELS_OF_A_DEGREE
        assert x_px[-1] - x_px[0] == pytest.approx(east_px, rel=TANGENT)
        assert y_px[-1] - y_px[0] == pytest.approx(0.49 * PIXELS_OF_A_DEGREE, rel=0.02)
        assert axes.yaxis_inverted()
        fitted = made.found.components.fov.fitted[:, k]
        assert np.asarray(field.get_array()) == pytest.approx(fitted)
        assert field.get_clim() == pytest.approx((-np.abs(fitted).max(), np.abs(fitted).max()))
    assert len(panels) == 3


def test_noise_is_drawn_beside_the_normal_distribution_of_its_sigma(written, made) -> None:
    for k, (axes, sigma) in enumerate(zip(written[1][3].axes, (0.5, 1.0, 3.0), strict=True)):
        (normal,) = axes.get_lines()
        bars = axes.patches
        edges = [bar.get_x() for bar in bars] + [bars[-1].get_x() + bars[-1].get_width()]
        shares, _ = np.histogram(made.found.components.left[:, k], edges, density=True)
        assert [bar.get_height() for bar in bars] == pytest.approx(shares.tolist())
        height = 1 / (sigma * np.sqrt(2 * np.pi))
        assert max(normal.get_ydata()) == pytest.approx(height)
        at_sigma = np.interp(sigma, normal.get_xdata(), normal.get_ydata())
        assert at_sigma == pytest.approx(height * np.exp(-0.5), rel=0.01)
        area = sum(bar.get_width() * bar.get_height() for bar in axes.patches)
        assert area == pytest.approx(1.0)


def test_bars_of_the_parts_have_their_sizes_and_intervals(written) -> None:
    across, about = written[1][0].axes
    assert [bar.get_width() for bar in across.patches] == pytest.approx([5.0, 2.5, 0.75, 0.625])
    assert [bar.get_width() for bar in about.patches] == pytest.approx([11.0, 7.5, 1.25, 2.875])
    for axes, fov in ((across, [2.0, 3.25]), (about, [7.0, 8.5])):
        segments = axes.collections[0].get_segments()
        assert segments[1][:, 0] == pytest.approx(fov)
        assert axes.yaxis_inverted()
    title = " ".join(written[1][0].get_suptitle().split())
    assert title == "Across the boresight the bias is the largest: 5 arcsec"


def test_the_tables_have_every_figure_of_the_assessment(tmp_path: Path, made: Assessment) -> None:
    report.write_tables(tmp_path, made)
    budget = []
    for row in csv_rows(tmp_path / "budget.csv"):
        budget.append(",".join(cell.replace(",", ";") for cell in row.values()))
    assert budget == BUDGET_ROWS
    assert [list(row.values()) for row in csv_rows(tmp_path / "slices.csv")] == [
        ["rate_deg_s", "0.125", "0.25", "21", "1.5", "2.5", "3.5", "4.5"],
        ["rate_deg_s", "0.25", "2", "22", "5.5", "6.5", "7.5", "8.5"],
        ["field_v_mag", "3.25", "4.5", "43", "1.25", "2.25", "3.25", "4.25"],
    ]
    (wrong,) = csv_rows(tmp_path / "wrong.csv")
    assert wrong == {"row": "6", "t_s": "8.016", "run_s": "11.016000", "off_deg": "33.25"}
    outages = csv_rows(tmp_path / "outages.csv")
    assert [list(row.values()) for row in outages] == [
        ["10.500000", "0.625000", "0", "3", "1"],
        ["11.750000", "1.250000", "1", "5", "2"],
    ]


def test_the_lines_of_an_assessment_say_what_its_tables_hold(made: Assessment) -> None:
    assert report.lines_of(made) == [
        ("answers", ANSWERS),
        ("missed frames", MISSED),
        ("bias", "x -3.00, y 4.00, about the boresight -11.00 arcsec"),
        (
            "field-of-view error",
            "2.5 (2 to 3.25) across, 7.5 (7 to 8.5) arcsec about the boresight",
        ),
        ("pixel error", "0.75 (0.5 to 1) across, 1.25 (1 to 1.75) arcsec about the boresight"),
        ("noise", "0.625 (0.5 to 0.75) across, 2.88 (2.5 to 3.25) arcsec about the boresight"),
        ("clock", "offset 1.750 +- 0.1 ms, fast by 12.50 +- 2 ppm"),
        ("availability", "56.25 % of 16 answers due, one each 250 ms"),
        ("lock lost", "1 times"),
        ("acquisition", "67 %, median 0.312 s"),
        ("wrong", "1, on lines 6"),
        ("display's own error", DISPLAY.format("+-")),
        ("limit of its stars", LIMIT),
        *FURTHER.items(),
        ("bench's own error", OFF_BY),
        ("glass", GLASS),
        ("cube to boresight", CUBE),
    ]


def test_the_json_of_an_assessment_has_each_part_under_its_own_key(made: Assessment) -> None:
    told: Any = as_json(report.budget_of(made))
    assert told["bias_arcsec"] == [-3.0, 4.0, -11.0]
    assert told["fov_arcsec"] == {"cross": 2.5, "roll": 7.5}
    assert told["pixel_arcsec"] == {"cross": 0.75, "roll": 1.25}
    assert told["noise_arcsec"] == {"cross": 0.625, "roll": 2.875}
    assert told["clock"] == {"offset_ms": 1.75, "drift_ppm": 12.5, "sigma_ms": 0.1}
    assert told["availability"] == 0.5625
    assert told["wrong"] == [{"row": 6, "t_s": 8.016, "run_s": 11.016, "off_deg": 33.25}]
    assert told["missed"] == {"frames": 6, "answers_left_out": 1}
    assert told["out_of_order"] == 3
    assert told["limit_arcsec"] == {"cross": 0.3125, "roll": 1.0625}
    assert [(row["value"], row["low_95"], row["high_95"]) for row in told["further"]] == [
        (0.0125, 0.01, 0.016),
        (None, None, None),
        (0.0004, 0.0003, None),
        (0.02, 0.01, 0.03),
    ]
    assert [row["why"] for row in told["further"]] == ["", "too few turns", "", ""]
    assert told["glass"]["fov_arcsec"]["without_colour"] == {"cross": 3.5, "roll": 13.5}
    assert told["bench"] == {
        "certificate": "H20261126-0a1b2c3d",
        "off_arcsec": {"cross": 4.5, "roll": 10.0},
        "share_of_bias": {"cross": pytest.approx(0.9), "roll": pytest.approx(10 / 11)},
    }
    assert told["cube_to_boresight"]["roll_arcsec"] == 9.75


def with_clock(made: Assessment, **keys: Any) -> Assessment:
    clock: ClockFit = replace(made.found.clock, **keys)
    return replace(made, found=replace(made.found, clock=clock))


def test_a_clock_that_the_motion_does_not_tell_has_no_figures(made: Assessment) -> None:
    by_drift = with_clock(made, offset_told=False)
    assert dict(report.lines_of(by_drift))["clock"] == "offset unknown, fast by 12.50 +- 2 ppm"
    told: Any = as_json(report.budget_of(by_drift))
    assert told["clock"] == {"offset_ms": None, "drift_ppm": 12.5, "sigma_ms": 0.1}
    values = {row.quantity: row.value for row in report.rows_of(by_drift)}
    assert (values["clock offset"], values["clock drift"]) == (None, pytest.approx(12.5))
    card = page._clock(by_drift).html()
    assert DASH in card
    assert page.STILL_CURE in card
    by_offset = with_clock(made, drift_told=False)
    assert "cannot be told" in dict(report.lines_of(by_offset))["clock"]
    assert as_json(report.budget_of(by_offset))["clock"]["drift_ppm"] is None  # type: ignore[index]
    assert "1.75 \N{PLUS-MINUS SIGN} 0.10 ms" in page._clock(by_offset).html()


@pytest.mark.parametrize(
    ("right", "wrong", "lost", "missed", "state", "counts"),
    [
        (16, 0, 0, 0, OK, "no wrong answers, no lost locks, no missed frames."),
        (16, 0, 0, 1, WARN, "no wrong answers, no lost locks, 1 missed frame."),
        (15, 0, 0, 0, WARN, "no wrong answers, no lost locks, no missed frames."),
        (16, 1, 0, 0, BAD, "1 wrong answer, no lost locks, no missed frames."),
        (16, 2, 0, 0, BAD, "2 wrong answers, no lost locks, no missed frames."),
        (16, 0, 1, 0, BAD, "no wrong answers, 1 lost lock, no missed frames."),
    ],
)
def test_a_verdict_is_bad_by_wrong_answers_and_lost_locks_and_a_warning_by_the_rest(
    made: Assessment, right: int, wrong: int, lost: int, missed: int, state: str, counts: str
) -> None:
    run = made.run.run
    outages = made.lock.outages[1:] * lost
    shown = replace(
        made,
        lock=replace(made.lock, right=right, availability=right / 16, outages=outages),
        wrong=made.wrong * wrong,
        run=replace(made.run, run=CommandedRun(run.commanded, 0, 0, missed=missed)),
    )
    verdict = page.verdict_of(shown)
    share = {16: "100 %", 15: "93.8 %"}[right]
    assert verdict.state == state
    assert verdict.headline == f"The tracker was right in {share} of the answers due"
    assert verdict.words == counts
    tiles = figures_of(page._counts(shown))
    states = [OK if right == 16 else WARN, BAD if wrong else OK, BAD if lost else OK]
    states.append(WARN if missed else OK)
    assert [part.split('"')[0] for part in tiles.split('data-state="')[1:]] == states
    # a tile names one thing in the singular, as the sentence does
    for noun in counts.removesuffix(".").split(", "):
        assert noun.partition(" ")[2] in re.split(r"[<>,]", tiles)


@pytest.mark.parametrize(("wrong", "lost", "missed"), [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)])
def test_each_fault_of_the_answers_has_its_own_cure(
    made: Assessment, wrong: int, lost: int, missed: int
) -> None:
    shown = replace(
        made,
        wrong=made.wrong * wrong,
        lock=replace(made.lock, outages=made.lock.outages[1:] * lost),
        run=replace(made.run, run=CommandedRun(made.run.run.commanded, 0, 0, missed=missed)),
    )
    with drawn_figures():
        cure = page._answers(shown).cure
    assert cure == page.WRONG_CURE * wrong + page.LOST_CURE * lost + page.MISSED_CURE * missed


@pytest.mark.parametrize(
    ("sizes", "largest"),
    [((2.5, 0.75, 0.625), "bias"), ((9.0, 0.75, 0.5), "fov"), ((1.0, 7.5, 7.0), "pixel")],
)
def test_the_cure_of_a_budget_is_that_of_its_largest_part(
    made: Assessment, sizes: tuple[float, float, float], largest: str
) -> None:
    """Beside a bias of 5 arcsec across."""
    fov, pixel, noise = (Axes(size, 1.0) for size in sizes)
    parts = replace(made.found, fov_arcsec=fov, pixel_arcsec=pixel)
    with drawn_figures():
        card = page._budget(replace(made, found=parts, noise_arcsec=noise))
    assert card.cure == page.LARGEST_CURES[page.PARTS.get(largest, page.BIAS)]


def test_more_outages_and_wrong_answers_than_a_table_has_are_counted(made: Assessment) -> None:
    many = page.MAX_ROWS + 3
    shown = replace(
        made,
        wrong=made.wrong * many,
        lock=replace(made.lock, outages=made.lock.outages[:1] * (many + 1)),
    )
    (card,) = page._events(shown)
    lines = card_lines(card.html())["Wrong answers and outages"]
    counts = [f"{many} wrong answers", f"{many + 1} outages"]
    assert [line for line in lines if "|" not in line] == counts
    assert len(lines) == 2 * (2 + page.MAX_ROWS)


def test_a_run_over_much_of_the_sky_has_no_map(made: Assessment) -> None:
    """Places 150 degrees from each other: some are over 72 degrees from their middle."""
    apart = np.array([from_radec_roll_deg(ra_deg, 0.0, 0.0) for ra_deg in np.linspace(0, 150, 8)])
    wide = replace(made, found=replace(made.found, commanded_q=apart))
    picture, reason = page._field_map(wide)
    assert picture == ""
    assert reason.startswith("no map: the run goes over too much of the sky")


def test_what_is_beside_a_tracker_is_told_without_a_certificate_too(made: Assessment) -> None:
    card = page._beside(replace(made, certificate=None))
    names = [
        line.partition(" | ")[0] for line in card_lines(card.html())["What is not the tracker's"]
    ]
    assert names == ["display", "glass"]


def test_nearly_all_answers_are_not_all_of_them(made: Assessment) -> None:
    lock = replace(made.lock, due=100_000, right=99_999, availability=0.99999)
    headline = page.verdict_of(replace(made, lock=lock)).headline
    assert headline == "The tracker was right in 99.9 % of the answers due"


def test_what_is_not_known_is_said_in_words(made: Assessment) -> None:
    unknown = Axes(None, None)
    bare = replace(
        made,
        found=replace(made.found, fov_arcsec=unknown),
        noise_arcsec=Axes(None, 1.0),
        display=None,
        limit_arcsec=Axes(0.5, None),
        glass=None,
        certificate=None,
        cube=None,
        out_of_order=0,
        wrong=(),
        lock=replace(made.lock, acquisitions=(Acquisition(10.0, None),), outages=()),
        run=replace(a_run(), run=CommandedRun(made.run.commanded, 0, 0)),
    )
    lines = dict(report.lines_of(bare))
    assert lines["field-of-view error"] == lines["noise"] == "cannot be told"
    assert lines["answers"] == "8 right of 10 valid and 12 rows"
    assert lines["acquisition"] == "0 %, median - s"
    assert (lines["wrong"], lines["missed frames"]) == ("none", "none")
    assert lines["display's own error"] == "not looked at"
    assert lines["limit of its stars"] == "not known"
    assert not {"glass", "bench's own error", "cube to boresight"} & set(lines)
    told = report.budget_of(bare)
    assert not {"glass", "bench", "cube_to_boresight"} & set(told)
    assert list(page._events(bare)) == []
    assert DASH in page._across(unknown, made.found.intervals.fov).html()
    assert page._about(unknown, made.found.intervals.fov) == []
    never = replace(made, lock=replace(made.lock, acquisitions=()))
    assert dict(report.lines_of(never))["acquisition"] == "-"


def test_wrong_answers_are_named_up_to_ten_by_line_or_by_number(made: Assessment) -> None:
    many = tuple(WrongAnswer(row, 1.0, 2.0, 3.0) for row in range(3, 14))
    by_line = dict(report.lines_of(replace(made, wrong=many)))["wrong"]
    assert by_line == "11, on lines 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, ..."
    telemetry = replace(made.telemetry, of_lines=False)
    by_number = replace(made, wrong=many[:10], telemetry=telemetry)
    assert dict(report.lines_of(by_number))["wrong"].startswith("10, attitudes 3, 4,")
    assert not dict(report.lines_of(by_number))["wrong"].endswith("...")


def test_a_display_s_error_that_noise_hides_has_no_share(made: Assessment) -> None:
    assert made.display is not None
    hidden = report.display_text(replace(made.display, sigma_seen=0.51))
    assert hidden.endswith("; it is too small beside the noise to be found in the answers")
    assert "50 %" in report.display_text(replace(made.display, sigma_seen=0.5))


def test_a_bench_could_have_made_no_more_than_all_of_a_bias(made: Assessment) -> None:
    found = replace(made.found, bias_arcsec=np.array([3.0, 0.0, 0.0]))
    part = report.bench_part(a_certificate(), found)
    assert part["share_of_bias"] == {"cross": 1.0, "roll": 1.0}
    off = [each for each in a_certificate().figures if each.quantity != "attitude_z"]
    unassessed = report.bench_part(a_certificate(figures=off), found)
    assert unassessed["off_arcsec"] is unassessed["share_of_bias"] is None


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (FigureRow("bias", "x", -3.0, "arcsec"), ["x", "-3 arcsec"]),
        (FigureRow("bias", "z", 4.0, "arcsec"), ["about the boresight", "4 arcsec"]),
        (FigureRow("noise", "cross", 2.0, "px", 1.0, 3.0), ["across", "2.0 (1.0 to 3.0) px"]),
        (FigureRow("noise", "roll", 0.5, "s"), ["about the boresight", "0.5 s"]),
        (FigureRow("answers due", "", 16), ["16"]),
        (FigureRow("availability", "", 0.5625), ["56.25 %"]),
        (FigureRow("rate scale", "", 0.02, "1", 0.01, 0.03), ["2.0 (1.0 to 3.0) %"]),
        (FigureRow("share seen", "", 0.12345678), ["12.35 %"]),
        (FigureRow("acquisition probability", "", 1.0), ["100 %"]),
    ],
)
def test_a_figure_stands_under_its_axis_in_words_and_a_share_in_percent(
    row: FigureRow, words: list[str]
) -> None:
    cells = re.findall("<td>(.*?)</td>", figures_table([row]))
    assert cells[1:] == words
