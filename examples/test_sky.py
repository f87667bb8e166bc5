"""A regression test to copy beside a bench file of your own. While you trust your bench, keep a
golden frame of it:

hilstar frame bench.toml --quaternion 0.6987226,0.7135120,-0.0370377,0.0362700 -o golden.fits
--truth golden.csv
"""

from __future__ import annotations

from pathlib import Path

import hilstar
from hilstar.testing import assert_same_sky

HERE = Path(__file__).parent
# RA 84.057, Dec -1.200, roll 0 deg
BELT_Q_ICRS_TO_CAM = (0.6987226, 0.7135120, -0.0370377, 0.0362700)


def test_orion_s_belt_is_the_same_sky_as_in_the_golden_frame() -> None:
    """Every star has its light and its place, to 0.001 mag and 0.001 px."""
    with hilstar.load(HERE / "bench.toml") as bench:
        frame = bench.frame(BELT_Q_ICRS_TO_CAM)
    assert_same_sky(frame, HERE / "golden.fits", truth=HERE / "golden.csv")
