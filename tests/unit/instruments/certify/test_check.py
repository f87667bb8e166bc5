"""What a check of a certified bench tells from noise, by SciPy's distributions; what it tells of
changes that are planted; and the table of all checks.
"""

from __future__ import annotations

import datetime
import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.stats import f, t

from hilstar.basics.errors import InputError
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.certify.bench_readings import geometry_of
from hilstar.instruments.certify.check import (
    TOLERANCES,
    CheckFigure,
    CheckReadings,
    _Change,
    by_bench_file,
    checks_in,
    compare,
    largest_changes,
    read_reference,
    record,
    take_check,
    watch,
)
from hilstar.server.bench.bench_file import BenchFile
from tests.support.card_texts import drawn_figures
from tests.support.planted_certify import stated_bench
from tests.support.planted_readings import DELAY_MS, WHITE_E_PER_S, PlantedReader, Truth, supposed
from tests.support.refusals import refusal
from tests.support.tables import csv_rows

# of a change that is none, told as one: so many of a million
PROBABILITY = 1e-4
# A change of 0.2 % is told to a fiftieth of it, by what is of second order in it.
SECOND_ORDER = 0.02
# The noise of 2000 numbers is known to 1 / sqrt(2 n): three of these. What a pixel is off the middle
# is 1 % less at the edge of the field.
NOISE_ERROR = 0.06


@pytest.mark.parametrize("dof", [3.0, 20.0, 1e6])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_change_is_told_where_noise_of_either_sign_would_make_it_as_rarely_as_asked(dof, sign):
    tolerance, _ = TOLERANCES["latency"]
    limit = tolerance + 0.02 * t.isf(PROBABILITY / 2, dof)
    for value, in_tolerance in ((0.99 * limit, True), (1.01 * limit, False)):
        figure = _Change("latency", sign * value, 0.02, dof).judged(PROBABILITY)
        assert figure.threshold == pytest.approx(limit, rel=1e-6)
        assert bool(figure.in_tolerance) is in_tolerance
        assert (figure.upper - figure.lower) / 2 == pytest.approx(0.02 * t.isf(0.025, dof))


def test_a_root_mean_square_is_told_by_f():
    tolerance, _ = TOLERANCES["psf"]
    limit = math.hypot(tolerance, 0.3 * math.sqrt(f.isf(PROBABILITY, 12.0, 40.0)))
    assert _Change("psf", limit, 0.3, 40.0, 12.0).judged(PROBABILITY).threshold == pytest.approx(
        limit
    )


def scattered(light: np.ndarray, relative: float, black_off: float) -> np.ndarray:
    """Three readings of each code's light (k,), (k, 3), of a relative scatter and one in black."""
    spread = relative * light
    spread[0] = black_off
    return np.asarray(light[:, None] + spread[:, None] * [-1.0, 0.0, 1.0])


@pytest.mark.parametrize("floor", [0.0, 40.0])
def test_a_change_of_light_is_as_sure_as_three_readings_of_each_code(
    bench: BenchFile, floor: float
) -> None:
    """The scatter of each code is 0.3 %, that of black has a floor besides, e-/s: what is added to
    the variance of the three faintest codes by which the floor is known is a third of black's.
    """
    relative = 0.003
    codes = np.array([0, 15, 20, 27, 37, 50, 68, 90, 120, 160, 205, 255])
    light = 1e6 * (codes / 255) ** 2.2 + 3000.0
    black_off = math.hypot(relative * light[0], floor)
    readings = msgspec.structs.replace(
        readings_of(bench, quiet_truth()),
        code=np.repeat(codes, 3).tolist(),
        light=scattered(light, relative, black_off).ravel().tolist(),
    )

    found = {figure.quantity: figure for figure in compare(bench, readings, readings)}

    floor_variance = floor**2 / 3
    log_code = np.log(codes[1:] / 255)
    variance = 2 / 3 * (relative**2 + floor_variance / light**2)
    weights = 1 / variance[1:]
    middle = float(np.average(log_code, weights=weights))
    slope_weight = float(weights @ (log_code - middle) ** 2)
    wanted = {
        "brightness": 100 / math.sqrt(weights.sum()),
        "gamma": 1 / math.sqrt(slope_weight),
        "black": 100 * light[0] / light[-1] * math.sqrt(variance[0]),
        "response_rest": 100 * math.sqrt(float(variance[1:].mean()) * 9 / 11),
    }
    for quantity, u in wanted.items():
        assert found[quantity].standard_uncertainty == pytest.approx(u, rel=1e-3), quantity
        assert found[quantity].value == pytest.approx(0.0, abs=1e-9)
    # seven codes are brighter than the fifth, each three times in both checks
    assert {found[quantity].dof for quantity in wanted} == {7 * 2 * 2}


