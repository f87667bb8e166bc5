"""The virtual bench of first light against a camera in closed form, pixel by pixel within the
detector's noise; and images that a person saves.
"""

from __future__ import annotations

import logging
import math
import os
import time

import numpy as np
import pytest

from hilstar.display.calibration import with_uniformity
from hilstar.display.quantise import LitLight
from hilstar.instruments.calibrate.first_light.image_sources import (
    BlackImages,
    ByHand,
    MaskImages,
    Pattern,
    PatternFrames,
    VirtualBench,
    mean_light,
    off_screen,
    on_screen,
    refuse_other_bench,
    virtual_diode,
)
from hilstar.optics.scan import Orientation
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from tests.support.benches import bench_text
from tests.support.closed_camera import (
    ACROSS,
    BITS,
    CLOSED,
    DETECTOR_PX,
    DOWN,
    EXPOSURE_S,
    GAIN_E_PER_DN,
    OFFSET_DN,
    READ_DN,
    SCREEN_PX,
    power_of,
)
from tests.support.refusals import refusal
from tests.support.spectra import bump, write_channels, write_panel

WHITE_E_PER_S = float(CLOSED["render"]["flux_at_white_e_per_s"])
WHITE = 2**BITS - 1
LIGHT = power_of(2.2)
BENCH = {"monitor": {"calibration": "gamma2.2"}}
# A mean square of 11 408 pixels is known to 1.3 %; the drawing itself is right to 1e-4 of its light.
CHI2 = 0.06


def bench(folder, name, *changes) -> BenchFile:
    path = folder / f"{name}.toml"
    path.write_text(bench_text(CLOSED, BENCH, *changes))
    return read_bench_file(path)


@pytest.fixture
def sources(tmp_path):
    """Opens virtual benches of a truth, by a bench file that knows less."""
    opened = []

    def made(*changes, filed=()) -> VirtualBench:
        opened.append(
            VirtualBench(bench(tmp_path, "filed", *filed), bench(tmp_path, "true", *changes), 3)
        )
        return opened[-1]

    yield made
    for source in opened:
        source.close()


def image_of(source: VirtualBench, folder, pattern: Pattern, exposure_s=EXPOSURE_S, filed=()):
    path = source.look(bench(folder, "filed", *filed), pattern, folder / pattern.name, exposure_s)
    return source.pixels(path, DETECTOR_PX)


def chi2(image: np.ndarray, light: np.ndarray, exposure_s=EXPOSURE_S) -> float:
    """The mean square of an image's differences from the closed form of this light, relative to
    white, in sigmas of photons, read noise and rounding.
    """
    electrons = DOWN @ light @ ACROSS.T * WHITE_E_PER_S * exposure_s
    mean_dn = OFFSET_DN + electrons / GAIN_E_PER_DN
    sigma_dn2 = electrons / GAIN_E_PER_DN**2 + READ_DN**2 + 1 / 12
    return float((((image - mean_dn) ** 2) / sigma_dn2).mean())


def squares(rng, count=40) -> np.ndarray:
    """Codes of squares here and there, none symmetric to another."""
    codes = np.zeros(SCREEN_PX[::-1], dtype=np.uint16)
    for _ in range(count):
        y, x = rng.integers(0, SCREEN_PX[1] - 3), rng.integers(0, SCREEN_PX[0] - 3)
        codes[y : y + 3, x : x + 2] = rng.integers(100, 900)
    return codes


@pytest.mark.parametrize("exposure_s", [EXPOSURE_S, 0.03])
def test_an_image_is_the_closed_form_s_within_its_noise(sources, tmp_path, rng, exposure_s):
    source = sources()
    codes = squares(rng)
    image = image_of(source, tmp_path, Pattern("squares", codes), exposure_s)
    assert chi2(image, LIGHT[codes], exposure_s) == pytest.approx(1.0, abs=CHI2)
    # and none of a pattern that stands a pixel beside
    assert chi2(image, LIGHT[np.roll(codes, 1, axis=1)], exposure_s) > 5
    assert chi2(image, LIGHT[np.roll(codes, 1, axis=0)], exposure_s) > 5
    # one level is drawn once and scaled for others, of another code and of another place
    for name, level in (("first", 300), ("second", 700)):
        mask = np.where(codes > 0, level, 0).astype(np.uint16)
        again = image_of(source, tmp_path, Pattern(name, mask), exposure_s)
        assert chi2(again, LIGHT[mask], exposure_s) == pytest.approx(1.0, abs=CHI2)


