"""From measured patches to a response: how near it comes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hilstar.display.calibration import load_calibration, primary_responses, read_toml
from hilstar.display.response import srgb_light
from hilstar.instruments.calibrate.measurements import drift_over_run, read_measurements
from hilstar.instruments.calibrate.photometric import (
    Provenance,
    _additivity,
    calibrate_photometric,
    draw_fits,
    fit_channel,
    held_out,
    strictly_rising,
)
from hilstar.instruments.calibrate.plan import PlanSettings, plan_patches, planned_codes
from tests.support.commands import run_hilstar_here
from tests.support.refusals import refusal
from tests.support.tables import write_readings

NOISE = 0.01
# The aim, over three decades below white.
WORST, RMS, FAINTEST = 0.01, 0.005, 1e-3


def cell(signal):
    """An S-curve: what a twisted-nematic cell lets through, against its voltage."""
    return np.sin(np.pi / 2 * signal**1.1) ** 2


def bent(signal):
    """A table as measured: a power law with waves of 6 %."""
    return signal**2.2 * np.exp(0.06 * (np.sin(3 * np.pi * signal**0.5) - np.sin(3 * np.pi)))


CURVES = {"gamma": lambda s: s**2.2, "srgb": srgb_light, "s-curve": cell, "table": bent}


def measure_plan(path, curve, rng, bits=8, repeats=3, black=0.0, noise=NOISE, unit=250.0):
    """The default plan, measured with a noise relative to the light."""
    patches = plan_patches(PlanSettings(bits, repeats=repeats), rng)
    light = (curve(np.array([patch.code for patch in patches]) / (2**bits - 1)) + black) * unit
    light *= 1 + noise * rng.standard_normal(len(light))
    return write_readings(
        path,
        [(patch.code, patch.channel, value) for patch, value in zip(patches, light, strict=True)],
    )


def curve_errors(fit, curve):
    true = curve(np.arange(len(fit.light)) / (len(fit.light) - 1))
    return (fit.light / np.where(true > 0, true, 1) - 1)[true >= FAINTEST]


@pytest.mark.parametrize(("bits", "black"), [(8, 0.0), (10, 1e-3)])
@pytest.mark.parametrize("name", CURVES)
def test_a_response_is_recovered_to_one_percent_over_three_decades(name, black, bits, tmp_path):
    """3 repeats do where a formula fits; a shape of its own has twice the free parameters, and is
    measured 6 times.

    Of 200 seeds, 96 to 100 % then meet the aim; five are run here, of which one may miss it.
    """
    repeats = 3 if name in ("gamma", "srgb") else 6
    met = 0
    for seed in range(5):
        path = measure_plan(
            tmp_path / "m.csv", CURVES[name], np.random.default_rng(seed), bits, repeats, black
        )
        error = curve_errors(fit_channel(read_measurements(path), "w"), CURVES[name])
        met += np.abs(error).max() < WORST and np.sqrt((error**2).mean()) < RMS
    assert met >= 4


def test_even_steps_of_code_do_where_the_light_is_a_power_law(tmp_path):
    codes = np.repeat(np.rint(np.linspace(0, 255, 32)).astype(int), 3)
    met = 0
    for seed in range(10):
        light = (codes / 255) ** 2.2 * (
            1 + NOISE * np.random.default_rng(seed).standard_normal(len(codes))
        )
        path = write_readings(
            tmp_path / "m.csv", [(c, "w", v) for c, v in zip(codes, light, strict=True)]
        )
        error = curve_errors(fit_channel(read_measurements(path), "w"), CURVES["gamma"])
        met += np.abs(error).max() < WORST and np.sqrt((error**2).mean()) < RMS
    assert met >= 9


@pytest.mark.parametrize("name", CURVES)
def test_without_noise_nothing_is_lost(name, tmp_path, rng):
    path = measure_plan(tmp_path / "m.csv", CURVES[name], rng, black=1e-3, noise=0)
    fit = fit_channel(read_measurements(path), "w")
    # sRGB's kink and the waves, between levels 8 % apart
    assert np.abs(curve_errors(fit, CURVES[name])).max() < 1e-3
    assert fit.black / fit.white == pytest.approx(1e-3, rel=1e-3)


def test_the_stated_error_is_the_error(tmp_path):
    """Over 30 seeds and the codes above FAINTEST, error over its stated sigma has an rms near 1."""
    ratios = []
    for seed in range(30):
        path = measure_plan(tmp_path / "m.csv", cell, np.random.default_rng(seed), black=1e-3)
        fit = fit_channel(read_measurements(path), "w")
        true = cell(np.arange(255) / 255)
        shown = true >= FAINTEST
        ratios.append((fit.light[:-1][shown] / true[shown] - 1) / fit.error[:-1][shown])
    rms = np.sqrt(np.mean(np.concatenate(ratios) ** 2))
    # A seed has about 6 free parameters: 30 * 6 draws give the rms to 1 / sqrt(360) = 5 %; the
    # smooth prior adds its bias.
    assert 0.75 < rms < 1.3


def test_a_held_out_residual_is_that_of_a_fit_without_the_level(tmp_path, rng):
    path = measure_plan(tmp_path / "m.csv", CURVES["gamma"], rng, black=1e-3)
    data = read_measurements(path)
    whole = fit_channel(data, "w")
    for place in (8, 15, 25):
        code = int(whole.levels.code[place])
        kept = [row for row in path.read_text().splitlines() if not row.startswith(f"{code},")]
        (tmp_path / "less.csv").write_text("\n".join(kept))
        without = fit_channel(read_measurements(tmp_path / "less.csv"), "w")
        left = (whole.levels.mean[place] - without.black) / (
            without.white * without.light[code]
        ) - 1
        # The stiffness and the noise are chosen anew without the level: a tenth of the noise of a
        # level's mean.
        assert whole.residual[place - 1] == pytest.approx(left, abs=0.1 * NOISE)


def test_a_flat_dark_end_is_made_strictly_rising():
    light = strictly_rising(np.array([0, 0, 0, 1e-12, 0.5, 0.4, 1.0]))
    assert np.all(np.diff(light) > 0)
    assert light[-1] == 1
    assert light[4] == pytest.approx(0.5)
    # by what a calibration may state, and at its dark end by more than nothing
    assert light[5] / light[4] - 1 == pytest.approx(1e-6, rel=1e-3)
    assert light[1] == 1e-9
    # over a black level a thousand times as bright as white, too
    assert np.all(np.diff(1000 + light) > 0)


def test_a_link_in_limited_range_has_a_dark_end_that_loads(tmp_path, rng):
    """Codes 1 to 16 are as black as 0."""
    path = measure_plan(
        tmp_path / "m.csv", lambda s: np.maximum(s - 16 / 255, 0) ** 2.2, rng, black=1e-3
    )
    calibrate_photometric(path, tmp_path / "monitor.toml")
    assert load_calibration(tmp_path / "monitor.toml", 8).response.light[20] < 1e-2


def test_every_code_of_16_bits_is_fitted(tmp_path, rng):
    path = measure_plan(tmp_path / "m.csv", CURVES["gamma"], rng, bits=16)
    assert (
        np.abs(curve_errors(fit_channel(read_measurements(path), "w"), CURVES["gamma"])).max()
        < WORST
    )


def test_dn_are_divided_by_their_exposure(tmp_path, rng):
    path = measure_plan(tmp_path / "m.csv", CURVES["gamma"], rng, black=1e-3)
    plain = read_measurements(path)
    rows = [
        (c, "w", v * t, t)
        for c, v, t in zip(
            plain.code, plain.value, rng.uniform(0.01, 2, len(plain.code)), strict=True
        )
    ]
    exposed = read_measurements(
        write_readings(tmp_path / "dn.csv", rows, "code,channel,value,exposure_s")
    )
    assert exposed.value == pytest.approx(plain.value)


def test_a_floor_of_the_instrument_does_not_bend_the_faint_end(tmp_path):
    """5e-5 of white added to each reading: without its own term the noise of the faint levels
    would be far underrated.
    """
    worst = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        path = measure_plan(
            tmp_path / "m.csv", CURVES["gamma"], rng, black=1e-3, noise=0.003, unit=1.0
        )
        data = read_measurements(path)
        value = np.maximum(data.value + 5e-5 * rng.standard_normal(len(data.value)), 0)
        write_readings(path, [(c, "w", v) for c, v in zip(data.code, value, strict=True)])
        worst.append(
            np.abs(curve_errors(fit_channel(read_measurements(path), "w"), CURVES["gamma"])).max()
        )
    assert np.median(worst) < WORST


def test_without_repeats_the_residuals_tell_the_noise(tmp_path, rng):
    """Where it is a third of what is taken for it at first."""
    noise = 0.003
    codes = planned_codes(8, 64)
    light = ((np.array(codes) / 255) ** 2.2 + 1e-3) * (1 + noise * rng.standard_normal(len(codes)))
    path = write_readings(
        tmp_path / "m.csv", [(c, "w", v) for c, v in zip(codes, light, strict=True)]
    )
    fit = fit_channel(read_measurements(path), "w")
    # four sigma of a scatter of 60
    assert fit.noise_relative == pytest.approx(noise, rel=4 / np.sqrt(2 * 60))


def test_calibrate_writes_a_file_that_loads_and_says_how_good_it_is(tmp_path, rng):
    path = measure_plan(tmp_path / "m.csv", CURVES["srgb"], rng, black=1e-3)
    summary = calibrate_photometric(
        path, tmp_path / "monitor.toml", Provenance('a "b"\nc', instrument="meter", unit="cd/m2")
    )
    calibration = load_calibration(tmp_path / "monitor.toml", 8)
    assert calibration.who == 'a "b"\nc'
    assert calibration.sha256 == summary["sha256"]
    # black is measured 25 times at 1 %
    assert calibration.response.black == pytest.approx(1e-3, rel=0.02)
    assert summary["black_level"]["unit"] == pytest.approx(0.25, rel=0.02)
    # some 60 repeats of bright levels: 9 %
    assert summary["noise_relative"] == pytest.approx(NOISE, rel=0.3)
    # A level's mean of three repeats to 0.58 %, seen from a response that is known better.
    assert 0.3 < summary["holdout"]["rms_percent"] < 0.9
    assert summary["holdout"]["max_mag"] == pytest.approx(
        summary["holdout"]["max_percent"] / 100 * 1.0857, rel=1e-4
    )
    assert summary["error_percent"]["1e-3"] > summary["error_percent"]["1e-2"]
    assert summary["additivity_percent"] is None
    drift, _ = drift_over_run(read_measurements(path))
    note = read_toml(tmp_path / "monitor.toml").notes.drift
    assert note == f"{100 * drift:+.2f} % over the run" != "+0.00 % over the run"
    light = load_calibration(tmp_path / "monitor.toml", 8).response.light
    assert np.abs(light[4:] / srgb_light(np.arange(4, 256) / 255) - 1).max() < WORST


def test_primaries_are_fitted_and_their_sum_compared_with_white(tmp_path, rng):
    shares, powers = {"r": 0.2, "g": 0.7, "b": 0.1}, {"r": 2.1, "g": 2.2, "b": 2.4}

    def light(code, channel):  # primaries add to each other's light, more at dark codes
        if channel != "w":
            return shares[channel] * (code / 255) ** powers[channel] + 1e-3
        together = sum(light(code, name) - 1e-3 for name in shares)
        return 1.02 * together * (1 + 0.1 * (1 - code / 255)) + 1e-3

    rows = [
        (p.code, p.channel, light(p.code, p.channel) * (1 + 0.005 * rng.standard_normal()))
        for p in plan_patches(PlanSettings(8, 24, channels="wrgb"), rng)
    ]
    summary = calibrate_photometric(
        write_readings(tmp_path / "m.csv", rows), tmp_path / "monitor.toml"
    )
    # four whites to 0.2 % each
    assert summary["additivity_percent"] == pytest.approx(100 * (1 / 1.02 - 1), abs=0.8)
    assert summary["crosstalk_percent"]["1e-0"] == summary["additivity_percent"]
    assert list(summary["crosstalk_percent"]) == [f"1e-{decade}" for decade in range(4)]
    # a calibration is as noisy as its noisiest primary
    noises = [summary["channels"][name]["noise_relative"] for name in shares]
    assert summary["noise_relative"] == max(noises) > min(noises)
    for code, decade in ((255, "1e-0"), (90, "1e-1"), (31, "1e-2")):
        planted = 100 * (1 / (1.02 * (1 + 0.1 * (1 - code / 255))) - 1)
        assert summary["crosstalk_percent"][decade] == pytest.approx(
            planted, abs=3 * summary["crosstalk_error_percent"][decade]
        )
        assert summary["crosstalk_error_percent"][decade] < 2
    for found, (name, power) in zip(
        primary_responses(tmp_path / "monitor.toml", 8), powers.items(), strict=True
    ):
        for code, decade in ((90, "1e-1"), (31, "1e-2")):
            error = summary["channels"][name]["error_percent"][decade]
            assert found.light[code] == pytest.approx((code / 255) ** power, rel=3 * error / 100)
    # the screen has one black level, which each primary tells
    blacks = [summary["channels"][name]["black_level"]["unit"] for name in shares]
    table = (tmp_path / "monitor.csv").read_text().splitlines()
    (dark,) = [row for row in table if row.startswith("0,")]
    light = [float(cell) for cell in dark.split(",")[1:]]
    assert light == pytest.approx([np.mean(blacks)] * 3, rel=1e-5)
    assert max(blacks) > 1.0001 * min(blacks)
    said = run_hilstar_here(
        "calibrate", "photometric", tmp_path / "m.csv", "-o", tmp_path / "again.toml"
    ).stdout
    assert "channel b" in said and "crosstalk at 1e-1" in said
    calibration = load_calibration(tmp_path / "monitor.toml", 8, bit_stealing=True)
    assert calibration.weights == pytest.approx((0.2, 0.7, 0.1), rel=0.01)
    assert len(calibration.response.light) == 1786


def test_the_scatter_of_a_black_without_light_is_no_relative_noise(tmp_path, rng):
    """As first light reads an OLED: too few repeats of bright levels, and black is its own
    noise.
    """
    times = {0: 5, 2: 2, 5: 2, 13: 2, 25: 2, 44: 1, 71: 1, 90: 1, 111: 1, 127: 3, 169: 1, 255: 4}
    codes = [code for code, count in times.items() for _ in range(count)]
    rows = [
        (
            code,
            "w",
            1e5 * (code / 255) ** 2.2 * (1 + 0.003 * rng.standard_normal())
            + 0.2 * rng.standard_normal(),
        )
        for code in codes
    ]
    path = write_readings(
        tmp_path / "m.csv", [(code, channel, abs(value)) for code, channel, value in rows]
    )
    found = calibrate_photometric(path, tmp_path / "monitor.toml")
    assert found["noise_relative"] < 0.1
    assert (found["codes"], found["repeats"]) == (len(times), {"min": 1, "max": 5})


def test_a_drawing_shows_each_channel_and_tells_of_the_one_that_is_farthest_off(
    tmp_path, rng, figures
):
    path = measure_plan(tmp_path / "m.csv", CURVES["gamma"], rng, black=0.01)
    fit = fit_channel(read_measurements(path), "w")
    scales = {"r": 1, "g": 3, "b": 2}
    fits = {name: replace(fit, residual=k * fit.residual) for name, k in scales.items()}
    finding = draw_fits(fits, tmp_path / "m")
    errors = held_out(fits["g"])
    rms, mag, largest = (errors[name] for name in ("rms_percent", "rms_mag", "max_percent"))
    assert finding == (
        f"Levels held out of the fit are {rms:.2g} % ({mag:.2g} mag) rms off, {largest:.2g} % at"
        f" the maximum; a patch repeats to {100 * fit.levels.reading_noise(fit.noise_relative):.2g} %"
    )
    response, residual = figures[0].axes
    curve, dots, black = response.lines[:3]
    np.testing.assert_array_equal(curve.get_xdata(), np.arange(1, 256))
    np.testing.assert_array_equal(curve.get_ydata(), np.maximum(fit.light[1:], 1e-5))
    assert black.get_ydata() == pytest.approx([fit.black / fit.white] * 2)
    code, light = dots.get_data()
    # levels are drawn as the fit is, above black
    bright = code > 50
    np.testing.assert_allclose(light[bright], fit.light[code[bright]], rtol=5 * NOISE)
    np.testing.assert_allclose(light * fit.white + fit.black, fit.levels.mean[-len(code) :])
    bands = [band.get_paths()[0].vertices[:, 1] for band in residual.collections]
    shown = fit.light >= 1e-3
    for band, drawn, k in zip(bands, residual.lines, scales.values(), strict=False):
        assert band.max() == pytest.approx(100 * fit.error[shown].max())
        code, off_percent = drawn.get_data()
        assert shown[code].all()
        np.testing.assert_allclose(off_percent, 100 * k * fit.residual[-len(code) :])


def ramp(codes, bits=8, curve=CURVES["gamma"], repeats=3, black=1e-3):
    return [
        (int(c), "w", float(curve(c / (2**bits - 1)) + black) * (1 + 1e-3 * (k - 1)))
        for k in range(repeats)
        for c in codes
    ]


STEPS = [0, 1, *range(5, 256, 10)]


def test_noise_is_not_taken_for_a_drift(tmp_path):
    for seed in range(20):
        again = read_measurements(
            measure_plan(tmp_path / "m.csv", CURVES["gamma"], np.random.default_rng(seed))
        )
        drift, error = drift_over_run(again)
        assert abs(drift) < 4 * error


def test_bits_are_those_of_the_largest_code_unless_given(tmp_path):
    path = write_readings(tmp_path / "m.csv", ramp([0, 300]))
    assert read_measurements(path).bits == 10
    assert read_measurements(path, 12).bits == 12
    line = refusal(calibrate_photometric, path, tmp_path / "monitor.toml", bits=8)
    assert "outside 8 bits" in line


def test_the_black_level_is_as_well_known_as_white_is(tmp_path, rng):
    """It is stated relative to white. Read forty times, its own error is a third of white's."""
    black = 0.3
    codes = np.append(np.zeros(37, dtype=np.intp), np.repeat(planned_codes(8, 24), 3))
    light = CURVES["gamma"](codes / 255) + black
    sigmas = []
    for _ in range(30):
        values = light * (1 + NOISE * rng.standard_normal(len(light)))
        rows = [(code, "w", value) for code, value in zip(codes, values, strict=True)]
        fit = fit_channel(read_measurements(write_readings(tmp_path / "read.csv", rows)), "w")
        sigmas.append((fit.black / fit.white - black) * fit.white / fit.black_error)
    assert 0.7 < np.sqrt(np.mean(np.square(sigmas))) < 1.4


