"""The parts of a certificate, each against a closed form: its figures and verdicts, light by code,
a lens's terms, and the correlation of what a fit leaves.
"""

from __future__ import annotations

import math
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.interpolate import CubicSpline

from hilstar.basics.errors import InputError
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.display.calibration import CalibrationHead, NotesTable, write_calibration
from hilstar.display.geometry import ErrorTable, MadeTable, Notes, monitor_camera, write_geometry
from hilstar.display.identity import MonitorIdentity
from hilstar.instruments.calibrate.geometric import fit as fits
from hilstar.instruments.certify import estimates, lens
from hilstar.instruments.certify.assembly import Assembled
from hilstar.instruments.certify.bench_readings import DotReadings, LightReadings
from hilstar.instruments.certify.budget import BudgetTrials, Combined, Input
from hilstar.instruments.certify.certificate import (
    _contributions,
    _figures,
    _input_row,
    _judged,
    _monitor,
    _place_of,
    files_of,
)
from hilstar.instruments.certify.estimates import (
    LightDeviation,
    Surface,
    _above_black,
    _fit_without_wild,
    _is_better,
    _LightFit,
    _scatter,
    light_deviation,
)
from hilstar.instruments.certify.model import Figures
from hilstar.instruments.certify.structure import (
    MIN_CELLS,
    RATIOS,
    Cells,
    Spread,
    Structure,
    _finer,
    _rectangle,
    in_place,
    in_time,
    lasting_root,
    weighed,
)
from hilstar.optics.camera import Camera
from hilstar.server.bench.bench_file import BenchFile, bench_file_of
from tests.support.planted_certify import BENCH, reference_star, stated_bench
from tests.support.refusals import refusal

SIZE_PX = (1920, 1080)
ROUNDING = 1e-9


def budget_input(name: str, dof: float = math.inf) -> Input:
    """An input of a standard uncertainty of 0.25 mag."""
    return Input(name, "normal", "stated", 1, 0.25, "mag", dof)


def deciding(decision: str, **limits: float) -> BenchFile:
    """A bench whose panel has a delay of 8 ms, with a rule of decision and limits."""
    lines = [f"{name} = {limit}\n" for name, limit in limits.items()]
    return stated_bench(f'[certify]\ndecision = "{decision}"\n{"".join(lines)}')


@pytest.mark.parametrize(
    ("decision", "value", "interval", "conforms"),
    [
        ("guard-band", 0.0, (-0.09, 0.09), True),
        ("guard-band", 0.0, (-0.11, 0.09), False),
        ("guard-band", 0.0, (-0.09, 0.11), False),
        ("guard-band", 0.2, (0.11, 0.3), False),
        ("simple", 0.09, (-0.3, 0.3), True),
        ("simple", -0.11, (-0.11, 0.0), False),
    ],
)
def test_a_figure_conforms_where_all_of_its_interval_or_its_value_alone_does(
    decision, value, interval, conforms
):
    file = deciding(decision, max_flux_mag=0.1)
    assert _judged(file, "flux", value, interval) == (0.1, conforms)
    assert _judged(file, "attitude_z", value, interval) == (None, None)


def test_a_latency_s_limit_is_about_the_stated_delay_and_a_roll_has_its_own():
    file = deciding("guard-band", max_latency_ms=1.0, max_attitude_arcsec=2.0, max_roll_arcsec=30.0)
    assert _judged(file, "latency", 8.5, (7.1, 8.9)) == (1.0, True)
    assert _judged(file, "latency", 0.0, (-0.5, 0.5)) == (1.0, False)
    assert _judged(file, "attitude_x", 0.0, (-3.0, 3.0)) == (2.0, False)
    assert _judged(file, "attitude_z", 0.0, (-3.0, 3.0)) == (30.0, True)


def test_contributions_are_shares_of_the_variance_with_the_largest_first():
    inputs = [budget_input("small"), budget_input("none"), budget_input("large")]
    small, large = 3.0, 4.0
    parts = _contributions(inputs, np.array([small, 0.0, large]))
    assert [part.input for part in parts] == ["large", "small"]
    assert [part.share for part in parts] == [16 / 25, 9 / 25]
    assert [part.standard_uncertainty for part in parts] == [large, small]


def test_an_input_s_freedom_is_written_where_it_is_finite():
    assert _input_row(budget_input("a", 7.0)).dof == 7.0
    assert _input_row(budget_input("a")).dof is None
    assert _input_row(budget_input("a")).standard_uncertainty == 0.25


