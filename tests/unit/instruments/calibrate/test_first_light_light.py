"""The light of first light: dots on lattices, the exposure that they need, and what is read of
them and of stars.
"""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from scipy.special import ndtr

from hilstar.basics.errors import InputError
from hilstar.display.calibration import (
    CalibrationHead,
    NotesTable,
    load_calibration,
    primary_lights,
    primary_responses,
    write_calibration,
)
from hilstar.display.geometry import monitor_camera
from hilstar.display.response import gamma_response, srgb_response
from hilstar.instruments.calibrate.first_light.context import StepContext, darker_code
from hilstar.instruments.calibrate.first_light.image_sources import ImageSource, VirtualBench
from hilstar.instruments.calibrate.first_light.photometer import (
    Assumed,
    LatticeRatio,
    Photometer,
    Readings,
    field_for,
    peak_shares,
)
from hilstar.instruments.calibrate.first_light.photometry import (
    _judged,
    _response_figures,
    exponent,
    photometry,
    plan_for,
    response_error_mag,
)
from hilstar.instruments.calibrate.first_light.stars import scale, trend
from hilstar.instruments.calibrate.geometric.observed import read_image
from hilstar.instruments.calibrate.plan import Patch
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.benches import TWIN, bench_text
from tests.support.refusals import refusal
from tests.support.spectra import bump, write_channels, write_panel

NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])
GEOMETRY = BenchGeometry(
    monitor_camera((640, 480), 57.65, 120, NO_TURN), monitor_camera((400, 400), 13, 25, NO_TURN)
)
RATIO = GEOMETRY.tracker.focal_length_px / GEOMETRY.monitor.focal_length_px
FLOOR_DN, GLOW_DN = 30.0, 4.0
FULL_DN = 70_000 / 24  # the small bench's full well by its gain
SIGMA_PX = 0.5


def test_a_lattice_lights_as_many_pixels_as_it_says_and_only_in_its_square():
    field, periods = field_for(GEOMETRY, SIGMA_PX)
    assert periods == (1, 2, 4, 8, 16)
    for period in periods:
        codes = field.lattice((640, 480), period, Patch(7, "w"))
        assert (codes == 7).sum() == field.lit(period)
        codes[field.top : field.top + field.side, field.left : field.left + field.side] = 0
        assert not codes.any()


def test_the_peak_of_a_lattice_is_that_of_its_light_drawn_pixel_by_pixel():
    """One lit pixel's light, a square of RATIO px under a Gaussian, over a fine grid of places
    of the lattice.
    """
    x = np.arange(-60, 61)
    for period, share in zip((1, 2, 8), peak_shares((1, 2, 8), RATIO, SIGMA_PX), strict=True):
        largest = 0.0
        for phase in np.linspace(0, 1, 40):
            place = phase + RATIO * period * np.arange(-40, 41)[:, None, None]
            inner = (np.arange(9) + 0.5) / 9 * RATIO - RATIO / 2
            edge = x[:, None] - place - inner
            along = (
                (ndtr((edge + 0.5) / SIGMA_PX) - ndtr((edge - 0.5) / SIGMA_PX))
                .mean(axis=2)
                .sum(axis=0)
            )
            largest = max(largest, float(along[30:-30].max()) ** 2)
        # The square counts as a Gaussian of its own variance there: 6 % of the peak at most, of a
        # range used to half.
        assert share == pytest.approx(largest, rel=0.06)


class Camera(ImageSource):
    """A tracker whose image is uniform over the field: so much light for each lit pixel, by a
    response of its own.
    """

    identity = "camera"

    def __init__(self, light, white_dn_per_s, sets_exposure=True, neighbours=0.0, unlit=True):
        self.light, self.white, self.sets_exposure = light, white_dn_per_s, sets_exposure
        self.neighbours, self.has_unlit, self.taken = neighbours, unlit, []

    def save(self, stem, image):
        path = stem.with_name(stem.name + ".png")
        Image.fromarray(np.clip(np.rint(image), 0, 4095).astype(np.uint16)).save(
            path, compress_level=1
        )
        return path

    def look(self, file, pattern, stem, exposure_s):
        self.taken.append((pattern.name, exposure_s))
        rows, columns = np.nonzero(pattern.codes)
        image = np.random.default_rng(len(self.taken)).normal(FLOOR_DN + GLOW_DN, 1.5, (400, 400))
        x, y = (
            np.rint(part).astype(int)
            for part in GEOMETRY.to_tracker(columns.astype(float), rows.astype(float))
        )
        dense = 1 + self.neighbours * (len(rows) > 10_000)
        dn = self.white * exposure_s * dense * self.light[pattern.codes[rows, columns]]
        image += np.bincount(y * 400 + x, dn, minlength=image.size).reshape(image.shape)
        return self.save(stem, image)

    def unlit(self, stem):
        image = np.random.default_rng(5).normal(FLOOR_DN, 1.5, (400, 400))
        return self.save(stem, image) if self.has_unlit else None


