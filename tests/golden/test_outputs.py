"""The whole output of commands as it was when it was looked at and found right: each line, each
key and each row, with its numbers.

A change of what a command says shows in the change of its file:
`python -m tests.golden.test_outputs` writes them anew.
"""

from __future__ import annotations

import math
import re
import sys
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from tests.support.benches import ROOT
from tests.support.commands import run_hilstar_here

OUTPUTS = Path(__file__).with_name("outputs")
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
# Of a number, beside a unit of its last digit: other processors round a few codes otherwise, which
# moves what is measured of a star by less.
WITHIN = 0.01
ROWS = 25  # of a table

ROLLING = """
[tracker]
aperture_mm = 22
focal_length_mm = 45
pixel_pitch_um = 5.5
resolution_px = [480, 320]
exposure_s = 0.08
psf_sigma_px = [0.9, 0.7]
quantum_efficiency = "ccd47-20"
[tracker.detector]
dark_e_per_s = 40
read_noise_e = 7
offset_dn = 64
gain_e_per_dn = 3.1
bits = 12
shutter = "rolling"
row_time_us = 30
[monitor]
resolution_px = [400, 300]
pixel_pitch_um = 50
refresh_hz = 75
bits = 8
flip_y = true
panel_delay_ms = 4.5
calibration = "lcd-example"
[collimator]
focal_length_mm = 310
q_cam_to_mon = [0.9999952, 0.001745, -0.0013, 0.0022]
[render]
effort = "auto"
quantisation = "auto"
tolerance_mag = 0.03
tolerance_px = 0.15
[sky]
faintest_v_mag = 8
epoch_utc = "2027-03-04T05:06:07Z"
observer_velocity_km_s = [12, -20, 7]
[background]
zodiacal_v_mag_arcsec2 = 21.5
"""
POINT = "--radec 84.5,-1.5,20"
# Commands in the order in which they run, each in the folder that the earlier ones wrote into.
COMMANDS = {
    "frame": [
        f"frame bench.toml {POINT} --explain --truth truth.csv --codes codes.png",
        f"frame bench.toml {POINT} --json -o a.fits",
        "frame bench.toml --radec 84.5,-1.5,20.002 -o b.fits",
        "compare a.fits b.fits --json",
        "compare a.fits a.fits",
    ],
    "other_benches": [
        "frame configs/microdisplay.toml --star Vega --explain",
        "frame configs/rosetta-navcam.toml --star Sirius,40 --explain --json",
        "frame configs/thesis-orion.toml --radec 5h36m14s,-1d12m,0 --explain",
    ],
    "catalogue": ["catalogue bench.toml --faintest 2 -o stars.csv"],
    "verify": ["verify bench.toml --fields 1 --seed 3", "verify bench.toml --fields 1 --json"],
    "simulate": [f"simulate bench.toml {POINT} --slew 0.1,-0.2,1 -o s.fits --json"],
    "attitude": [
        "attitude slew.csv --json",
        "attitude slew.csv",
        "convert slew.csv slew.aem",
        "attitude slew.aem",
    ],
}


def outputs_of(name: str, folder: Path) -> str:
    """All that the commands of a name print and write as text, in a folder, a part each."""
    (folder / "bench.toml").write_text(ROLLING)
    # by a name without the checkout's folder, which may have spaces
    (folder / "configs").symlink_to(ROOT / "configs")
    (folder / "slew.csv").write_bytes((ROOT / "examples" / "slew.csv").read_bytes())
    parts = []
    for command in COMMANDS[name]:
        before = set(folder.iterdir())
        result = run_hilstar_here(command, cwd=folder)
        parts += [f"$ hilstar {command}", f"exit {result.returncode}", result.stdout]
        parts += [result.stderr]
        for path in sorted(set(folder.iterdir()) - before):
            if path.suffix in {".csv", ".json", ".aem", ".toml"}:
                rows = path.read_text().splitlines()
                parts += [f"== {path.name}, {len(rows)} lines", *rows[:ROWS]]
    return without_place_and_time("\n".join(parts).replace(str(folder), "."))


def without_place_and_time(text: str) -> str:
    """A text without what another checkout, version, day or driver writes there."""
    text = text.replace(str(ROOT), "ROOT").replace(version("hilstar"), "VERSION")
    text = re.sub(r"(CREATION_DATE +=).*", r"\1", text)
    text = re.sub(r'"gl_renderer":"[^"]*"', '"gl_renderer":""', text)
    return re.sub(r"[ \t]+\n", "\n", text)


def differences(now: str, then: str) -> list[str]:
    """Lines that differ, by their words or by a number."""
    lines_now = now.splitlines()
    lines_then = then.splitlines()
    if len(lines_now) != len(lines_then):
        return [f"{len(lines_now)} lines, {len(lines_then)} then"]
    pairs = zip(lines_now, lines_then, strict=True)
    return [f"{line}\nthen\n{before}" for line, before in pairs if not is_same(line, before)]


def is_same(now: str, then: str) -> bool:
    """Whether two lines have the same words and near numbers."""
    if NUMBER.sub("#", now) != NUMBER.sub("#", then):
        return False
    numbers = zip(NUMBER.findall(now), NUMBER.findall(then), strict=True)
    return all(
        math.isclose(float(number), float(before), rel_tol=WITHIN, abs_tol=last_digit(before))
        for number, before in numbers
    )


def last_digit(number: str) -> float:
    """A unit of a number's last digit."""
    mantissa, _, exponent = number.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return 10.0 ** (int(exponent or 0) - decimals)


@pytest.mark.parametrize("name", COMMANDS)
def test_what_commands_say_and_write_is_as_it_was(name, tmp_path):
    then = (OUTPUTS / f"{name}.txt").read_text()
    assert differences(outputs_of(name, tmp_path), then) == []


if __name__ == "__main__":
    for name in sys.argv[1:] or COMMANDS:
        with TemporaryDirectory() as folder:
            (OUTPUTS / f"{name}.txt").write_text(outputs_of(name, Path(folder)))
