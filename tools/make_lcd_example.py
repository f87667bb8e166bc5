"""Make the example calibration `lcd-example`: an invented liquid-crystal monitor, not a measurement
of any.

    python tools/make_lcd_example.py

What is typical and what was chosen: a contrast of 1000:1; gamma near 2.2, a little different in
each channel, bent towards the S-curve that a twisted-nematic cell has against voltage; a ripple of
0.5 % as the driver's own table leaves;
light that falls to 85 % in the corners, through screen and lens; a repeatability of 0.5 %.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray

DATA = Path(__file__).resolve().parents[1] / "hilstar" / "display" / "data"
SEED = 20260101
BITS = 8
WHITE_CD_M2 = {"r": 53.0, "g": 179.0, "b": 18.0}  # 250 cd/m2 in the proportions of Rec. 709
CONTRAST = 1000.0
GAMMA = {"r": 2.16, "g": 2.20, "b": 2.27}
CELL_SHARE = {"r": 0.10, "g": 0.12, "b": 0.18}  # weight of the S-curve in the response
RIPPLE = 0.005
RIPPLES = 6
GRID = (9, 15)  # rows, columns of fields
CORNER = 0.85
NOISE = 0.005

TOML = """# An invented example of a calibration file. It is NOT a measurement: see make_lcd_example.py, which made it.
[calibration]
kind = "photometric"
who = "nobody: made by tools/make_lcd_example.py, seed {seed}"
when = 2026-01-01
instrument = "none: an invented example, not a measurement"
unit = "cd/m2"
bits = {bits}
response = "lcd-example.csv"       # code,r,g,b; code 0 is the black level

[weights]                          # shares of white of the primaries, as an imagined silicon tracker sees them
r = 0.34
g = 0.42
b = 0.24

[uniformity]
file = "lcd-example-uniformity.csv"

[noise]
relative = {noise}

[notes]
warm_up = "invented: as after 30 minutes"
drift = "invented: none"
text = "An example to try bit stealing, uniformity and a black level with; calibrate your own monitor before you trust a flux."
"""


def channel_light(name: str, rng: np.random.Generator) -> FloatArray:
    """Light (2^bits,) of one primary above black, in cd/m2."""
    signal = np.arange(2**BITS) / (2**BITS - 1)
    cell = np.sin(np.pi / 2 * signal**1.1) ** 2
    light = (1 - CELL_SHARE[name]) * signal ** GAMMA[name] + CELL_SHARE[name] * cell
    phase, amplitude = (
        rng.uniform(0, 2 * np.pi, RIPPLES),
        rng.normal(0, RIPPLE / np.sqrt(RIPPLES / 2), RIPPLES),
    )
    waves = np.arange(1, RIPPLES + 1)
    ripple = (amplitude * np.sin(2 * np.pi * waves * signal[:, None] + phase)).sum(axis=1)
    light = light * (1 + ripple - ripple[-1])
    return np.asarray(WHITE_CD_M2[name] * light / light[-1])


def uniformity() -> FloatArray:
    """Relative light (rows, columns): a little off centre, as cos^4 does it, 0.85 in the
    farthest corner.
    """
    rows, columns = ((np.arange(n) + 0.5) / n - 0.5 for n in GRID)
    radius2 = (columns[None, :] - 0.03) ** 2 * (16 / 9) ** 2 + (rows[:, None] + 0.02) ** 2
    farthest = (0.53 * 16 / 9) ** 2 + 0.52**2
    tangent2 = CORNER**-0.5 - 1  # cos^4 = CORNER there
    return np.asarray((1 + tangent2 * radius2 / farthest) ** -2.0)


def main() -> None:
    """Write the three packaged files."""
    rng = np.random.default_rng(SEED)
    black = sum(WHITE_CD_M2.values()) / CONTRAST
    light = np.stack([black + channel_light(name, rng) for name in WHITE_CD_M2], axis=1)
    rows = "".join(
        f"{code},{','.join(f'{value:.6g}' for value in row)}\n" for code, row in enumerate(light)
    )
    title = "# An invented example, NOT a measurement (make_lcd_example.py): "
    (DATA / "lcd-example.csv").write_text(
        f"{title}cd/m2, black level included\ncode,r,g,b\n{rows}", encoding="ascii"
    )
    fields = "".join(",".join(f"{value:.4f}" for value in row) + "\n" for row in uniformity())
    (DATA / "lcd-example-uniformity.csv").write_text(
        f"{title}relative light, top row first\n{fields}", encoding="ascii"
    )
    (DATA / "lcd-example.toml").write_text(
        TOML.format(seed=SEED, bits=BITS, noise=NOISE), encoding="ascii"
    )


if __name__ == "__main__":
    main()