def read_patches(tmp_path, camera, codes=(0, 100, 300, 511, 700, 900, 1023, 0)):
    (tmp_path / "bench.toml").write_text(bench_text(TWIN))
    context = StepContext(
        read_bench_file(tmp_path / "bench.toml"), tmp_path, tmp_path / "i", camera, {}, {}, 96
    )
    photometer = Photometer(context, SIGMA_PX, Assumed({"w": srgb_response(10).light}, 0.0))
    return photometer.read([Patch(code, "w") for code in codes])


@pytest.mark.usefixtures("without_charts")
def test_light_is_read_on_lattices_and_black_against_a_monitor_that_is_off(tmp_path):
    true = gamma_response(10, 2.35).light
    found = read_patches(tmp_path, Camera(true, 20_000))
    codes = np.array([patch.code for patch in found.patches])
    lit = codes > 0
    # 2000 pixels at the least, of 1.5 DN: 70 DN of noise in a sum of 10 000 DN or more.
    assert found.light[lit] - found.light[~lit].mean() == pytest.approx(
        20_000 * true[codes[lit]], rel=0.01
    )
    black = GLOW_DN / 0.1 * RATIO**2
    assert found.light[~lit] == pytest.approx(black, rel=0.02)
    assert found.black_known
    assert found.exposure_s == pytest.approx(0.1)
    assert [abs(link.ratio - 1) < 0.01 for link in found.links] == [True, True]


@pytest.mark.usefixtures("without_charts")
def test_the_exposure_is_shortened_until_white_fits_where_that_can_be(tmp_path):
    true = srgb_response(10).light
    found = read_patches(tmp_path, Camera(true, 2e6))
    assert 0.4 < found.exposure_s * 2e6 / FULL_DN < 0.6
    white = [patch.code == 1023 for patch in found.patches].index(True)
    assert found.light[white] - found.light[0] == pytest.approx(2e6, rel=0.01)
    assert "exposure_s" in refusal(read_patches, tmp_path, Camera(true, 2e6, sets_exposure=False))


@pytest.mark.usefixtures("without_charts")
def test_a_response_that_is_far_brighter_than_assumed_is_read_by_a_sparser_lattice(tmp_path):
    true = gamma_response(10, 0.7).light
    found = read_patches(tmp_path, Camera(true, 20_000))
    codes = np.array([patch.code for patch in found.patches])
    lit = codes > 0
    assert found.light[lit] - found.light[~lit].mean() == pytest.approx(
        20_000 * true[codes[lit]], rel=0.01
    )


@pytest.mark.usefixtures("without_charts")
def test_a_pixel_that_is_brighter_among_lit_ones_is_seen_by_the_links(tmp_path):
    found = read_patches(tmp_path, Camera(srgb_response(10).light, 20_000, neighbours=0.08))
    assert max(link.ratio for link in found.links) == pytest.approx(1.08, abs=0.01)


@pytest.mark.usefixtures("without_charts")
def test_without_an_image_of_a_monitor_that_is_off_black_is_the_bench_files(tmp_path):
    found = read_patches(tmp_path, Camera(srgb_response(10).light, 20_000, unlit=False))
    assert not found.black_known
    assert found.light[0] == pytest.approx(0.0, abs=2.0)  # of 20 000: srgb has no black level


MAG_A_PERCENT = 0.01 * 2.5 / np.log(10)


def response_figures(
    p95_percent=0.5, p95_sigmas=1.0, ratios=(1.0,), sigmas=(0.5,), black=False, others=()
):
    """The figures of a response of gamma 2.4 where the bench file has 2.2, by readings whose links
    have these ratios.
    """
    holdout = {"p95_percent": p95_percent, "rms_mag": 0.002, "max_mag": 0.01}
    holdout["p95_sigmas"] = p95_sigmas
    fitted = {
        "channels": {"w": {"holdout": holdout}} | dict(others),
        "drift_percent": None,
        "noise_relative": 0.003,
        "codes": 12,
        "error_percent": {"1e-0": 0.1, "1e-3": 0.9},
    }
    links = []
    for ratio, of_one in zip(ratios, sigmas, strict=True):
        error = abs(ratio - 1) / of_one
        links.append(LatticeRatio(Patch(50, "w"), 1, 2, ratio, error=error))
    count = 24
    none = np.zeros(count)
    readings = Readings(
        patches=[Patch(50, "w")] * count,
        light=none,
        exposure_s=0.2,
        links=links,
        black_known=black,
        images=(),
        above_black=none,
        period=none.astype(int),
        sigma=none,
        common=none[:, None],
    )
    responses = (gamma_response(10, 2.2), gamma_response(10, 2.4))
    return _response_figures(None, readings, fitted, responses, 1e-5)


