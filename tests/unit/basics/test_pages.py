"""The builder of pages: landmarks, verdicts, figures with their uncertainty, tables, themes."""

from __future__ import annotations

import math
import re

import pytest

from hilstar.basics.pages import (
    BAD,
    OK,
    Card,
    KeyFigure,
    Markup,
    Verdict,
    details_of,
    escaped,
    figures_of,
    key_table,
    key_words,
    keyed_rows,
    measured,
    page_of,
    page_style,
    side_by_side,
    split_key,
    table_of,
    value_text,
    within,
)
from hilstar.basics.palette import colours_of

PLUS_MINUS = "\N{PLUS-MINUS SIGN}"


def cell_texts(table: str) -> list[list[str]]:
    """The texts of a table's cells."""
    rows = re.findall("<tr>(.*?)</tr>", table)
    return [re.findall("<t[hd][^>]*>(.*?)</t[hd]>", row) for row in rows]


def test_a_page_has_its_verdict_first_in_its_only_main_landmark() -> None:
    card = Card("Noise", KeyFigure("1.0 arcsec", "one sigma"), words=["<p>words</p>"])
    page = page_of("a < b", Verdict(BAD, "Not ready", "x & y"), [card.html()], "go();").decode()
    assert page.count("<main>") == page.count("</main>") == page.count("<h1>") == 1
    assert "<title>a &lt; b</title>" in page
    main = page[page.index("<main>") : page.index("</main>")]
    places = [main.index(each) for each in ("<h1>", 'data-state="bad"', "<h2>Noise</h2>")]
    assert places == sorted(places)
    assert "x &amp; y" in main
    assert "<script>go();</script>" not in main
    assert page.endswith("<script>go();</script>\n</body></html>\n")


def test_a_card_says_what_to_do_and_folds_its_details() -> None:
    plain = Card("Focus").html()
    assert "What to do" not in plain and "<details" not in plain and "pictured" not in plain
    card = Card(
        "Focus",
        picture="<figure></figure>",
        cure="Turn the lens.",
        details=["<p>more</p>"],
        chip="failed",
        state=BAD,
        anchor="focus",
    ).html()
    assert '<section class="card pictured" id="focus">' in card
    assert "<b>What to do:</b> Turn the lens." in card
    assert "<details><summary>Details</summary><p>more</p></details>" in card
    assert 'data-state="bad"><h2>Focus</h2><span class="chip">failed</span>' in card
    assert '<details class="printed">' in details_of("Events", "<p>1</p>", printed=True)


@pytest.mark.parametrize(
    ("value", "error", "unit", "text"),
    [
        (1.23456, 0.0123, "px", f"1.235 {PLUS_MINUS} 0.012 px"),
        (-130.89, 108.63, "%", f"-130 {PLUS_MINUS} 110 %"),
        (12345.6, 12.3, "", f"12\u202f346 {PLUS_MINUS} 12"),
        (-0.0004, 0.5, "ms", f"0.00 {PLUS_MINUS} 0.50 ms"),
        (3.14159, None, "s", "3.142 s"),
        (3.14159, float("nan"), "s", "3.142 s"),
    ],
)
def test_a_figure_has_two_digits_of_its_uncertainty(value, error, unit, text) -> None:
    assert measured(value, error, unit) == text


def test_an_interval_has_two_digits_of_its_half_width() -> None:
    assert within(1.6471, 1.4043, 1.8941, "arcsec") == "1.65 (1.40 to 1.89) arcsec"
    assert within(2.0, 2.0, 2.0) == "2"


def test_a_table_leaves_out_columns_without_a_value_and_writes_no_dashes() -> None:
    rows = [("flux", 1.23456, None, ""), ("place", 7, None, "")]
    table = table_of(rows, ("quantity", "value", "limit", "verdict"))
    assert cell_texts(table) == [["quantity", "value"], ["flux", "1.235"], ["place", "7"]]
    assert '<th scope="col">' in table
    some = table_of([("flux", None), ("place", 0.1)], ("quantity", "limit"))
    assert cell_texts(some)[1:] == [["flux", ""], ["place", "0.1"]]
    assert cell_texts(table_of([("a", None)])) == [["a", ""]]  # without a header, all of it


def test_a_cell_with_an_uncertainty_stands_with_the_numbers_and_a_sentence_does_not() -> None:
    table = table_of([("1.0 +- 0.1 px", Markup("<b>x</b>"), f"{'word ' * 9}+- 1")])
    assert f'<td class="n">1.0 {PLUS_MINUS} 0.1 px</td><td><b>x</b></td><td>word' in table