def test_a_change_of_geometry_is_as_sure_as_its_dots_are_many(bench: BenchFile) -> None:
    """Dots of one check have noise of 0.01 px and 0.1 % of light. A shift is known as their mean, a
    turn and a scale as by the squares of their distances, and of a cubic's ten terms an axis what
    those four leave. Of a pixel of 13 um at 70 mm.
    """
    was = readings_of(bench, quiet_truth())
    count = len(was.x_px)
    drawn = np.random.default_rng(8)
    moved_x, moved_y, brighter = drawn.standard_normal((3, count))
    now = msgspec.structs.replace(
        was,
        seen_x_px=(np.array(was.seen_x_px) + 0.01 * moved_x).tolist(),
        seen_y_px=(np.array(was.seen_y_px) + 0.01 * moved_y).tolist(),
        dot_light=(np.array(was.dot_light) * (1 + 1e-3 * brighter)).tolist(),
        psf_u_px=4 * was.psf_px / 100,
    )
    was = msgspec.structs.replace(was, psf_u_px=3 * was.psf_px / 100)

    found = {figure.quantity: figure for figure in compare(bench, was, now)}

    noise_arcsec = 0.01 * 0.013 / 70 * ARCSEC_PER_RAD
    u, v = np.array(was.x_px) - 959.5, np.array(was.y_px) - 539.5
    tangents = np.stack([u - u.mean(), v - v.mean()]) * 0.05765 / 350
    about = math.sqrt(float((tangents**2).sum()))
    wanted = {
        "shift_x": noise_arcsec / math.sqrt(count),
        "shift_y": noise_arcsec / math.sqrt(count),
        "rotation": noise_arcsec / about,
        "scale": 1e6 / ARCSEC_PER_RAD * noise_arcsec / about,
        "geometry_rest": noise_arcsec * math.sqrt(16 / (2 * count)),
        "psf": 5.0,
    }
    for quantity, u_wanted in wanted.items():
        u_found = found[quantity].standard_uncertainty
        assert u_found == pytest.approx(u_wanted, rel=NOISE_ERROR), quantity
        assert abs(found[quantity].value) < 4 * u_found
    assert found["shift_x"].dof == 2 * (count - 10)
    # nine of a cubic's ten terms change the light from place to place
    powers = [(i, j) for i in range(4) for j in range(4 - i)]
    cubic = np.stack([(u / 960) ** i * (v / 540) ** j for i, j in powers], axis=1)
    ratio = np.log(1 + 1e-3 * brighter)
    _, (squares,), _, _ = np.linalg.lstsq(cubic, ratio, rcond=None)
    even_u = 100 * math.sqrt(squares / (count - 10) * 9 / count)
    assert found["evenness"].standard_uncertainty == pytest.approx(even_u, rel=1e-6)
    assert abs(found["evenness"].value) < 4 * even_u
    assert found["evenness"].dof == count - 10


@pytest.fixture(scope="module")
def bench() -> BenchFile:
    return stated_bench()


def quiet_truth() -> Truth:
    """A bench whose readings hardly scatter, seen from a little aside."""
    truth = supposed(np.random.default_rng(6))
    quiet = replace(truth, reading_noise=1e-6, dot_noise_px=1e-6, drift_per_h=0.0)
    return replace(quiet, bent=(0.0, 0.0), black=1e-5)


def readings_of(bench: BenchFile, truth: Truth) -> CheckReadings:
    return take_check(bench, PlantedReader(truth, np.random.default_rng(2)))


def changes_of(bench: BenchFile, truth: Truth) -> dict[str, CheckFigure]:
    """What a check tells of the quiet bench that became this."""
    figures = compare(bench, readings_of(bench, quiet_truth()), readings_of(bench, truth))
    return {figure.quantity: figure for figure in figures}


def test_a_check_tells_each_change_by_its_own_name_and_sign(bench: BenchFile) -> None:
    """A turn by a, b, c about cam's axes moves what is seen by b along x, by -a along y, and by c
    about the middle; a longer focal length draws it together.
    """
    was = quiet_truth()
    a, b, c = 3.0, -5.0, 40.0
    mount_arcsec = tuple(np.add(was.mount_arcsec, (a, b, c)))
    found = changes_of(
        bench,
        replace(
            was,
            white=1.004 * was.white,
            mount_arcsec=mount_arcsec,
            focal=was.focal + 2e-4,
            delay_ms=was.delay_ms + 1.5,
        ),
    )
    values = {quantity: figure.value for quantity, figure in found.items()}
    assert values["brightness"] == pytest.approx(0.4, rel=SECOND_ORDER)
    assert values["shift_x"] == pytest.approx(b, rel=SECOND_ORDER)
    assert values["shift_y"] == pytest.approx(-a, rel=SECOND_ORDER)
    assert values["rotation"] == pytest.approx(c, rel=SECOND_ORDER)
    assert values["scale"] == pytest.approx(-200.0, rel=SECOND_ORDER)
    # the same edges, drawn alike
    assert values["latency"] == pytest.approx(1.5, rel=1e-6)
    assert abs(values["gamma"]) < 1e-4
    assert abs(values["evenness"]) < 1e-3
    assert values["psf"] == 0.0


