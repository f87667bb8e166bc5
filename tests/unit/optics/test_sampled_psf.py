"""A sampled PSF: its light in pixels against brute force at 121 places in a pixel, and where it
fails.
"""

from __future__ import annotations

import tracemalloc
from itertools import product

import numpy as np
import pytest
from astropy.io import fits

from hilstar.basics.errors import InputError
from hilstar.optics.psf import (
    MAX_SAMPLED_CUT,
    GaussianPsf,
    SampledPsf,
    read_psf,
    square_points,
)
from tests.support.claims import holds
from tests.support.psfs import airy, coma, gaussian, in_pixels, sampled

PHASES = np.linspace(-0.5, 0.5, 11, endpoint=False) + 0.013  # beside the table's own places
FLUX_LIMIT = 1e-7  # float32's rounding of a table whose phases sum to 1
# within which a centroid is taken: further out the wings' end, a footprint's edge, is that of the
# samples
CENTRE_PX = 5
AIRY_LIMIT = 1e-3
# sigma, px, and samples a pixel of the rows of the table in docs/where-it-fails.md
SAMPLES_A_SIGMA = {"1.2": (0.3, 4), "0.9": (0.3, 3), "0.7": (0.7, 1), "0.6": (0.3, 2)}
WIDE_LIMIT = 3e-4  # of the peak: the table is linear between its places (1e-4 measured)
CENTROID_LIMIT_PX = 2e-4  # the cut wings' share, of 1e-4, times how unevenly they lie


