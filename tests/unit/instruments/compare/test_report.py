"""What `hilstar compare` says of stars that are planted: its sentence, its JSON, its table, its
page and its chart.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.pages import DASH, OK, WARN
from hilstar.instruments.compare import report
from hilstar.instruments.compare.report import (
    MAX_LISTED,
    MIN_ERROR,
    ChartPanel,
    draw,
    write_report,
)
from hilstar.instruments.compare.sky_comparison import (
    CommonChange,
    Limits,
    SkyComparison,
    StarDifference,
    finding,
    star_lines,
)
from tests.support.card_texts import BAND, card_lines
from tests.support.tables import csv_rows

LIMITS = Limits(0.01, 0.02)
OWN = Limits(0.5, 0.02)  # of a star beside a brighter one
SAME = StarDifference((71,), 10.0, 20.0, 1000.0, 0.004, 0.006, -0.008, LIMITS)
FAINTER = StarDifference((72, "Mars"), 50.0, 30.0, 100.0, 0.3, 0.0, 0.0, LIMITS)
MOVED = StarDifference((), 80.5, 15.25, 10.0, -0.002, -0.3, 0.4, LIMITS)
BESIDE = StarDifference((74,), 12.0, 21.0, 5.0, 0.4, 0.0, 0.012, OWN)
GONE = StarDifference((75,), 90.0, 60.0, 200.0, math.inf, 0.0, 0.0, LIMITS)
NEW = StarDifference((), 33.0, 44.0, 400.0, -math.inf, 0.0, 0.0, LIMITS)
STARS = [SAME, FAINTER, MOVED, BESIDE, GONE, NEW]
MAGS = [0.0, 2.5, 5.0, -2.5 * math.log10(5 / 1000)]  # below the brightest: of those in both


def comparison(stars=STARS, common=None) -> SkyComparison:
    return SkyComparison(list(stars), LIMITS, 3, common)


def test_stars_are_sorted_by_what_became_of_them():
    found = comparison()
    assert [star.kind for star in STARS] == [
        "same",
        "changed",
        "changed",
        "same",
        "missing",
        "extra",
    ]
    assert (found.star_count, found.widened, found.same) == (5, 1, False)
    # infinitely far off are those of one image, the brightest first; then 30 limits, then 25
    assert found.bad == [NEW, GONE, FAINTER, MOVED]
    assert MOVED.error_over_limit == pytest.approx(0.5 / 0.02)
    assert repr(found) == "<hilstar comparison: NOT the same sky, 4 of 5 stars>"
    fine = comparison([SAME, BESIDE])
    assert fine.same and fine.bad == []
    assert repr(fine) == "<hilstar comparison: the same sky, 2 stars>"


def test_the_json_has_each_figure():
    summary = comparison().summary()
    errors_mag = np.array([0.004, 0.3, 0.002, 0.4])
    errors_px = np.array([0.01, 0.0, 0.5, 0.012])
    for name, errors in (("flux_error_mag", errors_mag), ("centroid_error_px", errors_px)):
        assert summary[name] == {
            "rms": pytest.approx(math.sqrt((errors**2).mean())),
            "p95": pytest.approx(np.percentile(errors, 95)),
            "max": pytest.approx(errors.max()),
        }
    counts = ("stars", "missing", "extra", "blends", "widened", "unmeasured")
    assert [summary[name] for name in counts] == [5, 1, 1, 1, 1, 3]
    assert summary["limits"] == {"flux_mag": 0.01, "centroid_px": 0.02}
    assert (summary["same"], summary["common"], summary["channels"]) == (False, None, {})
    third = summary["bad"][2]
    assert third == {
        "kind": "changed",
        "hip": (72, "Mars"),
        "x_px": 50.0,
        "y_px": 30.0,
        "flux_e_per_s": 100.0,
        "flux_error_mag": 0.3,
        "dx_px": 0.0,
        "dy_px": 0.0,
    }
    whole = replace(comparison(), channels={"r": comparison([SAME]), "b": comparison()})
    channels = whole.summary()["channels"]
    assert list(channels) == ["r", "b"]
    assert channels["b"]["missing"] == 1
    assert set(channels["r"]) == {
        *("stars", "flux_error_mag", "centroid_error_px", "missing", "extra", "same")
    }


@pytest.mark.parametrize(
    ("star", "line"),
    [
        (
            FAINTER,
            "HIP 72 + Mars at (50.00, 30.00) px: +0.3000 mag, 0.0000 px (+0.0000, +0.0000) off",
        ),
        (MOVED, "star at (80.5, 15.2): -0.0020 mag, 0.5000 px (-0.3000, +0.4000) off"),
        (GONE, "HIP 75 at (90.00, 60.00) px: missing, 200 electrons/s"),
        (NEW, "star at (33.0, 44.0): extra, 400 electrons/s"),
    ],
)
def test_a_star_s_line_says_how_far_it_is_off(star, line):
    assert star.line() == line


def test_the_sentence_counts_what_differs_and_names_the_worst():
    assert finding(comparison()) == (
        f"Not the same sky: of 5 stars 2 changed, 1 missing, 1 extra; the worst is {NEW.line()}"
    )
    assert finding(comparison([SAME, BESIDE])) == (
        "The same sky: 2 stars, at most 0.4 mag and 0.012 px off"
    )
    channels = {"r": comparison([SAME]), "b": comparison([SAME, GONE])}
    by_channel = replace(comparison([SAME]), channels=channels)
    assert finding(by_channel).startswith("In channel b: Not the same sky: of 2 stars 1 missing")
    assert star_lines(by_channel, 20, "") == [GONE.line()]
    assert star_lines(comparison(), 2, " in the table") == [
        NEW.line(),
        GONE.line(),
        "and 2 more in the table",
    ]
    assert star_lines(comparison(), 4, "") == [star.line() for star in (NEW, GONE, FAINTER, MOVED)]


COMMON = CommonChange(
    shift_px=(1.25, -0.5),
    rotation_deg=-0.02,
    scale_error=0.003,
    flux_mag=-0.0456,
    beyond=[SAME, FAINTER],
    alone=[GONE],
)


def test_what_is_common_is_said_first_and_what_differs_beyond_it_is_counted():
    text = (
        "all shifted by (1.25, -0.50) px, turned by -0.0200 deg, scaled by +0.3000%, brighter by"
        " 0.0456 mag; 2 stars differ from that"
    )
    assert COMMON.line() == text
    small = replace(COMMON, shift_px=(0.03, 0.04), rotation_deg=0.0, scale_error=0.0, flux_mag=0.2)
    assert small.line() == (
        "all shifted by (0.0300, 0.0400) px, dimmer by 0.20 mag; 2 stars differ from that"
    )
    assert replace(small, alone=[]).line().endswith("; 1 star differs from that")
    assert COMMON.summary() == {
        "shift_px": (1.25, -0.5),
        "rotation_deg": -0.02,
        "scale_error": 0.003,
        "flux_mag": -0.0456,
        "stars": 1,
        "differ": 2,
    }
    found = comparison(common=COMMON)
    assert found.differing == [GONE, FAINTER]
    assert finding(found) == f"Not the same sky: {text}; the worst is {GONE.line()}"


def test_the_table_and_the_page_have_each_star(tmp_path, figures):
    write_report(tmp_path, comparison())
    rows = csv_rows(tmp_path / "compare.csv")
    assert [row["kind"] for row in rows] == [star.kind for star in STARS]
    assert [row["hip"] for row in rows] == ["71", "72 Mars", "", "74", "75", ""]
    assert [row["differs"] for row in rows] == ["0", "1", "1", "0", "1", "1"]
    for row, star in zip(rows, STARS, strict=True):
        assert (float(row["x_px"]), float(row["y_px"])) == (star.x_px, star.y_px)
        assert float(row["flux_e_per_s"]) == star.flux_e_per_s
        assert float(row["flux_error_mag"]) == star.flux_error_mag
        assert (float(row["dx_px"]), float(row["dy_px"])) == (star.dx_px, star.dy_px)
        assert float(row["centroid_error_px"]) == pytest.approx(math.hypot(star.dx_px, star.dy_px))
        assert float(row["flux_limit_mag"]) == star.limits.flux_mag
        assert float(row["centroid_limit_px"]) == star.limits.centroid_px
    page = (tmp_path / "compare.html").read_text()
    assert "Not the same sky" in page and "4 stars that differ, the worst first" in page
    for star in (NEW, GONE, FAINTER, MOVED):
        assert star.line() in page
    # 95 % of 0.002, 0.004, 0.3 and 0.4 mag, and of 0, 0.01, 0.012 and 0.5 px
    assert card_lines(page)[BAND] == [
        "Two skies compared",
        "Not the same sky",
        finding(comparison()).removeprefix("Not the same sky: ").capitalize(),
        "5",
        "stars compared",
        "0.39 mag",
        "flux error at 95 %; limit 0.01 mag",
        "0.43 px",
        "place error at 95 %; limit 0.02 px",
        "1",
        "missing stars",
        "1",
        "extra stars",
    ]
    assert "In common" not in page
    write_report(tmp_path, comparison([SAME, BESIDE]))
    assert "The same sky" in (tmp_path / "compare.html").read_text()
    write_report(tmp_path, comparison(common=COMMON))
    rows = csv_rows(tmp_path / "compare.csv")
    assert [row["differs"] for row in rows] == ["0", "1", "0", "0", "1", "0"]
    page = (tmp_path / "compare.html").read_text()
    assert "In common" in page and "turned by -0.0200 deg" in page
    assert "2 stars that differ" in page


def test_the_chart_has_each_star_at_its_magnitude_and_error(tmp_path, figures):
    draw(tmp_path / "compare", comparison())
    flux_axes, place_axes = figures[0].axes
    drawn = {line.get_label().split(":")[0]: line for line in flux_axes.get_lines()}
    assert drawn["same"].get_xydata().tolist() == [[MAGS[0], 0.004], [pytest.approx(MAGS[3]), 0.4]]
    assert drawn["changed"].get_xydata().tolist() == [[MAGS[1], 0.3], [MAGS[2], 0.002]]
    # four times the largest of limits and errors, which is a star's own limit; extra ones above
    assert drawn["missing"].get_ydata().tolist() == [pytest.approx(4 * 0.5)]
    assert drawn["extra"].get_ydata().tolist() == [pytest.approx(32 * 0.5)]
    assert drawn["missing"].get_xdata().tolist() == [pytest.approx(2.5 * math.log10(5))]
    assert drawn["limit"].get_ydata()[0] == 0.01
    own = drawn["a star's own limit"].get_xydata().tolist()
    assert own == [[pytest.approx(MAGS[3]), 0.5]]
    names = [text.get_text() for text in flux_axes.texts]
    assert names == ["(33, 44)", "HIP 75", "HIP 72 + Mars"]
    places = {line.get_label().split(":")[0]: line for line in place_axes.get_lines()}
    assert places["same"].get_ydata().tolist() == [pytest.approx(0.01), pytest.approx(0.012)]
    assert places["changed"].get_ydata().tolist() == [MIN_ERROR, 0.5]
    assert places["limit"].get_ydata()[0] == 0.02
    assert [text.get_text() for text in place_axes.texts] == ["(80, 15)"]


def test_a_panel_with_what_is_common_has_its_stars_beyond_that():
    panel = ChartPanel(comparison(common=COMMON), "px")
    assert panel.common == pytest.approx(math.hypot(1.25, 0.5))
    assert panel.stars == [SAME, FAINTER, GONE]
    assert panel.row == pytest.approx(4 * panel.common)
    light = ChartPanel(comparison(common=COMMON), "mag")
    assert (light.common, light.limit) == (0.0456, 0.01)
    assert light.label("extra", 0) == "extra: 1\n(1 by what is common)"
    assert light.label("missing", 1) == "missing: 1"


def test_a_kind_of_stars_of_one_image_alone_is_marked_where_there_are_any():
    for stars, states in (([SAME, GONE, GONE], [WARN, OK]), ([SAME, NEW], [OK, WARN])):
        *_, missing, extra = report._figures(comparison(stars))
        assert [missing.state, extra.state] == states
    # with no star in both there is no error
    texts = [figure.text for figure in report._figures(comparison([GONE]))]
    assert texts == ["1", DASH, DASH, "1", "0"]


@pytest.mark.parametrize("more", [0, 1, 7])
def test_the_page_lists_forty_stars_and_counts_those_beyond(monkeypatch, more):
    monkeypatch.setattr(report, "drawing_of", lambda figure, words: "")
    count = MAX_LISTED + more
    stars = [replace(FAINTER, hip=(k,), flux_error_mag=1.0 + k) for k in range(count)]
    *_, last = report._cards(comparison(stars), None)
    page = last.html()
    assert f"{count} stars that differ, the worst first" in page
    assert page.count(" mag, ") == MAX_LISTED
    assert (f"{more} more in compare.csv." in page) == (more > 0)
    assert ("more in compare.csv" in page) == (more > 0)