def test_a_figure_s_field_counts_from_0_and_its_star_has_its_own():
    stars = [reference_star(), reference_star(hip=71, field=2, third=1)]
    assert _place_of(stars, "flux", 1) == (71, 2, "middle third")
    for third, region in enumerate(("left third", "middle third", "right third")):
        assert _place_of([reference_star(third=third)], "place_along", 0)[2] == region
    assert _place_of(stars, "attitude_x", -1) == (None, 0, "field 0")
    assert _place_of(stars, "attitude_z", -3) == (None, 2, "field 2")
    assert _place_of(stars, "latency", 0) == (None, None, "screen")


def test_a_certificate_s_monitor_is_the_one_that_was_read_or_else_of_its_files(tmp_path: Path):
    """Of two files the second, the geometry, has an identity."""
    filed, read = (MonitorIdentity(maker="DEL", serial=serial) for serial in ("filed", "read"))
    head = CalibrationHead(
        kind="photometric", bits=8, response="light.csv", who="", when="", instrument="", unit=""
    )
    response = {"w": np.linspace(0.0, 1.0, 256)}
    q = np.array([1.0, 0.0, 0.0, 0.0])
    write_calibration(tmp_path / "light.toml", head, response, 0.0, NotesTable())
    screen = monitor_camera(SIZE_PX, 57.65, 350.0, q)
    for number, identity in enumerate((filed, None)):
        notes = Notes({}, ErrorTable(), MadeTable(when=""), identity)
        write_geometry(tmp_path / f"place-{number}.toml", screen, q, notes)
    facts = {"resolution_px": [1920, 1080], "refresh_hz": 60.0, "calibration": "light.toml"}
    for number, now, serial in ((0, read, "read"), (0, None, "filed"), (1, None, "")):
        text = BENCH.format(
            calibration="light.toml",
            delay_ms=8.0,
            geometry=f'geometry = "place-{number}.toml"',
            white=1e6,
        )
        told = _monitor(bench_file_of(tmp_path / "bench.toml", text), now)
        known = {"maker": "DEL", "serial": serial} if serial else {}
        assert told == facts | {"identity": known}


def test_each_figure_has_its_own_numbers_and_a_truth_where_there_is_one():
    """Three delays, of which the truth of two is known, and the trials of the second differ."""
    names = [("latency", 0, "ms"), ("latency", 0, "ms"), ("latency", 0, "ms")]
    file = deciding("guard-band", max_latency_ms=1.6)
    figures = Figures(file, [reference_star()])
    budget = Assembled([budget_input("a")], lambda variables: variables[0], names, figures, [])
    value, standard = np.array([8.0, 9.0, 10.0]), np.array([0.5, 0.25, 0.0])
    lower, upper = value - 3 * standard, value + 3 * standard
    freedom = np.array([2.51, 1e6, 7.0])
    combined = Combined(value, standard, freedom, lower, upper, standard[:, None])
    moved = np.array([0.0, 0.5, 0.0])
    drawn = BudgetTrials(value + moved, 1.1 * standard, lower + moved, upper + moved, 9, True)
    found = list(_figures(file, budget, combined, drawn, np.array([8.1, 9.2])))
    assert [each.truth for each in found] == [8.1, 9.2, None]
    assert [each.value for each in found] == [8.0, 9.0, 10.0]
    assert [each.k for each in found] == [3.0, 3.0, 0.0]
    assert [each.dof for each in found] == [2.5, None, 7.0]
    assert [(each.lower, each.upper) for each in found] == [(6.5, 9.5), (8.75, 10.25), (10.0, 10.0)]
    assert [each.conforms for each in found] == [True, False, False]
    assert [bool(each.by_trials.differs) for each in found] == [False, True, False]
    assert found[1].by_trials.standard_uncertainty == pytest.approx(0.275)
    unknown = replace(budget, not_assessed=["latency: no photodiode"])
    assert list(_figures(file, unknown, combined, drawn, None)) == []


def deviation(value: np.ndarray, sigma: float = 1e-6) -> LightDeviation:
    """Light by codes at steps of 0.2 in its log, with the same noise for each."""
    count = len(value)
    none = np.zeros((count, 0))
    nothing = Structure(np.ones(1), np.zeros(1), 1.0, math.inf)
    return LightDeviation(
        log_light=0.2 * np.arange(count) - 0.2 * (count - 1),
        value=value,
        factors=sigma * np.eye(count),
        dof=30.0,
        noise=sigma,
        dark_factors=none,
        dark_dof=5.0,
        dark=0.0,
        lasting_factors=none,
        lasting=nothing,
        square_px=(0, 0, 1),
        common_factors=none,
        beside=None,
    )