def test_the_screen_s_own_black_and_light_against_place_are_in_its_images(sources, tmp_path, rng):
    """A black screen glows, one that is switched off does not."""
    y, x = np.mgrid[-1 : 1 : SCREEN_PX[1] * 1j, -1 : 1 : SCREEN_PX[0] * 1j]
    even = 1 - 0.3 * x + 0.2 * y
    even /= even.max()
    head = (
        'kind = "photometric"\nwho = ""\nwhen = ""\ninstrument = ""\nunit = ""\n'
        f'bits = {BITS}\nresponse = "light.csv"\n'
    )
    rows = [f"{code},{float(value)!r}" for code, value in enumerate(0.999 * LIGHT + 1e-3)]
    (tmp_path / "light.csv").write_text("\n".join(["code,w", *rows]))
    (tmp_path / "black.toml").write_text(f"[calibration]\n{head}")
    with_uniformity(str(tmp_path / "black.toml"), BITS, tmp_path / "uneven.toml", even)
    source = sources({"monitor": {"calibration": "uneven.toml"}})
    codes = squares(rng)
    # white is the sum of its light and of black
    light = (LIGHT[codes] + 1e-3 / 0.999) * even
    image = image_of(source, tmp_path, Pattern("squares", codes))
    assert chi2(image, light) == pytest.approx(1.0, abs=CHI2)
    dark = image_of(source, tmp_path, Pattern("black", np.zeros_like(codes)))
    assert chi2(dark, 1e-3 / 0.999 * even) == pytest.approx(1.0, abs=CHI2)
    unlit = source.pixels(source.unlit(tmp_path / "unlit"), DETECTOR_PX)
    assert chi2(unlit, 0 * even) == pytest.approx(1.0, abs=CHI2)
    assert dark.mean() - unlit.mean() == pytest.approx(
        (DOWN @ even @ ACROSS.T).mean() * 1e-3 * WHITE_E_PER_S * EXPOSURE_S / GAIN_E_PER_DN,
        rel=0.05,
    )


def test_light_of_the_sky_and_of_black_grows_with_the_exposure_and_black_with_the_warmth(
    sources, tmp_path
):
    """Before the first image's end a screen has 0.6 of its light; the sky is not its."""
    virtual = {"warm_up_min": 1e3, "cold_percent": 40.0, "drift_percent_per_h": 0.0}
    filed = {"monitor": {"calibration": "gamma2.2"}}
    black = np.zeros(SCREEN_PX[::-1], dtype=np.uint16)
    head = 'kind = "photometric"\nwho = ""\nwhen = ""\ninstrument = ""\nunit = ""\n'
    rows = [f"{code},{float(value)!r}" for code, value in enumerate(0.99 * LIGHT + 0.01)]
    (tmp_path / "light.csv").write_text("\n".join(["code,w", *rows]))
    table = f'[calibration]\n{head}bits = {BITS}\nresponse = "light.csv"\n'
    (tmp_path / "black.toml").write_text(table)
    source = sources(
        {"monitor": {"calibration": "black.toml"}},
        {"certify.virtual": virtual},
        {"background": {"electrons_per_px": 400.0}},
        filed=[filed],
    )
    unlit_dn = source.pixels(source.unlit(tmp_path / "unlit"), DETECTOR_PX).mean() - OFFSET_DN
    # 400 e- in the bench's exposure; 11 408 pixels of 4 e- of noise and photons: 0.1 DN
    assert unlit_dn == pytest.approx(400.0 / GAIN_E_PER_DN, abs=0.5)
    glow_e_per_s = (DOWN @ np.ones(SCREEN_PX[::-1]) @ ACROSS.T).mean() * 0.01 * WHITE_E_PER_S
    for name, exposure_s in (("short", 0.05), ("long", 0.3)):
        image = image_of(source, tmp_path, Pattern(name, black), exposure_s)
        electrons = (400.0 / EXPOSURE_S + 0.6 * glow_e_per_s) * exposure_s
        dn = electrons / GAIN_E_PER_DN
        assert image.mean() - OFFSET_DN == pytest.approx(dn, rel=3e-3)


