"""What a user reads of a certificate whose figures all differ: its page, drawings and lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from hilstar.basics.pages import BAD, OK, PLAIN
from hilstar.instruments.certify import page
from hilstar.server.bench.certificate_file import CubeToBoresight
from tests.support.card_texts import BAND, card_lines, drawn_figures
from tests.support.certificates import BY_CLOCK, a_certificate, a_figure

DIGEST = "d" * 64
PM = "\N{PLUS-MINUS SIGN}"
# rms of half widths 0.02, 0.1 and 0.04 of three stars' light
STATEMENT = (
    "Expanded uncertainty (95 %), rms over the reference stars: a star's flux 0.063 mag, its place"
    " 0.8 arcsec, attitude across 1.6 arcsec, latency 0.4 ms."
)


@pytest.fixture(scope="module")
def written(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[dict[str, list[str]], list[Figure]]:
    """The page's cards, and its figures."""
    path = tmp_path_factory.mktemp("page") / "index.html"
    with drawn_figures() as drawn:
        page.write_certificate_page(path, a_certificate(), DIGEST)
    return card_lines(path.read_text()), drawn


def test_the_band_has_the_verdict_the_statement_and_the_worst_of_each_kind(written) -> None:
    assert written[0][BAND] == [
        "Certificate H20261126-0a1b2c3d",
        "Does not conform: 1 of 3 figures",
        STATEMENT,
        f"-0.04 {PM} 0.10 mag",
        "star's flux, worst of 3",
        f"1.50 {PM} 0.80 arcsec",
        "star's place along x, worst of 1",
        f"-2.5 {PM} 1.6 arcsec",
        "attitude about x, worst of 1",
        f"0.5 {PM} 1.2 arcsec",
        "attitude about y, worst of 1",
        f"8.25 {PM} 0.40 ms",
        "latency, worst of 1",
    ]


def test_figures_are_the_worst_of_each_kind_and_region_with_its_limit_and_verdict(written) -> None:
    lines = written[0]["Figures"]
    assert lines[2:10] == [
        f"star's flux | left third | -0.04 {PM} 0.10 mag | 2 | 0.05 mag | 1 of 2 do not",
        f"star's flux | middle third | 0.020 {PM} 0.040 mag | 2 |  |",
        f"star's place along x | right third | 1.50 {PM} 0.80 arcsec | 2 | 3 arcsec | conforms",
        f"attitude about x | field 0 | -2.5 {PM} 1.6 arcsec | 2 |  |",
        f"attitude about y | field 0 | 0.5 {PM} 1.2 arcsec | 2 |  |",
        f"attitude about z | field 0 | 7.0 {PM} 4.0 arcsec | 2 |  |",
        f"latency | screen | 8.25 {PM} 0.40 ms | 2 |  |",
        f"star's flux against the sky | left third | 0.030 {PM} 0.080 mag | 2 |  |",
    ]
    assert lines[10] == "star's flux | light over what it should be"
    assert page.MISSED_CURE in lines[11]
    assert written[0]["All figures"][2:5] == [
        f"star's flux | left third | 11 | 0.010 {PM} 0.020 mag",
        f"star's flux | left third | 22 | -0.04 {PM} 0.10 mag",
        f"star's flux | middle third | 33 | 0.020 {PM} 0.040 mag",
    ]
    assert len(written[0]["All figures"]) == 2 + len(a_certificate().figures)


def test_heads_inputs_and_lists_are_the_certificate_s_own(written) -> None:
    cards = written[0]
    assert cards["Certificate"] == [
        "number | H20261126-0a1b2c3d",
        "made, valid until | 2026-11-26T10:00:00+00:00, 2027-11-26",
        f"bench file | bench.toml {'5' * 64}",
        "read by | a test",
        "who | N. N.",
        "where | not stated",
        "ambient | 21 C",
        "traceability | not stated",
        "instrument | meter 9, 2026-01-02: U = 0.024 relative, k = 2",
        f"decision rule | {page.RULES['guard-band']}",
        f"certificate.json | SHA-256 {DIGEST}; signing it is the user's",
        "hilstar | 0.0",
    ]
    assert cards["Budget"][1:] == [
        "response | Student t | 0.0031 | relative | 18 | patches of light",
        "delay | normal | 0.2 | ms |  | stated",
    ]
    assert cards["Not assessed"] == ["stray light", "motion"]
    assert cards["Identity"] == ["monitor: refresh | 60 Hz", "collimator: focal length | 350 mm"]
    assert cards["Files"][1] == f"bench.toml | {'5' * 64}"