def test_figures_of_a_response_are_in_their_units():
    figures = response_figures(p95_percent=2.0, ratios=(1.01, 0.98), sigmas=(2.0, 1.0), black=True)
    assert figures["held_out_p95_mag"] == pytest.approx(2 * MAG_A_PERCENT)
    assert figures["noise_percent"] == pytest.approx(0.3)
    assert figures["error_at_1e-3_percent"] == 0.9
    assert figures["links_max_mag"] == pytest.approx(-2.5 * np.log10(0.98))
    assert (figures["links"], figures["links_max_sigmas"]) == ("1.0100, 0.9800", pytest.approx(2.0))
    assert figures["gamma"] == pytest.approx(2.4, abs=1e-6)
    assert figures["gamma_in_bench_file"] == pytest.approx(2.2, abs=1e-6)
    # at a thousandth of white by gamma 2.4 the signal is 0.056, which 2.2 has 0.2 powers brighter
    assert figures["bench_file_off_max_mag"] == pytest.approx(0.2 / 2.4 * 7.5, abs=0.02)
    assert (figures["black_level_measured"], figures["patches"]) == ("yes", 24)
    assert np.isnan(figures["drift_percent"])
    worse = {"p95_percent": 3.0, "rms_mag": 0.004, "max_mag": 0.02, "p95_sigmas": 1.5}
    better = {"p95_percent": 0.1, "rms_mag": 0.001, "max_mag": 0.003, "p95_sigmas": 0.2}
    channels = {"g": {"holdout": worse}, "b": {"holdout": better}}
    of_three = response_figures(others=channels)
    assert of_three["held_out_p95_mag"] == pytest.approx(3 * MAG_A_PERCENT)
    names = ("held_out_rms_mag", "held_out_max_mag", "held_out_p95_sigmas")
    assert [of_three[name] for name in names] == [0.004, 0.02, 1.5]


@pytest.mark.parametrize(
    ("changes", "verdict", "words"),
    [
        ({}, "done", "held-out levels 0.0020 mag rms"),
        # [verify] flux_mag is 0.05 mag: 5 % beyond noise is more, 4 % and what noise explains not
        ({"p95_percent": 5.0, "p95_sigmas": 4.0}, "failed", "do not make one smooth response"),
        ({"p95_percent": 4.0, "p95_sigmas": 4.0}, "done", ""),
        ({"p95_percent": 5.0, "p95_sigmas": 2.5}, "done", ""),
        ({"ratios": (0.95,), "sigmas": (4.0,)}, "failed", "dense and sparse dots"),
        ({"ratios": (1.05,), "sigmas": (4.0,)}, "failed", "local dimming"),
        ({"ratios": (0.95,), "sigmas": (2.5,)}, "done", ""),
    ],
)
def test_a_response_is_refused_beyond_its_limit_and_its_noise(tmp_path, changes, verdict, words):
    bench = bench_text(TWIN, {"verify": {"flux_mag": 0.05}})
    (tmp_path / "bench.toml").write_text(bench)
    camera = Camera(srgb_response(10).light, 1.0)
    context = StepContext(
        read_bench_file(tmp_path / "bench.toml"), tmp_path, tmp_path, camera, {}, {}, 96
    )
    outcome = _judged(context, response_figures(**changes), (), ())
    assert outcome.verdict == verdict
    assert words in outcome.line
    assert bool(outcome.changes) == (verdict == "done")
    if outcome.changes:
        # an rms of 12 levels is known to one over the root of twice as many
        assert outcome.number.value == 0.002
        assert outcome.number.error == pytest.approx(0.002 / np.sqrt(24))