def test_an_image_that_is_taken_again_has_its_noise_and_one_of_another_folder_has_not(
    sources, tmp_path
):
    source = sources()
    codes = np.zeros(SCREEN_PX[::-1], dtype=np.uint16)
    images = []
    for folder in ("a", "b", "a"):
        (tmp_path / folder).mkdir(exist_ok=True)
        file = bench(tmp_path, "filed")
        stem = tmp_path / folder / "frame_000"
        path = source.look(file, Pattern("frame_000", codes), stem, EXPOSURE_S)
        images.append(source.pixels(path, DETECTOR_PX))
    np.testing.assert_array_equal(images[0], images[2])
    assert (images[0] != images[1]).mean() > 0.5


def test_frames_are_shown_in_turn_for_as_long_as_the_exposure_lasts(sources, tmp_path, rng):
    """Three refreshes of 60 Hz of two frames: the first twice."""
    rate = {"monitor": {"refresh_hz": 60.0}}
    source = sources(rate, filed=[rate])
    first, second = squares(rng), squares(rng)
    pattern = Pattern("frames", first, (second,))
    image = image_of(source, tmp_path, pattern, 0.05, [rate])
    light = (2 * LIGHT[first] + LIGHT[second]) / 3
    assert chi2(image, light, 0.05) == pytest.approx(1.0, abs=CHI2)


def test_a_screen_that_is_mounted_otherwise_shows_its_codes_otherwise(sources, tmp_path, rng):
    """The truth's image is what its own mounting takes off the screen."""
    turned = {"monitor": {"resolution_px": list(SCREEN_PX), "flip_x": True, "rotate_deg": 180}}
    source = sources(turned)
    codes = squares(rng)
    image = image_of(source, tmp_path, Pattern("squares", codes))
    # mirrored left to right and then turned by half: its rows reversed
    assert chi2(image, LIGHT[codes[::-1]]) == pytest.approx(1.0, abs=CHI2)


def test_primaries_add_up_to_their_own_light(sources, tmp_path, rng):
    """Three channels of their own powers and shares, in a colour each."""
    signal = np.arange(WHITE + 1) / WHITE
    shares = np.array([0.2, 0.7, 0.1])
    powers = [2.0, 2.2, 2.5]
    tables = [share * signal**power for share, power in zip(shares, powers, strict=True)]
    rows = [
        ",".join([str(code), *[repr(float(table[code] + 1e-12)) for table in tables]])
        for code in range(WHITE + 1)
    ]
    (tmp_path / "light.csv").write_text("\n".join(["code,r,g,b", *rows]))
    head = (
        'kind = "photometric"\nwho = ""\nwhen = ""\ninstrument = ""\nunit = ""\n'
        f'bits = {BITS}\nresponse = "light.csv"\n'
    )
    (tmp_path / "colours.toml").write_text(f"[calibration]\n{head}")
    source = sources({"monitor": {"calibration": "colours.toml"}})
    codes = np.stack([squares(rng), squares(rng), squares(rng)], axis=2)
    image = image_of(source, tmp_path, Pattern("colours", codes))
    light = sum(table[codes[..., place]] for place, table in enumerate(tables))
    assert chi2(image, light) == pytest.approx(1.0, abs=CHI2)


