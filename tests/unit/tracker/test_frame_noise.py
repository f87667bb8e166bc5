"""A frame's random numbers, by pushing what they are made of through the same arithmetic: exact,
without sampling.

`python -m tests.unit.tracker.test_frame_noise` prints the errors by mean.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtr

from hilstar.basics.errors import InputError
from hilstar.tracker import frame_noise
from hilstar.tracker.detector import Detector
from hilstar.tracker.frame_noise import draw_blocks, normal_pairs, poisson
from hilstar.tracker.settings import DetectorSettings

# The limits, for means from 0.01 to 1e5 e-.
CDF_ERROR = 3e-4
MOMENT_ERROR = 1e-4
TAIL_ERROR = 0.05
TAIL = 2.87e-7  # 5 sigmas
# What is exact rounds the normal number to float32: 2.4e-7 of up to 5 sigmas, times the density;
# and 24 bits of a share.
FLOAT32_CDF_ERROR = 2e-7
MEANS_E = (0.01, 0.3, 1.0, 2.5, 7.99, 8.0, 20.5, 63.9, 64.0, 100.0, 1000.0, 1e5)
NUMBERS_END = 6.77


@dataclass
class PoissonErrors:
    """Of the law that `poisson` keeps: largest error of its CDF, relative ones of mean, variance
    and tails to 5 sigmas.
    """

    cdf: float
    mean: float
    variance: float
    tail: float


def poisson_errors(mean_e: float) -> PoissonErrors:
    """From the normal number at which each count gives way to the next, by bisection."""
    mean_e = float(np.float32(mean_e))
    reach = 7 * math.sqrt(mean_e) + 12
    count = np.arange(max(0, math.floor(mean_e - reach)), math.ceil(mean_e + reach))
    low, high = (
        np.full(len(count), -NUMBERS_END, dtype=np.float32),
        np.full(len(count), NUMBERS_END, dtype=np.float32),
    )
    means = np.full(len(count), mean_e, dtype=np.float32)
    for _ in range(40):
        middle = (low + high) / 2
        above = poisson(means, middle) > count
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    cdf, exceeds = ndtr(low.astype(float)), ndtr(-low.astype(float))
    wanted, wanted_exceeds = stats.poisson.cdf(count, mean_e), stats.poisson.sf(count, mean_e)
    moment = count[0] + exceeds.sum()
    square = (exceeds * (2 * (count - count[0]) + 1)).sum()
    tails = [
        np.abs(ours[theirs > TAIL] / theirs[theirs > TAIL] - 1).max(initial=0.0)
        for ours, theirs in ((cdf, wanted), (exceeds, wanted_exceeds))
    ]
    return PoissonErrors(
        cdf=float(np.abs(cdf - wanted).max()),
        mean=float(abs(moment / mean_e - 1)),
        variance=float(abs((square - (moment - count[0]) ** 2) / mean_e - 1)),
        tail=float(max(tails)),
    )


@pytest.mark.parametrize("mean_e", MEANS_E)
def test_counts_keep_poissons_law_to_five_sigmas(mean_e):
    errors = poisson_errors(mean_e)
    assert errors.cdf < (FLOAT32_CDF_ERROR if mean_e < frame_noise.EXACT_BELOW_E else CDF_ERROR)
    assert errors.mean < MOMENT_ERROR
    assert errors.variance < MOMENT_ERROR
    assert errors.tail < TAIL_ERROR


def test_the_expansion_alone_fails_the_limits_below_its_range(monkeypatch):
    monkeypatch.setattr(frame_noise, "EXACT_BELOW_E", 0.0)
    for mean_e in (12.0, 50.0):
        assert poisson_errors(mean_e).tail > TAIL_ERROR


def test_counts_rise_with_their_number_for_every_mean():
    # Bisection sees one step of each count; between table and expansion, doubt and none, there
    # could be others.
    number = np.linspace(-NUMBERS_END, NUMBERS_END, 20_001, dtype=np.float32)
    for mean_e in (0.0, 0.005, 0.7, 3.3, 7.999, 8.001, 11.0, 63.0, 65.0):
        counts = poisson(np.full_like(number, mean_e), number)
        assert (np.diff(counts) >= 0).all()
        assert counts[0] >= 0


def test_a_cell_of_the_table_holds_at_most_two_counts_within_three_sigmas():
    # The rule by which `poisson` takes one step and no second look there.
    step = frame_noise._count_table().step_number.reshape(-1, frame_noise.UNSURE)
    later, earlier = step[1:, 1:], step[:-1, :-1]
    assert (later - earlier)[np.abs(earlier) < 3.1].min() > 1.2 / frame_noise.COLUMNS_PER_SIGMA


def test_a_part_of_faint_and_bright_pixels_counts_each_as_if_alone():
    rng = np.random.default_rng(1)
    mean_e = np.exp(rng.uniform(-5, 9, (50, 60))).astype(np.float32)
    number = rng.standard_normal((50, 60), dtype=np.float32)
    wanted = stats.poisson.ppf(ndtr(number.astype(float)), mean_e.astype(float))
    counts = poisson(mean_e, number)
    exact = mean_e < frame_noise.EXACT_BELOW_E
    np.testing.assert_array_equal(counts[exact], wanted[exact])
    # At a step, float32 and the expansion may take the count beside it: 0.01 e- off, of one, is one
    # pixel in 100 at most.
    assert np.abs(counts - wanted).max() <= 1
    assert (counts != wanted).mean() < 0.01


def test_words_make_two_independent_normal_numbers():
    steps = 1 << 9
    share = (np.arange(steps, dtype=np.uint64) * 2 + 1) << np.uint64(22)
    radius, angle = (part.ravel().astype(np.uint32) for part in np.meshgrid(share, share))
    pair = np.array(normal_pairs(np.concatenate([radius, angle]).view(np.int64)), dtype=np.float64)
    assert pair.shape == (2, steps * steps)
    for number in pair:
        grid = np.linspace(-3, 3, 61)
        # A midpoint rule of 512 radii and 512 angles.
        assert (
            np.abs(np.searchsorted(np.sort(number), grid) / number.size - ndtr(grid)).max() < 1e-3
        )
        assert number.mean() == pytest.approx(0.0, abs=1e-6)
        assert number.std() == pytest.approx(1.0, abs=5e-4)
    assert np.mean(pair[0] * pair[1]) == pytest.approx(0.0, abs=1e-6)
    assert np.mean(pair[0] ** 2 * pair[1] ** 2) == pytest.approx(1.0, abs=0.01)


def test_the_tail_of_the_normal_numbers_is_right_at_five_and_six_sigmas():
    angles = 64
    angle = (np.arange(angles, dtype=np.uint64) * 2 + 1) << np.uint64(25)
    smallest = np.arange(16_384, dtype=np.uint64)  # every radius beyond 4.99 sigmas
    radius, turn = (part.ravel().astype(np.uint32) for part in np.meshgrid(smallest, angle))
    number, _ = normal_pairs(np.concatenate([radius, turn]).view(np.int64))
    for sigmas in (5.0, 6.0):
        assert (number > sigmas).sum() / angles / 2**32 == pytest.approx(ndtr(-sigmas), rel=0.01)


def test_every_word_has_a_number():
    ends = np.array([0, 2**32 - 1], dtype=np.uint32)
    numbers = normal_pairs(np.concatenate([np.repeat(ends, 2), np.tile(ends, 2)]).view(np.int64))
    assert np.isfinite(numbers).all()
    assert np.abs(numbers).max() < NUMBERS_END


def test_one_seed_gives_one_frame_on_any_number_of_threads(monkeypatch):
    settings = DetectorSettings(
        gain_e_per_dn=1.0,
        bits=16,
        offset_dn=100.0,
        read_noise_e=5.0,
        dark_e_per_s=30.0,
        blooming=True,
    )
    detector = Detector(settings, (700, 401))
    mean_e = np.random.default_rng(1).uniform(0, 200, (401, 700))
    frames = []
    for threads in ("1", "3", "2,1", "many"):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        frames.append(detector.expose(mean_e, 1.0, np.random.default_rng(2)))
    for frame in frames[1:]:
        np.testing.assert_array_equal(frame, frames[0])
    # And a second frame of the same generator is another one.
    assert (detector.expose(mean_e, 1.0, np.random.default_rng(3)) != frames[0]).mean() > 0.9


@pytest.mark.parametrize(
    ("stated", "threads"), [("1", []), ("3", [3]), ("0", [4]), ("2,8", [2]), ("", [4]), ("9", [5])]
)
def test_blocks_have_the_threads_that_are_stated_or_one_for_each_core(monkeypatch, stated, threads):
    """Of five blocks, where there are four cores; a single thread is this one."""
    made, drawn = [], []

    class Pool(ThreadPoolExecutor):
        def __init__(self, count):
            made.append(count)
            super().__init__(count)

    monkeypatch.setattr(frame_noise, "PART_PX", 100)
    monkeypatch.setattr(frame_noise, "ThreadPoolExecutor", Pool)
    monkeypatch.setattr(frame_noise.os, "sched_getaffinity", lambda process: {0, 1, 2, 3})
    monkeypatch.setenv("OMP_NUM_THREADS", stated)
    draw_blocks((100, 10), np.random.default_rng(1), lambda part, words: drawn.append(part.start))
    assert made == threads
    assert sorted(drawn) == list(range(0, 100, 20))


def test_words_repeat_nowhere_in_a_frame():
    seen = []
    draw_blocks(
        (500, 300),
        np.random.default_rng(1),
        lambda part, words: seen.append((part.start, words.copy())),
    )
    words = np.concatenate(
        [words.reshape(-1, 300) for _, words in sorted(seen, key=lambda item: item[0])]
    )
    assert words.shape == (500, 300)
    assert len(np.unique(words)) == words.size


def test_a_wrong_pixel_is_refused_from_every_thread(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    mean_e = np.zeros((600, 300))
    mean_e[590, 7] = math.nan
    with pytest.raises(InputError, match="NaN"):
        Detector(DetectorSettings(), (300, 600)).expose(mean_e, 1.0, np.random.default_rng(1))


def test_noise_version_1_draws_as_numpy_does():
    settings = DetectorSettings(
        noise_version=1,
        gain_e_per_dn=2.0,
        bits=16,
        offset_dn=100.0,
        read_noise_e=5.0,
        dark_e_per_s=30.0,
        prnu=0.02,
    )
    detector = Detector(settings, (60, 40))
    rng = np.random.default_rng(2)
    charge_e = rng.poisson(300.0 * detector.gain_map + detector.dark_map_e_per_s * 2.0).astype(
        float
    )
    charge_e += 5.0 * rng.standard_normal((40, 60), dtype=np.float32)
    frame = detector.expose(np.full((40, 60), 300.0), 2.0, np.random.default_rng(2))
    np.testing.assert_array_equal(frame, np.rint(charge_e / 2.0 + 100.0))


if __name__ == "__main__":
    for mean in MEANS_E:
        print(f"{mean:8g} e-  {poisson_errors(mean)}")


@pytest.mark.parametrize("few_are", ["dark", "faint", "bright", "both"])
def test_a_pixel_s_count_is_by_its_own_mean_and_number_whatever_stands_beside_it(few_are, rng):
    """Means below and above where the table ends, and none; mixed so that few or most are large:
    a pixel alone has the same count.
    """
    faint, bright = rng.uniform(0.01, 5.0, 4000), rng.uniform(200.0, 5e4, 4000)
    share = {"dark": 0.4, "faint": 0.2, "bright": 0.8, "both": 0.5}[few_are]
    mean_e = np.where(rng.uniform(size=4000) < share, faint, bright).astype(np.float32)
    if few_are == "dark":
        mean_e[rng.uniform(size=4000) < 0.7] = 0.0
    number = rng.normal(size=4000).astype(np.float32)
    # the smallest mean beside which a count is made says how far an expansion has to go
    counts = poisson(mean_e, number, 0.0)
    assert (counts[mean_e == 0] == 0).all()
    order = rng.permutation(4000)
    assert (poisson(mean_e[order], number[order], 0.0) == counts[order]).all()
    for k in range(0, 4000, 97):
        alone = poisson(mean_e[k : k + 1], number[k : k + 1], 0.0)
        assert alone[0] == counts[k]


def test_chosen_places_of_several_parts_have_the_numbers_that_all_have(rng):
    words = rng.integers(-(2**63), 2**63, size=(3, 4, 10), dtype=np.int64)
    which = np.array([0, 39, 40, 57, 119, 80, 3])
    for chosen, every in zip(normal_pairs(words, which), normal_pairs(words), strict=True):
        assert chosen.tolist() == every.ravel()[which].tolist()


def test_the_faintest_word_s_radius_is_the_largest_and_its_angle_goes_all_round():
    """Box and Muller 1958, by the first half of the words a radius, sqrt(-2 ln((k + 1/2) / 2^32)),
    and by the second an angle of -pi to pi; float32 rounds the largest half to 2^32.
    """
    radii = np.array([0, 1, 2**31, 2**32 - 1], dtype=np.uint32)
    angles = np.array([0, 2**30, -(2**31), -(2**29)], dtype=np.int32)
    words = np.concatenate([radii, angles.view(np.uint32)]).view(np.int64)
    first, second = normal_pairs(words)
    radius = np.sqrt(-2 * np.log((radii + 0.5) / 2**32))
    angle = angles / 2**31 * np.pi
    assert first == pytest.approx(radius * np.cos(angle), abs=2e-5)
    assert second == pytest.approx(radius * np.sin(angle), abs=2e-5)
