"""What a bench file states of its own errors, as it moves a certificate's figures: each by a closed
form, on stars whose places a test chooses.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from hilstar.basics.rotation import from_rotation_vector, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.certify.effects import Effect
from hilstar.instruments.certify.estimates import surface
from hilstar.instruments.certify.model import Deviations, Figures
from hilstar.instruments.certify.read_effects import _of_delays, _places_in, map_at
from hilstar.instruments.certify.stated_effects import (
    DRIFTS,
    of_drift,
    of_files,
    of_settings,
    of_warm_up,
    stated_delay,
)
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from tests.support.planted_certify import BENCH, reference_star

# The tracker of the planted bench: 512 px from its middle, 70 mm in pixels of 13 um.
EDGE_TANGENT = 512 / (70 / 0.013)
WIDTH_PX, HEIGHT_PX = 1920, 1080
# Of each star: its place on the monitor, px, and the tangents of its direction, in edges of the
# field. No two are alike along an axis, so that axes that are swapped show.
PLACES = ((300.0, 200.0), (960.0, 100.0), (1500.0, 900.0), (700.0, 600.0))
TANGENTS = ((0.0, 0.0), (0.6, -0.2), (-0.3, 0.8), (0.2, 0.5))
COUNT = len(PLACES)
SHARES = (0.7, 0.3)  # of a star's light, on pixels of two levels
TURN_ARCSEC = (3.0, -5.0, 40.0)
# A turn of 40 arcsec squared, over the field's edge, in arcsec: what first order leaves out.
SECOND_ORDER_ARCSEC = 40**2 / ARCSEC_PER_RAD


def bench(folder: Path, keys: str = "", calibration: str = "srgb", geometry: str = "") -> BenchFile:
    """The planted bench with more keys."""
    path = folder / "bench.toml"
    text = BENCH.format(calibration=calibration, delay_ms=8.0, geometry=geometry, white=2.6e6)
    path.write_text(text + keys)
    return read_bench_file(path)


LIGHT = """[calibration]
kind = "photometric"
who = ""
when = ""
instrument = ""
unit = ""
bits = 8
response = "light.csv"
"""


def bench_of_light(folder: Path, more: str) -> BenchFile:
    """The planted bench with a light file of a power of 2.2, and more tables in it."""
    rows = "".join(f"{code},{(code / 255) ** 2.2!r}\n" for code in range(256))
    (folder / "light.csv").write_text("code,w\n" + rows)
    (folder / "light.toml").write_text(LIGHT + more)
    return bench(folder, calibration="light.toml")


def figures_of(file: BenchFile) -> Figures:
    """The figures of the stars above, all of one field."""
    stars = []
    for number, ((x_px, y_px), tangent) in enumerate(zip(PLACES, TANGENTS, strict=True)):
        direction = np.append(EDGE_TANGENT * np.array(tangent), 1.0)
        light = {"log_light": np.log([0.5, 0.1]), "share": np.array(SHARES)}
        place = {"x_px": x_px, "y_px": y_px, "direction": direction / np.linalg.norm(direction)}
        stars.append(reference_star(hip=number, row=number, **light, **place))
    return Figures(file, stars)


def as_stated() -> Deviations:
    """A bench that is as its file says."""
    return Deviations(
        np.ones((1, 2)), np.zeros((1, COUNT)), np.zeros((1, COUNT, 2)), np.full(1, 8.0), np.zeros(1)
    )


def by_name(effects: list[Effect]) -> dict[str, Effect]:
    """Effects by the names of their inputs."""
    return {effect.input.name: effect for effect in effects}


@pytest.fixture
def settings(tmp_path) -> dict[str, Effect]:
    """The effects of a bench that states each error of [certify]."""
    file = bench(
        tmp_path,
        """[certify]
