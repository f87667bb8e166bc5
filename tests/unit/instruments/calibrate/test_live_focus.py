"""Live focus: planted widths of a lens whose ring is turned, motion, and saturation."""

from __future__ import annotations

import itertools
import json
import time
from contextlib import ExitStack, closing
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.instruments.calibrate.first_light.focus import Sharpness
from hilstar.instruments.calibrate.first_light.image_sources import ImageSource, VirtualBench
from hilstar.instruments.calibrate.live_focus import focus_readings, follow_answers, streak
from hilstar.server.answers.answer import Answer
from hilstar.server.answers.star_widths import FocusCurve, sparkline
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.benches import TWIN, bench_text
from tests.support.closed_camera import ClosedCamera, closed_context, power_of
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.fake_clock import FakeClock
from tests.support.refusals import refusal
from tests.support.senders import answers_over_udp, free_port

RING_PX = (3.0, 2.0, 1.4, 1.0, 0.8, 1.1, 1.6)  # sigma of the PSF as the ring is turned
BEST = 5  # the image of the sharpest
SURE_SIGMAS = 4.0
EXPOSURE_S = 0.005  # no dot saturates the tracker
NOISE = {"gain_e_per_dn": 8.0, "read_noise_e": 12.0, "full_well_e": 30_000.0, "offset_dn": 40.0}


class Ring(ImageSource):
    """A virtual bench for each place of the ring, one after another; the last stays."""

    sets_exposure = True

    def __init__(self, benches):
        self._benches = benches
        self._looks = 0

    def look(self, file, pattern, stem, exposure_s):
        place = max(0, self._looks - 1)  # the first look is the dark frame
        self._looks += 1
        return self._benches[min(place, len(self._benches) - 1)].look(
            file, pattern, stem, exposure_s
        )


class Shaken(VirtualBench):
    """A virtual bench whose second image is of a tracker that moves over 4 px to the right."""

    looks = 0

    def look(self, file, pattern, stem, exposure_s):
        self.looks += 1
        return super().look(file, pattern, stem, exposure_s)

    def pixels(self, path, resolution_px):
        image = super().pixels(path, resolution_px)
        if self.looks == 3:
            image = np.mean([np.roll(image, k, axis=1) for k in range(5)], axis=0)
        return image


@pytest.fixture
def benches(tmp_path):
    """The bench file, and a truth file for a width of the PSF."""

    def truth(sigma_px):
        path = tmp_path / f"truth-{sigma_px}.toml"
        tracker = {"psf_sigma_px": [sigma_px, sigma_px]}
        path.write_text(bench_text(TWIN, {"tracker": tracker, "tracker.detector": NOISE}))
        return read_bench_file(path)

    return truth(1.0), truth


def readings(file, source, folder, count):
    """The first readings, and the curve after them."""
    curve = FocusCurve()
    lines = []
    images = focus_readings(file, source, folder, EXPOSURE_S)
    for _ in range(count):
        curve.add(next(images))
        lines.append(curve.line())
    return curve, lines


def test_the_sharpest_place_of_the_ring_is_the_best(benches, tmp_path):
    file, truth = benches
    with ExitStack() as stack:
        places = [
            stack.enter_context(closing(VirtualBench(file, truth(sigma), 0))) for sigma in RING_PX
        ]
        curve, lines = readings(file, Ring(places), tmp_path, len(RING_PX))
    for reading, sigma_px in zip(curve.readings, RING_PX, strict=True):
        assert reading.figure is not None, reading.why
        off_px = reading.figure.psf_sigma_px - sigma_px
        assert abs(off_px) < SURE_SIGMAS * reading.figure.error_px
    assert curve.best is curve.readings[BEST - 1]
    assert "the best so far" in lines[BEST - 1]
    assert "best 0.8" in lines[-1]


def test_an_image_of_a_tracker_that_moves_is_named_and_is_no_best(benches, tmp_path):
    file, truth = benches
    with closing(Shaken(file, truth(1.0), 0)) as source:
        curve, lines = readings(file, source, tmp_path, 3)
    still, moved, after = (reading.figure for reading in curve.readings)
    assert still and moved and after
    assert moved.streak_px == pytest.approx(np.sqrt(12 * 2), rel=0.1)  # the variance of 0 to 4 is 2
    assert min(moved.streak_deg, 180 - moved.streak_deg) < 5
    assert max(still.streak_px, after.streak_px) < 1.0
    assert "hold the tracker still" in lines[1]
    assert curve.best is not curve.readings[1]


