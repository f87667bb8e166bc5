"""The noise of a star and its bounds: against closed form, a maximum-likelihood fit, and
simulated exposures.
"""

from __future__ import annotations

import itertools
import json
import math

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import to_matrix
from hilstar.instruments.simulate import noise
from hilstar.instruments.simulate.noise import (
    NoiseBudget,
    NoisyStar,
    Table,
    _until_unseen,
    between,
    measured_px,
    nea_arcsec,
    noise_lines,
    noisy_star,
    turns_of,
)
from hilstar.optics.camera import Camera
from hilstar.optics.psf import GaussianPsf, SampledPsf
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.cameras import tracker_camera
from hilstar.server.bench.star_light import bench_stars
from hilstar.tracker.centroids import CentroidSettings, find_stars
from hilstar.tracker.detector import Detector
from hilstar.tracker.mosaic import in_pixels, luminance
from hilstar.tracker.settings import DetectorSettings
from tests.support.bench_files import filed_bench
from tests.support.benches import ORION_Q, bench_text
from tests.support.claims import holds
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.figures import assert_legible
from tests.support.psfs import coma, sampled
from tests.support.psfs import gaussian as gaussian_light
from tests.support.spectra import bump, write_channels
from tests.support.tables import csv_rows

QUIET = DetectorSettings(gain_e_per_dn=0.3, full_well_e=1e6, bits=16)  # rounding: 0.0075 e-^2
NOISY = DetectorSettings(
    gain_e_per_dn=1.0,
    bits=16,
    offset_dn=200.0,
    read_noise_e=8.0,
    dark_e_per_s=60.0,
    dsnu_e_per_s=6.0,
    prnu=0.01,
)
# A Gaussian integrated over pixels is nearly one of variance sigma^2 + 1/12 (a square is no
# Gaussian): 1e-3 at 2 px and more.
CLOSED_FORM = 2e-3
STARS = 1600
ERROR = 1 / math.sqrt(2 * 2 * STARS)  # of an rms of x and y of so many stars


def one(
    star: NoisyStar, star_e: float, sky_e: float = 0.0, finder: CentroidSettings | None = None
) -> Table:
    return star.noise(np.array([star_e]), np.array([sky_e]), finder or CentroidSettings())


def gaussian(sigma_px: float, detector: DetectorSettings = QUIET, phases: int = 6) -> NoisyStar:
    return NoisyStar(GaussianPsf((sigma_px, sigma_px)), detector, 1.0, phases)


@pytest.mark.parametrize("sigma_px", [2.0, 3.0])
def test_the_photons_limit_is_sigma_over_the_root_of_their_number(sigma_px):
    found = one(gaussian(sigma_px), 5e5)
    wide = math.sqrt(sigma_px**2 + 1 / 12)
    holds("noise-bound", 100 * abs(found["bound_px"][0] / (wide / math.sqrt(5e5)) - 1))
    assert found["shot_e"][0] == pytest.approx(math.sqrt(5e5), rel=CLOSED_FORM)
    assert found["bound_flux_e"][0] == pytest.approx(math.sqrt(5e5), rel=CLOSED_FORM)


@pytest.mark.parametrize("sigma_px", [2.0, 3.0])
def test_the_background_s_limit_is_that_of_a_gaussian_in_even_noise(sigma_px):
    # Winick 1986: var x = 8 pi sigma^4 V / N^2; var N = 4 pi sigma^2 V, the noise-equivalent area
    # of King 1983.
    found = one(gaussian(sigma_px), 100.0, 10_000.0)
    wide2, variance = sigma_px**2 + 1 / 12, 10_000 + 0.3**2 / 12
    bound_px = math.sqrt(8 * math.pi * variance) * wide2 / 100
    holds("noise-bound", 100 * abs(found["bound_px"][0] / bound_px - 1))
    assert found["total_e"][0] == pytest.approx(
        math.sqrt(4 * math.pi * wide2 * variance), rel=CLOSED_FORM
    )
    assert found["effective_px"][0] == pytest.approx(4 * math.pi * wide2, rel=CLOSED_FORM)


def test_the_sources_add_up_to_the_total_each_as_table_4_1_has_it():
    star = gaussian(0.85, NOISY)
    found = one(star, 3000.0, 40.0)
    pixels = found["effective_px"]
    for name, e2 in (
        ("background_e", 40),
        ("dark_e", 60),
        ("read_e", 64),
        ("quantisation_e", 1 / 12),
        ("dsnu_e", 36),
    ):
        np.testing.assert_allclose(found[name], np.sqrt(pixels * e2), rtol=1e-12)
    # Shot noise is between that of all photons and, under the weights of even noise, sqrt(4/3) as
    # much.
    assert math.sqrt(3000) < found["shot_e"][0] < math.sqrt(4 / 3 * 3000)
    names = ("shot", "background", "dark", "read", "reset", "quantisation", "prnu", "dsnu")
    np.testing.assert_allclose(
        sum(found[f"{name}_e"] ** 2 for name in names), found["total_e"] ** 2, rtol=1e-12
    )
    np.testing.assert_allclose(found["snr"], 3000 / found["total_e"])
    assert (
        found["total_e"][0]
        <= found["bound_flux_e"][0] * (1 + 1e-12)
        <= found["bound_flux_sky_e"][0]
    )


