"""Parts of a comparison of skies and of a judgement of a field, each against a closed form."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics.rotation import from_rotation_vector, to_matrix
from hilstar.instruments.compare.compare_skies import (
    MAX_MOVE_SIGMAS,
    PIXEL_ERROR,
    _differences,
    _SkyFit,
    _unexplained,
)
from hilstar.instruments.compare.sky_comparison import Limits
from hilstar.instruments.compare.star_fit import (
    RIPPLE_SHARE,
    Seeds,
    _blended,
    _has,
    _sigma_px,
)
from hilstar.instruments.simulate.eye_picture import _blocks
from hilstar.instruments.simulate.noise import found_share
from hilstar.instruments.simulate.simulator import FaultyExposure
from hilstar.instruments.verify.measure import DECENTRED, HIGHER, LENS, TILT, Star, _parts
from hilstar.instruments.verify.summary import _by_magnitude
from hilstar.instruments.verify.verdict import DisplayErrors
from hilstar.optics.layers.truth import TRUTH_DTYPE
from hilstar.optics.psf import GaussianPsf
from hilstar.testing import compare
from tests.support.refusals import refusal


def sky_of(*stars: tuple[float, float, float]) -> np.ndarray:
    """A linear image of Gaussian stars: the peak, x and y of each."""
    y, x = np.mgrid[:48, :64]
    return sum(
        peak * np.exp(-((x - at_x) ** 2 + (y - at_y) ** 2) / 2) for peak, at_x, at_y in stars
    )


SKY = sky_of((100.0, 15.2, 20.3), (60.0, 45.1, 40.2), (30.0, 52.4, 10.7))


def test_a_sky_is_the_same_within_the_limit_that_is_given_of_each():
    """A star that is 0.1 mag brighter, and one that has moved by 0.1 px."""
    brighter = sky_of((100 * 10**0.04, 15.2, 20.3), (60.0, 45.1, 40.2), (30.0, 52.4, 10.7))
    moved = sky_of((100.0, 15.2, 20.3), (60.0, 45.2, 40.2), (30.0, 52.4, 10.7))
    assert not compare(brighter, SKY, flux_mag=0.05, centroid_px=0.5).same
    assert compare(brighter, SKY, flux_mag=0.2, centroid_px=0.05).same
    assert not compare(moved, SKY, flux_mag=0.5, centroid_px=0.05).same
    assert compare(moved, SKY, flux_mag=0.05, centroid_px=0.2).same


@pytest.mark.parametrize(
    ("frame", "golden", "words"),
    [
        (SKY[:, 1:], SKY, "63 x 48 px against 64 x 48 px"),
        (np.where(SKY > 90, np.nan, SKY), SKY, "the frame image has a pixel that is NaN"),
        (SKY, np.where(SKY > 90, np.inf, SKY), "the golden image has a pixel that is NaN"),
        (SKY[0], SKY[0], "the frame image has the shape (64,)"),
        (SKY[:1], SKY[:1], "the frame image has the shape (1, 64)"),
        (SKY, np.zeros_like(SKY), "the golden image has no star"),
    ],
)
def test_what_is_no_pair_of_skies_is_refused(frame, golden, words):
    assert words in refusal(compare, frame, golden)


@pytest.mark.parametrize("sigma_px", [0.3, 0.9, 2.0])
def test_a_star_s_sigma_is_that_of_its_correlation_without_the_pixel_s(sigma_px):
    """Of a Gaussian with itself one pixel on: exp(-1 / (4 sigma^2)), and a pixel's variance."""
    correlation = math.exp(-0.25 / (sigma_px**2 + 1 / 12))
    assert _sigma_px(correlation) == pytest.approx(sigma_px)


def test_a_blend_is_at_its_first_star_and_has_all_names():
    places = np.array([[10.0, 10], [50, 50], [11, 10], [12, 10], [80, 20]])
    seeds = _blended(Seeds(places, [(1,), (2,), (3,), ("Moon",), (5,)]), 1.5)
    order = np.argsort(seeds.places_px[:, 0])
    assert seeds.places_px[order].tolist() == [[10, 10], [50, 50], [80, 20]]
    assert [seeds.hip[k] for k in order] == [(1, 3, "Moon"), (2,), (5,)]


