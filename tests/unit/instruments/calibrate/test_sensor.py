"""A sensor from its data sheet and from its own frames: what comes out is what went in, within
the errors that are stated.
"""

from __future__ import annotations

import json
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image

from hilstar.basics.errors import InputError
from hilstar.instruments.calibrate import sensor
from hilstar.instruments.calibrate.sensor import (
    Levels,
    SensorFile,
    _Figures,
    _system_gain,
    draw_curves,
    import_emva,
    measure_sensor,
    sensor_of,
    write_sensor,
)
from hilstar.server.bench.config import read_config
from hilstar.server.bench.star_rates import bench_optics
from hilstar.tracker.detector import Detector
from hilstar.tracker.settings import DetectorSettings
from tests.support.benches import SMALL_BENCH
from tests.support.card_texts import drawn_figures
from tests.support.commands import run_hilstar_here
from tests.support.refusals import refusal

SIZE_PX = (256, 200)
SHAPE = (200, 256)
# Nine quantities, errors of their own pixels: 4 sigmas are one of 16 000. Seeds are fixed, so this
# is a margin, not a flake.
SIGMAS = 4.0
LEVELS_E = (1500.0, 4000.0, 8000.0, 14_000.0, 20_000.0, 24_000.0, 27_000.0, 32_000.0, 40_000.0)
SENSOR = DetectorSettings(
    gain_e_per_dn=1.5, bits=16, offset_dn=200.0, read_noise_e=6.0, prnu=0.02, dark_e_per_s=203.0, dsnu_e_per_s=30.0,
    dsnu_e=5.0, full_well_e=30_000.0, device_seed=3,
)  # fmt: skip
SHEET = """quantity,value,unit
# A camera of 12 bits.
K,0.25,DN/e-
sigma_d,6.2,e-
mu_e.sat,10500,e-
DSNU1288,1.4,e-
PRNU1288,0.5,%
mu_I,12,e-/s
T_d,7.5,K
temperature,35,degC
bits,12,bit
mu_y.dark,30,DN
SNRmax,40,dB
eta@530nm,64,%
eta@450 nm,0.55,1
"""


def write_frames(
    folder: Path, settings: DetectorSettings, levels_e, darks_s=(0.01, 5.0, 20.0)
) -> tuple[list[Path], list[Path]]:
    """Flats of 0.1 s and darks, two of each, as FITS with EXPTIME."""
    detector, rng = Detector(settings, SIZE_PX), np.random.default_rng(7)
    flats = [(level_e, 0.1) for level_e in levels_e for _ in range(2)]
    darks = [(0.0, seconds) for seconds in darks_s for _ in range(2)]
    named: list[Path] = []
    for number, (level_e, seconds) in enumerate([*flats, *darks]):
        named.append(folder / f"frame_{number:03}.fits")
        frame = detector.expose(np.full(SHAPE, level_e), seconds, rng)
        fits.PrimaryHDU(frame, fits.Header({"EXPTIME": seconds})).writeto(named[-1])
    return named[: len(flats)], named[len(flats) :]


def test_frames_of_the_virtual_detector_give_its_settings_back(tmp_path):
    found = measure_sensor(*write_frames(tmp_path, SENSOR, LEVELS_E))
    for key in (
        "gain_e_per_dn",
        "read_noise_e",
        "prnu",
        "dsnu_e",
        "dark_e_per_s",
        "dsnu_e_per_s",
        "offset_dn",
    ):
        assert found.keys[key] == pytest.approx(
            getattr(SENSOR, key), abs=SIGMAS * found.sigmas[key]
        ), key
        assert found.sigmas[key] < 0.02 * found.keys[key], key
    # The flat before saturation, of levels 3000 e- apart.
    assert found.keys["full_well_e"] == pytest.approx(30_000.0, abs=4000.0)
    assert found.keys["bits"] == math.ceil(math.log2(200 + 30_000 / 1.5 + 60))


