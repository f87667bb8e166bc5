"""The virtual tracker's Bayer mosaic, as other programs read it, against quadrature that is not
the package's.
"""

from __future__ import annotations

import numpy as np
import pytest
import sep
from astropy.io import fits

from hilstar import load
from hilstar.attitude.wire.shown_frames import FrameHead, ShownFrame
from hilstar.basics.rotation import conjugate, from_radec_roll_deg, multiply, to_rotation_vector
from hilstar.instruments.campaign.display_tracker import DisplayTracker
from hilstar.instruments.campaign.solvers import given_image
from hilstar.instruments.simulate.live_exposure import TRACKING, LiveTracker
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.optics.layers.view import STILL, View
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.tracker.mosaic import in_pixels, luminance
from hilstar.tracker.settings import DetectorSettings
from tests.support.benches import ORION_Q, bench_text
from tests.support.claims import holds
from tests.support.commands import run_hilstar_here
from tests.support.spectra import bump, channel_keys, write_channels, write_panel
from tests.unit.server.bench.test_channels import NM, PASSBANDS, integrals

PATTERNS = ("rggb", "bggr", "grbg", "gbrg")
EXPOSURE_S, GAIN = 0.5, 4.0
# Every second pixel samples a star of sigma 1.6 px to exp(-2 pi^2 1.6^2 / 4) = 3e-6 of its light,
# and a circle of 12 px holds all of it. DN are rounded: half a DN in each of 113 pixels, mostly
# cancelled, of some 1e4 DN.
SIGMA_PX, RADIUS_PX = 1.6, 12.0
BRIGHTEST = 5