rate_deg_s = 0.5
jitter_ms = 0.3
clock_ms = 0.2
temperature_k = 2.0
flux_mag_per_k = 0.01
place_arcsec_per_k = 0.4
instrument = { name = "photometer", relative_expanded = 0.03, k = 3.0 }
[certify.tracker]
direction_expanded_arcsec = 1.0
focal_expanded_relative = 4e-4
distortion_expanded_arcsec = 6.0
evenness_expanded_relative = 0.02
linearity_expanded_relative = 0.01
""",
    )
    missing: list[str] = []
    effects = by_name(list(of_settings(file, figures_of(file), missing)))
    assert missing == []
    return effects


def test_an_expanded_uncertainty_is_divided_by_its_factor(settings):
    assert settings["instrument"].even == pytest.approx(np.full((1, COUNT), 0.01))
    assert settings["tracker's linearity"].even == pytest.approx(np.full((1, COUNT), 0.005))
    focal_arcsec = 2e-4 * ARCSEC_PER_RAD * EDGE_TANGENT * np.array(TANGENTS)
    assert settings["tracker's focal length"].place == pytest.approx(focal_arcsec[None])
    assert (settings["clock"].late, settings["prediction"].late) == ([0.2], [0.3])


def test_a_range_of_temperatures_is_a_rectangle(settings):
    kelvin = 2.0 / math.sqrt(3)
    warmth = settings["temperature"]
    # a change of 1 % is 0.010857 mag
    assert warmth.even.sum(axis=0) == pytest.approx(0.01 * kelvin * math.log(10) / 2.5)
    along, across = np.moveaxis(warmth.place, 2, 0)
    assert along.sum(axis=0) == pytest.approx(0.4 * kelvin)
    assert across.sum(axis=0) == pytest.approx(0.4 * kelvin)
    assert not (along * across).any()  # two errors, each along its own axis


def test_a_tracker_s_distortion_is_radial_and_grows_as_the_cube_to_what_is_stated_at_the_edge(
    settings,
):
    (moved,) = settings["tracker's distortion"].place
    tangents = np.array(TANGENTS)
    radius = np.hypot(*tangents.T)
    assert np.hypot(*moved.T) == pytest.approx(3.0 * radius**3)
    assert (moved * tangents).sum(axis=1) == pytest.approx(3.0 * radius**4)


def apart_squared() -> np.ndarray:
    """The squares of how far stars are from each other, in edges of the field (n, n)."""
    tangents = np.array(TANGENTS)
    return np.asarray(((tangents[:, None] - tangents) ** 2).sum(axis=2))


def test_a_tracker_s_errors_of_direction_and_evenness_are_alike_over_half_of_its_field(settings):
    alike = np.exp(-apart_squared() / 2)
    place = settings["tracker's lens"].place
    for axis in (0, 1):
        slopes = place[..., axis]
        assert slopes.T @ slopes == pytest.approx(0.5**2 * alike, abs=1e-9)
    assert not np.any(place[..., 0] * place[..., 1])
    even = settings["tracker's evenness"].even
    # relative to the middle, where the first star is
    from_middle = even.T @ even
    assert from_middle[0] == pytest.approx(np.zeros(COUNT), abs=1e-9)
    assert np.diag(from_middle) == pytest.approx(2 * 0.01**2 * (1 - alike[0]), abs=1e-12)


def test_each_effect_has_slopes_by_as_many_variables_as_its_input_has(settings):
    for name, effect in settings.items():
        slopes = (effect.levels, effect.even, effect.place, effect.delay, effect.late, effect.sky)
        counts = [len(by_variable) for by_variable in slopes if by_variable is not None]
        assert counts, name
        assert set(counts) == {effect.input.size}, name


def test_a_warm_up_is_as_seen_or_else_as_stated_in_per_cent(tmp_path):
    file = bench(tmp_path, "[certify]\nwarm_up_percent = 0.6\n")
    stated_u = 0.006 / math.sqrt(3)
    for change, u in ((None, stated_u), (0.001, 0.001 / math.sqrt(3))):
        (effect,) = of_warm_up(file, COUNT, change, [])
        assert effect.even == pytest.approx(np.full((1, COUNT), u))
    missing: list[str] = []
    assert list(of_warm_up(bench(tmp_path), COUNT, None, missing)) == []
    assert missing[0].startswith("warm-up: ")


def test_what_checks_saw_moves_what_each_of_them_is_of(tmp_path):
    file = bench(tmp_path)
    figures = figures_of(file)
    largest = (0.5, 0.7, 1.1, 9.0, 30.0, 0.4)  # %, arcsec, arcsec, arcsec, ppm, ms
    (drift,) = of_drift(figures, dict(zip(DRIFTS, largest, strict=True)), [])
    tangents = EDGE_TANGENT * np.array(TANGENTS)
    place = np.zeros((len(DRIFTS), COUNT, 2))
    place[1, :, 0] = 0.7
    place[2, :, 1] = 1.1
    # a small turn about the boresight carries x to y, and y to -x
    place[3] = 9.0 * np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    place[4] = 30e-6 * ARCSEC_PER_RAD * tangents
    assert drift.place * math.sqrt(3) == pytest.approx(place)
    assert drift.even[0] * math.sqrt(3) == pytest.approx(np.full(COUNT, 0.005))
    assert not drift.even[1:].any()
    assert drift.delay * math.sqrt(3) == pytest.approx([0, 0, 0, 0, 0, 0.4])


def test_a_bench_that_states_nothing_says_what_is_not_assessed(tmp_path):
    file = bench(tmp_path)
    figures = figures_of(file)
    value = as_stated()
    missing: list[str] = []
    assert list(of_files(file, figures, value, missing)) == []
    assert list(of_settings(file, figures, missing)) == []
    assert list(of_drift(figures, None, missing)) == []
    subjects = {line.partition(":")[0] for line in missing}
    assert subjects >= {
        *("flux", "full scale", "evenness", "place and attitude", "latency", "vignetting"),
        *("linearity", "absolute scale of the light", "temperature", "motion"),
        "drift since the certificate",
    }


def test_a_stated_delay_is_an_effect_of_the_delay_alone(tmp_path):
    (effect,) = stated_delay(bench(tmp_path, "[certify]\npanel_delay_u_ms = 0.2\n"), [])
    assert effect.delay == [0.2]
    assert (effect.late, effect.place, effect.even) == (None, None, None)


def test_a_photodiode_s_edges_tell_their_mean_by_the_root_of_their_number(rng):
    """White noise of 0.4 ms over 100 edges: 0.04 ms, known to 1 / sqrt(2 n)."""
    count = 100
    effects = by_name(list(_of_delays(8.0 + 0.4 * rng.standard_normal(count))))
    (error_ms,) = effects["delay"].delay
    assert error_ms == pytest.approx(0.04, rel=5 / math.sqrt(2 * count))


GEOMETRY = f"""kind = "hilstar geometry 1"
resolution_px = [{WIDTH_PX}, {HEIGHT_PX}]
focal_length_px = 6071.0
principal_point_px = [959.5, 539.5]
q_cam_to_mon = [1.0, 0.0, 0.0, 0.0]
[error]
"""


def of_geometry(folder: Path, error: str) -> dict[str, Effect]:
    """The effects of a geometry file with a table [error]."""
    (folder / "lens.toml").write_text(GEOMETRY + error)
    file = bench(folder, geometry='geometry = "lens.toml"')
    value = as_stated()
    return by_name(list(of_files(file, figures_of(file), value, [])))


def test_a_map_of_errors_is_read_where_each_star_is_half_of_its_square_along_each_axis(tmp_path):
    """Its places are the screen's edges and what is between them: 1 + 3 of the way down + 2 of the
    way along it.
    """
    rows = [[1.0 + 3 * down + 2 * along for along in (0.0, 0.5, 1.0)] for down in (0.0, 1.0)]
    place = of_geometry(tmp_path, f"map_arcsec = {rows}\n")["geometry"].place
    x_px, y_px = np.array(PLACES).T
    known = 1 + 3 * (y_px + 0.5) / HEIGHT_PX + 2 * (x_px + 0.5) / WIDTH_PX
    assert place.shape == (2, COUNT, 2)
    for axis in (0, 1):
        other = 1 - axis
        assert place[axis, :, axis] == pytest.approx(known / math.sqrt(2))
        assert not place[axis, :, other].any()


def test_a_place_whose_error_is_not_known_has_the_largest_of_the_map(tmp_path):
    """Below 0 is unknown: the first of six, of which the largest is 7."""
    rows = [[-1.0, 2.0, 3.0], [4.0, 7.0, 5.0]]
    place = of_geometry(tmp_path, f"map_arcsec = {rows}\n")["geometry"].place
    places = (np.array([-0.5, HEIGHT_PX - 0.5]), np.array([-0.5, 959.5, WIDTH_PX - 0.5]))
    known = RegularGridInterpolator(places, [[7.0, 2.0, 3.0], [4.0, 7.0, 5.0]])
    x_px, y_px = np.array(PLACES).T
    assert place[0, :, 0] * math.sqrt(2) == pytest.approx(known((y_px, x_px)))


def test_the_modes_of_a_map_move_each_star_by_their_own_x_and_y_there(tmp_path):
    """Two modes of two rows by three columns, each x at all places and then y; linear between."""
    modes = np.array([[[1, 2, 4], [3, 5, 6]], [[-2, 0, 1], [7, -3, 2]]], dtype=float)
    modes = np.stack([modes, 10 - 2 * modes], axis=1)
    error = f"map_arcsec = {np.ones((2, 3)).tolist()}\nmodes_arcsec = "
    effect = of_geometry(tmp_path, error + f"{modes.reshape(2, -1).tolist()}\n")["geometry"]
    places = (np.array([-0.5, HEIGHT_PX - 0.5]), np.array([-0.5, 959.5, WIDTH_PX - 0.5]))
    x_px, y_px = np.array(PLACES).T
    assert effect.place.shape == (2, COUNT, 2) and effect.input.size == 2
    for number, axis in np.ndindex(2, 2):
        known = RegularGridInterpolator(places, modes[number, axis])
        assert effect.place[number, :, axis] == pytest.approx(known((y_px, x_px)))


@pytest.mark.parametrize(
    ("freedom", "distribution", "dof"),
    [("", "normal", math.inf), ("flux_at_white_dof = 12\n", "Student t", 12.0)],
)
def test_a_full_scale_that_is_stated_moves_all_stars_alike(tmp_path, freedom, distribution, dof):
    file = bench(tmp_path, "[certify]\nflux_at_white_relative = 0.02\n" + freedom)
    effect = by_name(list(of_files(file, figures_of(file), as_stated(), [])))["full scale"]
    assert effect.even == pytest.approx(np.full((1, COUNT), 0.02))
    about = effect.input
    assert (about.distribution, about.dof, about.standard) == (distribution, dof, 0.02)


def test_an_alignment_s_covariance_turns_the_sky_about_its_own_axes(tmp_path):
    """In the middle of the field a turn about x moves a star along y, and one about y along x."""
    error = "alignment_covariance_arcsec2 = [[4, 0, 0], [0, 9, 0], [0, 0, 100]]\n"
    effect = of_geometry(tmp_path, error)["alignment"]
    covariance = np.einsum("ksi,ksj->sij", effect.place, effect.place)
    assert covariance[0] == pytest.approx(np.diag([9.0, 4.0]))
    assert effect.input.standard == pytest.approx(math.sqrt((4 + 9 + 100) / 3))
    # a star beside the middle also goes round it, by as much as it is beside
    u, v = EDGE_TANGENT * np.array(TANGENTS[1])
    along = 9 * (1 + u**2) ** 2 + 4 * (u * v) ** 2 + 100 * v**2
    assert covariance[1, 0, 0] == pytest.approx(along)
    # turns that go together: a star that goes up for one goes to the other side for the other
    mixed = "alignment_covariance_arcsec2 = [[4, 2, 0], [2, 9, 1], [0, 1, 100]]\n"
    place = of_geometry(tmp_path, mixed)["alignment"].place
    covariance = np.einsum("ksi,ksj->sij", place, place)
    assert covariance[0] == pytest.approx(np.array([[9.0, -2.0], [-2.0, 4.0]]))


def test_levels_of_a_calibration_move_the_light_that_stars_have_of_them(tmp_path):
    """Level 0.5 is off by 2 %, level 0.1 by none; white is full scale, and has no error of its own."""
    light = [0.01, 0.1, 0.5, 1.0]
    file = bench_of_light(
        tmp_path,
        f"[errors]\nlight = {light}\n"
        "off = [0.0, 0.0, 0.02, 0.0]\nrelative = [0.0, 0.03, 0.04, 0.0]\ndof = 20.0\n",
    )
    figures = figures_of(file)
    value = as_stated()
    response = by_name(list(of_files(file, figures, value, [])))["response"]
    assert np.exp(figures.log_light) == pytest.approx([0.1, 0.5])  # rising
    assert value.levels[0] == pytest.approx([1.0, 1.02])
    spread = np.sqrt((response.levels**2).sum(axis=0))
    assert spread == pytest.approx([0.03, 0.04])


def test_levels_are_relative_to_white_with_what_they_have_in_common(tmp_path):
    """Errors of black, which are 0.002 of white in all levels, and each level's own beside them."""
    light, common = np.array([0.05, 0.1, 0.5, 1.0]), 0.002
    relative = np.array([0.06, 0.03, 0.04, 0.01])
    off = np.array([0.03, -0.01, 0.02, 0.005])
    file = bench_of_light(
        tmp_path,
        f"[errors]\nlight = {light.tolist()}\n"
        f"off = {off.tolist()}\nrelative = {relative.tolist()}\ndof = 20.0\ncommon = {common}\n",
    )
    value = as_stated()
    response = by_name(list(of_files(file, figures_of(file), value, [])))["response"]
    black = common / light
    own = relative**2 - black**2
    of_stars = slice(1, 3)  # the stars' two levels are read themselves
    assert value.levels[0] - 1 == pytest.approx(off[of_stars] - off[-1])
    variance = own[of_stars] + own[-1] + (black[of_stars] - black[-1]) ** 2
    assert (response.levels**2).sum(axis=0) == pytest.approx(variance)
    (product,) = [response.levels[:, 0] @ response.levels[:, 1]]
    apart = black[of_stars] - black[-1]
    assert product == pytest.approx(own[-1] + apart[0] * apart[1])