def test_a_black_level_that_is_read_badly_is_known_by_the_levels_above_it(tmp_path):
    """Its own three readings are 0.0005 of white too bright, and known to 0.0006."""
    codes = np.concatenate([[0], np.rint(np.geomspace(8, 255, 24))]).astype(int)
    rows = [(0, "w", value) for value in (0.5e-3, 1.5e-3, 2.5e-3)]
    for code in codes[1:].tolist():
        light = (code / 255) ** 2.2 + 1e-3
        rows += [(code, "w", share * light) for share in (0.999, 1.0, 1.001)]
    fit = fit_channel(read_measurements(write_readings(tmp_path / "m.csv", rows)), "w")
    assert fit.black_error < 1e-4
    assert abs(fit.black - 1e-3) < 2 * fit.black_error


def test_no_black_is_below_zero_though_the_levels_above_it_say_so(tmp_path):
    """All of them are 0.001 of white too dark, where black reads 0 and is known to 0.003."""
    rows = ["code,channel,value,sigma", "0,w,0,0.003"]
    for code in np.rint(np.geomspace(18, 255, 30)).astype(int).tolist():
        light = (code / 255) ** 2.2 - 1e-3
        rows.append(f"{code},w,{light!r},{1e-3 * light!r}")
    path = tmp_path / "m.csv"
    path.write_text("\n".join(rows) + "\n")
    assert fit_channel(read_measurements(path), "w").black == 0.0