@pytest.fixture(scope="module")
def curves(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mosaic")
    write_channels(folder, NM, PASSBANDS)
    return folder


def mosaic_bench(curves, bayer, *changes):
    keys = channel_keys("rgb") | {"psf_sigma_px": [SIGMA_PX, SIGMA_PX], "exposure_s": EXPOSURE_S}
    keys |= {"resolution_px": [1024, 1024]}
    detector = {
        "bits": 16,
        "gain_e_per_dn": GAIN,
        "full_well_e": 1e9,
        **({} if bayer is None else {"bayer": bayer}),
    }
    sky = {"faintest_v_mag": 4.5, "spectrum": "blackbody"}
    path = curves / f"{bayer}.toml"
    path.write_text(
        bench_text({"tracker": keys, "tracker.detector": detector, "sky": sky}, *changes)
    )
    return path


@pytest.mark.gpu
@pytest.mark.parametrize("bayer", PATTERNS)
def test_planes_of_the_raw_mosaic_have_each_channels_electrons_of_a_quadrature(
    curves, tmp_path, bayer
):
    """Photometry of each plane by `sep`, found by the keywords that other programs read."""
    out = tmp_path / "raw.fits"
    run = run_hilstar_here(
        "simulate", mosaic_bench(curves, bayer), "--radec", "86,3,0", "--noise", "none", "-o", out
    )
    assert run.returncode == 0, run.stderr
    with fits.open(out) as (image, table):
        header, dn, truth = image.header, image.data.astype(np.float64), table.data
        assert (header["XBAYROFF"], header["YBAYROFF"], header["ROWORDER"]) == (0, 0, "TOP-DOWN")
        pattern, truth = header["BAYERPAT"].lower(), truth.copy()
    assert pattern == bayer
    inside = [row for row in truth if 20 < row["x_px"] < 1003 and 20 < row["y_px"] < 1003][
        :BRIGHTEST
    ]
    # Betelgeuse among blue stars
    assert len(inside) == BRIGHTEST and np.ptp([row["bv"] for row in inside]) > 1.5
    for star in inside:
        wanted = np.array(integrals(star["temperature_k"])) * 10 ** (-0.4 * star["v_mag"])
        np.testing.assert_allclose([star[f"electrons_{c}_per_s"] for c in "rgb"], wanted, rtol=1e-3)
        found = dict.fromkeys("rgb", 0.0)
        for place, colour in enumerate(pattern):
            down, right = divmod(place, 2)
            plane = np.ascontiguousarray(dn[down::2, right::2])
            at = (star["x_px"] - right) / 2, (star["y_px"] - down) / 2
            light, _, _ = sep.sum_circle(plane, [at[0]], [at[1]], RADIUS_PX / 2, subpix=0)
            found[colour] += 4 * GAIN * light[0] / EXPOSURE_S / pattern.count(colour)
        off = np.array(list(found.values())) / wanted - 1
        holds("mosaic-planes", 100 * np.abs(off).max())


@pytest.mark.gpu
def test_noise_comes_after_the_mosaic_and_zodiacal_light_has_each_channels_own(curves):
    sky = {
        "background": {"zodiacal_v_mag_arcsec2": 20.0},
        "tracker.detector": {"read_noise_e": 5.0},
    }
    with Simulator(read_bench_file(mosaic_bench(curves, "rggb", sky))) as simulator:
        view = simulator.view(np.array(ORION_Q), np.zeros(3))
        exposure = simulator.expose(view, np.random.default_rng(3))
        levels = [
            float(np.median(simulator.background_e[k // 2 :: 2, k % 2 :: 2])) for k in range(4)
        ]
        assert levels[1] == pytest.approx(levels[2], rel=1e-9)
        assert len({round(level, 6) for level in levels}) == 3
        for k, level in enumerate(levels):
            noise_dn = np.median(
                np.abs(
                    exposure.dn[k // 2 :: 2, k % 2 :: 2]
                    - np.median(exposure.dn[k // 2 :: 2, k % 2 :: 2])
                )
            )
            # a median of whole DN
            assert noise_dn * 1.4826 == pytest.approx(np.sqrt(level + 25.0) / GAIN, rel=0.35)
        given = given_image(exposure, simulator)
    assert given.dtype == np.uint16 and given.shape == exposure.dn.shape
    assert np.abs(given - luminance(exposure.dn)).max() <= 0.5


def before_display(curves, colour, **sky):
    power = [bump(625, 40, NM), bump(530, 45, NM), bump(460, 30, NM)]
    write_panel(curves / "oled.csv", power, NM)
    tracker = {
        "focal_length_mm": 25,
        "resolution_px": [400, 400],
        "transmission": None,
        "psf_sigma_px": [1.3, 1.3],
    }
    tables = {"tracker": tracker, "monitor.primaries": {"file": "oled.csv", "layout": "rgb-stripe"}}
    tables |= {
        "monitor": {"resolution_px": [640, 480], "bits": 10},
        "collimator": {"focal_length_mm": 120},
    }
    tables |= {"render": {"colour": colour, "quantisation": "exact", "brightest_v_mag": 0.0}}
    return read_bench_file(mosaic_bench(curves, "rggb", tables, {"sky": sky}))


SHOWN = 0.02  # asked for: 2 % at 95 % of stars, of which these are the brightest


@pytest.mark.gpu
@pytest.mark.parametrize("colour", ["star", "white"])
def test_a_mosaic_before_the_display_has_each_stars_own_channels_or_whites(curves, colour):
    display = DisplayTracker(before_display(curves, colour))
    exposure = display.expose(display_view(86.0, 3.0), None)
    display.close()
    off = []
    for star in exposure.truth[:4]:
        x, y = round(star["x_px"]), round(star["y_px"])
        rows, columns = np.mgrid[y - 6 : y + 7, x - 6 : x + 7]
        found = [exposure.mean_e[rows, columns][wanted(rows, columns)].sum() for wanted in PLANES]
        off.append(
            np.array(found) * [4, 2, 4] / EXPOSURE_S / [star[f"electrons_{c}_per_s"] for c in "rgb"]
            - 1
        )
    assert (np.abs(off).max() < SHOWN) == (colour == "star")
    assert np.abs(off).max() < SHOWN or np.abs(off).max() > 0.2  # Betelgeuse in white


@pytest.mark.gpu
def test_the_live_tracker_before_a_coloured_display_finds_its_attitude_in_superpixels(curves):
    file = before_display(curves, "star", faintest_v_mag=5.5)
    with load(file.path) as bench, LiveTracker(file, np.random.default_rng(1)) as tracker:
        q = from_radec_roll_deg(86.0, 3.0, 0.0)
        codes = bench.frame(q).codes.reshape(-1, 3)
        lit = np.flatnonzero(codes.any(axis=1)).astype(np.uint32)
        for number, lit_ns in enumerate((0, 10**9)):
            tracker.take(
                ShownFrame(FrameHead(number, lit_ns, 640, 480, 10, tuple(q), 3), lit, codes[lit])
            )
        exposed = tracker.frames.exposed(0, round(EXPOSURE_S * 1e9))
        solved = tracker.solve(exposed, tracker.expose(exposed))
    assert solved.mode == TRACKING and len(solved.identified.star) >= 8
    off = to_rotation_vector(multiply(solved.identified.q_icrs_to_cam, conjugate(q)))
    assert np.linalg.norm(off[:2]) < 0.1 * 13e-3 / 25  # a tenth of a pixel


PLANES = (
    lambda y, x: (y % 2 == 0) & (x % 2 == 0),
    lambda y, x: y % 2 != x % 2,
    lambda y, x: (y % 2 == 1) & (x % 2 == 1),
)


def display_view(ra_deg, dec_deg):
    return View.exposure(from_radec_roll_deg(ra_deg, dec_deg, 0.0), STILL, EXPOSURE_S)


def test_a_superpixel_has_no_pattern_keeps_all_light_and_every_place():
    flat = in_pixels([np.full((8, 8), level) for level in (1.0, 2.0, 4.0)], "gbrg")
    np.testing.assert_allclose(luminance(flat), 2.25)
    point = np.zeros((9, 9))
    point[3, 5] = 16.0
    spread = luminance(point)
    y, x = np.indices(point.shape)
    assert (spread.sum(), (spread * x).sum() / 16, (spread * y).sum() / 16) == pytest.approx(
        (16, 5, 3)
    )


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        (
            {"tracker.detector": {"bayer": "rggb"}},
            'bayer = "rggb" has three colours of pixels, and [tracker] one',
        ),
        (
            {"tracker.detector": {"bayer": "rgbg"}},
            '[tracker.detector] bayer = "rgbg"; did you mean rggb?',
        ),
    ],
)
def test_a_mosaic_without_three_channels_is_refused_in_one_line(tmp_path, tables, words):
    path = tmp_path / "bench.toml"
    path.write_text(bench_text(tables))
    run = run_hilstar_here("simulate", path, "--radec", "84,-1,0", "-o", tmp_path / "x.fits")
    assert (run.returncode, run.stderr.count("\n")) == (2, 1)
    assert words in run.stderr


def test_three_channels_without_a_mosaic_are_added_up_with_a_line(curves, caplog):
    with Simulator(read_bench_file(mosaic_bench(curves, None))) as simulator:
        exposure = simulator.expose(simulator.view(np.array(ORION_Q), np.zeros(3)), None)
    assert "without a mosaic: each pixel adds them up" in caplog.text
    row = exposure.truth[0]
    assert row["electrons_r_per_s"] + row["electrons_g_per_s"] + row[
        "electrons_b_per_s"
    ] == pytest.approx(row["electrons_per_s"])


def test_a_detector_in_python_takes_the_same_patterns():
    assert (
        DetectorSettings(bayer="bggr").takes_superpixels
        and not DetectorSettings(bayer="bggr", solver_image="mosaic").takes_superpixels
    )