def test_dots_that_saturate_have_no_figure_and_are_dimmed(benches, tmp_path):
    file, truth = benches
    with closing(VirtualBench(file, truth(1.0), 0)) as source:
        images = focus_readings(file, source, tmp_path, 1.0)
        begin_s = time.monotonic()
        reading = next(images)
        # by the clock of the readings, which begins with them
        assert 0 < reading.t_s <= time.monotonic() - begin_s
        assert reading.figure is None and "saturate" in reading.why
        assert next(images).code < reading.code == 2**10 - 1


def test_a_pattern_is_shown_to_its_watcher_once_and_images_are_read_as_they_come(tmp_path):
    """Of a screen whose dots saturate the tracker in their first codes."""
    camera = ClosedCamera(power_of(2.2), 400_000.0)
    file = closed_context(tmp_path, camera).file
    watched = []
    images = focus_readings(file, camera, tmp_path, 0.1, watched.append)
    readings = [next(images) for _ in range(6)]
    codes = [reading.code for reading in readings]
    *bright, settled = dict.fromkeys(codes)
    assert bright[0] == 1023 and bright == sorted(bright, reverse=True)
    assert codes == [*bright, *[settled] * (6 - len(bright))]
    assert [int(pattern.codes.max()) for pattern in watched] == [*bright, settled]
    assert [reading.figure is None for reading in readings] == [code in bright for code in codes]
    assert [reading.number for reading in readings] == [1, 2, 3, 4, 5, 6]


def test_the_command_ends_with_the_best_image(benches, tmp_path):
    _, truth = benches
    bench = tmp_path / "truth-1.0.toml"
    words = ("--images", "3", "--exposure", str(EXPOSURE_S), "--json")
    done = run_hilstar_here("calibrate", "focus", bench, "--virtual", truth(1.4).path, *words)
    assert done.returncode == 0, done.stderr
    *figures, last = [json.loads(line) for line in done.stdout.splitlines()]
    best = last["best"]["figure"]
    assert [figure["number"] for figure in figures] == [1, 2, 3]
    # with the bench file's exposure the first dots saturate the tracker
    assert all(figure["figure"] is not None for figure in figures)
    assert abs(best["psf_sigma_px"] - 1.4) < SURE_SIGMAS * best["error_px"]


@pytest.mark.parametrize(
    ("words", "advice"),
    [
        (("calibrate", "focus", "BENCH", "--grab", "true {output}"), "{pattern} in --grab"),
        (("first-light", "BENCH", "-o", "OUT", "--grab", "true {output}"), "{pattern} in --grab"),
        (("serve", "BENCH", "--frames", "1"), "run with --headless"),
    ],
)
def test_a_machine_without_a_display_is_told_what_the_command_can_do_without_one(
    benches, tmp_path, monkeypatch, words, advice
):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    places = {"BENCH": tmp_path / "truth-1.0.toml", "OUT": tmp_path / "out"}
    done = run_hilstar_here(*[places.get(word, word) for word in words])
    assert done.returncode in {1, 3}  # 1: a step of first light that failed
    assert "no display to open a window on; set DISPLAY, or " in done.stderr
    assert advice in done.stderr
    assert ("--headless" in done.stderr) == ("--headless" in advice)


ANSWERS = '[answers]\nsource = "udp"\nbind = "127.0.0.1:PORT"\nclock = "host"\nformat = "json"\n'
SKY = ("--radec", "84,-1,0", "--headless", "--feed", "tcp://127.0.0.1:*")


def a_tracker_that_answers(port, star):
    """Twenty answers a second of five stars like `star`, until the block ends."""
    answer = json.dumps({"t_ns": 1, "centroids": [star] * 5}).encode()
    return answers_over_udp(port, itertools.repeat(answer))


@pytest.fixture
def answering_bench(tmp_path):
    """A bench file whose tracker answers to a free port, and that port."""
    port = free_port()
    path = tmp_path / "bench.toml"
    path.write_text(bench_text(TWIN) + ANSWERS.replace("PORT", str(port)))
    return path, port


@pytest.mark.e2e
def test_the_command_measures_the_focus_by_answers_widths(answering_bench):
    bench, port = answering_bench
    with a_tracker_that_answers(port, [30.0, 40.0, 900.0, None, 1.75]):
        words = ("--answers", *SKY, "--images", "2", "--json")
        done = run_hilstar_here("calibrate", "focus", bench, *words)
    assert done.returncode == 0, done.stderr
    *figures, last = [json.loads(line) for line in done.stdout.splitlines()]
    assert [figure["number"] for figure in figures] == [1, 2]
    assert last["best"]["figure"]["psf_sigma_px"] == 1.75
    assert last["best"]["figure"]["dots"] % 5 == 0


