"""A whole certificate of a bench that is off in every way, by readings that are drawn in
tests/support: each figure against the truth, and each input against the noise that was put in.
"""

from __future__ import annotations

import datetime
import hashlib
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from hilstar.instruments.certify import assembly, certificate
from hilstar.instruments.certify.budget import BATCH
from hilstar.instruments.certify.model import Figures, ReferenceStar
from hilstar.instruments.certify.sky_effects import catalogue_errors
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from hilstar.server.bench.catalogue import bench_catalogue
from hilstar.server.bench.certificate_file import Certificate, CertifiedFigure
from tests.support.planted_certify import BENCH, EXACT_LENS
from tests.support.planted_readings import (
    ARCSEC,
    DELAY_MS,
    EDGE_NOISE_MS,
    EDGES,
    TRACKER_FOCAL_PX,
    WHITE_E_PER_S,
    PlantedReader,
    Truth,
    supposed,
    true_figures,
)

NOW = datetime.datetime(2026, 11, 26, 1, 30, tzinfo=datetime.timezone(datetime.timedelta(hours=2)))
READING_NOISE, DOT_NOISE_PX = 0.003, 0.03
DOT_IMAGES = 4
LIMITS = """[certify]
fields = 1
valid_days = 100
who = "N. N."
max_flux_mag = 3.0
max_place_arcsec = 1e4
max_roll_arcsec = 1.0
"""
# Of a photodiode's 120 edges, 8 dots a term, and 40 readings: a sigma is known to 11 %, 3 % and 11 %
SIGMA_WITHIN = {"delay": 0.35, "evenness": 0.15, "geometry": 0.15, "response": 0.35}
# What a spline between codes and polynomials over the screen leave of a bench without noise.
FIT_MAG, FIT_ARCSEC = 1e-3, 0.05
SIX_DIGITS = 1e-5  # what is rounded to six digits is off by half of this each, and so is a sum


def the_bench(folder: Path) -> BenchFile:
    path = folder / "bench.toml"
    text = BENCH.format(calibration="srgb", delay_ms=DELAY_MS, geometry="", white=WHITE_E_PER_S)
    path.write_text(f"{text}{LIMITS}{EXACT_LENS}")
    return read_bench_file(path)


def the_truth() -> Truth:
    """Off in every way, and nothing of it alike along two axes."""
    return replace(
        supposed(np.random.default_rng(4)),
        fall=(0.12, 0.04),
        tilt=(0.011, -0.017),
        mount_arcsec=(25.0, -60.0, 140.0),
        focal=0.002,
        delay_ms=11.25,
        reading_noise=READING_NOISE,
        dot_noise_px=DOT_NOISE_PX,
    )


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> BenchFile:
    return the_bench(tmp_path_factory.mktemp("small"))


@pytest.fixture(scope="module")
def stars(bench: BenchFile) -> list[ReferenceStar]:
    return assembly.reference_stars(bench)


@pytest.fixture(scope="module")
def by_readings(bench: BenchFile, stars: list[ReferenceStar]) -> tuple[Certificate, Truth]:
    truth = the_truth()
    return certified(bench, PlantedReader(truth, np.random.default_rng(8)), stars), truth


def test_a_reference_star_has_the_errors_of_its_own_star_of_the_catalogue(bench, stars) -> None:
    """Those that `hilstar catalogue` writes for its HIP number."""
    columns = bench_catalogue(bench, None, None).columns
    place = {hip: k for k, hip in enumerate(columns["hip"].values.tolist())}
    own = [place[star.hip] for star in stars]
    mag, arcsec = catalogue_errors(bench, np.array([star.row for star in stars]))
    sigmas_mas = [columns[f"sigma_{axis}_mas"].values[own] for axis in ("ra", "dec")]
    assert 1e3 * arcsec == pytest.approx(np.hypot(*sigmas_mas) / np.sqrt(2))
    assert mag == pytest.approx(columns["sigma_instrument_mag"].values[own])


