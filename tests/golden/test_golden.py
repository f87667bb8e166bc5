"""A small frame as it was when it was looked at and found right: Orion's belt, code for code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from hilstar.basics.rotation import from_radec_roll_deg

GOLDEN = Path(__file__).with_name("belt.png")
# Another driver's erf may put a pixel that stands at a threshold on its other side: one code.
CODE_TOLERANCE = 1


def test_orion_s_belt_is_as_it_was(bench_with):
    bench = bench_with('[sky]\nspectrum = "blackbody"\n[render]\nflux_at_white_e_per_s = 1.5e6\n')
    codes = bench.frame(from_radec_roll_deg(84.057, -1.2, 0.0)).codes
    golden = np.array(Image.open(GOLDEN))
    assert golden.shape == (240, 320)
    assert golden.max() > 200
    assert np.abs(codes.astype(int) - golden).max() <= CODE_TOLERANCE
