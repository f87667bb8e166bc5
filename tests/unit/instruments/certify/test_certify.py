"""Certificates: intervals that hold the truth, a budget that two ways agree on, and checks that
catch what moved.
"""

from __future__ import annotations

import dataclasses
import math
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from astropy.io import fits

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_rotation_vector, multiply
from hilstar.instruments.certify.assembly import DOT_IMAGES, reference_stars
from hilstar.instruments.certify.bench_readings import LightReadings, geometry_of, grey_response
from hilstar.instruments.certify.budget import Input, by_trials, first_order, why_they_differ
from hilstar.instruments.certify.check import compare, take_check
from hilstar.instruments.certify.estimates import light_deviation, place_errors
from hilstar.instruments.certify.lens import lens_fit
from hilstar.instruments.certify.model import Figures, true_deviations
from hilstar.instruments.certify.readings import VirtualReader, dot_places, light_in_squares
from hilstar.instruments.certify.structure import in_place
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.server.record.ledger_records import read_head
from tests.support.benches import bench_text
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.planted_certify import (
    LIGHT,
    PARTS,
    PLACE,
    REGIONS,
    coverage,
    coverage_by_images,
    drawn,
    plant,
    stated_bench,
    stated_lens,
)
from tests.support.planted_readings import (
    ARCSEC,
    KINDS,
    WHITE_E_PER_S,
    PlantedReader,
    SmoothField,
    Truth,
    supposed,
    uneven,
)
from tests.support.planted_readings import in_place as dots_in_place
from tests.support.planted_run import write_run
from tests.support.planted_tracker import Planted, Sizes, scan
from tests.support.planted_tracker import plant as plant_tracker
from tests.support.undrawn import charts_left_out

BENCHES = 16
FAR = 3 * math.sqrt(0.05 * 0.95 / BENCHES)  # the figures of one bench's third go nearly together
UNCHANGED = 10
FEW = 6
# of figures that go together in each of FEW benches
MIN_HELD = 0.95 - 3 * math.sqrt(0.05 * 0.95 / FEW)
LONGEST = 2.5  # stated over true errors, by the median of FEW benches
DIRECTION = "[certify.tracker]\ndirection_expanded_arcsec = 0.0\n"


def test_intervals_hold_the_truth_of_planted_benches() -> None:
    held = coverage(KINDS["as supposed"], BENCHES, 7)
    assert {quantity for quantity, _ in held} >= {
        "flux",
        "place_along",
        "place_across",
        "attitude_x",
        "attitude_z",
        "latency",
    }
    assert {region for quantity, region in held if quantity == "flux"} == {
        "left third",
        "middle third",
        "right third",
    }
    for where, counted in held.items():
        assert abs(np.mean(counted.held) - 0.95) < FAR, (where, np.mean(counted.held))
        assert 1 / LONGEST < counted.ratio < LONGEST, where


# What each has wrong where it is hard, and the figures that it moves.
HARD: dict[str, tuple[Callable[[np.random.Generator], Truth], tuple[str, ...]]] = {
    "readings in time": (
        lambda rng: replace(supposed(rng), lasts_readings=20.0),
        ("latency", "flux"),
    ),
    "dots over 60 px": (
        lambda rng: dots_in_place(rng, 60, 0.5),
        ("place_along", "place_across", "attitude_x", "attitude_y"),
    ),
    # The polynomials beside the lens follow it: by what they leave intervals held 60 %.
    "few of dots' errors over 280 px": (
        lambda rng: dots_in_place(rng, 280, 0.03),
        ("place_along", "place_across", "attitude_x", "attitude_y"),
    ),
    "light over 30 px": (lambda rng: uneven(rng, 30, 0.01), ("flux",)),
}


@pytest.mark.parametrize("kind", HARD)
def test_intervals_hold_the_truth_of_benches_whose_errors_correlate(kind: str) -> None:
    draw, moved = HARD[kind]
    parts = tuple(part for part, told in PARTS.items() if set(told) & set(moved))
    held = coverage(draw, FEW, 3, parts=parts)
    for (quantity, region), counted in held.items():
        if quantity in moved:
            assert np.mean(counted.held) > MIN_HELD, (quantity, region)
            assert counted.ratio < 2 * LONGEST, (quantity, region)