@pytest.mark.parametrize(
    ("key", "in_extension"), [("EXPOSURE", False), ("EXPTIME", True), ("EXPOINUS", False)]
)
def test_exposures_are_read_wherever_they_stand(tmp_path, key, in_extension):
    """The same frames with their exposure under another keyword, or in a header that fpack's
    image has.
    """
    flats, darks = write_frames(tmp_path, SENSOR, LEVELS_E[:4])
    expected = measure_sensor(flats, darks)
    for path in (*flats, *darks):
        with fits.open(path) as hdus:
            seconds, frame = hdus[0].header["EXPTIME"], hdus[0].data.copy()
        scale = 1e6 if key == "EXPOINUS" else 1.0
        kind = fits.CompImageHDU if in_extension else fits.PrimaryHDU
        kind(frame, fits.Header({key: seconds * scale})).writeto(path, overwrite=True)
    found = measure_sensor(flats, darks)
    assert found.keys == pytest.approx(expected.keys)
    assert "dark_e_per_s" in found.keys


def test_darks_of_unknown_exposures_are_no_repeats_of_one_level(tmp_path):
    flats, darks = write_frames(tmp_path, SENSOR, LEVELS_E[:4])
    for path in (*flats, *darks):
        fits.delval(path, "EXPTIME")
    with pytest.raises(
        InputError,
        match=r"--darks: their means differ by .* DN, and no header says their exposures.*EXPTIME",
    ):
        measure_sensor(flats, darks)
    # Darks of one exposure are repeats, whatever it was.
    assert "dark_e_per_s" not in measure_sensor(flats, darks[:2]).keys


def test_frames_of_which_some_say_an_exposure_are_refused(tmp_path):
    flats, darks = write_frames(tmp_path, SENSOR, LEVELS_E[:4])
    for path in darks[:2]:
        fits.delval(path, "EXPTIME")
    with pytest.raises(InputError, match="--darks: some frames say no exposure and some do"):
        measure_sensor(flats, darks)


def test_frames_by_plain_numpy_give_back_what_made_them(tmp_path):
    gain, read_e, prnu = 2.5, 12.0, 0.01
    rng = np.random.default_rng(1)
    response = 1 + prnu * rng.standard_normal(SHAPE)
    paths = []
    for number, level_e in enumerate(
        np.repeat([0.0, 2000.0, 8000.0, 20_000.0, 40_000.0, 60_000.0], 2)
    ):
        charge_e = rng.poisson(level_e * response) + read_e * rng.standard_normal(SHAPE)
        paths.append(tmp_path / f"{number:02}.png")
        Image.fromarray(np.rint(charge_e / gain + 100).astype(np.uint16)).save(
            paths[-1], compress_level=1
        )
    found = measure_sensor(paths[2:], paths[:2])
    for key, value in {
        "gain_e_per_dn": gain,
        "read_noise_e": read_e,
        "prnu": prnu,
        "offset_dn": 100.0,
    }.items():
        assert found.keys[key] == pytest.approx(value, abs=SIGMAS * found.sigmas[key]), key
        assert found.sigmas[key] < 0.02 * value, key
    # No pattern in the dark, no saturation, no EXPTIME: none is claimed.
    assert found.keys["dsnu_e"] < SIGMAS * found.sigmas["dsnu_e"]
    assert not {"full_well_e", "dark_e_per_s"} & set(found.keys)
    assert "do not saturate" in " ".join(found.notes)
    assert "no dark current" in " ".join(found.notes)


def test_a_data_sheet_gives_the_keys_in_their_units(tmp_path):
    (tmp_path / "emva.csv").write_text(SHEET)
    found = import_emva(tmp_path / "emva.csv")
    settings = found.settings
    assert settings.gain_e_per_dn == 4.0  # K is DN/e-
    assert (settings.read_noise_e, settings.full_well_e, settings.bits, settings.offset_dn) == (
        6.2,
        10_500.0,
        12,
        30.0,
    )
    assert (settings.dsnu_e, settings.dsnu_e_per_s) == (1.4, 0.0)  # an offset map, and no rate
    assert settings.prnu == pytest.approx(0.005)
    assert settings.dark_factor == 1.0
    warmer = DetectorSettings(**{**found.keys, "temperature_k": 308.15 + 7.5})
    assert warmer.dark_factor == pytest.approx(2.0, rel=1e-12)
    assert found.efficiency == ((450.0, 0.55), (530.0, pytest.approx(0.64)))
    assert found.notes == ("not used: SNRmax",)