def test_a_common_error_that_no_response_has_is_found_and_taken_off_the_levels(tmp_path):
    """Of 2 % up and down by turns, in light that is known to 0.1 %."""
    codes = np.linspace(0, 255, 16).astype(int)
    light = (codes / 255) ** 2.2
    common = 0.02 * light * np.where(np.arange(16) % 2, 1, -1)
    rows = ["code,channel,value,sigma,common_1"]
    readings = np.column_stack([light + common, common]).tolist()
    for code, (value, error) in zip(codes.tolist(), readings, strict=True):
        rows.append(f"{code},w,{value!r},{1e-3 * value + 1e-6!r},{error!r}")
    path = tmp_path / "m.csv"
    path.write_text("\n".join(rows) + "\n")
    fit = fit_channel(read_measurements(path), "w")
    assert np.abs(fit.level_off).max() < 1e-3
    assert np.abs(curve_errors(fit, CURVES["gamma"])).max() < 5e-3


def test_a_calibration_has_as_many_degrees_of_freedom_as_readings_less_one_a_level(tmp_path, rng):
    """Of each level's readings its mean takes one."""
    path = measure_plan(tmp_path / "m.csv", CURVES["srgb"], rng, black=1e-3, repeats=4)
    calibrate_photometric(path, tmp_path / "monitor.toml")
    readings = read_measurements(path).code
    errors = read_toml(tmp_path / "monitor.toml").errors
    assert errors.dof == len(readings) - len(np.unique(readings))