def test_codes_that_are_off_by_themselves_widen_the_response_between_those_read() -> None:
    def rough(rng: np.random.Generator) -> Truth:
        one = replace(supposed(rng), reading_noise=0.001)
        light = one.light * (1 + 0.005 * rng.standard_normal(256))
        return replace(one, light=light / light[-1])

    for where, counted in coverage(rough, FEW, 4, parts=(LIGHT,)).items():
        assert np.mean(counted.held) > MIN_HELD, where


def test_pixels_that_change_each_others_light_widen_flux_by_what_a_lattice_shows() -> None:
    """By the readings of single pixels alone flux held in half of such benches."""
    talking = coverage(KINDS["pixels that talk"], FEW, 3, parts=(LIGHT,))
    for region in REGIONS:
        assert np.mean(talking["flux", region].held) > MIN_HELD, region
        assert talking["flux", region].ratio < LONGEST, region
    still = coverage(supposed, 2, 3, parts=(LIGHT,))
    for region in REGIONS:
        wide, narrow = talking["flux", region].standard, still["flux", region].standard
        assert min(wide) > min(narrow), region


def test_places_seen_through_an_unstated_lens_are_not_assessed_and_a_stated_one_counts() -> None:
    own_lens = KINDS["tracker's own lens"]
    unstated = coverage(own_lens, 1, 5, tables="")
    assert {where for where, counted in unstated.items() if not counted.held} == {
        *((f"place_{axis}", region) for axis in ("along", "across") for region in REGIONS),
        *((f"attitude_{axis}", "field") for axis in "xyz"),
    }
    stated = coverage(own_lens, FEW, 5, tables=stated_lens(), parts=(PLACE,))
    for where, counted in stated.items():
        assert np.mean(counted.held) > MIN_HELD, where


# In one reading's noise; the structure that is planted has a hundred times more.
UNLIKELY_VARIANCE = 0.003


def test_structure_is_found_where_it_is_and_not_where_it_is_not() -> None:
    rng = np.random.default_rng(8)
    x, y = (part.ravel() * 20.0 for part in np.meshgrid(np.arange(50.0), np.arange(40.0)))
    terms = np.stack([np.ones_like(x), x / 500 - 1, y / 400 - 1], axis=1)[None]
    noise = rng.standard_normal((1, len(x)))
    found = in_place(x, y, noise, terms)
    assert found.total < UNLIKELY_VARIANCE
    assert found.noise_variance == pytest.approx(1, abs=4 * math.sqrt(2 / len(x)))
    more = noise + math.sqrt(0.3) * SmoothField(80.0, rng)(x, y)
    found = in_place(x, y, more, terms)
    # A field of 1000 x 800 px has some thirty places that far apart: their variance is known to a
    # quarter.
    assert found.total == pytest.approx(0.3, rel=0.75)
    assert found.mean_length == pytest.approx(80, rel=0.3)
    # An oblique field fills half of its box.
    oblique = np.abs(x - 490) / 490 + np.abs(y - 390) / 390 < 1
    found = in_place(x[oblique], y[oblique], more[:, oblique], terms[:, oblique])
    assert found.mean_length == pytest.approx(80, rel=0.6)


# Of seed 32: their dots are a whole number of tracker pixels apart, nearly, so that all have one
# phase in a pixel.
IN_PHASE = (29, 66, 72, 85)


@pytest.mark.parametrize("number", IN_PHASE)
def test_waves_of_the_trackers_pixels_do_not_fit_the_noise_of_dots(number: int) -> None:
    file = stated_bench()
    one = supposed(np.random.default_rng((32, number)))
    x_px, y_px = dot_places(geometry_of(file))
    dots = PlantedReader(one, np.random.default_rng((32, number, 2))).dots(x_px, y_px, DOT_IMAGES)
    places = lens_fit(file, dots, place_errors(file, dots)).at(dots.x_px, dots.y_px)
    wanted = geometry_of(file).monitor.rays(dots.x_px, dots.y_px)
    true = (one.tangents(dots.x_px, dots.y_px) - wanted[:, :2] / wanted[:, 2:]) * ARCSEC
    off = (places.value - true) / np.sqrt((places.noise**2).sum(axis=0))
    assert np.sqrt((off**2).mean()) < 1.6


def test_images_give_places_as_well_as_thousands_of_dots_know_them() -> None:
    # a third of the codes that a certificate reads: two images of each take half of the time
    found = coverage_by_images(1, 3, tables="levels = 16\n")
    for axis in ("along", "across"):
        for region in REGIONS:
            # All but the one at the edge of the field; 0.003 px a star were 0.11 arcsec.
            assert sorted(found[f"place_{axis}", region].standard)[-2] < 0.02
    for where, counted in found.items():
        assert max(abs(np.array(counted.error)) / np.array(counted.standard)) < 5, where