def test_a_cold_monitor_is_brighter_or_darker_by_its_own_clock(sources, tmp_path):
    """Each image takes as long as the truth says, and is of its own middle."""
    virtual = {
        "warm_up_min": 2.0,
        "cold_percent": 40.0,
        "drift_percent_per_h": 5.0,
        "seconds_a_reading": 4.0,
    }
    source = sources({"certify.virtual": virtual})
    codes = np.zeros(SCREEN_PX[::-1], dtype=np.uint16)
    codes[40:60, 30:70] = 900
    means = []
    middles_s = []
    for number in range(3):
        assert source.clock_ns() == pytest.approx(number * 34e9, abs=10)
        middles_s.append(number * 34 + 2)
        image = image_of(source, tmp_path, Pattern(f"light_{number}", codes))
        means.append(image.mean() - OFFSET_DN)
        source.hold(None, None, 30.0)
    whole = (DOWN @ LIGHT[codes] @ ACROSS.T).mean() * WHITE_E_PER_S * EXPOSURE_S / GAIN_E_PER_DN
    for mean, at_s in zip(means, middles_s, strict=True):
        warmth = 1 - 0.4 * math.exp(-at_s / 120) + 0.05 * at_s / 3600
        # 3 million photons: 0.06 %; two seconds of the exponential are 0.7 %
        assert mean == pytest.approx(whole * warmth, rel=3e-3)


def test_a_virtual_diode_sees_the_true_delay_and_the_way_of_the_scan(tmp_path, rng):
    monitor = {"photodiode_px": 16, "refresh_hz": 50.0, "scanout_ms": 8.0}
    file = bench(tmp_path, "filed", {"monitor": monitor})
    truth = bench(
        tmp_path,
        "true",
        {"monitor": monitor | {"photodiode_px": 0, "panel_delay_ms": 11.0}},
        {"certify.virtual": {"delay_noise_ms": 0.05}},
    )
    seen = virtual_diode(file, truth, 4.0, rng)
    late_ms = (seen.seen.host_ns - seen.shown.host_ns) / 1e6
    # its middle is 8 px above the foot of 96 rows
    assert late_ms.mean() == pytest.approx(11.0 + 8.0 * (1 - 8 / 96), abs=0.02)
    assert late_ms.std() == pytest.approx(0.05, rel=0.3)
    assert seen.seen.level.tolist() == seen.shown.level.tolist()
    assert 40 < len(late_ms) < 200
    assert np.ptp(seen.shown.host_ns) < 4e9


@pytest.mark.parametrize(
    ("filed", "true", "words"),
    [
        (
            {},
            {"monitor": {"resolution_px": [96, 120]}},
            "96 x 120 px and the bench file's is 120 x 96",
        ),
        ({}, {"monitor": {"bits": 8}}, "bits = 8 and the bench file says 10"),
        (
            {"monitor": {"bits": 8}},
            {"monitor": {"bits": 10}},
            "bits = 10 and the bench file says 8",
        ),
        ({}, {"tracker": {"resolution_px": [124, 90]}}, "[tracker] resolution_px is not"),
        ({}, {"tracker": {"resolution_px": [120, 92]}}, "[tracker] resolution_px is not"),
        ({}, {"render": {"bit_stealing": True}}, "bit_stealing is for the bench that shows"),
    ],
)
def test_a_truth_of_another_screen_or_tracker_is_refused(tmp_path, filed, true, words):
    assert words in refusal(
        refuse_other_bench, bench(tmp_path, "filed", filed), bench(tmp_path, "true", true)
    )


def test_a_truth_whose_screen_is_turned_has_the_same_screen(tmp_path):
    turned = {"monitor": {"resolution_px": [96, 120], "rotate_deg": 90}}
    refuse_other_bench(bench(tmp_path, "filed"), bench(tmp_path, "true", turned))


def test_the_mean_of_frames_is_by_place():
    first = [LitLight(np.array([2, 7]), np.array([4.0, 1.0]))]
    second = [LitLight(np.array([7, 9]), np.array([3.0, 6.0]))]
    (mean,) = mean_light([first, second])
    assert (mean.place.tolist(), mean.e_per_s.tolist()) == ([2, 7, 9], [2.0, 2.0, 3.0])
    assert mean_light([first]) is first