def test_json_says_what_csv_says(tmp_path):
    (tmp_path / "emva.csv").write_text(SHEET)
    rows = [line.split(",") for line in SHEET.splitlines()[1:] if not line.startswith("#")]
    objects = [
        {"quantity": name, "value": float(value), "unit": unit} for name, value, unit in rows
    ]
    (tmp_path / "emva.json").write_text(json.dumps(objects))
    assert import_emva(tmp_path / "emva.json") == import_emva(tmp_path / "emva.csv")
    # its objects are counted as a person counts them
    objects[1]["unit"] = "kg"
    (tmp_path / "emva.json").write_text(json.dumps(objects))
    line = refusal(import_emva, tmp_path / "emva.json")
    assert "emva.json:2: sigma_d = 6.2 kg; write it above 0 in e- or ke-" in line


def test_photon_transfer_of_an_imported_sensor_gives_its_sheet_back(tmp_path):
    (tmp_path / "emva.csv").write_text(
        SHEET.replace("K,0.25,DN/e-", "1/K,0.8,e-/DN").replace("bits,12", "bits,16")
    )
    sheet = import_emva(tmp_path / "emva.csv")
    found = measure_sensor(
        *write_frames(tmp_path, sheet.settings, (800.0, 2000.0, 4000.0, 6000.0, 9000.0))
    )
    for key in ("gain_e_per_dn", "read_noise_e", "prnu", "dsnu_e", "dark_e_per_s"):
        assert found.keys[key] == pytest.approx(sheet.keys[key], abs=SIGMAS * found.sigmas[key]), (
            key
        )


def test_a_bench_takes_the_tables_that_are_written(tmp_path):
    (tmp_path / "emva.csv").write_text(SHEET)
    files = write_sensor(tmp_path / "camera.toml", import_emva(tmp_path / "emva.csv"), "a test")
    assert [file.name for file in files] == [
        "camera.toml",
        "camera_qe.csv",
        "camera_curves.png",
        "camera_curves.svg",
    ]
    assert all(file.is_file() for file in files)
    _, tables = files[0].read_text().split("[tracker]\n")
    # beside it, wherever both are moved
    assert tables.startswith('quantum_efficiency = "camera_qe.csv"\n')
    bench = SMALL_BENCH.replace('quantum_efficiency = "ccd47-20"\n', "").replace(
        "[tracker]\n", "[tracker]\n" + tables.split("[")[0]
    )
    (tmp_path / "bench.toml").write_text(bench + "[" + tables.split("[")[1])
    tracker = read_config(tmp_path / "bench.toml").tracker
    for key, value in import_emva(tmp_path / "emva.csv").keys.items():
        assert getattr(tracker.detector, key) == pytest.approx(value, rel=1e-5), key  # six digits
    assert bench_optics(tracker, tmp_path).quantum_efficiency(np.array([490.0])) == pytest.approx(
        0.595
    )


def test_the_command_takes_its_darks_up_to_the_next_option(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    flats, darks = (
        [path.name for path in paths] for paths in write_frames(tmp_path, SENSOR, LEVELS_E[:5])
    )
    result = run_hilstar_here(
        "sensor", "measure", *flats, "--darks", *darks, "-o", "sensor.toml", "--json"
    )
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout)
    assert told["keys"]["gain_e_per_dn"] == pytest.approx(1.5, rel=0.02)
    assert "gain_e_per_dn = 1.5" in Path("sensor.toml").read_text()
    for wrong, words in (
        ((*flats[:3], "--darks", *darks), "3 frames; give two of each"),
        ((*flats, "--darks", darks[0], darks[-1]), "EXPTIME is not that of"),
        ((*darks, "--darks", *flats), "no noise that grows with light"),
    ):
        result = run_hilstar_here("sensor", "measure", *wrong, "-o", "other.toml")
        assert result.returncode == 2
        assert words in result.stderr
        assert not Path("other.toml").exists()