def test_a_hot_pixel_of_the_dark_frame_makes_no_image_too_bright(tmp_path):
    """It has 70 % of the range in the dark, and all of it with light: 0.8 of it is too bright."""
    (tmp_path / "bench.toml").write_text(bench_text(TWIN))
    camera = Camera(srgb_response(10).light, 1.0)
    context = StepContext(
        read_bench_file(tmp_path / "bench.toml"), tmp_path, tmp_path, camera, {}, {}, 96
    )
    dark = np.full((400, 400), FLOOR_DN)
    dark[30, 40] = 0.7 * FULL_DN
    lit = dark.copy()
    lit[100, 200], lit[30, 40] = 0.75 * FULL_DN, 0.99 * FULL_DN
    looked = context.looked(camera.save(tmp_path / "lit", lit), dark)
    assert looked.raw_peak == pytest.approx(0.75 * FULL_DN, abs=0.5)  # as whole DN
    assert looked.floor_dn == FLOOR_DN
    assert not context.is_too_bright(looked)
    lit[100, 200] = 0.85 * FULL_DN
    assert context.is_too_bright(context.looked(camera.save(tmp_path / "lit", lit), dark))


def test_a_darker_code_has_a_quarter_of_the_light_at_most_and_the_darkest_has_none():
    """By a gamma of 2.2, as all monitors have about: the largest such code."""
    for code in range(2, 1024):
        lower = darker_code(code)
        assert (lower / code) ** 2.2 <= 1 / 4 < ((lower + 1) / code) ** 2.2
    assert "darkest code" in refusal(darker_code, 1)


def test_a_plan_has_as_many_levels_as_its_patches_allow():
    assert len(plan_for(8, 96)) <= 96
    assert len({patch.code for patch in plan_for(10, 96)}) > 40
    assert len({patch.code for patch in plan_for(8, 30)}) >= 10


def test_responses_are_compared_by_magnitudes_and_by_their_power():
    flat, steep = gamma_response(10, 2.2), gamma_response(10, 2.35)
    assert exponent(steep) == pytest.approx(2.35, abs=1e-9)
    off = response_error_mag(flat, steep)
    # (1e-3)^(1 - 2.2 / 2.35) at the faintest light compared; a code's step is 4 % there.
    assert off.max() == pytest.approx(2.5 * 3 * (1 - 2.2 / 2.35), rel=0.03)
    assert off[-1] == 0


def test_a_trend_s_error_is_that_of_its_stars_weights(rng):
    """Half the stars a thousandth as sure as the others, whose light scatters alike."""
    along = rng.uniform(4, 6, 400)
    sigma = np.where(np.arange(400) % 2, 0.01, 10.0)
    off = 0.1 * along + rng.normal(0, 0.01, 400)
    found, error = trend(10**along, off, 1 / sigma)
    assert found == pytest.approx(0.1 * np.ptp(along), abs=4 * error)
    assert error == pytest.approx(0.01 / np.sqrt(200) * np.sqrt(12), rel=0.25)


def on_the_twin(tmp_path, step, bench, truth, patches=72):
    """What a step comes to on a bench that is truly another."""
    (tmp_path / "bench.toml").write_text(bench_text(TWIN, bench))
    (tmp_path / "truth.toml").write_text(bench_text(TWIN, truth))
    file, true = (read_bench_file(tmp_path / name) for name in ("bench.toml", "truth.toml"))
    source = VirtualBench(file, true, 0)
    try:
        return step(StepContext(file, tmp_path, tmp_path / "images", source, {}, {}, patches))
    finally:
        source.close()


def test_the_newest_image_of_the_virtual_bench_is_its_file(tmp_path):
    """It is not read again; an older one is."""

    def images(context):
        paths = [context.dark(number) for number in range(2)]
        return [(context.pixels(path), read_image(path)) for path in paths]

    for kept, read in on_the_twin(tmp_path, images, {}, {}):
        assert kept.dtype == read.dtype
        assert (kept == read).all()


@pytest.mark.usefixtures("without_charts")
def test_bit_stealing_needs_the_primaries_and_finds_their_shares(tmp_path):
    """Three channels of their own powers and shares of white: a triple's light is right only
    when all six are.
    """
    light = gamma_response(8, 2.35).light
    planted = {"r": 0.3 * light, "g": 0.5 * light**1.02, "b": 0.2 * light**0.97}
    head = CalibrationHead(
        "photometric", "planted", "2026-11-22", "none", "relative", 8, "true-response.csv"
    )
    columns = {name: 0.001 + value for name, value in planted.items()}
    write_calibration(tmp_path / "true-response.toml", head, columns, 0.0, NotesTable())
    bench = {"monitor": {"bits": 8}, "render": {"bit_stealing": True}}
    outcome = on_the_twin(
        tmp_path, photometry, bench, {"monitor": {"bits": 8, "calibration": "true-response.toml"}}
    )
    assert outcome.verdict == "done", outcome.line
    found = primary_lights(tmp_path / "response.toml", 8)
    assert found[:, -1] == pytest.approx([0.3, 0.5, 0.2], abs=0.001)
    wanted = np.stack(list(planted.values()))
    shown = wanted >= 1e-3 * wanted[:, -1:]
    assert found[shown] / wanted[shown] == pytest.approx(np.ones(shown.sum()), abs=0.01)
    assert (
        load_calibration(tmp_path / "response.toml", 8, bit_stealing=True).response.rgb is not None
    )