def test_all_of_a_dots_light_counts_however_faint_it_is() -> None:
    """Of the pixels above a threshold that of a dot of half the light was a smaller share."""
    row, column = np.mgrid[:60, :60]
    places = np.array([[15.2, 14.8], [15.0, 44.6], [45.4, 30.0]])
    light = np.array([1.0, 0.5, 0.02])
    image = np.zeros((60, 60))
    for (y, x), total in zip(places, light, strict=True):
        spot = np.exp(-((row - y) ** 2 + (column - x) ** 2) / 2)
        image += total * spot / spot.sum()
    assert light_in_squares(image, places[:, 1], places[:, 0], 6) == pytest.approx(light, rel=1e-6)


LENS = "true-lens.toml"
EVEN_PINHOLE = {"fall": 0.0, "k1": 0.0, "k2": 0.0, "tilt_deg": (0.0, 0.0)}


def test_a_screen_is_the_same_however_its_mounting_is_stated(tmp_path) -> None:
    """First light finds flip_y where the truth says flip_x and 180 degrees, and no turn where it
    says a quarter turn of a screen that hangs by 50 degrees: certify refused both.
    """
    turn_arcsec = 20.0
    one = replace(drawn(np.random.default_rng(7)), **EVEN_PINHOLE, mount_arcsec=(0, 0, turn_arcsec))
    bench_path, truth_path = plant(tmp_path, one)
    file, plain = read_bench_file(bench_path), read_bench_file(truth_path)
    text = truth_path.read_text()
    flipped_path = tmp_path / "flipped.toml"
    flips = "flip_x = true\nflip_y = true\nrotate_deg = 180\n"
    flipped_path.write_text(text.replace("[monitor]\n", f"[monitor]\n{flips}"))
    quarter = from_rotation_vector(np.array([0.0, 0.0, -math.pi / 2]))
    hang = from_rotation_vector(np.array([0.0, 0.0, turn_arcsec / ARCSEC]))
    q = ", ".join(map(repr, multiply(quarter, hang).tolist()))
    lens = re.sub("q_cam_to_mon = .*", f"q_cam_to_mon = [{q}]", (tmp_path / LENS).read_text())
    lens = lens.replace("[1920, 1080]", "[1080, 1920]").replace("[959.5, 539.5]", "[539.5, 959.5]")
    (tmp_path / "turned-lens.toml").write_text(lens)
    turned_path = tmp_path / "turned.toml"
    turned = text.replace("[monitor]\n", "[monitor]\nrotate_deg = 90\n").replace(
        LENS, "turned-lens.toml"
    )
    turned_path.write_text(turned.replace("[1920, 1080]", "[1080, 1920]"))
    wanted = VirtualReader(file, plain, 3).dots(*dot_places(geometry_of(file)), 4)
    figures = Figures(file, reference_stars(file))
    wanted_truth = true_deviations(figures, plain)
    for path in (flipped_path, turned_path):
        other = read_bench_file(path)
        found = VirtualReader(file, other, 3).dots(*dot_places(geometry_of(file)), 4)
        assert found.seen_x_px == pytest.approx(wanted.seen_x_px, abs=1e-6)
        assert found.seen_y_px == pytest.approx(wanted.seen_y_px, abs=1e-6)
        truth = true_deviations(figures, other)
        assert truth.place_arcsec == pytest.approx(wanted_truth.place_arcsec, abs=1e-6)
    mirrored = tmp_path / "mirrored.toml"
    mirrored.write_text(text.replace("[monitor]\n", "[monitor]\nflip_x = true\n"))
    with pytest.raises(InputError, match="mounted otherwise"):
        VirtualReader(file, read_bench_file(mirrored), 3)


def test_a_reading_of_a_lattice_with_few_dots_weighs_by_its_own_noise() -> None:
    """White of a sparse lattice is ten times as noisy as other codes: its interval is its own,
    and theirs are not wider.
    """
    file = stated_bench()
    codes = np.array([*[0, 255, 40, 80, 120, 160, 200] * 3, 0])
    shape = np.where(codes == 255, 10.0, 1.0)
    rng = np.random.default_rng(4)
    light = (grey_response(file).light[codes] + 1e-3) * 1e6
    drawn = np.where(codes > 0, rng.standard_normal(len(codes)), 0.01 * rng.standard_normal())
    noisy = light * (1 + 1e-4 * shape * drawn)
    readings = LightReadings(codes, noisy, np.zeros(len(codes)), noise=shape * light)
    deviation = light_deviation(file, readings)
    sigma = np.linalg.norm(deviation.factors, axis=1) / deviation.value
    assert 5 < sigma[-1] / np.median(sigma[:-1]) < 20