def test_additivity_is_as_sure_as_its_primaries_by_their_light_and_white(tmp_path):
    """Linear channels of 20, 50 and 30 units before a white of 80: at all codes a quarter more."""
    light = np.linspace(0, 1, 1001)
    path = measure_plan(tmp_path / "m.csv", CURVES["gamma"], np.random.default_rng(0))
    measured = fit_channel(read_measurements(path), "w")
    fits = {}
    whites = {"w": (80.0, 0.01, 0.0), "r": (20.0, 0.03, 0.04), "g": (50.0, 0.0, 0.02)}
    for name, (white, own, of_white) in (whites | {"b": (30.0, 0.05, 0.0)}).items():
        levels = replace(
            measured.levels,
            mean=np.array([white]),
            count=np.ones(1),
            stated=np.array([of_white * white]),
            additive_noise=0.0,
        )
        error = np.full(1001, own)
        fits[name] = replace(
            measured, light=light, white=white, error=error, levels=levels, noise_relative=0.0
        )
    found = _additivity(fits)
    assert found["additivity_percent"] == pytest.approx(25.0)
    names = [f"1e-{decade}" for decade in range(4)]
    assert found["crosstalk_percent"] == pytest.approx(dict.fromkeys(names, 25.0))
    # each relative error by its share of the sum, and white's own
    squares = (0.2 * 0.05) ** 2 + (0.5 * 0.02) ** 2 + (0.3 * 0.05) ** 2 + 0.01**2
    error_percent = 100 * squares**0.5
    assert found["crosstalk_error_percent"] == pytest.approx(dict.fromkeys(names, error_percent))