def test_places_that_a_turn_moves_are_that_turn_of_the_attitude(tmp_path):
    file = bench(tmp_path)
    figures = figures_of(file)
    (moved,) = figures.turned(np.array([TURN_ARCSEC]))
    turn = to_matrix(from_rotation_vector(np.array(TURN_ARCSEC) / ARCSEC_PER_RAD))
    rays = np.column_stack([EDGE_TANGENT * np.array(TANGENTS), np.ones(COUNT)]) @ turn.T
    exact = ARCSEC_PER_RAD * (rays[:, :2] / rays[:, 2:] - EDGE_TANGENT * np.array(TANGENTS))
    assert moved == pytest.approx(exact, abs=SECOND_ORDER_ARCSEC)
    off = Deviations(
        np.ones((1, 2)), np.zeros((1, COUNT)), moved[None], np.full(1, 8.0), np.zeros(1)
    )
    figure = dict(zip(figures.names, figures.of(off)[0].tolist(), strict=True))
    for axis, arcsec in zip("xyz", TURN_ARCSEC, strict=True):
        measured = figure[f"attitude_{axis}", -1, "arcsec"]
        assert measured == pytest.approx(arcsec, abs=10 * SECOND_ORDER_ARCSEC)


def test_dimmer_levels_and_places_add_up_in_magnitudes_and_late_light_lags(tmp_path):
    """10 % less on the level of 70 % of a star's light, and 1 % less at its place; light 2 ms late
    at 0.5 deg/s.
    """
    file = bench(tmp_path, "[certify]\nrate_deg_s = 0.5\n")
    figures = figures_of(file)
    levels = np.array([[1.0, 0.9]])  # rising: the brighter is the second
    even = np.full((1, COUNT), -0.01)
    off = Deviations(levels, even, np.zeros((1, COUNT, 2)), np.full(1, 9.5), np.full(1, 0.5))
    figure = dict(zip(figures.names, figures.of(off)[0].tolist(), strict=True))
    fainter_mag = -2.5 * math.log10(0.7 * 0.9 + 0.3) + 2.5 * math.log10(math.e) * 0.01
    for star in range(COUNT):
        assert figure["flux", star, "mag"] == pytest.approx(fainter_mag)
        assert figure["place_along", star, "arcsec"] == pytest.approx(-0.5 * 3600 * 0.002)
        assert figure["place_across", star, "arcsec"] == 0.0
    assert figure["latency", 0, "ms"] == pytest.approx(9.5)