def test_a_faint_code_that_reads_below_black_does_not_undo_the_others() -> None:
    """Its light, and so its noise by its light, was 0, and all scatters became infinite: "white
    reads no light above black".
    """
    file = stated_bench()
    lit = [1, 20, 40, 80, 120, 160, 200, 255]
    codes = np.array([0, *lit, 0, *lit, 0, *lit, 0])
    rng = np.random.default_rng(4)
    black = 1e4
    light = black + grey_response(file).light[codes] * 1e6
    light += np.where(codes > 0, 1e-4 * (light - black), 1.0) * rng.standard_normal(len(codes))
    light[codes == 1] = black - np.array([30.0, 31.0, 32.0])
    noise = np.where(codes > 1, 1e-4 * (light - black), 1.0)
    readings = LightReadings(codes, light, np.zeros(len(codes)), noise=noise)
    deviation = light_deviation(file, readings)
    off = deviation.value * WHITE_E_PER_S / 1e6 - 1
    assert np.abs(off[1:]).max() < 1e-3
    assert np.isfinite(deviation.factors).all()
    assert deviation.noise == pytest.approx(1e-4, rel=0.5)


LIT = [1, 20, 80, 160, 255]
LIT_TWICE = np.array([0, *LIT, 0, *LIT, 0, 0])


def twice_read(file: BenchFile) -> FloatArray:
    """LIT_TWICE as read above a black of 1000 e-/s: two readings differ by 2e-6, those of black
    by 2 e-/s.
    """
    light = 1e3 + grey_response(file).light[LIT_TWICE] * WHITE_E_PER_S
    light[LIT_TWICE == 0] += [1.0, -1.0, 1.0, -1.0]
    is_lit = LIT_TWICE > 1
    light[is_lit] *= 1 + 1e-6 * np.resize([1, -1], int(is_lit.sum()))
    return light


def test_of_two_readings_of_a_faint_code_the_darker_counts_as_much() -> None:
    file = stated_bench()
    light, faint = twice_read(file), LIT_TWICE == 1
    true = float(light[faint][0]) - 1e3
    light[faint] += true / 2 * np.array([1, -1])
    noise = np.where(faint, true, 1e-5 * light)
    readings = LightReadings(LIT_TWICE, light, np.zeros(len(light)), noise=noise)
    deviation = light_deviation(file, readings)
    assert deviation.value[0] == pytest.approx(1, abs=1e-4)


def test_what_readings_share_is_no_larger_where_a_faint_code_reads_nothing() -> None:
    """Relative to a reading of no light it was a billion times too large, and so all intervals."""
    file = stated_bench()
    light = twice_read(file)
    light[LIT_TWICE == 1] = [999.0, 1001.0]
    shared_e_per_s = np.where(LIT_TWICE == 0, 0.0, 2.0)[:, None]
    readings = LightReadings(LIT_TWICE, light, np.zeros(len(light)), common=shared_e_per_s)
    deviation = light_deviation(file, readings)
    expected = grey_response(file).light[LIT] * WHITE_E_PER_S
    assert deviation.common_factors[:, 0] == pytest.approx(2.0 / expected)


def test_three_readings_hold_the_truth_by_their_t() -> None:
    rng, trials = np.random.default_rng(3), 4000
    read = rng.normal(0, 1, (trials, 3))
    held = 0
    for one in read:
        error = float(one.std(ddof=1)) / math.sqrt(3)
        middle = float(one.mean())
        inputs = [Input("readings", "Student t", "", 1, error, "", 2.0)]
        found = first_order(lambda z, middle=middle, u=error: middle + u * z[0], inputs)
        held += bool(found.lower[0] <= 0 <= found.upper[0])
    assert abs(held / trials - 0.95) < 4 * math.sqrt(0.95 * 0.05 / trials)


