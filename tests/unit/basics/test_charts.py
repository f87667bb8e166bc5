"""Charts: their files, their colours on light and dark pages, their ticks and the names of lines."""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import dataclass

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from hilstar.basics import charts
from tests.support.figures import two_lines
from tests.support.pictures import assert_drawn


@dataclass(frozen=True)
class Record:
    """A row of a table."""

    name: str
    error_px: float


def test_a_table_of_records_has_a_column_a_field_and_a_row_a_record(tmp_path):
    charts.write_records(tmp_path / "t.csv", [Record("a, b", 0.5), Record("c", 1e-9)])
    assert (tmp_path / "t.csv").read_text() == 'name,error_px\n"a, b",0.5\nc,1e-09\n'


def test_a_chart_is_written_for_light_and_dark_pages(tmp_path):
    charts.save(two_lines(), tmp_path / "lines")
    text = (tmp_path / "lines.svg").read_text()
    light, dark = text.split("prefers-color-scheme: dark", 1)[0], text
    used = set(re.findall(r"(?:fill|stroke): (#[0-9a-f]{6})", text.split("</style>", 1)[1]))
    assert {charts.BLUE, charts.ORANGE, charts.INK, charts.PAPER} <= used <= set(charts.DARK)
    for colour in used:
        assert f'[style*="fill: {colour}"]{{fill:{charts.DARK[colour]}!important}}' in dark
        assert charts.DARK[colour] not in light
    assert "<dc:date>" not in text
    charts.save(two_lines(), tmp_path / "lines.svg")
    assert (tmp_path / "lines.svg").read_text() == text
    assert_drawn(tmp_path / "lines.png")


def test_what_a_matplotlibrc_or_another_library_sets_changes_no_chart(tmp_path):
    """Basilisk sets `figure.autolayout`, with which a figure that has a colour bar is an error."""

    def files(name: str) -> list[bytes]:
        with charts.chart(tmp_path / name, "A finding") as (axes,):
            dots = axes.scatter([0.0, 1.0], [0.0, 2.0], c=[0.0, 1.0])
            axes.figure.colorbar(dots, ax=axes, label="sigma [px]")
        return [(tmp_path / f"{name}{ending}").read_bytes() for ending in charts.ENDINGS]

    own = files("own")
    foreign = {"figure.autolayout": True, "savefig.bbox": "tight", "font.family": "serif"}
    with matplotlib.rc_context(foreign):
        assert files("foreign") == own
        assert matplotlib.rcParams["figure.autolayout"]


@pytest.mark.parametrize("paper", [charts.PAPER, charts.DARK[charts.PAPER]])
def test_colours_stand_out_on_both_pages(paper):
    """WCAG's contrast: 4.5 of text, which every colour may be."""

    def light(colour: str) -> float:
        parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
        return sum(
            w * (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4)
            for w, c in zip((0.2126, 0.7152, 0.0722), parts, strict=True)
        )

    for each, dark in charts.DARK.items():
        if each not in (charts.GRID, charts.PAPER):
            pair = sorted((light(each if paper == charts.PAPER else dark), light(paper)))
            assert (pair[1] + 0.05) / (pair[0] + 0.05) >= 4.5, (each, paper)


@pytest.mark.parametrize(
    ("limits", "ticks"),
    [
        ((0.3, 21), [0.5, 1, 2, 5, 10, 20]),
        ((0.03, 2000), [0.1, 1, 10, 100, 1000]),
        ((0.0009, 0.7), [0.001, 0.003, 0.01, 0.03, 0.1, 0.3]),
        ((0.026, 0.14), [0.03, 0.04, 0.05, 0.07, 0.1]),
        ((1e-13, 10), [1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2, 1]),
        ((1e-22, 10), [1e-21, 1e-18, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3, 1]),
    ],
)
def test_ticks_are_round_and_names_at_the_side_keep_apart(limits, ticks):
    axes = Figure().subplots()
    axes.set(xscale="log", xlim=limits)
    charts.log_ticks(axes.xaxis, 9)
    assert axes.get_xticks() == pytest.approx(ticks)
    heights = charts.spread([0.9, 0.9, 0.89, 0.02, 0.01, 0.0], 0.05)
    assert min(a - b for a, b in itertools.pairwise(heights)) == pytest.approx(0.05)
    assert heights[-1] >= 0 and heights[0] <= 1


def test_a_finding_is_a_title_with_its_own_signs():
    finding = "the star is 1 +- 2 px off, and 3 +- 4 mag bright"
    with charts.panels_of(finding) as (axes,):
        axes.plot([0, 1], [0, 1])
    title = axes.figure.get_suptitle().replace("\N{NO-BREAK SPACE}", " ")
    assert title.replace("\N{PLUS-MINUS SIGN}", "+-") == finding.capitalize()
    assert "+-" not in title


