"""The attitude log: a turn that its rates fit, and what its commands make of it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.examples.support import EXAMPLES, commands, copied, section
from tests.support.commands import run_hilstar_here
from tests.support.tables import csv_rows
from tests.support.waiting import PATIENCE_S

STEP_S = 0.1
# The trapezoidal rule's error in one step, h^3 / 12 times the largest second derivative of the
# rate, A/T (2 pi/T)^2.
STEP_ERROR_RAD = STEP_S**3 / 12 * np.radians(20) / 20 * (2 * np.pi / 20) ** 2
DIGITS_RAD = 1e-11  # of the file, in a difference of two attitudes


def sample_rows() -> np.ndarray:
    """t_s, q_icrs_to_cam, rate_cam_rad_s of each sample."""
    return np.loadtxt(EXAMPLES / "slew.csv", delimiter=",", skiprows=2)


def test_the_log_is_what_its_script_makes():
    made = subprocess.run(
        [sys.executable, EXAMPLES / "make_slew.py"],
        capture_output=True,
        text=True,
        check=True,
        timeout=PATIENCE_S,
    )
    assert made.stdout == (EXAMPLES / "slew.csv").read_text()


def test_its_attitudes_turn_as_its_rates_say_from_rest_to_rest():
    log = sample_rows()
    attitudes = Rotation.from_quat(log[:, 1:5], scalar_first=True)
    assert np.allclose(np.linalg.norm(log[:, 1:5], axis=1), 1, rtol=0, atol=1e-11)
    turns = (attitudes[1:] * attitudes[:-1].inv()).as_rotvec()
    expected = -STEP_S * (log[1:, 5:] + log[:-1, 5:]) / 2  # v_cam' = -omega x v_cam
    assert np.abs(turns - expected).max() < STEP_ERROR_RAD + DIGITS_RAD
    assert np.degrees((attitudes[-1] * attitudes[0].inv()).magnitude()) == pytest.approx(
        20, abs=1e-9
    )
    speed_deg_s = np.degrees(np.linalg.norm(log[:, 5:], axis=1))
    assert speed_deg_s.max() == pytest.approx(2, abs=1e-9)
    assert speed_deg_s[0] == speed_deg_s[-1] == 0


def test_replay_and_the_virtual_tracker_follow_it(tmp_path, monkeypatch):
    monkeypatch.chdir(copied(tmp_path))
    replay, simulate = commands("An attitude log")
    replayed, exposed = run_hilstar_here(*replay[1:]), run_hilstar_here(*simulate[1:])
    assert (replayed.returncode, exposed.returncode) == (0, 0), replayed.stderr + exposed.stderr
    (shown,) = re.findall(r"(?s)```text\n(.*?)```", section("An attitude log"))
    assert shape(replayed.stdout + exposed.stdout) == shape(shown)

    log = sample_rows()
    frames = csv_rows(Path("slew-frames/frames.csv"))
    assert [float(frame["t_s"]) for frame in frames] == [2.0 * k for k in range(12)]
    for frame, sample in zip(frames, log[::20], strict=True):
        assert np.allclose(
            [float(frame[name]) for name in ("qw", "qx", "qy", "qz")],
            sample[1:5],
            rtol=0,
            atol=1e-11,
        )
        assert int(frame["stars_drawn"]) > 50
        assert np.asarray(Image.open(f"slew-frames/frame_{int(frame['frame']):06}.png")).max() > 20

    for number, sample in enumerate((log[0], log[110], log[220])):
        header = fits.getheader(f"slew-exposures/exposure_{number:06}.fits")
        turned = [header["RATEX"], header["RATEY"], header["RATEZ"]]
        # The mean rate of an exposure of 0.1 s that the log's ends may cut in half.
        assert np.allclose(turned, np.degrees(sample[5:]), rtol=0, atol=2e-3)


def shape(text: str) -> str:
    """The lines with every figure and name that differs from machine to machine made alike."""
    return re.sub(r"-?\d+(\.\d+)?", "N", re.sub(r"(?m)^renderer .*$", "renderer", text))
