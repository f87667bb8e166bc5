"""Basilisk's controller before hilstar's display and tracker, as the example closes the loop: it
slews and settles.
"""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.examples.support import copied
from tests.support.waiting import PATIENCE_S

# 6 s of real time: 25 arcsec with a bandwidth of 0.6 rad/s have decayed to 5 and then 2 arcsec in the
# last quarter; what is added is the tracker's noise, 0.1 arcsec and 1.2 about the boresight, through
# the controller. Measured 0.1 to 3.5, and 5, on a machine with three times the work of its cores.
SLEW_DEG, SECONDS = 0.007, 6
ACROSS_ARCSEC, ABOUT_ARCSEC = 10.0, 15.0
# The loop is closed in real time: a machine that loses answers, or is late with them, flies another
# loop, of which nothing is stated.
# the tracker exposes ten times a second: more frames than twice that are work for nobody
REFRESH_HZ = 20
MIN_ANSWERS, MAX_AGE_MS = 50, 250.0


def test_a_slew_settles_by_nothing_but_the_trackers_answers(tmp_path):
    command = [sys.executable, "basilisk_loop.py", str(SLEW_DEG), str(SECONDS)]
    folder = copied(tmp_path)
    bench = folder / "bench.toml"
    bench.write_text(
        bench.read_text().replace("[monitor]", f"[monitor]\nrefresh_hz = {REFRESH_HZ}")
    )
    result = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S + 60, check=False
    )
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert found["answers"] > 0
    if found["answers"] < MIN_ANSWERS or found["answer_age_ms"] > MAX_AGE_MS:
        pytest.skip(
            f"a busy machine: {found['answers']} answers of 60, {found['answer_age_ms']:.0f} ms old"
            " in the middle"
        )
    assert found["pointing_rms_arcsec"]["x"] < ACROSS_ARCSEC
    assert found["pointing_rms_arcsec"]["y"] < ACROSS_ARCSEC
    assert found["pointing_rms_arcsec"]["about_boresight"] < ABOUT_ARCSEC