@pytest.mark.parametrize(("near", "has"), [(0, False), (1, False), (2, True), (3, True)])
def test_a_table_is_of_a_sky_by_half_of_its_brightest_stars(near, has):
    truth = np.zeros(3, dtype=TRUTH_DTYPE)
    truth["x_px"] = [10.0, 30.0, 50.0]
    truth["y_px"] = 10.0
    found = np.array([[10.0, 10.5], [30.0, 10.5], [50.0, 10.5]])
    found[near:, 1] += 20
    assert _has(truth, found, 1.0) == has


def test_a_star_is_gone_that_is_too_faint_or_too_far_whichever_way():
    far_px = MAX_MOVE_SIGMAS * 1.5
    places = np.array([[10.0, 10.0]] * 5)
    shifts = np.array(
        [[0.1, 0.2], [0, 1.01 * far_px], [1.01 * far_px, 0], [0, 0.9 * far_px], [0, 0]]
    )
    fit = SimpleNamespace(
        templates=SimpleNamespace(errors=lambda flux, error: (0.1 * flux, np.full(5, 0.05))),
        flux=np.full(5, 100.0),
        places_px=places,
        psf=SimpleNamespace(width_px=(1.0, 1.5)),
    )
    moved = SimpleNamespace(flux=np.array([80.0, 100, 100, 100, 1e-6]), places_px=places + shifts)
    limits = Limits(0.01, 0.1)
    rows = _differences(Seeds(places, [(k,) for k in range(5)]), fit, moved, limits)
    assert [math.isinf(row.flux_error_mag) for row in rows] == [False, True, True, False, True]
    assert rows[0].flux_error_mag == pytest.approx(-2.5 * math.log10(0.8))
    assert (rows[0].dx_px, rows[0].dy_px) == pytest.approx((0.1, 0.2))
    assert (rows[1].dx_px, rows[1].dy_px) == (0.0, 0.0)
    # a tenth of the light in magnitudes; a place's own error is under the limit
    assert rows[0].limits.flux_mag == pytest.approx(0.1 * 2.5 / math.log(10))
    assert rows[0].limits.centroid_px == 0.1


def test_tilts_are_small_turns_about_both_axes_and_lenses_are_those_of_brown(rng):
    x, y = rng.uniform(-0.3, 0.3, (2, 7))
    parts = _parts(x, y)
    turn = 1e-6
    for axis, shift in ((0, (0, 1)), (1, (-1, 0))):
        vector = np.zeros(3)
        vector[axis] = -turn
        rays = to_matrix(from_rotation_vector(vector)) @ np.stack([x, y, np.ones(7)])
        moved = (rays[:2] / rays[2] - [x, y]) / turn
        # without the shift of the whole
        wanted = moved - np.array(shift)[:, None]
        sign = np.sign(wanted[0] @ parts[TILT][:7, axis])
        np.testing.assert_allclose(parts[TILT][:, axis], sign * wanted.ravel(), atol=1e-5)
    r2 = x**2 + y**2
    np.testing.assert_allclose(parts[LENS][:, 0], np.concatenate([x * r2, y * r2]))
    np.testing.assert_allclose(parts[HIGHER][:, 0], np.concatenate([x * r2**2, y * r2**2]))
    first = np.concatenate([2 * x * y, r2 + 2 * y**2])
    second = np.concatenate([r2 + 2 * x**2, 2 * x * y])
    np.testing.assert_allclose(parts[DECENTRED], np.column_stack([first, second]))


def test_magnitudes_have_rows_from_the_brightest_star_on():
    stars = []
    for v_mag in (-1.4, 0.5, 0.6, 3.0):
        stars.append(Star(1, v_mag, 10.0, 20.0, 0.01, 0.06, 0.08, 0.01, 0.1, 0.0, 0.0))
    rows = _by_magnitude(DisplayErrors(stars, [], 0.0, 0.0, None))
    assert [(row["v_from"], row["v_to"], row["stars"]) for row in rows] == [
        (-2, -1, 1),
        (0, 1, 2),
        (3, 4, 1),
    ]


def test_blocks_of_a_picture_are_even_about_its_middle(rng):
    blocks = _blocks(rng.integers(90, 110, (256, 384)).astype(np.uint16))
    assert blocks.across.min() == pytest.approx(-blocks.across.max())
    assert blocks.down.min() == pytest.approx(-blocks.down.max())
    assert -1 < blocks.across.min() < 0