def star_frames(
    star: NoisyStar, star_e: float, sky_e: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Frames [e-] of single stars (n, side, side) through the detector, and their places (2, n)
    from the middle.
    """
    count, side = math.isqrt(STARS), star.side_px
    place = rng.uniform(-0.5, 0.5, (2, STARS))
    tiles = (star_e * star.stamps(*place) + sky_e).reshape(count, count, side, side).swapaxes(1, 2)
    image = tiles.reshape(count * side, count * side)
    dn = Detector(star.detector, image.shape[::-1]).expose(image, 1.0, rng)
    seen = (dn - star.detector.offset_dn) * star.detector.gain_e_per_dn - star.detector.dark_e_per_s
    return seen.reshape(count, side, count, side).swapaxes(1, 2).reshape(-1, side, side), place


def most_likely(
    star: NoisyStar, seen: FloatArray, start: FloatArray, star_e: float, sky_e: float
) -> FloatArray:
    """Places (2, n) by Fisher's scoring for x, y and flux, from the true place: the fit that the
    bound is of.
    """
    x, y, flux, step = *start.copy(), np.full(len(seen), star_e), 1e-3
    for _ in range(12):
        shares = star.stamps(x, y)
        by_x = (star.stamps(x + step, y) - star.stamps(x - step, y)) / (2 * step)
        by_y = (star.stamps(x, y + step) - star.stamps(x, y - step)) / (2 * step)
        size = flux[:, None, None]
        slopes = np.stack([size * by_x, size * by_y, shares]).reshape(3, len(seen), -1)
        light = (size * shares + sky_e).reshape(len(seen), -1)
        weight = 1 / star.detector.noise(light, 1.0).total_e2
        information = np.einsum("ins,jns,ns->nij", slopes, slopes, weight)
        left = np.einsum("ins,ns->ni", slopes, weight * (seen.reshape(len(seen), -1) - light))
        dx, dy, more = np.linalg.solve(information, left[..., None])[..., 0].T
        x, y = (np.clip(one + np.clip(by, -0.3, 0.3), -2, 2) for one, by in ((x, dx), (y, dy)))
        flux = np.maximum(flux + more, star_e / 10)
    return np.stack([x, y])


def beyond_bound(
    sigma_px: float, star_e: float, detector: DetectorSettings = NOISY, sky_e: float = 20.0
) -> float:
    """The rms of most likely places over the bound."""
    star = gaussian(sigma_px, detector, 16)
    seen, place = star_frames(star, star_e, sky_e, np.random.default_rng(5))
    off = most_likely(star, seen, place, star_e, sky_e) - place
    return float(np.sqrt(np.mean(off**2)) / one(star, star_e, sky_e)["bound_px"][0])


@pytest.mark.parametrize(
    ("sigma_px", "star_e"), [(0.5, 2000.0), (0.55, 20_000.0), (0.85, 4000.0), (1.2, 20_000.0)]
)
def test_the_most_likely_place_reaches_the_bound_and_nothing_beats_it(sigma_px, star_e):
    ratio = beyond_bound(sigma_px, star_e)
    assert ratio > 1 - 4 * ERROR
    holds("noise-likelihood", 100 * (ratio - 1))


def test_where_a_star_is_one_pixel_wide_at_low_signal_the_bound_is_no_bound():
    # Its share of the middle pixel hardly changes with the place, and a fit that cannot leave the
    # pixel does better.
    assert beyond_bound(0.25, 150.0) < 0.9
    assert beyond_bound(0.85, 150.0) > 1.15  # SNR 3.3: the fit wanders


def test_the_variance_alone_tells_what_counts_do_but_for_single_electrons():
    """Exact information of a Poisson count with normal read noise, times its variance: 1 where
    the variance is all.
    """

    def ratio(mean_e: float, read_e: float) -> float:
        from scipy.stats import norm, poisson

        count = np.arange(int(mean_e + 12 * math.sqrt(mean_e) + 30))
        seen = np.arange(-8 * read_e, count[-1] + 8 * read_e, read_e / 12)
        share = norm.pdf(seen[:, None] - count, scale=read_e) @ np.stack(
            [poisson.pmf(count, mean_e), poisson.pmf(count, mean_e) * (count / mean_e - 1)], axis=-1
        )
        kept = share[:, 0] > 1e-300
        return float(
            (share[kept, 1] ** 2 / share[kept, 0]).sum() * read_e / 12 * (mean_e + read_e**2)
        )

    assert all(
        1 - 1e-6 < ratio(mean_e, read_e) < 1.025
        for mean_e, read_e in ((3, 0.3), (3, 2), (0.1, 5), (30, 1))
    )
    assert ratio(0.1, 0.3) > 1.5


def test_a_star_whose_pixels_all_clip_has_no_bound_and_one_that_clips_in_part_has_that_of_the_rest():
    star = gaussian(0.55, replace(QUIET, full_well_e=1e4))
    part, whole = one(star, 2e5), one(star, 1e28)
    narrow = gaussian(0.05, replace(QUIET, full_well_e=1e4)).noise(
        10.0 ** np.arange(9), np.zeros(9), CentroidSettings()
    )
    assert not (narrow["bound_px"] < 1e3).any()
    assert 0 < part["clipped_px"][0] < 9 < whole["clipped_px"][0]
    assert (
        np.isnan([whole["total_e"], whole["snr"], whole["bound_px"]]).all()
        and whole["detection"][0] == 1
    )
    assert (
        part["bound_px"][0]
        > 1.3 * one(gaussian(0.55, replace(QUIET, gain_e_per_dn=9.0)), 2e5)["bound_px"][0]
    )


def test_a_pixel_clips_by_its_dark_charge_and_its_star():
    """Of a well of 1e4 e- 6000 e- of dark leave 4000."""
    dark = replace(QUIET, full_well_e=1e4, dark_e_per_s=6000.0)
    for star_e, clipped in ((0.95 * 4000, 0.0), (1.05 * 4000, 1.0)):
        assert one(gaussian(0.02, dark, phases=1), star_e)["clipped_px"] == clipped


@pytest.mark.parametrize("minimum_pixels", [1, 2, 3])
def test_a_star_is_found_where_so_many_of_its_pixels_are_above_the_threshold(minimum_pixels):
    """By all outcomes of four pixels, the mean over two places."""
    above = np.array([[[0.9, 0.5, 0.2, 0.0], [0.3, 0.3, 0.8, 1.0]]])
    shares = []
    for place in above[0]:
        outcomes = np.array(list(itertools.product((0, 1), repeat=4)))
        chances = np.prod(np.where(outcomes, place, 1 - place), axis=1)
        shares.append(chances[outcomes.sum(axis=1) >= minimum_pixels].sum())
    assert noise.found_share(above, minimum_pixels) == pytest.approx([np.mean(shares)])


TILE_PX, TILES = 40, 30
SAMPLED = 5e-3  # the table of a sampled PSF is linear between its steps
SHARE_ERROR = 4 * 0.5 / TILES  # of a share of TILES^2 stars, to four of its sigmas


@pytest.mark.parametrize(
    ("sigma_px", "gain_e_per_dn", "pixels"), [(0.55, 24.0, 1), (0.85, 1.0, 1), (0.85, 24.0, 3)]
)
def test_the_tracker_finds_as_many_simulated_stars_as_the_threshold_s_model_says(
    sigma_px, gain_e_per_dn, pixels
):
    star = gaussian(sigma_px, replace(NOISY, gain_e_per_dn=gain_e_per_dn))
    finder = CentroidSettings(minimum_pixels=pixels)
    offered = np.geomspace(50.0, 5000.0, 200)
    chances = star.noise(offered, np.full(200, 20.0), finder)["detection"]
    rng = np.random.default_rng(1)
    for wanted in (0.25, 0.8):
        star_e = float(np.interp(wanted, chances, offered))
        place = rng.uniform(-0.5, 0.5, (2, TILES**2))
        image = np.full((TILES, TILE_PX, TILES, TILE_PX), 20.0)
        stamps = (star_e * star.stamps(*place)).reshape(TILES, TILES, star.side_px, star.side_px)
        image[:, : star.side_px, :, : star.side_px] += stamps.swapaxes(1, 2)
        image = image.reshape(TILES * TILE_PX, -1)
        found = find_stars(Detector(star.detector, image.shape).expose(image, 1.0, rng), finder)
        assert len(found) / TILES**2 == pytest.approx(wanted, abs=SHARE_ERROR)


@pytest.mark.parametrize(("rows", "last"), [([1.0, 0.4, 0.011], 0.009), ([1.0, 0.4], 0.0099)])
def test_a_table_of_magnitudes_ends_with_the_first_row_of_under_a_percent(rows, last):
    """Four stars stand between two rows."""
    detection = np.concatenate([np.repeat(rows, 5), np.full(11, last)])
    assert detection[_until_unseen(detection)].tolist() == [*rows, last]


def test_stars_between_rows_have_the_bounds_of_their_own():
    star = gaussian(0.85, NOISY)
    grid = np.geomspace(1e6, 200.0, 94)  # a tenth of a magnitude apart
    off = np.sqrt(grid[:-1] * grid[1:])
    coarse, exact = (
        star.noise(one, np.full(len(one), 20.0), CentroidSettings()) for one in (grid, off)
    )
    # half way by magnitude: a bound by its logarithm, a probability as it is
    rows = np.zeros(2, noise.NOISE_DTYPE)
    rows["star_e"], rows["detection"] = (1e4, 1e2), (1.0, 0.2)
    rows["bound_x_px"], rows["bound_y_px"] = (0.01, 0.1), (0.02, 0.08)
    middle = between(rows, np.array([1e3]))
    np.testing.assert_allclose(middle[:, 0], [math.sqrt(0.001), 0.04, 0.6])
    x, _, seen = between(coarse, off)
    fine = exact["clipped_px"] == 0  # the bound steps by some per cent where a pixel begins to clip
    np.testing.assert_allclose(x[fine], exact["bound_x_px"][fine], rtol=2e-3)
    np.testing.assert_allclose(x, exact["bound_x_px"], rtol=0.15)
    np.testing.assert_allclose(seen, exact["detection"], atol=0.03)


def test_a_sampled_psf_has_the_bounds_of_the_gaussian_that_it_samples():
    sampled_psf = SampledPsf(sampled(gaussian_light(0.8, 0.6), 4, 8), per_px=4)
    closed, fine = (NoisyStar(psf, NOISY, 1.0) for psf in (GaussianPsf((0.8, 0.6)), sampled_psf))
    for star_e in (300.0, 30_000.0):
        a, b = (one(star, star_e, 20.0) for star in (closed, fine))
        for name in ("bound_x_px", "bound_y_px", "bound_flux_e", "total_e", "detection"):
            np.testing.assert_allclose(a[name], b[name], rtol=SAMPLED)
        assert a["bound_y_px"] < a["bound_px"] < a["bound_x_px"]


def test_a_star_with_coma_is_found_beside_its_chief_ray_which_is_no_error_of_its_place():
    star = NoisyStar(SampledPsf(sampled(coma(0.6), 4, 8), per_px=4), NOISY, 1.0)
    found = measured_px(star, 10_000.0, 20.0, CentroidSettings(), np.random.default_rng(4))
    bound_px = one(star, 10_000.0, 20.0)["bound_px"][0]
    # the middle of its light is 0.45 px, forty bounds, off
    assert 0.9 * bound_px < found.min() < 2 * bound_px


def test_nea_is_the_scatter_of_attitudes_from_stars_off_by_their_bounds():
    """Against Wahba's problem (SciPy), star by star with its own weight."""
    camera = Camera((1024, 1024), 2000.0, (511.5, 511.5), np.eye(3))
    rng = np.random.default_rng(2)
    count, trials = 12, 1500
    place = rng.uniform(0, 1023, (2, count))
    sigma_px = rng.uniform(0.02, 0.2, count)
    rays = camera.rays(*place)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    turned = []
    for _ in range(trials):
        seen = camera.rays(*(place + sigma_px * rng.standard_normal((2, count))))
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        turned.append(Rotation.align_vectors(seen, rays, weights=sigma_px**-2)[0].as_rotvec())
    turns = turns_of(camera, *place)
    across, about = nea_arcsec(turns, np.stack([sigma_px] * 2), np.ones(count))
    x, y, z = 206264.806 * np.std(turned, axis=0)
    assert across[-1] == pytest.approx(
        math.hypot(x, y) / math.sqrt(2), rel=4 / math.sqrt(4 * trials)
    )
    assert about[-1] == pytest.approx(z, rel=4 / math.sqrt(2 * trials))
    # of stars that every second exposure has: half the information
    rare = nea_arcsec(turns, np.stack([sigma_px] * 2), np.full(count, 0.5))
    np.testing.assert_allclose(rare[:, 1:], math.sqrt(2) * np.stack([across, about])[:, 1:])
    lost = np.stack([np.where(np.arange(count) < 2, (np.nan, 1e6) * (count // 2), sigma_px)] * 2)
    # stars without a place are none
    assert np.isinf(nea_arcsec(turns, lost, np.ones(count))[:, :3]).all()
    twice = nea_arcsec(turns[[0, 0]], np.full((2, 2), 0.1), np.ones(2))
    assert np.isfinite(twice[:, 1]).all() and twice[1, 1] > 1000 * about[1]
    assert np.isinf([across[0], about[0]]).all() and (np.diff(across[1:]) < 0).all()


CONTRACT = [
    "v_mag",
    "shot_e",
    "background_e",
    "dark_e",
    "read_e",
    "reset_e",
    "quantisation_e",
    "prnu_e",
    "dsnu_e",
    "total_e",
    "snr",
    "detection",
    "bound_px",
]


@pytest.fixture
def noisy_file(tmp_path):
    path = tmp_path / "bench.toml"
    detector = {
        "read_noise_e": 12,
        "dark_e_per_s": 50,
        "dsnu_e_per_s": 5,
        "prnu": 0.01,
        "offset_dn": 20,
    }
    changes = {
        "tracker.detector": detector,
        "background": {"electrons_per_px": 30},
        "sky": {"faintest_v_mag": 6.5},
    }
    path.write_text(bench_text(changes))
    return path


def test_budget_noise_writes_a_row_for_each_magnitude_and_for_each_star_of_a_field(
    noisy_file, tmp_path, monkeypatch
):
    drawn = []
    monkeypatch.setattr("hilstar.basics.charts.save", lambda figure, path: drawn.append(figure))
    ran = run_hilstar_here(
        f"budget {noisy_file} --noise --radec 84.057,-1.2,0 -o {tmp_path}/out --json"
    )
    assert ran.returncode == 0, ran.stderr
    found = json.loads(ran.stdout)
    tables = {}
    for name in ("noise", "stars", "nea"):
        tables[name] = csv_rows(tmp_path / "out" / f"{name}.csv")
    assert list(tables["noise"][0])[: len(CONTRACT)] == CONTRACT
    assert list(tables["stars"][0])[:5] == ["hip", "name", "x_px", "y_px", "v_mag"]
    for name, rows in (("noise", found["rows"]), ("stars", found["stars"]), ("nea", found["nea"])):
        written = [
            [float(value or "nan") for key, value in row.items() if key != "name"]
            for row in tables[name]
        ]
        told = [
            [math.nan if v is None else v for key, v in row.items() if key != "name"]
            for row in rows
        ]
        np.testing.assert_allclose(written, told, rtol=1e-12)
    v_mag = [row["v_mag"] for row in found["rows"]]
    assert (
        v_mag == (v_mag[0] + 0.5 * np.arange(len(v_mag))).tolist()
        and found["stars"][0]["v_mag"] >= v_mag[0]
    )
    assert (
        found["rows"][0]["detection"] == 1
        and found["rows"][-1]["detection"] < 0.01 < found["rows"][-2]["detection"]
    )
    usual = [row for row in found["rows"] if row["clipped_px"] == 0 and row["snr"] > 30]
    assert len(usual) >= 4 and all(
        row[f"{kind}_px"] > 0.9 * row["bound_px"] for row in usual for kind in ("fit", "window")
    )
    limit = found["nea_arcsec"].pop("limit")
    assert all(
        one[way] > limit[way] for one in found["nea_arcsec"].values() for way in ("across", "about")
    )
    assert found["nea"][-1]["stars"] == len(found["stars"]) and found["fields"] == 1
    for figure in drawn:
        assert_legible(figure)
    assert len(drawn) == 1


def test_budget_noise_without_a_field_has_the_median_of_fields_all_over_the_sky(noisy_file):
    spoken = run_hilstar_here("budget", noisy_file, "--noise")
    assert (
        spoken.returncode == 0
        and "NEA, limit" in spoken.stdout
        and "1 px above 5 sigma" in spoken.stdout
    )
    assert spoken.stdout == run_hilstar_here("budget", noisy_file, "--noise").stdout


def test_a_mosaics_channels_have_their_own_noise_and_its_superpixels_find_what_they_do(tmp_path):
    """Information adds up: the squares of the channels' SNR are that of all. Shares are
    Gaussians' of width 0.55 px.
    """
    nm, peaks = np.arange(400.0, 721.0, 20.0), {"r": 620.0, "g": 540.0, "b": 460.0}
    curves = {name: bump(peak, 60, nm) for name, peak in peaks.items()}
    keys = write_channels(tmp_path, nm, curves)
    detector = {
        "bayer": "rggb",
        "read_noise_e": 9,
        "dark_e_per_s": 50,
        "offset_dn": 20,
        "gain_e_per_dn": 1.0,
    }
    changes = {
        "tracker": keys | {"psf_sigma_px": [1.0, 1.0]},
        "tracker.detector": detector,
        "background": {"electrons_per_px": 30},
    }
    (tmp_path / "bench.toml").write_text(bench_text(changes, {"sky": {"faintest_v_mag": 5.0}}))
    found = json.loads(
        run_hilstar_here(
            "budget", tmp_path / "bench.toml", "--noise", "--radec", "84,-1,0", "--json"
        ).stdout
    )
    assert any("SNR r   SNR g   SNR b" in line for line in noise_lines(NoiseBudget(**found)))
    assert sum(one["star_share"] for one in found["channels"].values()) == pytest.approx(1)
    assert {one["background_e_per_px"] for one in found["channels"].values()} == {30.0}
    for row in found["rows"][4:]:
        assert sum(row[f"snr_{name}"] ** 2 for name in peaks) == pytest.approx(
            row["snr"] ** 2, rel=0.02
        )
    row = next(one for one in found["rows"] if one["detection"] < 0.97)
    star = noisy_star(read_bench_file(tmp_path / "bench.toml"), np.full((4, 4), 30.0))
    place, side = np.random.default_rng(1).uniform(-0.5, 0.5, (2, TILES**2)), star.side_px
    image = np.zeros((TILES, TILE_PX + 1, TILES, TILE_PX + 1))
    image[:, :side, :, :side] = (
        (row["star_e"] * star.stamps(*place)).reshape(TILES, TILES, side, side).swapaxes(1, 2)
    )
    image = image.reshape(TILES * (TILE_PX + 1), -1)
    light = 30.0 + in_pixels(
        [image * one["star_share"] for one in found["channels"].values()], "rggb"
    )
    dn = Detector(star.detector, image.shape).expose(
        light, star.exposure_s, np.random.default_rng(2)
    )
    assert len(find_stars(luminance(dn), CentroidSettings())) / TILES**2 == pytest.approx(
        row["detection"], abs=0.1
    )


def test_a_field_without_stars_says_so(noisy_file, tmp_path):
    noisy_file.write_text(
        noisy_file.read_text().replace("faintest_v_mag = 6.5", "faintest_v_mag = 1.0")
    )
    ran = run_hilstar_here(
        "budget", noisy_file, "--noise", "--radec", "190,27,0", "-o", tmp_path / "out"
    )
    assert ran.returncode == 0 and "none: fewer than 2 stars with a place" in ran.stdout
    assert (tmp_path / "out" / "nea.csv").exists() and not (tmp_path / "out" / "nea.png").exists()


def test_what_budget_has_no_use_for_is_refused(noisy_file):
    assert_refused(
        run_hilstar_here("budget", noisy_file, "--radec", "84,-1,0"), 2, "--radec", "add --noise"
    )
    assert_refused(
        run_hilstar_here("budget", noisy_file, "--noise", "--centroider", "fit"),
        2,
        "leave out --centroider",
    )
    assert_refused(run_hilstar_here("budget", noisy_file, "--noise", "--radec", "84"), 2, "--radec")


def test_the_pixels_response_adds_noise_in_proportion_to_it_and_to_the_light():
    """A star in one pixel would have all of it; one over several has less."""
    found = []
    for prnu in (0.0, 0.0005, 0.001):
        detector = DetectorSettings(prnu=prnu, read_noise_e=20.0)
        star = NoisyStar(GaussianPsf((0.8, 0.8)), detector, 0.1, phases=2)
        found.append(star.noise(np.array([2e4]), np.zeros(1), CentroidSettings())["prnu_e"][0])
    assert found[0] == 0
    assert 0.2 * 0.001 * 2e4 < found[2] < 0.001 * 2e4
    assert found[2] == pytest.approx(2 * found[1], rel=0.01)


RGGB = DetectorSettings(gain_e_per_dn=1.0, bits=16, read_noise_e=5.0, bayer="rggb")
ALIKE = np.ones((2, 3))


def test_a_mosaic_whose_channels_are_alike_has_a_grey_detector_s_bounds():
    star = NoisyStar(GaussianPsf((0.9, 1.3)), RGGB, 1.0, 3, ALIKE)
    grey = NoisyStar(GaussianPsf((0.9, 1.3)), replace(RGGB, bayer=None), 1.0, 3)
    found, expected = one(star, 2000.0, 30.0), one(grey, 2000.0, 30.0)
    for name in ("total_e", "snr", "bound_x_px", "bound_y_px", "bound_flux_e", "effective_px"):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-9)


def test_each_pixel_of_a_mosaic_has_its_channel_s_share_for_a_star_on_any_of_its_four():
    """A star that is red alone before a sky that is blue alone: of four places one is red."""
    shares = np.array([[4.0, 0.0, 0.0], [0.0, 0.0, 4.0]])
    star = NoisyStar(GaussianPsf((0.9, 0.9)), RGGB, 1.0, 2, shares)
    side = star.side_px
    by_place = star.shares.reshape(4, 4, side, side)
    whole = star.stamps(*np.array([[-0.25, -0.25, 0.25, 0.25], [-0.25, 0.25, -0.25, 0.25]]))
    for number, (down, right) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        rows, columns = np.mgrid[down : down + side, right : right + side]
        is_red = (rows % 2 == 0) & (columns % 2 == 0)
        is_blue = (rows % 2 == 1) & (columns % 2 == 1)
        np.testing.assert_allclose(by_place[number], 4 * whole * is_red, atol=1e-12)
        sky = star._sky.reshape(4, -1, side, side)[number]
        assert (sky == 4.0 * is_blue).all()
    # over all places within four pixels a star keeps its light
    assert by_place.sum(axis=(2, 3)).mean() == pytest.approx(whole.sum(axis=(1, 2)).mean())


def test_superpixels_find_bright_stars_and_no_faint_ones():
    star = NoisyStar(GaussianPsf((0.9, 0.9)), RGGB, 1.0, 3, ALIKE)
    finder = CentroidSettings(5.0, 3)
    detection = [one(star, light_e, 30.0, finder)["detection"][0] for light_e in (1.0, 200.0, 1e5)]
    assert detection[0] < 1e-3
    assert detection[0] < detection[1] < detection[2]
    assert detection[2] == pytest.approx(1.0, abs=1e-6)


def test_a_field_s_budget_is_of_its_own_stars_in_the_light_behind_each(tmp_path, monkeypatch):
    """A tracker of 300 x 200 px on Orion's belt: every star of the field by a pinhole."""
    monkeypatch.setattr(noise, "TRIALS", 4)
    tracker = {"resolution_px": [300, 200], "focal_length_mm": 20, "transmission": None}
    changes = {"tracker": tracker, "sky": {"faintest_v_mag": 7.0}}
    file = filed_bench(tmp_path, changes, {"background": {"electrons_per_px": 50.0}})
    finder = CentroidSettings()
    found = noise.noise_budget(file, np.array(ORION_Q), finder, np.random.default_rng(1))
    stars = bench_stars(file.config, tmp_path)
    x, y, z = to_matrix(np.array(ORION_Q)) @ stars.vectors.T
    focal_px = 20e3 / 13
    ahead = np.where(z > 0, z, np.nan)
    x_px, y_px = 149.5 + focal_px * x / ahead, 99.5 + focal_px * y / ahead
    inside = (np.rint(x_px) >= 0) & (np.rint(x_px) < 300)
    inside &= (np.rint(y_px) >= 0) & (np.rint(y_px) < 200)
    assert found.stars is not None
    listed = {row["hip"]: row for row in found.stars}
    hips = stars.catalog.hip[stars.row]
    assert set(listed) == set(hips[inside].tolist())
    for star in np.flatnonzero(inside):
        row = listed[int(hips[star])]
        assert (row["x_px"], row["y_px"]) == pytest.approx((x_px[star], y_px[star]), abs=1e-3)
        assert row["v_mag"] == pytest.approx(stars.v_mag[star], abs=1e-3)
        electrons = stars.electrons_per_s[star] * file.config.tracker.exposure_s
        assert row["star_e"] == pytest.approx(electrons, rel=1e-5)
    assert found.background_e_per_px == pytest.approx(50.0)
    assert found.fields == 1
    assert found.found_stars == pytest.approx(sum(row["detection"] for row in found.stars))
    assert found.identified_share == 1.0
    assert found.nea_arcsec["limit"]["across"] == found.nea[-1]["limit_across_arcsec"]
    assert found.nea_arcsec["limit"]["about"] == found.nea[-1]["limit_about_arcsec"]
    assert len(found.nea) > 2
    field = noise.field_stars(
        stars, tracker_camera(file.config.tracker, tmp_path), np.array(ORION_Q)
    )
    assert len(field) == len(listed)
    assert (np.diff(field["v_mag"]) >= 0).all()
    # the same by all its stars, whatever attitude is asked for beside it
    away_q = np.roll(ORION_Q, 1)
    limits_arcsec = noise.attitude_limits_arcsec(file, np.array([away_q, ORION_Q]))
    assert limits_arcsec[1] == pytest.approx(list(found.nea_arcsec["limit"].values()), rel=1e-6)
    assert limits_arcsec[0] != pytest.approx(limits_arcsec[1], rel=0.01)
    # rows end with the first whose stars are hardly found
    assert found.rows[-1]["detection"] < noise.UNSEEN <= found.rows[-2]["detection"]
    # the magnitude of which half are found
    below = [row for row in found.rows if row["detection"] > 0.5]
    above = [row for row in found.rows if row["detection"] < 0.5]
    assert below[-1]["v_mag"] <= found.found_v_mag <= above[0]["v_mag"]
    assert found.rows[0]["v_mag"] <= stars.v_mag[inside].min() < found.rows[0]["v_mag"] + 1


def test_the_light_behind_a_star_is_that_of_the_pixel_whose_half_sides_hold_it():
    image = np.arange(20.0).reshape(4, 5)
    field = np.zeros(4, dtype=[("x_px", "f8"), ("y_px", "f8")])
    field["x_px"], field["y_px"] = [2.3, 2.7, -0.4, 4.4], [1.2, 0.8, 2.6, -0.3]
    assert noise._at_stars(image, field).tolist() == [7.0, 8.0, 15.0, 4.0]


def test_limits_by_magnitude_are_medians_of_fields_with_the_stars_up_to_each():
    """Of three fields, the last without a star; NEA falls with the stars."""
    fields = []
    for v_mag in ([3.1, 4.0, 4.6], [3.5, 3.75], []):
        rows = np.zeros(len(v_mag), dtype=[("v_mag", "f8")])
        rows["v_mag"] = v_mag
        fields.append(rows)
    who, ways = len(noise.WHO), 2
    scale = np.arange(1.0, who * ways + 1).reshape(who, ways, 1)
    curves = [scale * np.array(by_star) for by_star in ([np.inf, 9.0, 5.0], [np.inf, 4.0], [])]
    rows = noise._nea_rows(fields, curves, 4.6)
    assert [row["v_mag"] for row in rows] == [4.0, 4.25, 4.5, 4.6]
    # a star of just the limit is used; without two stars a field has no attitude
    assert [row["stars"] for row in rows] == [2.0, 2.0, 2.0, 2.0]
    for row, median in zip(rows, (9.0, 9.0, 9.0, 5.0), strict=True):
        for number, name in enumerate(noise.NEA_COLUMNS, start=1):
            assert row[name] == number * median
    # where no limit has an attitude one row says so
    (none,) = noise._nea_rows([fields[0][:1]], [curves[0][..., :1]], 4.6)
    assert (none["v_mag"], none["stars"], none["limit_about_arcsec"]) == (4.6, 1.0, np.inf)


def row_of(v_mag: float, factor: float, **changes: float) -> dict[str, float]:
    """A row of noise.csv in which no two figures are alike."""
    columns = [*noise.NOISE_COLUMNS, *(f"{kind}_px" for kind in noise.FAMILY)]
    row = {"v_mag": v_mag}
    for number, name in enumerate(columns, start=1):
        row[name] = factor * number
    return row | changes


def nea_of(v_mag: float, stars: float, factor: float) -> dict[str, float]:
    """A row of nea.csv in which no two figures are alike."""
    row = {"v_mag": v_mag, "stars": stars}
    for number, name in enumerate(noise.NEA_COLUMNS, start=1):
        row[name] = factor * number
    return row


def spoken_budget(**changes: object) -> NoiseBudget:
    """A budget of two magnitudes and channels, whose figures are all different."""
    nea = [nea_of(5.0, 3.0, math.inf), nea_of(5.5, 4.0, 2.0), nea_of(6.0, 7.0, 1.5)]
    plain: dict[str, object] = {
        "threshold_sigma": 4.5,
        "minimum_pixels": 3,
        "background_e_per_px": 31.25,
        "centroider": "fit",
        "fields": 9,
        "rows": [
            row_of(5.0, 1.0, snr_r=2.5, snr_g=3.5, snr_b=1.5),
            row_of(5.5, 0.5, snr_r=1.25, snr_g=1.75, snr_b=0.75, fit_px=math.nan),
        ],
        "stars": None,
        "nea": nea,
        "nea_arcsec": noise._by_way(nea[-1]),
        "channels": {
            "r": {"star_share": 0.25, "background_e_per_px": 40.0},
            "g": {"star_share": 0.5, "background_e_per_px": 30.0},
        },
        "found_v_mag": 6.25,
        "found_stars": 12.5,
        "identified_share": 0.95,
    }
    return NoiseBudget(**plain | changes)


def test_a_budget_of_noise_is_told_with_all_its_figures():
    budget = spoken_budget()
    lines = list(noise_lines(budget))
    assert lines[:3] == [
        "found                 3 px above 4.5 sigma of a background of 31.25 e- in a pixel",
        ("pixels of r           25.0% of a star of the Sun's colour, background 40 e-"),
        ("pixels of g           50.0% of a star of the Sun's colour, background 30 e-"),
    ]
    columns = noise.NEA_COLUMNS
    for kind, line in zip(noise.WHO, lines[3 : 3 + len(noise.WHO)], strict=True):
        across = 1.5 * (1 + columns.index(f"{kind}_across_arcsec"))
        about = 1.5 * (1 + columns.index(f"{kind}_about_arcsec"))
        name = f"NEA, {kind}"
        assert line == f"{name:22}{across:.3g} arcsec across, {about:.3g} about the boresight"
    empty, titles, first, second = lines[3 + len(noise.WHO) :]
    assert empty == ""
    assert " ".join(titles.split()) == (
        "V star e- noise e- SNR SNR r SNR g detection bound px fit px"
    )
    names = ["star_e", "total_e", "snr", "snr_r", "snr_g", "detection", "bound_px", "fit_px"]
    wanted = [budget.rows[0][name] for name in names]
    assert [float(word) for word in first.split()] == [5.0, *wanted]
    assert second.split()[-1] == "-"
    assert [float(word) for word in second.split()[:3]] == [5.5, wanted[0] / 2, wanted[1] / 2]
    assert len({len(titles), len(first), len(second)}) == 1


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "sensitive enough: "),
        ({"identified_share": 0.9499}, "not enough: "),
        ({}, "12.5 stars in a field (median of 9), 4 or more in 95% of fields"),
        ({"fields": 1}, "12.5 stars in the field, 4 or more in 95% of fields"),
        ({}, "half of the stars of V = 6.2 are found"),
    ],
)
def test_a_tracker_is_sensitive_enough_where_it_identifies_95_percent_of_fields(changes, words):
    assert words in noise.sensitivity_line(spoken_budget(**changes))


def test_what_is_not_finite_is_an_empty_cell_and_a_table_without_rows_no_file(
    tmp_path, monkeypatch
):
    drawn = []
    monkeypatch.setattr("hilstar.basics.charts.save", lambda figure, path: drawn.append(figure))
    budget = spoken_budget(fields=1)
    noise.write_noise(tmp_path, budget)
    for name, rows in (("noise", budget.rows), ("nea", budget.nea)):
        cells = csv_rows(tmp_path / f"{name}.csv")
        assert [list(row) for row in cells] == [list(row) for row in rows]
        for written, row in zip(cells, rows, strict=True):
            for key, value in row.items():
                assert written[key] == (str(value) if math.isfinite(value) else "")
    assert not (tmp_path / "stars.csv").exists()
    (figure,) = drawn
    by_magnitude, by_stars = figure.axes
    kinds = [(way, kind) for way in ("about", "across") for kind in ("fit", "limit")]
    for axes, key in ((by_magnitude, "v_mag"), (by_stars, "stars")):
        for (way, kind), line in zip(kinds, axes.lines, strict=False):
            assert list(line.get_xdata()) == [row[key] for row in budget.nea]
            wanted = [row[f"{kind}_{way}_arcsec"] for row in budget.nea]
            assert list(line.get_ydata()) == wanted
            assert line.get_linestyle() == ("--" if kind == "fit" else "-")
    texts = " ".join(text.get_text().replace("\n", " ") for text in figure.texts)
    finding = texts.replace("\N{NO-BREAK SPACE}", " ")
    assert "Stars to V = 6 allow 1.5 and 3 arcsec across and about the boresight" in finding
    assert "with all noise; the field." in texts
    infinite = {kind: {"across": math.inf, "about": math.inf} for kind in noise.WHO}
    noise.write_noise(tmp_path, spoken_budget(nea_arcsec=infinite))
    assert len(drawn) == 1
    name = "NEA, limit"
    wanted_line = f"{name:22}none: fewer than 2 stars with a place"
    assert wanted_line in list(noise_lines(spoken_budget(nea_arcsec=infinite)))


def test_a_mosaic_s_star_has_the_light_of_its_own_channels_before_each_colour_s_sky(tmp_path):
    nm = np.arange(400.0, 721.0, 20.0)
    curves = {"r": bump(620.0, 60, nm), "g": bump(540.0, 60, nm), "b": 0.5 * bump(460.0, 60, nm)}
    keys = write_channels(tmp_path, nm, curves)
    file = filed_bench(tmp_path, {"tracker": keys, "tracker.detector": {"bayer": "grbg"}})
    sky_e = np.tile([[20.0, 50.0], [5.0, 24.0]], (4, 6))
    whole = noisy_star(file, sky_e)
    star, sky = whole.mosaic
    assert star.sum() == pytest.approx(1.0)
    assert 0 < star[2] < star[0] < 1 and star[2] < star[1]
    # red 50, green the mean of 20 and 24, blue 5, over the mean of all four
    assert sky == pytest.approx(np.array([50.0, 22.0, 5.0]) / 24.75)
    for number in range(3):
        alone = noisy_star(file, sky_e, number).mosaic
        wanted = np.zeros(3)
        wanted[number] = star[number]
        np.testing.assert_allclose(alone, [wanted, sky])
    dark = noisy_star(file, np.zeros((4, 4))).mosaic
    assert dark[1].tolist() == [0.0, 0.0, 0.0]


def test_each_channel_of_a_mosaic_has_its_own_light_sky_and_noise(tmp_path):
    """Red 50, green the mean of 20 and 24, blue 5, of a mean of 24.75; the squares of the channels'
    S/N add up to that of the whole.
    """
    nm = np.arange(400.0, 721.0, 20.0)
    curves = {"r": bump(620.0, 60, nm), "g": bump(540.0, 60, nm), "b": 0.5 * bump(460.0, 60, nm)}
    keys = write_channels(tmp_path, nm, curves)
    changes = {"tracker": keys, "tracker.detector": {"bayer": "grbg"}}
    file = filed_bench(tmp_path, changes, {"tracker": {"psf_sigma_px": [1.0, 1.0]}})
    sky_e = np.tile([[20.0, 50.0], [5.0, 24.0]], (4, 6))
    star = noisy_star(file, sky_e)
    star_e, background_e = np.array([1e4, 1e3, 10.0]), np.full(3, 24.75)
    finder = CentroidSettings()
    rows = star.noise(star_e, background_e, finder)
    shown = slice(0, 2)
    table = (np.arange(3.0), star_e, background_e, rows, shown, np.zeros((2, 2)))
    coloured = noise._ByMagnitude(star, *table)
    snr_columns, channels = noise._by_channel(file, sky_e, coloured, finder)
    assert list(snr_columns) == ["snr_r", "snr_g", "snr_b"]
    squares = sum(snr**2 for snr in snr_columns.values())
    assert squares == pytest.approx(rows["snr"][shown] ** 2, rel=0.02)
    shares = dict(zip("rgb", star.mosaic[0], strict=True))
    assert {name: one["star_share"] for name, one in channels.items()} == pytest.approx(shares)
    sky = {name: one["background_e_per_px"] for name, one in channels.items()}
    assert sky == pytest.approx({"r": 50.0, "g": 22.0, "b": 5.0})
    grey = noise._ByMagnitude(gaussian(1.0), *table)
    assert noise._by_channel(file, sky_e, grey, finder) == ({}, {})


def test_fields_all_over_the_sky_are_identified_by_four_stars_and_more(tmp_path, monkeypatch):
    """Of a pinhole's stars to V = 5, which are all found for sure."""
    fields = 16
    monkeypatch.setattr(noise, "TRIALS", 4)
    monkeypatch.setattr(noise, "SKY_FIELDS", fields)
    tracker = {"resolution_px": [300, 200], "focal_length_mm": 15, "transmission": None}
    file = filed_bench(tmp_path, {"tracker": tracker, "sky": {"faintest_v_mag": 5.0}})
    budget = noise.noise_budget(file, None, CentroidSettings(), np.random.default_rng(2))
    q = np.random.default_rng(2).standard_normal((fields, 4))
    stars = bench_stars(file.config, tmp_path)
    focal_px = 15e3 / 13
    counts = []
    for one_q in q:
        x, y, z = to_matrix(one_q / np.linalg.norm(one_q)) @ stars.vectors.T
        ahead = np.where(z > 0, z, np.nan)
        inside = np.abs(focal_px * x / ahead) < 150
        counts.append(int((inside & (np.abs(focal_px * y / ahead) < 100)).sum()))
    assert budget.fields == fields
    assert budget.found_stars == pytest.approx(np.median(counts), abs=1e-6)
    # some fields have just four, and some have three
    assert {3, 4} <= set(counts)
    assert budget.identified_share == pytest.approx(np.mean(np.array(counts) >= 4))


def test_each_of_many_stars_has_the_noise_of_its_own_light_and_background():
    """More than are computed at once."""
    star = gaussian(1.0, NOISY, phases=2)
    count = 2 * noise.CHUNK + 3
    star_e = np.geomspace(10.0, 1e5, count)
    sky_e = np.linspace(900.0, 1.0, count)
    rows = star.noise(star_e, sky_e, CentroidSettings())
    for number in (0, noise.CHUNK - 1, noise.CHUNK, count - 1):
        (alone,) = one(star, star_e[number], sky_e[number])
        for name in noise.NOISE_COLUMNS:
            assert rows[name][number] == pytest.approx(alone[name], rel=1e-9)


def test_a_bound_is_the_rms_over_the_places_within_a_pixel():
    """Of two places with variances of 1 and 9 of the first unknown, 4 and 16 of the second."""
    information = np.array([[np.diag([1.0, 1 / 4]), np.diag([1 / 9, 1 / 16])]])
    np.testing.assert_allclose(noise._bounds(information), [[math.sqrt(5.0), math.sqrt(10.0)]])


def test_what_centroiders_reach_is_before_the_sky_and_no_better_than_its_bound(rng):
    """Of a star as bright as each pixel of its sky, which makes most of its noise."""
    star = gaussian(1.0, NOISY, phases=2)
    stars_e = np.array([2e4, 5e4])
    finder = CentroidSettings()
    reached_px = noise._measured_by_rate(star, stars_e, 2e4, finder, rng)
    assert reached_px.shape == (len(noise.FAMILY), 2)
    bound_px = star.noise(stars_e, np.full(2, 2e4), finder)["bound_px"]
    # an rms of 400 places along two axes is known to 2.5 %
    assert (reached_px > 0.9 * bound_px).all()
    fit_px = reached_px[noise.FAMILY.index("fit")]
    assert (fit_px < 1.2 * bound_px).all()


@pytest.mark.parametrize("sky_e", [14.0, 20.0])
def test_a_pixel_of_the_sky_is_above_the_threshold_as_often_as_its_codes_are(sky_e):
    """Steps of the ADC are twice the noise before it, and the threshold is one sigma."""
    star = gaussian(0.85, replace(NOISY, gain_e_per_dn=24.0), phases=1)
    finder = CentroidSettings(1.0, 1)
    sky = star.detector.noise(np.full((1, 1, 1), sky_e), 1.0)
    above = star._above(np.zeros((1, 1, 1)), np.full((1, 1, 1), sky_e), (sky, sky), finder)
    assert np.ptp(above) == 0.0
    pixels = (400, 400)
    codes = Detector(star.detector, pixels).expose(
        np.full(pixels, sky_e), 1.0, np.random.default_rng(4)
    )
    level_dn = (sky_e + 60.0) / 24.0 + 200.0
    share = np.mean(codes > level_dn + np.sqrt(sky.total_e2.item()) / 24.0)
    # four sigmas of the share of so many pixels, and the skewness of electrons' number
    assert above.max() == pytest.approx(share, abs=4 * 0.5 / 400 + 2e-3)


@pytest.mark.parametrize("noises", [5.0, 6.0])
def test_a_superpixel_has_a_quarter_of_the_light_of_its_middle_and_three_eighths_of_the_noise(
    noises,
):
    """A star within one pixel, before even noise: on that pixel it is found most probably."""
    star = NoisyStar(GaussianPsf((0.05, 0.05)), RGGB, 1.0, 1, ALIKE)
    even = star.detector.noise(np.full(star.shares.shape, 30.0)[None], 1.0)
    noise_e = math.sqrt(even.total_e2.flat[0])
    star_e = np.full((1, 1, 1), 4 * noises * 0.375 * noise_e)
    above = star._superpixels_above(star_e, (even, even), 5.0)
    for window in above[0]:
        assert window.max() == pytest.approx(ndtr(noises - 5.0), rel=1e-6)


def measured(star: NoisyStar, star_e: float, threshold_sigma: float = 5.0) -> np.ndarray:
    return noise.measured_px(
        star, star_e, 30.0, CentroidSettings(threshold_sigma, 1), np.random.default_rng(4)
    )


def test_stars_of_trials_are_those_over_the_threshold_of_a_detector_without_defects(monkeypatch):
    """Whatever its dark current, no star is none; a superpixel finds what a pixel does not."""
    monkeypatch.setattr(noise, "TRIALS", 8)
    dark = gaussian(0.9, replace(NOISY, dark_e_per_s=3000.0, gain_e_per_dn=3.0), phases=1)
    assert np.isnan(measured(dark, 1e-6, 6.0)).all()
    plain = gaussian(0.9, NOISY, phases=1)
    hot = gaussian(0.9, replace(NOISY, hot_pixel_fraction=0.2), phases=1)
    np.testing.assert_array_equal(measured(hot, 2000.0), measured(plain, 2000.0))
    star = NoisyStar(GaussianPsf((0.9, 0.9)), RGGB, 1.0, 1, ALIKE)
    noise_e = math.sqrt(star.detector.noise(30.0, 1.0).total_e2)
    # a superpixel in the middle has 0.13 of the light: 9 sigmas of its own noise, and 3.4 of a
    # pixel's
    assert np.isfinite(measured(star, 26 * noise_e)).all()
