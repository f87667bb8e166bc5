"""What a user reads of a confrontation whose figures all differ: its page, pictures and charts."""

from __future__ import annotations

import base64
import io
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from hilstar.basics.arrays import FloatArray
from hilstar.basics.pages import BAD, DASH, OK, WARN
from hilstar.instruments.confront import page
from hilstar.instruments.confront.judge import SourceRow
from tests.support.card_texts import BAND, card_lines, drawn_figures
from tests.support.confrontations import (
    a_confrontation,
    a_session,
    a_shot,
    a_verdict,
    some_verdicts,
)

# a pixel's variance at 200 DN above the pedestal: photons, read noise, steps, response and columns
NOISE_DN = math.sqrt(200 / 2 + 3**2 + 4**2 / 12 + (0.02 * 200) ** 2 + 0.5**2)
JPEG_LEVELS = 4  # by which even areas of a JPEG are off, with edges beside them


@dataclass(frozen=True)
class Written:
    """A page's text, its cards' lines, and its charts' figures."""

    text: str
    cards: dict[str, list[str]]
    drawn: list[Figure]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    path = tmp_path_factory.mktemp("page") / "index.html"
    confrontation = a_confrontation()
    maps = [np.arange(192.0).reshape(12, 16) + k for k in range(2)]
    pictures = [page.Pictures((b"a", b"b", bytes([k])), maps[k]) for k in range(2)]
    with drawn_figures() as drawn:
        page.write_page(path, confrontation, pictures)
    text = path.read_text()
    return Written(text, card_lines(text), drawn)


def title_of(figure: Figure) -> str:
    return " ".join(figure.get_suptitle().split())


def test_the_band_has_the_verdict_and_the_worst_of_all_photographs(written: Written) -> None:
    assert written.cards[BAND] == [
        "Photographs against the simulator",
        "Beyond the limits",
        "p0.fits: too few; p0.fits: too dim. Its camera was fitted to them.",
        "19",
        "stars to V = 6.5",
        "0.25 px",
        "rms off their places",
        "0.5 mag",
        "rms off their light",
        "2",
        "sources that nothing explains",
        "1",
        "stars that are missing",
    ]


def test_cards_list_what_is_odd_by_photograph(written: Written) -> None:
    cards = written.cards
    assert list(cards)[1:3] == ["p0.fits", "p1.fits"]
    assert cards["Sources that nothing explains"][1:] == [
        "p0.fits | 61.2 | 5.5 | 22",
        "p0.fits | 12.3 | 45.7 | 9",
    ]
    assert cards["Sources that are no stars"][1:] == ["p0.fits | 3.2 | 4.8 | 40 | a hot pixel"]
    assert cards["Stars that are missing"] == [
        "photograph | star | V, mag | x, px | y, px",
        "p0.fits | HIP 11 | 5.25 | 30.4 | 12.6",
    ]
    assert cards["What the scatter is made of"] == [
        "part | rms, mag | how it is told apart",
        "all | 0.0375 |",
        "noise | 0.0125 | by gain",
        "scintillation by law |  | no height",
        "part | rms, px | how it is told apart",
        "all | 0.0625 |",
        "seeing | 0.05 | by pairs",
    ]
    assert cards["Each photograph"] == [
        "photograph | stars to V = 6.5 | rms, px | rms, mag | background chi² | star chi² |"
        " unexplained | missing",
        "p0.fits | 2 | 0.25 | 0.5 | 0.75 | 3.5 | 2 | 1",
        "p1.fits | 17 | 0.0625 | 0.0312 | 1.06 | 1.25 | 0 | 0",
    ]
    assert cards["What was fitted"] == ["a line of a test"]
    assert cards["Notes"] == ["a note of a test"]