@pytest.mark.e2e
def test_a_tracker_whose_answers_have_no_widths_is_refused_in_one_line(answering_bench):
    bench, port = answering_bench
    with a_tracker_that_answers(port, [30.0, 40.0, 900.0, 26311]):
        done = run_hilstar_here("calibrate", "focus", bench, "--answers", *SKY)
    assert done.returncode == 2
    *before, line = done.stderr.splitlines()
    assert [each.partition(" ")[0] for each in before] == ["frames:"]
    assert "--answers: the tracker's answers report no widths of stars; give --grab CMD" in line


def refused_as_silent(source: SimpleNamespace, clock: FakeClock) -> str:
    """What is said in the end of answers of which none has a star; a frame takes a second."""

    def hold(done):
        while not done():
            clock.work(1e9)

    return refusal(follow_answers, source, hold, lambda reading: False, lambda: False, clock)


def test_silence_ends_after_a_while_and_says_whose():
    source = SimpleNamespace(take=list, trouble=lambda: "", unread="the reader starts again")
    assert "no answer in 30 s: the reader starts again" in refused_as_silent(source, FakeClock())


def test_silence_counts_from_the_last_answer():
    """One each 25 s for 100 s, of no star; the line is silent after that."""
    clock = FakeClock()
    begun_ns = clock.ns
    times_ns = [begun_ns + 25 * k * 10**9 for k in range(5)]

    def take():
        due = [at for at in times_ns if at <= clock.ns]
        del times_ns[: len(due)]
        return [Answer(at, b"") for at in due]

    source = SimpleNamespace(take=take, trouble=lambda: "unplugged", unread="")
    assert "no answer in 30 s: unplugged" in refused_as_silent(source, clock)
    assert (clock.ns - begun_ns) / 1e9 == pytest.approx(130, abs=2)


def test_a_curve_is_as_high_as_its_values():
    assert sparkline([3.0, 2.0, 1.0, 2.0, 3.0], 0.1) == "█▅▁▅█"
    assert sparkline([1.0, 1.01], 0.1) == "▁▂"
    assert sparkline([1.5, 1.5], 0.0) == "▁▁"


def dragged_dots(length_px: float, angle_deg: float, sigma_px: float = 1.2):
    """An image (80, 120) of Gaussian dots, each drawn out evenly, and the places of their middles."""
    x_px = np.array([15.3, 40.0, 66.7, 100.45])
    y_px = np.array([14.6, 60.2, 33.0, 48.55])
    rows, columns = np.mgrid[:80, :120]
    image = np.full(rows.shape, 7.0)
    angle = np.radians(angle_deg)
    for step in np.linspace(-0.5, 0.5, 41) * length_px:
        for x, y in zip(x_px, y_px, strict=True):
            across = columns - x - step * np.cos(angle)
            down = rows - y - step * np.sin(angle)
            image += np.exp(-(across**2 + down**2) / (2 * sigma_px**2)) / 41
    sharp = Sharpness(x_px, y_px, np.full(4, sigma_px), 2 * sigma_px, 0.0, 0.0, 0.0)
    return image, sharp


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, 135.0])
def test_a_streak_has_the_length_and_the_direction_of_the_motion(angle_deg):
    """Wherever in their pixels dots are; a window of three sigmas cuts 1 % off."""
    length_px, found_deg = streak(*dragged_dots(3.0, angle_deg))
    assert length_px == pytest.approx(3.0, rel=0.03)
    off_deg = (found_deg - angle_deg + 90) % 180 - 90
    assert abs(off_deg) < 1.0


def test_round_dots_are_no_streak_wherever_in_their_pixels_they_are():
    length_px, _ = streak(*dragged_dots(0.0, 0.0))
    assert length_px < 0.2


def test_a_virtual_bench_has_no_patterns_to_hand_on(benches, tmp_path):
    _, truth = benches
    bench = tmp_path / "truth-1.0.toml"
    words = ("--virtual", truth(1.4).path, "--feed", f"tcp://127.0.0.1:{free_port()}")
    refused = run_hilstar_here("calibrate", "focus", bench, *words)
    assert_refused(refused, 2, "--feed", "shows nothing here")
