"""A camera in the place of a photodiode: changes of the square by its images, and the latency."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest

from hilstar.instruments.calibrate.camera_edges import (
    begin_on_host,
    check_rate,
    edges_in,
    find_square,
    format_of_fewest_bits,
)
from hilstar.server.genicam.camera import Film, has_aravis
from hilstar.server.gige.registers import CameraSettings
from hilstar.server.screen.screen import marker_light
from tests.support.benches import bench_text
from tests.support.commands import run_hilstar_here
from tests.support.gige_cameras import running_camera
from tests.support.planted_run import write_ledger
from tests.support.refusals import refusal

needs_aravis = pytest.mark.skipif(
    not has_aravis(), reason="Aravis is not installed (gir1.2-aravis-0.8, python3-gi)"
)
REFRESH_HZ, LATENCY_S, MARKER_PX = 20.0, 0.070, 64
SQUARE = (slice(30, 42), slice(8, 20))
DARK_DN, LIT_DN = 20, 180
RUN_S = 60.0
# Of the median: the bytes of an image come after its exposure, on a machine that has other work.
MAX_OFF_MS = 5.0


class Blinking:
    """A square that is lit as the marker of frames at 1 / REFRESH_HZ from `start_s` on, LATENCY_S
    later.
    """

    def __init__(self, start_s: float) -> None:
        count = round(RUN_S * REFRESH_HZ)
        self.swap_s = start_s + np.arange(count) / REFRESH_HZ
        self.marker = [marker_light(k, "code") for k in range(count)]
        # seconds of light up to each frame's beginning
        self._lit_s = np.concatenate([[0.0], np.cumsum(self.marker)]) / REFRESH_HZ

    def share(self, begin_s, end_s):
        """The share of a time in which it was lit."""
        ends = np.append(self.swap_s, self.swap_s[-1] + 1 / REFRESH_HZ) + LATENCY_S
        lit = np.interp([begin_s, end_s], ends, self._lit_s)
        return float(lit[1] - lit[0]) / (end_s - begin_s)

    @property
    def edges(self):
        """When it changes, s, and the level after each."""
        changed = np.flatnonzero(np.diff(self.marker)) + 1
        return self.swap_s[changed] + LATENCY_S, np.array(self.marker)[changed]


@pytest.mark.parametrize(("period_s", "exposure_s"), [(0.010, 0.010), (0.012, 0.006), (0.02, 0.02)])
def test_changes_are_known_to_less_than_the_pause_between_exposures(period_s, exposure_s):
    light = Blinking(5.0)
    begin_s = 5.5 + 0.9973 * period_s * np.arange(round(30 / period_s))
    shares = np.array([light.share(begin, begin + exposure_s) for begin in begin_s])
    begin_ns = np.round(begin_s * 1e9).astype(np.int64)
    found = edges_in(begin_ns, exposure_s, DARK_DN + LIT_DN * shares)
    true_s, level = light.edges
    inside = (true_s > begin_s[0] + 0.1) & (true_s < begin_s[-1] - 0.1)
    off_s, missing = [], 0
    for edge_s, after in zip(true_s[inside], level[inside], strict=True):
        near = np.abs(found.host_ns / 1e9 - edge_s).argmin()
        assert found.level[near] == after
        off_s.append(found.host_ns[near] / 1e9 - edge_s)
        missing += abs(off_s[-1]) > period_s
    assert missing <= 0.02 * len(off_s)
    # a change that only a tenth of an exposure tells is taken for one between two
    largest_s = (period_s - exposure_s) / 2 + 0.1 * exposure_s
    assert np.quantile(np.abs(off_s), 0.98) < largest_s + 1e-6
    assert abs(np.median(off_s)) < 0.1 * largest_s


def film_of(dn, stamp_ns, arrived_ns, exposure_s=0.01):
    return Film(dn, np.array(stamp_ns), np.array(arrived_ns), exposure_s, 0)


def test_exposures_stand_on_the_hosts_clock_as_early_as_their_bytes_allow(rng):
    stamp_ns = 7_000_000 + 10_000_000 * np.arange(200)
    true_begin_ns = stamp_ns + 123_456_789_000
    # each waits a while, and one in ten not at all
    waited_ns = rng.integers(0, 4_000_000, 200) * (rng.random(200) > 0.1)
    utc_ns = true_begin_ns + 10_000_000 + waited_ns + 55_000
    film = film_of(np.zeros((200, 1, 1), np.uint8), stamp_ns, utc_ns)
    begin_ns = begin_on_host(film, to_host_ns=-55_000)
    np.testing.assert_allclose(begin_ns, true_begin_ns, atol=100_000)
    without = film_of(film.dn, 0 * stamp_ns, utc_ns)
    np.testing.assert_array_equal(begin_on_host(without, -55_000), true_begin_ns + waited_ns)


def test_the_square_is_the_largest_patch_that_blinks(rng):
    images = rng.integers(18, 23, (12, 48, 64)).astype(np.uint8)
    images[::2, 30:42, 8:20] += 80
    images[1::3, 5, 58:61] += 200  # pixels that flicker, by more than twice as much
    square = find_square(film_of(images, np.arange(12), np.arange(12)))
    assert square.rows == (30, 42)
    assert square.pixels.shape == (12, 64)
    assert square.pixels[:, 8:20].all() and square.pixels.sum() == 144


def test_a_camera_that_is_fast_enough_is_taken():
    check_rate(30_000_000 * np.arange(50), 0.004, 20.0)


@needs_aravis
def test_a_camera_before_the_square_tells_the_latency(tmp_path):
    light = Blinking(time.monotonic() - 1.0)
    bench = bench_text(
        {"monitor": {"refresh_hz": REFRESH_HZ, "photodiode_px": MARKER_PX, "photodiode": "code"}}
    )
    ledger = write_ledger(
        tmp_path / "run.mcap",
        light.swap_s - light.swap_s[0],
        None,
        start_ns=round(light.swap_s[0] * 1e9),
        bench=bench,
        markers=light.marker,
    )
    settings = CameraSettings(64, 48, 8, 0.01, 60.0)

    def image(k):
        """What was exposed up to now."""
        now_s = time.monotonic()
        shown = np.full((48, 64), DARK_DN, np.uint16)
        shown[SQUARE] += round(LIT_DN * light.share(now_s - settings.exposure_s, now_s))
        return shown

    with running_camera(settings, image) as address:
        found = run_hilstar_here(
            "latency", ledger, "--grab", f"genicam:{address}", "--duration", "6", "--json"
        )
    assert found.returncode == 0, found.stderr
    figures = json.loads(found.stdout)
    assert figures["edges"] > 40 and not figures["ambiguous"]
    assert figures["latency_ms"]["p50"] == pytest.approx(1e3 * LATENCY_S, abs=MAX_OFF_MS)


def test_a_square_is_filmed_in_the_format_of_whole_bytes_with_the_fewest_bits():
    """A packed one is none of whole bytes."""
    assert format_of_fewest_bits(["Mono12", "Mono8", "BayerRG10"]) == "Mono8"
    assert format_of_fewest_bits(["Mono8p", "Mono12Packed", "BayerRG10"]) == "BayerRG10"
    words = refusal(format_of_fewest_bits, ["Mono12Packed", "RGB8"])
    assert words.endswith("whole bytes of grey or Bayer: Mono12Packed, RGB8")