def test_marks_are_at_their_places_over_the_three_views_of_their_photograph(
    written: Written,
) -> None:
    first, second = re.findall("<svg (viewBox.*?)</svg>", written.text)
    assert first.startswith('viewBox="-0.5 -0.5 80 60"')
    named = re.findall('<text x="(.*?)" y="(.*?)" .*?text-anchor="(.*?)".*?>(.*?)</text>', first)
    # the brightest first, a fifty-fifth of the width beside it, and left of what is at the right
    assert named == [
        ("69", "50", "end", "\N{GREEK SMALL LETTER ALPHA} Lyr"),
        ("22", "40", "start", "\N{GREEK SMALL LETTER ALPHA} Cyg"),
        ("12", "20", "start", "TYC 5"),
        ("52", "8", "start", "HIP 7"),
    ]
    squares = re.findall('<rect x="(.*?)" y="(.*?)" width="(.*?)" height="(.*?)"', first)
    assert squares == [("3", "37", "18", "18"), ("52", "-4", "18", "18")]
    assert re.findall('<circle cx="(.*?)" cy="(.*?)" r="(.*?)"', first) == [("30", "13", "10")]
    assert len(re.findall("<text", second)) == 1
    images = re.findall('<img alt="(.*?)" src="data:image/jpeg;base64,(.*?)">', written.text)
    assert [alt for alt, _ in images[:3]] == [f"{view} of p0.fits" for view in page.VIEWS]
    assert [base64.b64decode(data) for _, data in images[3:]] == [b"a", b"b", b"\x01"]


def test_the_page_has_its_style_and_the_script_that_its_buttons_need(written: Written) -> None:
    """The script counts a frame's buttons: an image for each of the first, then two ways to see
    several.
    """
    style, script = page.STYLE.read_text(), page.SCRIPT.read_text()
    assert f"<style>{style}</style>" in written.text
    assert f"<script>{script}</script>" in written.text
    first_frame = written.text.partition('<div class="frame">')[2].partition("</svg>")[0]
    buttons = re.findall('<button type="button">(.*?)</button>', first_frame)
    assert buttons == [*page.VIEWS, "blink", "side by side"]
    assert "const [BLINK, SIDE_BY_SIDE] = [3, 4];" in script
    used = re.findall(r'querySelector(?:All)?\("\.(\w+)"\)', script)
    assert used and all(f'class="{name}"' in written.text for name in used)


def test_a_chart_of_light_has_stars_that_stand_alone_by_v_and_colour(written: Written) -> None:
    """Seen less predicted: 1000 of 900 DN, 5000 of 5500, 1000 of 1100, and 90 of 99 of V = 7.5."""
    figure = written.drawn[0]
    by_flux, by_v, by_colour = figure.axes
    off_mag = -2.5 * np.log10([10 / 9, 10 / 11, 10 / 11])
    rms_mag = math.sqrt((off_mag**2).mean())
    assert title_of(figure) == f"Stars to V = 6.5 are {rms_mag:.3f} mag rms off their prediction"
    others, counted, fitted = (line.get_xydata() for line in by_flux.lines)
    assert others == pytest.approx(np.array([[7.5, -2.5 * math.log10(90)]]))
    seen_mag = -2.5 * np.log10([1000.0, 5000.0, 1000.0])
    assert counted == pytest.approx(np.column_stack([[3.5, 0.03, 0.03], seen_mag]))
    # V - zero point + colour term (B-V), at the median colour
    at_mag = np.array([0.03, 7.5])
    assert fitted == pytest.approx(np.column_stack([at_mag, at_mag - 14.5 - 0.21 * 0.5]))
    assert by_v.lines[1].get_xydata() == pytest.approx(
        np.column_stack([[3.5, 0.03, 0.03], off_mag])
    )
    assert by_colour.lines[1].get_xdata() == pytest.approx([1.5, 0.5, 0.5])
    assert by_colour.lines[1].get_ydata() == pytest.approx(off_mag)


def test_arrows_go_from_predicted_places_to_those_seen(written: Written) -> None:
    """A quarter right and an eighth up, of stars of 20 sigmas and more."""
    figure = written.drawn[1]
    rms_px = math.sqrt((0.25**2 + 0.125**2) / 2)
    assert title_of(figure).endswith(f"are {rms_px:.3f} px rms an axis off their places")
    (axes,) = figure.axes
    arrows = axes.collections[0]
    assert arrows.XY.tolist() == [[10, 20], [70, 50], [40, 30]]
    assert set(zip(arrows.U.tolist(), arrows.V.tolist(), strict=True)) == {(0.25, -0.125)}
    assert axes.yaxis_inverted()