def test_masks_are_kept_where_they_have_light_the_oldest_go_first():
    masks = MaskImages((6, 4), 2)
    images = {}
    for number in range(3):
        image = np.zeros((4, 6))
        image[1:3, number : number + 2] = number + 1
        images[bytes([number])] = image
        masks.keep(bytes([number]), image)
    assert [bytes([number]) in masks for number in range(3)] == [False, True, True]
    for key in (b"\x01", b"\x02"):
        np.testing.assert_array_equal(masks.image(key, 0.5), 0.5 * images[key])
    masks.keep(b"dark", np.zeros((4, 6)))
    assert not masks.image(b"dark", 3.0).any()


@pytest.mark.parametrize("quarter_turns", range(4))
@pytest.mark.parametrize(("flip_x", "flip_y"), [(False, False), (True, False), (False, True)])
def test_what_goes_onto_a_screen_comes_off_it(quarter_turns, flip_x, flip_y):
    codes = np.arange(12, dtype=np.uint16).reshape(3, 4)
    mounting = Orientation(flip_x, flip_y, quarter_turns)
    np.testing.assert_array_equal(off_screen(on_screen(codes, mounting), mounting), codes)


class Display:
    """A display that goes on until it is told that it is done, and presses keys."""

    def __init__(self, keys=(), meanwhile=lambda turn: None):
        self.keys, self.meanwhile, self.turns = list(keys), meanwhile, 0

    def show_until(self, file, pattern, done, on_key=lambda key: None):
        while not done():
            self.turns += 1
            assert self.turns < 100
            self.meanwhile(self.turns)
            if self.keys:
                on_key(self.keys.pop(0))


def by_hand(display: Display) -> ByHand:
    source = ByHand()
    source._display = display
    return source


@pytest.mark.parametrize(
    ("exposure_s", "words"), [(EXPOSURE_S, ""), (0.025, "exposed for 0.025 s")]
)
def test_a_person_is_asked_for_an_image_until_its_file_is_still(
    tmp_path, caplog, exposure_s, words
):
    stem = tmp_path / "frame_000"

    def saves(turn):
        """An empty file, then one that grows, then the same some time ago."""
        path = stem.with_suffix(".fits")
        if turn == 2:
            path.touch()
        if turn == 4:
            path.write_bytes(b"light")
        if turn == 6:
            before_s = time.time() - 5
            os.utime(path, (before_s, before_s))

    display = Display(meanwhile=saves)
    file = bench(tmp_path, "filed")
    pattern = Pattern("frame_000", np.zeros((2, 2), dtype=np.uint16))
    with caplog.at_level(logging.WARNING):
        path = by_hand(display).look(file, pattern, stem, exposure_s)
    assert (path, display.turns) == (stem.with_suffix(".fits"), 6)
    (asked,) = [record.message for record in caplog.records if "save" in record.message]
    assert f"{stem}.png" in asked and words in asked
    assert ("exposed" in asked) == bool(words)


def test_a_person_may_press_a_key_that_has_a_meaning(tmp_path, caplog):
    file = bench(tmp_path, "filed")
    pattern = Pattern("figure", np.zeros((2, 2), dtype=np.uint16))
    with caplog.at_level(logging.WARNING):
        source = by_hand(Display(keys=["x", "3"]))
        keys = {"1": "upright", "3": "turned"}
        assert source.look_or_key(file, pattern, tmp_path / "figure", keys) == "3"
    assert "    3  turned" in caplog.text
    (tmp_path / "figure.png").write_bytes(b"light")
    before_s = time.time() - 5
    os.utime(tmp_path / "figure.png", (before_s, before_s))
    found = by_hand(Display()).look_or_key(file, pattern, tmp_path / "figure", keys)
    assert found == tmp_path / "figure.png"


