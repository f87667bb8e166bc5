"""Parts of fits and readings of calibrations, each against a closed form."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics.rotation import from_rotation_vector
from hilstar.instruments.calibrate.attitude_pairs import _boresight_rad
from hilstar.instruments.calibrate.camera_edges import check_rate
from hilstar.instruments.calibrate.first_light.uniformity import _White
from hilstar.instruments.calibrate.geometric import fit as geometric_fit
from hilstar.instruments.calibrate.geometric import match
from hilstar.instruments.calibrate.geometric.fit import HUBER, _Loss, residuals_sigma
from hilstar.instruments.calibrate.geometric.match import MAX_CHANCE, MIN_MOTION_PX, MOTION_NOISE
from hilstar.instruments.calibrate.latency import Edges, pair
from hilstar.instruments.calibrate.measurements import MeasuredLevels
from hilstar.instruments.calibrate.photometric import errors_of, held_out
from hilstar.instruments.calibrate.reference import _check_apart
from hilstar.instruments.calibrate.scale import scale_of
from tests.support.refusals import refusal


def test_a_loss_is_a_square_that_goes_on_as_a_line():
    loss = SimpleNamespace(prior=lambda count: np.full(count, 4.0))

    def value(*off: float) -> float:
        return _Loss.value(loss, np.array(off), np.zeros(0))

    near, far = HUBER - 1e-6, HUBER + 1e-6
    assert value(near) == pytest.approx(HUBER**2 / 2, rel=1e-5)
    # no jump, and no bend, where one leads into the other
    assert value(far) - value(near) == pytest.approx(2e-6 * HUBER, rel=1e-5)
    assert value(-9.0) - value(-8.0) == pytest.approx(HUBER)
    assert value(0.3, -0.4) == pytest.approx(0.125)
    # half of four times the numbers' squares
    assert _Loss.value(loss, np.zeros(1), np.array([0.5, 1.0])) == pytest.approx(2.5)


def test_held_out_levels_count_down_to_three_decades():
    fit = SimpleNamespace(
        light=np.array([0.0, 9e-4, 1e-3, 0.1, 1.0]),
        levels=SimpleNamespace(code=np.arange(5)),
        residual=np.array([0.5, 0.03, -0.04, 0.0]),
        residual_error=np.full(4, 0.01),
    )
    figures = held_out(fit)
    assert figures["rms_percent"] == pytest.approx(100 * math.sqrt(0.0025 / 3))
    assert figures["max_percent"] == pytest.approx(4.0)
    assert figures["p95_sigmas"] == pytest.approx(3.9)


def test_a_calibration_of_primaries_has_no_errors_of_white():
    levels = SimpleNamespace(relative_noise=math.nan, has_errors=False)
    white = SimpleNamespace(levels=levels)
    assert errors_of({}) is None
    assert errors_of({"r": white}) is None
    assert errors_of({"w": white}) is None
    # not even asked for its levels
    assert errors_of({"w": SimpleNamespace(), "r": white}) is None


def test_a_reading_of_white_is_noisier_than_the_mean_of_four():
    levels = SimpleNamespace(
        stated=np.array([9.0, 3.0]), count=np.array([1, 4]), mean=np.array([1.0, 100.0])
    )
    assert MeasuredLevels.reading_noise(levels, 0.08) == pytest.approx(0.1)


def test_readings_weigh_alike_unless_the_noise_of_each_is_known():
    ratios = np.array([1.0, 1.1, 1.5])
    unknown = scale_of(100.0, ratios, np.array([0.01, 0.0, 0.02]))
    assert unknown.weights.tolist() == [1.0, 1.0, 1.0]
    assert unknown.noise_mag == 0.0
    known = scale_of(100.0, ratios, np.array([0.01, 0.5, 0.02]))
    assert known.weights[0] > known.weights[2] > 100 * known.weights[1]
    assert known.noise_mag == pytest.approx(known.weights.sum() ** -0.5)


@pytest.mark.parametrize(
    ("vector", "off_rad"),
    [((0.3, 0.0, 0.0), 0.3), ((0.0, 2.8, 0.0), 2.8), ((0.0, 0.0, 1.0), 0.0)],
)
def test_a_boresight_may_be_turned_backwards(vector, off_rad):
    q = from_rotation_vector(np.array(vector))
    assert _boresight_rad(q) == pytest.approx(off_rad, abs=1e-9)


@pytest.mark.parametrize(("apart_deg", "tells"), [(0.0, False), (90.0, True), (180.0, False)])
def test_parallel_and_opposite_faces_tell_no_rotation(apart_deg, tells):
    turned = [math.cos(math.radians(apart_deg)), math.sin(math.radians(apart_deg)), 0.0]
    directions = [np.array([1.0, 0.0, 0.0]), np.array(turned)]
    readings = [SimpleNamespace(direction=direction) for direction in (*directions, None)]
    if tells:
        _check_apart(Path("cube.csv"), "faces", readings)
    else:
        assert "read another one" in refusal(_check_apart, Path("cube.csv"), "faces", readings)


def test_edges_are_paired_within_half_a_period_and_after_the_last_frame(rng):
    """60 changes at 16 ms, seen 12.5 ms later, of which one is seen 10 ms later still; the last is
    seen after the last frame, and one that no frame made half a second after that.
    """
    period_ns = 16e6
    changes_ns = (np.cumsum(rng.integers(3, 9, 60)) * period_ns).astype(np.int64)
    level = np.arange(60) % 2
    seen_ns = changes_ns + 12_500_000
    seen_ns[30] += 10_000_000
    seen_ns = np.append(seen_ns, changes_ns[-1] + 600_000_000)
    seen = Edges(seen_ns, np.append(level, 0))
    paired = pair(seen, Edges(changes_ns, level), period_ns)
    assert len(paired.latency_ns) == 59
    assert set(paired.latency_ns.tolist()) == {12_500_000.0}
    assert paired.unmatched == 1


def test_residuals_are_in_the_sigmas_of_their_own_centroids(monkeypatch):
    """Sigmas of 1, 2 and 4 in a noise of half a pixel."""
    off = (np.array([1.0, 1.0, 1.0]), np.array([2.0, -2.0, 2.0]))
    monkeypatch.setattr(geometric_fit, "residuals_px", lambda *given: off)
    data = SimpleNamespace(centroids=SimpleNamespace(sigma_px=np.array([1.0, 2.0, 4.0])))
    found = residuals_sigma(SimpleNamespace(noise_px=0.5), None, data)
    assert found.tolist() == [2.0, 1.0, 0.5, 4.0, -2.0, 1.0]


# A square may change every 50 ms.
@pytest.mark.parametrize(
    ("period_ms", "exposure_s", "is_quick"),
    [(30, 0.019, True), (30, 0.021, False), (51, 0.0, False), (None, 0.001, False)],
)
def test_an_exposure_lies_within_a_refresh_with_what_comes_between(period_ms, exposure_s, is_quick):
    count = 1 if period_ms is None else 40
    begin_ns = np.arange(count) * (period_ms or 0) * 10**6
    if is_quick:
        check_rate(begin_ns, exposure_s, 20.0)
    else:
        assert "may change every 50 ms" in refusal(check_rate, begin_ns, exposure_s, 20.0)


def test_a_glow_is_taken_from_the_lit_pixels_by_their_number(tmp_path):
    """Three lit pixels of 100 DN, and a glow of 4 DN in five beside them."""
    image = np.array([[100.0, 100, 100, 7, 7], [4, 4, 4, 4, 4]])
    lit = image == 100
    path = tmp_path / "white_000.png"
    watched = []
    context = SimpleNamespace(
        watch=lambda pattern: watched.append(pattern.name),
        folder=tmp_path,
        source=SimpleNamespace(look=lambda file, pattern, stem, exposure_s: path),
        file=None,
        exposure_s=0.1,
        looked=lambda path, dark: SimpleNamespace(image=image),
        is_too_bright=lambda looked: False,
    )
    white = SimpleNamespace(
        _context=context,
        _dark=None,
        _code=900,
        _codes=np.zeros((2, 5), dtype=np.uint16),
        _cold=np.ones((2, 5), dtype=bool),
        _lit=lit,
        _beside=image == 4,
        _number=0,
    )
    for number in range(2):
        path.touch()
        assert _White.read(white) == 300 - 3 * 4
        assert not path.exists()
        assert watched[-1] == f"white_{number:03}"


class FewDots(SimpleNamespace):
    """So many centroids of one pose."""

    def __len__(self):
        return self.count

    def at(self, which):
        """All of them."""
        return self


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_the_median_of_few_dots_moves_by_chance(monkeypatch, share):
    """Four dots a frame, whose median scatters by half as much as one."""
    noise_px = 10.0
    limit_px = MAX_CHANCE * noise_px / 2
    assert limit_px > max(MIN_MOTION_PX, MOTION_NOISE * noise_px)
    shift = np.array([0.0, 0.3, -0.7, 0.1]) * share * limit_px
    monkeypatch.setattr(match, "frame_shifts", lambda *given: (np.arange(4), shift, noise_px))
    centroids = SimpleNamespace(pose=np.zeros(16, dtype=int), x_px=None, y_px=None)
    data = FewDots(count=16, centroids=centroids)
    if share < 1:
        match.refuse_motion(data)
    else:
        words = refusal(match.refuse_motion, data)
        assert "in x between frames 1 and 2" in words


@pytest.mark.parametrize(("fitting", "is_found"), [(20, True), (13, True), (11, False)])
def test_a_map_that_less_than_a_third_of_many_dots_fit_is_none(monkeypatch, rng, fitting, is_found):
    """36 decoded dots, of which the first stand where a map has them."""
    x_px, y_px = rng.uniform(0, 1000, (2, 36))
    u, v = x_px / 2000 - 0.2, y_px / 2000 + 0.1
    u[fitting:], v[fitting:] = rng.uniform(-0.5, 0.5, (2, 36 - fitting))
    decoded = SimpleNamespace(x_px=u, y_px=v, dot=np.arange(36))
    monkeypatch.setattr(match, "decode", lambda plan, seen: decoded)
    plan = SimpleNamespace(x_px=x_px, y_px=y_px, extent_px=100.0)
    nominal = SimpleNamespace(tracker=SimpleNamespace(tangents=lambda x, y: (x, y)))
    found = match._map_of(plan, nominal, None, rng)
    assert (found is not None) == is_found
    if is_found:
        np.testing.assert_allclose(found @ [0.05, -0.1, 1.0], [500, -400, 1.0], atol=3.0)