def test_both_ways_are_compared_by_their_ratio_and_where_they_differ(written) -> None:
    """0.0475 against 0.05, and 0.012 against 0.01."""
    lines = written[0]["First order against trials"]
    assert lines[0] == (
        "12345 trials of the whole model (the largest number of trials was reached): their standard"
        " uncertainty is 0.950 to 1.200 of first order's."
    )
    assert lines[1].startswith("1 figures differ by more than 5 % of the interval")
    assert lines[3] == f"star's flux | 11 | -0.01 | 0.03 | -0.03 | 0.055 | {BY_CLOCK}"
    alike = [each for each in a_certificate().figures if each.star != 11]
    settled = a_certificate(figures=alike, two_digits_stand=True)
    told = list(page._both_ways(settled))
    assert "(two digits of every figure stand)" in told[0]
    assert told[1:] == ["<p>No interval differs by more than 5 %.</p>"]
    assert list(page._both_ways(a_certificate(figures=[a_figure("flux", 0, 1, "mag")]))) == []


def test_of_many_figures_that_differ_the_first_are_listed_and_all_are_counted(monkeypatch) -> None:
    monkeypatch.setattr(page, "MAX_APART", 2)
    apart = next(each for each in a_certificate().figures if each.star == 11 and each.by_trials)
    told = list(page._both_ways(a_certificate(figures=[apart] * 3)))
    assert told[1].startswith("<p>3 figures differ by more than 5 %")
    assert told[2].count(f">{BY_CLOCK}<") == 2


def test_bars_are_each_input_s_rms_over_all_figures_of_a_kind(written) -> None:
    """0.004 and 0.012 of three stars, one of which has none of it."""
    light, place = written[1]
    expected = [np.sqrt((0.004**2 + 0.012**2) / 3), np.sqrt(2 * 0.003**2 / 3)]
    assert [bar.get_width() for bar in light.axes[0].patches] == pytest.approx(expected)
    names = [label.get_text() for label in light.axes[0].get_yticklabels()]
    assert names == ["evenness [mag]", "response [mag]"]
    title = " ".join(light.get_suptitle().split())
    assert title == "Star's flux: 0.0077 mag standard uncertainty, of which evenness 0.0073"
    assert [bar.get_width() for bar in place.axes[0].patches] == pytest.approx([0.4])


def test_lines_have_the_worst_of_each_kind_and_third_to_two_digits_of_its_uncertainty() -> None:
    cube = CubeToBoresight(
        reference="cube",
        boresight=(0.0, 0.0, 1.0),
        q_tracker_to_reference=(1.0, 0.0, 0.0, 0.0),
        cross_arcsec=None,
        roll_arcsec=None,
    )
    lines = page.text_lines(a_certificate(cube=cube), DIGEST, Path("out"))
    assert lines == [
        ("number", "H20261126-0a1b2c3d"),
        ("verdict", "Does not conform"),
        ("uncertainty", STATEMENT),
        ("flux left third", "-0.04 +- 0.10 mag (the worst of 2)"),
        ("flux middle third", "+0.020 +- 0.040 mag (the worst of 1)"),
        ("place_along right third", "+1.50 +- 0.80 arcsec (the worst of 1)"),
        ("attitude_x", "-2.5 +- 1.6 arcsec (the worst of 1)"),
        ("attitude_y", "+0.5 +- 1.2 arcsec (the worst of 1)"),
        ("attitude_z", "+7.0 +- 4.0 arcsec (the worst of 1)"),
        ("latency", "+8.25 +- 0.40 ms (the worst of 1)"),
        ("cube to boresight", cube.line),
        ("not assessed", "stray light"),
        ("not assessed", "motion"),
        ("valid until", "2027-11-26"),
        ("sha256", DIGEST),
        ("page", "out/index.html"),
    ]


@pytest.mark.parametrize(
    ("conforms", "state", "headline"),
    [(True, OK, "Conforms"), (False, BAD, "Does not conform"), (None, PLAIN, "Stated, no limits")],
)
def test_a_verdict_s_state_is_what_the_certificate_says(conforms, state, headline) -> None:
    figures = [a_figure("flux", 0.0, 0.1, "mag", conforms=conforms, limit=1.0)]
    verdict = page._verdict(a_certificate(conforms=conforms, figures=figures))
    assert verdict.state == state
    assert verdict.headline.partition(":")[0] == headline
    card = page._figures(a_certificate(conforms=conforms, figures=figures))
    assert card.cure == (page.MISSED_CURE if conforms is False else "")
    assert page.statement(a_certificate(figures=[])).endswith("nothing could be stated.")