def falling_light(x_px, y_px):
    """The log of a screen's light, which falls with the square of the distance from a corner."""
    return -0.3 * (x_px / WIDTH_PX) ** 2 - 0.2 * (y_px / HEIGHT_PX) ** 2


def test_the_light_at_a_star_is_half_way_between_a_smooth_screen_and_a_map_of_16_by_9_fields():
    """Relative to the square where light was read; the map is SciPy's, linear between its
    fields' middles.
    """
    x_px, y_px = (
        grid.ravel() for grid in np.meshgrid(np.arange(60, 1900, 90), np.arange(40, 1060, 90))
    )
    dots = surface(x_px, y_px, falling_light(x_px, y_px)[:, None], (2,), (WIDTH_PX, HEIGHT_PX))
    columns_px = (np.arange(16) + 0.5) * WIDTH_PX / 16 - 0.5
    rows_px = (np.arange(9) + 0.5) * HEIGHT_PX / 9 - 0.5
    fields = falling_light(columns_px[:, None], rows_px)
    linear = RegularGridInterpolator((columns_px, rows_px), fields)
    star_x_px, star_y_px = np.array(PLACES).T
    left, top, side = 1100, 300, 70
    square = np.meshgrid(left + np.arange(4.5, side, 10), top + np.arange(4.5, side, 10))

    at_stars = map_at(dots, (left, top, side), star_x_px, star_y_px)

    smooth = falling_light(star_x_px, star_y_px) - falling_light(*square).mean()
    square_px = np.rint(np.array(square).reshape(2, -1).T)
    of_map = linear(np.array(PLACES)) - linear(square_px).mean()
    assert at_stars.smooth == pytest.approx(smooth, abs=1e-9)
    assert np.abs(smooth - of_map).max() > 1e-4
    assert at_stars.midway == pytest.approx((smooth + of_map) / 2, abs=1e-6)