def test_a_deviation_of_light_is_a_natural_spline_that_is_held_beyond_its_ends(rng):
    read = deviation(rng.normal(1.0, 0.1, 12))
    at = np.array([-5.0, read.log_light[0], -1.23, -0.51, 0.0, 3.0])
    spline = CubicSpline(read.log_light, read.value, bc_type="natural")
    held = spline(np.clip(at, read.log_light[0], 0.0))
    np.testing.assert_allclose(read.weights(at) @ read.value, held, atol=ROUNDING)
    bent = held - np.interp(at, read.log_light, read.value)
    np.testing.assert_allclose(read.bent(at), bent, atol=ROUNDING)


def test_codes_on_a_line_foretell_each_other():
    read = deviation(np.linspace(0.9, 1.1, 10))
    gaps = read._gaps() @ read.value
    np.testing.assert_allclose(gaps[1:-1], 0.0, atol=ROUNDING)
    np.testing.assert_allclose(gaps[[0, -1]], [0.9, 1.1], atol=ROUNDING)
    assert not read.rough(np.array([-0.3, -1.1])).any()


def test_codes_that_are_off_by_themselves_say_how_far(rng):
    off = 0.01
    signs = rng.choice([-1.0, 1.0], 40)
    read = deviation(1.0 + off * signs)
    between = 0.5 * (read.log_light[1:] + read.log_light[:-1])[10:30]
    rough = read.rough(between)
    # one sigma of a code, and what the spline through such codes adds
    assert off < float(np.median(rough)) < 2.5 * off
    assert not read.rough(read.log_light).any()
    # noise that explains it all leaves nothing
    assert not deviation(1.0 + off * signs, sigma=off).rough(between).any()


def test_lit_codes_are_above_black_and_a_scatter_is_by_its_freedom():
    rows = np.array([[1.0, 2.0], [4.0, 9.0], [5.0, 5.0], [77.0, 77.0]])
    np.testing.assert_array_equal(_above_black(rows, 3), [[3.0, 7.0], [4.0, 3.0]])
    assert _scatter(np.array([1.0, -2.0, 2.0]), 2.0) == pytest.approx(math.sqrt(9 / 2))


@pytest.mark.parametrize(("more", "dof"), [(2, 40.0), (5, 90.0)])
def test_a_finer_fit_is_better_from_the_thousandth_of_f_on(more, dof):
    limit = stats.f.isf(0.001, more, dof)
    squares = dof * (1.0 + limit * np.array([0.98, 1.02]) * more / dof)
    assert not _is_better(squares[0], dof + more, dof, dof)
    assert _is_better(squares[1], dof + more, dof, dof)
    assert not _is_better(squares[1], dof, dof, dof)


def test_a_wild_value_is_left_out_and_noise_of_one_has_the_fit_s_covariance(rng):
    x = np.linspace(-1, 1, 60)
    terms = np.column_stack([np.ones(60), x])
    values = (terms @ [2.0, 3.0] + rng.normal(0, 0.01, 60))[:, None]
    values[17] += 5.0
    solution, root, usable = _fit_without_wild(terms, values, np.ones(60, dtype=bool))
    assert np.flatnonzero(~usable).tolist() == [17]
    # sigma / sqrt(n), and over the rms of x: five of them
    assert solution[:, 0] == pytest.approx([2.0, 3.0], abs=5 * 0.01 / math.sqrt(60 / 3))
    covariance = np.linalg.inv(terms[usable].T @ terms[usable])
    np.testing.assert_allclose(root @ root.T, covariance, rtol=1e-9)


def test_a_surface_s_bow_is_nothing_at_a_field_s_middle_and_a_parabola_s_between_them():
    """Of T2 = 2 u^2 - 1, linear between nodes a step apart: short of it by the product of the
    distances to both, twice.
    """
    value = np.zeros((6, 1))
    # terms of degree 2 in rows of the columns' degree: 1, y, y^2, x, xy, x^2
    value[5] = 1.0
    surface = Surface(2, SIZE_PX, value, np.eye(6), 10.0, 1.0)
    step_px = SIZE_PX[0] / 16
    # 120 px to a field: pixels 60 and 899 are half a pixel beside a middle
    x_px = np.array([60.0, 119.0, 899.0, 1700.0])
    y_px = np.full(4, 540.0)
    middle = step_px * (np.floor((x_px + 0.5) / step_px - 0.5) + 0.5) - 0.5
    off_px = x_px - middle
    half_px = SIZE_PX[0] / 2
    wanted = -2 * off_px * (step_px - off_px) / half_px**2
    np.testing.assert_allclose(surface.bowed(x_px, y_px), wanted, atol=1e-9)


