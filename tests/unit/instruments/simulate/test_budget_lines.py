"""What `hilstar budget` prints of a budget whose numbers all differ."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hilstar.display.calibration import with_uniformity
from hilstar.display.primaries import ChannelMatrix
from hilstar.instruments.simulate import budget as budgets
from hilstar.instruments.simulate.budget import (
    LightBudget,
    MagnitudeRow,
    NotDrawn,
    budget,
    budget_lines,
    last_within,
    magnitude_row,
    not_drawn,
    out_of_gamut,
    red_shares,
    zero_point_mag,
)
from hilstar.optics.camera import Camera, Lens
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.star_rates import bench_optics
from hilstar.server.bench.star_size import StarSize
from hilstar.sky.stars import Stars
from hilstar.tracker.centroiders import FAMILY
from hilstar.tracker.star_errors import StarErrors
from tests.support.benches import SMALL_BENCH, bench_text
from tests.support.stars import stars_at
from tests.support.tables import csv_rows

STAR = StarSize(1.0, 0.5, 1.5, 2.0, 1.25, 13.5, 4.5, None)


def a_budget(**keys: Any) -> LightBudget:
    """A budget of two magnitudes, at the fainter of which nothing is found."""
    kinds = {kind: 0.01 * (k + 1) for k, kind in enumerate(FAMILY)}
    none = dict.fromkeys(FAMILY)
    rows = [
        MagnitudeRow(3.25, 2.0, 0.0125, 0.0375, 0.0625, 0.125, 4.75, kinds),
        MagnitudeRow(9.5, 8.25, None, None, None, None, None, none),
    ]
    facts: dict[str, Any] = {
        "method": "exact",
        "bits": 10,
        "clips_v_mag": 1.25,
        "clips_v_mag_at_best": 0.5,
        "nothing_v_mag": 8.75,
        "range_mag": 7.5,
        "within": {"0.05_mag": 4.5, "0.1_px": None},
        "clipped_hip": [32349],
        "left_out": NotDrawn(17, 2.5e-4),
        "black_e_per_s_px": 12.345,
        "rows": rows,
        "centroider": "window",
        "centroid_rms_px": kinds,
        "primaries": None,
        "near_infrared": [],
        "out_of_gamut": None,
        "star": STAR,
    }
    return LightBudget(**(facts | keys))


def lines_of(budget: LightBudget) -> list[str]:
    return [" ".join(line.split()) for line in budget_lines(budget)]


def test_a_budget_s_lines_have_each_figure_once() -> None:
    lines = lines_of(a_budget())
    assert lines[:5] == [
        "method exact, 10 bits",
        "clips at V = 1.25 in the middle of a pixel, 0.50 on a corner",
        "shows nothing from V = 8.75, a range of 7.5 mag",
        "below full scale 4.5 mag within 0.05 mag, - mag within 0.1 px",
        "centroider window, in the tracker's pixels after its blur",
    ]
    assert [f"{kind} {0.01 * (k + 1):.4f}" in lines[5] for k, kind in enumerate(FAMILY)] == [
        True for _ in FAMILY
    ]
    assert lines[6:10] == [
        "clipped stars HIP 32349",
        "not drawn 17 stars, too faint: 2.50e-04 of all light",
        "black 12.35 e-/s in a monitor pixel",
        f"in the tracker {STAR.line()}",
    ]
    assert lines[10:] == [
        "",
        "V flux rms max mag centroid rms max px max arcsec",
        "3.25 0.0125 0.0375 0.0625 0.1250 4.75",
        "9.50 - - - - -",
    ]


def test_a_budget_of_all_centroiders_has_a_column_for_each() -> None:
    lines = lines_of(a_budget(centroider="all"))
    assert lines[-3] == f"V flux rms max mag {' '.join(FAMILY)} max px"
    kinds = " ".join(f"{0.01 * (k + 1):.4f}" for k in range(len(FAMILY)))
    assert lines[-2] == f"3.25 0.0125 0.0375 {kinds} 0.1250"
    assert lines[-1].count("-") == len(FAMILY) + 3


@pytest.mark.parametrize(
    ("channels", "what"), [(("one",), "mean wavelength"), (("r", "b"), "electrons by channel")]
)
def test_primaries_are_told_by_channel_and_what_they_cannot_show(channels, what) -> None:
    rates = np.array([[1.0, 20.0, 300.0], [4.0, 50.0, 600.0]])[: len(channels)]
    matrix = ChannelMatrix(channels, rates, 12.5)
    red = [
        {"channel": "all", "from_nm": 700.4, "by_class": {"B": 0.125, "M": 0.5}},
        {"channel": "b", "from_nm": 650.0, "by_class": {"B": 0.25, "M": 0.75}},
    ]
    lines = lines_of(a_budget(primaries=matrix, out_of_gamut=0.0625, near_infrared=red))
    after = lines[10 : 14 + len(channels)]
    assert after[0] == f"out of gamut 6.25% of stars, whose {what} the primaries cannot show"
    assert after[1].startswith("condition number 12.50, electrons of each channel")
    for k, channel in enumerate(channels):
        r, g, b = rates[k].tolist()
        expected = f"r {r:.4g} e-/s, g {g:.4g} e-/s, b {b:.4g} e-/s"
        assert after[2 + k].replace("red", "r").replace("green", "g").replace("blue", "b") == (
            f"{channel} {expected}"
        )
    assert after[-2:] == [
        "from 700 nm, % of e- B 12.5 M 50.0",
        "from 650 nm, % of e- B 25.0 M 75.0 b",
    ]


def test_stars_out_of_gamut_are_those_that_are_not_in_it() -> None:
    class Colours:
        """Of four stars the first alone is in the primaries' gamut."""

        def wanted(self, stars: Any, rows: np.ndarray) -> np.ndarray:
            return 10.0 * rows

        def shares_of(self, stars: Any, rows: np.ndarray) -> np.ndarray:
            return rows + 1.0

        def off(self, wanted: np.ndarray, shares: np.ndarray) -> np.ndarray:
            return wanted - shares

        def in_gamut(self, off: np.ndarray) -> np.ndarray:
            return np.asarray(off < 0)

    class Bench:
        colours: Any = Colours()

        class stars:
            rates_e_per_s = np.zeros(4)

    assert out_of_gamut(Bench()) == pytest.approx(0.75)  # type: ignore[arg-type]
    Bench.colours = None
    assert out_of_gamut(Bench()) is None  # type: ignore[arg-type]