@pytest.fixture
def apart(sources, tmp_path) -> VirtualBench:
    """A bench whose primaries are lit apart, in stripes of their own."""
    nm = np.arange(400.0, 701.0, 10.0)
    write_panel(tmp_path / "panel.csv", [bump(middle, 30, nm) for middle in (620, 540, 460)], nm)
    keys = write_channels(tmp_path, nm, {name: np.full_like(nm, 0.5) for name in "rgb"})
    primaries = {"file": "panel.csv", "layout": "rgb-stripe"}
    bench = {"tracker": keys, "monitor.primaries": primaries, "render": {"colour": "star"}}
    return sources(bench, filed=(bench,))


def test_each_primary_s_light_is_relative_to_white_of_all_of_them(apart):
    """Of a spectrum that a tracker sees as even, by its photons."""
    whites = np.array([620.0, 540.0, 460.0])
    shares = whites / whites.sum()
    place = np.array([5, 9])
    codes = np.array([[WHITE, 100, 200], [0, WHITE, 100]])
    lights = apart._lights(place, codes)
    for number, light in enumerate(lights):
        assert light.place.tolist() == [5, 9]
        # the spectra end at 400 and 700 nm, where the outer bumps are not over
        wanted = shares[number] * LIGHT[codes[:, number]]
        assert light.e_per_s == pytest.approx(wanted, rel=5e-3)


def test_each_primary_s_lit_pixels_are_drawn_in_its_own_light(apart):
    """Of one level they are drawn once and scaled for others."""
    place = np.array([4000, 7000])
    stripes = set()
    for number, primary in enumerate(apart._primaries_seen):
        drawn = apart._drawn(LitLight(place, np.ones(2)), primary)
        stripes.add(primary.place_px)
        for brightness in (1.0, 2.0):
            image = apart._primary_image(LitLight(place, np.full(2, brightness)), number)
            np.testing.assert_allclose(image, brightness * drawn, rtol=1e-5, atol=1e-3)
    assert len(stripes) == 3


class Watchers:
    """Somebody who watches, or nobody."""

    def __init__(self):
        self.frames, self.is_there = [], True

    def look(self):
        return self.is_there

    def put_frame(self, frame):
        self.frames.append(frame)


def test_patterns_are_handed_on_one_after_another_where_somebody_watches(tmp_path):
    watchers = Watchers()
    frames = PatternFrames(watchers)
    file = bench(tmp_path, "filed")
    grey = np.zeros((3, 5), dtype=np.uint16)
    grey[1, 2] = 700
    colour = np.zeros((3, 5, 3), dtype=np.uint16)
    colour[2, 4] = [1, 2, 3]
    for is_there, codes, lit_ns in ((True, grey, 7), (False, grey, 8), (True, colour, 9)):
        watchers.is_there = is_there
        frames.send(file, codes, lit_ns)
    first, second = watchers.frames
    for frame, number, lit_ns, channels in ((first, 1, 7, 1), (second, 2, 9, 3)):
        head = frame.head
        assert (head.frame, head.lit_ns, head.channels) == (number, lit_ns, channels)
        assert (head.width, head.height, head.bits) == (5, 3, BITS)
        assert head.bench_sha256 == file.sha256
    assert (first.lit.tolist(), first.codes.tolist()) == ([7], [700])
    assert (second.lit.tolist(), second.codes.tolist()) == ([14], [[1, 2, 3]])


def test_a_camera_s_black_images_are_said_once_of_lit_patterns_and_once_of_black_ones(caplog):
    images = BlackImages()
    black, grey = np.zeros((2, 3), dtype=np.uint16), np.eye(2, 3, dtype=np.uint16)
    for image, is_lit in ((grey, True), (black, True), (black, True), (black, False)):
        images.tell(image, "frame_0", lit=is_lit)
    lens_cap, black_level = caplog.messages
    assert lens_cap.startswith("frame_0: every pixel is 0; look at the lens cap")
    assert "a black level above 0" in black_level