def test_an_error_stands_beside_its_value_as_a_comment(tmp_path):
    """And one share of all wavelengths in place of a curve."""
    found = SensorFile(
        {"gain_e_per_dn": 3.99, "read_noise_e": 2.5},
        {"gain_e_per_dn": 0.0213},
        ((530.0, 0.625),),
        ("dsnu_e: too few images",),
    )
    with drawn_figures():
        files = write_sensor(tmp_path / "camera.toml", found, "a test")
    assert files[0] == tmp_path / "camera.toml" and not (tmp_path / "camera_qe.csv").exists()
    text = files[0].read_text()
    assert text.splitlines() == [
        "# a test",
        "# dsnu_e: too few images",
        "[tracker]",
        "quantum_efficiency = 0.625",
        "[tracker.detector]",
        "gain_e_per_dn = 3.99  # +- 0.021",
        "read_noise_e = 2.5",
    ]
    assert tomllib.loads(text)["tracker"]["detector"] == found.keys


def test_an_import_tells_what_it_wrote_and_what_it_passed_over(tmp_path, monkeypatch):
    """The charts that `write_sensor` draws beside its tables are held by other tests."""
    monkeypatch.chdir(tmp_path)
    Path("sheet.csv").write_text("quantity,value,unit\nK,0.25,DN/e-\nsigma_d,2.5,e-\nspeed,3,m/s\n")
    sources = []

    def write(output, _, source):
        sources.append(source)
        return [output, Path("curves.png")]

    monkeypatch.setattr(sensor, "write_sensor", write)
    words = ("sensor", "import", "sheet.csv", "-o", "sensor.toml")
    told = run_hilstar_here(*words)
    assert told.returncode == 0, told.stderr
    assert told.stdout.splitlines() == [
        "gain_e_per_dn = 4",
        "read_noise_e = 2.5",
        "not used: speed",
        "wrote sensor.toml, curves.png",
    ]
    assert sources == ["By hilstar sensor import from sheet.csv"]
    assert json.loads(run_hilstar_here(*words, "--json").stdout) == {
        "keys": {"gain_e_per_dn": 4.0, "read_noise_e": 2.5},
        "sigmas": {},
        "notes": ["not used: speed"],
        "written": ["sensor.toml", "curves.png"],
    }