def test_a_structure_s_length_is_the_mean_by_its_variances():
    structure = Structure(np.array([1.0, 5.0, 9.0]), np.array([3.0, 0.0, 1.0]), 0.5, 9.0)
    assert structure.total == 4.0
    assert structure.mean_length == pytest.approx((3 * 1 + 9) / 4)
    assert list(structure.parts()) == [(1.0, 3.0), (9.0, 1.0)]


@pytest.mark.parametrize("ratio", [0.0, 0.4, 30.0])
def test_a_restricted_likelihood_is_that_of_contrasts(ratio, rng):
    """Patterson and Thompson: the density of what no term explains, whatever basis spans it."""
    count, terms = 12, 3
    eigen = rng.uniform(0, 5, count)
    design = rng.normal(size=(count, terms))
    value = rng.normal(size=count)
    contrasts = np.linalg.svd(design)[0][:, terms:]
    free = count - terms

    def by_contrasts(at: float) -> tuple[float, float]:
        covariance = contrasts.T @ np.diag(1 + at * eigen) @ contrasts
        left = contrasts.T @ value
        unexplained = left @ np.linalg.solve(covariance, left)
        log_size = np.linalg.slogdet(covariance)[1]
        return -0.5 * (log_size + free * math.log(unexplained)), unexplained / free

    spread = Spread(eigen, value, design)
    (likelihood, at_zero), noises = spread.likelihoods(np.array([ratio, 0.0]))
    wanted, wanted_noise = by_contrasts(ratio)
    assert noises[0] == pytest.approx(wanted_noise)
    # up to a constant of the terms, the same for all ratios
    assert likelihood - at_zero == pytest.approx(wanted - by_contrasts(0.0)[0], abs=1e-9)


def test_what_lasts_falls_by_e_in_its_time():
    structure = Structure(np.array([2.0, 8.0]), np.array([3.0, 1.0]), 1.0, 9.0)
    t = np.array([0.0, 2.0, 8.0])
    root = lasting_root(t, structure)
    covariance = root @ root.T
    apart = np.abs(t[:, None] - t)
    wanted = 3 * np.exp(-apart / 2) + np.exp(-apart / 8)
    np.testing.assert_allclose(covariance, wanted, atol=ROUNDING)
    none = Structure(np.array([2.0]), np.zeros(1), 1.0, 9.0)
    assert lasting_root(t, none).shape == (3, 0)