def test_shares_of_red_light_fall_with_the_wavelength_and_rise_with_redder_stars(tmp_path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(SMALL_BENCH)
    file = read_bench_file(path)
    optics = bench_optics(file.config.tracker, tmp_path)
    rows = red_shares({"one": optics}, [650.0, 800.0])
    assert [(row["channel"], row["from_nm"]) for row in rows] == [("all", 650.0), ("all", 800.0)]
    near, far = (row["by_class"] for row in rows)
    assert all(0 < far[kind] < near[kind] < 1 for kind in near)
    assert list(near.values()) == sorted(near.values())
    two = red_shares({"a": optics, "b": optics}, [650.0])
    assert [row["channel"] for row in two] == ["all", "a", "b"]
    assert two[1]["by_class"] == pytest.approx(near)


def test_a_budget_s_ends_are_where_white_and_the_first_code_are_on_the_darkest_and_best_places(
    tmp_path, monkeypatch
) -> None:
    """A screen of gamma 2.2 and 8 bits whose light falls to 0.8, through the small bench's Gaussian."""
    monkeypatch.setattr(budgets, "_errors", lambda bench: [])
    even = np.ones((6, 8))
    uneven = even.copy()
    uneven[4:, 5:] = 0.8
    ends = []
    for name, grid in (("even", even), ("uneven", uneven)):
        with_uniformity("gamma2.2", 8, tmp_path / f"{name}.toml", grid)
        path = tmp_path / f"{name}_bench.toml"
        monitor = {"calibration": f"{name}.toml", "bits": 8}
        render = {"quantisation": "round", "flux_at_white_e_per_s": 5e4}
        sky = {"faintest_v_mag": 4.0}
        path.write_text(bench_text({"monitor": monitor, "render": render, "sky": sky}))
        with open_bench(read_bench_file(path)) as bench:
            sigma_x_px, sigma_y_px = bench.psf.width_px
            ends.append(budget(bench))
    whole, falling = ends
    peak = 1.0
    corner = 1.0
    for sigma_px in (sigma_x_px, sigma_y_px):
        peak *= math.erf(0.5 / sigma_px / math.sqrt(2))
        corner *= math.erf(1 / sigma_px / math.sqrt(2)) / 2
    # a sprite ends at four sigmas
    cut = 1e-3
    at_best = whole.clips_v_mag_at_best - whole.clips_v_mag
    assert at_best == pytest.approx(2.5 * math.log10(corner / peak), abs=cut)
    white_v_mag = whole.clips_v_mag + 2.5 * math.log10(1 / peak)
    # a star lights a pixel where half of the first code's light falls into its own
    dimmest = 255**-2.2 / 2 / peak
    assert whole.nothing_v_mag - white_v_mag == pytest.approx(-2.5 * math.log10(dimmest), abs=cut)
    assert whole.range_mag == pytest.approx(whole.nothing_v_mag - whole.clips_v_mag)
    brighter = falling.clips_v_mag - whole.clips_v_mag
    assert brighter == pytest.approx(-2.5 * math.log10(0.8), abs=cut)
    assert falling.clips_v_mag_at_best == pytest.approx(whole.clips_v_mag_at_best, abs=cut)
    assert whole.black_e_per_s_px == 0.0


def test_a_budget_s_table_has_a_column_for_each_kind_and_its_chart_the_errors_of_what_shows(
    tmp_path, monkeypatch
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr("hilstar.basics.charts.save", lambda figure, path: drawn.append(figure))
    within = {"0.02_mag": 2.0, "0.05_mag": 4.5, "0.01_px": None}
    kinds = {kind: 0.01 * (k + 1) for k, kind in enumerate(FAMILY)}
    told = a_budget(within=within)
    first, last = told.rows
    middle = MagnitudeRow(5.25, 4.0, 0.025, 0.03, 0.125, 0.1, 3.5, kinds)
    told = a_budget(within=within, rows=[first, middle, last])
    budgets.write_report(tmp_path, told)
    cells = csv_rows(tmp_path / "budget.csv")
    columns = [name for name in MagnitudeRow.__slots__ if name != "axis_rms_px"]
    assert list(cells[0]) == [*columns, *(f"axis_rms_px_{kind}" for kind in FAMILY)]
    for written, row in zip(cells, told.rows, strict=True):
        for name in columns:
            value = getattr(row, name)
            assert written[name] == ("" if value is None else str(value))
        for kind in FAMILY:
            value = row.axis_rms_px[kind]
            assert written[f"axis_rms_px_{kind}"] == ("" if value is None else str(value))
    (figure,) = drawn
    flux, place, by_kind = figure.axes
    # the largest so far, and the rms of each; then the limits
    wanted = (
        (flux, [0.0375, 0.0375], [0.0125, 0.025], [0.02, 0.05]),
        (place, [0.125, 0.125], [0.0625, 0.125], [0.01]),
    )
    for axis, largest, rms, limits in wanted:
        for line, values in zip(axis.lines, (largest, rms), strict=False):
            assert line.get_xdata().tolist() == [3.25, 5.25]
            assert line.get_ydata().tolist() == values
        levels = [line.get_ydata()[0] for line in axis.lines[2 : 2 + len(limits)]]
        assert levels == limits
    for line, kind in zip(by_kind.lines, FAMILY, strict=False):
        assert line.get_ydata().tolist() == [kinds[kind]] * 2
    for axis in figure.axes:
        assert [line.get_xdata()[0] for line in axis.lines[-2:]] == [1.25, 8.75]
    texts = " ".join(text.get_text().replace("\n", " ") for text in figure.texts)
    finding = texts.replace("\N{NO-BREAK SPACE}", " ")
    assert "10 bits, exact: from V = 1.2, where stars clip" in finding
    assert "within 0.05 mag over 4.5 magnitudes" in finding


def test_a_budget_s_arcseconds_are_those_where_a_pixel_is_widest() -> None:
    """A lens with 1000 px to a radian in the middle and more at its corners: 0.01 px are up to 2.06
    arcsec.
    """
    lens = Lens(radial=(0.5, 0.0, 0.0))
    monitor = Camera((800, 600), 1000.0, (399.5, 299.5), np.eye(3), lens)
    off_px = np.array([[0.006, 0.0], [0.008, 0.0]])
    by_kind = dict.fromkeys(FAMILY, 3 * off_px) | {"moment": off_px}
    errors = StarErrors(np.array([0.3, -0.4]), by_kind)
    row = magnitude_row(1.0, errors, "moment", 3.0, monitor)
    assert row.centroid_max_arcsec == pytest.approx(206264.8 * 0.01 / 1000, rel=1e-5)
    assert row.centroid_max_px == pytest.approx(0.01)
    assert row.axis_rms_px == pytest.approx(dict.fromkeys(FAMILY, 0.015) | {"moment": 0.005})
    assert row.centroid_rms_px == pytest.approx(0.01 / math.sqrt(2))
    assert (row.flux_max_mag, row.flux_rms_mag) == (0.4, pytest.approx(math.sqrt(0.125)))
    assert (row.v_mag, row.below_white_mag) == (4.0, 1.0)


def test_a_budget_s_reach_ends_before_the_first_magnitude_beyond_the_limit() -> None:
    none = dict.fromkeys(FAMILY)
    rows = [
        MagnitudeRow(1.0 + mag, mag, None, None, None, None, None, none)
        for mag in (0.0, 0.5, 1.0, 1.5)
    ]
    for errors, within_mag in (
        ([0.01, 0.02, 0.021, 0.001], 0.5),
        ([0.01, 0.01, 0.01, 0.02], 1.5),
        ([0.01, None, 0.01, 0.01], 0.0),
        ([0.03, 0.01, 0.01, 0.01], None),
        ([None, 0.01, 0.01, 0.01], None),
    ):
        assert last_within(rows, errors, 0.02) == within_mag


def stars_of(electrons_per_s: list[float], v_mag: list[float], bv_mag: list[float]) -> Stars:
    """Five stars with these figures, wherever they stand."""
    stars = stars_at(np.eye(3)[[0, 1, 2, 0, 1]], np.ones(5))
    return replace(
        stars,
        electrons_per_s=np.array(electrons_per_s),
        v_mag=np.array(v_mag),
        bv_mag=np.array(bv_mag),
    )


def test_stars_too_faint_to_be_drawn_have_their_share_of_all_light_but_a_body_s() -> None:
    """Of 900, 70, 20 and 10 e-/s, the second driven twice and the fourth three times as bright."""
    stars = stars_of([900.0, 70.0, 20.0, 10.0, 1e9], [0.0] * 5, [0.0] * 5)
    drive = np.array([1.0, 2.0, 1.0, 3.0, 1.0])
    missing = not_drawn(replace(stars, bodies=("moon",)), drive, 30.0)
    assert (missing.stars, missing.flux_share) == (1, pytest.approx(0.02))
    assert not_drawn(replace(stars, bodies=("moon",)), 1.0, 30.0).stars == 2


def test_the_zero_point_is_that_of_stars_of_the_sun_s_colour() -> None:
    """Of 1000 e-/s at V = 4 three are of B-V 0.56 to 0.74, and red ones are twice as bright."""
    rates_e_per_s = [1000.0, 100.0, 10.0, 2000.0, 5.0]
    v_mag = [4.0, 6.5, 9.0, 4.0, 4.0]
    alike = stars_of(rates_e_per_s, v_mag, [0.56, 0.65, 0.74, 1.5, 0.5])
    assert zero_point_mag(alike) == pytest.approx(11.5)
    # none is as near as a tenth: the nearest
    red = stars_of(rates_e_per_s, v_mag, [1.4, 1.5, 1.9, 1.5, 1.2])
    assert zero_point_mag(red) == pytest.approx(4 + 2.5 * math.log10(5))


def test_a_budget_of_temporal_codes_is_of_the_frames_of_an_exposure(bench_with, monkeypatch):
    """Three magnitudes below white: of eight frames the mean light is off by an eighth or so of
    what one frame's codes leave.
    """
    monkeypatch.setattr(budgets, "PHASES", 2)
    monkeypatch.setattr(budgets, "STEP_MAG", 3.0)
    monkeypatch.setattr(budgets, "MAX_BELOW_WHITE_MAG", 3.0)
    off_mag = {}
    for frames in (1, 8):
        text = f'[render]\nquantisation = "temporal"\ncycle_frames = {frames}\n'
        (_, _), (mag, errors) = budgets._errors(bench_with(text))
        assert mag == 3.0
        off_mag[frames] = errors.flux_rms_mag
    assert off_mag[8] < off_mag[1] / 4