def test_what_all_readings_and_black_have_in_common_is_no_error_of_the_response(tmp_path, rng):
    """An offset of each reading moves black, and nothing above it; one of light alone does."""
    codes = np.linspace(0, 255, 16).astype(int)
    light = (codes / 255) ** 2.2 * (1 + 1e-3 * rng.normal(size=16)) + 0.01
    errors = []
    black_errors = []
    for of_black, of_light in ((0.0, 0.0), (0.005, 0.005), (0.0, 0.005)):
        rows = ["code,channel,value,sigma,common_1"]
        for code, value in zip(codes.tolist(), light.tolist(), strict=True):
            rows.append(f"{code},w,{value!r},1e-4,{of_light if code else of_black}")
        path = tmp_path / "measured.csv"
        path.write_text("\n".join(rows) + "\n")
        fit = fit_channel(read_measurements(path), "w")
        errors.append(fit.error)
        black_errors.append(fit.black_error)
    np.testing.assert_allclose(errors[1], errors[0], rtol=1e-6)
    assert (errors[2][1:200] > 1.2 * errors[0][1:200]).all()
    # of white's unit: what black itself has of the cause
    assert black_errors[1] == pytest.approx(math.hypot(black_errors[0], 0.005), rel=1e-6)
    assert black_errors[2] < 0.005