def test_both_ways_agree_on_what_is_linear_and_say_why_where_it_is_not() -> None:
    inputs = [Input("a", "normal", "", 2, 1.0, ""), Input("b", "rectangular", "", 1, 1.0, "")]
    linear = lambda z: np.stack([z[0] @ [1.0, -2.0] + 0.5 * z[1][:, 0]], axis=1)  # noqa: E731
    bent = lambda z: np.stack([z[0][:, 0] + 0.5 * z[0][:, 0] ** 2], axis=1)  # noqa: E731
    rng = np.random.default_rng(1)
    first, drawn_ones = first_order(linear, inputs), by_trials(linear, inputs, rng, 200_000)
    assert drawn_ones.settled
    assert drawn_ones.standard == pytest.approx(first.standard, rel=0.05)
    assert why_they_differ(first, drawn_ones, inputs, 0) == ""
    first, drawn_ones = first_order(bent, inputs), by_trials(bent, inputs, rng, 200_000)
    assert drawn_ones.standard[0] > 1.1 * first.standard[0]  # sqrt(1 + 2 / 4)
    assert "not linear" in why_they_differ(first, drawn_ones, inputs, 0)


def test_correlations_within_an_input_count() -> None:
    both = [Input("a", "normal", "", 1, 1.0, "")]
    assert first_order(lambda z: z[0] - z[0], both).standard[0] == 0


CHANGES = {
    "brightness": {"white": 1.01},
    "darker": {"white": 0.99},
    "shift": {"mount_arcsec": (2.0, 0.0, 0.0)},
    "roll": {"mount_arcsec": (0.0, 0.0, 2.0)},
    "gamma": {"gamma": 0.02},
}


@pytest.fixture(scope="module")
def checked(tmp_path_factory: pytest.TempPathFactory):
    """A planted bench, its readings at its certificate, and a function that checks it with other
    things planted.
    """
    one = dataclasses.replace(
        drawn(np.random.default_rng(5)),
        reading_noise=0.002,
        dot_noise_px=0.02,
        drift_percent_per_h=0.0,
    )
    folder = tmp_path_factory.mktemp("check")
    bench, truth = (read_bench_file(path) for path in plant(folder, one))
    reference = take_check(bench, VirtualReader(bench, truth, 0))

    def check(seed: int, focus: float = 1.0, **changes: float | tuple[float, float, float]):
        changed = one
        for name, value in changes.items():
            now = getattr(one, name)
            if isinstance(value, tuple):
                new = tuple(a + b for a, b in zip(now, value, strict=True))
            else:
                new = now * value if name == "white" else now + value
            changed = dataclasses.replace(changed, **{name: new})
        as_it_is = read_bench_file(plant(folder, changed)[1])
        tracker = msgspec.structs.replace(
            as_it_is.config.tracker, psf_sigma_px=(0.55 * focus, 0.55 * focus)
        )
        as_it_is = dataclasses.replace(
            as_it_is, config=msgspec.structs.replace(as_it_is.config, tracker=tracker)
        )
        return compare(bench, reference, take_check(bench, VirtualReader(bench, as_it_is, seed, 1)))

    return check


@pytest.mark.parametrize("change", CHANGES)
def test_a_check_catches_what_moved(checked, change: str) -> None:
    for seed in range(3):
        assert not all(each.in_tolerance for each in checked(seed, **CHANGES[change])), change


def test_a_check_catches_a_new_focus(checked) -> None:
    assert [each.quantity for each in checked(1, focus=1.05) if not each.in_tolerance] == ["psf"]


def test_a_check_is_quiet_where_nothing_moved(checked) -> None:
    for seed in range(UNCHANGED):
        figures = checked(seed)
        assert all(each.in_tolerance for each in figures), seed
        assert all(
            abs(each.value) < 6 * each.standard_uncertainty
            for each in figures
            if each.quantity != "psf"
        )


CUBE = """
[alignment]
q_mon_to_reference = [1.0, 0.0, 0.0, 0.0]
covariance_arcsec2 = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 4.0]]
name = "cube 7"
"""
KEYS = f'[certify]\nfields = 1\nmax_latency_ms = 1.0\nwho = "A. Tester"\n{DIRECTION}{CUBE}'


@pytest.fixture
def certified(tmp_path: Path, certified_once: tuple[Path, dict[str, Any]]) -> dict[str, Any]:
    """What the command said of a planted bench, whose folder, out/ beside it, this test has for
    its own.
    """
    folder, said = certified_once
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    return said