def test_text_is_escaped_and_an_uncertainty_has_its_sign() -> None:
    assert escaped("<b> 3 +- 1") == f"&lt;b&gt; 3 {PLUS_MINUS} 1"
    assert escaped(Markup("<b>")) == "<b>"


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("drift_error_percent_per_h", "drift error, %/h"),
        ("panel_delay_ms", "panel delay, ms"),
        ("bits", "bits"),
        ("max_cd_m2", "max, cd/m\N{SUPERSCRIPT TWO}"),
    ],
)
def test_a_key_reads_as_words_and_a_unit(key, words) -> None:
    assert key_words(key) == words


def test_figures_by_key_have_their_error_and_unit_beside_them() -> None:
    figures = {
        "psf_sigma_px": 0.5529870059,
        "psf_sigma_error_px": 0.0056648,
        "flux_at_white_e_per_s": 3148199.07,
        "noise": 3.64e-5,
        "dots": 12208,
        "resolution_px": [1920, 1080],
        "q_cam_to_mon": (1.0, 0.0, 2e-05, 0.0),
        "error_mag": 0.25,  # of nothing that is named
        "stable": "yes",
        "identity": {},
        "geometry": None,
    }
    assert keyed_rows(figures) == [
        ("PSF sigma", f"0.5530 {PLUS_MINUS} 0.0057 px"),
        ("flux at white", "3\u202f148\u202f000 e-/s"),
        ("noise", "3.6\N{MIDDLE DOT}10\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT FIVE}"),
        ("dots", "12\u202f208"),
        ("resolution", "1920 \N{MULTIPLICATION SIGN} 1080 px"),
        (
            "quaternion cam to mon",
            "1, 0, 2\N{MIDDLE DOT}10\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT FIVE}, 0",
        ),
        ("error", "0.25 mag"),
        ("stable", "yes"),
    ]
    assert key_table([("a", "<b>")]).count('<th scope="row">a</th><td>&lt;b&gt;</td>') == 1


def test_cards_without_pictures_stand_side_by_side() -> None:
    pair = side_by_side([Card("Bias"), Card("Clock")])
    assert pair.startswith('<div class="pair"><section class="card">')
    assert pair.count("<h2>") == 2


def test_figures_have_their_state() -> None:
    tiles = figures_of([KeyFigure("0", "wrong answers", OK), KeyFigure("3", "lost locks", BAD)])
    assert re.findall('data-state="(.*?)">(.)', tiles) == [("ok", "0"), ("bad", "3")]


def test_a_page_is_light_on_paper_whatever_the_reader_prefers() -> None:
    style = page_style()
    root, rest = style.split("\n", 1)
    assert all(f"--{name}: {colour};" in root for name, colour in colours_of("light").items())
    dark = f"--ground: {colours_of('dark')['ground']};"
    at = rest.index(dark)
    assert rest.rindex("@media", 0, at) == rest.index(
        "@media screen and (prefers-color-scheme: dark)"
    )
    assert rest.count(dark) == 1
    assert "@media print { :root { color-scheme: light } }" in style


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (12345.678, "12\u202f350"),
        (12345, "12\u202f345"),
        (1e15, "1\u202f000\u202f000\u202f000\u202f000\u202f000"),
        (0.00023456, "0.0002346"),
        (-0.00002, "-2\N{MIDDLE DOT}10\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT FIVE}"),
        (False, "False"),
        ([1, 2, 3], "1, 2, 3"),
        ({"a_b": 1.5, "p95": (2, 3)}, "a b 1.5; at 95 % 2 \N{MULTIPLICATION SIGN} 3"),
        (math.inf, "inf"),
    ],
)
def test_a_value_is_written_as_a_person_does(value, text) -> None:
    assert value_text(value) == text


def test_what_is_false_or_none_at_all_has_its_row_and_what_is_empty_has_none() -> None:
    figures = {"lit": False, "dots": 0, "list": [], "words": "", "offset_error_s": 0.1}
    assert [name for name, _ in keyed_rows(figures)] == ["lit", "dots", "list", "offset error"]


def test_the_longest_ending_of_a_key_is_its_unit() -> None:
    assert [split_key(key) for key in ("dark_e_per_s", "turn_deg_s", "wait_s", "x_error_deg")] == [
        ("dark", "_e_per_s"),
        ("turn", "_deg_s"),
        ("wait", "_s"),
        ("x_error", "_deg"),
    ]


def test_a_row_may_be_short_and_a_column_of_empty_texts_is_left_out() -> None:
    rows = [("a", "", 1), ("b", "")]
    assert cell_texts(table_of(rows, ("name", "none"))) == [["name"], ["a"], ["b"]]
    assert cell_texts(table_of(rows)) == [["a", "", "1"], ["b", ""]]


def test_a_card_s_anchor_is_text() -> None:
    assert 'id="a&quot;b"' in Card("Title", anchor='a"b').html()