@pytest.mark.parametrize("square", [(100, 40, 1), (100, 40, 2), (1500, 7, 301)])
def test_places_in_a_square_are_even_over_its_pixels(square):
    """From the first pixel's outer edge to the last one's: pixel k reaches from k - 0.5 to
    k + 0.5, so that the mean place and its variance are those of an even square.
    """
    left, top, side = square
    x_px, y_px = _places_in(square)
    for places_px, first in ((x_px, left), (y_px, top)):
        assert places_px.mean() == pytest.approx(first + (side - 1) / 2, abs=1e-9)
        assert first - 0.5 < places_px.min() and places_px.max() < first + side - 0.5
    # of n even steps over a side: side^2 / 12 less 1 / n^2 of it
    steps = math.isqrt(len(x_px))
    assert x_px.var() == pytest.approx(side**2 / 12 * (1 - 1 / steps**2), rel=1e-9)
    assert (x_px @ y_px) / len(x_px) == pytest.approx(x_px.mean() * y_px.mean())


def test_fields_of_a_light_map_are_each_off_by_themselves_and_stars_share_them(tmp_path):
    """Three fields along and two down, each known to 2 %: a star has what linear weights give it of
    the four about it, which go on beyond the outermost.
    """
    (tmp_path / "even.csv").write_text("1.0,0.98,0.9\n0.97,1.0,0.95\n")
    file = bench_of_light(tmp_path, '[uniformity]\nfile = "even.csv"\nrelative = 0.02\n')
    value = as_stated()
    even = by_name(list(of_files(file, figures_of(file), value, [])))["evenness"]
    columns = (np.arange(3) + 0.5) * WIDTH_PX / 3 - 0.5
    rows = (np.arange(2) + 0.5) * HEIGHT_PX / 2 - 0.5
    weights = np.zeros((COUNT, 6))
    for field in range(6):
        unit = np.zeros(6)
        unit[field] = 1.0
        map_of = RegularGridInterpolator(
            (rows, columns), unit.reshape(2, 3), bounds_error=False, fill_value=None
        )
        weights[:, field] = [map_of((y, x)).item() for x, y in PLACES]
    covariance = even.even.T @ even.even
    assert covariance == pytest.approx(0.02**2 * weights @ weights.T)
    assert even.input.standard == 0.02
