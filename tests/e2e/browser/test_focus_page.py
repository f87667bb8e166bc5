"""The page beside somebody who turns the tracker's ring: the figure, the best so far and the curve, of
star widths that answers report.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.support.benches import TWIN, bench_text
from tests.support.browser import Browser, assert_fits_every_size_in_light_and_dark
from tests.support.forks import HILSTAR, Started
from tests.support.pages import page_of
from tests.support.senders import answers_over_udp, free_port
from tests.support.servers import Served

pytestmark = pytest.mark.e2e

SHARP_PX, BLURRED_PX, ANSWERS = 1.0, 2.2, 60  # a turn of the ring there and back, in three seconds
FRINGE_PX = (-0.02, -0.01, 0.0, 0.01, 0.02)  # by which five stars' widths differ


def ring_that_turns() -> Iterator[bytes]:
    """Answers that report five stars while the tracker's ring is turned back and forth."""
    for number in itertools.count(1):
        share = 0.5 - 0.5 * math.cos(2 * math.pi * number / ANSWERS)
        width_px = SHARP_PX + (BLURRED_PX - SHARP_PX) * share
        stars = [[9, 9, 99, None, width_px + off_px] for off_px in FRINGE_PX]
        yield json.dumps({"centroids": stars}).encode()


@contextmanager
def page_of_focus(page: Browser, *words: str) -> Iterator[None]:
    """The browser at the page of `calibrate focus`, once that has a figure."""
    command = [*HILSTAR, "calibrate", "focus", *words, "--console", "127.0.0.1:0"]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    with Started(command, env=os.environ, **pipes) as process:
        try:
            address = page_of(Served(process, 0))
            page.get(f"http://{address.host}:{address.port}/")
            page.until("!document.getElementById('focus').hidden")
            yield
            page.get("about:blank")
        finally:
            process.send_signal(signal.SIGINT)


@pytest.fixture
def focus_page(page, tmp_path) -> Iterator[Browser]:
    """The page of `calibrate focus --answers`, once its best is where the ring is sharpest."""
    port = free_port()
    answers = f'[answers]\nsource = "udp"\nbind = "127.0.0.1:{port}"\nclock = "host"\n'
    bench = tmp_path / "bench.toml"
    bench.write_text(bench_text() + answers + 'format = "json"\n')
    words = ("--answers", "--star", "Alnilam", "--headless", "--feed", "tcp://127.0.0.1:*")
    with answers_over_udp(port, ring_that_turns()), page_of_focus(page, str(bench), *words):
        page.until("document.querySelector('#focus-rows dd').textContent.startsWith('1.0')")
        yield page


def text_of(page: Browser, place: str) -> str:
    return str(page.run(f"return document.querySelector('{place}').textContent"))


def test_the_page_shows_the_figure_its_error_the_best_and_the_curve(focus_page, tmp_path):
    page = focus_page
    assert text_of(page, "#focus-what") == "by star sigma"
    assert text_of(page, "#health-headline") == "The focus is measured"
    assert SHARP_PX <= float(text_of(page, "#focus-now").split()[0]) <= BLURRED_PX + 0.02
    assert text_of(page, "#focus-error").startswith("\u00b1 0.0")
    assert text_of(page, "#focus-state") in {"sharpest so far", "less sharp"}
    page.until("document.getElementById('focus-state').textContent === 'less sharp'")
    page.until("/^best 1\\.0/.test(document.getElementById('focus-line').textContent)")
    page.until(
        "/\\u00b7|to|px/.test(document.querySelector('#chart-focus .chart-text').textContent)"
    )
    assert page.run("return document.querySelector('#chart-focus canvas').width") > 100
    assert_fits_every_size_in_light_and_dark(page, tmp_path)


def test_images_have_the_same_page(page, tmp_path):
    bench = tmp_path / "bench.toml"
    bench.write_text(bench_text(TWIN))
    truth = tmp_path / "truth.toml"
    truth.write_text(bench_text(TWIN, {"tracker": {"psf_sigma_px": [1.4, 1.4]}}))
    with page_of_focus(page, str(bench), "--virtual", str(truth), "--exposure", "0.005"):
        page.until("/^1\\.[34]/.test(document.getElementById('focus-now').textContent)")
        assert text_of(page, "#focus-what") == "by PSF sigma"
        assert text_of(page, "#focus-rows").endswith("dots")