def test_a_measurement_tells_its_errors_apart_from_its_figures(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    paths = write_frames(tmp_path, SENSOR, LEVELS_E[:3], darks_s=(0.1,))
    flats, darks = ([path.name for path in some] for some in paths)
    monkeypatch.setattr(sensor, "write_sensor", lambda output, *_: [output])
    words = ["sensor", "measure", *flats, "--darks", *darks, "-o", "sensor.toml"]
    told = json.loads(run_hilstar_here(*words, "--json").stdout)
    gain, error = told["keys"]["gain_e_per_dn"], told["sigmas"]["gain_e_per_dn"]
    assert abs(gain - SENSOR.gain_e_per_dn) < SIGMAS * error < 0.1


SPELLED = {
    "K,0.25,DN/e⁻\nσ_d,2.5,e⁻\nμ_e.sat,10.5,ke-\nη@530nm,100,%": {
        "gain_e_per_dn": 4,
        "read_noise_e": 2.5,
        "full_well_e": 10500,
    },
    "K,0.25,ADU/e-\nσ_{d},0.65,ADU\nDSNU_1288,0.2,counts": {
        "gain_e_per_dn": 4,
        "read_noise_e": 2.6,
        "dsnu_e": 0.8,
    },
    "sigma_d,0.65,DN\nsigma_d,2.6,e-\nK,0.25,DN/e-": {"gain_e_per_dn": 4, "read_noise_e": 2.6},
    "K,0.25,DN/e−\nµ_I,3,e-/pixel/s\nTemperature,−10,°C": {
        "gain_e_per_dn": 4,
        "dark_e_per_s": 3,
        "temperature_k": 263.15,
    },
    "K,0.25,LSB/electron\nmu_I.mean,0.5,DN/s\nmu_I.mean,2,e-/(pixel s)": {
        "gain_e_per_dn": 4,
        "dark_e_per_s": 2,
    },
    "K,0.25,DN/e-\nK,0.25,DN/e-\n1/K,4.02,e-/DN\nDSNU,0.5,DN": {"gain_e_per_dn": 4, "dsnu_e": 2},
}


@pytest.mark.parametrize("rows", SPELLED)
def test_symbols_and_units_of_a_sheet_are_read_as_people_spell_them(tmp_path, rows):
    (tmp_path / "sheet.csv").write_text(f"quantity,value,unit\n{rows}\n")
    sensor = import_emva(tmp_path / "sheet.csv")
    keys = dict(sensor.keys)
    # the dark signal of a sheet is that at its own temperature
    assert keys.pop("dark_reference_temperature_k", None) == keys.get("temperature_k")
    assert keys == pytest.approx(SPELLED[rows])
    assert sensor.notes == ()
    assert [nm for nm, _ in sensor.efficiency] == ([530] if "530" in rows else [])


# What was converted may be rounded: by 5 %, to either side.
@pytest.mark.parametrize(
    ("rows", "is_alike"),
    [
        ("K,0.25,DN/e-\n1/K,4.19,e-/DN", True),
        ("K,0.25,DN/e-\n1/K,3.81,e-/DN", True),
        ("K,0.25,DN/e-\n1/K,4.21,e-/DN", False),
        ("K,0.25,DN/e-\n1/K,3.79,e-/DN", False),
        ("K,0.25,DN/e-\nK,0.2501,DN/e-", False),
        ("K,0.25,DN/e-\nK,0.2499,DN/e-", False),
        ("K,0.25,DN/e-\nsigma_d,2.6,e-\nsigma_d,0.68,DN", True),
        ("K,0.25,DN/e-\nsigma_d,2.6,e-\nsigma_d,0.62,DN", True),
        ("K,0.25,DN/e-\nsigma_d,2.6,e-\nsigma_d,0.69,DN", False),
        ("K,0.25,DN/e-\nsigma_d,2.6,e-\nsigma_d,0.61,DN", False),
    ],
)
def test_two_values_of_a_quantity_are_one_or_refused(tmp_path, rows, is_alike):
    sheet = tmp_path / "sheet.csv"
    sheet.write_text(f"quantity,value,unit\n{rows}\n")
    if is_alike:
        assert import_emva(sheet).keys["gain_e_per_dn"] == pytest.approx(4)
        return
    with pytest.raises(InputError, match="leave one of them"):
        import_emva(sheet)


@pytest.mark.parametrize(
    ("old", "new"),
    [(b"BITPIX  ", b"????????"), (b"NAXIS2  ", b"????????"), (b"EXPTIME = ", b"EXPTIME = ?")],
)
def test_a_frame_with_a_damaged_header_is_refused_in_one_line(tmp_path, old, new):
    """Astropy raises errors of many classes, KeyError and its own VerifyError among them."""
    flats, darks = write_frames(tmp_path, SENSOR, LEVELS_E[:2])
    data = flats[0].read_bytes()
    place = data.index(old)
    flats[0].write_bytes(data[:place] + new + data[place + len(new) :])
    with pytest.raises(InputError, match="frame_000") as refusal:
        measure_sensor(flats, darks)
    assert len(str(refusal.value).splitlines()) == 1


def test_the_error_of_a_gain_is_the_scatter_of_sensors_that_are_alike(rng):
    """400 sensors of 5 DN an electron: a variance of n pixels scatters by sqrt(2 / n)."""
    pixels, sensors = 1000, 400
    signal_dn = np.array([500.0, 2000.0, 6000.0])
    gains, errors = [], []
    for _ in range(sensors):
        variance_dn2 = 5.0 * signal_dn * rng.chisquare(pixels, len(signal_dn)) / pixels
        unit = _system_gain(signal_dn, variance_dn2, variance_dn2, pixels)
        figures = _Figures(unit)
        gains.append(figures.keys["gain_e_per_dn"])
        errors.append(figures.sigmas["gain_e_per_dn"])
    assert np.mean(gains) == pytest.approx(0.2, rel=SIGMAS * math.sqrt(2 / 3 / pixels / sensors))
    # a standard deviation of n values is known to 1 / sqrt(2 n)
    assert np.std(gains) == pytest.approx(np.mean(errors), rel=SIGMAS / math.sqrt(2 * sensors))


def line_errors(place, sigma, pixels):
    """One sigma of the slope of a line and of its value at 0, by the sigmas of a pixel's points."""
    design = np.column_stack([place, np.ones(len(place))]) / sigma[:, None]
    return np.sqrt(np.diag(np.linalg.inv(design.T @ design)) / pixels)


@pytest.mark.parametrize(("largest_dn", "bits"), [(4095.0, 12), (4096.0, 13)])
def test_a_sensor_s_figures_are_the_lines_of_its_frames(largest_dn, bits):
    """Levels without scatter, of 0.5 DN an electron; the fourth is full, and the fifth beyond it."""
    k, prnu = 0.5, 0.02
    dark_s = np.array([0.0, 2.0, 8.0])
    signal_dn = np.array([200.0, 800.0, 1300.0, 2000.0, 2100.0])
    flat_s = 0.1
    under_dn2 = 0.25 * 36.0 + 1 / 12 + 0.25 * 40.0 * flat_s
    temporal = under_dn2 + k * signal_dn
    temporal[-1] = 50.0  # full
    pattern0, pattern_s = (0.25 * 3.0**2), (0.25 * 0.7**2)
    light = Levels(
        100.0 + 20.0 * flat_s + signal_dn,
        temporal,
        pattern0 + pattern_s * flat_s**2 + (prnu * signal_dn) ** 2,
        np.full(5, flat_s),
        largest_dn,
        (80, 60),
    )
    dark = Levels(
        100.0 + 20.0 * dark_s,
        0.25 * 36.0 + 1 / 12 + 0.25 * 40.0 * dark_s,
        pattern0 + pattern_s * dark_s**2,
        dark_s,
        300.0,
        (80, 60),
    )
    found = sensor_of(light, dark)
    keys = found.keys
    wanted = {
        "gain_e_per_dn": 2.0,
        "offset_dn": 100.0,
        "read_noise_e": 6.0,
        "dsnu_e": 3.0,
        "dsnu_e_per_s": 0.7,
        "dark_e_per_s": 40.0,
        "full_well_e": 4000.0,
        "bits": bits,
    }
    assert {name: keys[name] for name in wanted} == pytest.approx(wanted)
    # by the level nearest to half of full, without what dark frames have of it
    assert keys["prnu"] == pytest.approx(prnu)
    pattern_dn2 = (prnu * 800.0) ** 2
    at_half = light.pattern_error_dn2[1] / math.sqrt(80 * 60)
    sigma = at_half / (2 * math.sqrt(pattern_dn2)) / 800.0
    assert found.sigmas["prnu"] == pytest.approx(sigma)
    # the slope of signals up to 70 % of full alone, whose inverse is the gain
    pixels = 80 * 60
    weight = pixels / 2 * (signal_dn[:3] / temporal[:3]) ** 2
    slope_error = 1 / math.sqrt(weight.sum())

    def in_electrons(value_dn, error_dn):
        return math.hypot(error_dn, value_dn * slope_error / k) / k

    def root_in_electrons(root_dn, error_dn2):
        return in_electrons(root_dn, error_dn2 / (2 * root_dn))

    # of means of two frames, variances of their differences, and covariances
    dark_s_error, offset_error = line_errors(
        dark_s, np.sqrt(dark.temporal_dn2 / 2 + dark.spatial_dn2), pixels
    )
    _, read_error = line_errors(dark_s, math.sqrt(2) * dark.temporal_dn2, pixels)
    both_dn2 = dark.temporal_dn2 + dark.spatial_dn2
    rate_error, dsnu_error = line_errors(dark_s**2, np.hypot(both_dn2, dark.spatial_dn2), pixels)
    assert {name: found.sigmas[name] for name in found.sigmas if name != "prnu"} == pytest.approx(
        {
            "gain_e_per_dn": slope_error / k**2,
            "offset_dn": offset_error,
            "read_noise_e": root_in_electrons(0.5 * 6.0, read_error),
            "dsnu_e": root_in_electrons(0.5 * 3.0, dsnu_error),
            "dsnu_e_per_s": root_in_electrons(0.5 * 0.7, rate_error),
            "dark_e_per_s": in_electrons(0.5 * 40.0, dark_s_error),
            # half of the way from the level below to that above
            "full_well_e": in_electrons(2000.0, (2100.0 - 1300.0) / 2),
        }
    )
    np.testing.assert_allclose(found.transfer[0], signal_dn)


def test_frames_of_two_exposures_are_no_pair(tmp_path):
    flats, _ = write_frames(tmp_path, SENSOR, LEVELS_E[:2])
    with fits.open(flats[1], mode="update") as hdus:
        hdus[0].header["EXPTIME"] = 0.2
    with pytest.raises(InputError, match="its size or EXPTIME is not that of"):
        sensor.read_levels(flats, "FLATS")


def write_pair(path, levels_dn, noise_dn):
    """Two frames of 64 x 48 px whose noise is two chequered patterns that are unlike."""
    down, right = np.mgrid[0:48, 0:64]
    names = []
    for number, (level_dn, place) in enumerate(zip(levels_dn, (down, right), strict=True)):
        pattern_dn = noise_dn * (1 - 2 * (place % 2))
        names.append(path.with_name(f"{path.name}_{number}.png"))
        # the right half is brighter by 40: the pattern that both have in common
        frame = level_dn + pattern_dn + 40 * (right >= 32)
        Image.fromarray(frame.astype(np.uint16)).save(names[-1])
    return names


def test_a_pair_of_frames_tells_noise_by_its_difference_and_the_pattern_by_what_is_common(tmp_path):
    """Light that differs from one frame to the other is no noise."""
    levels = sensor.read_levels(write_pair(tmp_path / "flat", (100, 107), 3), "FLATS")
    assert levels.mean_dn.tolist() == [123.5]
    assert levels.temporal_dn2.tolist() == [9.0]
    assert levels.spatial_dn2.tolist() == [400.0]
    assert levels.largest_dn == 150.0


@pytest.mark.parametrize(("apart_dn", "is_refused"), [(1, False), (2, True)])
def test_darks_without_exposures_differ_by_half_their_noise_at_most(tmp_path, apart_dn, is_refused):
    """Of 3 DN of noise: 1.5 DN."""
    darks = [
        *write_pair(tmp_path / "dark", (100, 100), 3),
        *write_pair(tmp_path / "later", (100 + apart_dn, 100 + apart_dn), 3),
    ]
    flats = [
        *write_pair(tmp_path / "half", (200, 200), 6),
        *write_pair(tmp_path / "full", (300, 300), 8),
    ]
    if not is_refused:
        measure_sensor(flats, darks)
        return
    with pytest.raises(InputError, match=f"their means differ by {apart_dn} DN"):
        measure_sensor(flats, darks)


def test_a_sensor_s_lines_are_drawn_through_its_points(tmp_path, figures):
    """Shot noise makes a variance of the signal over e- a DN, and dark current a line from the
    offset on.
    """
    points = np.array([[0.0, 1000.0, 3000.0], [0.0, 500.0, 1500.0]])
    dark_points = np.array([[0.5, 4.0], [101.0, 108.0]])
    keys = {"gain_e_per_dn": 2.0, "offset_dn": 100.0, "dark_e_per_s": 4.0, "full_well_e": 8000.0}
    for transfer, dark, signal_dn, seconds in (
        (points, dark_points, 3000.0, 4.0),
        (None, None, 4000.0, 1.0),
    ):
        found = SensorFile(keys, {}, transfer=transfer, dark=dark)
        draw_curves(tmp_path / "curves", found.settings, found)
        lines, darks = ([line.get_xydata() for line in axes.lines] for axes in figures[-1].axes)
        np.testing.assert_allclose(lines[0], [[0, 0], [signal_dn, signal_dn / 2]])
        np.testing.assert_allclose(darks[0], [[0, 100], [seconds, 100 + 2 * seconds]])
        if transfer is not None:
            np.testing.assert_allclose(lines[1], points.T)
            np.testing.assert_allclose(darks[1], dark_points.T)