def centroid_px(share: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """The centroid (x, y) of the pixels within CENTRE_PX."""
    near = np.abs(pixel) <= CENTRE_PX
    part, at = share[np.ix_(near, near)], pixel[near]
    return np.array([(part.sum(axis=0) * at).sum(), (part.sum(axis=1) * at).sum()]) / part.sum()


def profile_errors(psf: SampledPsf, profile) -> tuple[float, float, float]:
    """The largest errors of a star's flux (relative), centroid (px) and pixel (relative to its
    flux) over all phases.
    """
    nodes = 5 if psf.footprint_px > 15 else 8
    pixel = np.arange(psf.footprint_px) - psf.footprint_px // 2
    found = []
    for x, y in product(PHASES, PHASES):
        share, true = (
            psf.shares(pixel - x, (pixel - y)[:, None]),
            in_pixels(profile, pixel - x, pixel - y, nodes),
        )
        true /= true.sum()  # as the cut light is shared out
        places = [centroid_px(part, pixel) for part in (share, true)]
        found.append(
            (abs(share.sum() - 1), np.hypot(*(places[0] - places[1])), np.abs(share - true).max())
        )
    return tuple(np.max(found, axis=0).tolist())


# Limits of a pixel: the table's step and the spline; of an Airy pattern, whose rings go on, also
# the light beyond its samples. Measured, in this order: 1.2e-4, 6.9e-5, 2.1e-5, 1.4e-5, 1.5e-6;
# 7.5e-5, 5.8e-5; 8.4e-4, 5.7e-4. Centroids: 1.1e-4 px at most.
@pytest.mark.parametrize(
    ("profile", "per_px", "half_px", "limit"),
    [
        (gaussian(0.4, 0.4), 4, 4, 2e-4),
        (gaussian(0.55, 0.55), 3, 4, 1e-4),
        (gaussian(0.55, 1.1), 4, 7, 6e-5),
        (gaussian(0.85, 0.85), 5, 6, 3e-5),
        (gaussian(3.0, 3.0), 1, 18, 1e-5),
        (coma(), 3, 7, 1.5e-4),
        (coma(), 7, 7, 1e-4),
        (airy(1.5), 3, 10, 1e-3),
        (airy(2.5), 2, 10, 1e-3),
    ],
    ids=["0.4", "0.55", "0.55 x 1.1", "0.85", "3.0", "coma", "fine coma", "airy", "wide airy"],
)
def test_a_sampled_psf_has_its_light_in_the_right_pixels_at_every_phase(
    profile, per_px, half_px, limit
):
    flux, centroid, pixel = profile_errors(
        SampledPsf(sampled(profile, per_px, half_px), per_px), profile
    )
    holds("psf-sum", flux)
    # of an Airy pattern, whose rings go on, also the light beyond its samples
    holds("psf-pixel" if limit < AIRY_LIMIT else "psf-airy", pixel)
    assert centroid < CENTROID_LIMIT_PX
    assert pixel < limit


def test_an_image_that_reaches_far_keeps_its_core():
    """A table of 99 px has coarser steps: measured 3.1e-4, and 1.2e-3 were they not doubled
    there.
    """
    psf, light = SampledPsf(sampled(airy(1.5), 3, 48), 3), sampled(airy(1.5), 3, 48).sum() / 9
    assert psf.footprint_px > 90
    pixel = np.arange(-3.0, 4.0)
    for x, y in zip(PHASES, PHASES[::-1], strict=True):
        true = in_pixels(airy(1.5), pixel - x, pixel - y, 5) / light
        off = np.abs(psf.shares(pixel - x, (pixel - y)[:, None]) - true)
        holds("psf-far", off.max())


def test_an_image_that_is_pixel_integrated_is_interpolated_alone():
    at = np.arange(-28, 29) / 4
    psf = SampledPsf(in_pixels(coma(), at, at), 4, pixel_integrated=True)
    flux, centroid, pixel = profile_errors(psf, coma())
    assert (flux < FLUX_LIMIT, centroid < CENTROID_LIMIT_PX, pixel < 1.5e-4) == (True, True, True)


def test_a_sampled_gaussian_is_the_gaussian():
    """To the cut, which is a hundred times the Gaussian's own, and the table's step."""
    sigma = (0.6, 0.9)
    psf, exact = SampledPsf(sampled(gaussian(*sigma), 5, 6), 5), GaussianPsf(sigma)
    rng, pixel = np.random.default_rng(1), np.arange(-6.0, 7.0)
    fraction, light = rng.uniform(-0.5, 0.5, (2, 100)), rng.uniform(1, 2, 100)
    apart = np.abs(psf.stamps(fraction, light, 9) - exact.stamps(fraction, light, 9))
    assert apart.max() < 2e-4
    x, y = rng.uniform(-9, 9, (2, 100))
    region = (-5, -4, 13, 10)
    assert np.abs(psf.spread(x, y, light, region) - exact.spread(x, y, light, region)).max() < 5e-4
    for whole in (psf, SampledPsf(psf.samples.T, 5)):  # wide along rows, and along columns
        image = whole.spread(*fraction, light, (-7, -8, 15, 17))
        assert image.sum(dtype=float) == pytest.approx(light.sum(), rel=FLUX_LIMIT)
    assert psf.shares(pixel, pixel[:, None]).shape == (13, 13)
    assert psf.peak_share == pytest.approx(exact.peak_share, abs=1e-4)
    # A Gaussian and a pixel together are not quite a Gaussian, which adaptive moments weigh by: 1.4
    # % at a sigma of 0.55 px.
    assert psf.width_px == pytest.approx(sigma, rel=0.015)
    assert psf.cut_share(5) == pytest.approx(exact.cut_share(5), rel=1e-3)
    assert psf.outside_share(5) == pytest.approx(exact.outside_share(5), rel=2e-3)
    assert psf.cut_share(99) == 0
    wider, exactly = psf.blurred(0.3), exact.blurred(0.3)
    assert (
        np.abs(wider.stamps(fraction, light, 11) - exactly.stamps(fraction, light, 11)).max() < 2e-4
    )


@pytest.mark.parametrize("sigma_px", [1.0, 2.0, 3.0])
def test_a_wide_blur_spreads_beyond_the_samples_as_a_gaussian_s_does(sigma_px):
    """The samples reach 3 px to each side, a wide blur six times its sigma: variances add."""
    narrow = (0.5, 0.8)
    wider = SampledPsf(sampled(gaussian(*narrow), 5, 3), 5).blurred(sigma_px)
    exact = GaussianPsf((np.hypot(0.5, sigma_px), np.hypot(0.8, sigma_px)))
    pixel = np.arange(-12.0, 13.0)
    x_px, y_px = pixel - 0.3, (pixel - 0.1)[:, None]
    apart = np.abs(wider.shares(x_px, y_px) - exact.shares(x_px, y_px))
    assert apart.max() < WIDE_LIMIT * exact.peak_share


@pytest.mark.parametrize(
    ("profile", "half_px"), [(coma(), 7), (airy(1.5), 15), (gaussian(0.3, 1.5), 9)]
)
def test_footprint_and_reach_hold_what_they_say(profile, half_px):
    psf = SampledPsf(sampled(profile, 4, half_px), 4)
    assert psf.footprint_px % 2 == 1
    assert psf.cut_share(psf.footprint_px) <= MAX_SAMPLED_CUT < psf.cut_share(psf.footprint_px - 2)
    (x2, y2), factor = psf.reach
    pixel = np.arange(psf.footprint_px) - psf.footprint_px // 2
    for x, y in product(PHASES[::3], PHASES[::3]):
        share, away = (
            psf.shares(pixel - x, (pixel - y)[:, None]),
            (pixel - x) ** 2 / x2 + (pixel - y)[:, None] ** 2 / y2,
        )
        assert (share <= factor * np.exp(-away)).all()
        assert share.max() <= psf.peak_share
    # A star that lights its first pixel at 1 % of its light is drawn in an ellipse, not in a whole
    # square.
    assert np.pi * np.sqrt(x2 * y2) * np.log(100 * factor) < psf.footprint_px**2


@pytest.mark.parametrize("rows", [1, -1], ids=["as it is", "upside down"])
@pytest.mark.parametrize("columns", [1, -1], ids=["as it is", "mirrored"])
def test_what_a_footprint_cuts_is_that_of_the_worst_corner_of_a_pixel(rows, columns):
    """By quadrature of a tail towards each side, whose samples hold 1 - 1e-6 of its light."""
    psf = SampledPsf(sampled(coma(), 5, 8)[::rows, ::columns], 5)
    for size_px in (3, 5, 7):
        pixel = np.arange(size_px) - size_px // 2
        kept = []
        for x, y in product((-0.5, 0.5), (-0.5, 0.5)):
            kept.append(in_pixels(coma(), columns * (pixel - x), rows * (pixel - y), 6).sum())
        assert psf.cut_share(size_px) == pytest.approx(1 - min(kept), rel=0.01)
    assert psf.footprint_px == SampledPsf(sampled(coma(), 5, 8), 5).footprint_px


def test_the_chief_ray_stays_in_the_middle():
    """The centroid of a coma is its own, and so not at the star's place."""
    psf = SampledPsf(sampled(coma(), 5, 7), 5)
    pixel = np.arange(-8.0, 9.0)
    share = psf.shares(pixel, pixel[:, None])
    truly = 0.45 * (0.28 * np.array([1.2, 0.5]) + 0.12 * np.array([3.0, 1.3]))
    assert [float((share.sum(axis=axis) * pixel).sum()) for axis in (0, 1)] == pytest.approx(
        truly, abs=1e-3
    )
    assert share[9, 9] > 2 * share[7, 7]  # right and down, not left and up


def test_the_same_file_is_the_same_psf_and_another_is_not(tmp_path):
    """A tracker that changes its bench asks by that whether its optics have changed."""
    path = tmp_path / "psf.fits"
    fits.writeto(path, sampled(coma(), 3, 7), fits.Header({"OVERSAMP": 3}))
    first = read_psf(path)
    assert (first.per_px, first.pixel_integrated) == (3, False)
    assert read_psf(path) is first
    fits.writeto(path, sampled(airy(1.5), 3, 7), fits.Header({"OVERSAMP": 3}), overwrite=True)
    assert read_psf(path) != first
    fits.writeto(tmp_path / "plain.fits", sampled(gaussian(2.0, 2.0), 1, 9))
    plain = read_psf(tmp_path / "plain.fits")
    assert (plain.per_px, plain.pixel_integrated) == (1, False)


def test_fewer_samples_than_two_a_sigma_are_off_by_percents():
    """Where it fails: the spline cannot know what lies between its samples."""
    for samples, (sigma_px, per_px) in SAMPLES_A_SIGMA.items():
        light = gaussian(sigma_px, sigma_px)
        flux, centroid, pixel = profile_errors(SampledPsf(sampled(light, per_px, 5), per_px), light)
        holds("psf-sum", flux)
        holds(f"psf-{samples}-pixel", pixel)
        holds(f"psf-{samples}-centroid", centroid)


def test_an_undersampled_psf_is_refused():
    with pytest.raises(InputError, match=r"negative; .* more finely than 1 a pixel"):
        SampledPsf(sampled(gaussian(0.4, 0.4), 1, 4), 1)


def test_negative_lobes_become_black_and_many_are_refused():
    rng, samples = np.random.default_rng(2), sampled(gaussian(0.6, 0.6), 4, 5)
    noisy = samples + rng.normal(0, 1e-4, samples.shape) * samples.max()
    assert noisy.min() < 0
    psf = SampledPsf(noisy, 4)
    flux, _, pixel = profile_errors(psf, gaussian(0.6, 0.6))
    assert flux < FLUX_LIMIT
    assert pixel < 2e-3  # the noise in a pixel's 16 samples, and what its sum does to all
    assert psf.shares(PHASES * 10, PHASES[:, None] * 10).min() >= 0
    with pytest.raises(InputError, match="negative; subtract its background"):
        SampledPsf(samples - 0.02 * samples.max(), 4)


@pytest.mark.parametrize(
    ("samples", "per_px", "integrated", "match"),
    [
        (np.ones((4, 5)), 1, False, "5 x 4 samples has no middle"),
        (np.ones(5), 1, False, "no middle"),
        (np.zeros((5, 5)), 1, False, "no light"),
        (np.full((5, 5), np.nan), 1, False, "not finite"),
        (np.ones((5, 5)), 0, False, "0 samples a pixel; write 1 or more"),
        (sampled(gaussian(0.2, 0.2), 8, 3), 8, True, "write PIXINT = F"),
    ],
)
def test_what_is_no_psf_is_refused(samples, per_px, integrated, match):
    with pytest.raises(InputError, match=match):
        SampledPsf(samples, per_px, integrated)


@pytest.mark.parametrize("is_tall", [False, True])
def test_light_outside_a_square_is_that_along_the_wider_axis(is_tall):
    """A Gaussian of 1.5 by 0.5 px: 5 px hold 1.67 and 5 of its sigmas."""
    offset_px = np.arange(-32, 33) / 4
    across = np.exp(-0.5 * (offset_px / 1.5) ** 2)
    down = np.exp(-0.5 * (offset_px / 0.5) ** 2)
    image = np.outer(down, across)
    if is_tall:
        image = image.T
    outside = SampledPsf(image, 4).outside_share(5)
    exact = GaussianPsf((1.5, 0.5)).outside_share(5)
    assert outside == pytest.approx(exact, rel=0.01)


@pytest.mark.parametrize("is_tall", [False, True])
def test_an_elongated_psf_s_ellipse_lies_along_it_and_its_table_ends_in_the_dark(is_tall):
    """All shares are within it; its axes are those of the PSF, not each other's."""
    sigma = (0.6, 1.0) if is_tall else (1.0, 0.6)
    psf = SampledPsf(sampled(gaussian(*sigma), 3, 6), 3)
    (x2, y2), factor = psf.reach
    variance_x, variance_y = psf.variance_px2
    assert y2 / x2 == pytest.approx(variance_y / variance_x)
    wide_px = np.array(psf.width_px)
    assert (variance_x, variance_y) == pytest.approx(tuple(wide_px**2 + 1 / 12))
    half_px = psf.footprint_px / 2
    at = np.linspace(-half_px, half_px, 4 * psf.footprint_px + 1)
    shares = psf.shares(at, at[:, None])
    assert (shares <= factor * np.exp(-(at**2) / x2 - at[:, None] ** 2 / y2)).all()
    for edge in (shares[0], shares[-1], shares[:, 0], shares[:, -1]):
        assert not edge.any()
    assert psf.width_px == pytest.approx(sigma, rel=0.015)
    # and not much larger than what has a ten-thousandth of the peak
    lit_px2 = np.mean(shares > 1e-4 * psf.peak_share) * psf.footprint_px**2
    ellipse_px2 = np.pi * np.sqrt(x2 * y2) * np.log(factor / (1e-4 * psf.peak_share))
    assert lit_px2 < ellipse_px2 < 1.4 * lit_px2


def test_the_shader_s_cells_interpolate_the_shares_themselves(rng):
    """Each cell's four coefficients: of 1, x, y and x y, from its upper left corner on."""
    psf = SampledPsf(sampled(coma(), 3, 6), 3)
    side = psf.footprint_px
    defines, uniforms, cells = psf.shader(side)
    steps = (len(cells)) // side
    assert (defines, uniforms) == ((f"SHARE_STEPS {steps}.0",), {})
    assert cells.shape == (side * steps, side * steps, 4)
    x, y = rng.uniform(-side / 2, side / 2, (2, 300))
    column, row = ((at + side / 2) * steps for at in (x, y))
    corner = cells[row.astype(int), column.astype(int)].astype(float)
    u, v = column % 1, row % 1
    terms = np.stack([np.ones(300), u, v, u * v], axis=1)
    assert (corner * terms).sum(axis=1) == pytest.approx(psf.shares(x, y), abs=1e-7)


@pytest.mark.parametrize("integrated", [False, True])
def test_a_blurred_psf_is_as_wide_as_both_and_of_the_same_kind(integrated):
    at = np.arange(-15, 16) / 3
    profile = gaussian(0.8, 0.6)
    light = in_pixels(profile, at, at, 5) if integrated else sampled(profile, 3, 5)
    psf = SampledPsf(light, 3, integrated)
    wider = psf.blurred(0.5)
    assert wider.pixel_integrated is integrated
    # as far as a Gaussian and a pixel are no Gaussian
    assert wider.width_px == pytest.approx(np.hypot(psf.width_px, 0.5), rel=5e-3)
    assert psf.width_px == pytest.approx((0.8, 0.6), rel=0.015)


def test_a_table_of_any_footprint_has_a_star_s_light_and_place_at_every_phase(rng):
    """Of footprints whose share of the largest table is an odd number of steps, and others."""
    for sigma_px in (3.1, 3.4):
        psf = SampledPsf(sampled(gaussian(sigma_px, sigma_px), 2, 20), 2)
        pixel = np.arange(-20, 21)
        for x, y in rng.uniform(-0.5, 0.5, (3, 2)):
            share = psf.shares(pixel - x, (pixel - y)[:, None])
            assert share.sum() == pytest.approx(1, abs=1e-6)
            assert (share.sum(axis=0) @ pixel, share.sum(axis=1) @ pixel) == pytest.approx(
                (x, y), abs=CENTROID_LIMIT_PX
            )


def test_a_narrow_gaussian_is_drawn_by_error_functions_of_its_own_axes(rng):
    """Under half a pixel no polynomial will do: float32, and the rational function's own error."""
    psf = GaussianPsf((0.3, 0.45))
    defines, uniforms, table = psf.shader(psf.footprint_px)
    assert (defines, table) == ((), None)
    wanted = tuple(1 / (sigma * np.sqrt(2)) for sigma in psf.sigma_px)
    assert uniforms["inverse_sigma_sqrt2"] == pytest.approx(wanted)
    fraction = rng.uniform(-0.5, 0.5, (2, 50)).astype(np.float32)
    rates = rng.uniform(1, 2, 50).astype(np.float32)
    drawn = psf.drawn_stamps(fraction, rates, 7, psf.footprint_px)
    assert np.abs(drawn - psf.stamps(fraction.astype(float), rates, 7)).max() < 2e-6
    assert psf.variance_px2 == pytest.approx((0.09 + 1 / 12, 0.2025 + 1 / 12))


def test_a_look_at_a_share_copies_no_table():
    """A star of a thousand points is a thousand looks: by a copy each, seven seconds of a frame."""
    psf = SampledPsf(sampled(airy(1.5), 4, 24), 4)
    middle_px = np.zeros(1)
    psf.shares(middle_px, middle_px)  # makes the table
    tracemalloc.start()
    try:
        psf.shares(middle_px, middle_px)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # a table of this footprint has 20 rows a px, of four bytes a share
    assert peak_bytes < (20 * psf.footprint_px) ** 2 * 4 / 10


@pytest.mark.parametrize(
    ("psf", "side_px"),
    [
        *((GaussianPsf((0.7, 0.9)), side_px) for side_px in (0.4, 1.0, 3.0, 20.0)),
        (SampledPsf(sampled(gaussian(0.8, 0.8), 8, 5), 8), 1.0),
    ],
)
def test_the_points_of_a_square_have_its_middle_and_its_variance(psf, side_px):
    """An even square of side a has a^2 / 12 along each axis."""
    points, each = square_points(side_px, psf)
    assert points == pytest.approx(-points[::-1], abs=1e-12)
    blur_px2 = np.subtract(each.variance_px2, psf.variance_px2)
    found_px2 = side_px**2 * np.mean(points**2) + blur_px2
    assert found_px2 == pytest.approx(side_px**2 / 12, rel=1e-2)