@pytest.fixture(scope="module")
def certified_once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("certified")
    plant(folder, drawn(np.random.default_rng(5)), KEYS)
    done = run_hilstar_here(*CERTIFY, "--quick", "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, msgspec.json.decode(done.stdout)


CERTIFY = ("certify", "bench.toml", "-o", "out", "--virtual", "truth.toml")


def test_the_command_certifies_checks_and_refuses(
    tmp_path: Path, certified: dict[str, Any]
) -> None:
    assert certified["conforms"] is False  # the bench file's delay is 8 ms, the truth's is not
    assert certified["who"] == "A. Tester"
    figure = next(each for each in certified["figures"] if each["quantity"] == "latency")
    assert figure["lower"] < figure["value"] < figure["upper"]
    assert figure["contributions"][0]["input"] == "delay"
    page = (tmp_path / "out" / "index.html").read_text()
    assert page.count("<h2>") > 4
    assert "<strong>Does not conform: " in page
    assert "star&#x27;s place along x" in page and "<td>place_along</td>" not in page
    assert ">-</td>" not in page and ">unlimited</td>" not in page
    assert "place_along" not in page and "psf_sigma" not in page and "{}" not in page
    assert "collimator: quaternion cam to mon</th><td>1, 0, 0, 0</td>" in page
    assert "Cube to tracker&#x27;s boresight" in page and "of cube 7, within" in page
    assert run_hilstar_here(*CERTIFY, cwd=tmp_path).returncode == 2
    assert run_hilstar_here(*CERTIFY, "--check", cwd=tmp_path).returncode == 0
    plant(tmp_path, dataclasses.replace(drawn(np.random.default_rng(5)), white=1e6), KEYS)
    moved = run_hilstar_here(*CERTIFY, "--check", "--json", cwd=tmp_path)
    assert moved.returncode == 1
    assert msgspec.json.decode(moved.stdout)["checks"] == 2
    with charts_left_out():
        done = run_hilstar_here(*CERTIFY, "--again", "--quick", "--json", cwd=tmp_path)
    again = msgspec.json.decode(done.stdout)
    assert again["replaces"] == certified["number"]
    assert "drift" in {each["name"] for each in again["inputs"]}  # by the checks between


@pytest.mark.usefixtures("without_charts")
def test_runs_frames_and_assessments_name_the_certificate(
    tmp_path: Path, certified: dict[str, Any], planted_run: Planted
) -> None:
    number, bench = certified["number"], tmp_path / "bench.toml"
    named = 'fields = 1\ncertificate = "out/certificate.json"'
    bench.write_text(bench.read_text().replace("fields = 1", named))
    frame = ("frame", bench, "--radec", "84,-1,0", "-o")
    assert run_hilstar_here(*frame, tmp_path / "a.fits").returncode == 0
    assert fits.getheader(tmp_path / "a.fits")["CERTIF"] == number
    (tmp_path / "log.csv").write_text("t_s,qw,qx,qy,qz\n0.0,1,0,0,0\n0.1,1,0,0,0\n")
    words = ("replay", "bench.toml", "log.csv", "--headless", "--speed", "max")
    done = run_hilstar_here(*words, "--ledger", "run.mcap", cwd=tmp_path)
    assert done.returncode == 0
    assert read_head(tmp_path / "run.mcap")["certificate"] == number
    certificate = {"certificate": str(tmp_path / "out/certificate.json")}
    ledger, telemetry = write_run(
        tmp_path, planted_run, bench_text({"certify": certificate}) + CUBE
    )
    words = ("assess", ledger, telemetry, "-o", tmp_path / "assessed", "--json")
    done = run_hilstar_here(*words, "--display-attitudes", "0")
    told = msgspec.json.decode(done.stdout)
    assert told["cube_to_boresight"]["reference"] == "cube 7"
    # what the certificate does not know, the cube's direction cannot be known to
    assert told["cube_to_boresight"]["cross_arcsec"] > told["bench"]["off_arcsec"]["cross"]
    part = told["bench"]
    assert part["certificate"] == number
    assert 0 < part["share_of_bias"]["cross"] <= 1
    assert "could have made" in (tmp_path / "assessed" / "budget.html").read_text()
    (tmp_path / "out" / "certificate.json").write_text("{}")
    assert_refused(run_hilstar_here(*frame, tmp_path / "b.fits"), 2, "is no certificate")


@pytest.fixture(scope="module")
def planted_run() -> Planted:
    sizes = Sizes(wild=5, offset_s=0.02)
    return plant_tracker(scan, sizes, np.random.default_rng(11), seconds=60.0)