def test_a_psf_stands_at_its_place_of_the_field(written: Written) -> None:
    """Row 1 and column 3 of five, of 8 samples a pixel and three pixels to each side."""
    figure = written.drawn[2]
    (axes,) = figure.axes
    psf = a_session().psf
    mosaic = np.asarray(axes.images[0].get_array())
    side = 2 * 3 * 8 + 1
    assert mosaic.shape == (5 * side, 5 * side)
    tile = mosaic[side : 2 * side, 3 * side : 4 * side]
    assert tile**2 == pytest.approx(psf.samples(3 * 799 / 4, 599 / 4, 8, 3))
    widths_px = [float(text.get_text().partition(": ")[2]) for text in axes.texts]
    assert f"{min(widths_px):.2f} to {max(widths_px):.2f} px, pixel" in title_of(figure)
    place, _, wide = axes.texts[5 + 3].get_text().partition(": ")
    assert (place, axes.texts[5 + 3].get_position()) == ("599, 150", (3.03, 1.97))
    at = np.array([599.25]), np.array([149.75])
    assert float(wide) == pytest.approx(psf.fwhm_px(*at)[0], abs=0.005)


def test_a_photon_transfer_is_drawn_from_its_pedestal_on(written: Written) -> None:
    (axes,) = written.drawn[3].axes
    points, line = (line.get_xydata() for line in axes.lines)
    assert points.tolist() == [[200, 60], [300, 110], [500, 220]]
    read_dn2 = 3**2 + 4**2 / 12 + 0.5**2
    at_500_dn2 = read_dn2 + 400 / 2 + (0.02 * 400) ** 2
    assert line == pytest.approx(np.array([[100, read_dn2], [500, at_500_dn2]]))
    assert axes.get_ylim()[1] == 2 * 110
    assert title_of(written.drawn[3]) == (
        "2 \N{PLUS-MINUS SIGN} 0.03 e- a DN, 6.00 e- of read noise at 100 DN"
    )


def test_maps_of_squared_residuals_are_each_photograph_s(written: Written) -> None:
    figure = written.drawn[4]
    assert title_of(figure) == "The background's chi² is 0.750 to 1.062"
    for k, axes in enumerate(figure.axes[:2]):
        assert axes.get_xlabel() == f"photograph {k + 1}"
        assert np.asarray(axes.images[0].get_array())[0, :2].tolist() == [k, k + 1]


@pytest.mark.parametrize("fixed", [False, True])
def test_a_verdict_says_whether_its_camera_was_fitted(fixed: bool) -> None:
    camera = f"Its camera was {'not ' * fixed}fitted to them."
    session = a_session(fixed=fixed)
    off = page._verdict(a_confrontation(session=session, failures=("far off",)))
    assert (off.state, off.words) == (BAD, f"far off. {camera}")
    explained = page._verdict(a_confrontation(session=session, failures=()))
    assert (explained.state, explained.words) == (OK, camera)


def test_figures_that_no_photograph_has_are_dashes_and_the_worst_may_be_the_last() -> None:
    shot = a_shot(0)
    none = a_verdict(shot, 0, rms_px=math.nan, rms_mag=math.nan)
    figures = list(page._figures([none]))
    assert [figure.text for figure in figures[1:3]] == [f"{DASH} px", f"{DASH} mag"]
    assert [figure.state for figure in figures[3:]] == [OK, OK]
    odd = some_verdicts(a_session())[0]
    assert [figure.state for figure in list(page._figures([none, odd]))[3:]] == [WARN, WARN]
    worse = a_verdict(shot, 1, rms_px=0.75, rms_mag=0.0125)
    figures = list(page._figures([none, worse, a_verdict(shot, 2)]))
    assert [figure.text for figure in figures[1:3]] == ["0.75 px", "0.031 mag"]