def certified(
    bench: BenchFile, reader: PlantedReader | None, stars: list[ReferenceStar]
) -> Certificate:
    """A certificate with one batch of trials, and without the readings of checks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(certificate, "QUICK_TRIALS", BATCH)
        patch.setattr(certificate, "take_check", lambda file, reader: {"code": [0]})
        patch.setattr(assembly, "reference_stars", lambda file: stars)
        made, reference = certificate.certify(
            bench, reader, NOW, quick=True, warm_up=0.002, checked=CHANGES, replaces="H1"
        )
    if reader is None:
        assert reference is None
    else:
        assert made.reference_sha256 == hashlib.sha256(reference or b"").hexdigest()
    return made


CHANGES = {"brightness": 0.4, "shift_x": 0.3, "latency": 0.2}


def of_quantity(made: Certificate, quantity: str) -> list[CertifiedFigure]:
    return [figure for figure in made.figures if figure.quantity == quantity]


def test_a_bench_without_noise_has_the_figures_of_its_truth(bench, stars) -> None:
    """Every sign and axis: light, places, attitude and delay."""
    quiet = replace(the_truth(), reading_noise=1e-6, dot_noise_px=1e-5)
    made = certified(bench, PlantedReader(quiet, np.random.default_rng(1)), stars)
    truth = true_figures(quiet, stars)
    within = {"mag": FIT_MAG, "arcsec": FIT_ARCSEC, "ms": 5 * EDGE_NOISE_MS / math.sqrt(EDGES)}
    told = [figure for figure in made.figures if not figure.quantity.startswith("star_")]
    assert {(figure.quantity, figure.star) for figure in told} == set(truth)
    for figure in told:
        true = truth[figure.quantity, figure.star]
        assert figure.value == pytest.approx(true, abs=within[figure.unit]), figure.quantity


def test_intervals_hold_the_truth_and_are_as_wide_as_they_say(by_readings, stars) -> None:
    made, one = by_readings
    truth = true_figures(one, stars)
    told = [figure for figure in made.figures if not figure.quantity.startswith("star_")]
    off = np.array([figure.value - truth[figure.quantity, figure.star] for figure in told])
    standard = np.array([figure.standard_uncertainty for figure in told])
    assert (np.abs(off) < 4 * standard).all()
    for figure in told:
        half = figure.k * figure.standard_uncertainty
        if figure.by_trials is not None and not figure.by_trials.differs:
            ends = (figure.value - half, figure.value + half)
            assert (figure.lower, figure.upper) == pytest.approx(ends, rel=SIX_DIGITS)
        drawn = figure.by_trials
        assert drawn is not None
        assert drawn.lower < figure.value < drawn.upper


def test_inputs_are_as_large_as_the_noise_that_was_put_in(by_readings) -> None:
    made = by_readings[0]
    inputs = {row.name: row for row in made.inputs}
    dots = 1 / math.sqrt(DOT_IMAGES)
    expected = {
        "response": READING_NOISE,
        "evenness": dots * READING_NOISE,
        "geometry": dots * DOT_NOISE_PX / TRACKER_FOCAL_PX * ARCSEC,
        "delay": EDGE_NOISE_MS / math.sqrt(EDGES),
    }
    for name, size in expected.items():
        assert inputs[name].standard_uncertainty == pytest.approx(size, rel=SIGMA_WITHIN[name])
    assert inputs["delay"].dof == EDGES - 1
    # half of a range over its standard deviation
    assert inputs["warm-up"].standard_uncertainty == pytest.approx(0.002 / math.sqrt(3), rel=1e-5)
    drift = 0.4 / 100 / math.sqrt(3)
    assert inputs["drift"].standard_uncertainty == pytest.approx(drift, rel=1e-5)


def test_contributions_make_up_the_whole_and_the_largest_is_first(by_readings) -> None:
    for figure in by_readings[0].figures:
        parts = [part.standard_uncertainty for part in figure.contributions]
        assert parts == sorted(parts, reverse=True)
        assert math.hypot(*parts) == pytest.approx(figure.standard_uncertainty, rel=1e-4)
        assert sum(part.share for part in figure.contributions) == pytest.approx(1.0, abs=1e-3)
    (delay,) = of_quantity(by_readings[0], "latency")
    others = {part.input for part in delay.contributions} - {"delay", "delay that lasts"}
    assert others == {"drift"}


def test_a_star_against_the_sky_has_what_its_codes_lose_and_the_catalogue_s_errors(
    by_readings, stars
) -> None:
    made = by_readings[0]
    lost = {star.hip: star.quantised_mag for star in stars}
    pairs = zip(of_quantity(made, "flux"), of_quantity(made, "star_flux"), strict=True)
    for shown, of_sky in pairs:
        assert of_sky.star == shown.star
        assert of_sky.value - shown.value == pytest.approx(lost[shown.star], abs=1e-5)
        assert of_sky.standard_uncertainty > shown.standard_uncertainty
    for axis in ("along", "across"):
        places = of_quantity(made, f"place_{axis}"), of_quantity(made, f"star_place_{axis}")
        for shown, of_sky in zip(*places, strict=True):
            assert of_sky.value == shown.value
            parts = {part.input for part in of_sky.contributions}
            assert "catalogue place" in parts


def test_a_certificate_says_what_it_is_of_and_for_how_long(by_readings, bench) -> None:
    made = by_readings[0]
    # half past one at two hours east of Greenwich is the day before
    assert (made.made, made.valid_until) == ("2026-11-25T23:30:00+00:00", "2027-03-05")
    assert made.number.startswith("H20261125-")
    assert made.files == {"bench.toml": hashlib.sha256(bench.path.read_bytes()).hexdigest()}
    assert made.replaces == "H1"
    assert made.monitor["resolution_px"] == [1920, 1080]
    assert made.trials == BATCH
    assert "where is not written in [certify]" in made.not_assessed
    assert not any(reason.startswith("who ") for reason in made.not_assessed)


def test_a_certificate_conforms_only_where_every_limited_figure_does(by_readings) -> None:
    made = by_readings[0]
    verdicts = {figure.quantity: figure.conforms for figure in made.figures}
    assert verdicts["flux"] is verdicts["place_along"] is verdicts["place_across"] is True
    assert verdicts["attitude_z"] is made.conforms is False
    assert verdicts["attitude_x"] is verdicts["latency"] is None


def test_without_readings_a_bench_is_as_its_file_says_and_nothing_of_it_is_known(
    bench, stars
) -> None:
    made = certified(bench, None, stars)
    assert made.read_by.startswith("nothing was read")
    assert made.reference_sha256 is None
    # of light, places and the delay no file tells an error
    assert made.figures == []
    assert made.conforms is None
    assert any(reason.startswith("latency:") for reason in made.not_assessed)


def test_without_readings_a_delay_is_as_stated_with_its_own_uncertainty(bench, stars) -> None:
    certify = structs.replace(bench.config.certify, panel_delay_u_ms=0.2)
    stated = replace(bench, config=structs.replace(bench.config, certify=certify))
    (latency,) = of_quantity(certified(stated, None, stars), "latency")
    assert latency.value == pytest.approx(DELAY_MS, abs=1e-3)
    half_ms = (latency.upper - latency.lower) / 2
    # what the checks changed by is anywhere within it
    sigma_ms = math.hypot(0.2, CHANGES["latency"] / math.sqrt(3))
    assert half_ms == pytest.approx(1.96 * sigma_ms, rel=0.01)


def test_a_bench_as_its_file_says_has_its_delay_and_no_error(bench, stars) -> None:
    """At a rate, at which a late star would stand beside its place."""
    certify = structs.replace(bench.config.certify, rate_deg_s=1.0)
    stated = replace(bench, config=structs.replace(bench.config, certify=certify))
    figures = Figures(stated, stars)
    (found,) = figures.of(assembly._as_stated(stated, figures))
    for (quantity, _, _), value in zip(figures.names, found.tolist(), strict=True):
        if quantity == "latency":
            assert value == DELAY_MS
        else:
            assert value == pytest.approx(0.0, abs=1e-6), quantity