def test_a_check_tells_another_response_black_evenness_and_focus(bench: BenchFile) -> None:
    was = quiet_truth()
    code = np.arange(256) / 255
    steeper = replace(was, light=was.light * np.maximum(code, 1e-9) ** 0.01)
    assert changes_of(bench, steeper)["gamma"].value == pytest.approx(0.01, rel=0.05)
    # relative to white, which has black in it
    lighter = changes_of(bench, replace(was, black=was.black + 0.001, white=1.2 * was.white))
    black_percent = 100 * (1.2 * (was.black + 0.001) - was.black)
    assert lighter["black"].value == pytest.approx(black_percent / (1 + was.black), rel=1e-3)
    fallen = changes_of(bench, replace(was, fall=(was.fall[0] + 0.01, was.fall[1])))
    readings = readings_of(bench, was)
    u = (np.array(readings.x_px) - 959.5) / 960
    v = (np.array(readings.y_px) - 539.5) / 540
    even = 1 - was.fall[0] * u**2 - was.fall[1] * v**2
    spread = float(np.log(1 - 0.01 * u**2 / even).std())
    assert fallen["evenness"].value == pytest.approx(100 * spread, rel=0.05)
    wider = msgspec.structs.replace(readings, psf_px=1.02 * readings.psf_px)
    changes = {figure.quantity: figure.value for figure in compare(bench, readings, wider)}
    assert changes["psf"] == pytest.approx(2.0)


def test_dots_are_those_that_both_checks_saw(bench: BenchFile) -> None:
    readings = readings_of(bench, quiet_truth())
    columns = ("x_px", "y_px", "seen_x_px", "seen_y_px", "dot_light")
    fewer = {name: getattr(readings, name)[:7:-1] for name in columns}
    figures = compare(bench, readings, msgspec.structs.replace(readings, **fewer))
    assert max(abs(figure.value) for figure in figures) < 1e-9
    few = {name: getattr(readings, name)[:20] for name in columns}
    with pytest.raises(InputError, match="20 dots are seen now and were then"):
        compare(bench, readings, msgspec.structs.replace(readings, **few))


def test_a_bench_file_s_own_readings_have_no_noise(bench: BenchFile) -> None:
    """sRGB's exponent of 2.4, the stated delay, and dots of one light where they are shown."""
    readings = by_bench_file(bench)
    light = np.array(readings.light)
    codes = np.array(readings.code)
    (white,) = np.unique(light[codes == 255])
    assert white == pytest.approx(WHITE_E_PER_S)
    for code in np.unique(codes[codes > 10]):
        (share,) = np.unique(light[codes == code]) / white
        assert share == pytest.approx(((code / 255 + 0.055) / 1.055) ** 2.4)
    assert set(readings.dot_light) == {1.0}
    assert readings.delay_ms == pytest.approx(DELAY_MS)
    assert readings.delay_u_ms == pytest.approx(0.0, abs=1e-9)
    shown_px = geometry_of(bench).to_tracker(np.array(readings.x_px), np.array(readings.y_px))
    seen_px = np.stack([readings.seen_x_px, readings.seen_y_px])
    assert seen_px == pytest.approx(np.stack(shown_px), abs=1e-5)  # five digits are kept


class EdgesAlone(PlantedReader):
    """A photodiode that saw these edges, ms."""

    edges_ms = np.zeros(0)

    def delays_ms(self) -> np.ndarray:
        return self.edges_ms


@pytest.mark.parametrize(
    ("edges_ms", "told"),
    [((), (None, 0.0, 0)), ((8.0,), (None, 0.0, 0)), ((8.0, 9.0, 8.5, 8.5), (8.5, 0.2041, 3))],
)
def test_a_mean_delay_is_as_sure_as_its_edges_are_many(bench: BenchFile, edges_ms, told) -> None:
    """Of 8, 9 and twice 8.5 ms the scatter is sqrt(1/6), and that of their mean half of it."""
    reader = EdgesAlone(quiet_truth(), np.random.default_rng(2))
    reader.edges_ms = np.array(edges_ms)
    readings = take_check(bench, reader)
    found = (readings.delay_ms, readings.delay_u_ms, readings.delay_dof)
    assert found == pytest.approx(told, abs=1e-4)
    figures = {figure.quantity: figure for figure in compare(bench, readings, readings)}
    assert ("latency" in figures) == (readings.delay_ms is not None)
    if "latency" in figures:
        u_ms = figures["latency"].standard_uncertainty
        assert u_ms == pytest.approx(math.sqrt(2 / 24))
        assert figures["latency"].dof == 3
        # of two that are not as well known the less
        surer = msgspec.structs.replace(readings, delay_dof=9)
        for was, now in ((readings, surer), (surer, readings)):
            *_, latency = compare(bench, was, now)
            assert (latency.quantity, latency.dof) == ("latency", 3)