@pytest.mark.usefixtures("without_charts")
def test_a_mosaic_before_a_coloured_panel_finds_the_response_of_each_primary(tmp_path):
    """Three powers, of a panel whose primaries the channels see as they do here: a channel's
    light is of one of them.
    """
    nm, powers = np.arange(400.0, 701.0, 10.0), {"r": 2.1, "g": 2.35, "b": 2.5}
    peaks = {"r": 620, "g": 540, "b": 460}
    curves = {name: bump(peak, 30, nm) for name, peak in peaks.items()}
    write_panel(tmp_path / "panel.csv", curves.values(), nm)
    keys = write_channels(tmp_path, nm, curves)
    head = CalibrationHead(
        "photometric", "planted", "2026-11-22", "none", "relative", 8, "true-response.csv"
    )
    light = {name: gamma_response(8, power).light for name, power in powers.items()}
    columns = {
        name: 0.001 + share * light[name]
        for name, share in zip(powers, (0.3, 0.5, 0.2), strict=True)
    }
    write_calibration(tmp_path / "true-response.toml", head, columns, 0.0, NotesTable())
    bench = {
        "tracker": keys,
        "tracker.detector": {"bayer": "rggb", "gain_e_per_dn": 2.0, "bits": 16},
        "monitor": {"bits": 8},
    }
    bench |= {"monitor.primaries": {"file": "panel.csv", "layout": "rgb-stripe"}}
    truth = bench | {"monitor": {"bits": 8, "calibration": "true-response.toml"}}
    outcome = on_the_twin(tmp_path, photometry, bench, truth)
    assert outcome.verdict == "done", outcome.line
    for found, wanted in zip(
        primary_responses(tmp_path / "response.toml", 8), light.values(), strict=True
    ):
        shown = wanted >= 1e-3
        assert found.light[shown] / wanted[shown] == pytest.approx(np.ones(shown.sum()), abs=0.01)


@pytest.mark.usefixtures("without_charts")
def test_stars_of_temporal_frames_are_seen_over_their_whole_turn(tmp_path):
    """With 5 bits a turn of four frames leaves 0.012 mag between the stars, its first frame
    alone 0.036.
    """
    bench = {"monitor": {"bits": 5}, "render": {"quantisation": "temporal", "cycle_frames": 4}}
    truth = {
        "monitor": {"bits": 5},
        "render": {"quantisation": "round", "flux_at_white_e_per_s": 2.5e6},
    }
    outcome = on_the_twin(tmp_path, scale, bench, truth)
    assert outcome.verdict == "done", outcome.line
    assert outcome.figures["truth_off_mag"] == pytest.approx(0.0, abs=0.01)
    assert outcome.figures["scatter_mag"] < 0.02


@pytest.mark.usefixtures("without_charts")
def test_a_truth_whose_primaries_are_not_known_cannot_stand_in_for_bit_stealing(tmp_path):
    head = CalibrationHead(
        "photometric", "planted", "2026-11-22", "none", "relative", 8, "true-response.csv"
    )
    write_calibration(
        tmp_path / "true-response.toml", head, {"w": gamma_response(8).light}, 0.0, NotesTable()
    )
    with pytest.raises(InputError, match=r"\[weights\]"):
        on_the_twin(
            tmp_path,
            photometry,
            {"monitor": {"bits": 8}, "render": {"bit_stealing": True}},
            {"monitor": {"bits": 8, "calibration": "true-response.toml"}},
        )


@pytest.mark.usefixtures("without_charts")
def test_too_few_readings_of_a_response_that_needs_more_are_no_calibration(tmp_path):
    """The example's S-curve by 12 levels: held out of the fit they are 0.1 mag off, and the
    bench file is left alone.
    """
    bench = {"monitor": {"bits": 8, "calibration": "lcd-example"}}
    outcome = on_the_twin(tmp_path, photometry, bench, bench, 30)
    assert (outcome.verdict, outcome.changes) == ("failed", ())
    assert "--patches" in outcome.line
    # which the tracker has not measured, and the bench has
    assert "[uniformity]" in (tmp_path / "response.toml").read_text()