def test_figures_of_an_axis_are_a_persons():
    assert [charts.plain(v) for v in (3000, 0.5, 0.0001, 1e-5, 3e-6, 2e6, 0)] == [
        *("3000", "0.5", "0.0001", "10⁻⁵", "3·10⁻⁶", "2·10⁶", "0")
    ]
    assert [charts.plain(v) for v in (-3000, -0.0001, -3e-6, -2e6)] == [
        *("-3000", "-0.0001", "-3·10⁻⁶", "-2·10⁶")
    ]
    assert [charts.capital(text) for text in ("rate [Hz]", "x [px]", "V [mag]")] == [
        "Rate [Hz]",
        "x [px]",
        "V [mag]",
    ]


@pytest.mark.parametrize(
    ("x", "y", "end"),
    [
        ([1, 2, 3], [4, 5, math.nan], (2, 5)),
        ([1, 2, 3], [4, 5, math.inf], (2, 5)),
        ([3, 2, 1], [4, 5, 6], (3, 4)),
        ([1, 2, 9], [4, 5, 6], (2, 5)),
    ],
    ids=["no value", "infinite", "falling", "beyond the axis"],
)
def test_a_line_is_named_at_its_last_place_that_is_in_view(x, y, end):
    with charts.panels_of("A line") as (axes,):
        axes.plot(x, y, label="speed")
        axes.set(xlim=(0, 4), ylim=(0, 10))
        charts.label_ends(axes)
    (name,) = axes.texts
    assert (name.get_text(), name.xy) == ("speed", end)
    assert name.xyann[1] == pytest.approx(end[1] / 10)


def test_names_at_the_side_stand_in_the_order_of_their_lines():
    """Three of five lines end nearly at one height: their names are moved apart, none past
    another.
    """
    ends = {"e": 0.1, "b": 0.50, "a": 0.51, "d": 0.52, "c": 0.9}
    with charts.panels_of("Five lines") as (axes,):
        for name, end in ends.items():
            axes.plot([0, 1], [0.5, end], label=name)
        axes.set(xlim=(0, 1), ylim=(0, 1))
        charts.label_ends(axes)
    heights = {text.get_text(): text.xyann[1] for text in axes.texts}
    assert sorted(heights, key=heights.__getitem__) == sorted(ends, key=ends.__getitem__)
    assert (np.diff(sorted(heights.values())) > 0.01).all()
    assert heights["e"] == pytest.approx(0.1)


def test_names_that_fill_a_panel_begin_at_its_foot():
    assert charts.spread([0.3, 0.1, 0.05], 0.2) == pytest.approx([0.4, 0.2, 0.0])
    assert charts.spread([1.5, 0.9], 0.2) == pytest.approx([1.0, 0.8])


@pytest.mark.parametrize(
    ("value", "text"), [(1e6, "10⁶"), (999_000, "10⁶"), (1.24e-5, "1.2·10⁻⁵"), (math.inf, "-")]
)
def test_a_measured_figure_has_two_digits(value, text):
    assert charts.two_digits(value) == text


def test_a_key_of_a_file_keeps_its_letters():
    texts = ("tracker.aperture_mm", "drift_ms of a day", "a drift", "drift", "x")
    assert [charts.capital(text) for text in texts] == [
        "tracker.aperture_mm",
        "drift_ms of a day",
        "A drift",
        "Drift",
        "x",
    ]


@pytest.mark.parametrize("unit", ["%", "mag", "px", "s", "arcsec", "deg/s"])
def test_a_title_is_of_even_lines_and_parts_no_figure_from_its_unit(unit):
    lines = charts.title_lines(f"the error of a star is on the whole below 0.25 {unit} or so", 46)
    first, second = lines.split("\n")
    assert abs(len(first) - len(second)) < 12
    assert f"0.25\N{NO-BREAK SPACE}{unit}" in lines
    assert charts.title_lines("1.234e-05 of it") == "1.2·10⁻⁵ of it"


def test_a_path_without_an_ending_keeps_what_looks_like_one(tmp_path, monkeypatch):
    monkeypatch.setattr(charts, "png", lambda figure: b"png")
    monkeypatch.setattr(charts, "svg", lambda figure: "svg")
    charts.save(Figure(), tmp_path / "run.0001")
    charts.save(Figure(), tmp_path / "one.svg")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "one.svg",
        "run.0001.png",
        "run.0001.svg",
    ]


def test_a_name_that_was_moved_from_its_line_s_end_is_joined_to_it():
    with charts.panels_of("Three lines") as (axes,):
        for name, end in (("high", 0.9), ("upper", 0.5), ("lower", 0.499)):
            axes.plot([0, 1], [0.5, end], label=name)
        axes.plot([0, 0.5], [0.1, 0.1], label="short")
        axes.set(xlim=(0, 1), ylim=(0, 1))
        charts.label_ends(axes)
    joined = {text.get_text(): text.arrow_patch is not None for text in axes.texts}
    assert joined == {"high": False, "upper": False, "lower": True, "short": True}
