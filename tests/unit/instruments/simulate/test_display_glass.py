"""A display that brings the tracker's PSF: its stars on a bare detector against the virtual
tracker's own exact image.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.display.quantise import shown_light
from hilstar.display.render.numpy_backend import NumpyBackend
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.instruments.simulate.optics import TwinOptics
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.optics.glass.glass_psf import GlassPsf, regridded
from hilstar.optics.glass.psf_file import glass_of, write_glass
from hilstar.optics.psf import GaussianPsf, SampledPsf
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.cameras import (
    before_detector,
    bench_camera,
    display_psfs,
    tracker_camera,
    tracker_psf,
)
from hilstar.server.bench.frame import drawn_line
from hilstar.server.bench.least_psf import candidates, least_psf, psf_errors
from tests.support.benches import ORION_Q, bench_text
from tests.support.commands import run_hilstar_here
from tests.support.glass import SIDE_PX, moments, stack
from tests.support.psfs import coma, sampled

TRACKER = {
    "resolution_px": [SIDE_PX, SIDE_PX],
    "focal_length_mm": 12,
    "exposure_s": 0.2,
    "transmission": None,
}
SMALL = {"points": 3, "wavelengths_nm": (450.0, 750.0)}
# Monitor pixels to a tracker pixel, and a relay's blur, without which both grids beat: 0.01 px in a
# star's place.
SCALE, RELAY_PX = 2.3, 0.8
# measured 9e-7, 8e-5 px; the monitor's pixel counts twice: drawn, and lit
FLUX, CENTROID_PX, WIDENED = 1e-5, 3e-4, 0.03
CODES_PX = 0.01  # `exact` on 12 bits: measured 0.0034


@pytest.fixture
def relay_file(tmp_path):
    def make(*changes, scale=SCALE, relay_px=0.0, glass=None, **render):
        write_glass(tmp_path / "psf.fits", glass or glass_of(stack(**SMALL)))
        tables = {
            "tracker": TRACKER,
            "tracker.optics": {"psf": "psf.fits"},
            "sky": {"spectrum": "blackbody", "faintest_v_mag": 5},
            "monitor": {"resolution_px": [int(260 * scale)] * 2, "bits": 12},
            "collimator": {"focal_length_mm": 12 * scale * 57.65 / 13, "psf_sigma_px": relay_px},
            "render": {"psf": "tracker", "quantisation": "exact", "brightest_v_mag": 0, **render},
        }
        (tmp_path / "bench.toml").write_text(bench_text(tables, *changes))
        return read_bench_file(tmp_path / "bench.toml")

    return make


def test_a_bare_detector_sees_what_the_tracker_would_all_over_the_field(relay_file):
    # a star alone in each ninth of the field
    file, q = relay_file(relay_px=RELAY_PX), from_radec_roll_deg(90.2, 22.3, 56)
    camera = tracker_camera(file.config.tracker, file.folder)
    with Simulator(file) as simulator:
        exposure = simulator.expose(simulator.view(q, np.zeros(3)), None)
        table, glass = exposure.truth, simulator.glass
        shares = glass.shares_of(simulator.stars, table["hip"])
        exact = glass.psf.stamps_at(table["x_px"], table["y_px"], shares, np.ones(len(table)))
    with (
        open_bench(file) as shown,
        TwinOptics(BenchGeometry(shown.camera, camera), shown.tracker_psf) as optics,
    ):
        assert isinstance(shown.psf, GlassPsf)
        assert (
            "each star by its place and spectrum; exact; one PSF for all stars would be"
            in drawn_line(shown)
        )
        frame = shown.frame(q)
        lit = [frame.linear.astype(np.float64), shown_light(frame.levels, shown.panel)]
        images = [optics.image_e_per_s(light) * TRACKER["exposure_s"] for light in lit]
    assert not frame.truth["clipped"].any()
    zones = set()
    for row, stamp in zip(table, exact, strict=True):
        line, column = round(row["y_px"]), round(row["x_px"])
        parts = [
            image[max(line - 8, 0) : line + 9, max(column - 8, 0) : column + 9] for image in images
        ]
        alone = (np.hypot(table["x_px"] - row["x_px"], table["y_px"] - row["y_px"]) < 22).sum() == 1
        if not alone or parts[0].shape != (17, 17):
            continue
        wanted, linear, codes = (moments(part) for part in (stamp, *parts))
        light = row["electrons_per_s"] * TRACKER["exposure_s"] * row["relative_illumination"]
        true_px = row["x_centroid_px"] - column, row["y_centroid_px"] - line
        assert linear[0] == pytest.approx(light, rel=FLUX)
        assert linear[1:3] == pytest.approx(true_px, abs=CENTROID_PX)
        assert linear[3:] - wanted[3:] == pytest.approx(
            (1 / 6 + RELAY_PX**2) / SCALE**2, rel=WIDENED
        )
        assert codes[1:3] == pytest.approx(true_px, abs=CODES_PX)
        zones.add((3 * line // SIDE_PX, 3 * column // SIDE_PX))
    assert len(zones) == 9


def test_points_beyond_a_lens_are_left_out(relay_file, tmp_path):
    (tmp_path / "flight.toml").write_text("k1 = -0.1\n")
    glass = glass_of(stack(**SMALL))
    far = replace(glass, places_px=glass.places_px * [30.0, 1.0])
    with open_bench(relay_file({"tracker": {"distortion": "flight.toml"}}, glass=far)) as shown:
        assert 0 < len(shown.psf.field.places_px) < len(glass.places_px)


def test_what_white_lacks_of_a_disc_is_known_beside_stars(relay_file):
    sky = {"sky": {"epoch_utc": "2008-09-20T13:16:00Z"}, "sky.bodies": {"sun": True}}
    with open_bench(relay_file(sky, scale=1.0)) as shown:
        frame = shown.frame(from_radec_roll_deg(178.0, 0.9, 0.0))
        assert len(frame.truth) > 1
        assert shown.losses_mag(frame)["Sun"] > 15


def test_both_backends_show_the_same_levels_by_place(relay_file):
    for quantisation in ("round", "exact"):
        with open_bench(relay_file(scale=1.0, quantisation=quantisation)) as shown:
            sprites = shown.light(shown.view(np.array(ORION_Q)))
            oracle = NumpyBackend(shown.renderer.target)
            oracle.draw(sprites)
            shown.renderer.draw(sprites)
            off = shown.renderer.levels().astype(int) - oracle.levels()
            # float32 of light beside a threshold
            assert np.abs(off).max() <= 1 and np.count_nonzero(off) < 10, quantisation
            assert np.allclose(shown.renderer.linear(), oracle.linear(), rtol=1e-6, atol=1e-3)
            by_mean = replace(sprites, spectra=None)
            oracle.draw(by_mean)
            assert not np.array_equal(shown.renderer.levels(), oracle.levels())


def test_a_gaussian_and_one_image_are_scaled_to_the_display(relay_file, tmp_path):
    file = relay_file(
        {"tracker": {"psf_sigma_px": [0.5, 0.7]}, "tracker.optics": {"psf": "gaussian"}}
    )
    with open_bench(file) as shown:
        assert shown.psf.width_px == pytest.approx((0.5 * SCALE, 0.7 * SCALE))
        assert shown.tracker_psf.width_px[0] < 0.01
        blur = before_detector(
            relay_file(relay_px=0.8, psf="gaussian").config, tmp_path, shown.camera
        ).width_px
        own = tracker_psf(relay_file().config.tracker, tmp_path).width_px
    assert np.square(blur) - np.square(own) == pytest.approx((0.8 / SCALE) ** 2, rel=0.05)
    samples, per_px = regridded(
        sampled(coma(), 4, 7)[None] / 16, 4, np.array([[0.0, -SCALE], [SCALE, 0.0]])
    )
    assert samples.sum() == pytest.approx(1, abs=1e-3)
    turned, own = SampledPsf(samples[0], per_px), SampledPsf(sampled(coma(), 4, 7), 4)
    assert turned.width_px == pytest.approx(
        [SCALE * side for side in own.width_px[::-1]], rel=0.06
    )  # the pixel is half as wide


def test_the_least_that_the_tolerance_allows_is_drawn(relay_file):
    """A glass that is nearly the same everywhere takes one PSF, and with more tolerance a
    Gaussian, and says so.
    """
    even = stack(3, wavelengths_nm=(600.0,))
    even = replace(
        even, images=np.tile(even.images[4], (9, 1, 1)), facts=np.tile([1.0, 0, 0, 0], (9, 1))
    )
    file = relay_file(glass=glass_of(even))
    with open_bench(file) as shown:
        assert type(shown.psf) is SampledPsf and "one PSF for all stars" in drawn_line(shown)
        camera = shown.camera
    asked = relay_file(glass=glass_of(even), effort="auto", tolerance_mag=0.2, tolerance_px=0.1)
    psf, choice = next(display_psfs(asked.config, asked.folder, camera))
    assert isinstance(psf, GaussianPsf) and choice.note == "more would gain no more than that"


def test_more_components_are_nearer_to_the_whole(relay_file):
    psf = tracker_psf(relay_file().config.tracker, relay_file().folder)
    places = np.stack(np.meshgrid(*[np.linspace(10, SIDE_PX - 11, 4)] * 2), axis=-1).reshape(-1, 2)
    errors = {name: psf_errors(psf, make(), places) for name, make in candidates(psf)}
    px = [found.px for found in errors.values()]
    assert list(errors) == [
        *(
            "a Gaussian",
            "one PSF for all stars",
            "Gaussians by field",
            "a basis of 3",
            "a basis of 6",
            "a basis of 12",
        ),
        "each star by its place and spectrum",
    ]
    assert px[2] < px[0] and px[3] > px[4] > px[5] > px[6] == 0
    found, choice = least_psf(psf, places, (errors["a basis of 6"].mag, errors["a basis of 6"].px))
    assert len(found.optics.basis) == 6 and "a basis of 3 would be" in choice.note


def test_the_virtual_tracker_takes_the_least_too(relay_file, caplog):
    tables = {"tracker": {"effort": "auto", "tolerance_mag": 0.02, "tolerance_px": 0.05}}
    file = relay_file(tables)
    found = tracker_psf(file.config.tracker, file.folder)
    assert 3 <= len(found.optics.basis) <= 12 and "[tracker] effort: PSF: a basis of" in caplog.text
    assert "a Gaussian would be" in caplog.text
    loose = relay_file(
        {"tracker": {"effort": "auto", "tolerance_mag": 2, "tolerance_px": 2}}
    ).config.tracker
    assert isinstance(tracker_psf(loose, file.folder), GaussianPsf)
    assert "a Gaussian" in caplog.text and "more would gain no more than that" in caplog.text


def test_what_cannot_be_drawn_is_refused(relay_file, tmp_path):
    relay_file(glass=glass_of(stack(**SMALL, integrated=True)))
    result = run_hilstar_here(
        "frame", tmp_path / "bench.toml", "--radec", "84,-1,0", "-o", tmp_path / "x.fits"
    )
    # what the file does not cover is said once a process: perhaps by an earlier test
    *said, refusal = result.stderr.splitlines()
    assert result.returncode == 2 and all("of the light is" in line for line in said)
    assert (
        '[render] psf = "tracker", with psf.fits: it has the tracker\'s pixel in it (PIXINT)'
        in refusal
    )


@pytest.mark.parametrize("sine", [0.6, -0.6])
def test_an_oval_gaussian_that_lies_obliquely_is_refused_whichever_way_it_leans(relay_file, sine):
    wide = relay_file(
        {"tracker": {"psf_sigma_px": [0.5, 1.5]}, "tracker.optics": {"psf": "gaussian"}}
    )
    camera = bench_camera(wide.config, wide.folder)
    turn = np.array([[0.8, -sine, 0], [sine, 0.8, 0], [0, 0, 1]])
    camera = replace(camera, cam_to_image=turn)
    with pytest.raises(InputError, match="oval and lies obliquely"):
        next(display_psfs(wide.config, wide.folder, camera))