def test_a_long_list_says_how_many_more_the_tables_have() -> None:
    sources = [SourceRow(5.0, 6.0, 10.0 + k, "") for k in range(page.MAX_ROWS + 3)]
    (card,) = page._lists([a_verdict(a_shot(0), 0, sources=sources)])
    lines = card_lines(card.html())["Sources that nothing explains"]
    assert lines[1] == f"p0.fits | 5 | 6 | {10 + page.MAX_ROWS + 2}"
    assert lines[page.MAX_ROWS + 1 :] == ["3 more in the tables."]


def even_areas(values: list[float], repeated: int = 16) -> FloatArray:
    """An image of areas side by side, 48 px high."""
    return np.tile(np.repeat(values, repeated), (48, 1))


def test_pictures_are_black_at_two_sigmas_and_white_thirty_above_and_residuals_span_ten() -> None:
    """In sigmas of a pixel's own noise; the half of the greys is where asinh is half of that of
    30.
    """
    session = a_session()
    half = 2 + math.sinh(math.asinh(30) / 2)
    seen = even_areas([0.0, half, 32.0, 90.0])
    predicted = even_areas([32.0, 2.0, half, 0.0])
    residual = even_areas([-7.0, 0.0, 2.5, 5.0])
    level = np.full(seen.shape, 300.0)
    shot = a_shot(0)
    photo = replace(shot.photo, dn=level + NOISE_DN * seen)
    shot = replace(shot, photo=photo, level=replace(shot.level, level=level))
    verdict = a_verdict(shot, 0, predicted=level + NOISE_DN * predicted, residual=residual)
    pictures = page.page_pictures(session, verdict)
    wanted = ([0, 127, 255, 255], [255, 0, 127, 0], [0, 127, 191, 255])
    for data, greys in zip(pictures.views, wanted, strict=True):
        image = np.asarray(Image.open(io.BytesIO(data)))
        assert image.shape == seen.shape
        middles = image[20, 8::16].astype(int)
        assert np.abs(middles - greys).max() <= JPEG_LEVELS
    # each square counts up to 25: four columns of sixteen an area
    assert pictures.chi2_map.shape == (12, 16)
    assert pictures.chi2_map[5].tolist() == [*[25.0] * 4, *[0.0] * 4, *[6.25] * 4, *[25.0] * 4]


def test_a_map_of_an_image_that_no_part_divides_is_of_means() -> None:
    """Of 50 rows and 70 columns; the sum over the parts' pixels is that of all."""
    rng = np.random.default_rng(3)
    residual = rng.standard_normal((50, 70))
    residual[49, 69] = 4.0
    session = a_session()
    shot = a_shot(0)
    level = np.full(residual.shape, 300.0)
    shot = replace(
        shot, photo=replace(shot.photo, dn=level), level=replace(shot.level, level=level)
    )
    verdict = a_verdict(shot, 0, predicted=level, residual=residual)
    chi2 = page.page_pictures(session, verdict).chi2_map
    rows = np.linspace(0, 50, 13).astype(int)
    columns = np.linspace(0, 70, 17).astype(int)
    last = residual[rows[-2] :, columns[-2] :]
    assert chi2[-1, -1] == pytest.approx((last**2).mean())


def test_a_page_is_one_file_in_the_order_of_its_reader(tmp_path: Path) -> None:
    """Photographs without stars that are alone, and a detector without points, have no charts of
    them.
    """
    session = a_session()
    session = replace(session, pixels=replace(session.pixels, points=np.empty((0, 2))))
    verdicts = tuple(replace(verdict, stars=[]) for verdict in some_verdicts(session))
    confrontation = a_confrontation(session=session, verdicts=verdicts, excess=None, notes=())
    pictures = [page.Pictures((b"", b"", b""), np.ones((12, 16)))] * 2
    with drawn_figures():
        page.write_page(tmp_path / "index.html", confrontation, pictures)
    assert list(card_lines((tmp_path / "index.html").read_text()))[1:] == [
        "p0.fits",
        "p1.fits",
        "Point spread function",
        "Squared residuals over the field",
        "Sources that nothing explains",
        "Sources that are no stars",
        "Each photograph",
        "What was fitted",
    ]