def lattice(columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Readings on a lattice of 10 px across and 20 px down."""
    x_px, y_px = np.meshgrid(10.0 * np.arange(columns), 20.0 * np.arange(rows))
    return x_px.ravel(), y_px.ravel()


def test_cells_are_rows_of_columns_about_their_readings():
    x_px, y_px = lattice(7, 5)
    cells = Cells(x_px, y_px)
    assert (len(cells.middle[0]), len(cells.middle[1])) == (5, 7)
    np.testing.assert_array_equal(cells.index, np.arange(35))
    np.testing.assert_allclose(cells.middle[1], 10.0 * np.arange(7))
    assert cells.side == [20.0, 10.0]
    np.testing.assert_allclose(cells.means(x_px), x_px)
    # over 1000 readings: four to a cell, about their middle
    x_px, y_px = lattice(60, 60)
    grouped = Cells(x_px, y_px)
    assert grouped.count.tolist() == [4] * 900
    np.testing.assert_allclose(grouped.middle[1], 5.0 + 20.0 * np.arange(30))
    row, column = np.divmod(np.arange(900), 30)
    np.testing.assert_allclose(grouped.means(x_px), 5.0 + 20.0 * column)
    np.testing.assert_allclose(grouped.means(y_px), 10.0 + 40.0 * row)
    assert grouped.lengths(0.25)[[0, -1]] == pytest.approx([10.0, 0.25 * 40 * 29])


def test_cells_correlate_as_the_means_over_them_do():
    """Means over a square of a field that falls as exp(-d^2 / 2 L^2): by numbers, to the second
    order of the square over L.
    """
    x_px, y_px = lattice(4, 3)
    cells = Cells(x_px, y_px)
    length_px = 25.0
    eigen, rows, columns = cells.basis(length_px)
    vectors = np.kron(rows, columns)
    correlation = (vectors * eigen) @ vectors.T
    fine = (np.arange(20) - 9.5) / 20
    points = []
    for side, middle in zip((20.0, 10.0), cells.middle, strict=True):
        points.append(middle[:, None] + side * fine)
    means = []
    crossed = []
    at_px = (np.array([13.0]), np.array([21.0]))
    for axis, place_px in ((0, at_px[1]), (1, at_px[0])):
        apart = points[axis][:, :, None, None] - points[axis]
        means.append(np.exp(-(apart**2) / (2 * length_px**2)).mean(axis=(1, 3)))
        off = place_px[:, None, None] - points[axis]
        crossed.append(np.exp(-(off**2) / (2 * length_px**2)).mean(axis=2))
    fourth_order = (20 / length_px) ** 4 / 100
    np.testing.assert_allclose(correlation, np.kron(*means), atol=fourth_order)
    towards = cells.towards(*at_px, length_px)
    np.testing.assert_allclose(towards, np.kron(*crossed), atol=fourth_order)
    values = np.arange(24.0).reshape(12, 2)
    turned = cells.turned(rows, columns, values)
    np.testing.assert_allclose(turned, vectors.T @ values, atol=ROUNDING)


def test_a_cell_with_half_of_its_readings_is_filled():
    """Of four to a cell, one cell has two and another one."""
    x_px, y_px = lattice(60, 60)
    kept = np.ones(len(x_px), dtype=bool)
    kept[(x_px == 100) & (y_px <= 20)] = False
    kept[(x_px >= 200) & (x_px <= 210) & (y_px <= 20)] = False
    kept[(x_px == 200) & (y_px == 0)] = True
    cells = Cells(x_px[kept], y_px[kept])
    assert cells.count[[5, 10]].tolist() == [2, 1]
    assert np.flatnonzero(~cells.filled).tolist() == [10]
    assert cells.typical == pytest.approx((898 * 4 + 2) / 899)


def test_a_rectangle_leaves_the_empty_corner_out():
    x_px, y_px = lattice(12, 12)
    assert _rectangle(x_px, y_px).all()
    # a field without its two last rows but for a single reading
    kept = (y_px < 200) | (x_px == 50)
    inside = _rectangle(x_px[kept], y_px[kept])
    np.testing.assert_array_equal(inside, y_px[kept] < 200)
    assert inside.sum() > MIN_CELLS


TANGENTS = np.array([[0.05, 0.02], [-0.08, 0.03], [0.01, -0.09], [0.1, 0.1]])


def test_decentring_of_the_fifth_order_is_the_gradient_of_its_own_power():
    """r^4 along an axis and r^2 times the place: together, five of it and four of the other, the
    gradient of r^4 x.
    """
    u, v = TANGENTS.T / 0.1
    r2 = u**2 + v**2
    terms = lens._decentring(TANGENTS)
    gradient = terms[:, :, 2] + 4 * terms[:, :, 0]
    np.testing.assert_allclose(gradient, [r2**2 + 4 * r2 * u * u, 4 * r2 * u * v])
    gradient = terms[:, :, 3] + 4 * terms[:, :, 1]
    np.testing.assert_allclose(gradient, [4 * r2 * u * v, r2**2 + 4 * r2 * v * v])


def test_a_tilted_screen_s_terms_are_scales_lean_and_a_perspective_s_second_order():
    u, v = TANGENTS.T / 0.1
    terms = lens._tilted(TANGENTS)
    np.testing.assert_allclose(terms[:, :, 0], [u, -v])
    np.testing.assert_allclose(terms[:, :, 1], [v, u])
    # a perspective moves a place along itself
    for number, factor in enumerate((u * u, u * v, v * v)):
        np.testing.assert_allclose(terms[:, :, 2 + number], [u * factor, v * factor])


def test_a_dot_is_wild_along_either_axis_and_not_by_what_is_smooth(rng):
    """Of errors of 0.1 arcsec about a cubic of 5."""
    x_px, y_px = (rng.uniform(0, side, 400) for side in SIZE_PX)
    read = DotReadings(x_px, y_px, x_px, y_px, np.ones(400))
    u = x_px / 960 - 1
    residual = np.stack([5 * u**3, np.zeros(400)], axis=1) + 0.1 * rng.standard_normal((400, 2))
    residual[17, 0] += 5.0
    residual[41, 1] -= 5.0
    usable = np.ones(400, dtype=bool)
    usable[3] = False
    tame = lens._tame(read, residual, usable, SIZE_PX)
    assert np.flatnonzero(~tame).tolist() == [3, 17, 41]


def test_waves_of_a_tracker_s_pixels_come_back_after_one_pixel():
    place_px = np.array([10.0, 10.25, 11.0, 12.5])
    waves = lens._phases(place_px, place_px[::-1])
    np.testing.assert_allclose(waves[0, :, 0], [0, 1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(waves[0, :, 1], [1, 0, 1, -1], atol=1e-12)
    np.testing.assert_allclose(waves[1, ::-1, 2:], waves[0, :, :2], atol=1e-12)
    assert not waves[0, :, 2:].any()
    assert not waves[1, :, :2].any()


def test_an_orthonormal_basis_leaves_nothing_of_its_terms_and_forgets_what_repeats(rng):
    terms = rng.normal(size=(2, 15, 4)) * [1.0, 1e4, 1e-6, 1.0]
    terms[:, :, 3] = terms[:, :, 0] - 1e-4 * terms[:, :, 1]
    vectors, mix = lens._orthonormal(terms)
    assert vectors.shape == (30, 3)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(terms.reshape(30, 4) @ mix, vectors, atol=1e-6)
    left, by_axis = lens._left_by(vectors, terms.reshape(30, 4) @ [1.0, 2e-4, 3e6, 0.5])
    np.testing.assert_allclose(left, 0.0, atol=1e-9)
    assert left.shape == (2, 15)
    np.testing.assert_array_equal(by_axis[1], vectors[15:])


def test_a_thousand_dots_are_all_over_the_field():
    usable = np.ones(4500, dtype=bool)
    usable[:300] = False
    thinned = lens._thinned(usable)
    places = np.flatnonzero(thinned)
    assert places[0] == 300
    assert set(np.diff(places).tolist()) == {4}
    assert not thinned[:300].any()
    few = np.arange(900) % 2 == 0
    np.testing.assert_array_equal(lens._thinned(few), few)


@pytest.mark.parametrize("number", range(len(fits.BROWN_CONRADY)))
def test_a_lens_s_slopes_are_how_far_a_number_moves_the_directions_it_shows(number):
    """A ray of the lens that has the number, less one of the lens that has not."""
    flat = Camera((800, 600), 4000.0, (399.5, 299.5), np.eye(3))
    nominal = fits.Nominal(flat, lens.STILL[0], flat)
    model = fits.Model(fits.BROWN_CONRADY)
    numbers = np.zeros(model.size)
    fitted = fits.Fit(model, 0, numbers, fits.geometry_of(model, nominal, lens.STILL, numbers))
    slopes = lens._lens_terms(fitted, flat, TANGENTS)[:, :, number]
    step = np.zeros(model.size)
    step[number] = 1e-3
    moved = []
    for sign in (1, -1):
        camera = fits.geometry_of(model, nominal, lens.STILL, sign * step).monitor
        moved.append(lens._tangents(camera, flat, TANGENTS))
    wanted = (moved[0] - moved[1]).T / 2e-3 * ARCSEC_PER_RAD
    # second order in a step of either, and 1e-9 of a place by rounding
    largest = np.abs(wanted).max()
    assert largest > 0
    np.testing.assert_allclose(slopes, wanted, atol=0.01 * largest)


@pytest.mark.parametrize(("degree", "polynomials"), [(0, 10), (7, 36), (9, 55)])
def test_a_lens_is_its_numbers_and_cubics_or_polynomials_of_a_degree_alone(degree, polynomials):
    """A polynomial of two variables has (d + 1) (d + 2) / 2 terms, along either axis apart."""
    flat = Camera((800, 600), 4000.0, (399.5, 299.5), np.eye(3))
    nominal = fits.Nominal(flat, lens.STILL[0], flat)
    model = fits.Model(fits.BROWN_CONRADY)
    numbers = np.zeros(model.size)
    fitted = fits.Fit(model, 0, numbers, fits.geometry_of(model, nominal, lens.STILL, numbers))
    terms = lens._terms(fitted, flat, TANGENTS, flat.places_px(*TANGENTS.T), degree)
    of_lens = lens._lens_terms(fitted, flat, TANGENTS)
    own = 0 if degree else of_lens.shape[2]
    assert terms.shape == (2, len(TANGENTS), own + 2 * polynomials)
    np.testing.assert_array_equal(terms[:, :, :own], of_lens[:, :, :own])
    along, across = terms[:, :, own : own + polynomials], terms[:, :, own + polynomials :]
    np.testing.assert_array_equal(along[0], across[1])
    assert not along[1].any() and not across[0].any()


def test_a_square_s_evenness_is_the_mean_of_its_rows_and_columns(tmp_path: Path):
    """Of a map of light at places as many as the screen's pixels, relative to its largest."""
    even = np.arange(1.0, 41.0).reshape(5, 8) / 40
    np.savetxt(tmp_path / "even.csv", even, delimiter=",")
    (tmp_path / "r.csv").write_text("code,w\n0,0\n99,0.3\n255,1\n")
    head = '[calibration]\nkind = "photometric"\nwho = ""\nwhen = ""\ninstrument = ""\nunit = ""\n'
    head += 'bits = 8\nresponse = "r.csv"\n'
    squares = []
    for more in ('[uniformity]\nfile = "even.csv"\n', ""):
        (tmp_path / "light.toml").write_text(head + more)
        text = BENCH.format(calibration="light.toml", delay_ms=8.0, geometry="", white=1e6)
        file = bench_file_of(tmp_path / "bench.toml", text.replace("[1920, 1080]", "[8, 5]"))
        squares.append(estimates._evenness_in(file, (4, 1, 2)))
    # rows 1 and 2, columns 4 and 5
    assert squares == [pytest.approx((13 + 14 + 21 + 22) / 4 / 40), 1.0]


def test_a_finer_grid_has_both_ends_and_no_larger_step():
    for values, step in ((RATIOS, 1.12), (np.array([3.0, 10.0]), 1.08)):
        finer = _finer(values, step)
        assert (finer[0], finer[-1]) == pytest.approx((values[0], values[-1]))
        ratios = finer[1:] / finer[:-1]
        assert ratios.max() <= step
        assert np.ptp(ratios) < 1e-9


def test_evenness_scatters_by_what_a_fit_to_dots_leaves_of_a_screen_s_structure():
    """Of a field with K = exp(-d^2 / 2 L^2), stars less the fit to dots: K, less twice what is
    common to both, and the fit's own.
    """
    x_px, y_px = lattice(12, 9)
    x_px = 400 + 4 * x_px
    y_px = 300 + 2 * y_px
    nothing = Structure(np.array([150.0, 60.0]), np.array([2.0, 0.5]), 1.0, 9.0)
    fit = Surface(1, SIZE_PX, np.zeros((3, 1)), np.eye(3), 10.0, 1.0)
    terms = fit.terms(x_px, y_px)
    solve = np.linalg.pinv(terms)
    even = estimates.Evenness(fit, Cells(x_px, y_px), solve, nothing)
    star_x, star_y = np.array([500.0, 700.0, 650.0]), np.array([350.0, 420.0, 520.0])
    shares = np.array([[0.5, 0.5, 0.0], [0.0, 0.0, 1.0]])
    covariance = np.zeros((2, 2))
    all_x, all_y = np.append(star_x, x_px), np.append(star_y, y_px)
    weights = np.hstack([shares, -shares @ fit.terms(star_x, star_y) @ solve])
    for length, variance in nothing.parts():
        apart = (all_x[:, None] - all_x) ** 2 + (all_y[:, None] - all_y) ** 2
        covariance += variance * weights @ np.exp(-apart / (2 * length**2)) @ weights.T
    factors = even.scatter(star_x, star_y, shares)
    # a dot stands for its cell of 40 px, whose mean correlates less: (40 / 60)^2 / 12, squared
    np.testing.assert_allclose(factors.T @ factors, covariance, rtol=0.05)


def test_black_and_light_scatter_by_their_own_readings():
    codes = np.array([0] * 4 + [50, 100, 150, 200, 255] * 2)
    bright = 1000.0 * np.array([1, 2, 3, 4, 5])
    light = np.concatenate([[1.0, 2.0, 3.0, 6.0], 1.01 * bright, 0.99 * bright])
    read = LightReadings(codes, light, np.zeros(14))
    fit = _LightFit(read)
    # of 1, 2, 3 and 6 about 3, with a freedom of 3
    assert fit.floor == pytest.approx(math.sqrt(14 / 3))
    assert (fit.dark_dof, fit.light_dof) == (pytest.approx(3), pytest.approx(5))
    # 1 % to each side, ten of them with a freedom of five, relative to the light above black
    relative = 0.01 * bright / (bright - 3.0)
    assert fit.noise == pytest.approx(math.sqrt(2 * (relative**2).sum() / 5))
    np.testing.assert_allclose(fit.solution[:6], [3.0, *bright])


@pytest.mark.parametrize(("dark", "lit"), [(1, 3), (6, 1)])
def test_black_and_light_are_both_read_more_than_once(dark, lit):
    """The scatter of the one says nothing of the other's."""
    codes = np.array([0] * dark + [50, 100, 150, 200, 255] * lit)
    light = 10.0 * codes + np.arange(len(codes))
    with pytest.raises(InputError, match="white and black are read too seldom"):
        _LightFit(LightReadings(codes, light, np.zeros(len(codes))))


def test_white_within_the_scatter_of_black_is_no_light(tmp_path):
    """300 above a black of four readings, whose mean is known to 258."""
    text = BENCH.format(calibration="light.toml", delay_ms=8.0, geometry="", white=1e6)
    file = bench_file_of(tmp_path / "bench.toml", text)
    codes = np.array([0] * 4 + [50, 100, 150, 200, 255] * 2)
    lit = 600.0 + 60.0 * np.arange(1, 6)
    light = np.concatenate([[0.0, 400.0, 800.0, 1200.0], lit, lit])
    read = LightReadings(codes, light, np.zeros(14))
    assert "white reads no light above black" in refusal(light_deviation, file, read)


def test_a_certificate_has_the_hashes_of_the_bench_s_files_and_of_those_that_they_name(
    tmp_path: Path,
) -> None:
    """Of a name that is built in, or of no file, it has none."""
    folder = tmp_path / "light"
    folder.mkdir()
    files = {
        "light/monitor.toml": '[calibration]\nresponse = "r.csv"\n[uniformity]\nfile = "u.csv"\n',
        "light/r.csv": "code,w\n0,0\n",
        "light/u.csv": "1,1\n",
        "qe.csv": "wavelength_nm,qe\n",
        "lens.toml": "[distortion]\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    text = BENCH.format(
        calibration="light/monitor.toml",
        delay_ms=8.0,
        geometry='geometry = "missing.toml"',
        white=1e6,
    )
    text = text.replace('"ccd47-20"', '"qe.csv"')
    text = text.replace("[tracker]\n", '[tracker]\ndistortion = "lens.toml"\n')
    bench = bench_file_of(tmp_path / "bench.toml", text)
    expected = {name: sha256(text.encode()).hexdigest() for name, text in files.items()}
    expected["bench.toml"] = sha256(text.encode()).hexdigest()
    assert files_of(bench) == expected


def test_values_that_alternate_have_hardly_a_structure_in_time_and_the_noise_of_their_fit():
    """Of 60 readings every second, with a pause of ten minutes after the half of them."""
    t_s = np.arange(60.0)
    t_s[30:] += 600.0
    value = 3.0 * (-1.0) ** np.arange(60)
    structure = in_time(t_s, value, np.ones((60, 1)))
    assert structure.total < 0.01 * structure.noise_variance
    assert structure.noise_variance == pytest.approx(9.0 * 60 / 59, rel=0.01)
    # from half of a usual step to all of them
    assert structure.length[[0, -1]] == pytest.approx([0.5, 60.0])


def test_structure_that_would_have_shown_is_none_and_the_noise_is_that_of_the_residuals():
    """The squares of thirty combinations that a structure would make large are a quarter, and those
    of thirty others 4; a mean is fitted.
    """
    eigen = np.repeat([1e4, 0.0], 30)
    value = np.concatenate([np.tile([0.5, -0.5], 15), np.tile([2.0, -2.0], 15)])
    spread = Spread(eigen, value, np.full((60, 1), 1 / math.sqrt(60)))
    lengths = np.array([1.0, 2.0])
    structure = weighed(lengths, [spread, spread])
    assert structure.total == 0.0 and not list(structure.parts())
    assert math.isinf(structure.dof)
    assert structure.noise_variance == pytest.approx(30 * (0.25 + 4) / 59)


@pytest.mark.parametrize("axes", [1, 2])
def test_the_noise_of_readings_in_place_is_that_of_one_along_an_axis(rng, axes):
    """Three readings of each dot."""
    lattice = np.meshgrid(np.arange(20.0), np.arange(15.0))
    x, y = (np.repeat(part.ravel() * 20.0, 3) for part in lattice)
    terms = np.ones((axes, len(x), 1))
    found = in_place(x, y, 3.0 * rng.normal(size=(axes, len(x))), terms)
    four_sigma = 4 * math.sqrt(2 / (axes * len(x)))
    assert found.noise_variance == pytest.approx(9.0, rel=four_sigma)