def change(quantity: str, value: float, in_tolerance: bool) -> CheckFigure:
    return CheckFigure(
        quantity, value, 0.125, value - 0.25, value + 0.25, "%", 9.0, 0.25, 0.75, in_tolerance
    )


def test_checks_are_added_to_a_table_and_drawn_by_their_days(tmp_path: Path) -> None:
    first = datetime.datetime(2026, 11, 1, tzinfo=datetime.UTC)
    with drawn_figures() as drawn:
        rows = record(tmp_path, first, "H1", [change("brightness", -0.5, True)])
        assert len(rows) == 1
        later = first + datetime.timedelta(days=2, hours=12)
        figures = [change("brightness", 0.25, True), change("psf", 1.5, False)]
        rows = record(tmp_path, later, "H2", figures)
    assert rows == csv_rows(tmp_path / "checks.csv")
    assert [row["certificate"] for row in rows] == ["H1", "H2", "H2"]
    assert [row["made"] for row in rows] == [
        "2026-11-01T00:00:00.000+00:00",
        *2 * ["2026-11-03T12:00:00.000+00:00"],
    ]
    assert [row["value"] for row in rows] == ["-0.5", "0.25", "1.5"]
    assert checks_in(tmp_path) == 1 + len(rows)
    assert largest_changes(tmp_path) == {"brightness": 0.5, "psf": 1.5}
    titles = [" ".join(figure.get_suptitle().split()) for figure in drawn]
    assert titles == ["1 check: all within tolerance", "2 checks: out of tolerance in psf"]
    brightness = drawn[1].axes[0]
    errors = brightness.containers[0]
    assert errors[0].get_xydata().tolist() == [[0.0, -0.5], [2.5, 0.25]]
    (bars,) = errors[2]
    assert bars.get_segments()[1].tolist() == [[2.5, 0.0], [2.5, 0.5]]
    limits = [line.get_ydata() for line in brightness.get_lines() if line.get_marker() == "_"]
    assert sorted(float(limit[0]) for limit in limits[-2:]) == [-0.75, 0.75]


def test_a_folder_without_checks_has_no_changes_and_another_table_is_refused(
    tmp_path: Path,
) -> None:
    assert largest_changes(tmp_path) is None
    assert checks_in(tmp_path) == 0
    assert read_reference(tmp_path / "reference.json") is None
    (tmp_path / "checks.csv").write_text("quantity,value\nbrightness,dim\n")
    with pytest.raises(InputError, match="is no table of checks"):
        largest_changes(tmp_path)
    now = datetime.datetime(2026, 11, 1, tzinfo=datetime.UTC)
    with pytest.raises(InputError, match="its columns are not made, certificate, quantity"):
        record(tmp_path, now, "H1", [change("brightness", 0.5, True)])
    (tmp_path / "reference.json").write_text("{}")
    assert "--again" in refusal(read_reference, tmp_path / "reference.json")


class Warming:
    """White that begins 2 % dim and warms up with a time of four minutes, on a clock of its own."""

    def __init__(self) -> None:
        self.at_s = 0.0

    def now_ns(self) -> int:
        return round(self.at_s * 1e9)

    def wait(self, seconds: float) -> None:
        self.at_s += seconds

    def light(self, codes: np.ndarray) -> object:
        assert codes.tolist() == [200]
        light = 1000 * (1 - 0.02 * math.exp(-self.at_s / 240))
        return type("Read", (), {"light": np.array([light])})()


def test_white_is_watched_until_it_is_stable_and_drawn_over_its_last_reading(
    tmp_path: Path,
) -> None:
    reader = Warming()
    with drawn_figures() as drawn:
        judged = watch(reader, 200, 60.0, tmp_path / "warm-up")  # type: ignore[arg-type]
    read, fitted = drawn[0].axes[0].get_lines()
    minutes, share = np.asarray(read.get_xydata()).T
    assert share[-1] == 1.0
    expected = (1 - 0.02 * np.exp(-minutes / 4)) / (1 - 0.02 * math.exp(-minutes[-1] / 4))
    assert share == pytest.approx(expected)
    assert np.asarray(fitted.get_ydata()) == pytest.approx(expected, abs=1e-4)
    title = " ".join(drawn[0].get_suptitle().split()).replace("\N{PLUS-MINUS SIGN}", "+-")
    assert title.lower() == judged.line.lower()
    assert reader.at_s < 60 * 60