@pytest.mark.parametrize(("minimum", "share"), [(1, 7 / 8), (2, 1 / 2), (3, 1 / 8)])
def test_a_star_is_found_by_as_many_pixels_as_are_needed(minimum, share):
    """Three pixels, each above the threshold in every second exposure."""
    assert found_share(np.full((1, 1, 3), 0.5), minimum) == pytest.approx([share])


def test_a_field_is_seen_in_the_pieces_in_which_nothing_covers_it(monkeypatch):
    """Pieces of 0.1, 0.2 and 0.4 s, of which the second is blank."""
    pieces = []
    for number, seconds in enumerate((0.1, 0.2, 0.4)):
        view = SimpleNamespace(exposure_s=seconds)
        pieces.append(SimpleNamespace(view=view, now=number == 1))

    class Layer(SimpleNamespace):
        """Blank where its piece is."""

        def turned(self, view):
            return view

    monkeypatch.setattr(
        "hilstar.instruments.simulate.simulator.FaultLayer",
        lambda view, now: Layer(blank=now),
    )
    exposure = FaultyExposure(None, pieces)
    exposure._note = lambda sprites, share: None
    total, open_s = exposure.light_e(
        lambda view, layer: view, lambda view, seconds: np.full((1, 1), 10 * seconds)
    )
    assert total[0, 0] == pytest.approx(7.0)
    assert open_s == pytest.approx(0.5)


STAR_PX = (15.0, 20.0)


def fits_of(golden: np.ndarray, frame: np.ndarray) -> tuple[_SkyFit, _SkyFit]:
    """Two images as a star at STAR_PX explains them."""
    places_px = np.array([STAR_PX])
    psf = GaussianPsf((1.0, 1.0))
    return _SkyFit(golden, places_px, psf), _SkyFit(frame, places_px, psf)


def spikes(*values: tuple[float, int, int]) -> np.ndarray:
    """Light in single pixels: how much, x and y."""
    light = np.zeros((48, 64))
    for value, x, y in values:
        light[y, x] = value
    return light


@pytest.mark.parametrize("peaks", [(1e8, 1e8), (1e8, 0.0), (0.0, 1e8)])
def test_light_far_from_a_bright_star_of_either_image_is_none_below_its_rounding(peaks):
    """A half of what is unexplained is none by itself, so that it has to be twice the rounding."""
    golden, frame = (sky_of((peak, *STAR_PX)) for peak in peaks)
    fit, moved = fits_of(golden, frame)
    limit = 2 * PIXEL_ERROR * max(fit.flux.max(), moved.flux.max())
    for share, count in ((0.9, 0), (1.1, 1)):
        places_px, _ = _unexplained(spikes((share * limit, 50, 30)), fit, moved)
        assert len(places_px) == count


@pytest.mark.parametrize("is_in_frame", [True, False])
def test_light_upon_brighter_light_of_either_image_is_none_below_its_ripple(is_in_frame):
    dark = sky_of((1.0, *STAR_PX))
    lit = dark.copy()
    lit[20:40, 40:60] = 1e8
    fit, moved = fits_of(dark, lit) if is_in_frame else fits_of(lit, dark)
    limit = 2 * RIPPLE_SHARE * 1e8
    for share, count in ((0.9, 0), (1.1, 1)):
        places_px, _ = _unexplained(spikes((share * limit, 50, 30)), fit, moved)
        assert len(places_px) == count


def test_light_beside_twice_as_much_is_the_same_star_s():
    fit, moved = fits_of(SKY, SKY)
    for value, count in ((45.0, 1), (55.0, 2)):
        light = spikes((100.0, 50, 30), (value, 54, 30))
        places_px, _ = _unexplained(light, fit, moved)
        assert len(places_px) == count


def test_a_star_in_a_hollow_has_the_light_of_its_pixel():
    """Its fit, by light below 0 all about it, is below 0."""
    fit, moved = fits_of(SKY, SKY)
    light = spikes((100.0, 50, 30))
    light[27:34, 47:54] -= 30.0
    places_px, flux = _unexplained(light, fit, moved)
    assert places_px.tolist() == [[50.0, 30.0]]
    assert flux.tolist() == [70.0]
